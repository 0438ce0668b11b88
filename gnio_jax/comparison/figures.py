"""The figures of a run on a split: those that are there, or new ones."""

from __future__ import annotations

import dataclasses
import errno
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax import evaluation
from gnio_jax.config import EvaluateConfig, FilterSettings, plain
from gnio_jax.errors import InputError
from gnio_jax.evaluation import report
from gnio_jax.evaluation.metrics import NAMES
from gnio_jax.evaluation.run import folder_name, run_config
from gnio_jax.reporting import Reporter

OPTIONAL_NAMES = ("estimator", "alignment", "checkpoint", "coupling", "orientation_source")
"""Settings that are words where they are given."""
Figures = dict[str, Any]
"""One metrics.json."""


class Recordings(NamedTuple):
    """What an evaluation is of."""

    dataset: str
    split: str
    alignment: str


class Evaluated(NamedTuple):
    """An evaluation that is there."""

    folder: Path
    figures: Figures


def of_run(
    workdir: Path,
    split: str,
    estimator: str,
    reporter: Reporter,
    data_root: str | None = None,
    workers: int = 1,
) -> Evaluated:
    """The figures of the run's best checkpoint on a split: those that are there if they are of that
    checkpoint and mean the same (`report.DEFINITIONS`), else new ones."""
    config, folder = how(workdir, split, estimator, data_root)
    if problem := missing(workdir, split, estimator):
        reporter.line(f"evaluating {workdir.name} on {split} ({estimator}): {problem}")
        evaluation.evaluate(config, reporter.progress, workers)
    return Evaluated(folder, json.loads((folder / "metrics.json").read_text(encoding="utf-8")))


def missing(workdir: Path, split: str, estimator: str) -> str | None:
    """Why a run has to be evaluated; None where its figures are there. Raises `InputError` for a
    run that cannot be."""
    config, folder = how(workdir, split, estimator)
    found = _read(folder / "metrics.json")
    options = config.filter if estimator != "integrate" else None  # which takes no filter
    problem = "there are no whole figures yet"
    if found:
        asked = usual_recordings(workdir, split)
        problem = _of_others(found, asked) or _out_of_date(workdir, found, options)
    best = workdir / "checkpoints" / config.checkpoint
    if problem and estimator != "imu_only" and not any(best.glob("[0-9]*")):
        raise InputError(best, "holds no checkpoint", "let gnio train finish its first epoch")
    return problem


def how(
    workdir: Path, split: str, estimator: str, data_root: str | None = None
) -> tuple[EvaluateConfig, Path]:
    """How `of_run` evaluates a run, and the folder where that leaves its files. Pictures are drawn
    anew where there are some."""
    trained = run_config(workdir)
    config = EvaluateConfig(
        str(workdir),
        data_root=data_root,
        split=split,
        estimator=estimator,  # type: ignore[arg-type]
        plots=False,
        filter=trained.filter,
    )
    folder = workdir / "eval" / folder_name(config, trained.dataset, trained)
    return dataclasses.replace(config, plots=(folder / "plots").exists()), folder


def of_evaluation(folder: Path) -> Evaluated:
    """The figures of an evaluation that is there. Raises `InputError` where it is not, its run has
    learnt since, or its figures cannot stand beside those of today."""
    path, remedy = folder / "metrics.json", "evaluate the run anew with gnio evaluate"
    if not path.exists():
        remedy = "name a run, or a folder below its eval/"
        raise InputError(str(folder), "is neither a run nor an evaluation", remedy)
    figures = _read(path)
    if figures is None:
        raise InputError(str(path), "is not a metrics.json of an evaluation", remedy)
    whole = folder.resolve()
    workdir = whole.parents[1] if whole.parent.name == "eval" else None
    if problem := _out_of_date(workdir, figures, None):
        raise InputError(str(path), problem, remedy)
    return Evaluated(folder, figures)


def _read(path: Path) -> Figures | None:
    """metrics.json; None where it is not there or not as `report` writes it."""
    try:
        figures = json.loads(path.read_text(encoding="utf-8"))
        return figures if _is_whole(figures) else None
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError):
        return None
    except OSError as error:
        if error.errno not in (errno.ENOENT, errno.ENOTDIR, errno.ELOOP):
            raise
        return None


def _is_whole(figures: Figures) -> bool:
    """Whether all that a comparison reads is there, of its type; what is not there may raise."""
    settings, sequences = figures["settings"], figures["sequences"]
    names = ("dataset", "split", *(name for name in OPTIONAL_NAMES if settings.get(name)))
    diverged = figures["mean"]["diverged"]
    known = report.definitions(figures) != report.DEFINITIONS or all(
        isinstance(sequence["group"], str) for sequence in sequences.values()
    )
    return (
        all(isinstance(settings[name], str) for name in names)
        and isinstance(settings.get("filter", {}), dict)
        and type(diverged) is int
        and 0 <= diverged <= len(sequences) > 0
        and known
        and all(map(_has_metrics, sequences.values()))
    )


def _has_metrics(sequence: dict[str, Any]) -> bool:
    """Whether the metrics of a sequence are finite numbers or null, and the reasons of null are
    words. What else is said of it is not compared."""
    values = [value for name, value in sequence.items() if name in (*NAMES, "duration")]
    reasons = sequence.get("undefined", {})
    return all(value is None or math.isfinite(value) for value in values) and all(
        isinstance(reason, str) for reason in reasons.values()
    )


def usual_recordings(workdir: Path, split: str) -> Recordings:
    """What `of_run` evaluates a run on."""
    return Recordings(run_config(workdir).dataset, split, "origin")


def recordings(figures: Figures) -> Recordings:
    """What an evaluation that is there is of."""
    settings = figures["settings"]
    return Recordings(settings["dataset"], settings["split"], settings.get("alignment", "origin"))


def _of_others(figures: Figures, asked: Recordings) -> str | None:
    """Why figures are not of what is asked for; None where they are."""
    for field, own, wanted in zip(Recordings._fields, recordings(figures), asked, strict=True):
        if own != wanted:
            return f"is of {field} {own}"
    return None


def _out_of_date(
    workdir: Path | None, figures: Figures, options: FilterSettings | None
) -> str | None:
    """Why figures cannot stand for the run in `workdir`, as far as that is known; None where they
    can. `options`: the filter that they must be of."""
    settings = figures["settings"]
    if report.definitions(figures) != report.DEFINITIONS:
        return "was written by another version, whose figures mean something else"
    step, which = settings.get("step"), settings.get("checkpoint") or "best"
    if workdir and step is not None and not (workdir / "checkpoints" / which / str(step)).is_dir():
        return "is of a checkpoint that the run has no more"
    if options and settings.get("filter", plain(options)) != plain(options):
        return "is of another filter than the run's"
    return None
