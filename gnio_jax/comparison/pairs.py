"""Two rows over the sequences that both have: paired differences, and what they are worth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.comparison.figures import Figures
from gnio_jax.evaluation import report
from gnio_jax.evaluation.statistics import interval

Errors = Mapping[str, Float[np.ndarray, "_"]]
"""Sequence -> a metric with every seed: (seeds,), infinite where the estimate diverged."""


class Difference(NamedTuple):
    """Of a metric between a row and the first, over the sequences that both have with every seed,
    finite."""

    mean: float | None
    """Row minus first, over sequences, of the means over seeds; None without such a sequence, and
    where it is withheld."""
    interval: tuple[float, float] | None
    """95 % of the mean, over groups (`statistics.interval`); None for a single group."""
    gain: float | None
    """% by which the row's mean is smaller; None as `mean` is."""
    better: int
    """Sequences in which the row is nearer to the best value there is, mean over seeds."""
    compared: int
    """Sequences that all this is over."""
    sequences: int
    """Sequences that the row or the first has with any seed."""
    groups: int
    """People or sessions that the compared ones belong to."""
    withheld: bool = False
    """Whether the row would be better but diverged more often than the first."""


def errors(seeds: Sequence[Figures], metric: str = "ate") -> Errors:
    """A metric of the sequences that have one with every seed."""
    found = [_values(figures, metric) for figures in seeds]
    return {
        name: np.array([values[name] for values in found], float)
        for name in sorted(found[0])
        if all(name in values for values in found)
    }


def names(seeds: Sequence[Figures], metric: str = "ate") -> set[str]:
    """Sequences that have a metric with any seed."""
    return {name for figures in seeds for name in _values(figures, metric)}


def diverged(seeds: Sequence[Figures]) -> set[str]:
    """Sequences whose estimate diverged with any seed."""
    return {
        name
        for figures in seeds
        for name, sequence in figures["sequences"].items()
        if _lost(sequence)
    }


def means(seeds: Sequence[Figures], metric: str) -> list[float]:
    """Mean of a metric with each seed, over the sequences that have one with every seed and
    diverged with none: the seeds differ in nothing else. Empty without such a sequence; infinite
    where an error is too large for a number."""
    lost = diverged(seeds)
    kept = [values for name, values in errors(seeds, metric).items() if name not in lost]
    return [float(mean) for mean in np.mean(kept, axis=0)] if kept else []


def groups(seeds: Sequence[Figures]) -> dict[str, str]:
    """Sequence -> the person or session it belongs to."""
    return {
        name: sequence["group"]
        for figures in seeds
        for name, sequence in figures["sequences"].items()
    }


def paired(own: Errors, first: Errors) -> list[str]:
    """Sequences that both rows have with every seed, finite."""
    return [name for name in own if name in first and np.isfinite([*own[name], *first[name]]).all()]


def compare(
    own: Sequence[Figures],
    first: Sequence[Figures],
    group_of: Mapping[str, str],
    metric: str = "ate",
    best: float = 0.0,
) -> Difference:
    """How a row differs from the first in a metric whose best value is `best`. The rows may have
    different numbers of seeds.

    Where the row would be better but diverged more often than the first, it is not better: there is
    no difference then.
    """
    tables = errors(own, metric), errors(first, metric)
    found = difference(*tables, group_of, best)
    found = found._replace(sequences=len(names(own, metric) | names(first, metric)))
    return _withheld(found) if _nearer(*tables, best) and _less_sure(own, first) else found


def difference(
    own: Errors, first: Errors, group_of: Mapping[str, str], best: float = 0.0
) -> Difference:
    """As `compare`, of the errors, whatever diverged."""
    shared, sequences = paired(own, first), len(own.keys() | first.keys())
    if not shared:
        return Difference(None, None, None, 0, 0, sequences, 0)
    ours, theirs = (np.array([table[name].mean() for name in shared]) for table in (own, first))
    far = zip(_distances(own, shared, best), _distances(first, shared, best), strict=True)
    drawn = [group_of[name] for name in shared]
    return Difference(
        mean=float((ours - theirs).mean()),
        interval=interval(ours - theirs, drawn),
        gain=100 * (1 - float(ours.mean() / theirs.mean())) if theirs.mean() else None,
        better=sum(one < other for one, other in far),
        compared=len(shared),
        sequences=sequences,
        groups=len(set(drawn)),
    )


def _distances(table: Errors, shared: list[str], best: float) -> list[float]:
    """Of each sequence from the best value, mean over seeds."""
    return [float(np.abs(table[name] - best).mean()) for name in shared]


def _nearer(own: Errors, first: Errors, best: float) -> bool:
    """Whether a row is nearer to the best value than the first, over the sequences of both."""
    shared = paired(own, first)
    return sum(_distances(own, shared, best)) < sum(_distances(first, shared, best))


def _less_sure(own: Sequence[Figures], first: Sequence[Figures]) -> bool:
    """Whether a larger share of a row's estimates diverged than of the first's."""
    lost = [
        [_lost(each) for figures in row for each in figures["sequences"].values() if _scored(each)]
        for row in (own, first)
    ]
    return sum(lost[0]) * len(lost[1]) > sum(lost[1]) * len(lost[0])


def _withheld(found: Difference) -> Difference:
    """Without what would call the row better."""
    return found._replace(mean=None, interval=None, gain=None, better=0, withheld=True)


def _scored(sequence: Mapping[str, Any]) -> bool:
    """Whether an estimate has an `ate`, infinite or not."""
    return report.read_metric(sequence, "ate") is not None


def _lost(sequence: Mapping[str, Any]) -> bool:
    """Whether an estimate diverged."""
    return bool(report.read_metric(sequence, "ate") == math.inf)


def _values(figures: Figures, metric: str) -> dict[str, float]:
    """Sequence -> the metric, of the sequences that have one; infinite, whatever the metric, where
    the estimate diverged."""
    found = {}
    for name, sequence in figures["sequences"].items():
        value = report.read_metric(sequence, metric)
        if value is not None:
            found[name] = math.inf if _lost(sequence) else value
    return found
