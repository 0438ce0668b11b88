"""Rows of evaluations compared, metric by metric, with the first of them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax.comparison import figures, pairs, rows
from gnio_jax.comparison.figures import Recordings
from gnio_jax.comparison.pairs import Difference
from gnio_jax.comparison.rows import Row
from gnio_jax.config import CompareConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation.metrics import NAMES
from gnio_jax.reporting import Lines, Reporter

USUAL = ("ate", "rpe_1s", "yaw_rmse", "path_length_ratio", "nis", "nees")
"""Metrics that are compared where none are named."""
BEST = {
    **dict.fromkeys(("path_length_ratio", "path_length_ratio_2d", "nis", "nees", "nees_2d"), 1.0),
    **dict.fromkeys(("nis_coverage", "nees_coverage", "nees_coverage_2d"), 95.0),
    "accepted": 100.0,
}
"""The best value of a metric whose best is not 0."""
SAME_LENGTH = 0.05
"""Two recordings of one name are the same where their durations differ by less than this share:
estimates begin a window later or earlier."""


class Cell(NamedTuple):
    """A metric of a row."""

    label: str
    seeds: list[float]
    """Mean with each seed, over the sequences that diverged with none (`pairs.means`)."""
    diverged: int
    """Estimates that diverged."""
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
    cannot be compared and metrics that none of them has, before it evaluates where that can be
    known.
    """
    reporter = reporter or Lines()
    _check_metrics(config.metrics)
    if len(config.rows) < 2:
        remedy = "name the run to compare with first, and all of them before --metrics"
        raise InputError("RUNS", "needs two or more", remedy)
    named = {word: rows.find(word) for word in config.rows}
    _check_different(named, config)
    common = _common_recordings(named, config)
    found = [rows.read(word, named[word], config, reporter, workers) for word in config.rows]
    _check_same_sequences(found)
    labels = _labels(found)
    found = [row._replace(label=label) for row, label in zip(found, labels, strict=True)]
    cells = {metric: _cells(found, metric) for metric in _metrics(found, config.metrics)}
    return Comparison(common.dataset, common.split, found, cells)


def _check_metrics(wanted: tuple[str, ...] | None) -> None:
    """Raise `InputError` for words that are no metrics."""
    if wanted == ():
        raise InputError("--metrics", "names no metric", "leave it out for the usual ones")
    for word in wanted or ():
        if word not in NAMES:
            remedy = f"name RUNS before it; there are: {', '.join(NAMES)}"
            raise InputError("--metrics", f"no metric '{word}'", remedy)


def _check_different(named: dict[str, list[Path]], config: CompareConfig) -> None:
    """Raise `InputError` where an evaluation stands twice, in two rows or as two seeds of one."""
    taken: dict[Path, Path] = {}
    for folder in (folder for word in config.rows for folder in named[word]):
        is_run = rows.is_run(folder)
        own = figures.how(folder, config.split, config.estimator)[1] if is_run else folder
        if other := taken.get(own.resolve()):
            problem = "is named twice" if folder == other else f"is the same evaluation as {other}"
            raise InputError(str(folder), problem, "name each once")
        taken[own.resolve()] = folder


def _metrics(found: list[Row], wanted: tuple[str, ...] | None) -> list[str]:
    """Those that are wanted; by default the usual ones that some row has."""
    there = {metric for row in found for seed in row.seeds for metric in seed["mean"]}
    for metric in wanted or ():
        if metric not in there:
            has = ", ".join(name for name in NAMES if name in there)
            raise InputError("--metrics", f"no row has '{metric}'", f"there are: {has}")
    return list(wanted) if wanted else [metric for metric in USUAL if metric in there]


def _common_recordings(named: dict[str, list[Path]], config: CompareConfig) -> Recordings:
    """Dataset, split and alignment of all rows. Raises `InputError` where they differ."""
    found = {
        folder: rows.recordings(folder, config) for folders in named.values() for folder in folders
    }
    first = next(iter(found.values()))
    for folder, own in found.items():
        for field, here, there in zip(Recordings._fields, own, first, strict=True):
            if here == there:
                continue
            remedy = f"compare evaluations of one {field}"
            split = next((each.split for path, each in found.items() if not rows.is_run(path)), "")
            if field == "split" and split:
                remedy = f"give --split {split} for the runs, or {remedy}"
            problem = f"is of {field} {here}, the first row of {there}"
            raise InputError(str(folder), problem, remedy)
    return first


def _check_same_sequences(found: list[Row]) -> None:
    """Raise `InputError` where sequences of one name are different recordings, or belong to
    different people or sessions: the seeds of a row are compared too."""
    known: dict[str, tuple[Path, Mapping[str, Any]]] = {}
    evaluations = [each for row in found for each in zip(row.folders, row.seeds, strict=True)]
    for folder, seed in evaluations:
        for name, own in seed["sequences"].items():
            first, other = known.setdefault(name, (folder, own))
            remedy = f"evaluate it again, or {first}"
            if own["group"] != other["group"]:
                problem = f"is of {own['group']} here, of {other['group']} in {first}"
                raise InputError(str(folder), f"sequence {name} {problem}", remedy)
            lengths = [each.get("duration") or 0.0 for each in (own, other)]
            if abs(lengths[0] - lengths[1]) > SAME_LENGTH * max(lengths):
                problem = f"takes {lengths[0]:.0f} s here, {lengths[1]:.0f} s in {first}"
                raise InputError(str(folder), f"sequence {name} {problem}", remedy)


def _labels(found: list[Row]) -> list[str]:
    """The rows' names without the folders that all begin with, and those that all end with."""
    paths = [Path(os.path.abspath(row.label)) for row in found]
    common = os.path.commonpath([path.parent for path in paths])
    parts = [path.relative_to(common).parts for path in paths]
    while len({each[-1] for each in parts}) == 1 and all(len(each) > 1 for each in parts):
        parts = [each[:-1] for each in parts]
    return [str(Path(*each)) for each in parts]


def _cells(found: list[Row], metric: str) -> list[Cell]:
    """One metric of every row."""
    group_of = pairs.groups([seed for row in found for seed in row.seeds])
    first, best = found[0].seeds, BEST.get(metric, 0.0)
    return [
        Cell(
            label=row.label,
            seeds=pairs.means(row.seeds, metric),
            diverged=sum(seed["mean"]["diverged"] for seed in row.seeds),
            estimates=sum(len(seed["sequences"]) for seed in row.seeds),
            difference=pairs.compare(row.seeds, first, group_of, metric, best)
            if number and pairs.names(row.seeds, metric)
            else None,
        )
        for number, row in enumerate(found)
    ]
