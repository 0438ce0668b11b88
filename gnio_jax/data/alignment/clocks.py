"""By how much poses are stamped later than the IMU's samples, where both are of one body."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment.signals import smooth
from gnio_jax.numerics import interpolate, midpoints, robust_std, turns_between

RATE = 100.0
"""Hz of the clock on which both are compared."""
FILTER_SECONDS = 0.05
"""Standard deviation of the Gaussian that both angular rates pass."""
LONGEST_INTERVAL = 2.5 / RATE
"""s between poses whose difference tells an angular rate."""
MAX_LAG = 0.4
"""s, to either side."""


class PoseLag(NamedTuple):
    """What `pose_lag` estimates."""

    lag: float
    """By how much a pose is stamped later than the IMU's sample of the same event, s."""
    correlation: float
    """Of the angular rates once the lag is taken out, all axes together; 1 where nothing turns and
    nothing can be told."""


def pose_lag(
    time: Float[np.ndarray, " n"],
    gyro: Float[np.ndarray, "n 3"],
    stamps: Float[np.ndarray, " m"],
    attitude: Rotation,
) -> PoseLag:
    """By how much the poses are late, from the angular rates of both in the same body.

    `time`, `stamps` s; `gyro` rad/s; `attitude` m rotations body→world. The lag that lets gyro(t) −
    bias and rate(t + lag) differ least, in a robust sense, both smoothed over 0.05 s (σ); among
    multiples of 10 ms first, then by Gauss-Newton.
    """
    steps = np.diff(stamps)
    turning = turns_between(attitude) / steps[:, None]
    middle, near = midpoints(stamps), steps <= LONGEST_INTERVAL
    clock = np.arange(max(time[0], middle[0]), min(time[-1], middle[-1]), 1.0 / RATE)
    sigma = FILTER_SECONDS * RATE
    felt = smooth(interpolate(clock, time, gyro), sigma)
    tracked = smooth(interpolate(clock, middle[near], turning[near]), sigma)
    margin = MAX_LAG + 0.1
    inner = clock[(clock > clock[0] + margin) & (clock < clock[-1] - margin)]
    felt = interpolate(inner, clock, felt)
    if len(inner) < 5 * RATE or _typical_turn(felt) < 0.02:
        return PoseLag(0.0, 1.0)
    rate = CubicSpline(clock, tracked, axis=0)
    lag = _best_lag(inner, felt, rate)
    return PoseLag(lag, _correlation(felt, rate(inner + lag)))


def _typical_turn(rate: Float[np.ndarray, "n 3"]) -> float:
    """rad/s"""
    return float(np.median(np.linalg.norm(rate - np.median(rate, axis=0), axis=1)))


def _best_lag(
    time: Float[np.ndarray, " n"],
    felt: Float[np.ndarray, "n 3"],
    rate: CubicSpline,
) -> float:
    """The lag (s) at which rate(time + lag) differs least from `felt`, but for a constant."""
    slope = rate.derivative()

    def difference(lag: float) -> np.ndarray:
        error = felt - rate(time + lag)
        return error - np.median(error, axis=0)

    hundredths = round(MAX_LAG * 100)
    candidates = np.arange(-hundredths, hundredths + 1) / 100.0
    lag = float(min(candidates, key=lambda lag: np.abs(difference(lag)).mean()))
    for _ in range(8):
        error, gradient = difference(lag), slope(time + lag)
        scale = max(3.0 * robust_std(error), 1e-6)
        weight = 1.0 / (1.0 + (error / scale) ** 2)
        change = float((weight * gradient * error).sum() / max((weight * gradient**2).sum(), 1e-12))
        lag = float(np.clip(lag + np.clip(change, -0.02, 0.02), -MAX_LAG - 0.05, MAX_LAG + 0.05))
    return lag


def _correlation(first: Float[np.ndarray, "n 3"], second: Float[np.ndarray, "n 3"]) -> float:
    """Of all axes together, each about its mean."""
    first, second = first - first.mean(axis=0), second - second.mean(axis=0)
    return float((first * second).sum() / np.sqrt((first**2).sum() * (second**2).sum()))
