"""Poses of walks with waypoints: the smoother makes them from the displacements of an earlier run
(`filtering.waypoint_poses`), and the cache of recordings keeps them."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gnio_jax import config as configuration
from gnio_jax import data, filtering, networks
from gnio_jax.config import NoiseModel, TrainConfig
from gnio_jax.data.hdf5 import Reading, cache_entry, read_reading, write_reading
from gnio_jax.data.workers import FEW, in_processes
from gnio_jax.errors import InputError
from gnio_jax.filtering.network import Predict
from gnio_jax.models import Network
from gnio_jax.networks import TrainedNetwork
from gnio_jax.reporting import Reporter
from gnio_jax.types import Sequence


class PoseNetwork(NamedTuple):
    """The network that makes poses of walks with waypoints."""

    name: str
    """Name, folder or zip of the network."""
    digest: str
    """Digest of its weights and settings."""


def load_pose_network(config: TrainConfig, reporter: Reporter) -> PoseNetwork | None:
    """The network that `data.poses_by` names. Raises `InputError` if its rate is lower than that of
    the trained network, because its poses come with the IMU at its own rate."""
    name = config.data.poses_by
    if name is None:
        return None
    network = networks.load(name)
    if network.config.filter.corrector is not None:
        problem = "names a network with a corrector before its filter, which makes no poses"
        raise InputError("data.poses_by", problem, "name one without filter.corrector")
    rate = network.config.data.rate
    if rate < config.data.rate:
        problem = f"names a network of {rate:g} Hz, slower than data.rate"
        remedy = f"name one of {config.data.rate:g} Hz or more"
        raise InputError("data.poses_by", problem, remedy)
    if network.config.filter.noise == NoiseModel():
        reporter.line(
            f"warning: {name}: its filter is not calibrated, and smooths worse than interpolation; "
            "calibrate it with gnio calibrate"
        )
    return PoseNetwork(name, digest_network(network))


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
    trained = networks.load(pose_network.name)
    if digest_network(trained) != pose_network.digest:
        raise InputError(
            pose_network.name, "has changed while it made poses", "begin the training anew"
        )
    network, windows = Network.of(trained.model, trained.variables), trained.config.data
    return windows.rate, network.predict(), filtering.make_filter(windows, trained.config.filter)


def digest_network(network: TrainedNetwork) -> str:
    """Digest of the settings, without the paths of folders, and of the weights of a network."""
    settings = configuration.flatten(configuration.without_paths(network.config))
    return _digest(sorted(settings.items()), network.variables)


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
