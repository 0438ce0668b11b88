"""The training and validation data of a network: the recordings of two splits at its rate, with
poses, as windows or segments.

A walk with waypoints has no poses. They are interpolated between the waypoints
(`data.with_poses`), or made by an earlier run (`waypoint_poses`).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from gnio_jax import config as configuration
from gnio_jax import data, models, networks, parallel
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Reporter
from gnio_jax.training.task import Task, visit_count
from gnio_jax.training.waypoint_poses import (
    PoseNetwork,
    add_smoothed_poses,
    load_pose_network,
)
from gnio_jax.types import Sequence


class TrainingData(NamedTuple):
    """The data on which a task is trained and validated."""

    source: Any
    """Windows or segments of the training split, on the devices."""
    held_out: dict[str, Any]
    """Windows or segments of the validation split of each dataset, by its name, on the devices."""
    splits: dict[str, dict[str, int] | list[str]]
    """Names of the recordings of each split and their lengths in samples. With several datasets the
    name of the dataset comes first. If a run has made poses, its digest is there too, as
    `data.poses_by`."""


def set_up(
    task: type[Task],
    config: TrainConfig,
    reporter: Reporter,
    workers: int = 1,
) -> tuple[Task, TrainingData]:
    """Load the recordings and find the windows or segments in them.

    Raises `InputError` for options that the network does not have, missing data, recordings that
    are too short, a batch that is larger than the split, and one that the devices cannot share
    evenly. `workers` processes read recordings that are slow to read, and make smoothed poses.
    """
    model = models.from_experiment(config)  # finds mistakes in its options before reading data
    size, devices = config.optim.batch_size, parallel.count()
    if size % devices:
        problem = f"is {size}, which {devices} devices cannot share evenly"
        remedy = f"make it a multiple of {devices}, or use fewer --devices"
        raise InputError("optim.batch_size", problem, remedy)
    sources, held_out, splits = read_splits(
        config,
        reporter,
        workers,
        lambda sequences, training: task.source_of(sequences, config, training),
        lambda source: f"{task.count(source):,} {task.unit}",
    )
    held_out = {name: parallel.copy_to_devices(source) for name, source in held_out.items()}
    parts = tuple(map(task.count, sources))
    epoch = sum(map(visit_count, parts, config.data.weights or [1.0] * len(parts)))
    if epoch < size:
        problem = f"is {size}, but there are only {epoch} {task.unit}"
        raise InputError("optim.batch_size", problem, "lower it")
    training_data = TrainingData(parallel.copy_to_devices(task.join(sources)), held_out, splits)
    portable = dataclasses.replace(configuration.without_paths(config), seed=0)
    return task(model, portable, epoch // size, parts), training_data


class SplitSources(NamedTuple):
    """What was made of the recordings of both splits: windows or segments."""

    training: list[Any]
    """Of the training split of each dataset."""
    held_out: dict[str, Any]
    """Of the validation split of each dataset, by its name."""
    splits: dict[str, dict[str, int] | list[str]]
    """See `TrainingData.splits`."""


def read_splits(
    config: TrainConfig,
    reporter: Reporter,
    workers: int,
    make: Callable[[Iterable[Sequence], bool], Any],
    describe: Callable[[Any], str],
) -> SplitSources:
    """Read the training and the validation split of every dataset, and tell what they hold, what is
    left out of them, and whether they share recordings.

    `make` makes a source of the recordings of a split, and is told whether it is for training;
    `describe` gives its size in words.
    """
    train, val = config.data.train_split, config.data.val_split
    names, pose_network = config.datasets, load_pose_network(config, reporter)
    reporter.line(f"reading {', '.join(names)}: {train} and {val}")
    sources, held_out, splits = [], {}, {}
    for split, training in ((train, True), (val, False)):
        splits[split] = {}
        for name in names:
            label = f"{name}/" if len(names) > 1 else ""
            samples: dict[str, int] = {}
            left_out: dict[str, str] = {}
            sequences = read_split(
                config, name, split, reporter, workers, samples, pose_network, left_out
            )
            source = make(sequences, training)
            if training:
                sources.append(source)
            else:
                held_out[name] = source
            splits[split] |= {label + sequence: count for sequence, count in samples.items()}
            hours = sum(samples.values()) / config.data.rate / 3600
            contents = f"{hours:.2f} h, {describe(source)}"
            reporter.line(f"  {label}{split}: {len(samples)} sequences, {contents}")
            for recording, reason in left_out.items():
                reporter.line(f"  warning: LEFT OUT of {label}{split}: {recording}: {reason}")
    shared = sorted(set(splits[train]) & set(splits[val]))
    if shared:
        examples = f"{', '.join(shared[:3])}{' ...' if shared[3:] else ''}"
        reporter.line(
            f"warning: {examples} in {train} and in {val}: the best checkpoint is chosen by "
            "recordings that it was trained on; separate the two splits"
        )
    if pose_network is not None:
        splits["data.poses_by"] = [pose_network.digest]
    return SplitSources(sources, held_out, splits)


def read_split(
    config: TrainConfig,
    dataset: str,
    split: str,
    reporter: Reporter,
    workers: int,
    samples: dict[str, int],
    pose_network: PoseNetwork | None = None,
    left_out: dict[str, str] | None = None,
) -> Iterator[Sequence]:
    """The recordings of a split of a dataset at the network's rate, one after another. Recordings
    with waypoints get the poses that `pose_network` makes, or else interpolated ones. The number of
    samples of each recording is written into `samples` by its name, and the reason for each one
    that could not be used into `left_out`. A walk that can have no poses is left out with a
    warning."""
    progress = functools.partial(reporter.progress, f"reading {split}")
    sequences: Iterable[Sequence] = data.load_each(
        dataset, config.data_root, split, workers, progress, left_out
    )
    corrector = networks.load_corrector(config.filter, config.data.rate)
    if pose_network is not None:
        sequences = add_smoothed_poses(sequences, pose_network, split, reporter, workers)
    for sequence in sequences:
        resampled = data.resample(sequence, config.data.rate)
        if resampled.waypoints is not None:
            try:
                resampled = data.with_poses(resampled)
            except InputError as error:
                reporter.line(f"warning: {error}")
                continue
        if corrector is not None:
            accel, gyro, _ = corrector.correct(resampled.accel, resampled.gyro)
            resampled = resampled._replace(accel=accel, gyro=gyro)
        samples[resampled.name] = len(resampled.time)
        yield resampled
