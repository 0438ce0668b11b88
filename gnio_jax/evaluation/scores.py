"""Metrics of one way of estimating, over the sequences of a set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.metrics import AlignmentMethod, Measures, Summary


class Scores(NamedTuple):
    """Metrics of one way of estimating, over sequences."""

    sequences: dict[str, Measures]
    summary: Summary
    groups: dict[str, str]
    """Sequence -> person or session, as the intervals draw them."""

    @property
    def diverged(self) -> list[str]:
        """Sequences whose estimate diverged (`metrics.diverged`)."""
        return [name for name, m in self.sequences.items() if metrics.diverged(m.values)]


def score(
    estimates: list[Estimate], groups: Mapping[str, Any], alignment: AlignmentMethod = "origin"
) -> Scores:
    """Every metric of every estimate, and over all of them; `groups` says which sequences belong
    together (`metrics.summarise`)."""
    sequences = {}
    for e in estimates:
        found = metrics.measure(e.trajectory, e.reference, alignment, e.position_covariance, e.nis)
        sequences[e.name] = found if e.accepted is None else _with_accepted(found, e.accepted)
    summary = metrics.summarise({name: m.values for name, m in sequences.items()}, groups)
    return Scores(sequences, summary, {name: str(groups[name]) for name in sequences})


def _with_accepted(measures: Measures, accepted: Float[np.ndarray, "k"]) -> Measures:
    """With the share of the measurements that the filter used, %."""
    tried = accepted[~np.isnan(accepted)]
    if not len(tried):
        return Measures(
            measures.values | {"accepted": None},
            measures.undefined | {"accepted": "no measurement"},
        )
    share = float(100 * tried.mean())
    return measures._replace(values=measures.values | {"accepted": share})
