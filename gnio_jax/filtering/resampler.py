"""IMU samples with irregular stamps on the uniform clock of the filter.

Grid sample k is that of time k·dt after the first stamp. Where the IMU is about as fast as the
filter, it is interpolated linearly between its two neighbours. Where the IMU is faster, a low-pass
comes first, because frequencies above half the filter's rate would alias. It is that of
`data.resample`: a cubic spline through the samples is evaluated at `factor` points per grid sample,
and a symmetric FIR makes one sample of them. The FIR of a grid sample reaches beyond it by `delay`,
so the sample is known that much later; its time remains k·dt.

A hole in the stream ends a run of samples, and the grid samples in it are missing. At the start of
the stream the samples before it are replaced by odd reflection, as in a recording. At the other
ends of runs the FIR uses the weights of the samples that exist, divided by their sum. Odd
reflection would give the last sample before a hole without the low-pass, with all its vibration,
and the filter would hold this sample. A single lost sample is no hole. All of this happens on the
host.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from gnio_jax import numerics
from gnio_jax.decimation import decimation_factor, low_pass
from gnio_jax.filtering.checks import check_number

GYRO, ACCEL, VALID = slice(0, 3), slice(3, 6), 6
"""Columns of grid samples: gyro in rad/s, accel in m/s², and 1; NaN and 0 where the sample is
missing."""

LONGEST_GAP = 60.0
"""A stamp further than this from the one before is an error, most often of its unit, s."""
LONGEST_TRUSTED = 1.0
"""A stamp further than this from the one before is accepted when a second one agrees with it, s
(ours): a clock may be wrong for one sample."""

# Three limits in intervals of the IMU (ours). A sample that follows another one sooner than the
# first is left out before the low-pass, because noise would make the spline oscillate. Samples
# further apart than the second are joined by a line, because the spline would be unconstrained
# there. Samples not further apart than the third belong to one run: at most one is lost.
_CLOSEST, _LINE, _LOST = 0.25, 1.75, 2.5

# Two limits in intervals of the grid (ours). An interval longer than the first is a stop of the IMU
# and does not count for its rate; a shorter one may be jitter. The rate is known after the second.
_STOP, _RATE_KNOWN = 5.0, 100
_TOO_FAST = 1.05
"""Largest rate, as a multiple of the fastest rate for which the low-pass is made."""
_BEFORE = 4
"""Samples kept before the FIR's reach, so that the spline's new end has no effect within it."""


class Grid(NamedTuple):
    """The uniform clock of the filter, and how samples are brought onto it."""

    dt: float
    """Time between grid samples, s."""
    hole: float
    """Grid samples between stamps that are further apart than this are missing, s."""
    imu_rate: float
    """Hz, nominal."""
    factor: int
    """Points of the fine grid per grid sample; 1: there is no low-pass."""
    taps: Float[np.ndarray, "taps"]
    """Weights of the FIR on the fine grid; (1,) where there is none."""

    @property
    def delay(self) -> float:
        """By how much the FIR of a grid sample reaches beyond its time, s."""
        return len(self.taps) // 2 * self.dt / self.factor

    @property
    def longest(self) -> float:
        """Samples further apart belong to two runs, s."""
        return max(self.hole, _LOST / self.imu_rate) if self.factor > 1 else self.hole


def create_grid(dt: float, hole: float | None = None, imu_rate: float | None = None) -> Grid:
    """The grid of a filter with a sample every `dt` s and an IMU of `imu_rate` Hz, by default 1/dt.

    `hole` is 1.5 dt by default. Raises `ValueError`.
    """
    hole = 1.5 * dt if hole is None else hole
    imu_rate = 1 / dt if imu_rate is None else imu_rate
    check_number("hole", hole, dt, "s")
    check_number("imu_rate", imu_rate, 1e-9, "Hz")
    factor = decimation_factor(imu_rate, 1 / dt)
    taps = low_pass(factor) if factor > 1 else np.ones(1)
    return Grid(dt, float(hole), float(imu_rate), factor, taps)


def grid_rows(
    stamps: Float[np.ndarray, "m"],
    samples: Float[np.ndarray, "m 6"],
    first: int,
    count: int,
    grid: Grid,
    slack: float,
) -> Float[np.ndarray, "count 7"]:
    """Grid samples `first` … `first + count − 1`: the FIR about each, run by run of samples.

    `stamps` (s since that of grid sample 0, increasing) and `samples` (gyro, accel) are the samples
    that came and on which the grid samples depend. Stamps closer than `slack` (s) to a time count
    as that time.
    """
    half, step = len(grid.taps) // 2, grid.dt / grid.factor
    centres = (first + np.arange(count)) * grid.factor
    # The points of the fine grid on which all centres depend.
    lowest, highest = first * grid.factor - half, (first + count - 1) * grid.factor + half
    rows = np.concatenate([np.full((count, 6), np.nan), np.zeros((count, 1))], axis=1)
    for run in numerics.stretches(np.diff(stamps) > grid.longest) if len(stamps) else ():
        time = stamps[run]
        begin, end = math.ceil((time[0] - slack) / step), math.floor((time[-1] + slack) / step)
        low, high = max(begin, lowest), min(end, highest)
        inside = (begin <= centres) & (centres <= end)
        if not inside.any():
            continue
        fine = _evaluate_curve(time, samples[run], np.arange(low, high + 1) * step, grid, slack)
        if begin == 0:  # the stream's start, as far as samples can be reflected
            reflected = min(low - lowest, high - low)
            fine = np.concatenate([2 * fine[0] - fine[reflected:0:-1], fine])
            low -= reflected
        weighted = np.zeros((highest - lowest + 1, 7))  # samples, and 1 where there is one
        weighted[low - lowest : high - lowest + 1] = np.pad(
            fine, ((0, 0), (0, 1)), constant_values=1
        )
        windows = np.lib.stride_tricks.sliding_window_view(weighted, len(grid.taps), axis=0)
        sums = (windows[:: grid.factor] @ grid.taps)[inside]
        # From the centre to either side the sum of the taps is at least half the middle one.
        rows[inside] = sums / sums[:, 6:]
    return rows


def _evaluate_curve(
    time: np.ndarray, samples: np.ndarray, points: np.ndarray, grid: Grid, slack: float
) -> np.ndarray:
    """A run evaluated at some points: by lines, and before a low-pass by a spline where samples are
    close together."""
    points = np.clip(points, time[0], time[-1])
    if grid.factor == 1:
        nearest = time[np.minimum(np.searchsorted(time, points - slack), len(time) - 1)]
        points = np.where(nearest <= points + slack, nearest, points)
    lines = numerics.interpolate(points, time, samples)
    if grid.factor == 1 or len(time) < 4:
        return lines
    wide = np.diff(time) > _LINE / grid.imu_rate
    on_line = wide[np.searchsorted(time[1:-1], points, side="right")]
    return np.where(on_line[:, None], lines, CubicSpline(time, samples)(points))


class Stream:
    """The samples that have come and are still needed, and the grid samples that they make."""

    def __init__(self, grid: Grid):
        self.grid = grid
        self.origin = math.nan
        """The first stamp, s."""
        self.taken = 0
        """Number of grid samples that were taken."""
        self._ended = 0
        """Number of grid samples that no later sample can change, including those that were
        taken."""
        self._newest = 0.0
        """The newest stamp, s since the origin."""
        self._stamps: list[float] = []
        """Stamps of the samples that came and are still needed, s since the origin."""
        self._samples: list[tuple[float, ...]] = []
        self._unproven: tuple[float, tuple[float, ...]] | None = None
        """A sample whose stamp jumps, until the next one agrees with it."""
        self._intervals, self._covered = 0, 0.0
        """Number of intervals between stamps, including those of missing samples, and their sum in
        s, without those in which the IMU stopped."""

    def push(self, time: float, sample: tuple[float, ...]) -> None:
        """Take a sample: time s, gyro rad/s, accel m/s²; one that is not finite is missing.

        Raises `ValueError` and changes nothing for a time that does not increase or jumps by more
        than `LONGEST_GAP`, or for an IMU so fast that it would alias.
        """
        if math.isnan(self.origin):
            self.origin = time
            self._append(0.0, sample)
            return
        stamp, newest = time - self.origin, self._newest
        if stamp <= newest:
            raise ValueError(f"time: must increase, found {time!r} after {self.origin + newest!r}")
        if stamp - newest > LONGEST_GAP:
            problem = f"{time!r} is {stamp - newest:g} s after the sample before, more than"
            remedy = "stamps must be in seconds; after a long stop call Tracker.restart"
            raise ValueError(f"time: {problem} {LONGEST_GAP:g} s; {remedy}")
        come = [(stamp, sample)]
        if stamp - newest > LONGEST_TRUSTED:
            waiting = self._unproven
            if waiting is None or not 0 < stamp - waiting[0] <= LONGEST_TRUSTED:
                self._unproven = stamp, sample
                return
            come.insert(0, waiting)
        self._check_rate([arrival for arrival, _ in come])
        self._unproven = None
        for arrival, values in come:
            self._append(arrival, values)

    @property
    def newest(self) -> float:
        """The newest stamp, s; NaN before the first one. One that jumps counts when the next one
        agrees with it."""
        return self.origin + self._newest

    @property
    def delay(self) -> float:
        """Time by which a grid sample is known after its own, at most, s."""
        return self.grid.delay

    @property
    def ready(self) -> int:
        """Number of the next grid samples that later samples cannot change any more."""
        return self._ended - self.taken

    def rows(self, count: int) -> Float[np.ndarray, "count 7"]:
        """The next grid samples, at most `ready`. They are read, not taken."""
        stamps, samples = np.array(self._stamps), np.array(self._samples).reshape(-1, 6)
        slack = self._slack(self._newest)
        return grid_rows(stamps, samples, self.taken, count, self.grid, slack)

    def take(self, count: int) -> None:
        """Take the next `count` grid samples, and forget the samples that only these depended
        on."""
        self.taken += count
        reach = self.taken * self.grid.dt - self.grid.delay
        unneeded = int(np.searchsorted(self._stamps, reach, side="right")) - 1 - _BEFORE
        del self._stamps[: max(unneeded, 0)], self._samples[: max(unneeded, 0)]

    def _append(self, stamp: float, sample: tuple[float, ...]) -> None:
        self._newest = stamp
        too_close = self._stamps and stamp - self._stamps[-1] < _CLOSEST / self.grid.imu_rate
        if all(map(math.isfinite, sample)) and not (self.grid.factor > 1 and too_close):
            self._stamps.append(stamp)
            self._samples.append(sample)
        reached = self._stamps[-1] if self._stamps else -math.inf
        in_hole = stamp - reached > self.grid.longest  # and all grid samples up to now are missing
        last = stamp if in_hole else reached - self.grid.delay
        ended = math.floor((last + self._slack(stamp)) / self.grid.dt) + 1
        self._ended = max(self._ended, ended)

    def _slack(self, stamp: float) -> float:
        """Rounding error of the stamps, s: closer stamps are the same time."""
        largest = max(abs(self.origin), abs(self.origin + stamp))
        return 1e-6 * self.grid.dt + 4 * math.ulp(largest)

    def _check_rate(self, stamps: list[float]) -> None:
        """Count the intervals before these stamps. Raises `ValueError` if the samples come so much
        faster than `imu_rate` that vibrations would alias. The rate follows from the number of
        stamps so far, which jitter hardly changes."""
        grid, intervals, covered = self.grid, self._intervals, self._covered
        fastest = 1.5 * grid.imu_rate if grid.factor > 1 else 1 / grid.dt
        for before, stamp in itertools.pairwise([self._newest, *stamps]):
            if stamp - before <= max(grid.hole, _STOP * grid.dt):
                intervals, covered = intervals + 1, covered + stamp - before
        enough = round(covered / grid.dt, 3) >= _RATE_KNOWN
        rate = intervals / covered if enough else 0.0
        if rate > _TOO_FAST * fastest:
            raise ValueError(
                f"imu_rate: the samples come at {rate:.4g} Hz, the tracker was made for "
                f"{grid.imu_rate:.4g} Hz: vibrations would alias; make it with imu_rate={rate:.4g}"
            )
        self._intervals, self._covered = intervals, covered
