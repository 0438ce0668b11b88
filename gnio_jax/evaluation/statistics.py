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


class Summary(NamedTuple):
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
    """95 % interval of the mean. That of a share ends at 0 and at 100 %."""
    sequences: int
    """Number of sequences in the mean."""
    groups: int
    """Number of groups to which the sequences of the mean belong."""
    diverged: int
    """Number of `estimates` that diverged."""
    estimates: int
    """Number of sequences × seeds."""

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


def values(seeds: Sequence[Scores], metric: str) -> dict[str, Float[np.ndarray, "seeds"]]:
    """A metric of the sequences that have it with every seed."""
    tables = [{name: own.values.get(metric) for name, own in scores.items()} for scores in seeds]
    return {
        name: np.array([table[name] for table in tables], float)
        for name in tables[0]
        if all(table.get(name) is not None for table in tables)
    }


def lost(seeds: Sequence[Scores]) -> dict[str, int]:
    """Sequence → number of seeds with which its estimate diverged, if there are any."""
    return Counter(name for scores in seeds for name, own in scores.items() if own.diverged)


def summarise(seeds: Sequence[Scores], metric: str, groups: Mapping[str, Any]) -> Summary:
    """Mean, median and interval of a metric. Each sequence counts once."""
    found, diverged = values(seeds, metric), lost(seeds)
    every = np.concatenate([*found.values()]) if found else np.zeros(0)
    kept = [name for name in found if name not in diverged]
    rows = np.array([found[name] for name in kept]).reshape(len(kept), len(seeds))
    drawn = [groups[name] for name in kept]
    reach = interval(rows.mean(1), drawn) if kept else None
    if reach and metric in SHARES:
        reach = max(reach[0], 0.0), min(reach[1], 100.0)
    return Summary(
        mean=float(rows.mean()) if kept else None,
        seeds=rows.mean(0).tolist() if kept else [],
        median=float(np.median(every)) if found else None,
        interval=reach,
        sequences=len(kept),
        groups=len({str(group) for group in drawn}),
        diverged=sum(diverged.get(name, 0) for name in found),
        estimates=len(every),
    )


def interval(values: Float[np.ndarray, "n"], groups: Iterable[Any]) -> Interval | None:
    """95 % interval of the mean of a population of groups, such as people or sessions.

    `groups` has the group of each value. Groups are assumed to be drawn at random, so the standard
    error is the cluster-robust one, sqrt(G / (G − 1) Σ_g (Σ_{i in g} (x_i − x̄))²) / n for G groups
    and n values (Liang and Zeger 1986), and the quantile is Student's t with G − 1 degrees of
    freedom. For groups of similar sizes it covers the mean with the stated probability, even for
    few groups: a percentile bootstrap over 2, 3, 6 and 10 groups misses the mean in 50, 25, 15 and
    10 % of the cases. None for fewer than two groups, and if a value or the interval is not finite.
    """
    members, group = np.unique([str(name) for name in groups], return_inverse=True)
    count = len(members)
    if count < 2 or not np.isfinite(values).all():
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        mean = float(values.mean())
        sums = np.bincount(group, values - mean)
        error = math.sqrt(count / (count - 1)) * float(np.linalg.norm(sums)) / len(values)
    reach = float(stdtrit(count - 1, 0.975)) * error
    found = mean - reach, mean + reach
    return found if all(map(math.isfinite, found)) else None


def compare(
    own: Sequence[Scores],
    other: Sequence[Scores],
    metric: str,
    groups: Mapping[str, Any],
    best: float = 0.0,
) -> Difference:
    """The difference of a row from another one in a metric whose best value is `best`. The rows may
    have different numbers of seeds."""
    of_own, of_other = values(own, metric), values(other, metric)
    diverged = lost(own) | lost(other)
    shared = sorted(
        name
        for name in of_own.keys() & of_other.keys()
        if name not in diverged and np.isfinite([*of_own[name], *of_other[name]]).all()
    )
    either = {
        name
        for scores in (*own, *other)
        for name, measures in scores.items()
        if measures.values.get(metric) is not None
    }
    drawn = [groups[name] for name in shared]
    nothing = Difference(None, None, None, 0, len(shared), len(either), len(set(drawn)))
    if not shared:
        return nothing
    rows = [[of[name] for name in shared] for of in (of_own, of_other)]
    ours, theirs = (np.array([seeds.mean() for seeds in row]) for row in rows)
    near, far = (np.array([np.abs(seeds - best).mean() for seeds in row]) for row in rows)
    if near.sum() < far.sum() and _share_lost(own) > _share_lost(other):
        return nothing._replace(withheld=True)
    return nothing._replace(
        mean=float((ours - theirs).mean()),
        interval=interval(ours - theirs, drawn),
        gain=100 * (1 - float(ours.mean() / theirs.mean())) if theirs.mean() else None,
        better=int((near < far).sum()),
    )


def _share_lost(seeds: Sequence[Scores]) -> float:
    """Share of diverged estimates among those whose positions have an error, finite or not."""
    scored = [
        own.diverged
        for of in seeds
        for own in of.values()
        if any(own.values.get(name) is not None for name in POSITION_ERRORS)
    ]
    return float(np.mean(scored)) if scored else 0.0


class Cell(NamedTuple):
    """A metric of one row of a table."""

    mean: Summary
    difference: Difference | None
    """Difference from the first row; None for the first row itself."""
