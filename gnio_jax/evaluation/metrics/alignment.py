"""Laying an estimated trajectory on its reference by one rigid motion."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gnio_jax.evaluation.metrics.heading import relative_yaw
from gnio_jax.evaluation.metrics.trajectory import (
    Trajectory,
    Undefined,
    finite_poses,
)
from gnio_jax.numerics import finite_rows, quaternion_from_matrix, quaternion_product, rotation_z

AlignmentMethod = Literal["origin", "none", "yaw_position", "se3"]
NOT_FINITE = "the estimate is not finite"
"""How the reason of a metric begins that is infinite because the estimate diverged."""


class _Motion(NamedTuple):
    """p ↦ turn (p − source) + target."""

    turn: Float[np.ndarray, "3 3"]
    source: Float[np.ndarray, "3"]
    target: Float[np.ndarray, "3"]


def align(
    estimate: Trajectory, reference: Trajectory, how: AlignmentMethod = "origin"
) -> Trajectory:
    """The estimate moved into the reference's frame by one rigid motion.

    The motion is fitted over the rows that are trusted and where the estimate is finite. `origin`
    matches position and yaw (`relative_yaw`) at the first such row (what a user of odometry knows).
    `none` changes nothing. `yaw_position` is the least-squares motion of four degrees of freedom
    (the unobservable ones of inertial odometry; VIO benchmarks). `se3` is the least-squares motion
    of six (Horn/Kabsch, no scale; TUM, evo). Raises `Undefined` without such a row, or for `se3`
    with fewer than three.
    """
    if how == "none":
        return estimate
    trusted = finite_poses(reference) if how == "origin" else finite_rows(reference.position)
    if not trusted.any():
        raise Undefined("no trusted reference")
    rows = np.flatnonzero(trusted & finite_poses(estimate))
    if not len(rows):
        raise Undefined(f"{NOT_FINITE} in any trusted row")
    if how == "origin":
        motion = _match_start(estimate, reference, int(rows[0]))
    else:
        motion = _least_squares(estimate.position, reference.position, rows, how)
    return Trajectory(
        estimate.time,
        (estimate.position - motion.source) @ motion.turn.T + motion.target,
        quaternion_product(quaternion_from_matrix(motion.turn), estimate.orientation),
    )


def _match_start(estimate: Trajectory, reference: Trajectory, row: int) -> _Motion:
    """The motion that matches position and yaw at one row."""
    starts = (path.orientation[row : row + 1] for path in (reference, estimate))
    turn = rotation_z(relative_yaw(*starts)[0])
    return _Motion(turn, estimate.position[row], reference.position[row])


def _least_squares(
    estimate: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "n 3"],
    rows: Int[np.ndarray, "m"],
    how: AlignmentMethod,
) -> _Motion:
    """The motion with the least squared error of positions over `rows`."""
    source, target = estimate[rows].mean(0), reference[rows].mean(0)
    a, b = estimate[rows] - source, reference[rows] - target
    if how == "yaw_position":
        sine = a[:, 0] @ b[:, 1] - a[:, 1] @ b[:, 0]
        cosine = a[:, 0] @ b[:, 0] + a[:, 1] @ b[:, 1]
        return _Motion(rotation_z(np.arctan2(sine, cosine)), source, target)
    if len(rows) < 3:
        raise Undefined("fewer than three trusted rows to align")
    u, _, vt = np.linalg.svd(b.T @ a)
    proper = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])  # no reflection
    return _Motion(u @ proper @ vt, source, target)
