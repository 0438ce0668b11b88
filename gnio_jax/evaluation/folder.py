"""The results of an evaluation as a folder: writing and reading.

metrics.json    settings, every metric of every sequence, means, intervals, reference rows
metrics.csv     a line for each sequence, a column for each metric
trajectories/   estimates in TUM format, for evo
references/     references in TUM format
waypoints/      references of sequences without poses: t x y
states/         all results of the estimator, for NumPy (docs/tables.md)
plots/          a picture for each sequence, and the distribution of the errors
report.html     a page with map, curves and a time slider
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gnio_jax import config as configuration
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import tabulate
from gnio_jax.evaluation.estimate import SequenceEstimate
from gnio_jax.evaluation.report import DEFINITIONS, Report, as_json, from_json
from gnio_jax.evaluation.trajectory import (
    Trajectory,
    read_tum,
    read_waypoints,
    write_tum,
    write_waypoints,
)
from gnio_jax.evaluation.views import View, make_view
from gnio_jax.files import file_stems, replacing_folder, write_csv, write_part
from gnio_jax.reporting import Progress, silent

PAGE = "report.html"
REMEDY = "evaluate the run again with gnio evaluate"
SHARED = ("dataset", "split", "data_root", "recordings", "contents", "model", "checkpoint", "step")
"""Settings that evaluations must share to be shown together."""


# --- written


def write(
    folder: Path,
    report: Report,
    estimates: list[SequenceEstimate],
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
    with_pictures = plots or (folder / PAGE).exists()
    with replacing_folder(folder) as new:
        text = json.dumps(as_json(report), indent=2, allow_nan=False, ensure_ascii=False)
        write_part(new / "metrics.json", text + "\n")
        values = {name: measures.values for name, measures in report.scores.items()}
        columns = list(dict.fromkeys(metric for row in values.values() for metric in row))
        rows = ([name, *map(row.get, columns)] for name, row in values.items())
        write_csv(new / "metrics.csv", [["sequence", *columns], *rows])
        for kind in ("trajectories", "references", "states"):
            (new / kind).mkdir()
        for stem, estimate in zip(file_stems(report.scores), estimates, strict=True):
            write_tum(new / "trajectories" / f"{stem}.txt", estimate.trajectory)
            np.savez(new / "states" / f"{stem}.npz", **arrays(estimate))
            if estimate.reference.known.any():
                write_tum(new / "references" / f"{stem}.txt", estimate.reference)
            if estimate.waypoints is not None:
                (new / "waypoints").mkdir(exist_ok=True)
                write_waypoints(new / "waypoints" / f"{stem}.txt", estimate.waypoints)
        if with_pictures:
            # Bokeh and Matplotlib take seconds to import.
            from gnio_jax.evaluation import page
            from gnio_jax.evaluation import plots as pictures

            alignment = report.settings["alignment"]
            views = [make_view(estimate, alignment) for estimate in estimates]
            pictures.save_all(new / "plots", views, report, progress)
            run = page.describe_report(report, views, command, configuration.to_yaml(trained))
            title = f"{report.settings['dataset']} {report.settings['split']}: {run.name}"
            others = read_others(folder, report.settings)
            runs = [page.describe_report(*other, name=name) for name, other in others.items()]
            page.write(new / PAGE, title, [run, *runs])


def arrays(estimate: SequenceEstimate) -> dict[str, Float[np.ndarray, "n ..."]]:
    """The results of the estimator that docs/tables.md lists: a row for each row of the
    trajectory."""
    results: dict[str, Any] = estimate.trajectory._asdict()
    if estimate.displacements is not None:
        value, covariance, diagnostics = estimate.displacements
        results |= {"displacement": value, "displacement_covariance": covariance, **diagnostics}
    if estimate.filtered is not None:
        covariance, nis, accepted = estimate.filtered
        results |= {"position_covariance": covariance, "nis": nis, "accepted": accepted}
    return results | (estimate.states._asdict() if estimate.states else {})


# --- read back


def read(folder: str | Path) -> Report:
    """The figures of an evaluation from its metrics.json.

    Raises `InputError` if the folder has none, if they are damaged, or if they were written by a
    version whose figures mean something else.
    """
    path = Path(folder) / "metrics.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["settings"].get("definitions") != DEFINITIONS:
            problem = "was written by another version that defines its figures otherwise"
            raise InputError(path, problem, REMEDY)
        return from_json(content)
    except InputError:
        raise
    except (FileNotFoundError, NotADirectoryError):
        remedy = "name a run, or a folder below its eval/"
        raise InputError(folder, "is neither a run nor an evaluation", remedy) from None
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError):
        raise InputError(path, "is not a metrics.json of an evaluation", REMEDY) from None


def read_estimates(folder: Path, names: list[str]) -> list[SequenceEstimate]:
    """Estimate and reference of each of an evaluation's sequences, at the estimate's stamps.

    `names` has all sequences, in the order of its metrics.json. A row without a reference is NaN.
    The estimate ends where it diverged.
    """
    estimates = []
    for name, stem in zip(names, file_stems(names), strict=True):
        path = read_tum(folder / "trajectories" / f"{stem}.txt")
        unknown = (np.full((len(path.time), width), np.nan) for width in (3, 4))
        reference = Trajectory(path.time, *unknown)
        file = folder / "references" / f"{stem}.txt"
        if file.exists():
            poses = read_tum(file)
            stamps = np.round(path.time, 6), np.round(poses.time, 6)
            _, rows, pose_rows = np.intersect1d(*stamps, return_indices=True)
            reference.position[rows] = poses.position[pose_rows]
            reference.orientation[rows] = poses.orientation[pose_rows]
        file = folder / "waypoints" / f"{stem}.txt"
        waypoints = read_waypoints(file) if file.exists() else None
        estimates.append(SequenceEstimate(name, path, reference, waypoints=waypoints))
    return estimates


def read_views(folder: Path, report: Report) -> list[View]:
    """The paths of the sequences of `report` from its folder, without the curves of network and
    filter."""
    estimates = read_estimates(folder, list(report.scores))
    return [make_view(estimate, report.settings["alignment"]) for estimate in estimates]


def read_others(folder: Path, settings: Mapping[str, Any]) -> dict[str, tuple[Report, list[View]]]:
    """The other evaluations of the same recordings by the same network, beside `folder`, each by
    its difference in few words. Evaluations that cannot be read or were measured in another way are
    left out."""
    evaluations: dict[str, tuple[Report, list[View]]] = {}
    for path in sorted(path.parent for path in folder.parent.glob("*/metrics.json")):
        try:
            report = read(path)
            if path != folder and all(report.settings.get(x) == settings.get(x) for x in SHARED):
                way = tabulate.describe_estimator(report.settings)
                name = (
                    path.name
                    if way in {tabulate.describe_estimator(settings), *evaluations}
                    else way
                )
                evaluations[name] = report, read_views(path, report)
        except (InputError, OSError):
            continue
    return evaluations
