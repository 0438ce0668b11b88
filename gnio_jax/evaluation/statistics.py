"""Means over sequences and seeds, their intervals, and differences paired by sequence.

Sequences of one person or session are not independent: they form a group, and an interval treats
the groups as the random sample. A sequence whose estimate diverged is left out of every mean and
every difference, with all its metrics and all seeds, and it is counted separately.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from gnio_jax.evaluation.metrics import POSITION_ERRORS, SHARES, Measures

Scores = Mapping[str, Measures]
"""Sequence → its metrics."""
Interval = tuple[float, float]
FEWEST_GROUPS = 4
"""Number of groups from which the mean of a metric has an interval (ours). No metric is negative,
and Student's quantile of fewer groups, 12.7 and 4.3, mostly reaches far below zero."""
LARGEST_SHARE = 1 / 3
"""Share of the sequences above which one group makes an interval unsure (ours)."""


class MetricSummary(NamedTuple):
    """One metric over the sequences that have it with every seed."""

    mean: float | None
    """Mean over the sequences whose estimate did not diverge with any seed; None if there are none.
    It is infinite if one of them is (NEES, with a covariance that is not positive definite)."""
    seeds: list[float]
    """The same for each seed."""
    median: float | None
    """Median over all sequences and seeds; that of an error is infinite if half of them
    diverged."""
    interval: Interval | None
    """95 % interval of the mean, from `FEWEST_GROUPS` groups on. It ends at 0, and that of a share
    at 100 %."""
    sequences: int
    """Number of sequences in the mean."""
    groups: int
    """Number of groups to which the sequences of the mean belong."""
    diverged: int
    """Number of `estimates` that diverged."""
    estimates: int
    """Number of sequences × seeds."""
    largest: int = 0
    """Number of the sequences of the mean that belong to the largest group."""

    @property
    def std(self) -> float | None:
        """Standard deviation over seeds; None for one seed, or without a finite mean."""
        if len(self.seeds) < 2 or not np.isfinite(self.seeds).all():
            return None
        return float(np.std(self.seeds, ddof=1))


class Difference(NamedTuple):
    """A metric of one row minus that of another, over the sequences that both have with every seed,
    finite, and with no seed diverged."""

    mean: float | None
    """Difference of the means over seeds. None if there is no such sequence, or if it is
    withheld."""
    interval: Interval | None
    """95 % interval of the mean."""
    gain: float | None
    """Reduction of the row's mean, %."""
    better: int
    """Number of sequences on which the row is nearer to the best value, as a mean over seeds."""
    compared: int
    sequences: int
    """Number of sequences that either row has with any seed."""
    groups: int
    """Number of groups to which the compared sequences belong."""
    withheld: bool = False
    """True if the row would be better, but a larger share of its estimates diverged, so that it
    does not count as better."""
    largest: int = 0
    """Number of the compared sequences that belong to the largest group."""


def collect_values(seeds: Sequence[Scores], metric: str) -> dict[str, Float[np.ndarray, "seeds"]]:
    """A metric of the sequences that have it with every seed."""
    tables = [
        {name: measures.values.get(metric) for name, measures in scores.items()} for scores in seeds
    ]
    return {
        name: np.array([table[name] for table in tables], float)
        for name in tables[0]
        if all(table.get(name) is not None for table in tables)
    }


def count_divergences(seeds: Sequence[Scores]) -> dict[str, int]:
    """Sequence → number of seeds with which its estimate diverged, if there are any."""
    return Counter(
        name for scores in seeds for name, measures in scores.items() if measures.diverged
    )


def summarise(seeds: Sequence[Scores], metric: str, groups: Mapping[str, Any]) -> MetricSummary:
    """Mean, median and interval of a metric. Each sequence counts once."""
    table, diverged = collect_values(seeds, metric), count_divergences(seeds)
    estimates = np.concatenate([*table.values()]) if table else np.zeros(0)
    names = [name for name in table if name not in diverged]
    rows = np.array([table[name] for name in names]).reshape(len(names), len(seeds))
    row_groups = [groups[name] for name in names]
    sizes = group_sizes(row_groups)
    limits = interval(rows.mean(1), row_groups) if len(sizes) >= FEWEST_GROUPS else None
    if limits:
        limits = max(limits[0], 0.0), min(limits[1], 100.0 if metric in SHARES else math.inf)
    return MetricSummary(
        mean=float(rows.mean()) if names else None,
        seeds=rows.mean(0).tolist() if names else [],
        median=float(np.median(estimates)) if table else None,
        interval=limits,
        sequences=len(names),
        groups=len(sizes),
        diverged=sum(diverged.get(name, 0) for name in table),
        estimates=len(estimates),
        largest=max(sizes.values(), default=0),
    )


def group_sizes(groups: Iterable[Any]) -> Counter[str]:
    """Group → number of its sequences."""
    return Counter(map(str, groups))


def is_uneven(figure: MetricSummary | Difference) -> bool:
    """Whether one group has more than `LARGEST_SHARE` of the sequences, and more than the others,
    so that the interval may be too narrow."""
    count = figure.sequences if isinstance(figure, MetricSummary) else figure.compared
    return figure.largest > count * LARGEST_SHARE and figure.largest * figure.groups > count


def interval(values: Float[np.ndarray, "n"], groups: Iterable[Any]) -> Interval | None:
    """95 % interval of the mean of a population of groups, such as people or sessions.

    `groups` has the group of each value. Groups are assumed to be drawn at random. The standard
    error is that of the jackknife over groups, sqrt((G − 1) / G Σ_g (x̄_g − x̄)²), where x̄_g is the
    mean without group g of G groups (CV3: Bell and McCaffrey 2002; MacKinnon, Nielsen and Webb
    2023), and the quantile is Student's t with G − 1 degrees of freedom. For groups of equal sizes
    it covers the mean with the stated probability, even for few groups: a percentile bootstrap over
    2, 3, 6 and 10 groups misses the mean in 50, 25, 15 and 10 % of the cases. If one or two groups
    have most of the values it misses it in 8 to 19 % of the cases. None for fewer than two groups,
    and if a value or the interval is not finite.
    """
    members, group = np.unique([str(name) for name in groups], return_inverse=True)
    count = len(members)
    if count < 2 or not np.isfinite(values).all():
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        mean = float(values.mean())
        sums, sizes = np.bincount(group, values - mean), np.bincount(group)
        shifts = sums / (len(values) - sizes)  # of the mean, by leaving out each group
        error = math.sqrt((count - 1) / count) * float(np.linalg.norm(shifts))
    half_width = float(stdtrit(count - 1, 0.975)) * error
    limits = mean - half_width, mean + half_width
    return limits if all(map(math.isfinite, limits)) else None


def compare(
    row: Sequence[Scores],
    other: Sequence[Scores],
    metric: str,
    groups: Mapping[str, Any],
    best: float = 0.0,
) -> Difference:
    """The difference of a row from another one in a metric whose best value is `best`. The rows may
    have different numbers of seeds."""
    row_values, other_values = collect_values(row, metric), collect_values(other, metric)
    diverged = count_divergences(row) | count_divergences(other)
    shared = sorted(
        name
        for name in row_values.keys() & other_values.keys()
        if name not in diverged and np.isfinite([*row_values[name], *other_values[name]]).all()
    )
    either = {
        name
        for scores in (*row, *other)
        for name, measures in scores.items()
        if measures.values.get(metric) is not None
    }
    shared_groups = [groups[name] for name in shared]
    sizes = group_sizes(shared_groups)
    counts = len(shared), len(either), len(sizes)
    difference = Difference(None, None, None, 0, *counts, largest=max(sizes.values(), default=0))
    if not shared:
        return difference
    tables = [[values[name] for name in shared] for values in (row_values, other_values)]
    means, other_means = (np.array([seeds.mean() for seeds in table]) for table in tables)
    errors, other_errors = (
        np.array([np.abs(seeds - best).mean() for seeds in table]) for table in tables
    )
    if errors.sum() < other_errors.sum() and _share_diverged(row) > _share_diverged(other):
        return difference._replace(withheld=True)
    return difference._replace(
        mean=float((means - other_means).mean()),
        interval=interval(means - other_means, shared_groups),
        gain=100 * (1 - float(means.mean() / other_means.mean())) if other_means.mean() else None,
        better=int((errors < other_errors).sum()),
    )


def _share_diverged(seeds: Sequence[Scores]) -> float:
    """Share of diverged estimates among those whose positions have an error, finite or not."""
    scored = [
        measures.diverged
        for scores in seeds
        for measures in scores.values()
        if any(measures.values.get(name) is not None for name in POSITION_ERRORS)
    ]
    return float(np.mean(scored)) if scored else 0.0


class Cell(NamedTuple):
    """A metric of one row of a table."""

    summary: MetricSummary
    difference: Difference | None
    """Difference from the first row; None for the first row itself."""
