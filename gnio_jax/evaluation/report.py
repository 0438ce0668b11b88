"""The figures of an evaluation: the content of metrics.json, as a `Report` and as plain values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from gnio_jax.evaluation import statistics
from gnio_jax.evaluation.metrics import Measures
from gnio_jax.evaluation.statistics import Scores, Summary

DEFINITIONS = 3
"""Version of the meaning of the figures of metrics.json, in its `settings`. Raise it with every
change after which the figures of older files cannot be compared with newer ones: another definition
of a metric, of divergence or of a mean, or a new field that tables need."""
BESIDE = ("infinite", "reasons", "diverged", "group", "placement", "notes")
"""Fields of a sequence in metrics.json besides its metrics."""


class Report(NamedTuple):
    """The content of metrics.json."""

    settings: dict[str, Any]
    """The settings that define the meaning of the figures."""
    scores: dict[str, Measures]
    """By sequence."""
    reference_rows: dict[str, dict[str, Measures]]
    """`never_moves` and `perfect_displacements`, by sequence."""
    groups: dict[str, str]
    """Sequence → person or session."""
    notes: dict[str, list[str]]
    """Sequence → notes about its start and its filter."""
    left_out: dict[str, str]
    """Sequence → reason why it has no figures."""
    placements: dict[str, str] = {}
    """Sequence → way of carrying the IMU, if it is known."""

    @property
    def diverged(self) -> list[str]:
        """Sequences whose estimate diverged."""
        return [name for name, own in self.scores.items() if own.diverged]

    def summary(self, row: str | None = None) -> dict[str, Summary]:
        """Each metric over the sequences, for this evaluation or one of its reference rows."""
        scores = self.scores if row is None else self.reference_rows[row]
        metrics = dict.fromkeys(metric for own in scores.values() for metric in own.values)
        return {name: statistics.summarise([scores], name, self.groups) for name in metrics}


def as_json(report: Report) -> dict[str, Any]:
    """The report as plain values. JSON has no infinity, so values that are not finite are null, and
    `infinite` names the infinite metrics of a sequence."""
    return {
        "settings": report.settings,
        "sequences": _of_estimates(report),
        **_summaries(report.summary()),
        "reference_rows": {
            row: {"sequences": _sequences(scores), **_summaries(report.summary(row))}
            for row, scores in report.reference_rows.items()
        },
        "left_out": report.left_out,
    }


def _of_estimates(report: Report) -> dict[str, dict[str, Any]]:
    found = _sequences(report.scores)
    for name, own in found.items():
        own |= {"group": report.groups[name], "notes": report.notes.get(name, [])}
        if name in report.placements:
            own["placement"] = report.placements[name]
    return found


def _sequences(scores: Scores) -> dict[str, dict[str, Any]]:
    return {
        name: {
            **finite(own.values),
            "infinite": [metric for metric, value in own.values.items() if value == math.inf],
            "reasons": own.reasons,
            "diverged": own.diverged,
        }
        for name, own in scores.items()
    }


def _summaries(found: Mapping[str, Summary]) -> dict[str, dict[str, Any]]:
    """Each statistic of all metrics."""
    names = {"mean": "mean", "median": "median", "interval": "interval", "n": "sequences"}
    names |= {"groups": "groups", "diverged": "diverged"}
    return {
        key: finite({metric: getattr(of, field) for metric, of in found.items()})
        for key, field in names.items()
    }


def finite(values: Mapping[str, Any]) -> dict[str, Any]:
    """Metrics for JSON, which has no infinity."""
    return {name: None if value == math.inf else value for name, value in values.items()}


def from_json(content: Mapping[str, Any]) -> Report:
    """The inverse of `as_json`. Raises `ValueError`, `LookupError`, `TypeError`, `AttributeError`
    or `ArithmeticError` for content with another structure, such as a text in the place of a
    number."""
    settings, sequences = content["settings"], content["sequences"]
    known = [isinstance(settings[x], str) for x in ("dataset", "split", "estimator", "alignment")]
    known += [math.isfinite(settings["recordings"][name]) for name in sequences]
    if not sequences or not all(known) or not isinstance(settings["filter"], dict):
        raise ValueError
    rows = {row: of["sequences"] for row, of in content["reference_rows"].items()}
    report = Report(
        settings,
        _scores(sequences),
        {row: _scores(own) for row, own in rows.items()},
        {name: str(own["group"]) for name, own in sequences.items()},
        {name: [*map(str, own["notes"])] for name, own in sequences.items() if own["notes"]},
        {name: str(reason) for name, reason in content["left_out"].items()},
        {n: str(own["placement"]) for n, own in sequences.items() if "placement" in own},
    )
    again = {row: _sequences(own) for row, own in report.reference_rows.items()}
    if (_of_estimates(report), again, report.left_out) != (sequences, rows, content["left_out"]):
        raise ValueError
    return report


def _scores(sequences: Mapping[str, Any]) -> dict[str, Measures]:
    """The inverse of `_sequences`."""
    scores = {}
    for name, own in sequences.items():
        found = {metric: own[metric] for metric in own if metric not in BESIDE}
        values = {metric: None if x is None else float(x) for metric, x in found.items()}
        values |= dict.fromkeys(own["infinite"], math.inf)
        reasons = {metric: str(reason) for metric, reason in own["reasons"].items()}
        scores[name] = Measures(values, reasons, bool(own["diverged"]))
    return scores
