"""Resampling: splines within unbroken runs, and a low-pass before a lower rate."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from gnio_jax.decimation import decimation_factor, low_pass
from gnio_jax.errors import InputError
from gnio_jax.numerics import convolve, finite_rows, quaternions, rotations, stretches
from gnio_jax.types import Sequence

SPLINE_INTERVALS = 3.5
"""Largest number of usual intervals of a sensor between two samples that a spline interpolates;
across more it would oscillate, and a line is used (ours)."""
SHORTEST_SPLINE = 4
"""Number of successive samples below which straight lines replace a spline."""
SAME_STAMP = 1e-6
"""s."""


def longest_bridge(rate: float) -> float:
    """Largest time between two samples of an IMU at `rate` Hz for which interpolated samples count
    as measured, s (ours): clocks of phones jitter, and the interpolation of a few lost samples is
    accurate."""
    return max(0.1, 3.0 / rate)


def check_count(sequence: Sequence) -> None:
    """Raise `InputError` for a sequence of less than two samples, which have no rate."""
    if (count := len(sequence.time)) < 2:
        problem = f"has {count} sample{'' if count else 's'}, at least two are needed"
        raise InputError(sequence.name, problem, "leave it out")


def is_uniform(time: Float[np.ndarray, " n"], rate: float) -> bool:
    """True if every interval is 1/rate to 0.1 % and the whole to 0.01 %.

    This holds for stamps rounded to a microsecond.
    """
    intervals = np.diff(time) * rate
    return bool(np.abs(intervals - 1.0).max() < 1e-3 and abs(intervals.mean() - 1.0) < 1e-4)


def uniform_clock(first: float, last: float, rate: float) -> Float[np.ndarray, " m"]:
    """Stamps at `rate` Hz from `first` to at most `last`."""
    clock = first + np.arange(int(np.floor((last - first) * rate + 1e-6)) + 1) / rate
    clock[-1] = min(clock[-1], last)  # rounding must not extrapolate
    return clock


def resample_imu(
    time: Float[np.ndarray, " n"],
    values: Float[np.ndarray, "n w"],
    clock: Float[np.ndarray, " m"],
    rate: float,
) -> tuple[Float[np.ndarray, "m w"], Bool[np.ndarray, " m"]]:
    """An IMU's samples at the uniform stamps `clock` of `rate` Hz, and which of these are measured.

    For a lower rate the samples are band-limited first (zero-phase FIR, pass band to 0.8 of the new
    Nyquist frequency), because vibrations would alias into the gait band. In gaps longer than
    `longest_bridge` the samples are on a line and not measured, and beyond the ends they are held.
    """
    step = float(np.median(np.diff(time)))
    factor, broken = decimation_factor(1.0 / step, rate), np.diff(time) > SPLINE_INTERVALS * step
    measured = covered_at(time, clock, longest_bridge(1.0 / step))
    if factor == 1:
        return interpolate_splines(time, values, clock, broken), measured
    fine = clock[0] + np.arange((len(clock) - 1) * factor + 1) / (rate * factor)
    fine = interpolate_splines(time, values, np.minimum(fine, time[-1]), broken)
    taps = low_pass(factor)
    half = len(taps) // 2
    padded = np.pad(fine, ((half, half), (0, 0)), mode="reflect", reflect_type="odd")
    return convolve(padded, taps)[::factor], measured


def resample(sequence: Sequence, rate: float) -> Sequence:
    """`sequence` on a uniform clock of `rate` Hz that starts at its first stamp.

    A sequence on such a clock is unchanged. The IMU is resampled by `resample_imu`, position and
    velocity by splines, and attitudes by slerp along the shorter arc. `valid` is False between
    samples of which one is invalid, and in gaps of the IMU, where `imu_valid` is also False. A
    reference value next to a NaN is NaN. Waypoints and the readings of other sensors have stamps of
    their own and do not change. Raises `InputError` for a rate that is not a number above 0, and
    for a sequence of less than two samples.
    """
    if not (isinstance(rate, int | float | np.number) and 0 < rate < np.inf):
        raise InputError("rate", f"found {rate!r}", "give a number above 0, Hz")
    check_count(sequence)
    time, valid = sequence.time, sequence.valid
    if is_uniform(time, rate):
        return sequence
    clock = uniform_clock(time[0], time[-1], rate)
    step = float(np.median(np.diff(time)))
    bridge = longest_bridge(1.0 / step)
    broken = (np.diff(time) > SPLINE_INTERVALS * step) | ~(valid[1:] & valid[:-1])
    imu = np.concatenate([sequence.gyro, sequence.accel], axis=1)
    imu, measured = resample_imu(time, imu, clock, rate)
    if sequence.imu_valid is not None:
        measured = covered_at(time, clock, bridge, sequence.imu_valid)
    device = sequence.device_orientation
    return sequence._replace(
        time=clock,
        gyro=imu[:, :3],
        accel=imu[:, 3:],
        orientation=interpolate_attitudes(time, sequence.orientation, clock),
        position=interpolate_splines(time, sequence.position, clock, broken),
        velocity=interpolate_splines(time, sequence.velocity, clock, broken),
        valid=covered_at(time, clock, bridge, valid),
        device_orientation=None if device is None else interpolate_attitudes(time, device, clock),
        imu_valid=None if measured.all() else measured,
    )


# --- between samples


def bracket(
    time: Float[np.ndarray, " n"], clock: Float[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """The rows below and above each stamp of `clock`, and its relative position between them. Both
    rows are the same if the stamp is that of a sample to 1 µs."""
    upper = np.clip(np.searchsorted(time, clock), 1, len(time) - 1)
    lower = np.where(time[upper] - clock <= SAME_STAMP, upper, upper - 1)
    upper = np.where(clock - time[lower] <= SAME_STAMP, lower, upper)
    span = time[upper] - time[lower]
    share = np.divide(clock - time[lower], span, out=np.zeros_like(clock), where=span > 0)
    return lower, upper, np.clip(share, 0.0, 1.0)


def covered_at(
    time: Float[np.ndarray, " n"],
    clock: Float[np.ndarray, " m"],
    longest: float,
    present: Bool[np.ndarray, " n"] | bool = True,
) -> Bool[np.ndarray, " m"]:
    """Where a clock is between two samples that are both `present` and at most `longest` (s)
    apart."""
    lower, upper, _ = bracket(time, clock)
    covered = (clock >= time[0] - SAME_STAMP) & (clock <= time[-1] + SAME_STAMP)
    present = np.broadcast_to(present, time.shape)
    return present[lower] & present[upper] & (time[upper] - time[lower] <= longest) & covered


def runs_within(
    time: Float[np.ndarray, " n"],
    broken: Bool[np.ndarray, " i"],
    clock: Float[np.ndarray, " m"],
    shortest: int = SHORTEST_SPLINE,
) -> Iterator[tuple[slice, slice]]:
    """Rows of `time`, and rows of `clock` within them to 1 µs, of each unbroken run of at least
    `shortest` samples."""
    for run in stretches(broken):
        if run.stop - run.start >= shortest:
            start = np.searchsorted(clock, time[run.start] - SAME_STAMP)
            stop = np.searchsorted(clock, time[run.stop - 1] + SAME_STAMP, side="right")
            if stop > start:
                yield run, slice(int(start), int(stop))


def interpolate_splines(
    time: Float[np.ndarray, " n"],
    values: Float[np.ndarray, "n w"],
    clock: Float[np.ndarray, " m"],
    broken: Bool[np.ndarray, " i"],
) -> Float[np.ndarray, "m w"]:
    """Cubic splines within runs of samples, straight lines where the interval between two is
    `broken`, and the outermost values beyond the ends.

    A spline would carry an outlier or a gap into its surroundings.
    """
    if len(clock) == len(time) and np.abs(clock - time).max() <= SAME_STAMP:
        return values
    lower, upper, share = bracket(time, clock)
    share = share[:, None]
    lines = (1.0 - share) * values[lower] + share * values[upper]
    resampled = np.where(share > 0, lines, values[lower])
    for run, rows in runs_within(time, broken, clock):
        # A spline starts at 0, because large stamps would cost its coefficients digits.
        run_time = time[run] - time[run.start]
        at = np.clip(clock[rows] - time[run.start], 0.0, run_time[-1])
        resampled[rows] = CubicSpline(run_time, values[run], axis=0)(at)
    return resampled


def interpolate_attitudes(
    time: Float[np.ndarray, " n"], wxyz: Float[np.ndarray, "n 4"], clock: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "m 4"]:
    """Attitudes on the shorter arc between samples, for any signs of the quaternions; NaN next to a
    NaN, and the outermost attitudes beyond the ends."""
    lower, upper, share = bracket(time, clock)
    attitudes = np.full((len(clock), 4), np.nan)
    finite = finite_rows(wxyz[lower]) & finite_rows(wxyz[upper])
    if finite.any():
        start, end = rotations(wxyz[lower[finite]]), rotations(wxyz[upper[finite]])
        turn = (start.inv() * end).as_rotvec() * share[finite, None]
        attitudes[finite] = quaternions(start * Rotation.from_rotvec(turn))
    return attitudes
