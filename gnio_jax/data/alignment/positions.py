"""Alignment of a phone with the positions of another device that moves with it, whose attitude is
unknown.

`align_positions` finds the difference of both clocks and the phone's attitude in the tracker's
level world, from accelerations alone: those of the phone, rotated by its own integrated gyro, are
compared with the second difference of the positions.

The first guess of the lag is the one at which both accelerations correlate best. The vertical
accelerations need no heading and show every step. The horizontal ones, compared within stretches in
which the yaw hardly drifts, distinguish one step from the next. Then one robust least-squares fit
finds a rotation and a lag, both of which vary slowly. All of this is ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment.body import (
    LAG_BEND_STD,
    RATE,
    SAME_LAG,
    TooLittle,
    check_lengths,
    gaps,
    hat_functions,
    second_difference,
    smooth,
    uniform_knots,
)
from gnio_jax.data.assembly import Samples, Streams, sort_streams
from gnio_jax.data.parsing.stamps import in_order
from gnio_jax.data.reference import Poses, longest_trusted, smooth_positions
from gnio_jax.data.resampling import covered_at, interpolate_attitudes, interpolate_splines
from gnio_jax.numerics import (
    about_z,
    integrate_gyro,
    interpolate,
    midpoints,
    robust_std,
    rotations,
    slerp,
    turns_between,
    within,
)
from gnio_jax.types import GRAVITY

STEP_FILTER_SECONDS, SLOW_FILTER_SECONDS = 0.08, 0.25
"""Standard deviations of the Gaussian filters, s: one keeps the steps, whose vertical acceleration
shows the lag; the other removes the gait, which differs between two devices in two hands."""
SHORTEST_OVERLAP = 20.0
"""Shortest time of usable positions for a fit, s."""
STRETCH_SECONDS = 15.0
"""Length of the stretches whose horizontal accelerations are compared, s, in which the yaw hardly
drifts."""
LAG_STEP, SEARCH_SECONDS = 0.02, 4.0
"""Step and largest size of the constant lags that are tried, s."""
TURN_KNOT_SECONDS, LAG_KNOT_SECONDS = 10.0, 30.0
"""Spacing of the knots of the rotation and of the lag, s."""
DRIFT_STD = np.array([0.05, 0.05, 0.02])
"""Standard deviation of the change of the gyro's drift about x, y and z from one interval of 10 s
to the next, rad: 0.005 rad/s in tilt and 0.002 rad/s in yaw."""
STEPS = 0.3, 0.03
"""Ranges within which the fit is about linear, rad and s: the scale of the trust region."""
UPWARD = np.array([0.0, 0.0, GRAVITY])
"""Specific force at rest in a level world, m/s²."""
CUTOFF = 2.0
"""Frequency at which the smoother of the positions has half response, Hz. Faster motion is the
tracker's noise and the sway of the other device. OxIOD's walks on two floors disagree: with 4 Hz
three of them would correlate with the accelerometer by 0.81 in place of 0.77, and three by 0.28 in
place of 0.35."""


class PositionsFit(NamedTuple):
    """The result of `align_positions`, in SI units."""

    lag: Float[np.ndarray, " k"]
    """Time of the IMU minus time of the tracker for the same event, at knots over the recording,
    s."""
    yaw_drift: float
    """Range of the yaw error of the device's own attitude, rad."""
    correlation: float
    """Correlation of the vertical accelerations at the best constant lag."""
    runner_up: float
    """The unexplained share of the best constant lag over that of the second best; 1 if both are
    equally good."""
    poses: Poses
    """Poses of the IMU on its own clock: its attitude, with the tracker's smoothed positions and
    their velocities."""


class _Signals(NamedTuple):
    """Accelerations of both in level worlds, m/s², on uniform clocks of their own, s."""

    clock: Float[np.ndarray, " n"]
    inertial: Float[np.ndarray, "n 3"]
    """The IMU's acceleration by the device's own attitude, without gravity."""
    grid: Float[np.ndarray, " m"]
    tracked: Float[np.ndarray, "m 3"]
    """Second difference of the positions."""
    good: Bool[np.ndarray, " m"]
    """False near positions that are missing, and where the tracker relocalised."""

    def low_pass(self, seconds: float) -> _Signals:
        """The signals with both accelerations passed through a Gaussian filter."""
        inertial, tracked = (
            smooth(acceleration, seconds * RATE) for acceleration in (self.inertial, self.tracked)
        )
        return self._replace(inertial=inertial, tracked=tracked)

    def overlap_at(self, lag: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Good rows of the grid that the IMU covers at a constant lag, and the accelerations of the
        IMU and of the tracker there."""
        imu_time = self.grid + lag
        covered = self.good & (imu_time > self.clock[0]) & (imu_time < self.clock[-1])
        rows = np.flatnonzero(covered)
        return rows, interpolate(imu_time[rows], self.clock, self.inertial), self.tracked[rows]


def align_positions(imu: Streams, track: Samples) -> PositionsFit:
    """Attitude and clock of an IMU, whose device gives an attitude of its own, from positions (m)
    in a level world.

    The device's attitude treats part of each stride's acceleration as gravity, which gives up to 6°
    of tilt, and its yaw drifts. Over minutes, however, it finds the gyro's bias in tilt from
    gravity. Raises `TooLittle` if both share less than 20 s.
    """
    imu = sort_streams(imu)
    rows, _ = in_order(track.time, track.values, track.source)
    stamps, values = track.time[rows], track.values[rows]
    assert imu.device is not None
    streams = (imu.gyro, imu.accel, imu.device)
    check_lengths(SHORTEST_OVERLAP, *streams, track._replace(time=stamps))
    first, last = (
        max(stream.time[0] for stream in streams),
        min(stream.time[-1] for stream in streams),
    )
    if last - first < SHORTEST_OVERLAP:
        raise TooLittle(f"gyro, accelerometer and attitude share less than {SHORTEST_OVERLAP:g} s")
    clock = np.arange(first, last, 1.0 / RATE)
    gyro, accel = (
        interpolate_splines(stream.time, stream.values, clock, gaps(stream.time))
        for stream in streams[:2]
    )
    device = rotations(interpolate_attitudes(imu.device.time, imu.device.values, clock))

    grid = np.arange(stamps[0], stamps[-1], 1.0 / RATE)
    position = interpolate_splines(stamps, values, grid, gaps(stamps))
    present = covered_at(stamps, grid, longest_trusted(stamps))
    tracked = second_difference(position, 1.0 / RATE)
    # Accelerations beyond those of a pedestrian are jumps.
    strength = np.linalg.norm(smooth(tracked, STEP_FILTER_SECONDS * RATE), axis=1)
    usual = float(np.median(strength[present])) if present.any() else 0.0
    jumps = strength > 8.0 * max(usual, 0.1)
    good = ~within(~present | jumps, round(2 * SLOW_FILTER_SECONDS * RATE))
    signals = _Signals(clock, device.apply(accel) - UPWARD, grid, tracked, good)
    lag, correlation, runner_up = _constant_lag(signals)

    integrated = integrate_gyro(gyro - _gyro_bias(gyro, device), 1.0 / RATE)
    knots = uniform_knots(clock, TURN_KNOT_SECONDS)
    # The device's attitude about each knot, turned to the tracker's yaw, is the first guess.
    drifting = device * integrated.inv()
    at_knots = [drifting[np.abs(clock - knot) <= 1.0].mean() for knot in knots]
    yaw = _yaw(signals, knots, lag)
    guess = about_z(yaw) * Rotation.concatenate(at_knots)
    lag_knots = uniform_knots(clock, LAG_KNOT_SECONDS)
    lags = np.full(len(lag_knots), lag)
    correction, lags = _fit(signals, accel, integrated, knots, guess, lags)

    attitude = slerp(clock, knots, correction) * integrated
    tracker_time = clock - np.interp(clock, lag_knots, lags)
    shared = np.flatnonzero((tracker_time >= grid[0]) & (tracker_time <= grid[-1]))
    smoothed, velocity, used = smooth_positions(
        interpolate_splines(grid, position, tracker_time[shared], gaps(grid)),
        np.interp(tracker_time[shared], grid, (present & ~jumps).astype(float)) > 0.99,
        1.0 / RATE,
        CUTOFF,
    )
    rows = shared[used]
    poses = Poses(clock[rows], attitude[rows], smoothed[used], velocity[used], source=track.source)
    return PositionsFit(lags, float(np.ptp(yaw)), correlation, runner_up, poses)


def _gyro_bias(gyro: Float[np.ndarray, "n 3"], device: Rotation) -> Float[np.ndarray, "3"]:
    """Mean rate of the gyro minus that of the device's attitude, rad/s, without a constant drift
    about the vertical, which is an error of the device."""
    beyond = midpoints(gyro) - turns_between(device) * RATE
    up = device[:-1].inv().apply([0.0, 0.0, 1.0])
    system = len(up) * np.eye(4)
    system[:3, 3] = system[3, :3] = up.sum(axis=0)
    right = np.append(beyond.sum(axis=0), (beyond * up).sum())
    return np.linalg.lstsq(system, right, rcond=1e-6)[0][:3]


def _constant_lag(signals: _Signals) -> tuple[float, float, float]:
    """The best constant lag, the correlation of the vertical accelerations at it, and its
    unexplained share over that of the next best peak."""
    from scipy.signal import find_peaks  # takes half a second to import

    signals = signals.low_pass(STEP_FILTER_SECONDS)
    stretch = np.floor((signals.grid - signals.grid[0]) / STRETCH_SECONDS).astype(int)

    def correlate_at(lag: float) -> tuple[float, float]:
        """Correlations of the vertical accelerations, and of the horizontal ones for any yaw of
        each stretch (the mean square, by the time that both share)."""
        rows, inertial, tracked = signals.overlap_at(lag)
        if len(rows) < SHORTEST_OVERLAP * RATE:
            return 0.0, 0.0
        powers = ((inertial[:, :2] ** 2).sum(axis=1), (tracked[:, :2] ** 2).sum(axis=1))
        along, across, inertial_power, tracked_power = (
            np.bincount(stretch[rows], values)
            for values in (*_dot_and_cross(inertial, tracked), *powers)
        )
        level = (along**2 + across**2) / np.maximum(inertial_power * tracked_power, 1e-12)
        up, risen = (
            acceleration[:, 2] - acceleration[:, 2].mean() for acceleration in (inertial, tracked)
        )
        vertical = float(up @ risen / max(np.linalg.norm(up) * np.linalg.norm(risen), 1e-12))
        return vertical, float(np.average(level, weights=np.bincount(stretch[rows]) + 1e-9))

    most = round(SEARCH_SECONDS / LAG_STEP)
    lags = np.arange(-most, most + 1) * LAG_STEP
    correlations = np.array([correlate_at(lag) for lag in lags])
    if not correlations.any():
        problem = f"less than {SHORTEST_OVERLAP:g} s of moving positions overlap the IMU's samples"
        raise TooLittle(problem)
    # A negative correlation explains nothing.
    explained = 0.5 * (np.maximum(correlations[:, 0], 0.0) ** 2 + correlations[:, 1])
    best = int(np.argmax(explained))
    peaks, _ = find_peaks(np.pad(explained, 1, constant_values=-np.inf))
    others = [explained[i] for i in peaks - 1 if abs(lags[i] - lags[best]) > SAME_LAG]
    runner_up = (1.0 - explained[best]) / (1.0 - max(others)) if others else 0.0
    return float(lags[best]), float(correlations[best, 0]), float(runner_up)


def _dot_and_cross(inertial: np.ndarray, tracked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal dot and cross product of each row."""
    along = (inertial[:, :2] * tracked[:, :2]).sum(axis=1)
    return along, inertial[:, 0] * tracked[:, 1] - inertial[:, 1] * tracked[:, 0]


def _yaw(signals: _Signals, knots: Float[np.ndarray, " k"], lag: float) -> Float[np.ndarray, " k"]:
    """Yaw (rad) from the device's world to the tracker's about each knot, by the slow horizontal
    accelerations of one and a half stretches to either side."""
    rows, inertial, tracked = signals.low_pass(SLOW_FILTER_SECONDS).overlap_at(lag)
    near = np.abs(signals.grid[rows, None] + lag - knots) < 1.5 * STRETCH_SECONDS
    along, across = _dot_and_cross(inertial, tracked)
    observed = near.any(axis=0)  # in a gap of the tracker the yaw is unknown
    yaw = np.unwrap(np.arctan2(across @ near, along @ near)[observed])
    return np.interp(knots, knots[observed], yaw)


def _fit(
    signals: _Signals,
    accel: Float[np.ndarray, "n 3"],
    integrated: Rotation,
    knots: Float[np.ndarray, " k"],
    correction: Rotation,
    lags: Float[np.ndarray, " l"],
) -> tuple[Rotation, Float[np.ndarray, " l"]]:
    """The corrections of the integrated gyro at the knots, and the lags at their knots, that align
    the accelerations, from a first guess.

    The vertical accelerations of the steps, by the device's own attitude, determine the lag; the
    slow ones, in all axes, determine the attitude.
    """
    clock, count = signals.clock, len(knots)
    tracker_time = clock - lags.mean()
    inside = (tracker_time > signals.grid[0] + 1.0) & (tracker_time < signals.grid[-1] - 1.0)
    usable = inside & (np.interp(tracker_time, signals.grid, signals.good.astype(float)) > 0.99)
    step, slow = STEP_FILTER_SECONDS * RATE, SLOW_FILTER_SECONDS * RATE
    rises = CubicSpline(signals.grid, smooth(signals.tracked[:, 2], step))
    tracked = CubicSpline(signals.grid, smooth(signals.tracked, slow), axis=0)
    at_steps, at_slow = (np.flatnonzero(usable)[:: round(sigma)] for sigma in (step, slow))
    inertial_rises = smooth(signals.inertial[:, 2], step)[at_steps]
    lag_knots = uniform_knots(clock, LAG_KNOT_SECONDS)
    step_hats, slow_hats = (hat_functions(clock[rows], lag_knots) for rows in (at_steps, at_slow))
    turn_hats = hat_functions(clock[at_slow], knots)

    def improve(
        correction: Rotation, lags: Float[np.ndarray, " l"]
    ) -> tuple[Rotation, Float[np.ndarray, " l"]]:
        turned = (slerp(clock, knots, correction) * integrated).apply(accel)
        force = smooth(turned, slow)[at_slow]

        def errors(change: Float[np.ndarray, " u"]) -> list[np.ndarray]:
            turns, lag = change[: 3 * count].reshape(count, 3), lags + change[3 * count :]
            inertial = Rotation.from_rotvec(turn_hats @ turns).apply(force) - UPWARD
            of_steps = rises(clock[at_steps] - step_hats @ lag) - inertial_rises
            return [of_steps, tracked(clock[at_slow] - slow_hats @ lag) - inertial]

        start = np.zeros(3 * count + len(lags))
        scales = [max(robust_std(error), 1e-3) for error in errors(start)]

        def residuals(change: Float[np.ndarray, " u"]) -> Float[np.ndarray, " r"]:
            # Neighbouring rows are correlated by the filter.
            parts = [(e / s).ravel() / 1.6 for e, s in zip(errors(change), scales, strict=True)]
            corrections = Rotation.from_rotvec(change[: 3 * count].reshape(count, 3)) * correction
            drift = (
                np.diff((corrections[1:] * corrections[:-1].inv()).as_rotvec(), axis=0) / DRIFT_STD
            )
            bends = np.diff(lags + change[3 * count :], 2) / LAG_BEND_STD
            return np.concatenate([*parts, drift.ravel(), bends])

        reach = np.repeat(STEPS, [3 * count, len(lags)])
        change = least_squares(
            residuals, start, loss="cauchy", f_scale=2.0, x_scale=reach, ftol=1e-4, max_nfev=20
        ).x
        turns = Rotation.from_rotvec(change[: 3 * count].reshape(count, 3))
        return turns * correction, lags + change[3 * count :]

    for _ in range(3):
        correction, lags = improve(correction, lags)
    return correction, lags
