"""Means and spread over seeds, differences over pairs of sequences, and the files of a table."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation import metrics, report
from gnio_jax.files import replacing
from gnio_jax.tables.experiments import Experiment
from gnio_jax.tables.matrix import Result

COLUMNS = {
    "ate": "ate m",
    "ate_2d": "ate 2-D",
    "ate_ronin_2d": "ate_ronin 2-D",
    "rpe_1s": "rpe_1s",
    "rte_60s": "rte_60s",
    "path_length_ratio": "path ratio",
    "stationary_drift": "standing m/min",
}
"""Metrics of every table: name in metrics.json, heading."""


class Row(NamedTuple):
    """One configuration over its seeds.

    An estimate that diverged has an infinite `ate`. It is in `diverged` and `median`; means leave
    it out, and comparisons leave its sequence out on both sides.
    """

    name: str
    label: str
    published: float | None
    published_gain: float | None
    """% of the first row's published figure."""
    seeds: dict[str, list[float]]
    """Metric -> mean over the sequences that did not diverge, for each seed; a metric that has none
    with some seed is not there."""
    median: float | None
    """Of `ate`, m, over seeds × sequences: infinite where half diverged, None without any `ate`."""
    diverged: int
    """Estimates, of seeds × sequences."""
    estimates: int
    """With an `ate`, infinite or not."""
    compared: int
    """Sequences that gain, difference and interval are over: those that both rows have and in which
    neither diverged with any seed."""
    sequences: int
    """Of this row or the first."""
    groups: int
    """People or sessions that the compared sequences belong to."""
    gain: float | None
    """% by which `ate` is smaller than the first row's. None, as are difference and interval,
    without a sequence to compare, and for a row that would gain but diverged more often than the
    first: where it did, it is not better."""
    difference: float | None
    """Of `ate` to the first row: mean over sequences of the means over seeds, m."""
    interval: tuple[float, float] | None
    """95 % of the difference, groups drawn anew (`metrics.bootstrap`); none for the first row or a
    single group."""
    extra: dict[str, float]
    """Figures that belong to this table alone."""


def rows(
    experiment: Experiment, results: list[Result], extra: dict[str, dict[str, float]] | None = None
) -> list[Row]:
    """The table of an experiment; `extra` holds more figures by the name of a cell.

    Sequences are paired by name.
    """
    first, published, group = errors(results[0]), experiment.cells[0].published, groups(results)
    found: list[Row] = []
    for result in results:
        cell, own = result.cell, errors(result)
        every = np.array([ate for one in result.figures for ate in _ates(one).values()], float)
        diverged = int(np.isinf(every).sum())
        pairs = [
            name for name in own if name in first and np.isfinite([*own[name], *first[name]]).all()
        ]
        ours, theirs = (np.array([table[name].mean() for name in pairs]) for table in (own, first))
        drawn = [group[name] for name in pairs]
        gain = 100 * (1 - float(ours.mean() / theirs.mean())) if pairs else None
        difference = float((ours - theirs).mean()) if pairs else None
        interval = metrics.bootstrap(ours - theirs, drawn) if found else None
        more_often = found and diverged * found[0].estimates > found[0].diverged * len(every)
        if more_often and gain is not None and gain > 0:
            gain = difference = interval = None
        published_gain = None
        if cell.published is not None and published is not None:
            published_gain = 100 * (1 - cell.published / published)
        found.append(
            Row(
                name=cell.name,
                label=cell.label,
                published=cell.published,
                published_gain=published_gain,
                seeds=_seeds(result),
                median=float(np.median(every)) if len(every) else None,
                diverged=diverged,
                estimates=len(every),
                compared=len(pairs),
                sequences=len(own.keys() | first.keys()),
                groups=len(set(drawn)),
                gain=gain,
                difference=difference,
                interval=interval,
                extra=(extra or {}).get(cell.name, {}),
            )
        )
    return found


def errors(result: Result) -> dict[str, Float[np.ndarray, "seeds"]]:
    """Sequence -> `ate` with every seed, m, infinite where the estimate diverged.

    Of the sequences that have one with every seed.
    """
    each = [_ates(figures) for figures in result.figures]
    return {
        name: np.array([one[name] for one in each], float)
        for name in sorted(each[0])
        if all(name in one for one in each)
    }


def _ates(figures: dict[str, Any]) -> dict[str, float]:
    """Of the sequences of one metrics.json, those that have one."""
    return {
        name: ate
        for name, one in figures["sequences"].items()
        if (ate := report.read_metric(one, "ate")) is not None
    }


def groups(results: list[Result]) -> dict[str, str]:
    """Sequence -> the person or session it belongs to."""
    return {
        name: one["group"]
        for result in results
        for figures in result.figures
        for name, one in figures["sequences"].items()
    }


def _seeds(result: Result) -> dict[str, list[float]]:
    values = {
        metric: [figures["mean"].get(metric) for figures in result.figures] for metric in COLUMNS
    }
    return {
        metric: [float(v) for v in each]
        for metric, each in values.items()
        if all(v is not None for v in each)
    }


def spread(values: list[float]) -> float:
    """Standard deviation over seeds; NaN of one."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def arrow(gain: float | None) -> str:
    """As the paper prints gains: ↓ and the share by which the error is smaller, ↑ by which it is
    larger."""
    return (
        ""
        if gain is None
        else "0 %"
        if round(gain, 1) == 0
        else f"{'↓' if gain > 0 else '↑'} {abs(gain):.1f} %"
    )


def markdown(experiment: Experiment, found: list[Row], notes: list[str]) -> str:
    """The table as Markdown: means ± standard deviations over seeds, then what its marks say."""
    extra = list(dict.fromkeys(name for row in found for name in row.extra))
    others = [
        metric
        for metric in COLUMNS
        if metric != "ate" and any(metric in row.seeds for row in found)
    ]
    any_diverged = any(row.diverged for row in found)
    header = [
        "",
        COLUMNS["ate"],
        "median",
        *(COLUMNS[metric] for metric in others),
        *(["diverged"] if any_diverged else []),
        *extra,
        "gain",
        "difference of ate, m (95 %)",
        "published m",
        "its gain",
    ]
    table = []
    for row in found:
        cells = [_mean(row, "ate"), _median(row), *(_mean(row, metric) for metric in others)]
        if any_diverged:
            cells.append(f"{row.diverged} of {row.estimates}")
        cells += [f"{row.extra[name]:.3g}" if name in row.extra else "–" for name in extra]
        compared = row is not found[0]
        cells += [
            _gain(row) if compared else "",
            _difference(row) if compared else "",
            "–" if row.published is None else f"{row.published:.2f}",
            arrow(row.published_gain) if compared else "",
        ]
        table.append([row.label, *cells])
    text = "\n".join([f"## {experiment.title}", "", *notes, ""]) + "\n" + grid(header, table)
    return text + "".join(f"\n{line}\n" for line in _explained(found))


def _mean(row: Row, metric: str) -> str:
    if metric not in row.seeds:
        return "–"
    return _with_spread(row.seeds[metric]) + (" †" if row.diverged else "")


def _median(row: Row) -> str:
    if row.median is None:
        return "–"
    return "∞" if math.isinf(row.median) else f"{row.median:.{_digits(row.median)}f}"


def _gain(row: Row) -> str:
    return "–" if row.gain is None else arrow(row.gain)


def _difference(row: Row) -> str:
    if row.difference is None:
        return "–"
    between = f" ({row.interval[0]:+.2f} to {row.interval[1]:+.2f})" if row.interval else ""
    over = f" over {row.compared} of {row.sequences}" if row.compared < row.sequences else ""
    return f"{row.difference:+.2f}{between}{over}"


def _explained(found: list[Row]) -> list[str]:
    lines = []
    if any(row.interval for row in found):
        drawn = " or ".join(str(n) for n in sorted({row.groups for row in found if row.interval}))
        lines.append(
            "The interval draws whole groups of sequences (people or sessions) anew; "
            f"there are {drawn}."
        )
    if any(row.diverged for row in found):
        lines.append(
            "† Over the estimates that did not diverge. The median counts a diverged one "
            "as infinite. Gain and difference are over the sequences in which neither row "
            "diverged. A row that would be better there but diverged more often than "
            "the first has neither."
        )
    return lines


def grid(header: list[str], table: list[list[str]]) -> str:
    """Cells as a Markdown table."""
    return "".join(
        f"| {' | '.join(cells)} |\n" for cells in [header, ["---"] * len(header), *table]
    )


def _with_spread(values: list[float]) -> str:
    digits = _digits(float(np.mean(values)))
    return f"{np.mean(values):.{digits}f}" + (
        f" ± {spread(values):.{digits}f}" if len(values) > 1 else ""
    )


def _digits(value: float) -> int:
    return 3 if abs(value) < 1 else 2


def write(path: Path, experiment: Experiment, found: list[Row], notes: list[str]) -> None:
    """`path`.md and `path`.csv."""
    with replacing(path.with_suffix(".md")) as temporary:
        temporary.write_text(markdown(experiment, found, notes), encoding="utf-8")
    columns = list(COLUMNS)
    extra = list(dict.fromkeys(name for row in found for name in row.extra))
    with (
        replacing(path.with_suffix(".csv")) as temporary,
        open(temporary, "w", newline="", encoding="utf-8") as file,
    ):
        table = csv.writer(file)
        table.writerow(
            [
                "name",
                "label",
                "seeds",
                *columns,
                *(f"{metric}_std" for metric in columns),
                *extra,
                "gain_percent",
                "difference",
                "difference_low",
                "difference_high",
                "published",
                "published_gain_percent",
                "ate_median",
                "diverged",
                "estimates",
                "compared",
                "sequences",
                "groups",
            ]
        )
        for row in found:
            means = [np.mean(row.seeds[m]) if m in row.seeds else "" for m in columns]
            spreads = [
                spread(row.seeds[m]) if len(row.seeds.get(m, [])) > 1 else "" for m in columns
            ]
            low, high = row.interval or ("", "")
            seeds, more = (
                len(next(iter(row.seeds.values()), [])),
                [row.extra.get(name, "") for name in extra],
            )
            values = [
                *means,
                *spreads,
                *more,
                row.gain,
                row.difference,
                low,
                high,
                row.published,
                row.published_gain,
                row.median,
            ]
            counts = [row.diverged, row.estimates, row.compared, row.sequences, row.groups]
            texts = ("" if value is None or value == "" else repr(float(value)) for value in values)
            table.writerow([row.name, row.label, seeds, *texts, *counts])
