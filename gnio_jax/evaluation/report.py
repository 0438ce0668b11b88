"""The figures of an evaluation: the content of metrics.json, as a `Report` and as plain values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from gnio_jax.evaluation import statistics
from gnio_jax.evaluation.metrics import Measures
from gnio_jax.evaluation.statistics import MetricSummary, Scores

DEFINITIONS = 5
"""Version of the meaning of the figures of metrics.json, in its `settings`. Raise it with every
change after which the figures of older files cannot be compared with newer ones: another definition
of a metric, of divergence or of a mean, or a new field that tables need."""
OTHER_FIELDS = ("infinite", "reasons", "diverged", "group", "placement", "notes")
"""Fields of a sequence in metrics.json that are no metrics."""


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
        return [name for name, measures in self.scores.items() if measures.diverged]

    def summary(self, row: str | None = None) -> dict[str, MetricSummary]:
        """Each metric over the sequences, for this evaluation or one of its reference rows."""
        scores = self.scores if row is None else self.reference_rows[row]
        metrics = dict.fromkeys(
            metric for measures in scores.values() for metric in measures.values
        )
        return {name: statistics.summarise([scores], name, self.groups) for name in metrics}


def as_json(report: Report) -> dict[str, Any]:
    """The report as plain values. JSON has no infinity, so values that are not finite are null, and
    `infinite` names the infinite metrics of a sequence."""
    return {
        "settings": report.settings,
        "sequences": _plain_sequences(report),
        **_plain_summaries(report.summary()),
        "reference_rows": {
            row: {"sequences": _plain_scores(scores), **_plain_summaries(report.summary(row))}
            for row, scores in report.reference_rows.items()
        },
        "left_out": report.left_out,
    }


def _plain_sequences(report: Report) -> dict[str, dict[str, Any]]:
    sequences = _plain_scores(report.scores)
    for name, fields in sequences.items():
        fields |= {"group": report.groups[name], "notes": report.notes.get(name, [])}
        if name in report.placements:
            fields["placement"] = report.placements[name]
    return sequences


def _plain_scores(scores: Scores) -> dict[str, dict[str, Any]]:
    return {
        name: {
            **finite_values(measures.values),
            "infinite": [metric for metric, value in measures.values.items() if value == math.inf],
            "reasons": measures.reasons,
            "diverged": measures.diverged,
        }
        for name, measures in scores.items()
    }


def _plain_summaries(summaries: Mapping[str, MetricSummary]) -> dict[str, dict[str, Any]]:
    """Each statistic of all metrics."""
    names = {"mean": "mean", "median": "median", "interval": "interval", "n": "sequences"}
    names |= {"groups": "groups", "diverged": "diverged"}
    return {
        key: finite_values(
            {metric: getattr(summary, field) for metric, summary in summaries.items()}
        )
        for key, field in names.items()
    }


def finite_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Metrics for JSON, which has no infinity."""
    return {name: None if value == math.inf else value for name, value in values.items()}


def from_json(content: Mapping[str, Any]) -> Report:
    """The inverse of `as_json`. Raises `ValueError`, `LookupError`, `TypeError`, `AttributeError`
    or `ArithmeticError` for content with another structure, such as a text in the place of a
    number."""
    settings, sequences = content["settings"], content["sequences"]
    texts = [settings[name] for name in ("dataset", "split", "estimator", "alignment")]
    valid = [isinstance(text, str) for text in texts]
    valid += [math.isfinite(settings["recordings"][name]) for name in sequences]
    valid += [len(digests["files"] + digests["sha256"]) > 0 for digests in _contents(settings)]
    if not sequences or not all(valid) or not isinstance(settings["filter"], dict):
        raise ValueError
    rows = {name: row["sequences"] for name, row in content["reference_rows"].items()}
    notes = {name: [*map(str, fields["notes"])] for name, fields in sequences.items()}
    placements = {name: fields.get("placement") for name, fields in sequences.items()}
    report = Report(
        settings,
        _scores_of(sequences),
        {name: _scores_of(row) for name, row in rows.items()},
        {name: str(fields["group"]) for name, fields in sequences.items()},
        {name: lines for name, lines in notes.items() if lines},
        {name: str(reason) for name, reason in content["left_out"].items()},
        {name: str(text) for name, text in placements.items() if text is not None},
    )
    plain_rows = {name: _plain_scores(scores) for name, scores in report.reference_rows.items()}
    plain = _plain_sequences(report), plain_rows, report.left_out
    if plain != (sequences, rows, content["left_out"]):
        raise ValueError
    return report


def _contents(settings: Mapping[str, Any]) -> Iterable[Mapping[str, str]]:
    """The digests of the recordings; none for a dataset that is computed."""
    return settings.get("contents", {}).values()


def _scores_of(sequences: Mapping[str, Any]) -> dict[str, Measures]:
    """The inverse of `_plain_scores`."""
    scores = {}
    for sequence, fields in sequences.items():
        figures = {metric: fields[metric] for metric in fields if metric not in OTHER_FIELDS}
        values = {
            metric: None if value is None else float(value) for metric, value in figures.items()
        }
        values |= dict.fromkeys(fields["infinite"], math.inf)
        reasons = {metric: str(reason) for metric, reason in fields["reasons"].items()}
        scores[sequence] = Measures(values, reasons, bool(fields["diverged"]))
    return scores
