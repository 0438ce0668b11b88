"""Lag and heading of an IMU against tracked positions, where the tracker's attitude says nothing of
the IMU's.

Horizontal accelerations are complex numbers here, x + i y: a difference in yaw is a factor
exp(i yaw), and the magnitude of their correlation over a stretch tells the lag whatever the yaw.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from gnio_jax.data.alignment.lag import SAME_LAG
from gnio_jax.data.alignment.signals import (
    bending,
    hat_functions,
    second_difference,
    smooth,
    uniform_knots,
)
from gnio_jax.numerics import robust_std, within

STRETCH_SECONDS = 15.0
"""Length of the stretches whose correlations are compared: in it the yaw hardly drifts."""
KNOT_SECONDS = 30.0
"""Spacing of the knots of lag and yaw."""
LAG_STEP = 0.02
"""s between the constant lags that are tried."""
ITERATIONS = 15
"""Of the fit that follows."""
YAW_BEND_STD, LAG_BEND_STD = np.radians(5.0), 0.02
"""rad and s: second differences from knot to knot of a yaw that drifts slowly, and of clocks that
run straight."""
LARGEST_YAW_STEP, LARGEST_LAG_STEP = 0.3, 0.03
"""rad and s per iteration."""


class Heading(NamedTuple):
    """What `align_heading` estimates; SI units."""

    knots: Float[np.ndarray, " k"]
    """On the tracker's clock, s."""
    lag: Float[np.ndarray, " k"]
    """Time of the IMU minus time of the tracker for the same event, at the knots, s."""
    yaw: Float[np.ndarray, " k"]
    """To be added to the IMU's heading, at the knots, rad."""
    correlation: float
    """Median over stretches of the correlation of the horizontal accelerations."""
    runner_up: float
    """What the best constant lag leaves unexplained over what the second best does; 1 where both
    are as good."""


class _Accelerations(NamedTuple):
    """Filtered horizontal accelerations of both."""

    track_time: Float[np.ndarray, " n"]
    """s, on the tracker's clock."""
    tracked: Complex[np.ndarray, " n"]
    """By the second difference of the positions, m/s²."""
    usable: Bool[np.ndarray, " n"]
    """False near positions that are not good, and where the tracker relocalised."""
    stretch: Int[np.ndarray, " n"]
    """Number of the stretch of `STRETCH_SECONDS` that each sample is in."""
    sigma: float
    """Standard deviation of the filter, samples of the tracker."""
    time: Float[np.ndarray, " m"]
    """s, on the IMU's clock."""
    felt: Complex[np.ndarray, " m"]
    """By the IMU, in a level frame of its own, m/s²."""
    slope: Complex[np.ndarray, " m"]
    """Time derivative of `felt`, m/s³."""

    def usable_at(self, there: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Usable samples of the tracker whose times on the IMU's clock, `there`, it covers."""
        return self.usable & (there > self.time[0]) & (there < self.time[-1])


def align_heading(
    time: Float[np.ndarray, " m"],
    acceleration: Float[np.ndarray, "m 2"],
    track_time: Float[np.ndarray, " n"],
    position: Float[np.ndarray, "n 3"],
    good: Bool[np.ndarray, " n"],
    search_seconds: float = 4.0,
    filter_seconds: float = 0.08,
) -> Heading:
    """Lag and heading that lay an IMU's horizontal acceleration on that of tracked positions.

    `acceleration` m/s² is the IMU's in a level frame of its own whose yaw is arbitrary and drifts
    slowly; `position` m and `good` are on the uniform clock `track_time` (s). Lag and yaw are
    piecewise linear with a knot per 30 s. Raises `ValueError` when there are less than 30 s.
    """
    signals = _accelerations(time, acceleration, track_time, position, good, filter_seconds)
    if signals.stretch.max() < 2:
        raise ValueError("less than 30 s to align")
    knots = uniform_knots(track_time, KNOT_SECONDS)
    hats = hat_functions(track_time, knots)
    constant, runner_up = _constant_lag(signals, search_seconds)
    lag = np.full(len(knots), constant)
    yaw = _first_yaw(signals, knots, track_time + hats @ lag)
    for _ in range(ITERATIONS):
        yaw_change, lag_change = _step(signals, hats, yaw, lag)
        yaw = yaw + np.clip(yaw_change, -LARGEST_YAW_STEP, LARGEST_YAW_STEP)
        lag = lag + np.clip(lag_change, -LARGEST_LAG_STEP, LARGEST_LAG_STEP)
    cross, power = _correlation(signals, track_time + hats @ lag)
    return Heading(knots, lag, yaw, float(np.median(np.abs(cross / power))), runner_up)


def _accelerations(
    time: Float[np.ndarray, " m"],
    acceleration: Float[np.ndarray, "m 2"],
    track_time: Float[np.ndarray, " n"],
    position: Float[np.ndarray, "n 3"],
    good: Bool[np.ndarray, " n"],
    filter_seconds: float,
) -> _Accelerations:
    step = float(np.median(np.diff(track_time)))
    sigma = filter_seconds / step
    tracked = _complex(smooth(second_difference(position[:, :2], step), sigma))
    # A tracker that relocalises makes accelerations that no pedestrian makes.
    plausible = np.abs(tracked) < 8.0 * max(float(np.median(np.abs(tracked))), 0.1)
    felt = _complex(smooth(acceleration, filter_seconds / float(np.median(np.diff(time)))))
    return _Accelerations(
        track_time=track_time,
        tracked=tracked,
        usable=~within(~good, int(np.ceil(2 * sigma))) & plausible,
        stretch=np.floor((track_time - track_time[0]) / STRETCH_SECONDS).astype(int),
        sigma=sigma,
        time=time,
        felt=felt,
        slope=np.gradient(felt, time),
    )


def _complex(horizontal: Float[np.ndarray, "n 2"]) -> Complex[np.ndarray, " n"]:
    return horizontal[:, 0] + 1j * horizontal[:, 1]


def _correlation(
    signals: _Accelerations, there: Float[np.ndarray, " n"]
) -> tuple[Complex[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    """Σ conj(felt) tracked of each stretch, whose angle is the yaw between them, and √(Σ|felt|²
    Σ|tracked|²). `there` is the tracker's clock as the IMU's stamps have it."""
    inside = signals.usable_at(there)
    felt = np.interp(there, signals.time, signals.felt) * inside
    both = np.conj(felt) * signals.tracked

    def sums(values: np.ndarray) -> np.ndarray:
        return np.bincount(signals.stretch, values)

    cross = sums(np.real(both)) + 1j * sums(np.imag(both))
    power = sums(np.abs(felt) ** 2) * sums(np.abs(signals.tracked * inside) ** 2)
    return cross, np.sqrt(power) + 1e-9


def _constant_lag(signals: _Accelerations, search_seconds: float) -> tuple[float, float]:
    """The constant lag (s) at which the accelerations correlate best, and what it leaves
    unexplained over what the next best peak leaves."""
    from scipy.signal import find_peaks  # takes half a second to import

    most = round(search_seconds / LAG_STEP)
    lags = np.arange(-most, most + 1) * LAG_STEP
    scores = []
    for lag in lags:
        cross, power = _correlation(signals, signals.track_time + lag)
        scores.append(float(np.mean(np.abs(cross / power) ** 2)))
    best = int(np.argmax(scores))
    peaks, _ = find_peaks(np.pad(scores, 1, constant_values=-np.inf))
    others = [scores[i] for i in peaks - 1 if abs(lags[i] - lags[best]) > SAME_LAG]
    runner_up = (1.0 - scores[best]) / (1.0 - max(others)) if others else 0.0
    return float(lags[best]), runner_up


def _first_yaw(
    signals: _Accelerations, knots: Float[np.ndarray, " k"], there: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " k"]:
    """Yaw (rad) at the knots by the angles of the correlation. The mean of neighbouring stretches
    starts the fit on the right turn."""
    cross, _ = _correlation(signals, there)
    numbers = range(signals.stretch.max() + 1)
    centres = np.array([signals.track_time[signals.stretch == j].mean() for j in numbers])
    angles = np.unwrap(np.angle(np.convolve(cross, np.ones(3), mode="same")))
    return np.interp(knots, centres, angles)


def _step(
    signals: _Accelerations,
    hats: Float[np.ndarray, "n k"],
    yaw: Float[np.ndarray, " k"],
    lag: Float[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """One Gauss-Newton step of yaw (rad) and lag (s), robust against relocalisations."""
    there = signals.track_time + hats @ lag
    inside = signals.usable_at(there)
    turn = np.exp(1j * (hats @ yaw))
    turned = turn * np.interp(there, signals.time, signals.felt)
    turned_slope = turn * np.interp(there, signals.time, signals.slope)
    error = (signals.tracked - turned)[inside]
    scale = max(robust_std(np.stack([error.real, error.imag])), 1e-3)
    weight = 1.0 / scale**2 / (1.0 + (np.abs(error) / (2.0 * scale)) ** 2)
    weight = weight / max(2.5 * signals.sigma, 1.0)  # one independent row per filter length
    by_yaw = 1j * turned[inside, None] * hats[inside]
    by_lag = turned_slope[inside, None] * hats[inside]
    jacobian = -np.concatenate([by_yaw, by_lag], axis=1)
    normal = np.einsum("ni,n,nj->ij", jacobian.conj(), weight, jacobian, optimize=True).real
    gradient = np.einsum("ni,n,n->i", jacobian.conj(), weight, error, optimize=True).real

    count = len(yaw)
    for columns, values, spread in (
        (slice(0, count), yaw, YAW_BEND_STD),
        (slice(count, None), lag, LAG_BEND_STD),
    ):
        stiffness = bending(count, spread)
        normal[columns, columns] += stiffness + 1e-6 * np.eye(count)
        gradient[columns] += stiffness @ values
    yaw_change, lag_change = np.split(-np.linalg.solve(normal, gradient), 2)
    return yaw_change, lag_change
