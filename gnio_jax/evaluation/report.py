"""The figures of an evaluation in files: JSON and CSV for programs, TUM trajectories for evo."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gnio_jax.evaluation.curves_file import write_curves
from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.scores import Scores
from gnio_jax.evaluation.trajectory import write_tum

DEFINITIONS = 3
"""What the figures of metrics.json mean, in its `settings`. Raise it with every change after which
a file's figures cannot stand beside newer ones: another definition of a metric, of who counts as
diverged or of a mean, or something in the file that tables need. Those of 1 have no groups, and
yaw errors that are differences of Euler yaws; those of 2 have a drift over the trusted part of the
path."""
INFINITE = (
    "the estimate is not finite",
    "the error is too large",
    "the filter's covariance is not positive definite",
)
"""How the reasons of infinite metrics begin."""


class Report(NamedTuple):
    """Everything the files say."""

    settings: dict[str, Any]
    """What changes the meaning of the figures, for the reader of the table and of the JSON."""
    scores: Scores
    reference_rows: dict[str, Scores]
    """`never_moves` and `perfect_displacements`."""
    notes: dict[str, list[str]]
    """Sequence -> what a reader should know of its start and of its filter."""
    left_out: dict[str, str]
    """Sequence -> why it has no figures."""


def write(folder: Path, report: Report, estimates: list[Estimate]) -> None:
    """metrics.json, metrics.csv, trajectories/ and references/ (TUM format) and curves/ into an
    empty folder (see `files.replacing_folder`)."""
    text = json.dumps(as_json(report), indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "metrics.json").write_text(text + "\n", encoding="utf-8")
    _write_csv(folder / "metrics.csv", report.scores)
    for kind in ("trajectories", "references", "curves"):
        (folder / kind).mkdir()
    for stem, e in zip(file_names([e.name for e in estimates]), estimates, strict=True):
        write_tum(folder / "trajectories" / f"{stem}.txt", e.trajectory)
        write_curves(folder / "curves" / f"{stem}.npz", e)
        if np.isfinite(e.reference.position).any():
            write_tum(folder / "references" / f"{stem}.txt", e.reference)


def _write_csv(path: Path, scores: Scores) -> None:
    """A line per sequence, a column per metric; empty where it has no value."""
    measured = scores.sequences
    columns = list(dict.fromkeys(metric for m in measured.values() for metric in m.values))
    with open(path, "w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow(["sequence", *columns])
        for name, m in measured.items():
            values = (m.values.get(column) for column in columns)
            lines.writerow([name, *("" if value is None else repr(value) for value in values)])


def file_names(names: list[str]) -> list[str]:
    """A distinct file name for each sequence: its name with anything a file system could mind as
    `_`."""
    stems: list[str] = []
    for name in names:
        stem = re.sub(r"[^\w.=+-]+", "_", name).strip("._") or "sequence"
        while stem in stems:
            stem += "_"
        stems.append(stem)
    return stems


# metrics.json
# --------------------------------------------------------------------------------------------------


def as_json(report: Report) -> dict[str, Any]:
    """The whole report as plain values; a metric without a finite value is None, with a reason.

    `mean` is over the sequences that did not diverge; its `diverged` counts those that did, the
    report's `diverged` by metric.
    """
    sequences = _sequences(report.scores)
    for name, group in report.scores.groups.items():
        sequences[name]["group"] = group
    for name, notes in report.notes.items():
        sequences[name]["notes"] = notes
    return {
        "settings": report.settings,
        "sequences": sequences,
        **_summary(report.scores),
        "undefined": _without_mean(report.scores),
        "reference_rows": {
            label: {"sequences": _sequences(scores), **_summary(scores)}
            for label, scores in report.reference_rows.items()
        },
        "left_out": report.left_out,
    }


def read_metric(sequence: Mapping[str, Any], metric: str) -> float | None:
    """A metric of one of the `sequences` of metrics.json, as `Measures` has it: None where it is
    not defined, infinite where its reason says so."""
    value = sequence.get(metric)
    reason = sequence.get("undefined", {}).get(metric, "")
    return math.inf if value is None and reason.startswith(INFINITE) else value


def diverged(values: Mapping[str, float | None]) -> bool:
    """Whether the estimate of a sequence diverged: its `ate` is infinite or, where there is none
    for want of a reference, anything else is."""
    error = values.get("ate")
    return math.inf in values.values() if error is None else math.isinf(error)


def definitions(figures: Mapping[str, Any]) -> int:
    """`DEFINITIONS` of a metrics.json. In files that do not say it, those of 2 are the ones with
    groups."""
    grouped = all("group" in sequence for sequence in figures["sequences"].values())
    return figures["settings"].get("definitions", 2 if grouped else 1)


def _sequences(scores: Scores) -> dict[str, dict[str, Any]]:
    return {
        name: {**_finite(m.values), **({"undefined": m.reasons} if m.reasons else {})}
        for name, m in scores.sequences.items()
    }


def _summary(scores: Scores) -> dict[str, Any]:
    summary = scores.summary
    interval = {
        name: None if value is None else list(value) for name, value in summary.interval.items()
    }
    return {
        "mean": {**_finite(summary.mean), "diverged": len(scores.diverged)},
        "median": _finite(summary.median),
        "interval": interval,
        "groups": summary.groups,
        "n": summary.count,
        "diverged": summary.diverged,
    }


def _without_mean(scores: Scores) -> dict[str, str]:
    """Metric -> reason, for those without a finite mean."""
    found = {}
    for name, value in _finite(scores.summary.mean).items():
        if value is None:
            reasons = (m.reasons.get(name) for m in scores.sequences.values())
            found[name] = next(filter(None, reasons), "no estimate that did not diverge")
    return found


def _finite(values: Mapping[str, float | None]) -> dict[str, float | None]:
    """JSON has no infinity."""
    return {name: None if value == math.inf else value for name, value in values.items()}
