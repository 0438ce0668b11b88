"""The tables of `gnio data`: what there is, and what the self-check finds."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rich.table import Table

from gnio_jax.data import registry
from gnio_jax.data.checking import CheckedSequence
from gnio_jax.data.dataset import Dataset
from gnio_jax.data.reading import find_recordings
from gnio_jax.errors import InputError

_CHECK_COLUMNS = (
    "sequence",
    "split",
    "s",
    "Hz",
    "mean of R·accel\nm/s²",
    "gyro\n°/10 s",
    "speed\nm/s",
    "accel\ncorr.",
    "valid",
    "",
)
_TEXT_COLUMNS = ("sequence", "split", "")


def datasets() -> tuple[Table, Table]:
    """What there is and what of it is here, and where it is had."""
    here = Table(title="Datasets", title_justify="left", show_lines=True)
    for column in ("dataset", "Hz", "splits", "licence", "found here"):
        here.add_column(column, overflow="fold", justify="right" if column == "Hz" else "left")
    title = "Where they are had, and the layout that is expected"
    sources = Table(title=title, title_justify="left", show_lines=True)
    for column in ("dataset", "where", "layout"):
        sources.add_column(column, overflow="fold")
    for name in registry.names():
        dataset = registry.get(name)
        splits = ", ".join(dataset.splits)
        here.add_row(name, f"{dataset.rate:g}", splits, dataset.licence, _found_here(dataset))
        sources.add_row(name, dataset.source, dataset.layout if dataset.needs_root else "–")
    return here, sources


def _found_here(dataset: Dataset) -> str:
    try:
        root = registry.find_root(dataset.name) if dataset.needs_root else Path(".")
    except InputError:
        return "not found"
    place = f"{root}: " if dataset.needs_root else "computed: "
    try:
        found, splits, _ = find_recordings(dataset, root, "all")
    except InputError as error:
        return f"{place}no recording ({error})"
    counts = ", ".join(f"{split} {len(names)}" for split, names in splits.items())
    return f"{place}{len(found)} recordings ({counts})"


def check_table(rows: list[CheckedSequence], title: str) -> Table:
    """One line for each sequence; those that are left out are red."""
    table = Table(title=title, title_justify="left")
    for column in _CHECK_COLUMNS:
        text = column in _TEXT_COLUMNS
        width = 14 if column == "sequence" else None
        justify = "left" if text else "right"
        table.add_column(
            column, overflow="fold", justify=justify, no_wrap=not text, min_width=width
        )
    for row in rows:
        table.add_row(*_cells(row), style="red" if row.reason else None)
    return table


def check_markdown(rows: list[CheckedSequence]) -> str:
    """The same table as Markdown."""
    header = [column.replace("\n", " ") for column in _CHECK_COLUMNS]
    rule = ["---" if column in _TEXT_COLUMNS else "--:" for column in _CHECK_COLUMNS]
    lines = [header, rule, *(_cells(row) for row in rows)]
    return "".join(f"| {' | '.join(cell.replace('|', '¦') for cell in line)} |\n" for line in lines)


def _cells(row: CheckedSequence) -> list[str]:
    check = row.check
    if check is None:
        return [row.name, row.split, *["–"] * 7, "left out"]
    gravity = " ".join(f"{round(value, 2) + 0.0:.2f}" for value in check.gravity_mean)
    return [
        row.name,
        row.split,
        f"{check.duration:.1f}",
        f"{check.rate:.1f}",
        "–" if np.isnan(check.gravity_mean).any() else gravity,
        _number(check.gyro_consistency_degrees),
        _number(check.median_speed),
        _number(check.accel_correlation_horizontal),
        f"{check.share_valid:.1%}",
        "left out" if row.reason else "used",
    ]


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2f}"
