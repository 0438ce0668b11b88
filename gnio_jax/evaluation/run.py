"""One evaluation from its options to its folder of results: what `evaluate.py` does."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from gnio_jax import config as configuration
from gnio_jax import data
from gnio_jax.config import EvaluateConfig, FilterSettings, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation.estimation import (
    PERFECT_STD,
    estimate,
    never_moves,
    perfect_displacements,
)
from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.exporting import rerun_file
from gnio_jax.evaluation.frames import in_the_references_frame
from gnio_jax.evaluation.inference import Network, inference_network
from gnio_jax.evaluation.preparation import Prepared, prepare
from gnio_jax.evaluation.report import DEFINITIONS, Report, write
from gnio_jax.evaluation.scores import score
from gnio_jax.evaluation.setup import Setup, resolve
from gnio_jax.evaluation.trajectory import Alignment
from gnio_jax.parallel import is_first
from gnio_jax.types import Sequence

OnStage = Callable[[str, float], None]
"""Called with the stage and the share of it that is done."""


class Evaluation(NamedTuple):
    """What `evaluate` found and where it is."""

    report: Report
    folder: Path


class Job(NamedTuple):
    """What is evaluated, and how."""

    workdir: Path
    trained: TrainConfig
    """Configuration of the run."""
    network: Network | None
    """None for `imu_only`."""
    provenance: dict[str, Any]
    """Where the network is from."""
    options: FilterSettings
    setup: Setup
    dataset: str
    data_root: str | None


def evaluate(
    config: EvaluateConfig,
    progress: OnStage = lambda stage, share: None,
    workers: int = 1,
    command: str = "",
) -> Evaluation:
    """Estimate every sequence of a split with a run's network, measure, and leave the results in a
    folder of the run. Several processes (`jax.distributed`) share the filter's work, and the first
    one writes.

    The folder is written whole or not at all, and takes the place of the one an earlier evaluation
    with the same options left. `workers` processes read what is slow to read (`data.load`).
    `command` is how this was called, for the page.

    Raises `InputError` for options that do not fit together, a workdir without the checkpoint,
    unknown or missing data, or sequences that cannot be estimated this way.
    """
    job = _set_up(config)
    trained, setup = job.trained, job.setup
    sequences = data.load(
        job.dataset, job.data_root, config.split, workers, lambda x: progress("reading", x)
    )

    prepared, left_out = prepare(sequences, trained.data, setup)
    if not prepared:
        name, reason = next(iter(left_out.items()))
        problem = f"no sequence of split '{config.split}' can be estimated ({name}: {reason})"
        raise InputError(f"dataset {job.dataset}", problem)

    how = (trained.data, job.options, setup, config.batch_size)
    estimates = estimate(prepared, job.network, *how, lambda x: progress("estimating", x))
    ideal = perfect_displacements(
        prepared, *how, lambda x: progress("estimating with perfect displacements", x)
    )

    report = Report(
        _settings(config, job, sequences, prepared),
        score(estimates, config.alignment),
        {
            "never_moves": score(never_moves(estimates), config.alignment),
            "perfect_displacements": score(ideal, config.alignment),
        },
        {each.sequence.name: str(data.group(each.sequence)) for each in prepared},
        {e.name: list(e.notes) for e in estimates if e.notes},
        left_out,
    )

    folder = job.workdir / "eval" / folder_name(config, job.dataset, trained)
    if is_first():
        drawing = lambda x: progress("drawing", x)  # noqa: E731
        write(folder, report, estimates, trained, command, config.plots, drawing)
        if config.rerun:
            _write_rerun(Path(config.rerun), estimates, prepared, config.alignment)
    return Evaluation(report, folder)


def _write_rerun(
    path: Path, estimates: list[Estimate], prepared: list[Prepared], alignment: Alignment
) -> None:
    """The estimates in the frames of their references, with the IMU that they are of."""
    logged = [
        rerun_file.Logged(in_the_references_frame(estimate, alignment), each.sequence)
        for estimate, each in zip(estimates, prepared, strict=True)
    ]
    rerun_file.write_rerun(path, logged)


def folder_name(config: EvaluateConfig, dataset: str, trained: TrainConfig) -> str:
    """<dataset>_<split>_<estimator>, then every choice that is not the default: other figures never
    take the place of these."""
    usual = resolve(_setup(config)._replace(orientation=None)).orientation
    parts = [dataset, config.split, config.estimator]
    if config.estimator == "ekf" and config.coupling != "tight":
        parts.append(config.coupling)
    if config.orientation not in (None, usual):
        parts.append(f"{config.orientation}-orientation")
    if config.init != "reference":
        parts.append(f"{config.init}-init")
    if config.gyro_bias != "zero":
        parts.append(f"{config.gyro_bias}-bias")
    if config.alignment != "origin":
        parts.append(f"{config.alignment}-alignment")
    if config.checkpoint != "best" and config.estimator != "imu_only":
        parts.append(config.checkpoint)
    if config.estimator != "integrate":
        usual, own = configuration.flat(trained.filter), configuration.flat(config.filter)
        for name in {**usual, **own}:
            value = own.get(name)
            if value != usual.get(name):
                numbers = value if isinstance(value, tuple) else (value,)
                text = ",".join(f"{x:g}" if isinstance(x, float) else str(x) for x in numbers)
                parts.append(f"{name}-{text}")
    return "_".join(parts)


def _setup(config: EvaluateConfig) -> Setup:
    return Setup(
        config.estimator, config.coupling, config.orientation, config.init, config.gyro_bias
    )


def _set_up(config: EvaluateConfig) -> Job:
    """The run with its network, and the options checked against each other."""
    setup = resolve(_setup(config))
    if config.batch_size < 1:
        raise InputError("--batch-size", f"must be at least 1, found {config.batch_size}")
    if config.rerun:
        rerun_file.check_file(Path(config.rerun))
    workdir = Path(config.workdir) if config.workdir else configuration.newest_run()
    trained, network, provenance = _load_run(workdir, config)
    checked = configuration.validate(
        dataclasses.replace(trained, filter=config.filter), "command line"
    )
    dataset = config.dataset or trained.dataset
    own_root = trained.data_root if dataset == trained.dataset else None
    root = config.data_root or own_root
    return Job(workdir, trained, network, provenance, checked.filter, setup, dataset, root)


def run_config(workdir: Path, which: Literal["best", "latest"] = "best") -> TrainConfig:
    """The settings of a run; the filter's options as this checkpoint has learnt them, if they did.

    Raises `InputError` if they did and there is no checkpoint.
    """
    config = configuration.load(workdir / "config.yaml")
    if not config.through_filter.learn:
        return config
    from gnio_jax.training import checkpoint  # Orbax takes seconds to import

    return checkpoint.load_run(workdir, which).config


def _load_run(
    workdir: Path, config: EvaluateConfig
) -> tuple[TrainConfig, Network | None, dict[str, Any]]:
    """The run's configuration, its network (none for `imu_only`, which needs no checkpoint) and
    where that is from."""
    kept = workdir / "config.yaml"
    if config.estimator == "imu_only" and kept.is_file():
        nothing: dict[str, Any] = dict.fromkeys(("model", "checkpoint", "epoch", "step"))
        return run_config(workdir, config.checkpoint), None, nothing
    from gnio_jax.training import checkpoint  # Orbax takes seconds to import

    run = checkpoint.load_run(workdir, config.checkpoint)
    provenance = {
        "model": run.config.model.name,
        "checkpoint": config.checkpoint,
        "epoch": run.epoch,
        "step": run.step,
    }
    return run.config, inference_network(run.model, run.variables), provenance


def _settings(
    config: EvaluateConfig, job: Job, sequences: list[Sequence], prepared: list[Prepared]
) -> dict[str, Any]:
    """What changes the meaning of the figures."""
    needs_root = data.get(job.dataset).needs_root
    root = str(data.find_root(job.dataset, job.data_root).resolve()) if needs_root else None
    setup, windows = job.setup, job.trained.data
    compensated = {str(p.sequence.attributes.get("imu_compensated", "no")) for p in prepared}
    return {
        "dataset": job.dataset,
        "data_root": root,
        "split": config.split,
        "recordings": {each.name: round(float(np.ptp(each.time)), 3) for each in sequences},
        "estimator": setup.estimator,
        "coupling": setup.coupling if setup.estimator == "ekf" else None,
        "orientation_source": setup.orientation,
        "initial_state": setup.init,
        "gyro_bias": setup.gyro_bias,
        "imu_compensated": " and ".join(sorted(compensated)),
        "alignment": config.alignment,
        **job.provenance,
        "rate": windows.rate,
        "window_seconds": windows.window_seconds,
        "context_seconds": windows.context_seconds,
        "stride_seconds": windows.stride_seconds,
        "window_rotation": windows.window_rotation,
        "filter": configuration.plain(job.options),
        "perfect_displacements_std": PERFECT_STD if setup.estimator != "integrate" else None,
        "definitions": DEFINITIONS,
        "device": jax.devices()[0].device_kind,
        "version": version("gnio-jax"),
    }
