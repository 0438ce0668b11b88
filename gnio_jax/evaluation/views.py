"""The data that pictures and pages draw: trajectory and reference in one frame, and the curves of
network and filter."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation.estimate import SequenceEstimate, in_one_frame
from gnio_jax.evaluation.infer import Displacements
from gnio_jax.evaluation.metrics import Filtered
from gnio_jax.evaluation.trajectory import Alignment, positions_at
from gnio_jax.numerics import finite_rows
from gnio_jax.types import Waypoints

SIGMAS = 3.0
"""Size of ellipses, ellipsoids and bands, in standard deviations."""


ROOM, SMALLEST = 1.5, 2.0
"""Size of a map relative to that of the paths on it, and smallest size, m. Ellipses are cut: those
of an uncertain track may be ten times as large as its path."""


class View(NamedTuple):
    """A trajectory and its reference in one frame, with the curves of network and filter.

    There are n rows, one for each row of the estimate. Unknown values are NaN.
    """

    name: str
    time: Float[np.ndarray, "n"]
    """Time from the start, s."""
    position: Float[np.ndarray, "n 3"]
    """Position of the estimate, m."""
    reference: Float[np.ndarray, "n 3"]
    """Position of the reference, m."""
    network: Displacements
    filtered: Filtered
    waypoints: Waypoints
    """Waypoints, at times from the start; none if the sequence has poses."""
    at_waypoints: Float[np.ndarray, "k 2"]
    """Horizontal position of the estimate at the times of the waypoints, m."""

    @property
    def step(self) -> float:
        """Time between two rows, s."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 1.0

    @property
    def has_reference(self) -> bool:
        """Whether there is a reference."""
        return bool(np.isfinite(self.reference).any())

    @property
    def errors(self) -> Float[np.ndarray, "_"]:
        """Horizontal errors where there is a reference, or at the waypoints, m."""
        if not self.has_reference:
            return np.linalg.norm(self.at_waypoints - self.waypoints.position, axis=1)
        error = (self.position - self.reference)[finite_rows(self.reference), :2]
        return np.linalg.norm(error, axis=1)


def make_view(estimate: SequenceEstimate, alignment: Alignment | None = "origin") -> View:
    """An estimate in the frame of its reference; without an `alignment` the reference is moved to
    the start of the estimate. Where the estimate has diverged, its covariance is not known
    either."""
    aligned = in_one_frame(estimate, alignment)
    rows = len(aligned.trajectory.time)
    none, blank = np.full((rows, 3), np.nan), np.full((rows, 3, 3), np.nan)
    begin = aligned.trajectory.time[0]
    filtered = aligned.filtered or Filtered(blank, none[:, 0], none[:, 0])
    finite = finite_rows(aligned.trajectory.position)[:, None, None]
    filtered = filtered._replace(covariance=np.where(finite, filtered.covariance, np.nan))
    stamps, positions = aligned.waypoints or Waypoints(np.zeros(0), np.zeros((0, 2)))
    return View(
        aligned.name,
        aligned.trajectory.time - begin,
        aligned.trajectory.position,
        aligned.reference.position,
        aligned.displacements or Displacements(none, blank),
        filtered,
        Waypoints(stamps - begin, positions),
        positions_at(aligned.trajectory, stamps),
    )


class Ellipses(NamedTuple):
    """Contours of horizontal covariances at `SIGMAS`, one for each row; NaN where one is not
    finite."""

    major: Float[np.ndarray, "n"]
    """Semi-axis, m."""
    minor: Float[np.ndarray, "n"]
    """Semi-axis, m."""
    angle: Float[np.ndarray, "n"]
    """Angle of the major axis, from x towards y, rad."""


def ellipses(covariance: Float[np.ndarray, "n 3 3"]) -> Ellipses:
    """The contours of the horizontal parts of covariances of positions, m²."""
    horizontal = covariance[:, :2, :2]
    finite = finite_rows(horizontal.reshape(-1, 4))
    variance, axes = np.linalg.eigh(np.where(finite[:, None, None], horizontal, np.eye(2)))
    minor, major = SIGMAS * np.sqrt(np.maximum(variance, 0.0)).T
    angle = np.arctan2(axes[:, 1, 1], axes[:, 0, 1])
    return Ellipses(*(np.where(finite, part, np.nan) for part in (major, minor, angle)))


def map_corners(points: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "2 2"]:
    """The lower left and the upper right corner of a map of paths, m. Points that are not finite do
    not count."""
    finite = points[finite_rows(points)] if len(points) else points
    if not len(finite):
        finite = np.zeros((1, 2))
    low, high = finite.min(axis=0), finite.max(axis=0)
    half = np.maximum(ROOM * (high - low), SMALLEST) / 2
    return np.stack([(low + high) / 2 - half, (low + high) / 2 + half])


def horizontal_speed(position: Float[np.ndarray, "n 3"], step: float) -> Float[np.ndarray, "n"]:
    """Horizontal speed, m/s, as a mean over the second around each row, for rows that are `step`
    apart, s."""
    lag = max(1, round(1.0 / step))
    speeds = np.full(len(position), np.nan)
    if len(position) > lag:
        distance = np.linalg.norm((position[lag:] - position[:-lag])[:, :2], axis=1)
        speeds[lag // 2 :][: len(distance)] = distance / (lag * step)
    return speeds
