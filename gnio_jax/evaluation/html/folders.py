"""Evaluations that lie in folders, read back for the page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from gnio_jax.evaluation.curves_file import with_curves
from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.html.entry import Entry, Figures, about, label, remarks
from gnio_jax.evaluation.report import (
    DEFINITIONS,
    definitions,
    diverged,
    file_names,
    read_metric,
)
from gnio_jax.evaluation.trajectory import Trajectory, read_tum

SAME = ("dataset", "split", "model", "checkpoint", "step")
"""Settings in which evaluations are alike that stand side by side."""


def beside(folder: Path, settings: dict[str, Any]) -> list[Entry]:
    """The other evaluations of the same recordings by the same network, beside `folder`.

    They have all that their own pages show, but for the command and the configuration; those of
    older versions have no curves of network and filter. What cannot be read, and what an older
    version measured otherwise, is left away.
    """
    found: dict[str, Entry | None] = {label(settings): None}
    for path in sorted(folder.parent.glob("*/metrics.json")):
        if path.parent != folder and (entry := _read(path.parent, settings)) is not None:
            name = path.parent.name if entry.name in found else entry.name
            found[name] = entry._replace(name=name)
    return [entry for entry in found.values() if entry is not None]


def read_entry(folder: Path, name: str | None = None) -> Entry:
    """The entry of an evaluation's folder; `name` is by default what tells it from others."""
    figures = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    settings, sequences = figures["settings"], figures["sequences"]
    references = {
        row.replace("_", " "): values["mean"] for row, values in figures["reference_rows"].items()
    }
    measured = {sequence: _figures(values) for sequence, values in sequences.items()}
    return Entry(
        name or label(settings),
        about(settings),
        [
            _estimate(folder, sequence, stem)
            for sequence, stem in zip(sequences, file_names(list(sequences)), strict=True)
        ],
        settings["alignment"],
        measured,
        {"mean": figures["mean"], "median": figures["median"], **references},
        remarks(
            {name: values["notes"] for name, values in sequences.items() if "notes" in values},
            figures["left_out"],
            [name for name, values in measured.items() if diverged(values)],
        ),
    )


def _read(folder: Path, settings: dict[str, Any]) -> Entry | None:
    try:
        figures = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        other = figures["settings"]
        networks = SAME if other["estimator"] != "imu_only" else SAME[:2]
        alike = all(other.get(name) == settings.get(name) for name in networks)
        return read_entry(folder) if alike and definitions(figures) == DEFINITIONS else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _figures(values: dict[str, Any]) -> Figures:
    return {
        metric: read_metric(values, metric)
        for metric, value in values.items()
        if value is None or isinstance(value, int | float)
    }


def _estimate(folder: Path, sequence: str, stem: str) -> Estimate:
    """Trajectory, reference and curves of a sequence, at the trajectory's stamps."""
    path = read_tum(folder / "trajectories" / f"{stem}.txt")
    file = folder / "references" / f"{stem}.txt"
    reference = _at(path.time, read_tum(file) if file.exists() else None)
    return with_curves(Estimate(sequence, path, reference), folder / "curves" / f"{stem}.npz")


def _at(time: np.ndarray, reference: Trajectory | None) -> Trajectory:
    """The reference at these stamps; NaN where it has none of them."""
    nowhere = Trajectory(time, np.full((len(time), 3), np.nan), np.full((len(time), 4), np.nan))
    if reference is None:
        return nowhere
    _, rows, known = np.intersect1d(
        np.round(time, 6), np.round(reference.time, 6), return_indices=True
    )
    nowhere.position[rows] = reference.position[known]
    nowhere.orientation[rows] = reference.orientation[known]
    return nowhere
