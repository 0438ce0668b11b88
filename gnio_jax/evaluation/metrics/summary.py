"""Metrics over the sequences of a set: means, medians, bootstrap intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation.metrics.measures import diverged


class Summary(NamedTuple):
    """Metrics over the sequences of a set. None where no sequence has the metric, or (interval) it
    has fewer than two groups."""

    mean: dict[str, float | None]
    """Over the sequences that did not diverge: of no worth without `diverged` beside it. Infinite
    where one of them is (NEES, with a covariance that is not positive definite)."""
    median: dict[str, float | None]
    """Over all that have the metric: of an error, infinite where half of them diverged."""
    interval: dict[str, tuple[float, float] | None]
    """Bootstrap 95 % interval of a finite mean, groups (people, sessions) drawn with replacement.
    """
    count: dict[str, int]
    """Sequences in the mean."""
    diverged: dict[str, int]
    """Sequences that have the metric and are in no mean, because their estimate diverged."""


def summarise(
    measures: Mapping[str, Mapping[str, float | None]],
    groups: Mapping[str, Any],
    seed: int = 0,
    draws: int = 2000,
) -> Summary:
    """Mean, median and bootstrap 95 % interval of every metric over sequences, each sequence
    counted once.

    `measures` is sequence -> metric -> value, `groups` sequence -> the person or session it belongs
    to: recordings of one are not independent, so whole groups are drawn (`bootstrap`). A sequence
    that `diverged` is left out of the mean, interval and count of every metric alike. The same seed
    gives the same interval.
    """
    lost = {name for name, values in measures.items() if diverged(values)}
    metrics = list(dict.fromkeys(metric for values in measures.values() for metric in values))
    summary = Summary({}, {}, {}, {}, {})
    for metric in metrics:
        present = [name for name, values in measures.items() if values.get(metric) is not None]
        numbers = np.array([measures[name][metric] for name in present], float)
        kept = np.array([name not in lost for name in present], bool)
        summary.count[metric], summary.diverged[metric] = int(kept.sum()), int((~kept).sum())
        mean = summary.mean[metric] = float(numbers[kept].mean()) if kept.any() else None
        summary.median[metric] = float(np.median(numbers)) if present else None
        drawn = [groups[name] for name in present if name not in lost]
        interval = bootstrap(numbers[kept], drawn, seed, draws) if mean != math.inf else None
        summary.interval[metric] = interval
    return summary


def bootstrap(
    values: Float[np.ndarray, "n"], groups: Iterable[Any], seed: int = 0, draws: int = 2000
) -> tuple[float, float] | None:
    """95 % interval of the mean of `values`, whole groups drawn with replacement.

    `groups` holds the group of each value. A draw's mean is over its values, so a large group
    weighs more than a small one. None for fewer than two groups.
    """
    members, group = np.unique([str(name) for name in groups], return_inverse=True)
    if len(members) < 2:
        return None
    sums, sizes = np.bincount(group, values), np.bincount(group)
    drawn = np.random.default_rng(seed).integers(0, len(members), (draws, len(members)))
    low, high = np.percentile(sums[drawn].sum(1) / sizes[drawn].sum(1), [2.5, 97.5])
    return float(low), float(high)
