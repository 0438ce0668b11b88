"""One uniform clock for a recording."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from gnio_jax.decimation import decimation_factor, low_pass
from gnio_jax.numerics import convolved, quaternions, rotations
from gnio_jax.types import Sequence

LONGEST_BRIDGE = 0.1
"""s between samples within which `resample` trusts what it interpolates."""


def is_uniform(time: Float[np.ndarray, "n"], rate: float) -> bool:
    """True if every interval is 1/rate to 0.1 % and the whole to 0.01 %.

    Stamps rounded to a microsecond are.
    """
    intervals = np.diff(time) * rate
    return bool(np.abs(intervals - 1.0).max() < 1e-3 and abs(intervals.mean() - 1.0) < 1e-4)


def resample(sequence: Sequence, rate: float, max_gap: float = LONGEST_BRIDGE) -> Sequence:
    """`sequence` on a uniform clock of `rate` Hz that starts at its first stamp.

    Unchanged if it is on such a clock already. IMU, position and velocity follow cubic splines,
    attitudes slerp along the shorter arc. Going to a lower rate the IMU is band-limited first
    (zero-phase FIR, pass band to 0.8 of the new Nyquist frequency), or vibrations would alias into
    the gait band; poses stay those of the stamp. `valid` is False between samples of which one is
    invalid, and in gaps longer than `max_gap` (s), where the IMU is interpolated linearly: there
    `imu_valid` is False, too. A reference value next to a NaN is NaN.
    """
    time = sequence.time
    if is_uniform(time, rate):
        return sequence
    count = int(np.floor((time[-1] - time[0]) * rate + 1e-6)) + 1
    clock = time[0] + np.arange(count) / rate
    clock[-1] = min(clock[-1], time[-1])
    imu = np.concatenate([sequence.gyro, sequence.accel], axis=1)
    imu = _resample_imu(time, imu, clock, rate, max_gap)
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
        imu_valid=_imu_valid_at(time, sequence.imu_valid, clock, max_gap),
    )


def _resample_imu(
    time: np.ndarray, imu: np.ndarray, clock: np.ndarray, rate: float, max_gap: float
) -> np.ndarray:
    everywhere = np.ones(len(time), dtype=bool)
    factor = decimation_factor(1.0 / float(np.median(np.diff(time))), rate)
    if factor == 1:
        return _interpolate(time, imu, everywhere, clock, max_gap)
    fine = time[0] + np.arange((len(clock) - 1) * factor + 1) / (rate * factor)
    fine = np.minimum(fine, time[-1])
    return _low_pass(_interpolate(time, imu, everywhere, fine, max_gap), factor)[::factor]


class _Neighbours(NamedTuple):
    """The samples around each stamp of a clock; one and the same where a stamp is a sample's own to
    1 µs."""

    left: np.ndarray
    """Rows."""
    right: np.ndarray
    """Rows."""
    span: np.ndarray
    """s between the two."""
    share: np.ndarray
    """Where the stamp lies between them, 0 to 1."""


def _neighbours(time: np.ndarray, clock: np.ndarray) -> _Neighbours:
    right = np.clip(np.searchsorted(time, clock), 1, len(time) - 1)
    left = right - 1
    left = np.where(np.abs(time[right] - clock) <= 1e-6, right, left)
    right = np.where(np.abs(time[left] - clock) <= 1e-6, left, right)
    span = time[right] - time[left]
    share = np.divide(clock - time[left], span, out=np.zeros_like(clock), where=span > 0)
    return _Neighbours(left, right, span, share)


def _valid_at(
    time: np.ndarray, valid: np.ndarray, clock: np.ndarray, max_gap: float
) -> Bool[np.ndarray, "m"]:
    near = _neighbours(time, clock)
    return valid[near.left] & valid[near.right] & (near.span <= max_gap)


def _imu_valid_at(
    time: np.ndarray, valid: np.ndarray | None, clock: np.ndarray, max_gap: float
) -> Bool[np.ndarray, "m"] | None:
    """None where every sample lies among measured ones."""
    everywhere = np.ones(len(time), dtype=bool)
    found = _valid_at(time, everywhere if valid is None else valid, clock, max_gap)
    return None if found.all() else found


def _interpolate(
    time: np.ndarray, values: np.ndarray, good: np.ndarray, clock: np.ndarray, max_gap: float
) -> np.ndarray:
    """Cubic splines within runs of good samples, linear between the runs.

    A spline would carry an outlier or a gap into its surroundings.
    """
    near = _neighbours(time, clock)
    share = near.share[:, None]
    line = (1.0 - share) * values[near.left] + share * values[near.right]
    result = np.where(share > 0, line, values[near.left])
    rows = np.flatnonzero(good)
    if rows.size == 0:
        return result
    breaks = np.flatnonzero((np.diff(rows) > 1) | (np.diff(time[rows]) > max_gap)) + 1
    for run in np.split(rows, breaks):
        if run.size >= 4:
            first = np.searchsorted(clock, time[run[0]], side="left")
            stop = np.searchsorted(clock, time[run[-1]], side="right")
            spline = CubicSpline(time[run], values[run], axis=0)
            result[first:stop] = spline(clock[first:stop])
    return result


def _slerp(time: np.ndarray, wxyz: np.ndarray, clock: np.ndarray) -> np.ndarray:
    near = _neighbours(time, clock)
    result = np.full((len(clock), 4), np.nan)
    known = np.isfinite(wxyz[near.left]).all(axis=1) & np.isfinite(wxyz[near.right]).all(axis=1)
    if not known.any():
        return result
    start, end = rotations(wxyz[near.left[known]]), rotations(wxyz[near.right[known]])
    # The relative rotation vector is the shorter arc whatever the signs of the quaternions.
    turn = (start.inv() * end).as_rotvec() * near.share[known, None]
    result[known] = quaternions(start * Rotation.from_rotvec(turn))
    return result


def _low_pass(values: np.ndarray, factor: int) -> np.ndarray:
    """The FIR `low_pass` with zero phase, ends filled by odd reflection."""
    taps = low_pass(factor)
    half = len(taps) // 2
    padded = np.pad(values, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
    return convolved(padded, taps)
