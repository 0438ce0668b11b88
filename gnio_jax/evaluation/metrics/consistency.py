"""Whether a filter's errors are as large as it says they are: NEES, NIS, coverage."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import gammaincinv

from gnio_jax.evaluation.metrics.heading import relative_yaw
from gnio_jax.evaluation.metrics.trajectory import Trajectory, Undefined
from gnio_jax.numerics import finite_rows, rotation_z

COVERAGES = frozenset({"nees_coverage", "nees_coverage_2d", "nis_coverage"})
"""Metrics that are small when they are bad: 0 for an estimate that diverged."""


def normalised_squared(
    error: Float[np.ndarray, "n d"], covariance: Float[np.ndarray, "n d d"]
) -> Float[np.ndarray, "n"]:
    """eᵀ P⁻¹ e of each row, infinite where P is not finite and positive definite.

    Such a P claims to know some direction exactly, which no error agrees with. It is judged to the
    rounding of float64, after scaling to unit variances, so that units do not matter (ours).
    """
    variance = np.einsum("nii->ni", covariance)
    sound = np.isfinite(covariance).all((1, 2)) & (variance > 0).all(1)
    std = np.sqrt(variance[sound])
    value, vector = np.linalg.eigh(covariance[sound] / (std[:, :, None] * std[:, None, :]))
    definite = value[:, 0] > value.shape[1] * np.finfo(float).eps * value[:, -1]
    projected = np.einsum("nji,nj->ni", vector, error[sound] / std)
    squared = np.full(len(error), np.inf)
    value = np.where(definite[:, None], value, 1.0)
    squared[sound] = np.where(definite, (projected**2 / value).sum(1), np.inf)
    return squared


def position_nees(
    aligned: Trajectory,
    estimate: Trajectory,
    reference: Trajectory,
    covariance: Float[np.ndarray, "n 3 3"],
    dims: int = 3,
) -> Float[np.ndarray, "n"]:
    """eᵀ P⁻¹ e of the position, NaN where there is no reference.

    e is the error of the start-aligned estimate, turned back into the filter's own frame, in which
    its covariance is. Infinite where the covariance is not finite and positive definite.
    """
    turn = rotation_z(relative_yaw(estimate.orientation[:1], aligned.orientation[:1])[0])
    error = (aligned.position - reference.position) @ turn.T
    variance = np.einsum("nii->ni", covariance)
    squared = np.full(len(error), np.nan)
    # A start given as exact has nothing to be normalised by.
    good = finite_rows(error) & (variance != 0).all(1)
    squared[good] = normalised_squared(error[good, :dims], covariance[good, :dims, :dims])
    return squared


def mean_normalised(squared: Float[np.ndarray, "n"], dims: int) -> float:
    """Mean of normalised squared errors over their expectation d: 1 is consistent, above it the
    filter is overconfident.

    With eᵀ P⁻¹ e of the position it is `nees`, with rᵀ S⁻¹ r of the measurements `nis`
    (Bar-Shalom). NaN counts nowhere.
    """
    return float(np.mean(_present(squared)) / dims)


def coverage(squared: Float[np.ndarray, "n"], dims: int, level: float = 0.95) -> float:
    """Share of rows whose normalised squared error lies inside the χ² region of probability
    `level`, %: 95 is consistent."""
    # The quantile of χ²; `scipy.stats` takes half a second to import.
    quantile = 2 * gammaincinv(dims / 2, level)
    return float(100 * np.mean(_present(squared) <= quantile))


def _present(squared: Float[np.ndarray, "n"]) -> Float[np.ndarray, "m"]:
    present = squared[~np.isnan(squared)]
    if not len(present):
        raise Undefined("no measurement or no trusted reference")
    return present
