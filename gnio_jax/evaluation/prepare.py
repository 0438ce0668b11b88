"""Preparation of sequences for an estimator: at the network's rate, in whole strides, with a
start."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.config import DataConfig, FilterSettings
from gnio_jax.errors import InputError
from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.filtering import (
    Filter,
    FilterState,
    InitialStd,
    initial_state,
    level_state,
    make_filter,
)
from gnio_jax.filtering.start import rest_at_start
from gnio_jax.filtering.update import Measurement
from gnio_jax.models.airimu import Corrector
from gnio_jax.numerics import (
    cumulative_rotation,
    finite_rows,
    last_true,
    matrix_from_quaternion,
    rotations,
    yaw_rotation,
)
from gnio_jax.types import Array, Sequence, Waypoints
from gnio_jax.windows import true_displacement, window_starts

REFERENCE_BIAS_SECONDS = 10.0
"""Time of the reference that `gyro_bias="reference"` uses, s."""
ROUGH_START = 0.4
"""Standard deviation of the first velocity above which a static start is inaccurate, m/s (ours),
because the person does not stand still."""
OF_WAYPOINTS = (
    "waypoints, no poses: it starts level, with yaw and position zero, and is compared after one "
    "turn about z and one shift"
)

Init = Literal["reference", "static"]
BiasSource = Literal["zero", "rest", "reference"]
Orientation = Literal["filter", "device", "reference"]
Matrices = Float[np.ndarray, "t 3 3"]


class Start(NamedTuple):
    """The start of the filter, and its uncertainty."""

    rotation: Float[np.ndarray, "3 3"]
    """Body→world."""
    velocity: Float[np.ndarray, "3"]
    """m/s."""
    position: Float[np.ndarray, "3"]
    """m."""
    gyro_bias: Float[np.ndarray, "3"]
    """First estimate, rad/s."""
    std: InitialStd
    level_gyro_bias: float
    """Standard deviation of the components of the gyro bias that are level at the start, rad/s;
    `std` has that of the vertical one."""
    raw_gyro: bool
    """True if neither the phone nor a rest gave a first estimate of the gyro's bias."""

    @property
    def raw_axis(self) -> Float[Array, "3"]:
        """The vertical at the start, in the body, if the gyro is raw, otherwise zero. The bias
        along it is considered."""
        return self.raw_gyro * self.rotation[2]

    def state(self, ekf: Filter) -> FilterState:
        """The start as a state of the filter, with the standard deviations of this start."""
        ekf = dataclasses.replace(ekf, start=self.std)
        pose = self.rotation, self.velocity, self.position
        return initial_state(ekf, *pose, self.gyro_bias, 0, self.level_gyro_bias)


class PreparedRecording(NamedTuple):
    """A sequence prepared for an estimator: K strides of n samples."""

    name: str
    group: str
    """Person or session; recordings of the same one are not independent."""
    placement: str
    """Way of carrying the IMU, as its dataset names it; empty if it is not known."""
    time: Float[np.ndarray, "k1"]
    """Stamps of the start and of the end of each stride, K + 1, s."""
    gyro: Float[np.ndarray, "t 3"]
    """K·n samples, rad/s."""
    accel: Float[np.ndarray, "t 3"]
    """K·n samples, m/s²."""
    imu_valid: Bool[np.ndarray, "t"] | None
    """Whether each sample was measured; None: all were."""
    start: Start
    attitude: Matrices | None
    """Body→world at every sample and at the end of the last one, K·n + 1 rows, for windows that are
    not cut inside the filter."""
    reference: Trajectory
    """The reference at `time`; NaN where it cannot be trusted."""
    displacement: Float[np.ndarray, "m 3"]
    """Displacement of the reference over each window, with a stride between windows, m, expressed
    in the yaw frame of the window's start; NaN where the reference cannot be trusted."""
    velocity: Float[np.ndarray, "m 3"]
    """Velocity of the reference at the end of each window, in metres per window, expressed in the
    body; NaN where the reference cannot be trusted."""
    notes: tuple[str, ...]
    """Notes for a reader of the result."""
    waypoints: Waypoints | None = None
    """The reference of a sequence without poses."""
    variance: Float[np.ndarray, "t 6"] | None = None
    """Variances of [accel, gyro] by a corrector, (m/s²)² and (rad/s)²; None: there is none."""
    measurements: tuple[Measurement, ...] = ()
    """Measurements of other sensors with a row for each stride, in addition to those of the filter.
    Recordings that are estimated together have the same ones."""

    @property
    def strides(self) -> int:
        """K."""
        return len(self.time) - 1


def prepare(
    sequences: Iterable[Sequence],
    windows: DataConfig,
    ekf: Filter | None = None,
    *,
    init: Init = "reference",
    gyro_bias: BiasSource = "zero",
    orientation: Orientation | None = None,
    from_first: bool = False,
    corrector: Corrector | None = None,
) -> tuple[list[PreparedRecording], dict[str, str]]:
    """Recordings to estimate, and the names of the sequences that are left out with the reason.

    A recording begins at the first sample with a trusted reference, or without a reference at its
    first sample. A sequence with waypoints has no pose to start from, so its start is always
    static.

    Args:
        sequences: The sequences, at any rate.
        windows: Rate, window and stride.
        ekf: The filter, for the uncertainty of the start; None: the defaults. A static start
            replaces the standard deviations of tilt and velocity. `ekf.raw_gyro_bias` replaces that
            of the level components of the gyro's bias if neither the phone nor a rest gives a first
            estimate of it: if `imu_compensated` is "no" and the bias starts from zero.
        init: "reference" takes pose and velocity of the reference. "static" takes the tilt from
            gravity, and yaw, position and velocity are zero.
        gyro_bias: The source of the first estimate of the gyro's bias, "zero", "rest" or
            "reference".
        orientation: The source of `PreparedRecording.attitude`; None: there is none.
        from_first: Whether recordings begin at their first sample, whatever the reference.
        corrector: It corrects the samples of a recording before everything else.

    Raises:
        InputError: A sequence lacks what these choices need.
    """
    ekf = ekf or make_filter(windows, FilterSettings())
    recordings, left_out = [], {}
    for sequence in sequences:
        sequence = data.resample(sequence, windows.rate)
        variance = None
        if corrector is not None:
            accel, gyro, variance = corrector.correct(sequence.accel, sequence.gyro)
            sequence = sequence._replace(accel=accel, gyro=gyro)
        posed = finite_rows(sequence.position) & finite_rows(sequence.orientation)
        sequence = sequence._replace(valid=sequence.valid & posed)
        _check(sequence, init, gyro_bias, orientation)
        first = 0 if from_first else int(np.argmax(sequence.valid))
        strides = (len(sequence.time) - 1 - first) // windows.stride
        whole = _cut(sequence, slice(first, first + strides * windows.stride + 1))
        if variance is not None:
            variance = variance[first : first + strides * windows.stride]
        measured = whole.measured_rows
        if (
            strides <= windows.input_samples // windows.stride
            or len(measured) < windows.input_samples
        ):
            seconds = len(_cut(sequence, slice(first, None)).measured_rows) / windows.rate
            problem = f"{seconds:.2f} s measured from its first trusted sample on"
            left_out[sequence.name] = f"{problem}, too short for a window and a stride"
            continue
        start, notes = _find_start(whole, measured, windows, ekf, init, gyro_bias)
        trusted, mask = whole.valid[:, None], whole.imu_valid
        starts = window_starts(len(whole.time), windows.window, windows.stride)
        poses = [np.where(trusted, part, np.nan) for part in (whole.position, whole.orientation)]
        ends = slice(None, None, windows.stride)
        placement = str(sequence.attributes.get("placement", "unknown"))
        recordings.append(
            PreparedRecording(
                name=sequence.name,
                group=str(data.group(sequence)),
                placement="" if placement == "unknown" else placement,
                time=whole.time[ends],
                gyro=whole.gyro[:-1],
                accel=whole.accel[:-1],
                imu_valid=None if mask is None or mask.all() else mask[:-1],
                start=start,
                attitude=orientation and _trace_attitude(whole, start, windows.rate, orientation),
                reference=Trajectory(whole.time[ends], *(part[ends] for part in poses)),
                displacement=true_displacement(poses[1], poses[0], starts, windows.window),
                velocity=windows.window_seconds * _velocity_in_body(whole, starts + windows.window),
                notes=notes,
                waypoints=whole.waypoints,
                variance=variance,
            )
        )
    return recordings, left_out


def _velocity_in_body(sequence: Sequence, rows: Int[np.ndarray, "m"]) -> Float[np.ndarray, "m 3"]:
    """The velocity of the reference at these rows, m/s, expressed in the body; NaN where the
    reference cannot be trusted."""
    valid = sequence.valid[rows, None]
    velocity, orientation = (
        np.where(valid, part[rows], np.nan) for part in (sequence.velocity, sequence.orientation)
    )
    return np.einsum("mji,mj->mi", matrix_from_quaternion(orientation), velocity)


def _check(
    sequence: Sequence, init: Init, gyro_bias: BiasSource, orientation: Orientation | None
) -> None:
    """Raise `InputError` if the sequence lacks what the choices need."""
    if orientation == "device" and sequence.device_orientation is None:
        remedy = "give --orientation filter or reference"
        raise InputError(sequence.name, "has no device orientation", remedy)
    if sequence.valid.any():
        return
    tapped = sequence.waypoints is not None
    remedies = {
        "--init static": init == "reference" and not tapped,
        "--gyro-bias zero": gyro_bias == "reference",
        "--orientation filter": orientation == "reference",
    }
    for remedy, needed in remedies.items():
        if needed:
            problem = "has waypoints, no poses" if tapped else "has no reference"
            raise InputError(sequence.name, problem, f"give {remedy}")


def _cut(sequence: Sequence, rows: slice) -> Sequence:
    """Some samples of a sequence."""
    arrays = {k: v[rows] for k, v in sequence._asdict().items() if isinstance(v, np.ndarray)}
    return sequence._replace(**arrays)


def _find_start(
    sequence: Sequence,
    measured: Int[np.ndarray, "m"],
    windows: DataConfig,
    ekf: Filter,
    init: Init,
    gyro_bias: BiasSource,
) -> tuple[Start, tuple[str, ...]]:
    """The start of a recording, and notes about its reference, its gyro's bias and its pose."""
    bias, bias_note = _estimate_gyro_bias(sequence, measured, windows.rate, gyro_bias)
    raw = sequence.attributes.get("imu_compensated") == "no" and not bias.any()
    reference_note = ""
    if sequence.waypoints is not None:
        init, reference_note = "static", OF_WAYPOINTS
    rotation, velocity, position, std, start_note = _find_pose(
        sequence, measured, windows, ekf, init
    )
    level = ekf.start.gyro_bias
    if raw and ekf.raw_gyro_bias is not None:
        level = ekf.raw_gyro_bias
    start = Start(rotation, velocity, position, bias, std, level, raw)
    return start, tuple(filter(None, (reference_note, bias_note, start_note)))


def _find_pose(
    sequence: Sequence,
    measured: Int[np.ndarray, "m"],
    windows: DataConfig,
    ekf: Filter,
    init: Init,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, InitialStd, str]:
    """Rotation, velocity and position at the start, their uncertainty, and a note about them."""
    if init == "reference":
        velocity = sequence.velocity[0]
        velocity = velocity if np.isfinite(velocity).all() else np.zeros(3)
        rotation = matrix_from_quaternion(sequence.orientation[0])
        return rotation, velocity, sequence.position[0], ekf.start, ""
    second = measured[measured < round(windows.rate)]
    if 2 * len(second) < round(windows.rate):  # most of the first second was not measured
        second = measured[: round(windows.rate)]
    level = level_state(ekf, sequence.gyro[second], sequence.accel[second])
    core_std = np.sqrt(np.diag(level.core_covariance))
    tilt_std, velocity_std = float(core_std[0]), float(core_std[3])
    std, note = ekf.start._replace(tilt=tilt_std, velocity=velocity_std), ""
    if velocity_std > ROUGH_START:
        tilt = float(f"{np.degrees(tilt_std):.1g}")  # rounded, so that few different notes are made
        sigma = f"one sigma: velocity {velocity_std:.1f} m/s, tilt {tilt:g}°"
        note = f"start: it moves, so the start is uncertain ({sigma})"
    return np.asarray(level.rotation), np.zeros(3), np.zeros(3), std, note


def _estimate_gyro_bias(
    sequence: Sequence, measured: Int[np.ndarray, "m"], rate: float, source: BiasSource
) -> tuple[Float[np.ndarray, "3"], str]:
    """First estimate of the gyro bias, rad/s, and its origin."""
    if source == "zero":
        return np.zeros(3), ""
    if source == "rest":
        # Samples interpolated across a gap look like rest, so only measured samples count.
        gyro, accel = np.full((2, len(sequence.time), 3), np.nan)
        gyro[measured], accel[measured] = sequence.gyro[measured], sequence.accel[measured]
        bias, seconds = rest_at_start(gyro, accel, 1.0 / rate)
        if not seconds:
            note = "gyro bias: no rest at the start (quieter than a hand), so it starts from zero"
            return np.zeros(3), note
        return bias, f"gyro bias: mean of {seconds:g} s of rest at the start"
    rows = np.arange(min(round(REFERENCE_BIAS_SECONDS * rate), len(sequence.time) - 1))
    rows = np.intersect1d(rows[sequence.valid[rows] & sequence.valid[rows + 1]], measured)
    if len(rows) < rate:
        return np.zeros(3), "gyro bias: under 1 s of reference at the start, so it starts from zero"
    before, after = (rotations(sequence.orientation[i]) for i in (rows, rows + 1))
    true_rate = (before.inv() * after).as_rotvec() * rate
    note = f"gyro bias: {len(rows) / rate:g} s against the reference orientation"
    return (sequence.gyro[rows] - true_rate).mean(0), note


def _trace_attitude(sequence: Sequence, start: Start, rate: float, source: Orientation) -> Matrices:
    """Body→world at every sample.

    `filter` is the gyro integrated from the start; `device` is the device's own estimate, turned
    about z to the yaw of the start. Where reference or device are missing, the gyro is integrated
    from the last attitude that they give. Raises `InputError` if they are missing at the start.
    """
    turns = Rotation.from_rotvec((sequence.gyro[:-1] - start.gyro_bias) / rate)
    integrated = start.rotation @ cumulative_rotation(turns).as_matrix()
    if source == "filter":
        return integrated
    orientation = sequence.orientation if source == "reference" else sequence.device_orientation
    assert orientation is not None  # `_check` ensures it
    present = finite_rows(orientation)
    if source == "reference":
        present = present & sequence.valid
    if not present[0]:
        problem = f"has no {source} orientation at its start"
        raise InputError(sequence.name, problem, "give --orientation filter")
    # Untrusted rows may have any values, even ones that are no rotation.
    rotation = matrix_from_quaternion(np.where(present[:, None], orientation, np.nan))
    if source == "device":
        ours, its = yaw_rotation(np.stack([start.rotation, rotation[0]]))
        rotation = ours @ its.T @ rotation
    last = last_true(present)
    turn = np.einsum("tji,tjk->tik", integrated[last], integrated)
    return np.where(present[:, None, None], rotation, rotation[last] @ turn)
