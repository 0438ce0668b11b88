"""Means over seeds, and differences of rows over pairs of sequences."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.comparison import pairs
from gnio_jax.tables.experiments import Experiment
from gnio_jax.tables.matrix import Result

COLUMNS = {
    "ate": "ate m",
    "ate_2d": "ate 2-D",
    "ate_ronin_2d": "ate_ronin 2-D",
    "rpe_1s": "rpe_1s",
    "rte_60s": "rte_60s",
    "path_length_ratio": "path ratio",
    "stationary_drift": "standing m/min",
    "nis": "NIS/3",
    "nees": "NEES/3",
}
"""Metrics of every table: name in metrics.json, heading."""


class TableRow(NamedTuple):
    """One configuration over its seeds.

    An estimate that diverged has an infinite `ate`. It is in `diverged` and `median`; means leave
    it out, and comparisons leave its sequence out on both sides.
    """

    name: str
    label: str
    published: float | None
    published_gain: float | None
    """% of the first row's published figure."""
    seeds: dict[str, list[float]]
    """Metric -> mean for each seed, over the sequences that have one with every seed and diverged
    with none; without such a sequence the metric is not there."""
    median: float | None
    """Of `ate`, m, over seeds × sequences: infinite where half diverged, None without any `ate`."""
    diverged: int
    """Estimates, of seeds × sequences."""
    estimates: int
    """With an `ate`, infinite or not."""
    compared: int
    """Sequences that gain, difference and interval are over: those that both rows have and in which
    neither diverged with any seed."""
    sequences: int
    """Of this row or the first."""
    groups: int
    """People or sessions that the compared sequences belong to."""
    gain: float | None
    """% by which `ate` is smaller than the first row's. None, as are difference and interval,
    without a sequence to compare, and for a row that would gain but diverged more often than the
    first: where it did, it is not better."""
    difference: float | None
    """Of `ate` to the first row: mean over sequences of the means over seeds, m."""
    interval: tuple[float, float] | None
    """95 % of the difference, over groups (`statistics.interval`); none for the first row or a
    single group."""
    extra: dict[str, float]
    """Figures that belong to this table alone."""


Extra = dict[str, dict[str, float]]
"""Figures that belong to one table alone: name of a cell -> heading -> value."""


def rows(
    experiment: Experiment, results: list[Result], extra: Extra | None = None
) -> list[TableRow]:
    """The table of an experiment. Sequences are paired by name."""
    published = experiment.cells[0].published
    group_of, found = groups(results), []
    for result in results:
        cell, every = result.cell, _every_ate(result)
        difference = pairs.compare(result.figures, results[0].figures, group_of)
        row = TableRow(
            name=cell.name,
            label=cell.label,
            published=cell.published,
            published_gain=_published_gain(cell.published, published),
            seeds=_means_of_seeds(result),
            median=float(np.median(every)) if len(every) else None,
            diverged=int(np.isinf(every).sum()),
            estimates=len(every),
            compared=difference.compared,
            sequences=difference.sequences,
            groups=difference.groups,
            gain=difference.gain,
            difference=difference.mean,
            interval=difference.interval,
            extra=(extra or {}).get(cell.name, {}),
        )
        found.append(row if found else row._replace(interval=None))
    return found


def errors(result: Result) -> pairs.Errors:
    """Sequence -> `ate` with every seed, m, infinite where the estimate diverged."""
    return pairs.errors(result.figures)


def groups(results: list[Result]) -> dict[str, str]:
    """Sequence -> the person or session it belongs to."""
    return pairs.groups([figures for result in results for figures in result.figures])


def _every_ate(result: Result) -> Float[np.ndarray, "estimates"]:
    """Over seeds × sequences, m."""
    ates = [pairs.errors([seed]) for seed in result.figures]
    return np.array([ate for seed in ates for (ate,) in seed.values()], float)


def _means_of_seeds(result: Result) -> dict[str, list[float]]:
    """Metric -> mean over sequences with each seed (`pairs.means`)."""
    means = {metric: pairs.means(result.figures, metric) for metric in COLUMNS}
    return {metric: values for metric, values in means.items() if values}


def _published_gain(published: float | None, first: float | None) -> float | None:
    """% by which the paper's figure is smaller than its first row's."""
    if published is None or first is None:
        return None
    return 100 * (1 - published / first)
