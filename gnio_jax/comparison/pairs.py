"""Two rows over the sequences that both have: paired differences, and what they are worth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.comparison.figures import Figures
from gnio_jax.evaluation import metrics, report

Errors = Mapping[str, Float[np.ndarray, "_"]]
"""Sequence -> a metric with every seed: (seeds,), infinite where the estimate diverged."""


class Difference(NamedTuple):
    """Of a metric between a row and the first, over the sequences that both have and in which
    neither diverged with any seed."""

    mean: float | None
    """Row minus first, over sequences, of the means over seeds; None without such a sequence."""
    interval: tuple[float, float] | None
    """95 % of the mean, groups drawn anew (`metrics.bootstrap`); None for a single group."""
    gain: float | None
    """% by which the row's mean is smaller; None without such a sequence."""
    better: int
    """Sequences in which the row is nearer to the best value there is, mean over seeds."""
    compared: int
    """Sequences that all this is over."""
    sequences: int
    """Sequences of this row or the first."""
    groups: int
    """People or sessions that the compared ones belong to."""


def errors(seeds: Sequence[Figures], metric: str = "ate") -> Errors:
    """A metric of the sequences that have one with every seed."""
    found = [_values(figures, metric) for figures in seeds]
    return {
        name: np.array([values[name] for values in found], float)
        for name in sorted(found[0])
        if all(name in values for values in found)
    }


def means(seeds: Sequence[Figures], metric: str) -> list[float]:
    """Mean of a metric over the sequences that did not diverge, with each seed; empty where some
    seed has none."""
    found = [figures["mean"].get(metric) for figures in seeds]
    return [] if None in found else [float(mean) for mean in found]


def groups(seeds: Sequence[Figures]) -> dict[str, str]:
    """Sequence -> the person or session it belongs to."""
    return {
        name: sequence["group"]
        for figures in seeds
        for name, sequence in figures["sequences"].items()
    }


def paired(own: Errors, first: Errors) -> list[str]:
    """Sequences that both rows have and in which neither diverged with any seed."""
    return [name for name in own if name in first and np.isfinite([*own[name], *first[name]]).all()]


def difference(
    own: Errors, first: Errors, group_of: Mapping[str, str], best: float = 0.0
) -> Difference:
    """How a row differs from the first, in a metric whose best value is `best`. The rows may have
    different numbers of seeds."""
    names, sequences = paired(own, first), len(own.keys() | first.keys())
    if not names:
        return Difference(None, None, None, 0, 0, sequences, 0)
    ours, theirs = (np.array([table[name].mean() for name in names]) for table in (own, first))
    far = [[np.abs(table[name] - best).mean() for name in names] for table in (own, first)]
    drawn = [group_of[name] for name in names]
    return Difference(
        mean=float((ours - theirs).mean()),
        interval=metrics.bootstrap(ours - theirs, drawn),
        gain=100 * (1 - float(ours.mean() / theirs.mean())) if theirs.mean() else None,
        better=sum(one < other for one, other in zip(*far, strict=True)),
        compared=len(names),
        sequences=sequences,
        groups=len(set(drawn)),
    )


def _values(figures: Figures, metric: str) -> dict[str, float]:
    """Sequence -> the metric, of the sequences that have one; infinite, whatever the metric, where
    the estimate diverged."""
    found = {}
    for name, sequence in figures["sequences"].items():
        value = report.read_metric(sequence, metric)
        if value is not None:
            lost = report.read_metric(sequence, "ate") == math.inf
            found[name] = math.inf if lost else value
    return found
