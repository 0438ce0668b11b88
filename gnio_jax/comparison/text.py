"""A comparison as Markdown and CSV, and the cells of its table."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from gnio_jax.comparison.comparing import BEST, Cell, Comparison
from gnio_jax.comparison.pairs import Difference
from gnio_jax.comparison.rows import Row
from gnio_jax.evaluation.table import COLUMNS, Column
from gnio_jax.files import with_ending, write_csv, write_text

HEADER = ["metric", "row", "mean", "difference (95 %)", "better in"]


def grid(header: list[str], table: list[list[str]]) -> str:
    """Cells as a Markdown table."""
    lines = [header, ["---"] * len(header), *table]
    escaped = [[" ".join(cell.split()).replace("|", "\\|") for cell in cells] for cells in lines]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in escaped)


def spread(values: list[float]) -> float:
    """Standard deviation over seeds; NaN of one."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def write(path: Path, comparison: Comparison) -> None:
    """`path`.md and `path`.csv."""
    text = f"{title(comparison)}\n\n{grid(HEADER, lines(comparison))}\n"
    text += "".join(f"{line}\n\n" for line in explanations(comparison))
    write_text(with_ending(path, ".md"), text.rstrip() + "\n")
    write_csv(with_ending(path, ".csv"), _csv_lines(comparison))


def title(comparison: Comparison) -> str:
    """Recordings, how the trajectories are estimated, and the first row."""
    ways = {way(row) for row in comparison.rows}
    how = f", {ways.pop()}" if len(ways) == 1 else ""
    return (
        f"{comparison.dataset} {comparison.split}{how}; differences to "
        f"{comparison.rows[0].label}, paired by sequence"
    )


def way(row: Row) -> str:
    """How a row's trajectories are estimated: what changes the meaning of its errors."""
    return " and ".join(dict.fromkeys(_way(figures["settings"]) for figures in row.seeds))


def _way(settings: dict[str, Any]) -> str:
    """The estimator, where its attitude comes from, and what is not as usual."""
    said = [settings.get("estimator") or "estimator not known"]
    if settings.get("coupling") == "loose":
        said.append("loosely coupled")
    if source := settings.get("orientation_source"):
        said.append(f"attitude of the {source}")
    if settings.get("initial_state", "reference") != "reference":
        said.append(f"{settings['initial_state']} start")
    if settings.get("gyro_bias", "zero") != "zero":
        said.append(f"gyro bias of the {settings['gyro_bias']}")
    if settings.get("alignment", "origin") != "origin":
        said.append(f"aligned by {settings['alignment']}")
    if settings.get("checkpoint") not in (None, "best"):
        said.append(f"{settings['checkpoint']} checkpoint")
    return ", ".join(said)


def filter_options(comparison: Comparison) -> list[str]:
    """Names of the filter's options in which a row differs from the first."""
    found: list[dict[str, list[Any]]] = []
    for row in comparison.rows:
        values: dict[str, list[Any]] = {}
        for settings in (figures["settings"] for figures in row.seeds):
            given = settings.get("filter") if settings.get("estimator") != "integrate" else None
            for name, value in (given or {}).items():
                values.setdefault(name, []).append(value)
        found.append(values)
    both = [(found[0], other) for other in found[1:] if found[0] and other]
    return sorted(
        {name for a, b in both for name in a | b if _differ(a.get(name, []), b.get(name, []))}
    )


def _differ(some: list[Any], others: list[Any]) -> bool:
    """Whether one of the lists has a value that the other has not."""
    return any(a not in others for a in some) or any(b not in some for b in others)


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
    if len({way(row) for row in comparison.rows}) > 1:
        ways = "; ".join(f"{row.label}: {way(row)}" for row in comparison.rows)
        found.append(f"The rows are not estimated alike. {ways}.")
    if options := filter_options(comparison):
        found.append(f"The rows differ in options of the filter: {', '.join(options)}.")
    differences = [cell.difference for cell in _cells(comparison) if cell.difference]
    groups = sorted({difference.groups for difference in differences if difference.interval})
    if groups:
        drawn = " or ".join(map(str, groups))
        found.append(f"The interval is Student's t over people or sessions; there are {drawn}.")
    if any(difference.groups == 1 and not difference.withheld for difference in differences):
        found.append("No interval: the sequences compared are of one person or session.")
    if any(difference.compared < difference.sequences for difference in differences):
        found.append(
            "A difference is over the sequences that both rows have with every seed, and on which "
            "no error is infinite; a mean is over all that a row has with every seed."
        )
    return found + _marks(comparison, differences)


def _marks(comparison: Comparison, differences: list[Difference]) -> list[str]:
    """What †, ‡, ∞ and – mean, where they stand."""
    found, cells = [], _cells(comparison)
    if any(cell.diverged for cell in cells):
        found.append("† So many of all estimates diverged. A mean leaves out their sequences.")
    if any(difference.withheld for difference in differences):
        first = comparison.rows[0].label
        found.append(f"‡ Would be better than {first}, but diverged more often: it is not better.")
    if any(np.isinf(cell.seeds).any() for cell in cells):
        found.append("∞: an error is too large for a number.")
    if any(not cell.seeds for cell in cells):
        found.append("–: there is no such value with every seed, or nothing to compare it with.")
    return found


def _seeds(comparison: Comparison) -> str:
    """How many there are, and which runs."""
    if max(len(row.seeds) for row in comparison.rows) == 1:
        return "One seed each: what another seed would give is not known."
    each = (", ".join(row.runs) if len(row.runs) > 1 else "one" for row in comparison.rows)
    rows = zip(comparison.rows, each, strict=True)
    said = "; ".join(f"{row.label}: {runs}" for row, runs in rows)
    return f"Seeds of {said}. ± is their standard deviation."


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
    counted = found and found.compared and not found.withheld
    better = f"{found.better} of {found.compared}" if found and counted else ""
    return [cell.label, _mean(cell, digits), _difference(found, digits), better]


def _mean(cell: Cell, digits: int) -> str:
    mean = np.mean(cell.seeds) if cell.seeds else math.nan
    text = f"{mean:.{digits}f}" if np.isfinite(mean) else "∞" if cell.seeds else "–"
    if len(cell.seeds) > 1 and np.isfinite(mean):
        text += f" ± {spread(cell.seeds):.{digits}f}"
    return f"{text} † {cell.diverged}/{cell.estimates}" if cell.diverged else text


def _difference(found: Difference | None, digits: int) -> str:
    """Of the first row nothing; with another row a dash where no sequence can be compared."""
    if found is None:
        return ""
    if found.mean is None:
        return "– ‡" if found.withheld else "–"
    low, high = found.interval or (None, None)
    digits = _digits(found, digits)
    between = "" if low is None else f" ({low:+.{digits}f} to {high:+.{digits}f})"
    over = f" over {found.compared}" if found.compared < found.sequences else ""
    return f"{found.mean:+.{digits}f}{between}{over}"


def _digits(found: Difference, digits: int) -> int:
    """Of a difference: those of the mean, and as many more as show two digits of the interval's
    half width, three at most."""
    low, high = found.interval or (0.0, 0.0)
    size = (high - low) / 2 or abs(found.mean or 0.0)
    needed = 1 - math.floor(math.log10(size)) if size else digits
    return min(max(digits, needed), digits + 3)


def _csv_lines(comparison: Comparison) -> list[list[object]]:
    """Header and lines; empty where there is no value."""
    lines = [
        _csv_columns(comparison, metric, row, cell)
        for metric, cells in comparison.cells.items()
        for row, cell in zip(comparison.rows, cells, strict=True)
    ]
    return [[*lines[0]], *([_csv_text(value) for value in line.values()] for line in lines)]


def _csv_columns(comparison: Comparison, metric: str, row: Row, cell: Cell) -> dict[str, object]:
    """Heading -> value."""
    found = cell.difference
    low, high = found.interval if found and found.interval else (None, None)
    return {
        "dataset": comparison.dataset,
        "split": comparison.split,
        "estimated": way(row),
        "metric": metric,
        "row": cell.label,
        "seeds": len(row.seeds),
        "mean": np.mean(cell.seeds) if cell.seeds else None,
        "std": spread(cell.seeds) if len(cell.seeds) > 1 else None,
        "diverged": cell.diverged,
        "estimates": cell.estimates,
        "difference": found and found.mean,
        "difference_low": low,
        "difference_high": high,
        "better": None if found is None or found.withheld else found.better,
        "compared": found and found.compared,
        "sequences": found and found.sequences,
        "groups": found and found.groups,
    }


def _csv_text(value: object) -> object:
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, float) else value
