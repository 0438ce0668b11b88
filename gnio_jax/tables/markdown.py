"""A table of an experiment as Markdown and CSV."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from gnio_jax.comparison.text import grid, spread
from gnio_jax.files import with_ending, write_csv, write_text
from gnio_jax.tables.experiments import Experiment
from gnio_jax.tables.summary import COLUMNS, TableRow

INTERVAL = "The 95 % interval is Student's t over people or sessions; there are {}."
DIVERGED = (
    "† Over the sequences on which no seed diverged. The median counts a diverged one as infinite. "
    "Gain and difference are over the sequences in which neither row diverged. A row that would be "
    "better there but diverged more often than the first has neither."
)


def write(path: Path, experiment: Experiment, found: list[TableRow], notes: list[str]) -> None:
    """`path`.md and `path`.csv."""
    write_text(with_ending(path, ".md"), render(experiment, found, notes))
    write_csv(with_ending(path, ".csv"), _csv_lines(found))


def render(experiment: Experiment, found: list[TableRow], notes: list[str]) -> str:
    """The table as Markdown: means ± standard deviations over seeds, then what its marks mean."""
    columns = _columns(found)
    table = [[cells[number] for cells in columns.values()] for number in range(len(found))]
    head = "\n".join([f"## {experiment.title}", "", *notes, ""])
    text = f"{head}\n{grid([*columns], table)}"
    return text + "".join(f"\n{line}\n" for line in _explanations(found))


def _columns(found: list[TableRow]) -> dict[str, list[str]]:
    """Heading -> cell of every row."""
    others = [metric for metric in COLUMNS if metric != "ate"]
    measured = [metric for metric in others if any(metric in row.seeds for row in found)]
    columns = {
        "": [row.label for row in found],
        COLUMNS["ate"]: [_mean(row, "ate") for row in found],
        "median": [_median(row) for row in found],
    }
    columns |= {COLUMNS[metric]: [_mean(row, metric) for row in found] for metric in measured}
    if any(row.diverged for row in found):
        columns["diverged"] = [f"{row.diverged} of {row.estimates}" for row in found]
    columns |= {name: [_extra(row, name) for row in found] for name in _extra_names(found)}
    # The first row is what the others are compared with.
    compared = found[1:]
    columns["gain"] = ["", *("–" if row.gain is None else arrow(row.gain) for row in compared)]
    columns["difference of ate, m (95 %)"] = ["", *(_difference(row) for row in compared)]
    columns["published m"] = [
        "–" if row.published is None else f"{row.published:.2f}" for row in found
    ]
    columns["its gain"] = ["", *(arrow(row.published_gain) for row in compared)]
    return columns


def arrow(gain: float | None) -> str:
    """As the paper prints gains: ↓ and the share by which the error is smaller, ↑ by which it is
    larger."""
    if gain is None:
        return ""
    if round(gain, 1) == 0:
        return "0 %"
    return f"{'↓' if gain > 0 else '↑'} {abs(gain):.1f} %"


def _mean(row: TableRow, metric: str) -> str:
    if metric not in row.seeds:
        return "–"
    values = row.seeds[metric]
    digits = _digits(float(np.mean(values)))
    text = f"{np.mean(values):.{digits}f}"
    if len(values) > 1:
        text += f" ± {spread(values):.{digits}f}"
    return f"{text} †" if row.diverged else text


def _median(row: TableRow) -> str:
    if row.median is None:
        return "–"
    return "∞" if math.isinf(row.median) else f"{row.median:.{_digits(row.median)}f}"


def _difference(row: TableRow) -> str:
    if row.difference is None:
        return "–"
    between = f" ({row.interval[0]:+.2f} to {row.interval[1]:+.2f})" if row.interval else ""
    over = f" over {row.compared} of {row.sequences}" if row.compared < row.sequences else ""
    return f"{row.difference:+.2f}{between}{over}"


def _extra(row: TableRow, name: str) -> str:
    return f"{row.extra[name]:.3g}" if name in row.extra else "–"


def _extra_names(found: list[TableRow]) -> list[str]:
    return list(dict.fromkeys(name for row in found for name in row.extra))


def _digits(value: float) -> int:
    return 3 if abs(value) < 1 else 2


def _explanations(found: list[TableRow]) -> list[str]:
    lines = []
    drawn = {row.groups for row in found if row.interval}
    if drawn:
        lines.append(INTERVAL.format(" or ".join(map(str, sorted(drawn)))))
    if any(row.diverged for row in found):
        lines.append(DIVERGED)
    return lines


def _csv_lines(found: list[TableRow]) -> list[list[object]]:
    """Header and rows; empty where there is no value."""
    columns = [_csv_columns(row, _extra_names(found)) for row in found]
    return [[*columns[0]], *([*row.values()] for row in columns)]


def _csv_columns(row: TableRow, extra: list[str]) -> dict[str, object]:
    """Heading -> value."""
    low, high = row.interval or (None, None)
    means = {m: np.mean(row.seeds[m]) if m in row.seeds else None for m in COLUMNS}
    spreads = {
        f"{m}_std": spread(row.seeds[m]) if len(row.seeds.get(m, [])) > 1 else None for m in COLUMNS
    }
    numbers = {
        **means,
        **spreads,
        **{name: row.extra.get(name) for name in extra},
        "gain_percent": row.gain,
        "difference": row.difference,
        "difference_low": low,
        "difference_high": high,
        "published": row.published,
        "published_gain_percent": row.published_gain,
        "ate_median": row.median,
    }
    return {
        "name": row.name,
        "label": row.label,
        "seeds": len(next(iter(row.seeds.values()), [])),
        **{key: "" if value is None else repr(float(value)) for key, value in numbers.items()},
        "diverged": row.diverged,
        "estimates": row.estimates,
        "compared": row.compared,
        "sequences": row.sequences,
        "groups": row.groups,
    }
