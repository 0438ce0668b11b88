"""The runs of a table's row: its seeds are trained, its network is timed, then its seeds are
calibrated and evaluated one after the other. Nothing is done twice, and interrupted work
continues."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from gnio_jax import calibration, data, models
from gnio_jax import config as configuration
from gnio_jax.config import CalibrateConfig, EvaluateConfig, TablesConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import reuse
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.statistics import Scores
from gnio_jax.networks.folder import WEIGHTS, read_settings
from gnio_jax.reporting import Reporter
from gnio_jax.tables.cost import RunCost, load_or_measure
from gnio_jax.tables.experiments import TableRow
from gnio_jax.training import loop, run_folder

CALIBRATED = "_calibrated"
"""Ending of the folder of a calibrated run."""


class Interrupted(Exception):
    """A signal, whose number is the argument, asked a training run to stop; it is saved, and the
    same command continues it."""


class RowResult(NamedTuple):
    """A row after all its seeds."""

    row: TableRow
    reports: list[Report]
    runs: list[Path]
    """Work folders of the seeds."""
    folders: list[Path]
    """Reports of their evaluations."""
    cost: RunCost

    @property
    def uncalibrated(self) -> list[str]:
        """Names of the runs whose filter is not calibrated."""
        return [run.name for run in self.runs if not run.name.endswith(CALIBRATED)]

    @property
    def seeds(self) -> list[Scores]:
        return [report.scores for report in self.reports]


def run_row(
    row: TableRow, options: TablesConfig, reporter: Reporter, workers: int = 1
) -> RowResult:
    """Train, calibrate if the options ask for it, and evaluate a row with seeds 0 … seeds−1 below
    OUT/runs.

    A finished run is not trained again, an interrupted one continues, and an existing cost,
    calibration or evaluation is read. Raises `InputError` if a folder holds a run with other
    settings or of other recordings, and `Interrupted` after a signal. `workers` processes read
    recordings that are slow to read.
    """
    workdir = Path(options.out) / "runs" / row.name
    config, seeds = dataclasses.replace(row.config, workdir=str(workdir)), range(options.seeds)
    train(config, seeds, reporter, workers)
    runs = [
        Path(seed_config.workdir or "") for seed_config in configuration.with_seeds(config, seeds)
    ]
    cost = load_or_measure(runs[0], reporter)
    if options.calibrate:
        runs = [calibrate_run(run, reporter, workers) for run in runs]
    measured = {"dataset": options.dataset, "data_root": options.data_root, "split": options.split}
    settings = {**measured, "estimator": options.estimator, "plots": False}
    requests = [EvaluateConfig(str(run), **settings) for run in runs]
    evaluations = [reuse.find_existing(request) for request in requests]
    reports = [reuse.load_or_evaluate(evaluation, reporter, workers) for evaluation in evaluations]
    folders = [evaluation.folder for evaluation in evaluations]
    return RowResult(row, reports, runs, folders, cost)


def train(config: TrainConfig, seeds: Sequence[int], reporter: Reporter, workers: int = 1) -> None:
    """Train the runs of `config` with these seeds to their end, unless they are finished
    already."""
    states: dict[str, list[int]] = {"begun": [], "new": [], "finished": []}
    for seed_config in configuration.with_seeds(config, seeds):
        states[run_state(seed_config)].append(seed_config.seed)
    for state in ("begun", "new"):
        if not states[state]:
            continue
        numbers = ", ".join(f"s{seed}" for seed in states[state])
        reporter.line(f"── {configuration.default_workdir(config).name} {numbers}")
        configs = configuration.with_seeds(config, states[state])
        outcomes = loop.train_all(configs, state == "begun", reporter, workers)
        if outcomes[-1].stopped_by:
            raise Interrupted(outcomes[-1].stopped_by)


def unfinished_runs(row: TableRow, out: Path, seeds: int) -> list[TrainConfig]:
    """The runs of a row that are not trained to their end. Raises `InputError` as `run_state`."""
    config = dataclasses.replace(row.config, workdir=str(out / "runs" / row.name))
    runs = configuration.with_seeds(config, range(seeds))
    return [run for run in runs if run_state(run) != "finished"]


def run_state(config: TrainConfig) -> str:
    """State of the run of `config`: new, begun or finished. Raises `InputError` if its folder has a
    run with other settings or of other recordings."""
    workdir = Path(config.workdir or "")
    file = workdir / "config.yaml"
    if not file.exists():
        return "new"
    run_folder.refuse_other_run(config, resume=True)
    for dataset in filter(lambda name: data.get(name).needs_root, config.datasets):
        trained_root = Path(configuration.load(file).data_root or data.find_root(dataset))
        root = data.find_root(dataset, config.data_root)
        if (
            trained_root.is_dir() and trained_root.resolve() != root.resolve()
        ):  # otherwise the folder has moved
            problem = f"was trained on the recordings of {trained_root}, not of {root}"
            raise InputError(file, problem, "give another --out")
    if models.trained_by(models.from_experiment(config)) != "gradient":  # has no epochs
        return "finished" if (workdir / WEIGHTS).exists() else "new"
    return "finished" if finished_epochs(workdir) >= config.optim.epochs else "begun"


def finished_epochs(workdir: Path) -> int:
    """The number of epochs in the log of a run, to which each is added when all its other files
    are written. Raises `InputError` as `run_folder.read_rows` does."""
    return run_folder.count_epochs(run_folder.read_rows(workdir))


def calibrate_run(workdir: Path, reporter: Reporter, workers: int = 1) -> Path:
    """The run's best weights with the filter fitted to its validation split: the existing
    calibrated run if it has these weights, else a new one. If the filter cannot be fitted, a
    warning says so, and the run stays as it is: the other rows go on."""
    folder = workdir.with_name(f"{workdir.name}{CALIBRATED}")
    if folder.exists() and read_settings(folder).digest == read_settings(workdir).digest:
        return folder
    reporter.line(f"calibrating {workdir.name}")
    shutil.rmtree(folder, ignore_errors=True)
    request = CalibrateConfig(str(workdir), out=str(folder))
    try:
        result = calibration.calibrate(request, workers=workers)
    except InputError as error:
        reporter.line(f"warning: {workdir.name} is measured without calibration: {error}")
        return workdir
    for warning in result.warnings:
        reporter.line(f"warning: {folder.name}: {warning}")
    return folder
