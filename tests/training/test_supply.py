"""Windows from the disk: the same windows, order and numbers as from the device; little memory."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import config as configuration
from gnio_jax.config import (
    AugmentConfig,
    DataConfig,
    ModelConfig,
    OptimConfig,
    ThroughFilter,
    TrainConfig,
)
from gnio_jax.data import windows
from gnio_jax.data.on_disk import source_on_disk
from gnio_jax.errors import InputError
from gnio_jax.models import registry
from gnio_jax.reporting import Silence
from gnio_jax.training import checkpoint, loop, on_windows, supply
from tests.support.tiny_network import Tiny
from tests.support.tlio_files import write_splits

ROOT = Path(__file__).parents[2]
SHIFT = 3

gather = jax.jit(windows.gather, static_argnums=2)
shift_windows = jax.jit(windows.shift_windows, static_argnums=3)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """Runs of epochs of six steps, whose parts hold three."""
    folder = tmp_path_factory.mktemp("supply")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._MODELS, "tiny", Tiny)
        patch.setattr(supply, "PART_BYTES", 3 * 32 * (36 * (50 + 2 * SHIFT) + 64 * (1 + 2 * SHIFT)))
        patch.setenv("GNIO_CACHE", str(folder / "cache"))
        yield TrainConfig(
            "tlio",
            str(write_splits(folder / "tlio")),
            str(folder / "device"),
            data=DataConfig(rate=50.0),
            model=ModelConfig("tiny", uncertainty="calibrated"),
            augment=AugmentConfig(shift_samples=SHIFT),
            optim=OptimConfig(epochs=2, batch_size=32, learning_rate=1e-3, statistics_windows=64),
        )


def on(config, residency, workdir=None):
    data = dataclasses.replace(config.data, residency=residency)
    return dataclasses.replace(config, data=data, workdir=str(workdir or config.workdir))


@pytest.fixture(scope="module")
def from_device(config):
    loop.train(config)
    return Path(config.workdir)


def rows(workdir):
    found = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    return [
        {name: row[name] for name in row if name not in ("seconds", "windows_per_second")}
        for row in found
    ]


def assert_same_run(workdir, other):
    for ours, theirs in zip(rows(workdir), rows(other), strict=True):
        assert ours == pytest.approx(theirs, rel=2e-6)
    both = (checkpoint.load_run(each, "latest").variables for each in (workdir, other))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), *both)


def test_from_the_disk_a_run_has_the_same_numbers(config, from_device, tmp_path):
    loop.train(on(config, "host", tmp_path / "run"))
    assert_same_run(tmp_path / "run", from_device)
    assert not list((tmp_path.parent / "cache").glob("*")), "files without names leave nothing"


def test_a_run_that_stopped_within_a_part_goes_on_from_the_disk(
    config, from_device, tmp_path, monkeypatch
):
    """It was begun from the device."""
    run_steps = loop._run_steps

    def stopped(*given):
        group = run_steps(*given)
        if group.step == 8:
            signal.raise_signal(signal.SIGTERM)
        return group

    monkeypatch.setattr(loop, "DISPATCH_SECONDS", 0)
    with monkeypatch.context() as patch:
        patch.setattr(loop, "_run_steps", stopped)
        assert loop.train(on(config, "device", tmp_path / "run")).stopped_by
    loop.train(on(config, "host", tmp_path / "run"), resume=True)
    assert_same_run(tmp_path / "run", from_device)


@pytest.fixture(scope="module")
def both(config):
    """Training windows in memory and on the disk."""
    training = on_windows.set_up(on(config, "host"), Silence())
    return on_windows.set_up(config, Silence()).source, training.source


def test_the_disk_has_what_memory_has(both):
    for ours, theirs in zip(both[1], both[0], strict=True):
        assert isinstance(ours, np.memmap)
        np.testing.assert_array_equal(ours, theirs)


def test_an_excerpt_has_the_windows_and_their_neighbours(both):
    """Also those at the ends of recordings, where a shift has no window to go to."""
    device, disk = both
    count = len(device.start)
    which = np.int32([0, 1, SHIFT, count - 1, count // 2 - 1, count // 2, 77])
    part = jax.tree.map(jnp.asarray, windows.excerpt(disk, which, 50, SHIFT))
    for seed in range(8):
        key = jax.random.key(seed)
        ours = shift_windows(key, part, part.visited, SHIFT)
        theirs = shift_windows(key, device, jnp.asarray(which), SHIFT)
        found = gather(part, ours, 50), gather(device, theirs, 50)
        jax.tree.map(np.testing.assert_array_equal, *found)


def test_an_epoch_gives_the_same_steps_wherever_one_begins(config, both):
    """In parts of three steps, the last of which is filled up."""
    device, disk = both
    order = np.random.default_rng(0).permutation(disk.visited)[: 5 * 32]
    epoch = supply.FromHost(32, 50, SHIFT).epoch(disk, order)
    for first, count, expected in ((0, 5, [3, 2]), (3, 2, [2]), (4, 1, [1]), (1, 3, [2, 1])):
        parts = list(epoch.parts(first, count))
        assert [part.count for part in parts] == expected
        found = [
            gather(part.source, np.asarray(part.order)[i * 32 : (i + 1) * 32], 50).imu
            for part in parts
            for i in range(part.first, part.first + part.count)
        ]
        batches = order[first * 32 : (first + count) * 32].reshape(count, 32)
        wanted = [gather(device, batch, 50).imu for batch in batches]
        np.testing.assert_array_equal(np.concatenate(found), np.concatenate(wanted))


@pytest.mark.parametrize("residency, memory, on_disk", [("auto", 10**9, False), ("auto", 1, True)])
def test_auto_is_the_disk_for_what_does_not_fit_the_device(
    config, monkeypatch, residency, memory, on_disk
):
    monkeypatch.setattr(supply, "_memory", lambda: memory)
    training = on_windows.set_up(on(config, residency), Silence())
    assert isinstance(training.source.imu, np.memmap) is on_disk
    assert isinstance(training.supply, supply.FromHost) is on_disk


def test_a_full_disk_is_named(config, tmp_path):
    def parts():
        raise OSError(28, "No space left on device")
        yield

    with pytest.raises(OSError) as told:
        source_on_disk(parts(), tmp_path)
    assert told.value.filename == str(tmp_path)


def test_through_the_filter_recordings_lie_on_the_device(config):
    changed = dataclasses.replace(on(config, "host"), through_filter=ThroughFilter(("head",)))
    with pytest.raises(InputError, match=r"'data\.residency' is for training on windows alone"):
        configuration.validate(changed)


def test_a_set_five_times_as_large_as_the_memory_trains(tmp_path):
    """And it would not fit: the same process cannot take it into memory."""
    megabytes = 70
    environment = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
        "GNIO_CACHE": str(tmp_path),
        # What is freed goes back to the system at once.
        "MALLOC_MMAP_THRESHOLD_": "65536",
        "MALLOC_ARENA_MAX": "2",
    }
    command = [sys.executable, "-m", "tests.support.large_set_process", str(megabytes)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    trained, refused = done.stdout.splitlines()
    steps, size = (int(word) for word in trained.split())
    assert steps == 24 and size >= 5e6 * megabytes
    assert refused in ("MemoryError", "_ArrayMemoryError")
