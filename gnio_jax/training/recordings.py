"""The training and validation data of a network: the recordings of two splits at its rate, with
poses, as windows or segments.

A walk with waypoints has no poses. They are interpolated between the waypoints
(`data.with_poses`), or made by the smoother from the displacements of an earlier run
(`filtering.waypoint_poses`).
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gnio_jax import config as configuration
from gnio_jax import data, filtering, models, parallel
from gnio_jax.config import NoiseModel, TrainConfig
from gnio_jax.data.hdf5 import Reading, cache_entry, read_reading, write_reading
from gnio_jax.data.loading import FEW, in_processes
from gnio_jax.errors import InputError
from gnio_jax.filtering.network import Predict
from gnio_jax.models import Network
from gnio_jax.reporting import Reporter
from gnio_jax.training.checkpoint import Run, load_run
from gnio_jax.training.task import Task, visit_count
from gnio_jax.types import Sequence

Load = Callable[[str], Run]
"""A function that reads the run, or the package of weights, of this name. It must be a function of
a module, because other processes call it too."""


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


class PoseNetwork(NamedTuple):
    """The network that makes poses of walks with waypoints."""

    run: str
    load: Load
    digest: str
    """Digest of its weights and settings."""


def set_up(
    task: type[Task],
    config: TrainConfig,
    reporter: Reporter,
    workers: int = 1,
    load: Load = load_run,
) -> tuple[Task, TrainingData]:
    """Load the recordings and find the windows or segments in them.

    Raises `InputError` for options that the network does not have, missing data, recordings that
    are too short, a batch that is larger than the split, and one that the devices cannot share
    evenly. `workers` processes read recordings that are slow to read, and make smoothed poses with
    the run that `load` reads.
    """
    model = models.from_config(config.model)  # finds mistakes in its options before reading data
    size, devices = config.optim.batch_size, parallel.count()
    if size % devices:
        problem = f"is {size}, which {devices} devices cannot share evenly"
        remedy = f"make it a multiple of {devices}, or use fewer --devices"
        raise InputError("optim.batch_size", problem, remedy)
    train, val = config.data.train_split, config.data.val_split
    names, pose_network = config.datasets, _load_pose_network(config, reporter, load)
    reporter.line(f"reading {', '.join(names)}: {train} and {val}")
    sources, held_out, splits = [], {}, {}
    for split, training in ((train, True), (val, False)):
        splits[split] = {}
        for name in names:
            label = f"{name}/" if len(names) > 1 else ""
            samples: dict[str, int] = {}
            sequences = read_split(config, name, split, reporter, workers, samples, pose_network)
            source = task.source_of(sequences, config, training)
            if training:
                sources.append(source)
            else:
                held_out[name] = parallel.everywhere(source)
            splits[split] |= {label + sequence: count for sequence, count in samples.items()}
            hours = sum(samples.values()) / config.data.rate / 3600
            contents = f"{hours:.2f} h, {task.count(source):,} {task.unit}"
            reporter.line(f"  {label}{split}: {len(samples)} sequences, {contents}")
    shared = sorted(set(splits[train]) & set(splits[val]))
    if shared:
        examples = f"{', '.join(shared[:3])}{' ...' if shared[3:] else ''}"
        reporter.line(
            f"warning: {examples} in {train} and in {val}: the best checkpoint is chosen by "
            "recordings that it was trained on; separate the two splits"
        )
    if pose_network is not None:
        splits["data.poses_by"] = [pose_network.digest]
    parts = tuple(map(task.count, sources))
    epoch = sum(map(visit_count, parts, config.data.weights or [1.0] * len(parts)))
    if epoch < size:
        problem = f"is {size}, but there are only {epoch} {task.unit}"
        raise InputError("optim.batch_size", problem, "lower it")
    training_data = TrainingData(parallel.everywhere(task.join(sources)), held_out, splits)
    portable = dataclasses.replace(configuration.without_paths(config), seed=0)
    return task(model, portable, epoch // size, parts), training_data


def _load_pose_network(config: TrainConfig, reporter: Reporter, load: Load) -> PoseNetwork | None:
    """The network that `data.poses_by` names. Raises `InputError` if its rate is lower than that of
    the trained network, because its poses come with the IMU at its own rate."""
    name = config.data.poses_by
    if name is None:
        return None
    run = load(name)
    if run.config.data.rate < config.data.rate:
        problem = f"names a network of {run.config.data.rate:g} Hz, slower than data.rate"
        remedy = f"name one of {config.data.rate:g} Hz or more"
        raise InputError("data.poses_by", problem, remedy)
    if run.config.filter.noise == NoiseModel():
        reporter.line(
            f"warning: {name}: its filter is not calibrated, and smooths worse than interpolation; "
            "calibrate it with gnio calibrate"
        )
    return PoseNetwork(name, load, digest_network(run))


def read_split(
    config: TrainConfig,
    dataset: str,
    split: str,
    reporter: Reporter,
    workers: int,
    samples: dict[str, int],
    pose_network: PoseNetwork | None = None,
) -> Iterator[Sequence]:
    """The recordings of a split of a dataset at the network's rate, one after another. Recordings
    with waypoints get the poses that `pose_network` makes, or else interpolated ones. The number of
    samples of each recording is written into `samples` by its name. A walk that can have no poses
    is left out with a warning."""
    progress = functools.partial(reporter.progress, f"reading {split}")
    sequences: Iterable[Sequence] = data.load_each(
        dataset, config.data_root, split, workers, progress
    )
    if pose_network is not None:
        sequences = _add_smoothed_poses(sequences, pose_network, split, reporter, workers)
    for sequence in sequences:
        resampled = data.resample(sequence, config.data.rate)
        if resampled.waypoints is not None:
            try:
                resampled = data.with_poses(resampled)
            except InputError as error:
                reporter.line(f"warning: {error}")
                continue
        samples[resampled.name] = len(resampled.time)
        yield resampled


def _add_smoothed_poses(
    sequences: Iterable[Sequence],
    pose_network: PoseNetwork,
    split: str,
    reporter: Reporter,
    workers: int,
) -> Iterator[Sequence]:
    """The recordings, with smoothed poses for those with waypoints. These take seconds per walk, so
    `workers` processes make them, and the cache of recordings keeps them."""
    queue: list[Sequence] = []  # recordings from the first walk with waypoints on
    for sequence in sequences:
        if sequence.waypoints is None and not queue:
            yield sequence
        else:
            queue.append(sequence)
    walks = {walk.name: walk for walk in queue if walk.waypoints is not None}
    entries = {name: _cache_entry(walk, pose_network) for name, walk in walks.items()}
    readings = {name: read_reading(entry) for name, entry in entries.items()}
    missing = [(walk, pose_network) for name, walk in walks.items() if readings[name] is None]
    several = workers > 1 and len(missing) > FEW
    make, workers = (_smooth_on_cpu, workers) if several else (smooth_poses, 1)
    progress = functools.partial(reporter.progress, f"poses of {split}")
    smoothed = in_processes(make, missing, workers, progress)
    for (walk, _), reading in zip(missing, smoothed, strict=True):
        write_reading(entries[walk.name], reading)
        readings[walk.name] = reading
    for sequence in queue:
        reading = readings.get(sequence.name) or Reading([sequence])
        for refusal in reading.refusals:
            reporter.line(f"warning: {refusal}")
        yield from reading.sequences


def _smooth_on_cpu(walk: Sequence, pose_network: PoseNetwork) -> Reading:
    """`smooth_poses` in a process of its own, on the CPU, because the first process uses the
    GPU."""
    jax.config.update("jax_platforms", "cpu")
    return smooth_poses(walk, pose_network)


def smooth_poses(walk: Sequence, pose_network: PoseNetwork) -> Reading:
    """The walk with smoothed poses at the rate of the network that makes them, or the reason why it
    has none.

    The valid legs are those on which interpolated poses are valid: on other legs the phone does not
    point ahead, and the taps may belong to another walk.
    """
    with jax.enable_x64(True):
        rate, predict, ekf = _load_smoother(pose_network)
        try:
            resampled = data.resample(walk, rate)
            legs = data.with_poses(resampled)
            poses = filtering.waypoint_poses(resampled, predict, ekf).sequence
        except InputError as error:
            return Reading([], refusals=(str(error),))
    return Reading([poses.with_reference_where(legs.valid & poses.valid)])


@functools.cache
def _load_smoother(pose_network: PoseNetwork) -> tuple[float, Predict, filtering.Filter]:
    """A network's rate (Hz), the network and its filter. They are made once, because programs are
    compiled for each network object. Raises `InputError` if the run has changed."""
    run = pose_network.load(pose_network.run)
    if digest_network(run) != pose_network.digest:
        raise InputError(
            pose_network.run, "has changed while it made poses", "begin the training anew"
        )
    network, windows = Network.of(run.model, run.variables), run.config.data
    predict = functools.partial(network.apply, network.variables)
    return windows.rate, predict, filtering.make_filter(windows, run.config.filter)


def digest_network(run: Run) -> str:
    """Digest of the settings, without the places of folders, and of the weights of a run."""
    settings = configuration.flatten(configuration.without_paths(run.config))
    return _digest(sorted(settings.items()), run.variables)


def _cache_entry(walk: Sequence, pose_network: PoseNetwork) -> Path:
    """The file that keeps the smoothed poses of a walk. Its name is a digest of the walk, the run,
    and the sources that make the poses."""
    arrays = [walk.time, walk.gyro, walk.accel, walk.imu_valid, walk.waypoints]
    name = _digest([walk.name, sorted(walk.attributes.items()), pose_network.digest], arrays)
    return cache_entry(name, _sources())


@functools.cache
def _sources() -> list[Path]:
    """The source files on which the poses of a walk depend, besides those of `data`."""
    package = Path(__file__).parents[1]
    rooms = [path for room in ("filtering", "models") for path in (package / room).rglob("*.py")]
    return sorted([*package.glob("*.py"), *rooms, Path(__file__)])


def _digest(values: list[Any], arrays: Any) -> str:
    digest = hashlib.sha256(repr(values).encode())
    for leaf in jax.tree.leaves(arrays):
        digest.update(f"{leaf.dtype}{leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()
