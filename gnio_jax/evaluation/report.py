"""The results of an evaluation as a folder: writing and reading.

metrics.json settings, every metric of every sequence, means, intervals, reference rows metrics.csv
a line per sequence, a column per metric trajectories/ estimates in TUM format, for evo references/
references in TUM format waypoints/ references of sequences without poses: t x y states/ all results
of the estimator, for NumPy (docs/tables.md) plots/ a picture per sequence, and the distribution of
the errors report.html a page with map, curves and a time slider
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax import config as configuration
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import statistics
from gnio_jax.evaluation.estimate import Estimate
from gnio_jax.evaluation.metrics import Measures
from gnio_jax.evaluation.statistics import Scores, Summary
from gnio_jax.evaluation.trajectory import (
    Trajectory,
    read_tum,
    read_waypoints,
    write_tum,
    write_waypoints,
)
from gnio_jax.files import file_stem, replacing_folder, write_csv
from gnio_jax.reporting import Progress, silent

DEFINITIONS = 3
"""Version of the meaning of the figures of metrics.json, in its `settings`. Raise it with every
change after which the figures of older files cannot be compared with newer ones: another definition
of a metric, of divergence or of a mean, or a new field that tables need."""
PAGE = "report.html"
REMEDY = "evaluate the run anew with gnio evaluate"
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


# --- written


def write(
    folder: Path,
    report: Report,
    estimates: list[Estimate],
    trained: TrainConfig,
    command: str = "",
    plots: bool = True,
    progress: Progress = silent,
) -> None:
    """Write the folder of an evaluation, whole or not at all.

    Pictures and page are made if `plots` is set. If an earlier evaluation has them, they are always
    made again, so that they are neither lost nor out of date. `trained` is the configuration of the
    run and `command` the command line, for the page.
    """
    drawn = plots or (folder / PAGE).exists()
    with replacing_folder(folder) as new:
        text = json.dumps(as_json(report), indent=2, allow_nan=False, ensure_ascii=False)
        (new / "metrics.json").write_text(text + "\n", encoding="utf-8")
        columns = list(dict.fromkeys(x for own in report.scores.values() for x in own.values))
        rows = ([name, *map(own.values.get, columns)] for name, own in report.scores.items())
        write_csv(new / "metrics.csv", [["sequence", *columns], *rows])
        for kind in ("trajectories", "references", "states"):
            (new / kind).mkdir()
        for stem, each in zip(file_names(list(report.scores)), estimates, strict=True):
            write_tum(new / "trajectories" / f"{stem}.txt", each.trajectory)
            np.savez(new / "states" / f"{stem}.npz", **arrays(each))
            if each.reference.known.any():
                write_tum(new / "references" / f"{stem}.txt", each.reference)
            if each.waypoints is not None:
                (new / "waypoints").mkdir(exist_ok=True)
                write_waypoints(new / "waypoints" / f"{stem}.txt", each.waypoints)
        if drawn:
            # Bokeh and Matplotlib take seconds to import.
            from gnio_jax.evaluation import page
            from gnio_jax.evaluation import plots as pictures

            alignment = report.settings["alignment"]
            views = [pictures.view(each, alignment) for each in estimates]
            pictures.save_all(new / "plots", views, report, progress)
            run = page.of_report(report, views, command, configuration.to_yaml(trained))
            title = f"{report.settings['dataset']} {report.settings['split']}: {run.name}"
            page.write(new / PAGE, title, [run, *page.beside(folder, report.settings)])


def arrays(estimate: Estimate) -> dict[str, Float[np.ndarray, "n ..."]]:
    """The results of the estimator that docs/tables.md lists: a row for each row of the
    trajectory."""
    found: dict[str, Any] = estimate.trajectory._asdict()
    if estimate.displacements is not None:
        value, covariance, diagnostics = estimate.displacements
        found |= {"displacement": value, "displacement_covariance": covariance, **diagnostics}
    if estimate.filtered is not None:
        covariance, nis, accepted = estimate.filtered
        found |= {"position_covariance": covariance, "nis": nis, "accepted": accepted}
    return found | (estimate.states._asdict() if estimate.states else {})


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


def file_names(names: list[str]) -> list[str]:
    """A distinct file name for each sequence: its name, with `_` for characters that a file system
    may refuse."""
    stems: list[str] = []
    for name in names:
        stem = file_stem(name)
        while stem in stems:
            stem += "_"
        stems.append(stem)
    return stems


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


# --- read back


def read(folder: Path) -> Report:
    """The figures of an evaluation from its metrics.json.

    Raises `InputError` if the folder has none, if they are damaged, or if they were written by a
    version whose figures mean something else.
    """
    path = folder / "metrics.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        settings, sequences = found["settings"], found["sequences"]
        if settings.get("definitions") != DEFINITIONS:
            problem = "was written by another version that defines its figures otherwise"
            raise InputError(path, problem, REMEDY)
        known = [
            isinstance(settings[x], str) for x in ("dataset", "split", "estimator", "alignment")
        ]
        known += [math.isfinite(settings["recordings"][name]) for name in sequences]
        if not sequences or not all(known) or not isinstance(settings["filter"], dict):
            raise ValueError
        rows = {row: of["sequences"] for row, of in found["reference_rows"].items()}
        report = Report(
            settings,
            _scores(sequences),
            {row: _scores(own) for row, own in rows.items()},
            {name: str(own["group"]) for name, own in sequences.items()},
            {name: [*map(str, own["notes"])] for name, own in sequences.items() if own["notes"]},
            {name: str(reason) for name, reason in found["left_out"].items()},
            {n: str(own["placement"]) for n, own in sequences.items() if "placement" in own},
        )
        # A file with another structure is no report, for example one with a text in the place of a
        # number.
        again = {row: _sequences(own) for row, own in report.reference_rows.items()}
        written = _of_estimates(report), again, report.left_out
        if written != (sequences, rows, found["left_out"]):
            raise ValueError
        return report
    except InputError:
        raise
    except (FileNotFoundError, NotADirectoryError):
        remedy = "name a run, or a folder below its eval/"
        raise InputError(folder, "is neither a run nor an evaluation", remedy) from None
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError):
        raise InputError(path, "is not a metrics.json of an evaluation", REMEDY) from None


def read_estimates(folder: Path, names: list[str]) -> list[Estimate]:
    """Estimate and reference of each of an evaluation's sequences, at the estimate's stamps.

    `names` has all sequences, in the order of its metrics.json. A row without a reference is NaN.
    The estimate ends where it diverged.
    """
    found = []
    for name, stem in zip(names, file_names(names), strict=True):
        path = read_tum(folder / "trajectories" / f"{stem}.txt")
        rows = len(path.time)
        reference = Trajectory(path.time, np.full((rows, 3), np.nan), np.full((rows, 4), np.nan))
        file = folder / "references" / f"{stem}.txt"
        if file.exists():
            true = read_tum(file)
            stamps = np.round(path.time, 6), np.round(true.time, 6)
            _, here, there = np.intersect1d(stamps[0], stamps[1], return_indices=True)
            reference.position[here] = true.position[there]
            reference.orientation[here] = true.orientation[there]
        file = folder / "waypoints" / f"{stem}.txt"
        waypoints = read_waypoints(file) if file.exists() else None
        found.append(Estimate(name, path, reference, waypoints=waypoints))
    return found


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
