"""Evaluations that a run has already, and whether they may replace new ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax import config as configuration
from gnio_jax.config import EvaluateConfig, plain
from gnio_jax.errors import InputError
from gnio_jax.evaluation.evaluate import evaluate, folder_of, resolve
from gnio_jax.evaluation.folder import read
from gnio_jax.evaluation.report import Report
from gnio_jax.reporting import Reporter

IDENTITY = ("dataset", "data_root", "split", "alignment")
"""Settings that two evaluations must share to have the same recordings and errors."""


class Kept(NamedTuple):
    """A requested evaluation of a run, and whether it has to be made."""

    config: EvaluateConfig
    """The request, as `evaluate.resolve` completes it."""
    folder: Path
    report: Report | None
    """The existing report, if it is the requested one."""
    problem: str
    """The reason why it has to be made; empty if it exists."""
    run: Any = None
    """The `training.checkpoint.Run`, if it is loaded already and the evaluation has to be made."""


def look(config: EvaluateConfig) -> Kept:
    """The evaluation of a run that `config` asks for, with the run's own filter.

    Raises `InputError` for one that does not exist and cannot be made.
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
            problem = _differs(report, config) or out_of_date(report, workdir)
        except InputError as error:
            problem = f"its figures cannot be used: {error}"
    best = workdir / "checkpoints" / config.checkpoint
    if problem and not any(best.glob("[0-9]*")):
        raise InputError(best, "holds no checkpoint", "let gnio train finish its first epoch")
    return Kept(config, folder, None, problem, run) if problem else Kept(config, folder, report, "")


def made(kept: Kept, reporter: Reporter, workers: int = 1) -> Report:
    """The evaluation, which is made if necessary."""
    if kept.report is not None:
        return kept.report
    config = kept.config
    run = Path(config.workdir or "").name
    reporter.line(f"evaluating {run} on {config.split} ({config.estimator}): {kept.problem}")
    evaluate(config, reporter, workers, run=kept.run)
    return read(kept.folder)


def out_of_date(report: Report, workdir: Path) -> str:
    """The reason why the figures are not those of the run in `workdir`; empty if they are."""
    step, which = report.settings.get("step"), report.settings.get("checkpoint")
    if step is not None and not (workdir / "checkpoints" / str(which) / str(step)).is_dir():
        return "its figures are of a checkpoint that the run has no more"
    return ""


def _differs(report: Report, config: EvaluateConfig) -> str:
    """The reason why the figures are not the requested ones; empty if they are."""
    for name in IDENTITY:
        if (own := report.settings.get(name)) != (wanted := getattr(config, name)):
            return f"its figures are of {name.replace('_', ' ')} {own}, not {wanted}"
    if config.estimator != "integrate" and report.settings["filter"] != plain(config.filter):
        return "its figures are of another filter than the run's"
    return ""
