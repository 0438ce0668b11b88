"""Rows of evaluations compared, metric by metric, with the first of them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from gnio_jax.comparison import pairs
from gnio_jax.comparison.pairs import Difference
from gnio_jax.comparison.rows import Row, read_row
from gnio_jax.config import CompareConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Lines, Reporter

USUAL = ("ate", "rpe_1s", "yaw_rmse", "path_length_ratio", "nis", "nees")
"""Metrics that are compared where none are named."""
BEST = {
    **dict.fromkeys(("path_length_ratio", "path_length_ratio_2d", "nis", "nees", "nees_2d"), 1.0),
    **dict.fromkeys(("nis_coverage", "nees_coverage", "nees_coverage_2d"), 95.0),
    "accepted": 100.0,
}
"""The best value of a metric whose best is not 0."""


class Cell(NamedTuple):
    """A metric of a row."""

    label: str
    seeds: list[float]
    """Mean over the sequences that did not diverge, with each seed; empty where some seed has
    none."""
    diverged: int
    """Estimates that diverged; they are in no mean."""
    estimates: int
    """Seeds × sequences."""
    difference: Difference | None
    """To the first row; None for the first itself, and without the metric."""


class Comparison(NamedTuple):
    """What a comparison shows."""

    dataset: str
    split: str
    rows: list[Row]
    cells: dict[str, list[Cell]]
    """Metric -> a cell for each row."""


def compare(
    config: CompareConfig, reporter: Reporter | None = None, workers: int = 1
) -> Comparison:
    """Read the rows' evaluations, make those that are missing, and compare them.

    `workers` processes read recordings that are slow to read. Raises `InputError` for rows that
    cannot be compared and metrics that none of them has.
    """
    reporter = reporter or Lines()
    if len(config.rows) < 2:
        raise InputError("RUNS", "needs two or more", "name the run to compare with first")
    if config.metrics == ():
        raise InputError("--metrics", "names no metric", "leave it out for the usual ones")
    rows = [read_row(word, config, reporter, workers) for word in config.rows]
    dataset, split = _common_recordings(rows)
    rows = [row._replace(label=label) for row, label in zip(rows, _labels(rows), strict=True)]
    metrics = _metrics(rows, config.metrics)
    return Comparison(dataset, split, rows, {metric: _cells(rows, metric) for metric in metrics})


def _metrics(rows: list[Row], wanted: tuple[str, ...] | None) -> list[str]:
    """Those that are wanted; by default the usual ones that some row has."""
    known = {metric: None for row in rows for seed in row.seeds for metric in seed["mean"]}
    del known["diverged"]
    for metric in wanted or ():
        if metric not in known:
            raise InputError(
                "--metrics", f"no row has '{metric}'", f"there are: {', '.join(known)}"
            )
    return list(wanted) if wanted else [metric for metric in USUAL if metric in known]


def _common_recordings(rows: list[Row]) -> tuple[str, str]:
    """Dataset and split of all rows. Raises `InputError` where they differ."""
    first = _recordings(rows[0], 0)
    for row in rows:
        for number, folder in enumerate(row.folders):
            if _recordings(row, number) != first:
                dataset, split = _recordings(row, number)
                problem = f"is of {dataset} {split}, the first row of {' '.join(first)}"
                remedy = f"give --split {split}, or name evaluations of one split of one dataset"
                raise InputError(str(folder), problem, remedy)
    return first


def _recordings(row: Row, seed: int) -> tuple[str, str]:
    settings = row.seeds[seed]["settings"]
    return settings["dataset"], settings["split"]


def _labels(rows: list[Row]) -> list[str]:
    """The rows' names without the folders that all begin with, and those that all end with."""
    paths = [Path(os.path.abspath(row.label)) for row in rows]
    common = os.path.commonpath([path.parent for path in paths])
    parts = [path.relative_to(common).parts for path in paths]
    while len({each[-1] for each in parts}) == 1 and all(len(each) > 1 for each in parts):
        parts = [each[:-1] for each in parts]
    return [str(Path(*each)) for each in parts]


def _cells(rows: list[Row], metric: str) -> list[Cell]:
    """One metric of every row."""
    group_of = pairs.groups([seed for row in rows for seed in row.seeds])
    tables = [pairs.errors(row.seeds, metric) for row in rows]
    cells = []
    for number, (row, own) in enumerate(zip(rows, tables, strict=True)):
        cells.append(
            Cell(
                label=row.label,
                seeds=pairs.means(row.seeds, metric),
                diverged=sum(seed["mean"]["diverged"] for seed in row.seeds),
                estimates=sum(len(seed["sequences"]) for seed in row.seeds),
                difference=pairs.difference(own, tables[0], group_of, BEST.get(metric, 0.0))
                if number and own
                else None,
            )
        )
    return cells
