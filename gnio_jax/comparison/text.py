"""A comparison as Markdown and CSV, and the cells of its table."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from gnio_jax.comparison.comparing import BEST, Cell, Comparison
from gnio_jax.comparison.pairs import Difference
from gnio_jax.evaluation.table import COLUMNS, Column
from gnio_jax.files import write_csv, write_text

HEADER = ["metric", "row", "mean", "difference (95 %)", "better in"]
FEW_GROUPS = 10
"""With fewer the interval of a mean leaves out the truth more than twice as often as it says."""


def grid(header: list[str], table: list[list[str]]) -> str:
    """Cells as a Markdown table."""
    lines = [header, ["---"] * len(header), *table]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def spread(values: list[float]) -> float:
    """Standard deviation over seeds; NaN of one."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def write(path: Path, comparison: Comparison) -> None:
    """`path`.md and `path`.csv."""
    text = f"{title(comparison)}\n\n{grid(HEADER, lines(comparison))}\n"
    text += "".join(f"{line}\n\n" for line in explanations(comparison))
    write_text(f"{path}.md", text.rstrip() + "\n")
    write_csv(f"{path}.csv", _csv_lines(comparison))


def title(comparison: Comparison) -> str:
    """Recordings, and the first row."""
    return (
        f"{comparison.dataset} {comparison.split}; differences to {comparison.rows[0].label}, "
        "paired by sequence"
    )


def lines(comparison: Comparison) -> list[list[str]]:
    """The table's lines: each metric's rows one below the other."""
    return [
        [heading(metric) if number == 0 else "", *_texts(cell, column(metric).digits)]
        for metric, cells in comparison.cells.items()
        for number, cell in enumerate(cells)
    ]


def explanations(comparison: Comparison) -> list[str]:
    """What a reader must know of the figures."""
    found = [_seeds(comparison)]
    differences = [cell.difference for cell in _cells(comparison) if cell.difference]
    groups = sorted({difference.groups for difference in differences if difference.interval})
    if groups:
        drawn = " or ".join(map(str, groups))
        found.append(f"The interval draws people or sessions anew; there are {drawn}.")
    elif any(difference.groups == 1 for difference in differences):
        found.append("No interval: the sequences are of one person or session.")
    if groups and groups[0] < FEW_GROUPS:
        found.append(
            "With so few it is too narrow: where runs do not differ, it leaves out 0 in 26 % of "
            "the cases with 3 groups, in 15 % with 6 and in 9 % with 10."
        )
    if any(difference.compared < difference.sequences for difference in differences):
        found.append(
            "A difference is over the sequences that both rows have and in which neither diverged; "
            "a mean is over all that a row has."
        )
    if any(cell.diverged for cell in _cells(comparison)):
        found.append("† Without the estimates that diverged, so many of all.")
    return found


def _seeds(comparison: Comparison) -> str:
    """How many there are."""
    counts = [len(row.seeds) for row in comparison.rows]
    if max(counts) == 1:
        return "One seed each: what another seed would give is not known."
    each = ", ".join(f"{row.label} {len(row.seeds)}" for row in comparison.rows)
    said = f"{counts[0]} each" if len(set(counts)) == 1 else each
    return f"Seeds: {said}; ± is their standard deviation."


def column(metric: str) -> Column:
    """How a metric is written: as in the table of an evaluation, where it is there."""
    return {**COLUMNS, "nees": Column("NEES/3", "", 2)}.get(metric, Column(metric, "", 3))


def heading(metric: str) -> str:
    """Name, unit, and the best value where that is not 0."""
    unit = column(metric).unit
    best = f"best {BEST[metric]:g}" if metric in BEST else ""
    remarks = ", ".join(filter(None, (unit, best)))
    return f"{column(metric).heading} ({remarks})" if remarks else column(metric).heading


def _cells(comparison: Comparison) -> list[Cell]:
    return [cell for cells in comparison.cells.values() for cell in cells]


def _texts(cell: Cell, digits: int) -> list[str]:
    """Row, mean, difference, sequences in which it is better."""
    found = cell.difference
    better = f"{found.better} of {found.compared}" if found and found.compared else ""
    return [cell.label, _mean(cell, digits), _difference(found, digits), better]


def _mean(cell: Cell, digits: int) -> str:
    text = f"{np.mean(cell.seeds):.{digits}f}" if cell.seeds else "–"
    if len(cell.seeds) > 1:
        text += f" ± {spread(cell.seeds):.{digits}f}"
    return f"{text} † {cell.diverged}/{cell.estimates}" if cell.diverged else text


def _difference(found: Difference | None, digits: int) -> str:
    """Of the first row nothing; with another row a dash where no sequence can be compared."""
    if found is None:
        return ""
    if found.mean is None:
        return "–"
    low, high = found.interval or (None, None)
    between = "" if low is None else f" ({low:+.{digits}f} to {high:+.{digits}f})"
    over = f" over {found.compared}" if found.compared < found.sequences else ""
    return f"{found.mean:+.{digits}f}{between}{over}"


def _csv_lines(comparison: Comparison) -> list[list[object]]:
    """Header and lines; empty where there is no value."""
    header: list[object] = ["metric", "row", "seeds", "mean", "std", "diverged", "difference"]
    header += ["difference_low", "difference_high", "better", "compared", "sequences", "groups"]
    table = [header]
    for metric, cells in comparison.cells.items():
        for row, cell in zip(comparison.rows, cells, strict=True):
            found = cell.difference or Difference(None, None, None, 0, 0, 0, 0)
            low, high = found.interval or (None, None)
            numbers = [np.mean(cell.seeds) if cell.seeds else None]
            numbers += [spread(cell.seeds) if len(cell.seeds) > 1 else None]
            texts = ["" if value is None else repr(float(value)) for value in numbers]
            differences = [
                "" if value is None else repr(float(value)) for value in (found.mean, low, high)
            ]
            line = [metric, cell.label, len(row.seeds), *texts, cell.diverged, *differences]
            table.append([*line, found.better, found.compared, found.sequences, found.groups])
    return table
