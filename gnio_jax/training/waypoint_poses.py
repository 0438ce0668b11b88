"""Poses of walks with waypoints: the smoother makes them from the displacements of an earlier run
(`filtering.waypoint_poses`), and the cache of recordings keeps them."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gnio_jax import config as configuration
from gnio_jax import data, filtering
from gnio_jax.config import NoiseModel, TrainConfig
from gnio_jax.data.hdf5 import Reading, cache_entry, read_reading, write_reading
from gnio_jax.data.workers import FEW, in_processes
from gnio_jax.errors import InputError
from gnio_jax.filtering.network import Predict
from gnio_jax.models import Network
from gnio_jax.reporting import Reporter
from gnio_jax.training.checkpoint import Run
from gnio_jax.types import Sequence

Load = Callable[[str], Run]
"""A function that reads the run, or the package of weights, of this name. It must be a function of
a module, because other processes call it too."""


class PoseNetwork(NamedTuple):
    """The network that makes poses of walks with waypoints."""

    run: str
    load: Load
    digest: str
    """Digest of its weights and settings."""


def load_pose_network(config: TrainConfig, reporter: Reporter, load: Load) -> PoseNetwork | None:
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


def add_smoothed_poses(
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
