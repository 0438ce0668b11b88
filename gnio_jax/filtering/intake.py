"""The low-pass of a stream: what the filter's rate cannot carry of a faster IMU would alias.

It is what `data.resample` does to a recording: a cubic spline through the samples is read at
`factor` points per grid sample, and a symmetric FIR makes one sample of them. The FIR of the grid
sample at t reaches up to t + delay, so that it is known that much later; its stamp stays t. At the
start of the stream odd reflection stands for what was before it, as in a recording. A hole ends a
run of samples: the FIR is drained and starts anew behind the hole, in both with the weights of what
is there, divided by their sum. Odd reflection would hand over the last sample before the hole as
raw as it is, with all its vibration, and the filter would hold that. A single lost sample is no
hole. On the host; nothing older than the FIR's reach is kept.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PPoly
from scipy.linalg import get_lapack_funcs

from gnio_jax.decimation import decimation_factor, low_pass

_CLOSEST = 0.25
"""Of the IMU's interval: a sample that comes sooner after another is left out (ours), or noise
would make the spline swing."""
_LINE = 1.75
"""Of the IMU's interval: samples further apart are joined by a line (ours). There the spline has no
hold, and swings the higher the wider the gap; a lost sample of a vibration is enough for that."""
_LOST = 2.5
"""Of the IMU's interval: samples no further apart belong to one run (ours), so that the loss of a
single one does not end it."""
_STOP = 5.0
"""Of the grid's interval: what is longer is a stop of the IMU and says nothing of its rate (ours).
Shorter ones may be jitter."""
_RATE_CHECK = 100
"""Every so many grid samples the IMU's rate is held against `imu_rate`: by the number of stamps
till then, which jitter hardly changes. The time in which the IMU stopped does not count."""
_TOO_FAST = 1.05
"""Times the fastest rate that the low-pass is made for."""
_BEFORE = 4
"""Samples kept before the FIR's reach, so that the spline's new end is not felt within it."""


(_solve_tridiagonal,) = get_lapack_funcs(("gtsv",), dtype=np.float64)


class Design(NamedTuple):
    """What is fixed when a tracker is made."""

    dt: float
    """Of the filter's grid, s."""
    hole: float
    """The clock takes grid samples as missing between stamps further apart, s."""
    imu_rate: float
    """Hz, nominal."""
    factor: int
    """Points of the fine grid per grid sample; 1: there is no low-pass."""
    taps: Float[np.ndarray, "taps"]
    """Of the FIR, on the fine grid; (1,) where there is none."""

    @property
    def longest(self) -> float:
        """Samples further apart belong to two runs, s. Never less than `hole`."""
        return max(self.hole, _LOST / self.imu_rate)

    @property
    def delay(self) -> float:
        """By how much the FIR of a grid sample reaches beyond its stamp, s."""
        return len(self.taps) // 2 * self.dt / self.factor

    @property
    def fastest(self) -> float:
        """Above this rate of the IMU, Hz, vibrations alias all the same."""
        return 1.5 * self.imu_rate if self.factor > 1 else 1 / self.dt


class SampleRun(NamedTuple):
    """Samples without a hole between them, as far as they are still needed."""

    first: int
    """Point of the fine grid with which the run began: origin + first·dt/factor."""
    stamps: Float[np.ndarray, "n"]
    """s since the origin."""
    samples: Float[np.ndarray, "n 6"]
    """gyro rad/s, accel m/s²."""


class Intake(NamedTuple):
    """Where the stream stands."""

    origin: float
    """The first stamp, s."""
    newest: float
    """The newest stamp, s."""
    intervals: int
    """Between stamps, missing samples included, without those in which the IMU stopped."""
    covered: float
    """Their sum, s."""
    count: int
    """Grid samples made or passed over by the low-pass."""
    run: SampleRun | None
    """None before the first sample, in a hole, and where there is no low-pass."""


Event = tuple[float, tuple[float, ...]]
"""Stamp in s and sample: gyro, accel; NaN says that there is none and that time goes by."""


def design(dt: float, hole: float, imu_rate: float) -> Design:
    """For an IMU of `imu_rate` Hz and a filter with a sample every `dt` s."""
    factor = decimation_factor(imu_rate, 1 / dt)
    return Design(dt, hole, imu_rate, factor, low_pass(factor) if factor > 1 else np.ones(1))


def checked_design(dt: float, hole: Any = None, imu_rate: Any = None) -> Design:
    """For an IMU of `imu_rate` Hz (default: the filter's) and a filter with a sample every `dt` s.

    `hole`: the clock's longest interval, s, by default 1.5 dt. Raises `ValueError`."""
    hole = 1.5 * dt if hole is None else hole
    if not (is_finite_number(hole) and hole >= dt):
        raise ValueError(f"hole: must be a time of at least dt = {dt:g} s, found {hole!r}")
    imu_rate = 1 / dt if imu_rate is None else imu_rate
    if not (is_finite_number(imu_rate) and imu_rate > 0):
        raise ValueError(f"imu_rate: must be a rate in Hz, found {imu_rate!r}")
    return design(dt, float(hole), float(imu_rate))


def is_finite_number(value: Any) -> bool:
    """Whether `value` is a Python number, and finite."""
    return isinstance(value, int | float) and math.isfinite(value)


def rounding(dt: float, time: float, origin: float) -> float:
    """What rounding leaves of the stamps, s: this close is the same time."""
    return 1e-6 * dt + 4 * math.ulp(max(abs(time), abs(origin)))


def measure_rate(intake: Intake, time: float, design: Design) -> Intake:
    """With the interval up to `time` counted, unless the IMU stopped in it."""
    interval = time - intake.newest
    if interval > max(design.hole, _STOP * design.dt):
        return intake
    return intake._replace(intervals=intake.intervals + 1, covered=intake.covered + interval)


def check_rate(intake: Intake, time: float, design: Design) -> None:
    """`ValueError` if the stamps up to `time` come so much faster than `imu_rate` that vibrations
    would alias."""
    after = measure_rate(intake, time, design)
    slack = rounding(design.dt, time, intake.origin)
    checks_before, checks_after = (
        (covered + slack) // (_RATE_CHECK * design.dt)
        for covered in (intake.covered, after.covered)
    )
    if checks_after <= checks_before:
        return
    found = after.intervals / after.covered
    if found > _TOO_FAST * design.fastest:
        raise ValueError(
            f"imu_rate: the samples come at {found:.4g} Hz, the tracker was made for "
            f"{design.imu_rate:.4g} Hz: vibrations would alias; make it with imu_rate={found:.4g}"
        )


def low_pass_sample(
    intake: Intake | None, time: float, sample: tuple[float, ...], design: Design
) -> tuple[Intake, list[Event]]:
    """The stream after one sample, and what the filter's clock is to be told.

    Without a low-pass that is the sample itself. With one it is grid samples with their own stamps,
    in order, each as soon as the FIR's reach is there. In holes there are none.
    """
    if intake is None:
        intake = Intake(time, time, 0, 0.0, 0, None)
    else:
        intake = measure_rate(intake, time, design)._replace(newest=time)
    if design.factor == 1:
        return intake, [(time, sample)]
    elapsed, slack = time - intake.origin, rounding(design.dt, time, intake.origin)
    present, events = all(map(math.isfinite, sample)), []
    if intake.run is not None and elapsed - intake.run.stamps[-1] > design.longest:
        intake, events = _drain(intake, intake.run, slack, design)
    if intake.run is None and not present:
        return intake, [*events, (time, sample)]
    if present:
        intake = _append(intake, elapsed, sample, slack, design)
    if intake.run is None:
        return intake, events
    intake, ready = _filter_ready(intake, intake.run, slack, design)
    return intake, events + ready


def _drain(
    intake: Intake, run: SampleRun, slack: float, design: Design
) -> tuple[Intake, list[Event]]:
    """End a run at a hole: the grid samples up to its end, with the weights of what is there."""
    last, count, events = _last_point(run, slack, design), intake.count, []
    while count * design.factor <= last:
        events.append(_grid_event(intake, run, count, last, design))
        count += 1
    return intake._replace(count=count, run=None), events


def _append(
    intake: Intake, elapsed: float, sample: tuple[float, ...], slack: float, design: Design
) -> Intake:
    """The sample added to the run, or the first of a new one."""
    run = intake.run
    if run is None:
        first = math.ceil((elapsed - slack) * design.factor / design.dt)
        run = SampleRun(first, np.array([elapsed]), np.array([sample]))
        return intake._replace(run=run, count=max(intake.count, -(-first // design.factor)))
    if elapsed - run.stamps[-1] < _CLOSEST / design.imu_rate:
        return intake
    stamps, samples = np.append(run.stamps, elapsed), np.concatenate([run.samples, [sample]])
    return intake._replace(run=run._replace(stamps=stamps, samples=samples))


def _filter_ready(
    intake: Intake, run: SampleRun, slack: float, design: Design
) -> tuple[Intake, list[Event]]:
    """The grid samples that the FIR reaches now; what it needs no more is dropped."""
    last, count, events = _last_point(run, slack, design), intake.count, []
    while count * design.factor + len(design.taps) // 2 <= last:
        events.append(_grid_event(intake, run, count, last, design))
        count += 1
    reach = count * design.dt - design.delay
    unneeded = int(np.searchsorted(run.stamps, reach, side="right")) - 1 - _BEFORE
    if unneeded > 0:
        run = run._replace(stamps=run.stamps[unneeded:], samples=run.samples[unneeded:])
    return intake._replace(count=count, run=run), events


def _last_point(run: SampleRun, slack: float, design: Design) -> int:
    """The last point of the fine grid that the run has reached."""
    return math.floor((run.stamps[-1] + slack) * design.factor / design.dt)


def _grid_event(intake: Intake, run: SampleRun, count: int, last: int, design: Design) -> Event:
    return intake.origin + count * design.dt, _filtered(run, count, last, design)


def _filtered(run: SampleRun, count: int, last: int, design: Design) -> tuple[float, ...]:
    """Grid sample `count` of a run that has come to point `last` of the fine grid."""
    half, centre = len(design.taps) // 2, count * design.factor
    low, high = max(centre - half, run.first), min(centre + half, last)
    points = np.arange(low, high + 1) * (design.dt / design.factor)
    fine = _interpolated(run, np.clip(points, run.stamps[0], run.stamps[-1]), design)
    # As far as there is something to reflect: a shorter run is truncated on both sides.
    reflected = min(low - centre + half, high - low) if run.first == 0 else 0
    fine = np.concatenate([2 * fine[0] - fine[reflected:0:-1], fine])
    skipped = low - reflected - centre + half
    taps = design.taps[skipped : skipped + len(fine)]
    # From the centre on to either side the taps never sum to less than half the middle one.
    return tuple((taps @ fine / taps.sum()).tolist())


def _interpolated(
    run: SampleRun, points: Float[np.ndarray, "p"], design: Design
) -> Float[np.ndarray, "p 6"]:
    """The samples at some points of the run: a spline, and lines where they are far apart."""
    if len(run.stamps) < 4:
        fine, lines = np.empty((len(points), 6)), np.ones(len(points), bool)
    else:
        fine = _spline(run.stamps, run.samples)(points)
        wide = np.diff(run.stamps) > _LINE / design.imu_rate
        lines = wide[np.searchsorted(run.stamps[1:-1], points, side="right")]
    if lines.any():
        for row, column in zip(fine.T, run.samples.T, strict=True):
            row[lines] = np.interp(points[lines], run.stamps, column)
    return fine


def _spline(x: Float[np.ndarray, "n"], y: Float[np.ndarray, "n 6"]) -> PPoly:
    """SciPy's `CubicSpline(x, y)` of at least 4 samples, to the bit.

    Its checks of every argument take longer than all else that is done for a sample.
    """
    steps = np.diff(x)
    column = steps[:, None]
    slope = np.diff(y, axis=0) / column
    # Equal second derivatives at every sample, and no knot at the second and the last but one.
    first, last = x[2] - x[0], x[-1] - x[-3]
    right = np.empty_like(y)
    right[1:-1] = 3 * (column[1:] * slope[:-1] + column[:-1] * slope[1:])
    right[0] = (column[0] + 2 * first) * column[1] * slope[0] + column[0] ** 2 * slope[1]
    right[0] /= first
    right[-1] = column[-1] ** 2 * slope[-2] + (2 * last + column[-1]) * column[-2] * slope[-1]
    right[-1] /= last
    diagonal = np.concatenate([steps[1:2], 2 * (steps[:-1] + steps[1:]), steps[-2:-1]])
    lower, upper = np.append(steps[1:], last), np.append(first, steps[:-1])
    derivative = _solve_tridiagonal(lower, diagonal, upper, right)[3]
    bend = (derivative[:-1] + derivative[1:] - 2 * slope) / column
    quadratic = (slope - derivative[:-1]) / column - bend
    return PPoly.construct_fast(
        np.stack([bend / column, quadratic, derivative[:-1], y[:-1]]), x, extrapolate=True
    )
