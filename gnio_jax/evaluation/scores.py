"""Metrics of one way of estimating, over the sequences of a set."""

from __future__ import annotations

from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.metrics import Filtered, Measures, measure
from gnio_jax.evaluation.trajectory import Alignment


def score(estimates: list[Estimate], alignment: Alignment = "origin") -> dict[str, Measures]:
    """Every metric of every estimate, by sequence."""
    found = {}
    for e in estimates:
        filtered = None
        if e.position_covariance is not None and e.nis is not None and e.accepted is not None:
            filtered = Filtered(e.position_covariance, e.nis, e.accepted)
        found[e.name] = measure(e.trajectory, e.reference, alignment, filtered)
    return found
