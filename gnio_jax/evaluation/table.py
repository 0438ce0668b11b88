"""The figures of an evaluation as a table on the screen."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.scores import Scores


class Column(NamedTuple):
    heading: str
    unit: str
    digits: int


COLUMNS = {
    "duration": Column("time", "s", 0),
    "path_length": Column("path", "m", 0),
    "ate": Column("ATE", "m", 2),
    "ate_2d": Column("ATE 2-D", "m", 2),
    "rte_60s": Column("RTE 60 s", "m", 2),
    "rpe_1s": Column("RPE 1 s", "m", 3),
    "yaw_rmse": Column("yaw", "°", 1),
    "path_length_ratio": Column("path ratio", "", 2),
    "stationary_drift": Column("standing", "m/min", 1),
    "nees_coverage": Column("NEES<95 %", "%", 0),
    "nis": Column("NIS/3", "", 2),
    "accepted": Column("accepted", "%", 0),
}
"""Metrics in the table. The files hold them all."""

DIVERGENCE = (
    "∞: the estimate diverged. It counts in medians, with infinite errors and coverages of 0; "
    "means, intervals and n are in every column of the others alone, so they cannot be compared "
    "with those of another run"
)


def render(report: Report) -> Group:
    """The table and what belongs under it, for `rich.console.Console.print`."""
    return Group(_grid(report), *_lines(report))


def _grid(report: Report) -> Table:
    """A row per sequence, then the set's, then the reference rows."""
    scores = report.scores
    measured, summary = scores.sequences, scores.summary
    shown = [name for name in COLUMNS if any(name in m.values for m in measured.values())]
    grid = _empty_grid(report, shown)

    def add(label: str, values: Mapping[str, Any], style: str = "", last: bool = False) -> None:
        cells = (_cell(values.get(name), COLUMNS[name].digits) for name in shown)
        grid.add_row(Text(label), *cells, style=style, end_section=last)

    names = list(measured)
    for name in names:
        add(name, measured[name].values, last=name == names[-1])
    add(_mean_of(scores), summary.mean, "bold")
    add("median", summary.median)
    groups = [summary.groups[name] for name in shown if summary.interval.get(name)]
    over = f" ({max(groups)} groups)" if groups else ""
    add(f"95 % interval{over}", summary.interval)
    if scores.diverged:
        grid.add_row("diverged", *_counts(summary.diverged, shown), style="bold red")
    grid.add_row("n", *_counts(summary.count, shown), style="dim", end_section=True)
    for label, reference in report.reference_rows.items():
        label = f"{label} ({_mean_of(reference)})" if reference.diverged else label
        add(label, reference.summary.mean, "italic")
    return grid


def _empty_grid(report: Report, shown: list[str]) -> Table:
    """The table's title and columns."""
    settings = report.settings
    coupling = f", {settings['coupling']} coupling" if settings["estimator"] == "ekf" else ""
    grid = Table(
        title=f"{settings['dataset']} {settings['split']}: {settings['estimator']}{coupling}",
        title_style="bold",
        title_justify="left",
        box=box.SIMPLE_HEAD,
    )
    longest = max(map(len, [*report.scores.sequences, *report.reference_rows]))
    grid.add_column("sequence", overflow="fold", min_width=min(40, longest))
    for name in shown:
        heading, unit, _ = COLUMNS[name]
        # Not as markup, which the console of results does not read.
        label = Text.assemble(heading, "\n", (unit, "dim"))
        grid.add_column(label, justify="right", no_wrap=True)
    return grid


def _lines(report: Report) -> list[Text]:
    """How the figures were made, what the signs mean, notes, and what was left out."""
    settings = report.settings
    words = [
        f"window orientation: {settings['orientation_source']}",
        f"initial state: {settings['initial_state']}",
        f"gyro bias: {settings['gyro_bias']}",
        f"IMU compensated: {settings['imu_compensated']}",
        f"alignment: {settings['alignment']}",
    ]
    signs = "reference rows are means; – is not defined (the reason is in metrics.json)"
    warnings = [*_notes(report)]
    warnings += [f"left out: {name}: {reason}" for name, reason in report.left_out.items()]
    if any(scores.diverged for scores in (report.scores, *report.reference_rows.values())):
        warnings.insert(0, DIVERGENCE)
    return [
        Text("; ".join(words), style="dim"),
        Text(signs, style="dim"),
        *(Text(line, style="yellow") for line in warnings),
    ]


def _notes(report: Report) -> list[str]:
    """Each note once, with the sequences it is of."""
    sequences: dict[str, list[str]] = {}
    for name, notes in report.notes.items():
        for note in notes:
            sequences.setdefault(note, []).append(name)
    return [
        f"{', '.join(names) if len(names) < 4 else f'{len(names)} sequences'}: {note}"
        for note, names in sequences.items()
    ]


def _mean_of(scores: Scores) -> str:
    return f"mean without {len(scores.diverged)} diverged" if scores.diverged else "mean"


def _counts(counts: Mapping[str, int], shown: Iterable[str]) -> list[str]:
    return [str(counts.get(name, 0)) for name in shown]


def _cell(value: Any, digits: int) -> str:
    if value is None:
        return "–"
    if value == math.inf:
        return "∞"
    if isinstance(value, tuple):
        return f"{_cell(value[0], digits)}–{_cell(value[1], digits)}"
    return f"{value:.{digits}f}" if abs(value) < 10 ** (7 - digits) else f"{value:.1e}"
