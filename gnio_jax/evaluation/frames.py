"""Estimates and references brought into one frame, to be looked at together."""

from __future__ import annotations

import numpy as np

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.metrics import AlignmentMethod, Trajectory, Undefined
from gnio_jax.numerics import rotation_z

SIGMAS = 3.0
"""Size of the ellipses that are shown, in standard deviations."""


def in_the_references_frame(estimate: Estimate, alignment: AlignmentMethod = "origin") -> Estimate:
    """With trajectory and covariance of the position aligned; unchanged where that is impossible.

    The covariance is turned about the vertical alone, which is what alignment turns of a level
    world.
    """
    aligned = _aligned(estimate.trajectory, estimate.reference, alignment)
    covariance = estimate.position_covariance
    if covariance is not None and aligned is not estimate.trajectory:
        before, after = estimate.trajectory.orientation, aligned.orientation
        turn = rotation_z(metrics.relative_yaw(after, before))
        covariance = turn @ covariance @ np.swapaxes(turn, 1, 2)
    return estimate._replace(trajectory=aligned, position_covariance=covariance)


def with_the_reference_in_its_frame(estimate: Estimate) -> Estimate:
    """With the reference moved so that both start alike; unchanged where there is none."""
    return estimate._replace(reference=_aligned(estimate.reference, estimate.trajectory, "origin"))


def _aligned(path: Trajectory, to: Trajectory, how: AlignmentMethod) -> Trajectory:
    try:
        return metrics.align(path, to, how)
    except Undefined:
        return path
