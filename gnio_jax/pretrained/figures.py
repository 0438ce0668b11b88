"""The evaluations that a run holds, as a package passes them on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax.errors import InputError
from gnio_jax.pretrained.package import Metric

KEY = "ate_2d"
"""The metric by which networks are listed."""


class Column(NamedTuple):
    """A metric in the table of the card."""

    heading: str
    digits: int


SHOWN = {
    "ate_2d": Column("ATE 2-D (m)", 2),
    "rte_60s_2d": Column("RTE 60 s 2-D (m)", 2),
    "path_length_ratio_2d": Column("path ratio", 2),
    "yaw_rmse": Column("yaw (°)", 1),
    "nees_coverage_2d": Column("NEES < 95 % (%)", 0),
}


def read(workdir: Path) -> dict[str, dict[str, Any]]:
    """Evaluation -> settings, means, 95 % intervals and counts, of every eval/*/metrics.json.

    Raises `InputError` for a file that is damaged.
    """
    found = {}
    for path in sorted(workdir.glob("eval/*/metrics.json")):
        try:
            figures = json.loads(path.read_text(encoding="utf-8"))
            kept = {name: figures[name] for name in ("settings", "mean", "interval", "n")}
            sequences = len(figures["sequences"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            problem = f"cannot be read ({error})"
            raise InputError(path, problem, "evaluate again, or remove it") from None
        found[path.parent.name] = {**kept, "sequences": sequences}
    return found


def key_metric(figures: dict[str, dict[str, Any]], dataset: str) -> Metric | None:
    """The key metric of the first evaluation that has it: with the filter before without, on the
    run's own dataset before others, on a test split before others."""

    def rank(name: str) -> tuple[bool, bool, bool, int, str]:
        how = figures[name]["settings"]
        own, tested = how.get("dataset") == dataset, "test" in str(how.get("split"))
        return how.get("estimator") != "ekf", not own, not tested, len(name), name

    for name in sorted(figures, key=rank):
        value = figures[name]["mean"].get(KEY)
        if value is not None:
            low, high = figures[name]["interval"].get(KEY) or (None, None)
            return Metric(KEY, value, low, high, name)
    return None


def table(figures: dict[str, dict[str, Any]]) -> list[str]:
    """Lines of Markdown: a row per evaluation, means with their 95 % intervals."""
    if not figures:
        return ["The run holds no evaluation."]
    headings = ["evaluation", "sequences", *(column.heading for column in SHOWN.values())]
    lines = [_row(headings), _row(["---", *["---:"] * (len(headings) - 1)])]
    for name, found in figures.items():
        cells = [
            _cell(found["mean"].get(metric), found["interval"].get(metric), column.digits)
            for metric, column in SHOWN.items()
        ]
        lines.append(_row([name, str(found["sequences"]), *cells]))
    return [*lines, "", "Means over sequences, with 95 % intervals; evaluations.json has them all."]


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _cell(value: float | None, interval: list[float] | None, digits: int) -> str:
    if value is None:
        return "–"
    text = f"{value:.{digits}f}"
    if interval and None not in interval:
        text += f" ({interval[0]:.{digits}f}–{interval[1]:.{digits}f})"
    return text
