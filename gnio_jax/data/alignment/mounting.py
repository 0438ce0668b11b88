"""How an IMU is mounted on a tracked body: the best of several fits, and how good it is."""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment.fit import SHORTEST_OVERLAP, Fit, fit, imu_samples
from gnio_jax.data.alignment.lag import SAME_LAG, ranked_lags, refined_lag, unexplained
from gnio_jax.data.alignment.signals import smooth, uniform_knots
from gnio_jax.data.alignment.track import FILTER_SECONDS, TooLittle, Track, TrackMotion, motion
from gnio_jax.numerics import levelling, robust_std

FITS = 4
"""Peaks of the correlation from which a fit starts."""

COARSE_KNOT_SECONDS = 30.0
"""Spacing of the lag's knots in these fits."""

FIRST_ITERATIONS = 8
"""Of these fits; the best one is then repeated to its end, with all its knots."""


class Alignment(NamedTuple):
    """What `align` estimates; SI units."""

    extrinsic: Rotation
    """IMU → marker body."""
    lever: Float[np.ndarray, "3"]
    """From the marker body's origin to the IMU, in the marker body, m."""
    up: Float[np.ndarray, "3"]
    """Unit vector against gravity in the tracker's world."""
    gyro_bias: Float[np.ndarray, "3"]
    accel_bias: Float[np.ndarray, "3"]
    knots: Float[np.ndarray, " k"]
    """Knots of the lag on the tracker's clock, s."""
    lag: Float[np.ndarray, " k"]
    """Time of the IMU minus time of the tracker for the same event, at the knots, s."""
    accel_delay: float
    """How much later than the gyro the accelerometer tells of the same event, s."""
    gyro_residual: float
    """Robust standard deviation of the filtered angular rate's residual, rad/s."""
    accel_residual: float
    """Robust standard deviation of the filtered acceleration's residual, m/s²."""
    gyro_unexplained: float
    """Power of the filtered angular rate's residual over that of the tracker's angular rate; 0 is a
    perfect fit, 1 explains nothing."""
    accel_unexplained: float
    """The same of the acceleration, gravity apart."""
    runner_up: float
    """What this fit leaves unexplained over what the best fit with another lag does; 0 where there
    is no other, 1 where both are as good."""
    mismatch: Bool[np.ndarray, " n"]
    """Samples of the track whose acceleration contradicts the IMU grossly: the tracker jumped."""

    @property
    def unexplained(self) -> float:
        """Geometric mean of both shares: with noise of unknown size the least is likeliest."""
        return float(np.sqrt(self.gyro_unexplained * self.accel_unexplained))

    def track_time(self, imu_time: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        """Tracker's time of the events that the IMU stamped `imu_time`."""
        imu_knots = self.knots + self.lag
        # np.interp holds the ends; here the slopes of the outer intervals go on.
        inner = np.interp(imu_time, imu_knots, self.knots)
        before, after = imu_time < imu_knots[0], imu_time > imu_knots[-1]
        inner = np.where(before, self.knots[0] + imu_time - imu_knots[0], inner)
        return np.where(after, self.knots[-1] + imu_time - imu_knots[-1], inner)

    def levelling(self) -> Rotation:
        """The smallest rotation that turns `up` onto z: tracker's world → level world."""
        return levelling(self.up)


def align(
    time: Float[np.ndarray, " m"],
    gyro: Float[np.ndarray, "m 3"],
    accel: Float[np.ndarray, "m 3"],
    track: Track,
    knot_seconds: float = 30.0,
    search_seconds: float = 5.0,
    iterations: int = 12,
) -> Alignment:
    """Estimate extrinsic rotation, lever arm, gravity, biases and lag (the room's docstring).

    `time` s is the IMU's uniform clock, `gyro` rad/s, `accel` m/s² specific force. `knot_seconds`
    is the spacing of the lag's knots, `search_seconds` bounds its first guesses. Raises `TooLittle`
    when too little of the track is usable. Whether the best fit is a good one is the caller's to
    judge, by `gyro_unexplained`, `accel_unexplained` and `runner_up`.
    """
    imu, moved = imu_samples(time, gyro, accel), motion(track)
    rate = smooth(gyro, FILTER_SECONDS / float(np.median(np.diff(time))))
    coarse = uniform_knots(track.time, COARSE_KNOT_SECONDS)
    candidates = []
    for guess in ranked_lags(moved, time, rate, search_seconds)[:FITS]:
        lag = refined_lag(moved, time, rate, coarse, guess)
        with suppress(TooLittle):
            found = fit(imu, moved, coarse, lag, FIRST_ITERATIONS)
            candidates.append(_alignment(found, moved, coarse))
    if not candidates:
        raise TooLittle(f"less than {SHORTEST_OVERLAP:g} s of the track overlap the IMU's samples")
    best = min(candidates, key=lambda candidate: candidate.unexplained)
    knots = uniform_knots(track.time, knot_seconds)
    final = fit(imu, moved, knots, np.interp(knots, coarse, best.lag), iterations)
    return _alignment(final, moved, knots)._replace(runner_up=_runner_up(best, candidates))


def _runner_up(best: Alignment, candidates: list[Alignment]) -> float:
    """What the best fit leaves unexplained over what the next best at another lag does."""
    others = [
        other.unexplained
        for other in candidates
        if abs(float(np.mean(other.lag - best.lag))) > SAME_LAG
    ]
    return best.unexplained / min(others) if others else 0.0


def _alignment(found: Fit, track: TrackMotion, knots: Float[np.ndarray, " k"]) -> Alignment:
    """A fit with the figures by which it is judged; `runner_up` is left at 0."""
    unknowns, residuals, usable = found.unknowns, found.residuals, found.residuals.usable
    limit = max(6.0, 8.0 * found.accel_scale)
    return Alignment(
        extrinsic=unknowns.extrinsic,
        lever=unknowns.lever,
        up=unknowns.up,
        gyro_bias=unknowns.gyro_bias,
        accel_bias=unknowns.accel_bias,
        knots=knots,
        lag=unknowns.lag,
        accel_delay=unknowns.accel_delay,
        gyro_residual=robust_std(residuals.gyro[usable]),
        accel_residual=robust_std(residuals.accel[usable]),
        gyro_unexplained=unexplained(residuals.gyro[usable], track.rate[usable]),
        accel_unexplained=unexplained(residuals.accel[usable], track.acceleration[usable]),
        runner_up=0.0,
        mismatch=usable & (np.linalg.norm(residuals.accel, axis=1) > limit),
    )
