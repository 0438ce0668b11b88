"""One evaluation, from a network and its options to a folder of results.

    prepare → infer → estimate → score → report

Each stage is one file of this folder and one call here. Its inputs are results of earlier stages,
and no stage calls an earlier one.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import zlib
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gnio_jax import config as configuration
from gnio_jax import data, models
from gnio_jax.config import EvaluateConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation.estimate import (
    PERFECT_STD,
    SequenceEstimate,
    estimate,
    never_moves,
    perfect,
)
from gnio_jax.evaluation.folder import write
from gnio_jax.evaluation.infer import infer, no_displacements, reference_displacements
from gnio_jax.evaluation.metrics import score
from gnio_jax.evaluation.prepare import Orientation, PreparedRecording, prepare
from gnio_jax.evaluation.report import DEFINITIONS, Report
from gnio_jax.evaluation.trajectory import Alignment, Undefined, pair, read_tum
from gnio_jax.filtering import make_filter
from gnio_jax.models import Network
from gnio_jax.networks import (
    TrainedNetwork,
    digest_corrector,
    find_network,
    load_corrector,
    newest_run,
    read_network,
)
from gnio_jax.networks.folder import evaluations_folder, training_recordings
from gnio_jax.reporting import Progress, Reporter, Silence
from gnio_jax.types import Sequence

SILENCE = Silence()
NAMED = {
    "coupling": "{}",
    "orientation": "{}-orientation",
    "init": "{}-init",
    "gyro_bias": "{}-bias",
    "alignment": "{}-alignment",
    "checkpoint": "{}",
}
"""Choices that are part of a folder's name if they are not the default."""
LONGEST_NAME = 150
"""Largest number of bytes of a folder's name, to which the name of a data root may be added. File
systems allow 255, and for a file that is written beside it a few more are needed."""
OF_SAMPLES = ("corrector",)
"""Settings of the filter that change the samples, and so every estimator."""
WINDOWS = ("rate", "window_seconds", "context_seconds", "stride_seconds", "window_rotation")
"""Settings of `DataConfig` on which the figures depend."""


class Evaluation(NamedTuple):
    """The result of `evaluate`."""

    report: Report
    estimates: list[SequenceEstimate]
    recordings: list[PreparedRecording]
    folder: Path
    """Folder of the results."""


def evaluate(
    config: EvaluateConfig,
    reporter: Reporter = SILENCE,
    workers: int = 1,
    command: str = "",
) -> Evaluation:
    """Estimate every sequence of a split with a trained network, measure the errors, and write the
    results to a folder of the network.

    The folder is written whole or not at all, and replaces that of an earlier evaluation with the
    same options.

    Args:
        config: The options of `gnio evaluate`.
        reporter: It gets progress and lines of text.
        workers: Number of processes that read recordings that are slow to read.
        command: The command line, for the page.

    Raises:
        InputError: Options do not fit together, the network cannot be loaded, data are missing, or
            no sequence of the split can be estimated.
    """
    _check(config)
    path = find_network(config.network or newest_run())
    trained = _load_network(path, config)
    config = resolve(config, trained.config)
    windows, ekf = trained.config.data, make_filter(trained.config.data, config.filter)

    def stage(name: str) -> Progress:
        return functools.partial(reporter.progress, name)

    unread: dict[str, str] = {}
    sequences = data.load(
        config.dataset, config.data_root, config.split, workers, stage("reading"), unread
    )
    for sequence in sequences:
        if sequence.waypoints is not None and config.alignment not in ("origin", "yaw_position"):
            problem = f"has waypoints, and no --alignment {config.alignment}"
            remedy = "leave it out: one turn about z and one shift are fitted"
            raise InputError(sequence.name, problem, remedy)
    learnt = training_recordings(path, trained.config, config.dataset)
    if overlap := [sequence.name for sequence in sequences if sequence.name in learnt]:
        count = f"{len(overlap)} of {len(sequences)} recordings, e.g. {overlap[0]}"
        reporter.line(f"warning: the network has learnt from {count}: its errors there are smaller")
    recordings, left_out = prepare(
        sequences,
        windows,
        ekf,
        init=config.init,
        gyro_bias=config.gyro_bias,
        orientation=config.orientation if _infers(config) else None,
        corrector=load_corrector(config.filter, windows.rate, trained),
    )
    if not recordings:
        name, reason = next(iter(left_out.items()))
        problem = f"no sequence of split '{config.split}' can be estimated ({name}: {reason})"
        raise InputError(f"dataset {config.dataset}", problem)

    network = Network.of(trained.model, trained.variables)
    if _infers(config):
        options: dict[str, Any] = {}
        if config.estimator == "ekf":
            options["least_std"] = math.exp(ekf.config.log_std_min)
            options["measures"] = ekf.config.measures
        source = infer(network, recordings, windows, stage("inferring"), **options)
    elif config.estimator == "imu_only":
        source = [no_displacements(recording) for recording in recordings]
    else:
        source = network
    posed = [recording for recording in recordings if recording.waypoints is None]
    truth = [reference_displacements(recording, PERFECT_STD) for recording in posed]

    actual, ideal = (None, None) if config.estimator == "integrate" else (ekf, perfect(ekf))
    batch, perfecting = config.batch_size, stage("estimating with perfect displacements")
    estimates = estimate(recordings, source, windows, actual, batch, stage("estimating"))
    floor = estimate(posed, truth, windows, ideal, batch, perfecting)
    compared = {"never_moves": never_moves(estimates), "perfect_displacements": floor}

    report = Report(
        _describe_settings(config, trained, sequences),
        score(estimates, config.alignment),
        {row: score(of, config.alignment) for row, of in compared.items() if of},
        {recording.name: recording.group for recording in recordings},
        {result.name: list(result.notes) for result in estimates if result.notes},
        unread | left_out,
        {recording.name: recording.placement for recording in recordings if recording.placement},
    )
    folder = folder_of(path, config, trained.config)
    write(folder, report, estimates, trained.config, command, config.plots, stage("drawing"))
    return Evaluation(report, estimates, recordings, folder)


def score_files(reference: Path, estimate: Path, alignment: Alignment = "origin") -> Report:
    """The report about two trajectories in TUM format, written by any program, at the stamps that
    they share. Raises `InputError` if these are too few."""
    try:
        path, truth = pair(read_tum(estimate), read_tum(reference))
    except Undefined as problem:
        remedy = "give both the stamps of one clock, in s"
        raise InputError(estimate, f"{problem} as in {reference}", remedy) from None
    estimates = [SequenceEstimate(estimate.stem, path, truth)]
    count = f"{np.isfinite(truth.position).all(axis=1).sum():,} poses"
    settings = {"dataset": estimate.name, "split": f"against {count} of {reference.name}"}
    settings |= {"estimator": "given poses", "alignment": alignment}
    still = {"never_moves": score(never_moves(estimates), alignment)}
    groups = {estimate.stem: estimate.stem}
    return Report(settings, score(estimates, alignment), still, groups, {}, {})


def _check(config: EvaluateConfig) -> None:
    """Raise `InputError` for options that are impossible for any run."""
    if config.batch_size < 1:
        raise InputError("--batch-size", f"must be at least 1, found {config.batch_size}")
    if not _infers(config) and config.orientation not in (None, "filter"):
        what = "imu_only" if config.estimator == "imu_only" else "the tight coupling"
        problem = f"{what} uses the filter's own attitude"
        remedy = "leave it out, or choose --coupling loose or --estimator integrate"
        raise InputError(f"--orientation {config.orientation}", problem, remedy)
    if config.estimator != "ekf" and config.coupling != "tight":
        problem = f"{config.estimator} has no filter that a network is coupled to"
        remedy = "leave it out, or choose --estimator ekf"
        raise InputError(f"--coupling {config.coupling}", problem, remedy)
    for assignment in config.set:
        if not assignment.startswith("filter."):
            remedy = "write filter.FIELD=VALUE, e.g. filter.noise.measurement_scale=1"
            raise InputError(f"--set {assignment}", "is not a setting of the filter", remedy)
        setting = assignment.partition("=")[0].strip().removeprefix("filter.")
        if config.estimator == "integrate" and setting not in OF_SAMPLES:
            remedy = "leave it out, or choose --estimator ekf"
            raise InputError(f"--set {assignment}", "integrate has no filter", remedy)


def resolve(config: EvaluateConfig, run: TrainConfig) -> EvaluateConfig:
    """The request, completed from the run: dataset, folder of the data, orientation of the windows,
    and the filter with the changes of `config.set`. `run` is the configuration of the run. Raises
    `InputError` for an unknown dataset, missing data and impossible settings."""
    changed = dataclasses.replace(run, filter=config.filter or run.filter)
    changed = configuration.validate(configuration.assign(changed, config.set), "command line")
    models.check_experiment(models.from_config(changed.model), changed, "command line")
    dataset, root = config.dataset or run.datasets[0], None
    if config.dataset is None and len(run.datasets) > 1:
        remedy = f"give --dataset, e.g. {dataset}"
        raise InputError(
            config.network or "the run", f"has learnt from {', '.join(run.datasets)}", remedy
        )
    if data.get(dataset).needs_root:
        data_root = config.data_root or (run.data_root if dataset in run.datasets else None)
        root = str(data.find_root(dataset, data_root).resolve())
    return dataclasses.replace(
        config,
        dataset=dataset,
        data_root=root,
        coupling=config.coupling if config.estimator == "ekf" else "tight",
        orientation=config.orientation or _default_orientation(config),
        filter=changed.filter,
        set=(),
    )


def _load_network(path: Path, config: EvaluateConfig) -> TrainedNetwork:
    """The network of a run's folder. Raises `InputError` if the estimator needs displacements and
    the network predicts none."""
    if config.checkpoint == "latest":
        from gnio_jax.training.checkpoint import load_latest  # Orbax takes half a second to import

        trained = load_latest(path)
    else:
        trained = read_network(path)
    if _infers(config) and not models.predicts_displacement(trained.model):
        problem = f"needs displacements, and '{trained.config.model.name}' predicts none"
        choice = "integrate" if config.estimator == "integrate" else "loose"
        raise InputError(choice, problem, "evaluate it with the filter's tight coupling")
    return trained


def _infers(config: EvaluateConfig) -> bool:
    """Whether the network runs over all windows before the estimator."""
    loose = config.estimator == "ekf" and config.coupling == "loose"
    return loose or config.estimator == "integrate"


def _default_orientation(config: EvaluateConfig) -> Orientation:
    return "reference" if _infers(config) else "filter"


def folder_of(path: Path, config: EvaluateConfig, run: TrainConfig) -> Path:
    """The folder of a network for the results of a resolved `config`.

    If it already holds the results of another `data_root`, they stay: from then on the folder of
    this data root has a suffix of its name and a digest of its path."""
    folder = evaluations_folder(path) / folder_name(config, run)
    if config.data_root is None:
        return folder
    root = Path(config.data_root)
    of_root = root.name.encode()[:50].decode(errors="ignore")
    with_root = folder.with_name(f"{folder.name}_{of_root}-{zlib.crc32(bytes(root)):08x}-root")
    try:
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        occupied = metrics["settings"]["data_root"] != config.data_root
    except (OSError, ValueError, LookupError, TypeError):  # the file names no recordings
        occupied = False
    return with_root if occupied or with_root.exists() else folder


def folder_name(config: EvaluateConfig, run: TrainConfig) -> str:
    """<dataset>_<split>_<estimator>, then every choice of a resolved `config` other than the
    default. What is beyond `LONGEST_NAME` becomes a digest of the whole name."""
    defaults = vars(EvaluateConfig(orientation=_default_orientation(config)))
    choices = vars(config)
    parts = [config.dataset, config.split, config.estimator]
    parts += [text.format(choices[x]) for x, text in NAMED.items() if choices[x] != defaults[x]]
    trained, chosen = configuration.flatten(run.filter), configuration.flatten(config.filter)
    for name in {**trained, **chosen} if config.estimator != "integrate" else OF_SAMPLES:
        if (value := chosen.get(name)) != trained.get(name):
            numbers = value if isinstance(value, tuple) else (value,)
            text = ",".join(f"{x:g}" if isinstance(x, float) else str(x) for x in numbers)
            text = text.replace("/", "-")  # the folder of a corrector
            parts.append(f"{name}-{text}")
    name = "_".join(map(str, parts))
    if len(name.encode()) <= LONGEST_NAME:
        return name
    digest = f"_{zlib.crc32(name.encode()):08x}"
    return name.encode()[: LONGEST_NAME - len(digest)].decode(errors="ignore") + digest


def _describe_settings(
    config: EvaluateConfig, trained: TrainedNetwork, sequences: list[Sequence]
) -> dict[str, Any]:
    """The settings that define the meaning of the figures and their subject."""
    compensated = {str(sequence.attributes.get("imu_compensated", "no")) for sequence in sequences}
    tapped = all(sequence.waypoints is not None for sequence in sequences)
    return {
        "dataset": config.dataset,
        "data_root": config.data_root,
        "split": config.split,
        "recordings": {
            sequence.name: round(float(np.ptp(sequence.time)), 3) for sequence in sequences
        },
        "contents": data.describe_contents(config.dataset, config.data_root, config.split),
        "estimator": config.estimator,
        "coupling": config.coupling if config.estimator == "ekf" else None,
        "orientation_source": config.orientation,
        "initial_state": "static" if tapped else config.init,
        **({"reference": "waypoints"} if tapped else {}),
        "gyro_bias": config.gyro_bias,
        "imu_compensated": " and ".join(sorted(compensated)),
        "alignment": config.alignment,
        "network": trained.name,
        "model": trained.config.model.name,
        "checkpoint": config.checkpoint,
        "weights": trained.digest or None,
        "corrector_weights": digest_corrector(config.filter, trained),
        **{name: getattr(trained.config.data, name) for name in WINDOWS},
        "filter": configuration.to_plain(config.filter),
        "perfect_displacements_std": PERFECT_STD if config.estimator != "integrate" else None,
        "definitions": DEFINITIONS,
        "device": jax.devices()[0].device_kind,
        "version": version("gnio-jax"),
        "epoch": trained.epoch,
        "step": trained.step,
    }
