"""Sequences made ready for an estimator: resampled, cut to whole strides, with a start."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gnio_jax import data
from gnio_jax.config import DataConfig, FilterSettings
from gnio_jax.config.schema import TLIO_STD
from gnio_jax.errors import InputError
from gnio_jax.evaluation.setup import DEFAULT_SETUP, Setup, resolve
from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.filtering import InitialStd, level_state
from gnio_jax.filtering.settings import filter_setup
from gnio_jax.filtering.start import rest_at_start
from gnio_jax.numerics import finite_rows, matrix_from_quaternion, rotations
from gnio_jax.types import Sequence

REFERENCE_BIAS_SECONDS = 10.0
"""How long `gyro_bias="reference"` looks at the reference, s."""
ROUGH_START = 0.4
"""Standard deviation of the first velocity above which a static start is only rough, m/s (ours):
nobody stands still there."""


class Start(NamedTuple):
    """Pose and velocity at the first sample."""

    rotation: Float[np.ndarray, "3 3"]
    """Body→world."""
    velocity: Float[np.ndarray, "3"]
    """m/s."""
    position: Float[np.ndarray, "3"]
    """m."""
    tilt_std: float | None = None
    """Standard deviation of roll and pitch, rad; None: the filter's options say."""
    velocity_std: float | None = None
    """Standard deviation of the velocity, m/s; None: the filter's options say."""


class GyroBias(NamedTuple):
    """First estimate of the gyro bias."""

    value: Float[np.ndarray, "3"]
    """rad/s."""
    note: str = ""
    """Where it is from, for the reader of the result."""


class Prepared(NamedTuple):
    """A sequence ready for an estimator: at the network's rate, cut to whole strides from its
    start."""

    sequence: Sequence
    """K·n + 1 samples: K strides of n samples and the stamp at the end of the last."""
    start: Start
    gyro_bias: Float[np.ndarray, "3"]
    """First estimate, rad/s."""
    notes: tuple[str, ...]
    """What a reader of the result should know."""

    def strides(self, samples: int) -> int:
        """K, for strides of `samples`."""
        return (len(self.sequence.time) - 1) // samples

    @property
    def imu_valid(self) -> Bool[np.ndarray, "m"] | None:
        """Which of the samples that drive the filter are there; None: all."""
        mask = self.sequence.imu_valid
        return None if mask is None or mask.all() else mask[:-1]

    def reference(self, samples: int) -> Trajectory:
        """The reference at the ends of the strides, NaN where it cannot be trusted."""
        sequence = self.sequence
        trusted = sequence.valid[::samples, None]
        poses = (
            np.where(trusted, part[::samples], np.nan)
            for part in (sequence.position, sequence.orientation)
        )
        return Trajectory(sequence.time[::samples], *poses)


def prepare(
    sequences: Iterable[Sequence],
    config: DataConfig,
    setup: Setup = DEFAULT_SETUP,
    std: InitialStd = TLIO_STD,
) -> tuple[list[Prepared], dict[str, str]]:
    """Sequences to estimate, and the names of those left out with the reason (shorter than a window
    and a stride). `std`, of the filter, says how far a static start may be off level.

    Raises `InputError` if `setup` needs a reference, a device orientation or more data where a
    sequence has none.
    """
    setup = resolve(setup)
    prepared, left_out = [], {}
    for sequence in sequences:
        if sequence.waypoints is not None:
            raise InputError(
                sequence.name, "has waypoints, no poses", "nothing can be compared with a track yet"
            )
        sequence = data.resample(sequence, config.rate)
        good = finite_rows(sequence.position) & finite_rows(sequence.orientation)
        sequence = sequence._replace(valid=sequence.valid & good)
        _check_reference(sequence, setup)
        first = int(np.argmax(sequence.valid)) if sequence.valid.any() else 0
        strides = (len(sequence.time) - 1 - first) // config.stride
        if strides <= config.seen // config.stride:
            seconds = max(0, len(sequence.time) - first) / config.rate
            left_out[sequence.name] = (
                f"{seconds:.2f} s from its first trusted sample on, "
                "too short for a window and a stride"
            )
            continue
        whole = _samples(sequence, slice(first, first + strides * config.stride + 1))
        if (measured := len(measured_rows(whole))) < config.seen:
            seconds = measured / config.rate
            left_out[sequence.name] = f"{seconds:.2f} s of it measured, too short for a window"
            continue
        bias = _gyro_bias(whole, config.rate, setup)
        start, note = _start(whole, config, setup, std)
        notes = tuple(filter(None, (bias.note, note)))
        prepared.append(Prepared(whole, start, bias.value, notes))
    return prepared, left_out


def measured_rows(sequence: Sequence) -> Int[np.ndarray, "m"]:
    """Samples of the IMU that are no line across a gap."""
    mask = sequence.imu_valid
    return np.arange(len(sequence.time)) if mask is None else np.flatnonzero(mask)


def _check_reference(sequence: Sequence, setup: Setup) -> None:
    """Raise `InputError` where the sequence lacks what `setup` starts from or rotates with."""
    trusted = sequence.valid.any()
    if not trusted and (setup.init == "reference" or setup.gyro_bias == "reference"):
        wanted = "--init static" if setup.init == "reference" else "--gyro-bias zero"
        raise InputError(sequence.name, "has no reference to start from", f"give {wanted}")
    if not trusted and setup.orientation == "reference":
        remedy = "give --orientation filter or device"
        raise InputError(sequence.name, "has no reference orientation", remedy)
    if setup.orientation == "device" and sequence.device_orientation is None:
        remedy = "give --orientation filter or reference"
        raise InputError(sequence.name, "has no device orientation", remedy)


def _samples(sequence: Sequence, rows: slice) -> Sequence:
    """Some samples of a sequence."""
    arrays = {
        name: value[rows]
        for name, value in sequence._asdict().items()
        if isinstance(value, np.ndarray)
    }
    return sequence._replace(**arrays)


def _start(
    sequence: Sequence, config: DataConfig, setup: Setup, std: InitialStd
) -> tuple[Start, str]:
    """The start that `setup.init` asks for, with what a reader should know of it."""
    if setup.init == "static":
        return _static_start(sequence, config, std)
    rotation = matrix_from_quaternion(sequence.orientation[0])
    velocity = sequence.velocity[0]
    velocity = velocity if np.isfinite(velocity).all() else np.zeros(3)
    return Start(rotation, velocity, sequence.position[0]), ""


def _static_start(sequence: Sequence, config: DataConfig, std: InitialStd) -> tuple[Start, str]:
    """Level from the gravity of the first second; yaw, velocity and position zero."""
    second = _first_second(sequence, round(config.rate))
    filter_config = filter_setup(config, FilterSettings()).config
    level = level_state(filter_config, sequence.gyro[second], sequence.accel[second], std)
    found = np.sqrt(np.diag(level.core_covariance))
    tilt_std, velocity_std = float(found[0]), float(found[3])
    start = Start(np.asarray(level.rotation), np.zeros(3), np.zeros(3), tilt_std, velocity_std)
    if velocity_std <= ROUGH_START:
        return start, ""
    known = f"velocity to {velocity_std:.1f} m/s, tilt to {np.degrees(tilt_std):.0f}°"
    return start, f"start: not standing still, known to one sigma: {known}"


def _first_second(sequence: Sequence, samples: int) -> Int[np.ndarray, "m"]:
    """What was measured of the first second, or where that is not half of it, the first so many
    samples that were."""
    measured = measured_rows(sequence)
    first = measured[measured < samples]
    return first if 2 * len(first) >= samples else measured[:samples]


def _gyro_bias(sequence: Sequence, rate: float, setup: Setup) -> GyroBias:
    """The first estimate of the gyro bias that `setup.gyro_bias` asks for."""
    match setup.gyro_bias:
        case "rest":
            return _gyro_bias_at_rest(sequence, rate)
        case "reference":
            return _gyro_bias_from_reference(sequence, rate)
        case _:
            return GyroBias(np.zeros(3))


def _gyro_bias_at_rest(sequence: Sequence, rate: float) -> GyroBias:
    """Mean of the gyro over the whole seconds of rest at the start."""
    # A line across a gap is as quiet as a table: what was not measured is no rest.
    gyro, accel = np.full((2, len(sequence.time), 3), np.nan)
    rows = measured_rows(sequence)
    gyro[rows], accel[rows] = sequence.gyro[rows], sequence.accel[rows]
    rest = rest_at_start(gyro, accel, 1.0 / rate)
    if not rest.seconds:
        return GyroBias(np.zeros(3), "gyro bias: no rest at the start, so it starts from zero")
    note = f"gyro bias: mean of {rest.seconds:g} s of rest at the start"
    return GyroBias(rest.gyro_bias, note)


def _gyro_bias_from_reference(sequence: Sequence, rate: float) -> GyroBias:
    """Mean difference of the gyro from the rates of the reference's attitude at the start."""
    rows = np.arange(min(round(REFERENCE_BIAS_SECONDS * rate), len(sequence.time) - 1))
    rows = rows[sequence.valid[rows] & sequence.valid[rows + 1]]
    rows = np.intersect1d(rows, measured_rows(sequence))
    if len(rows) < rate:
        note = "gyro bias: under 1 s of reference at the start, so it starts from zero"
        return GyroBias(np.zeros(3), note)
    before, after = (rotations(sequence.orientation[each]) for each in (rows, rows + 1))
    true_rate = (before.inv() * after).as_rotvec() * rate
    note = f"gyro bias: {len(rows) / rate:g} s against the reference orientation"
    return GyroBias((sequence.gyro[rows] - true_rate).mean(0), note)
