"""What every loader shares: validation, one uniform clock, physical self-check, HDF5.

Quaternions are wxyz here and everywhere in the package; SciPy's xyzw never leaves `rotations` and
`quaternions`.
"""

from __future__ import annotations

import itertools
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.signal import fftconvolve
from scipy.spatial.transform import Rotation

from gnio_jax.decimation import decimation_factor, low_pass
from gnio_jax.files import replacing
from gnio_jax.types import GRAVITY, InputError, Sequence

FASTEST_TURN, STRONGEST_FORCE = 100.0, 1000.0
"""rad/s and m/s²: beyond the range of any gyro or accelerometer one navigates with."""
FASTEST, LARGEST_STEP, FARTHEST = 300.0, 10.0, 1e8
"""m/s that nothing exceeds that carries such an IMU; m by which positions held for a while, or
corrected, may jump all the same; m from the world's origin, of which a float still has digits
enough."""

LONGEST_BRIDGE = 0.1
"""s between samples within which `resample` trusts what it interpolates."""

WINDOW_SECONDS = 1.0
"""A hole in the IMU longer than the network's window is no jitter: loaders divide the recording
there (`recordings.divide`), or refuse it."""


class Recording(NamedTuple):
    """One recording that was found, but not yet read."""

    name: str
    """Unique within a dataset; that of its sequence, if it yields one."""
    read: Callable[[], list[Sequence]]
    """Its sequences, validated, not yet self-checked: one, or the pieces between its gaps. Can be
    sent to another process. Raises `InputError`."""


@dataclass(frozen=True)
class Dataset:
    """What the registry knows of one dataset; every loader module ends with `DATASET =
    Dataset(...)`."""

    name: str
    """The name of `--dataset`."""
    read: Callable[[Path, str], list[Sequence]]
    """(root, split) -> sequences at the native rate, validated, that pass the self-check. Raises
    `InputError`."""
    recordings: Callable[[Path, str], list[Recording]]
    """(root, split) -> what `read` would read. Raises `InputError`."""
    splits: tuple[str, ...]
    """Splits that `read` knows."""
    rate: float
    """Native IMU rate, Hz."""
    source: str
    """Where the public set is had."""
    layout: str
    """The expected layout below the root, in one line."""
    licence: str
    """Terms of the data, as their authors state them."""
    needs_root: bool = True
    """False for a dataset that is made, not read."""
    pedestrian: bool = True
    """False for drones and vehicles: no speed is implausible then."""
    min_correlation: float | None = 0.3
    """What the self-check asks of the horizontal accelerations; None where positions are those of
    another body, or smoothed."""
    needs_reference: bool = True
    """False where recordings without any reference are of use."""
    list_splits: Callable[[Path], tuple[str, ...]] | None = None
    """Where the root's own lists name the splits: root -> splits, of which there may be others than
    `splits`."""

    def splits_at(self, root: Path) -> tuple[str, ...]:
        """The splits that may be asked for at this root."""
        return self.list_splits(root) if self.list_splits else self.splits


class SelfCheck(NamedTuple):
    """Figures by which IMU and reference of one sequence vouch for each other; NaN where they
    cannot be computed."""

    duration: float
    """s."""
    rate: float
    """Hz, from the median interval."""
    gravity_mean: Float[np.ndarray, "3"]
    """Mean of R·accel in the world less the mean acceleration of the reference, (v_end −
    v_start)/T, m/s²: (0, 0, 9.81)."""
    gyro_consistency_degrees: float
    """Median angle between gyro-integrated and reference rotation over 10 s windows, one constant
    bias removed. NaN for what is shorter than two windows: the bias would take up whatever is
    wrong."""
    median_speed: float
    """m/s."""
    accel_correlation_horizontal: float
    """Correlation of the second difference of the position with R·accel + g, x and y together."""
    share_valid: float
    """Share of the samples whose reference can be trusted."""
    failures: tuple[str, ...]
    """What is implausible, one sentence each; empty when the sequence may be used."""


def rotations(wxyz: Float[np.ndarray, "... 4"]) -> Rotation:
    """SciPy rotations of quaternions wxyz."""
    return Rotation.from_quat(np.asarray(wxyz)[..., [1, 2, 3, 0]])


def quaternions(rotation: Rotation) -> Float[np.ndarray, "... 4"]:
    """Unit quaternions wxyz of SciPy rotations."""
    return rotation.as_quat()[..., [3, 0, 1, 2]]


def cumulative_rotation(turns: Rotation) -> Rotation:
    """R_0, R_0 R_1, R_0 R_1 R_2, … of a stack of rotations, in log2(n) vectorized passes."""
    reach = 1
    while reach < len(turns):
        turns = Rotation.concatenate([turns[:reach], turns[:-reach] * turns[reach:]])
        reach *= 2
    return turns


# --- validation
# ------------------------------------------------------------------------------------------------------


def validate(sequence: Sequence, source: object) -> Sequence:
    """Return `sequence` if every consumer can rely on it; raises `InputError` naming `source`, the
    field and the remedy.

    Quaternions whose norm is off by no more than 1e-3 (rounding in text files) come back
    normalized.
    """
    time = sequence.time
    n = time.shape[0] if time.ndim == 1 else -1
    if n < 2:
        raise InputError(
            source, f"field 'time' must hold at least two stamps, found shape {time.shape}"
        )
    widths = {"gyro": 3, "accel": 3, "orientation": 4, "position": 3, "velocity": 3}
    if sequence.device_orientation is not None:
        widths["device_orientation"] = 4
    for field, width in widths.items():
        shape = getattr(sequence, field).shape
        if shape != (n, width):
            raise InputError(
                source,
                f"field '{field}' has shape {shape}, expected {(n, width)} as field 'time' has {n} stamps",
            )
    if sequence.valid.shape != (n,) or sequence.valid.dtype != np.bool_:
        raise InputError(
            source,
            f"field 'valid' must be {n} booleans, found {sequence.valid.dtype} of shape {sequence.valid.shape}",
        )

    for field in ("time", "gyro", "accel"):
        check_finite(getattr(sequence, field), field, source)
    check_increasing(time, source)
    check_units(sequence.gyro, sequence.accel, source)
    for field in ("orientation", "position", "velocity"):
        bad = sequence.valid & ~np.isfinite(getattr(sequence, field)).all(axis=1)
        if bad.any():
            raise InputError(
                source,
                f"field '{field}' is NaN or Inf in {bad.sum()} rows marked valid, first in row {np.argmax(bad)}",
                "mark these rows invalid",
            )
    orientation = check_unit_norm(sequence.orientation, sequence.valid, "orientation", source)
    device = sequence.device_orientation
    if device is not None:
        device = check_unit_norm(
            device, np.asarray(np.isfinite(device).all(axis=1)), "device_orientation", source
        )
    return sequence._replace(orientation=orientation, device_orientation=device)


def check_finite(values: Float[np.ndarray, "n ..."], field: str, source: object) -> None:
    """Raise `InputError` where a column that must be complete holds NaN or Inf."""
    bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
    if bad.any():
        raise InputError(
            source,
            f"field '{field}' is NaN or Inf in {bad.sum()} rows, first in row {np.argmax(bad)}",
            "repair or cut the recording there",
        )


def check_increasing(time: Float[np.ndarray, "n"], source: object) -> None:
    """Raise `InputError` where the stamps (s) do not increase."""
    backward = np.flatnonzero(np.diff(time) <= 0)
    if backward.size:
        row = int(backward[0]) + 1
        raise InputError(
            source,
            f"field 'time' does not increase in {backward.size} rows, first in row {row} "
            f"({time[row - 1]:.6f} s, then {time[row]:.6f} s)",
            "sort the rows and drop repeated ones",
        )


def check_units(
    gyro: Float[np.ndarray, "n 3"], accel: Float[np.ndarray, "n 3"], source: object
) -> None:
    """Raise `InputError` when the magnitudes say that the IMU is not in rad/s and m/s²."""
    pull = float(np.median(np.linalg.norm(accel, axis=1)))
    if 0.5 < pull < 2.0:
        raise InputError(
            source,
            f"field 'accel' looks like G (median magnitude {pull:.3g})",
            "convert it to m/s² (× 9.80665)",
        )
    if pull < 5.0:  # a walker's linear acceleration is 1–4 m/s²
        raise InputError(
            source,
            f"field 'accel' has no gravity in it (median magnitude {pull:.3g} m/s²)",
            "give the specific force, gravity included",
        )
    if pull > 50.0:
        raise InputError(
            source,
            f"field 'accel' is not in m/s² (median magnitude {pull:.3g})",
            "convert it to m/s²",
        )
    turn = float(np.median(np.linalg.norm(gyro, axis=1)))
    if turn > 20.0:
        raise InputError(
            source,
            f"field 'gyro' looks like deg/s (median magnitude {turn:.3g})",
            "convert it to rad/s (× π/180)",
        )
    for field, values, most, unit in (
        ("gyro", gyro, FASTEST_TURN, "rad/s"),
        ("accel", accel, STRONGEST_FORCE, "m/s²"),
    ):
        beyond = (np.abs(values) > most).any(axis=1)
        if beyond.any():
            raise InputError(
                source,
                f"field '{field}' is beyond {most:g} {unit} in {beyond.sum()} rows, first in row {np.argmax(beyond)}",
                "no such sensor measures that: repair or cut the recording there",
            )


def check_motion(sequence: Sequence, source: object) -> None:
    """Raise `InputError` where the reference, as far as it is valid, moves as nothing does: for
    datasets whose truth is taken as it is."""
    speed = np.abs(sequence.velocity).max(axis=1)
    fast = sequence.valid & (speed > FASTEST)
    if fast.any():
        raise InputError(
            source,
            f"field 'velocity' is beyond {FASTEST:g} m/s in {fast.sum()} rows, first in row {np.argmax(fast)}",
            "repair these rows or mark them invalid",
        )
    far = sequence.valid & (np.abs(sequence.position).max(axis=1) > FARTHEST)
    if far.any():
        raise InputError(
            source,
            f"field 'position' is beyond {FARTHEST:g} m in {far.sum()} rows, first in row {np.argmax(far)}",
            "give metres in a local world, or mark these rows invalid",
        )
    step = np.abs(np.diff(sequence.position, axis=0)).max(axis=1)
    jump = (
        sequence.valid[1:]
        & sequence.valid[:-1]
        & (step > np.maximum(FASTEST * np.diff(sequence.time), LARGEST_STEP))
    )
    if jump.any():
        row = int(np.argmax(jump)) + 1
        raise InputError(
            source,
            f"field 'position' jumps in {jump.sum()} rows, first in row {row} (by {step[row - 1]:.3g} m)",
            "repair these rows or mark them invalid",
        )


def check_unit_norm(
    wxyz: Float[np.ndarray, "n 4"], where: Bool[np.ndarray, "n"], field: str, source: object
) -> Float[np.ndarray, "n 4"]:
    """Normalized quaternions where `where` holds; raises `InputError` if one is off by more than
    1e-3."""
    norm = np.linalg.norm(wxyz, axis=1)
    off = np.where(where, np.abs(norm - 1.0), 0.0)
    if (off > 1e-3).any():
        row = int(np.argmax(off > 1e-3))
        raise InputError(
            source,
            f"field '{field}' is not a unit quaternion in {(off > 1e-3).sum()} rows, first in row {row} "
            f"(norm {norm[row]:.4g})",
            "check the column order and normalize, or mark the rows invalid",
        )
    # What is exact to rounding stays bit for bit, so that writing and reading again changes
    # nothing.
    rounded = off > 1e-12
    return (
        np.where(rounded[:, None], wxyz / np.where(norm > 0, norm, 1.0)[:, None], wxyz)
        if rounded.any()
        else wxyz
    )


def check_rate(
    time: Float[np.ndarray, "n"], nominal: float, source: object, tolerance: float = 0.05
) -> float:
    """Rate (Hz) of the stamps by their median interval; raises `InputError` when it is off
    `nominal` by more than `tolerance`."""
    rate = float(1.0 / np.median(np.diff(time)))
    if not abs(rate / nominal - 1.0) <= tolerance:
        raise InputError(
            source,
            f"field 'time' runs at {rate:.4g} Hz, expected about {nominal:g} Hz",
            "check the unit of the stamps, or resample the recording",
        )
    return rate


def check_gaps(
    time: Float[np.ndarray, "n"], source: object, longest: float = WINDOW_SECONDS
) -> None:
    """Raise `InputError` when two stamps lie further apart than `longest` (s), by default the
    network's window."""
    gaps = np.diff(time)
    if gaps.size and gaps.max() > longest:
        row = int(np.argmax(gaps))
        raise InputError(
            source,
            f"field 'time' has a gap of {gaps[row]:.3f} s after row {row}, longer than {longest:g} s",
            "cut the recording there",
        )


def stretches(time: Float[np.ndarray, "n"], longest: float = WINDOW_SECONDS) -> list[slice]:
    """The rows between gaps of the increasing stamps that are longer than `longest` (s)."""
    edges = [0, *(np.flatnonzero(np.diff(time) > longest) + 1).tolist(), len(time)]
    return [slice(first, last) for first, last in itertools.pairwise(edges)]


# --- one uniform clock
# -----------------------------------------------------------------------------------------------


def is_uniform(time: Float[np.ndarray, "n"], rate: float) -> bool:
    """True if every interval is 1/rate to 0.1 % and the whole to 0.01 % (stamps rounded to a
    microsecond are)."""
    intervals = np.diff(time) * rate
    return bool(np.abs(intervals - 1.0).max() < 1e-3 and abs(intervals.mean() - 1.0) < 1e-4)


def resample(sequence: Sequence, rate: float, max_gap: float = LONGEST_BRIDGE) -> Sequence:
    """`sequence` on a uniform clock of `rate` Hz that starts at its first stamp; unchanged if it is
    on one already.

    IMU, position and velocity follow cubic splines, attitudes slerp along the shorter arc. Going to
    a lower rate the IMU is band-limited first (zero-phase FIR, pass band to 0.8 of the new Nyquist
    frequency), or vibrations would alias into the gait band; poses stay those of the stamp. `valid`
    is False between samples of which one is invalid, and in gaps longer than `max_gap` (s), where
    the IMU is interpolated linearly. A reference value next to a NaN is NaN.
    """
    time = sequence.time
    if is_uniform(time, rate):
        return sequence
    native = 1.0 / float(np.median(np.diff(time)))
    count = int(np.floor((time[-1] - time[0]) * rate + 1e-6)) + 1
    clock = time[0] + np.arange(count) / rate
    clock[-1] = min(clock[-1], time[-1])
    everywhere = np.ones(len(time), dtype=bool)

    imu = np.concatenate([sequence.gyro, sequence.accel], axis=1)
    factor = decimation_factor(native, rate)
    if factor > 1:
        fine = np.minimum(time[0] + np.arange((count - 1) * factor + 1) / (rate * factor), time[-1])
        imu = _low_pass(_interpolate(time, imu, everywhere, fine, max_gap), factor)[::factor]
    else:
        imu = _interpolate(time, imu, everywhere, clock, max_gap)

    device = sequence.device_orientation
    return sequence._replace(
        time=clock,
        gyro=imu[:, :3],
        accel=imu[:, 3:],
        orientation=_slerp(time, sequence.orientation, clock),
        position=_interpolate(time, sequence.position, sequence.valid, clock, max_gap),
        velocity=_interpolate(time, sequence.velocity, sequence.valid, clock, max_gap),
        valid=_valid_at(time, sequence.valid, clock, max_gap),
        device_orientation=None if device is None else _slerp(time, device, clock),
    )


def _neighbours(time: np.ndarray, clock: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the samples around each stamp of `clock`; equal where a stamp is a sample's own to
    1 µs."""
    right = np.clip(np.searchsorted(time, clock), 1, len(time) - 1)
    left = right - 1
    left = np.where(np.abs(time[right] - clock) <= 1e-6, right, left)
    right = np.where(np.abs(time[left] - clock) <= 1e-6, left, right)
    return left, right


def _valid_at(time: np.ndarray, valid: np.ndarray, clock: np.ndarray, max_gap: float) -> np.ndarray:
    left, right = _neighbours(time, clock)
    return valid[left] & valid[right] & (time[right] - time[left] <= max_gap)


def _interpolate(
    time: np.ndarray, values: np.ndarray, good: np.ndarray, clock: np.ndarray, max_gap: float
) -> np.ndarray:
    """Cubic splines within runs of good samples, linear between them: a spline would carry an
    outlier or a gap into its surroundings."""
    left, right = _neighbours(time, clock)
    span = time[right] - time[left]
    share = np.divide(clock - time[left], span, out=np.zeros_like(clock), where=span > 0)[:, None]
    result = np.where(share > 0, (1.0 - share) * values[left] + share * values[right], values[left])
    rows = np.flatnonzero(good)
    if rows.size == 0:
        return result
    breaks = np.flatnonzero((np.diff(rows) > 1) | (np.diff(time[rows]) > max_gap)) + 1
    for run in np.split(rows, breaks):
        if run.size >= 4:
            inside = slice(
                np.searchsorted(clock, time[run[0]], side="left"),
                np.searchsorted(clock, time[run[-1]], side="right"),
            )
            result[inside] = CubicSpline(time[run], values[run], axis=0)(clock[inside])
    return result


def _slerp(time: np.ndarray, wxyz: np.ndarray, clock: np.ndarray) -> np.ndarray:
    left, right = _neighbours(time, clock)
    result = np.full((len(clock), 4), np.nan)
    known = np.isfinite(wxyz[left]).all(axis=1) & np.isfinite(wxyz[right]).all(axis=1)
    if not known.any():
        return result
    left, right, clock = left[known], right[known], clock[known]
    start = rotations(wxyz[left])
    span = time[right] - time[left]
    share = np.divide(clock - time[left], span, out=np.zeros_like(clock), where=span > 0)
    # The relative rotation vector is the shorter arc whatever the signs of the quaternions.
    result[known] = quaternions(
        start
        * Rotation.from_rotvec((start.inv() * rotations(wxyz[right])).as_rotvec() * share[:, None])
    )
    return result


def _low_pass(values: np.ndarray, factor: int) -> np.ndarray:
    """The FIR `low_pass` with zero phase, ends filled by odd reflection."""
    taps = low_pass(factor)
    half = len(taps) // 2
    padded = np.pad(values, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
    return fftconvolve(padded, taps[:, None], mode="valid", axes=0)


# --- physical self-check
# ---------------------------------------------------------------------------------------------


def self_check(
    sequence: Sequence,
    pedestrian: bool = True,
    window_seconds: float = 10.0,
    max_gravity_error: float = 0.5,
    max_gyro_degrees: float = 5.0,
    max_speed: float = 3.0,
    min_correlation: float | None = 0.3,
) -> SelfCheck:
    """Do IMU and reference describe the same motion? `sequence` must be on a uniform clock.

    Fails: mean of R·accel off (0, 0, 9.81) and the reference's own mean acceleration by
    `max_gravity_error` m/s²; gyro off the reference orientation by more than `max_gyro_degrees` in
    the median window; a pedestrian whose median speed exceeds `max_speed` m/s; a horizontal
    acceleration above 0.2 m/s² rms that correlates with that of the positions by less than
    `min_correlation` (None asks for nothing). Standing still is no failure: it is what the gate is
    for. Neither is being too short for the gyro's windows.
    """
    time, valid = sequence.time, sequence.valid
    step = float(np.median(np.diff(time)))
    nothing = np.full(3, np.nan)
    figures: dict[str, Any] = dict(
        duration=float(time[-1] - time[0]), rate=1.0 / step, share_valid=float(valid.mean())
    )
    if not valid.any():
        return SelfCheck(
            gravity_mean=nothing,
            gyro_consistency_degrees=np.nan,
            median_speed=np.nan,
            accel_correlation_horizontal=np.nan,
            failures=("no sample has a valid reference",),
            **figures,
        )

    force = rotations(_held_attitude(sequence)).apply(sequence.accel)
    gravity_mean = force[valid].mean(axis=0) - _mean_acceleration(sequence, step)
    speed = float(np.median(np.linalg.norm(sequence.velocity[valid], axis=1)))
    starts, gyro_errors = gyro_windows(sequence, window_seconds)
    # Windows that overlap throughout are one window, and one bias explains one window whatever it
    # holds.
    apart = starts.size > 0 and float(np.ptp(starts)) > window_seconds - 0.5 * step
    gyro_degrees = float(np.median(gyro_errors)) if apart else float("nan")
    correlation, strength = _accel_correlation(sequence, force, step)

    failures = []
    off = float(np.linalg.norm(gravity_mean - [0.0, 0.0, GRAVITY]))
    if not off <= max_gravity_error:
        failures.append(
            f"mean of R·accel is ({', '.join(f'{value:.2f}' for value in gravity_mean)}) m/s², off (0, 0, 9.81) by {off:.2f}"
        )
    if not starts.size and time[-1] - time[0] >= 2.0 * window_seconds:
        failures.append(f"no window of {window_seconds:g} s has a valid reference at its ends")
    elif gyro_degrees > max_gyro_degrees:
        failures.append(
            f"gyro is off the reference orientation by {gyro_degrees:.1f}° in the median window of {window_seconds:g} s"
        )
    if pedestrian and speed > max_speed:
        failures.append(f"median speed is {speed:.1f} m/s, too fast for a pedestrian")
    if (
        min_correlation is not None and strength > 0.2 and not correlation >= min_correlation
    ):  # NaN when the positions do not move at all
        failures.append(
            f"horizontal acceleration of the positions correlates by only {correlation:.2f} with R·accel"
        )
    return SelfCheck(
        gravity_mean=gravity_mean,
        gyro_consistency_degrees=gyro_degrees,
        median_speed=speed,
        accel_correlation_horizontal=correlation,
        failures=tuple(failures),
        **figures,
    )


def _held_attitude(sequence: Sequence) -> np.ndarray:
    """Invalid rows take the last valid attitude: they are left out of every mean and only bridge
    the gyro's windows."""
    valid = sequence.valid
    return sequence.orientation[
        np.maximum.accumulate(np.where(valid, np.arange(len(valid)), int(np.argmax(valid))))
    ]


def _mean_acceleration(sequence: Sequence, step: float) -> Float[np.ndarray, "3"]:
    """Of the reference over the stretches that are valid, by its velocities at their ends."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], sequence.valid, [False]])))
    first, last = edges[::2], edges[1::2] - 1
    seconds = float((last - first).sum()) * step
    gained = (sequence.velocity[last] - sequence.velocity[first]).sum(axis=0)
    return gained / seconds if seconds > 0 else np.zeros(3)


def gyro_windows(
    sequence: Sequence, window_seconds: float = 10.0
) -> tuple[Float[np.ndarray, "w"], Float[np.ndarray, "w"]]:
    """(start s, degrees) of windows that start every half window: the angle between the rotation
    integrated from the gyro and the reference's, after the one constant bias that explains most of
    them. A recording shorter than a window is one."""
    time, valid = sequence.time, sequence.valid
    step = float(np.median(np.diff(time)))
    n = len(time)
    length = max(min(round(window_seconds / step), n - 1), 1)
    starts = np.arange(0, n - length, max(length // 2, 1))
    starts = starts[valid[starts] & valid[starts + length]]
    if not starts.size:
        return np.zeros(0), np.zeros(0)
    attitude = _held_attitude(sequence)
    rotation = rotations(attitude).as_matrix()
    reference = rotations(attitude[starts]).inv() * rotations(attitude[starts + length])
    # exp(J b) R ≈ rotation integrated from gyro + b, J = R_startᵀ Σ R_k dt
    summed = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(rotation * step, axis=0)])
    jacobian = np.einsum("wji,wjk->wik", rotation[starts], summed[starts + length] - summed[starts])
    samples = starts[:, None] + np.arange(length)
    # A rate sampled at the stamps is worth most at the middle of the interval it drives.
    middle = 0.5 * (sequence.gyro[:-1] + sequence.gyro[1:])
    bias = np.zeros(3)
    error = np.zeros((len(starts), 3))
    for _ in range(2):
        error = (_product((middle - bias) * step, samples) * reference.inv()).as_rotvec()
        correction = np.zeros(3)
        for _ in range(10):  # least absolute deviations: one broken window must not bend the bias
            weight = 1.0 / np.maximum(np.linalg.norm(error - jacobian @ correction, axis=1), 1e-3)
            normal = np.einsum("w,wji,wjk->ik", weight, jacobian, jacobian)
            correction = np.linalg.lstsq(
                normal, np.einsum("w,wji,wj->i", weight, jacobian, error), rcond=1e-9
            )[0]
        bias = bias + correction
    error = (_product((middle - bias) * step, samples) * reference.inv()).as_rotvec()
    return time[starts], np.degrees(np.linalg.norm(error, axis=1))


def _product(angles: np.ndarray, samples: np.ndarray) -> Rotation:
    """Product over each row of `samples` of the rotations by the vectors `angles`, halving the rows
    until one is left."""
    parts = (
        Rotation.from_rotvec(angles).as_quat().T[:, samples]
    )  # (4, rows, length): long inner loops
    while parts.shape[2] > 1:
        if parts.shape[2] % 2:
            one = np.zeros((4, len(samples), 1))
            one[3] = 1.0
            parts = np.concatenate([parts, one], axis=2)
        (a, b, c, d), (e, f, g, h) = (
            parts[:, :, 0::2],
            parts[:, :, 1::2],
        )  # x, y, z, w of both factors
        parts = np.stack(
            [
                d * e + a * h + b * g - c * f,
                d * f - a * g + b * h + c * e,
                d * g + a * f - b * e + c * h,
                d * h - a * e - b * f - c * g,
            ]
        )
    return Rotation.from_quat(parts[:, :, 0].T)


def _accel_correlation(sequence: Sequence, force: np.ndarray, step: float) -> tuple[float, float]:
    """(correlation, rms m/s² of the inertial side) of horizontal accelerations over triangles of ±
    0.1 s.

    The second difference of the position over ± h is the acceleration weighted by the triangle of
    that width, exactly.
    """
    h = max(round(0.1 / step), 1)
    n = len(sequence.time)
    if n < 4 * h:
        return float("nan"), 0.0
    position = sequence.position[:, :2]
    geometric = (position[2 * h :] - 2.0 * position[h:-h] + position[: -2 * h]) / (h * step) ** 2
    triangle = 1.0 - np.abs(np.arange(-h, h + 1)) / h
    inertial = fftconvolve(force[:, :2], (triangle / triangle.sum())[:, None], mode="valid", axes=0)
    broken = np.concatenate([[0], np.cumsum(~sequence.valid)])
    whole = broken[2 * h + 1 :] == broken[: -2 * h - 1]
    if whole.sum() < 2 * h:
        return float("nan"), 0.0
    geometric, inertial = geometric[whole], inertial[whole]
    geometric, inertial = geometric - geometric.mean(axis=0), inertial - inertial.mean(axis=0)
    strength = float(np.sqrt((inertial**2).sum(axis=1).mean()))
    scale = float(np.sqrt((geometric**2).sum() * (inertial**2).sum()))
    return (float((geometric * inertial).sum()) / scale if scale > 0 else float("nan")), strength


def judge(
    sequence: Sequence,
    pedestrian: bool = True,
    min_correlation: float | None = 0.3,
    needs_reference: bool = True,
) -> SelfCheck:
    """`self_check` by what its dataset asks (see `Dataset`). What a converted recording brings
    along as `check_pedestrian` and `check_min_correlation` wins: its own dataset asked it."""
    pedestrian = bool(sequence.attributes.get("check_pedestrian", pedestrian))
    asked = sequence.attributes.get("check_min_correlation", min_correlation)
    check = self_check(
        sequence,
        pedestrian,
        min_correlation=None if asked is None or asked <= -1.0 else float(asked),
    )
    return check if needs_reference or sequence.valid.any() else check._replace(failures=())


def keep_plausible(
    sequences: list[Sequence],
    pedestrian: bool = True,
    min_correlation: float | None = 0.3,
    needs_reference: bool = True,
) -> list[Sequence]:
    """The sequences that pass `self_check`; the others are named, with the reason, in one warning
    each. The options are those of `Dataset`.

    Raises `InputError` when none is left.
    """
    kept, refused = [], []
    for sequence in sequences:
        failures = judge(sequence, pedestrian, min_correlation, needs_reference).failures
        if failures:
            warnings.warn(
                f"{sequence.name}: left out by the self-check: {'; '.join(failures)}", stacklevel=2
            )
            refused.append(sequence.name)
        else:
            kept.append(sequence)
    if not kept:
        raise InputError(
            ", ".join(refused[:3]) or "no sequence",
            f"none of {len(refused)} sequences passes the physical self-check",
            "see the warnings above; check units, frames and time offset of the recordings",
        )
    return kept


# --- HDF5
# ------------------------------------------------------------------------------------------------------------

_FORMAT = "gnio-jax sequence 1"
_FIELDS = ("time", "gyro", "accel", "orientation", "position", "velocity", "valid")


def write_hdf5(path: str | os.PathLike[str], sequence: Sequence) -> None:
    """Write `sequence` as HDF5, whole or not at all: one dataset per field (contiguous, so that it
    can be memory-mapped), `name` and `format` as attributes of the file, its attributes on the
    group `attributes`."""
    with replacing(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["format"] = _FORMAT
        file.attrs["name"] = sequence.name
        for field in _FIELDS:
            file.create_dataset(field, data=getattr(sequence, field))
        if sequence.device_orientation is not None:
            file.create_dataset("device_orientation", data=sequence.device_orientation)
        group = file.create_group("attributes")
        for key, value in sequence.attributes.items():
            if not isinstance(
                value, str | bool | int | float | np.bool_ | np.integer | np.floating
            ):
                raise InputError(
                    path,
                    f"attribute '{key}' is {type(value).__name__}",
                    "attributes are text, numbers or booleans",
                )
            group.attrs[key] = value


def read_hdf5(path: str | os.PathLike[str]) -> Sequence:
    """Read and validate what `write_hdf5` wrote. Raises `InputError` on a missing, cut-short or
    foreign file."""
    path = Path(path)
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != _FORMAT:
                raise InputError(
                    path,
                    f"is not a '{_FORMAT}' file (format: {file.attrs.get('format')!r})",
                    "convert the recording with python -m gnio_jax.data convert",
                )
            values: dict[str, Any] = {}
            for field in _FIELDS:
                if field not in file:
                    raise InputError(
                        path, f"field '{field}' is missing", "convert the recording again"
                    )
                value = file[field][()]  # pyright: ignore[reportIndexIssue]
                if not isinstance(value, np.ndarray) or value.dtype.kind != (
                    "b" if field == "valid" else "f"
                ):
                    raise InputError(
                        path,
                        f"field '{field}' is not an array of {'booleans' if field == 'valid' else 'numbers'}",
                        "convert the recording again",
                    )
                values[field] = (
                    value.astype(np.float64, copy=False) if value.dtype.kind == "f" else value
                )
            device: Any = file["device_orientation"][()] if "device_orientation" in file else None  # pyright: ignore[reportIndexIssue]
            if device is not None:
                if not isinstance(device, np.ndarray) or device.dtype.kind != "f":
                    raise InputError(
                        path,
                        "field 'device_orientation' is not an array of numbers",
                        "convert the recording again",
                    )
                device = device.astype(np.float64, copy=False)
            stored = file["attributes"].attrs if "attributes" in file else {}
            attributes = {
                key: value.item() if isinstance(value, np.generic) else value
                for key, value in stored.items()
            }
            name = str(file.attrs.get("name", path.stem))
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    except InputError:
        raise
    except Exception as error:  # a damaged file makes the parser fail in any way
        raise InputError(
            path,
            f"cannot be read as HDF5, it may be cut short ({error})",
            "convert or copy it again",
        ) from None
    return validate(
        Sequence(name=name, device_orientation=device, attributes=attributes, **values), path
    )
