"""First guesses of the lag between an IMU and a tracker, from their angular rates.

The magnitudes of the angular rates need no extrinsic rotation. Their cross-correlation has a peak
at the lag; whoever walks in rounds or in figures of eight makes several, and the highest need not
be the right one. Wahba's problem on the angular rates ranks them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment.signals import covered
from gnio_jax.data.alignment.track import FILTER_SECONDS, TrackMotion
from gnio_jax.numerics import interpolate

SAME_LAG = 0.15
"""s by which two fits may differ in lag and be one: less than half a step of a runner."""

TRUSTED_SHARE = 0.9
"""Share of the samples by whose residuals a fit is judged; the worst are the tracker's flips."""

FASTEST_TURN = 6.0
"""rad/s; flips of the tracker make rates that no hand makes, so rates are compared up to here."""

REFINED_WITHIN = 0.4
"""s around the common guess within which each stretch may have its own lag."""


def ranked_lags(
    track: TrackMotion,
    time: Float[np.ndarray, " m"],
    rate: Float[np.ndarray, "m 3"],
    search_seconds: float,
) -> list[float]:
    """Lags (s) at which both angular rates correlate, the most plausible first.

    `time` s and `rate` rad/s are the IMU's clock and its filtered angular rate.
    """
    peaks = _correlation_peaks(track, time, np.linalg.norm(rate, axis=1), search_seconds)
    return sorted(peaks, key=lambda lag: _unexplained_turning(track, time, rate, lag))


def _correlation_peaks(
    track: TrackMotion,
    time: Float[np.ndarray, " m"],
    magnitude: Float[np.ndarray, " m"],
    search_seconds: float,
) -> list[float]:
    """Lags (s) within ± `search_seconds` at which the magnitudes of the angular rates correlate
    better than nearby."""
    # It takes half a second to import.
    from scipy.signal import correlate, correlation_lags, find_peaks

    of_track = np.where(track.unreliable, 0.0, np.linalg.norm(track.rate, axis=1))
    step = track.step
    start = min(track.time[0], time[0])
    grid = np.arange(start, max(track.time[-1], time[-1]) + step, step)
    first, second = (
        np.interp(grid, clock, np.minimum(values, FASTEST_TURN), left=0.0, right=0.0)
        for clock, values in ((track.time, of_track), (time, magnitude))
    )
    first, second = first - first.mean(), second - second.mean()
    score = correlate(second, first, method="fft")
    lags = correlation_lags(len(second), len(first)) * step
    near = np.abs(lags) <= search_seconds
    # A peak may lie at the end of the search.
    padded = np.pad(score[near], 1, constant_values=-np.inf)
    peaks, _ = find_peaks(padded, distance=max(round(SAME_LAG / step), 1))
    return [float(lags[near][index]) for index in peaks - 1]


def _unexplained_turning(
    track: TrackMotion, time: Float[np.ndarray, " m"], rate: Float[np.ndarray, "m 3"], lag: float
) -> float:
    """Share of the tracker's angular rate that the IMU's does not explain at a constant lag, after
    the rotation that explains most; infinite where too little overlaps."""
    rows = np.arange(0, len(track.time), max(int(track.sigma), 1))
    inside = covered(track.time[rows] + lag, time, margin=4 * FILTER_SECONDS)
    rows = rows[~track.unreliable[rows] & inside]
    if len(rows) < 10:
        return np.inf
    there, seen = interpolate(track.time[rows] + lag, time, rate), track.rate[rows]
    return unexplained(seen - Rotation.align_vectors(seen, there)[0].apply(there), seen)


def refined_lag(
    track: TrackMotion,
    time: Float[np.ndarray, " m"],
    rate: Float[np.ndarray, "m 3"],
    knots: Float[np.ndarray, " k"],
    guess: float,
) -> Float[np.ndarray, " k"]:
    """Lag (s) at each knot from the ± 15 s around it, near the common guess: some phones' clocks
    drift. A quiet stretch keeps the guess."""
    magnitude = np.linalg.norm(rate, axis=1)
    of_track = np.minimum(np.linalg.norm(track.rate, axis=1), FASTEST_TURN)
    hundredths = round(REFINED_WITHIN / 0.01)
    offsets = np.arange(-hundredths, hundredths + 1) * 0.01
    lag = np.full(len(knots), guess)
    for j, knot in enumerate(knots):
        rows = np.flatnonzero((np.abs(track.time - knot) < 15.0) & ~track.unreliable)
        if len(rows) * track.step < 5.0:
            continue
        there, seen = track.time[rows] + guess, of_track[rows]
        if seen.std() < 0.05 or not covered(there, time, margin=1.0).all():
            continue
        score = [
            np.corrcoef(seen, np.interp(there + offset, time, magnitude))[0, 1]
            for offset in offsets
        ]
        if max(score) > 0.6:
            lag[j] = guess + offsets[int(np.argmax(score))]
    return _median_of_three(lag) if len(lag) >= 3 else lag


def _median_of_three(values: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """One wild knot among agreeing neighbours is a quiet stretch, not a clock."""
    padded = np.concatenate([values[:1], values, values[-1:]])
    return np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0)


def unexplained(error: Float[np.ndarray, "n 3"], signal: Float[np.ndarray, "n 3"]) -> float:
    """Power of the errors over that of the signal, on the `TRUSTED_SHARE` of the rows with the
    smallest errors."""
    square = (error**2).sum(axis=1)
    trusted = square <= np.quantile(square, TRUSTED_SHARE)
    return float(max(square[trusted].sum(), 1e-12) / max((signal[trusted] ** 2).sum(), 1e-12))
