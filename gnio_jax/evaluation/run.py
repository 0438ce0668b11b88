"""One evaluation from its options to its folder of results: what `evaluate.py` does."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax

from gnio_jax import config as configuration
from gnio_jax import data, models
from gnio_jax.config import EvaluateConfig, TrainConfig
from gnio_jax.evaluation import odometry, report
from gnio_jax.evaluation.odometry import Network, Setup
from gnio_jax.evaluation.report import Report
from gnio_jax.types import InputError, Sequence

Progress = Callable[[str, float], None]
"""Told the stage and the share of it that is done."""


class Evaluation(NamedTuple):
    """What `evaluate` found and where it is."""

    report: Report
    folder: Path


def evaluate(
    config: EvaluateConfig,
    progress: Progress = lambda stage, share: None,
    workers: int = 1,
) -> Evaluation:
    """Estimate every sequence of a split with a run's network, measure, and leave the results in a
    folder of the run.

    The folder is written whole or not at all, and takes the place of the one an earlier evaluation
    with the same options left. `workers` processes read what is slow to read (`data.load`). Raises
    `InputError` for options that do not fit together, a workdir
    without the checkpoint, unknown or missing data, or sequences that cannot be estimated this way.
    """
    setup = odometry.resolve(
        Setup(config.estimator, config.coupling, config.orientation, config.init, config.gyro_bias)
    )
    if config.batch_size < 1:
        raise InputError("--batch-size", f"must be at least 1, found {config.batch_size}")
    workdir = Path(config.workdir) if config.workdir else configuration.newest_run()
    trained, network, provenance = _load(workdir, config)
    options = configuration.validate(
        dataclasses.replace(trained, filter=config.filter), "command line"
    ).filter
    name = config.dataset or trained.dataset
    root = config.data_root or (trained.data_root if name == trained.dataset else None)
    sequences = data.load(
        name, root, config.split, workers, lambda share: progress("reading", share)
    )

    recordings, left_out = odometry.prepare(sequences, trained.data, setup)
    if not recordings:
        first, reason = next(iter(left_out.items()))
        raise InputError(
            f"dataset {name}",
            f"no sequence of split '{config.split}' can be estimated ({first}: {reason})",
        )
    estimates = odometry.estimate(
        recordings,
        network,
        trained.data,
        options,
        setup,
        config.batch_size,
        lambda x: progress("estimating", x),
    )
    floor = odometry.perfect_displacements(
        recordings,
        trained.data,
        options,
        setup,
        config.batch_size,
        lambda x: progress("estimating with perfect displacements", x),
    )
    groups = {s.name: _group(s) for s in sequences}
    compensated = {str(r.sequence.attributes.get("imu_compensated", "no")) for r in recordings}
    settings: dict[str, Any] = {
        "dataset": name,
        "split": config.split,
        "estimator": setup.estimator,
        "coupling": setup.coupling if setup.estimator == "ekf" else None,
        "orientation_source": setup.orientation,
        "initial_state": setup.init,
        "gyro_bias": setup.gyro_bias,
        "imu_compensated": " and ".join(sorted(compensated)),
        "alignment": config.alignment,
        **provenance,
        "rate": trained.data.rate,
        "window_seconds": trained.data.window_seconds,
        "stride_seconds": trained.data.stride_seconds,
        "window_rotation": trained.data.window_rotation,
        "filter": dataclasses.asdict(options),
        "perfect_displacements_std": odometry.PERFECT_STD
        if setup.estimator != "integrate"
        else None,
        "definitions": report.DEFINITIONS,
        "device": jax.devices()[0].device_kind,
        "version": version("gnio-jax"),
    }
    found = Report(
        settings,
        report.score(estimates, groups, config.alignment),
        {
            "never_moves": report.score(odometry.never_moves(estimates), groups, config.alignment),
            "perfect_displacements": report.score(floor, groups, config.alignment),
        },
        {e.name: list(e.notes) for e in estimates if e.notes},
        left_out,
    )

    folder = workdir / "eval" / folder_name(config, name, trained)
    with report.replacing_folder(folder) as new:
        report.write(new, found, estimates)
        if config.plots:
            from gnio_jax.evaluation import plots  # Matplotlib takes a second to import

            plots.save_all(
                new / "plots",
                estimates,
                found,
                trained.data.window_seconds,
                lambda x: progress("drawing", x),
            )
    return Evaluation(found, folder)


def folder_name(config: EvaluateConfig, dataset: str, trained: TrainConfig) -> str:
    """<dataset>_<split>_<estimator>, then every choice that is not the default: other figures never
    take the place of these."""
    setup = Setup(
        config.estimator, config.coupling, config.orientation, config.init, config.gyro_bias
    )
    usual = odometry.resolve(setup._replace(orientation=None)).orientation
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
        own = dataclasses.asdict(trained.filter)
        changed = {
            key: value
            for key, value in dataclasses.asdict(config.filter).items()
            if value != own[key]
        }
        parts += [
            f"{key}-{value}" if isinstance(value, str | None) else f"{key}-{value:g}"
            for key, value in changed.items()
        ]
    return "_".join(parts)


def _load(
    workdir: Path, config: EvaluateConfig
) -> tuple[TrainConfig, Network | None, dict[str, Any]]:
    """The run's configuration, its network (none for `imu_only`, which needs no checkpoint) and
    where that is from."""
    if config.estimator == "imu_only" and (workdir / "config.yaml").is_file():
        return (
            configuration.load(workdir / "config.yaml"),
            None,
            {"model": None, "checkpoint": None, "epoch": None, "step": None},
        )
    from gnio_jax.training import checkpoint  # Orbax takes seconds to import

    run = checkpoint.load_run(workdir, config.checkpoint)
    provenance = {
        "model": run.config.model.name,
        "checkpoint": config.checkpoint,
        "epoch": run.epoch,
        "step": run.step,
    }
    return (
        run.config,
        Network(models.Inference(run.model), models.freeze(run.model, run.variables)),
        provenance,
    )


def _group(sequence: Sequence) -> str:
    """Whose recordings are not independent of each other: the loader's group, else the person, else
    each on its own."""
    return str(
        sequence.attributes.get("group") or sequence.attributes.get("subject") or sequence.name
    )
