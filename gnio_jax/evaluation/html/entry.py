"""One run on the page: its curves, its figures and how they were made."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.table import COLUMNS
from gnio_jax.evaluation.trajectory import Alignment

Figures = Mapping[str, float | None]
"""Metric -> value; None where it is not defined, infinite where the estimate diverged."""


class Entry(NamedTuple):
    """One run on the page."""

    name: str
    """Short: what tells it from the other runs."""
    about: dict[str, str]
    """How the figures were made, in words: the command, alignment, orientation, ..."""
    estimates: list[Estimate]
    alignment: Alignment
    figures: dict[str, Figures]
    """Sequence -> its metrics."""
    summary: dict[str, Figures] = {}
    """Row below the sequences (mean, median, ...) -> its metrics."""
    remarks: tuple[str, ...] = ()
    """What a reader should know."""
    settings: str = ""
    """Everything that was configured, as text of several lines."""


def of_evaluation(
    report: Report, estimates: list[Estimate], command: str = "", settings: str = ""
) -> Entry:
    """The entry of an evaluation; `settings` is the configuration of its run."""
    scores, made = report.scores, report.settings
    references = {
        label.replace("_", " "): of.summary.mean for label, of in report.reference_rows.items()
    }
    return Entry(
        name=label(made),
        about={"command": command, **about(made)} if command else about(made),
        estimates=estimates,
        alignment=made["alignment"],
        figures={name: measures.values for name, measures in scores.sequences.items()},
        summary={"mean": scores.summary.mean, "median": scores.summary.median, **references},
        remarks=remarks(report.notes, report.left_out, scores.diverged),
        settings=settings,
    )


def remarks(
    notes: Mapping[str, list[str]], left_out: Mapping[str, str], diverged: list[str]
) -> tuple[str, ...]:
    """What a reader should know of sequences: notes, those left out and why, those diverged."""
    found = [f"{name}: {note}" for name, own in notes.items() for note in own]
    found += [f"{name}: left out, {reason}" for name, reason in left_out.items()]
    return (*found, *(f"{name}: the estimate diverged, and is in no mean" for name in diverged))


def label(settings: Mapping[str, Any]) -> str:
    """What tells an evaluation from others of the same network and recordings."""
    parts = [settings["estimator"]]
    if settings.get("coupling") == "loose":
        parts.append("loose")
    if settings["estimator"] == "integrate" or settings.get("coupling") == "loose":
        parts.append(f"{settings['orientation_source']} orientation")
    if settings["initial_state"] != "reference":
        parts.append(f"{settings['initial_state']} start")
    return ", ".join(parts)


def about(settings: Mapping[str, Any]) -> dict[str, str]:
    """The choices behind the figures, in words."""
    network = settings.get("model")
    rate = settings.get("rate")
    found = {
        "recordings": f"{settings['dataset']}, split {settings['split']}",
        "estimator": label(settings),
        "orientation source": settings["orientation_source"],
        "alignment": settings["alignment"],
        "initial state": settings["initial_state"],
        "gyro bias": settings["gyro_bias"],
        "network": network
        and f"{network}, checkpoint {settings.get('checkpoint')}, step {settings.get('step')}",
        "windows": rate and windows_in_words(settings),
    }
    return {name: str(value) for name, value in found.items() if value}


def windows_in_words(settings: Mapping[str, Any]) -> str:
    """Of what the network sees, from fields of `DataConfig`; reports of earlier versions have no
    context."""
    text = f"{settings['window_seconds']:g} s at {settings['rate']:g} Hz"
    context = settings.get("context_seconds")
    return f"{text}, and {context:g} s before" if context else text


# Figures in words
# --------------------------------------------------------------------------------------------------


def shown(entries: list[Entry]) -> list[str]:
    """Metrics that the table shows: those of the screen's table that a run has."""
    measured = {name for entry in entries for values in entry.figures.values() for name in values}
    return [name for name in COLUMNS if name in measured]


def cell(value: float | None, digits: int) -> str:
    """A figure as it stands in the table."""
    if value is None or math.isnan(value):
        return "–"
    return "∞" if math.isinf(value) else f"{value:.{digits}f}"
