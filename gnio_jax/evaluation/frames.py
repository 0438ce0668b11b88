"""Estimates and references brought into one frame, to be looked at together."""

from __future__ import annotations

from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.trajectory import Alignment, in_frame_of, turned_covariance

SIGMAS = 3.0
"""Size of the ellipses that are shown, in standard deviations."""


def in_the_references_frame(estimate: Estimate, alignment: Alignment = "origin") -> Estimate:
    """With trajectory and covariance aligned; unchanged where that is impossible."""
    aligned = in_frame_of(estimate.trajectory, estimate.reference, alignment)
    covariance = estimate.position_covariance
    if covariance is not None:
        covariance = turned_covariance(covariance, estimate.trajectory, aligned)
    return estimate._replace(trajectory=aligned, position_covariance=covariance)


def with_the_reference_in_its_frame(estimate: Estimate) -> Estimate:
    """With the reference moved so that both start alike; unchanged where there is none."""
    return estimate._replace(reference=in_frame_of(estimate.reference, estimate.trajectory))
