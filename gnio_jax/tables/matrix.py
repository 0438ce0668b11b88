"""Configurations × seeds: the seeds of a configuration are trained together, then calibrated and
evaluated one after the other; restartable, nothing done twice."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax import calibration
from gnio_jax import config as configuration
from gnio_jax.comparison.figures import how, of_run
from gnio_jax.config import CalibrateConfig, TablesConfig, TrainConfig
from gnio_jax.evaluation import report
from gnio_jax.evaluation.trajectory import Trajectory, align, read_tum
from gnio_jax.reporting import Reporter
from gnio_jax.tables.experiments import Cell
from gnio_jax.training import loop, run_folder


class Interrupted(Exception):
    """A signal asked a training run to stop; it is saved, and the same command continues it."""

    def __init__(self, signum: int):
        super().__init__(signum)
        self.signum = signum


class Result(NamedTuple):
    """A cell after all its seeds."""

    cell: Cell
    figures: list[dict[str, Any]]
    """metrics.json of each seed."""
    runs: list[Path]
    """Their work folders."""


def run_cell(cell: Cell, options: TablesConfig, reporter: Reporter, workers: int = 1) -> Result:
    """Train, calibrate if that is asked for, and evaluate a cell with seeds 0 … seeds−1 below
    OUT/runs.

    A run that is finished is not trained again, one that was interrupted goes on, a calibration and
    an evaluation that are there are read. Raises `InputError` if a folder holds a run with other
    settings, and `Interrupted` after a signal. `workers` processes read recordings that are slow to
    read.
    """
    workdir = Path(options.out) / "runs" / cell.name
    config, seeds = dataclasses.replace(cell.config, workdir=str(workdir)), range(options.seeds)
    train(config, seeds, reporter, workers)
    runs = [Path(each.workdir or "") for each in configuration.with_seeds(config, seeds)]
    if options.calibrate:
        runs = [calibrated(run, reporter, workers) for run in runs]
    given = dict(split=options.split, estimator=options.estimator, reporter=reporter)
    figures = [of_run(run, **given, workers=workers).figures for run in runs]
    return Result(cell, figures, runs)


def train(config: TrainConfig, seeds: Sequence[int], reporter: Reporter, workers: int = 1) -> None:
    """Train the runs of `config` with these seeds to their end, as far as they are not there
    yet."""
    states: dict[str, list[int]] = {"begun": [], "new": [], "finished": []}
    for each in configuration.with_seeds(config, seeds):
        states[_standing(each)].append(each.seed)
    for standing in ("begun", "new"):
        if not states[standing]:
            continue
        numbers = ", ".join(f"s{seed}" for seed in states[standing])
        reporter.line(f"── {configuration.default_workdir(config).name} {numbers}")
        outcomes = loop.train_seeds(
            config, states[standing], standing == "begun", reporter, workers
        )
        if outcomes[-1].stopped_by:
            raise Interrupted(outcomes[-1].stopped_by)


def _standing(config: TrainConfig) -> Literal["new", "begun", "finished"]:
    """How far the run of `config` is. Raises `InputError` if its folder holds one with other
    settings."""
    workdir = Path(config.workdir or "")
    if not (workdir / "config.yaml").exists():
        return "new"
    run_folder.refuse_other_run(config, resume=True)  # refuses other settings
    log = workdir / "metrics.jsonl"
    rows = log.read_text(encoding="utf-8").count("\n") if log.exists() else 0
    return "finished" if rows >= config.optim.epochs else "begun"


def calibrated(workdir: Path, reporter: Reporter, workers: int = 1) -> Path:
    """The run's best checkpoint with its filter fitted to its validation split: the calibrated run
    that is there if it is of that checkpoint, else a new one."""
    folder = workdir.with_name(f"{workdir.name}_calibrated")
    if folder.exists() and _best_step(folder) == _best_step(workdir):
        return folder
    reporter.line(f"calibrating {workdir.name}")
    shutil.rmtree(folder, ignore_errors=True)
    calibration.calibrate(CalibrateConfig(str(workdir), out=str(folder)), workers=workers)
    return folder


def _best_step(workdir: Path) -> list[str]:
    return sorted(entry.name for entry in (workdir / "checkpoints" / "best").glob("[0-9]*"))


class PlanView(NamedTuple):
    """Paths of one sequence seen from above, m."""

    reference: Float[np.ndarray, "n 2"]
    estimate: Float[np.ndarray, "n 2"]
    """Laid on by start position and yaw; NaN from where it diverged."""


def paths(result: Result, split: str, estimator: str) -> dict[str, PlanView]:
    """Reference and the first seed's estimate of each sequence that has a reference."""
    folder = results_folder(result, split, estimator)
    names = list(result.figures[0]["sequences"])
    found = {}
    for name, stem in zip(names, report.file_names(names), strict=True):
        reference, estimate = (
            folder / kind / f"{stem}.txt" for kind in ("references", "trajectories")
        )
        if reference.exists():
            found[name] = _plan_view(read_tum(estimate), read_tum(reference))
    return found


def results_folder(result: Result, split: str, estimator: str) -> Path:
    """Of the first seed's evaluation."""
    return how(result.runs[0], split, estimator)[1]


def _plan_view(estimate: Trajectory, reference: Trajectory) -> PlanView:
    """Files have no row where the reference is not trusted or the estimate not finite."""
    rows = np.searchsorted(estimate.time, reference.time - 1e-6)
    rows = np.minimum(rows, len(estimate.time) - 1)
    present = np.abs(estimate.time[rows] - reference.time) <= 1e-6
    poses = (
        np.where(present[:, None], part[rows], np.nan)
        for part in (estimate.position, estimate.orientation)
    )
    aligned = align(Trajectory(reference.time, *poses), reference)
    return PlanView(reference.position[:, :2], aligned.position[:, :2])
