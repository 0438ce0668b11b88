"""A comparison as a picture: every sequence with every row. Import it only where one is drawn
(Matplotlib)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gnio_jax.comparison import pairs, text
from gnio_jax.comparison.comparing import Comparison
from gnio_jax.evaluation import plots
from gnio_jax.files import replacing

COLOURS = (plots.GREY, plots.BLUE, plots.VERMILION, plots.GREEN, "#CC79A7", "#E69F00", "#56B4E9")
"""The first row grey, the others in the colours of Okabe and Ito."""


def save(path: Path, figure: Figure) -> None:
    """Write one figure as PNG, whole or not at all."""
    with replacing(path) as temporary:
        plots.save(temporary, figure)


def draw(comparison: Comparison) -> Figure:
    """The first metric: a line per sequence, sorted by the first row; each row's mean over seeds a
    dot, each seed a fainter stroke. Beside the names, the people or sessions they belong to, and a
    mark where a row diverged."""
    metric = next(iter(comparison.cells))
    tables = [pairs.errors(row.seeds, metric) for row in comparison.rows]
    names = _by_first_row(tables)
    figure = Figure(figsize=(8.0, 1.8 + 0.32 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    for number, (row, table) in enumerate(zip(comparison.rows, tables, strict=True)):
        _draw_row(axes, row.label, table, names, COLOURS[number % len(COLOURS)])
    group_of = pairs.groups([seed for row in comparison.rows for seed in row.seeds])
    marks = {True: " †", False: ""}
    labels = [f"{name}  ({group_of[name]}){marks[_lost(tables, name)]}" for name in names]
    axes.set_yticks(range(len(names)), labels, fontsize=8)
    axes.set_xlabel(text.heading(metric))
    axes.set_title(f"{comparison.dataset} {comparison.split}", fontsize=11)
    if any(_lost(tables, name) for name in names):
        axes.plot([], [], " ", label="† an estimate diverged")
    figure.legend(
        *axes.get_legend_handles_labels(),
        fontsize=8,
        frameon=False,
        loc="outside lower center",
        ncols=2,
    )
    plots.finish(axes)
    return figure


def _by_first_row(tables: list[pairs.Errors]) -> list[str]:
    """Sequences of any row, those with the largest errors of the first row on top; those that it
    has not, below."""
    names = dict.fromkeys(name for table in tables for name in table)
    first = tables[0]
    return sorted(names, key=lambda name: (name in first, np.mean(first.get(name, 0.0)), name))


def _lost(tables: list[pairs.Errors], name: str) -> bool:
    """Whether any estimate of a sequence diverged."""
    return any(not np.isfinite(table[name]).all() for table in tables if name in table)


def _draw_row(axes: Axes, label: str, table: pairs.Errors, names: list[str], colour: str) -> None:
    """Dots of one row. What diverged has none."""
    places = [place for place, name in enumerate(names) if name in table]
    values = [table[names[place]] for place in places]
    means = [value.mean() if np.isfinite(value).all() else np.nan for value in values]
    axes.plot(means, places, "o", ms=7, color=colour, label=label, zorder=3)
    for place, value in zip(places, values, strict=True):
        if len(value) > 1:
            axes.plot(value, [place] * len(value), "|", ms=9, color=colour, alpha=0.6)
