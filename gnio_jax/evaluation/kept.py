"""Evaluations that a run has already, and whether they may stand for new ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax import data
from gnio_jax.config import EvaluateConfig, plain
from gnio_jax.errors import InputError
from gnio_jax.evaluation.report import Report, read
from gnio_jax.evaluation.run import evaluate, folder_name, run_config
from gnio_jax.reporting import Reporter

IDENTITY = ("dataset", "data_root", "split", "alignment")
"""Settings that say which recordings an evaluation is of, and how its errors are measured."""


class Kept(NamedTuple):
    """An evaluation of a run, before it is asked whether it has to be made."""

    config: EvaluateConfig
    """With the filter of the run."""
    folder: Path
    identity: dict[str, Any]
    """Of `IDENTITY`."""
    report: Report | None
    """What is there, if it is what is asked for."""
    problem: str
    """Why it has to be made; empty where it is there."""


def look(config: EvaluateConfig) -> Kept:
    """The evaluation of a run that `config` asks for, with the run's own filter.

    Raises `InputError` for one that is not there and cannot be made.
    """
    workdir = Path(config.workdir or "")
    run = run_config(workdir, config.checkpoint)
    dataset = config.dataset or run.dataset
    root = config.data_root or (run.data_root if dataset == run.dataset else None)
    config = dataclasses.replace(config, dataset=dataset, data_root=root, filter=run.filter)
    folder = workdir / "eval" / folder_name(config, dataset, run)
    if data.get(dataset).needs_root:
        root = str(data.find_root(dataset, root).resolve())
    identity = dict(zip(IDENTITY, (dataset, root, config.split, config.alignment), strict=True))
    report, problem = None, "it is not evaluated yet"
    if (folder / "metrics.json").exists():
        try:
            report = read(folder)
            problem = _differs(report, identity) or out_of_date(report, workdir)
            if config.estimator != "integrate" and report.settings["filter"] != plain(run.filter):
                problem = problem or "its figures are of another filter than the run's"
        except InputError as error:
            problem = f"its figures cannot be used: {error}"
    best = workdir / "checkpoints" / config.checkpoint
    if problem and config.estimator != "imu_only" and not any(best.glob("[0-9]*")):
        raise InputError(best, "holds no checkpoint", "let gnio train finish its first epoch")
    return Kept(config, folder, identity, None if problem else report, problem)


def made(kept: Kept, reporter: Reporter, workers: int = 1) -> Report:
    """The evaluation, new if it has to be made."""
    if kept.report is not None:
        return kept.report
    config = kept.config
    run = Path(config.workdir or "").name
    reporter.line(f"evaluating {run} on {config.split} ({config.estimator}): {kept.problem}")
    evaluate(config, reporter.progress, workers)
    return read(kept.folder)


def out_of_date(report: Report, workdir: Path) -> str:
    """Why figures cannot stand for the run in `workdir`; empty where they can."""
    step, which = report.settings.get("step"), report.settings.get("checkpoint")
    if step is not None and not (workdir / "checkpoints" / str(which) / str(step)).is_dir():
        return "its figures are of a checkpoint that the run has no more"
    return ""


def _differs(report: Report, identity: dict[str, Any]) -> str:
    for name, wanted in identity.items():
        if (own := report.settings.get(name)) != wanted:
            return f"its figures are of {name.replace('_', ' ')} {own}, not {wanted}"
    return ""
