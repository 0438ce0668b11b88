"""Metrics of one way of estimating, over the sequences of a set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.metrics import Filtered, Measures, measure
from gnio_jax.evaluation.statistics import interval
from gnio_jax.evaluation.trajectory import Alignment


class Summary(NamedTuple):
    """Metrics over the sequences of a set. None where no sequence has the metric, or (interval) it
    has fewer than two groups."""

    mean: dict[str, float | None]
    """Over the sequences that did not diverge: of no worth without `diverged` beside it. Infinite
    where one of them is (NEES, with a covariance that is not positive definite)."""
    median: dict[str, float | None]
    """Over all that have the metric: of an error, infinite where half of them diverged."""
    interval: dict[str, tuple[float, float] | None]
    """95 % interval of a finite mean over groups (people, sessions): `statistics.interval`."""
    groups: dict[str, int]
    """Groups that the interval is over."""
    count: dict[str, int]
    """Sequences in the mean."""
    diverged: dict[str, int]
    """Sequences that have the metric and are in no mean, because their estimate diverged."""


class Scores(NamedTuple):
    """Metrics of one way of estimating, over sequences."""

    sequences: dict[str, Measures]
    summary: Summary
    groups: dict[str, str]
    """Sequence -> person or session, as the intervals draw them."""

    @property
    def diverged(self) -> list[str]:
        """Sequences whose estimate diverged."""
        return [name for name, measures in self.sequences.items() if measures.diverged]


def score(
    estimates: list[Estimate], groups: Mapping[str, Any], alignment: Alignment = "origin"
) -> Scores:
    """Every metric of every estimate, and over all of them; `groups` says which sequences belong
    together (`summarise`)."""
    sequences = {}
    for e in estimates:
        filtered = None
        if e.position_covariance is not None and e.nis is not None and e.accepted is not None:
            filtered = Filtered(e.position_covariance, e.nis, e.accepted)
        sequences[e.name] = measure(e.trajectory, e.reference, alignment, filtered)
    return Scores(
        sequences, summarise(sequences, groups), {name: str(groups[name]) for name in sequences}
    )


def summarise(measures: Mapping[str, Measures], groups: Mapping[str, Any]) -> Summary:
    """Mean, median and 95 % interval of every metric over sequences, each sequence counted once.

    `measures` is by sequence, `groups` sequence -> the person or session it belongs to: recordings
    of one are not independent. A sequence that diverged is left out of the mean, interval and count
    of every metric alike.
    """
    lost = {name for name, found in measures.items() if found.diverged}
    metrics = list(dict.fromkeys(metric for found in measures.values() for metric in found.values))
    summary = Summary({}, {}, {}, {}, {}, {})
    for metric in metrics:
        present = [n for n, found in measures.items() if found.values.get(metric) is not None]
        numbers = np.array([measures[name].values[metric] for name in present], float)
        kept = np.array([name not in lost for name in present], bool)
        summary.count[metric], summary.diverged[metric] = int(kept.sum()), int((~kept).sum())
        summary.mean[metric] = float(numbers[kept].mean()) if kept.any() else None
        summary.median[metric] = float(np.median(numbers)) if present else None
        drawn = [groups[name] for name in present if name not in lost]
        summary.interval[metric] = interval(numbers[kept], drawn)
        summary.groups[metric] = len({str(group) for group in drawn})
    return summary
