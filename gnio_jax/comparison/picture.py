"""A comparison as a picture: every sequence with every row. Import it only where one is drawn
(Matplotlib)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gnio_jax.comparison import pairs, text
from gnio_jax.comparison.comparing import Comparison
from gnio_jax.comparison.figures import Figures
from gnio_jax.evaluation import plots
from gnio_jax.files import replacing, shown_name

COLOURS = (plots.GREY, plots.BLUE, plots.VERMILION, plots.GREEN, "#CC79A7", "#E69F00", "#56B4E9")
"""The first row grey, the others in the colours of Okabe and Ito."""
MARKERS = "os^Dv"
"""The next one where the colours begin anew."""


def save(path: Path, figure: Figure) -> None:
    """Write one figure as PNG, whole or not at all."""
    with replacing(path) as temporary:
        plots.save(temporary, figure)


def draw(comparison: Comparison) -> Figure:
    """The first metric that has values: a line per sequence, sorted by the first row; each row's
    mean over seeds a dot, each seed a fainter stroke, the rows one below the other. Beside the
    names, the people or sessions they belong to, and a mark where a row diverged."""
    seeds = [row.seeds for row in comparison.rows]
    drawn = [metric for metric, cells in comparison.cells.items() if any(c.seeds for c in cells)]
    metric = next(iter(drawn or comparison.cells))
    tables = [pairs.errors(row, metric) for row in seeds]
    names = _by_first_row(tables)
    height = 0.24 + 0.08 * len(tables)
    figure = Figure(figsize=(8.0, 2.0 + height * len(names)), layout="constrained")
    axes = figure.add_subplot()
    rows = zip(comparison.rows, tables, strict=True)
    handles = [
        _draw_row(axes, table, names, number, len(tables)) for number, (_, table) in enumerate(rows)
    ]
    legend = [shown_name(row.label, 100) for row in comparison.rows]
    lost = {name for row in seeds for name in pairs.diverged(row)}
    axes.set_yticks(range(len(names)), _tick_labels(names, seeds, lost), fontsize=8)
    axes.set_xlabel(text.heading(metric))
    axes.set_title(f"{comparison.dataset} {comparison.split}", fontsize=11)
    if lost & {*names}:
        handles.append(Line2D([], [], ls=""))
        legend.append("† an estimate diverged")
    _legend(figure, handles, legend)
    plots.finish(axes)
    return figure


def _tick_labels(names: list[str], seeds: list[list[Figures]], lost: set[str]) -> list[str]:
    """Names of the sequences, their people or sessions, and which diverged."""
    group_of = pairs.groups([figures for row in seeds for figures in row])
    return [
        f"{shown_name(name, 40)}  ({shown_name(group_of[name], 20)})"
        + (" †" if name in lost else "")
        for name in names
    ]


def _legend(figure: Figure, handles: list[Line2D], labels: list[str]) -> None:
    """Below the axes. Matplotlib leaves out what begins with an underscore: a space of no width
    goes before it."""
    columns = 2 if max(map(len, labels)) < 40 else 1
    shown = ["\u200b" + label if label.startswith("_") else label for label in labels]
    place = "outside lower center"
    figure.legend(handles, shown, fontsize=8, frameon=False, loc=place, ncols=columns)


def _by_first_row(tables: list[pairs.Errors]) -> list[str]:
    """Sequences of any row, those with the largest errors of the first row on top; those that it
    has not, below."""
    names = dict.fromkeys(name for table in tables for name in table)
    first = tables[0]
    return sorted(names, key=lambda name: (name in first, np.mean(first.get(name, 0.0)), name))


def _draw_row(axes: Axes, table: pairs.Errors, names: list[str], number: int, count: int) -> Line2D:
    """Dots of one of `count` rows. What diverged has none."""
    colour = COLOURS[number % len(COLOURS)]
    marker = MARKERS[number // len(COLOURS) % len(MARKERS)]
    below = 0.6 * (number / (count - 1) - 0.5)  # equal values would hide each other
    places = [place - below for place, name in enumerate(names) if name in table]
    values = [table[name] for name in names if name in table]
    means = [value.mean() if np.isfinite(value).all() else np.nan for value in values]
    (dots,) = axes.plot(means, places, marker, ms=6, color=colour, zorder=3)
    for place, value in zip(places, values, strict=True):
        if len(value) > 1:
            axes.plot(value, [place] * len(value), "|", ms=8, color=colour, alpha=0.6)
    return dots
