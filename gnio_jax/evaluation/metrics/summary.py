"""Metrics over the sequences of a set: means, medians, intervals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from gnio_jax.evaluation.metrics.measures import diverged
from gnio_jax.evaluation.statistics import interval


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


def summarise(
    measures: Mapping[str, Mapping[str, float | None]],
    groups: Mapping[str, Any],
) -> Summary:
    """Mean, median and 95 % interval of every metric over sequences, each sequence counted once.

    `measures` is sequence -> metric -> value, `groups` sequence -> the person or session it belongs
    to: recordings of one are not independent. A sequence that `diverged` is left out of the mean,
    interval and count of every metric alike.
    """
    lost = {name for name, values in measures.items() if diverged(values)}
    metrics = list(dict.fromkeys(metric for values in measures.values() for metric in values))
    summary = Summary({}, {}, {}, {}, {}, {})
    for metric in metrics:
        present = [name for name, values in measures.items() if values.get(metric) is not None]
        numbers = np.array([measures[name][metric] for name in present], float)
        kept = np.array([name not in lost for name in present], bool)
        summary.count[metric], summary.diverged[metric] = int(kept.sum()), int((~kept).sum())
        summary.mean[metric] = float(numbers[kept].mean()) if kept.any() else None
        summary.median[metric] = float(np.median(numbers)) if present else None
        drawn = [groups[name] for name in present if name not in lost]
        summary.interval[metric] = interval(numbers[kept], drawn)
        summary.groups[metric] = len({str(group) for group in drawn})
    return summary
