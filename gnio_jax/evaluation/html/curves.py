"""What the page shows of one sequence: curves over time, thinned, in the reference's frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.frames import SIGMAS, in_the_references_frame
from gnio_jax.evaluation.trajectory import Alignment
from gnio_jax.numerics import finite_rows


class Ellipses(NamedTuple):
    """Contours of the horizontal position's covariance at `SIGMAS`, one for each row."""

    major: Float[np.ndarray, "k"]
    """Semi-axis, m."""
    minor: Float[np.ndarray, "k"]
    """Semi-axis, m."""
    angle: Float[np.ndarray, "k"]
    """Of the major axis, from x towards y, rad."""


class Curves(NamedTuple):
    """One sequence by one run. Every array has k rows; what is not known is NaN."""

    sequence: str
    time: Float[np.ndarray, "k"]
    """From the start, s."""
    position: Float[np.ndarray, "k 3"]
    """Of the estimate, aligned with the reference, m."""
    reference: Float[np.ndarray, "k 3"]
    """m."""
    error: Float[np.ndarray, "k"]
    """Horizontal distance of the estimate from the reference, m."""
    distance: Float[np.ndarray, "k"]
    """Walked until then by the reference; by the estimate where there is no reference, m."""
    ellipses: Ellipses
    gate: Float[np.ndarray, "k 3"]
    """Of the network, along the axes of the window's yaw frame."""
    scale: Float[np.ndarray, "k 3"]
    """Of the network."""
    std: Float[np.ndarray, "k 3"]
    """Standard deviation of the displacements, m."""
    nis: Float[np.ndarray, "k"]
    """Largest of the stretch that the row stands for."""


def curves(estimate: Estimate, alignment: Alignment, rows: int) -> Curves:
    """The curves of an estimate in at most `rows` rows, evenly spaced in time."""
    estimate = in_the_references_frame(estimate, alignment)
    path, reference = estimate.trajectory, estimate.reference.position
    length, step = len(path.time), -(-len(path.time) // rows)
    covariance = estimate.position_covariance
    if covariance is None:
        covariance = np.full((length, 3, 3), np.nan)

    def vectors(values: Float[np.ndarray, "n 3"] | None) -> Float[np.ndarray, "k 3"]:
        return (np.full((length, 3), np.nan) if values is None else values)[::step]

    return Curves(
        estimate.name,
        (path.time - path.time[0])[::step],
        path.position[::step],
        reference[::step],
        np.linalg.norm((path.position - reference)[:, :2], axis=1)[::step],
        walked(reference if np.isfinite(reference).any() else path.position, path.time)[::step],
        ellipses(covariance[::step, :2, :2]),
        vectors(estimate.diagnostics.get("gate")),
        vectors(estimate.diagnostics.get("scale")),
        vectors(estimate.displacement_std),
        _largest(estimate.nis, length, step),
    )


def walked(position: Float[np.ndarray, "n 3"], time: Float[np.ndarray, "n"]) -> np.ndarray:
    """Horizontal distance along a path, m: through points 1 s apart, as `metrics.path_length`, so
    that the noise of positions is not counted as walking. A stretch that is not known adds none."""
    apart = max(1, round(1.0 / float(np.median(np.diff(time))))) if len(time) > 1 else 1
    corners = np.unique(np.append(np.arange(0, len(time), apart), len(time) - 1))
    sides = np.linalg.norm(np.diff(position[corners, :2], axis=0), axis=1)
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(sides))])
    return np.interp(time, time[corners], total)


def ellipses(covariance: Float[np.ndarray, "k 2 2"]) -> Ellipses:
    """Of horizontal covariances, m²; NaN where one is not finite."""
    known = finite_rows(covariance.reshape(-1, 4))
    variance, axes = np.linalg.eigh(np.where(known[:, None, None], covariance, np.eye(2)))
    minor, major = SIGMAS * np.sqrt(np.maximum(variance, 0.0)).T
    angle = np.arctan2(axes[:, 1, 1], axes[:, 0, 1])
    return Ellipses(*(np.where(known, part, np.nan) for part in (major, minor, angle)))


def _largest(
    values: Float[np.ndarray, "n"] | None, length: int, step: int
) -> Float[np.ndarray, "k"]:
    """The largest known value of each `step` rows."""
    padded = np.full(-(-length // step) * step, np.nan)
    padded[:length] = np.nan if values is None else values
    found = np.where(np.isnan(padded), -np.inf, padded).reshape(-1, step).max(axis=1)
    return np.where(np.isneginf(found), np.nan, found)
