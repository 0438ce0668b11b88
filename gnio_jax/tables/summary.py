"""Means and spread over seeds, paired differences over sequences, and the files of a table: Markdown, CSV."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.files import replacing
from gnio_jax.tables.experiments import Experiment
from gnio_jax.tables.matrix import Result

COLUMNS = {"ate": "ate m", "ate_2d": "ate 2-D", "ate_ronin_2d": "ate_ronin 2-D", "rpe_1s": "rpe_1s", "rte_60s": "rte_60s",
           "path_length_ratio": "path ratio", "stationary_drift": "standing m/min"}
"""Metrics of every table: name in metrics.json, heading."""
DRAWS = 2000


class Row(NamedTuple):
    """One configuration over its seeds."""

    name: str
    label: str
    published: float | None
    published_gain: float | None
    """% of the first row's published figure."""
    seeds: dict[str, list[float]]
    """Metric -> mean over the sequences, for each seed; a metric without a value is not there."""
    gain: float
    """% by which `ate` is smaller than the first row's."""
    difference: float
    """Of `ate` to the first row: mean over sequences of the means over seeds, m."""
    interval: tuple[float, float] | None
    """95 % of the difference, bootstrapped over sequences; none for the first row or a single sequence."""
    extra: dict[str, float]
    """Figures that belong to this table alone."""


def rows(experiment: Experiment, results: list[Result], extra: dict[str, dict[str, float]] | None = None) -> list[Row]:
    """The table of an experiment; `extra` holds more figures by the name of a cell."""
    tables = [errors(result) for result in results]
    first, published = tables[0], experiment.cells[0].published
    found = []
    for result, table in zip(results, tables, strict=True):
        cell = result.cell
        difference = table.mean(0) - first.mean(0)
        gain = None if cell.published is None or published is None else 100 * (1 - cell.published / published)
        interval = None if cell is results[0].cell else bootstrap(difference)
        found.append(Row(cell.name, cell.label, cell.published, gain, _seeds(result), 100 * (1 - float(table.mean() / first.mean())),
                         float(difference.mean()), interval, (extra or {}).get(cell.name, {})))
    return found


def errors(result: Result) -> Float[np.ndarray, "seeds sequences"]:
    """`ate` of every seed and sequence, m; of the sequences that have one with every seed, in the order of their names."""
    each = [figures["sequences"] for figures in result.figures]
    names = sorted(name for name in each[0] if all(one.get(name, {}).get("ate") is not None for one in each))
    return np.array([[one[name]["ate"] for name in names] for one in each])


def bootstrap(differences: Float[np.ndarray, "n"]) -> tuple[float, float] | None:
    """95 % interval of the mean, by drawing the sequences anew; none of fewer than two."""
    if len(differences) < 2:
        return None
    draws = np.random.default_rng(0).integers(0, len(differences), (DRAWS, len(differences)))
    low, high = np.percentile(differences[draws].mean(1), [2.5, 97.5])
    return float(low), float(high)


def _seeds(result: Result) -> dict[str, list[float]]:
    values = {metric: [figures["mean"].get(metric) for figures in result.figures] for metric in COLUMNS}
    return {metric: [float(v) for v in each] for metric, each in values.items() if all(v is not None for v in each)}


def spread(values: list[float]) -> float:
    """Standard deviation over seeds; NaN of one."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def arrow(gain: float | None) -> str:
    """As the paper prints gains: ↓ and the share by which the error is smaller, ↑ by which it is larger."""
    return "" if gain is None else "0 %" if round(gain, 1) == 0 else f"{'↓' if gain > 0 else '↑'} {abs(gain):.1f} %"


def markdown(experiment: Experiment, found: list[Row], notes: list[str]) -> str:
    """The table as Markdown, means ± standard deviations over seeds."""
    extra = list(dict.fromkeys(name for row in found for name in row.extra))
    metrics = [metric for metric in COLUMNS if any(metric in row.seeds for row in found)]
    header = ["", *(COLUMNS[metric] for metric in metrics), *extra, "gain", "difference of ate, m (95 %)", "published m", "its gain"]
    table = []
    for row in found:
        cells = [_with_spread(row.seeds[metric]) if metric in row.seeds else "–" for metric in metrics]
        cells += [f"{row.extra[name]:.3g}" if name in row.extra else "–" for name in extra]
        compared = row is not found[0]
        between = f" ({row.interval[0]:+.2f} to {row.interval[1]:+.2f})" if row.interval else ""
        cells += [arrow(row.gain) if compared else "", f"{row.difference:+.2f}{between}" if compared else "",
                  "–" if row.published is None else f"{row.published:.2f}", arrow(row.published_gain) if compared else ""]
        table.append([row.label, *cells])
    return "\n".join([f"## {experiment.title}", "", *notes, ""]) + "\n" + grid(header, table)


def grid(header: list[str], table: list[list[str]]) -> str:
    """Cells as a Markdown table."""
    return "".join(f"| {' | '.join(cells)} |\n" for cells in [header, ["---"] * len(header), *table])


def _with_spread(values: list[float]) -> str:
    digits = 3 if abs(np.mean(values)) < 1 else 2
    return f"{np.mean(values):.{digits}f}" + (f" ± {spread(values):.{digits}f}" if len(values) > 1 else "")


def write(path: Path, experiment: Experiment, found: list[Row], notes: list[str]) -> None:
    """`path`.md and `path`.csv."""
    with replacing(path.with_suffix(".md")) as temporary:
        temporary.write_text(markdown(experiment, found, notes), encoding="utf-8")
    metrics = list(COLUMNS)
    extra = list(dict.fromkeys(name for row in found for name in row.extra))
    with replacing(path.with_suffix(".csv")) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["name", "label", "seeds", *metrics, *(f"{metric}_std" for metric in metrics), *extra, "gain_percent", "difference",
                        "difference_low", "difference_high", "published", "published_gain_percent"])
        for row in found:
            means = [np.mean(row.seeds[m]) if m in row.seeds else "" for m in metrics]
            spreads = [spread(row.seeds[m]) if len(row.seeds.get(m, [])) > 1 else "" for m in metrics]
            low, high = row.interval or ("", "")
            seeds, more = len(next(iter(row.seeds.values()), [])), [row.extra.get(name, "") for name in extra]
            values = [*means, *spreads, *more, row.gain, row.difference, low, high, row.published, row.published_gain]
            table.writerow([row.name, row.label, seeds, *("" if value is None or value == "" else repr(float(value)) for value in values)])
