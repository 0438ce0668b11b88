"""The figures of a run on a split: those that are there, or new ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax import evaluation
from gnio_jax.config import EvaluateConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import report
from gnio_jax.evaluation.run import folder_name, run_config
from gnio_jax.reporting import Reporter

Figures = dict[str, Any]
"""One metrics.json."""


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
    path = folder / "metrics.json"
    if path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
        if report.definitions(found) == report.DEFINITIONS and _is_newest(workdir, found):
            return Evaluated(folder, found)
    reporter.line(f"evaluating {workdir.name} on {split} ({estimator})")
    evaluation.evaluate(config, workers=workers)
    return Evaluated(folder, json.loads(path.read_text(encoding="utf-8")))


def how(
    workdir: Path, split: str, estimator: str, data_root: str | None = None
) -> tuple[EvaluateConfig, Path]:
    """How `of_run` evaluates a run, and the folder where that leaves its files."""
    trained = run_config(workdir)
    config = EvaluateConfig(
        str(workdir),
        data_root=data_root,
        split=split,
        estimator=estimator,  # type: ignore[arg-type]
        plots=False,
        filter=trained.filter,
    )
    return config, workdir / "eval" / folder_name(config, trained.dataset, trained)


def of_evaluation(folder: Path) -> Evaluated:
    """The figures of an evaluation that is there. Raises `InputError` where it is not, its run has
    learnt since, or its figures cannot stand beside those of today."""
    path = folder / "metrics.json"
    try:
        figures = json.loads(path.read_text(encoding="utf-8"))
        definitions = report.definitions(figures)
    except FileNotFoundError:
        remedy = "name a run, or a folder below its eval/"
        raise InputError(str(folder), "is neither a run nor an evaluation", remedy) from None
    except (ValueError, KeyError, TypeError, AttributeError):
        remedy = "run gnio evaluate again"
        raise InputError(str(path), "is not a metrics.json of an evaluation", remedy) from None
    if definitions != report.DEFINITIONS:
        problem = "was written by another version, whose figures mean something else"
        raise InputError(str(path), problem, "run gnio evaluate again")
    if folder.parent.name == "eval" and not _is_newest(folder.parents[1], figures):
        problem = "is of a checkpoint that the run has no more"
        raise InputError(str(path), problem, "run gnio evaluate again")
    return Evaluated(folder, figures)


def _is_newest(workdir: Path, figures: Figures) -> bool:
    """Whether the figures are of a checkpoint that the run still has; those without a network are
    of none."""
    settings = figures["settings"]
    step, which = settings.get("step"), settings.get("checkpoint") or "best"
    return step is None or (workdir / "checkpoints" / which / str(step)).is_dir()
