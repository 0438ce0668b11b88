"""What the fits share: filters, piecewise linear functions of time, robust weights."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d


def smooth(values: np.ndarray, sigma: float) -> np.ndarray:
    """Rows filtered by a Gaussian of `sigma` samples; the ends are held."""
    return gaussian_filter1d(values, sigma, axis=0, mode="nearest")


def second_difference(values: Float[np.ndarray, "n *w"], step: float) -> Float[np.ndarray, "n *w"]:
    """Second derivative of uniform samples by central differences; the ends repeat their
    neighbours.

    It is zero to the last bit of a constant, unlike a sampled derivative of a Gaussian.
    """
    inner = (values[2:] - 2.0 * values[1:-1] + values[:-2]) / step**2
    return np.concatenate([inner[:1], inner, inner[-1:]])


def covered(
    time: Float[np.ndarray, " m"], clock: Float[np.ndarray, " n"], margin: float
) -> Bool[np.ndarray, " m"]:
    """Which times lie within a clock, and `margin` (s) away from its ends."""
    return (time > clock[0] + margin) & (time < clock[-1] - margin)


def uniform_knots(time: Float[np.ndarray, " n"], spacing: float) -> Float[np.ndarray, " k"]:
    """Knots over a clock, evenly spaced by at most `spacing` (s)."""
    intervals = max(int(np.ceil((time[-1] - time[0]) / spacing)), 1)
    return np.linspace(time[0], time[-1], intervals + 1)


def hat_functions(
    time: Float[np.ndarray, " n"], knots: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "n k"]:
    """Basis of piecewise linear functions of time: each is 1 at one knot and 0 at the others."""
    return np.clip(1.0 - np.abs((time[:, None] - knots) / (knots[1] - knots[0])), 0.0, 1.0)


def bending(count: int, spread: float) -> Float[np.ndarray, "k k"]:
    """Precision of a prior by which the slope of a piecewise linear function of `count` knots
    changes little: second differences of its values have the standard deviation `spread`."""
    differences = np.diff(np.eye(count), 2, axis=0) / spread
    return differences.T @ differences


def cauchy_weights(error: Float[np.ndarray, "n w"], scale: float) -> Float[np.ndarray, " n"]:
    """Weights 1/scale² that fall with the squared length of each row, so that a flip counts for
    nothing."""
    return 1.0 / scale**2 / (1.0 + (error**2).sum(axis=1) / (3.0 * scale) ** 2)
