"""Existing evaluations of runs, which are used again if they are the requested ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax import config as configuration
from gnio_jax.config import EvaluateConfig, to_plain
from gnio_jax.errors import InputError
from gnio_jax.evaluation.evaluate import evaluate, folder_of, resolve
from gnio_jax.evaluation.folder import read
from gnio_jax.evaluation.report import Report
from gnio_jax.reporting import Reporter

IDENTITY = ("dataset", "data_root", "split", "alignment")
"""Settings that two evaluations must share to have the same recordings and errors."""


class RequestedEvaluation(NamedTuple):
    """A requested evaluation of a run, with its figures if they exist."""

    config: EvaluateConfig
    """The request, as `evaluate.resolve` completes it."""
    folder: Path
    report: Report | None
    """The figures, if they exist."""
    problem: str
    """The reason why the run has to be evaluated; empty if the figures exist."""
    run: Any = None
    """The `training.checkpoint.Run`, if it is loaded already and has to be evaluated."""


def find_existing(config: EvaluateConfig) -> RequestedEvaluation:
    """Find the figures of a run that match `config`, with the run's own filter.

    Raises `InputError` if they do not exist and the run cannot be evaluated.
    """
    workdir, run = Path(config.workdir or ""), None
    trained = configuration.load(workdir / "config.yaml")
    if trained.through_filter.learn:  # the settings of its filter are in the checkpoint
        from gnio_jax.training import checkpoint  # Orbax takes seconds to import

        run = checkpoint.load_run(workdir, config.checkpoint)
        trained = run.config
    config = resolve(config, trained)
    folder = folder_of(workdir, config, trained)
    report, problem = None, "it is not evaluated yet"
    if (folder / "metrics.json").exists():
        try:
            report = read(folder)
            problem = _find_difference(report, config) or find_missing_step(report, workdir)
        except InputError as error:
            problem = f"its figures cannot be used: {error}"
    best = workdir / "checkpoints" / config.checkpoint
    if problem and not any(best.glob("[0-9]*")):
        raise InputError(best, "holds no checkpoint", "let gnio train finish its first epoch")
    if problem:
        return RequestedEvaluation(config, folder, None, problem, run)
    return RequestedEvaluation(config, folder, report, "")


def load_or_evaluate(request: RequestedEvaluation, reporter: Reporter, workers: int = 1) -> Report:
    """The existing figures, or those of a new evaluation."""
    if request.report is not None:
        return request.report
    config = request.config
    run = Path(config.workdir or "").name
    reporter.line(f"evaluating {run} on {config.split} ({config.estimator}): {request.problem}")
    evaluate(config, reporter, workers, run=request.run)
    return read(request.folder)


def find_missing_step(report: Report, workdir: Path) -> str:
    """The reason why the figures are not of a checkpoint of the run in `workdir`; empty if they
    are."""
    step, name = report.settings.get("step"), report.settings.get("checkpoint")
    if step is not None and not (workdir / "checkpoints" / str(name) / str(step)).is_dir():
        return "its figures are of a checkpoint that the run has no more"
    return ""


def _find_difference(report: Report, config: EvaluateConfig) -> str:
    """The reason why the figures are not the requested ones; empty if they are."""
    for name in IDENTITY:
        if (value := report.settings.get(name)) != (request := getattr(config, name)):
            return f"its figures are of {name.replace('_', ' ')} {value}, not {request}"
    if config.estimator != "integrate" and report.settings["filter"] != to_plain(config.filter):
        return "its figures are of another filter than the run's"
    return ""
