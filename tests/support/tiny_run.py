"""Runs of the smallest network, as `gnio train` leaves them."""

import contextlib
import dataclasses
import json
import signal
from pathlib import Path

import jax
import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.models import registry
from gnio_jax.networks import read_network
from gnio_jax.training import checkpoint, loop, windows
from tests.support import drawn_run
from tests.support.filter_settings import changed
from tests.support.numpy_layers import batch_norm, float64, linear
from tests.support.tiny_network import Tiny

CONFIGURED = TrainConfig(
    dataset="synthetic",
    data_root="/home/somebody/recordings",
    init_from="runs/earlier",
    seed=7,
    data=DataConfig(rate=50.0, poses_by="/home/somebody/runs/first"),
    model=ModelConfig(name="tiny"),
    filter=changed(noise={"std_factor": (1.7, 1.0, 1.0)}, considered={"scale": 0.02}),
)
"""Settings that a published network must not pass on, beside those that it must."""


@contextlib.contextmanager
def registry_entry(network=Tiny):
    """The registry of networks has `tiny`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._MODELS, "tiny", network)
        yield


def save(folder, config, size=0.2):
    """A run with parameters of about `size`."""

    def draw(random, kind, shape):
        statistics = kind == "batch_stats"
        return random.uniform(0.5, 1.5, shape) if statistics else random.normal(0, size, shape)

    return drawn_run.save(folder, config, draw)


STEPS = 13
"""Of an epoch of `config`: two walks of 12 s at 50 Hz have 110 windows of 1 s each."""


def config(root, workdir, **changes):
    """Three epochs on walks that `tlio_files.write_splits` wrote. `changes` are fields of the
    experiment, or of its section `optim`."""
    of_optim = {field.name for field in dataclasses.fields(OptimConfig)}
    optim = OptimConfig(epochs=3, batch_size=16, learning_rate=1e-3, warmup_epochs=1.0)
    experiment = TrainConfig(
        dataset="tlio",
        data_root=root and str(root),
        workdir=str(workdir),
        data=DataConfig(rate=50.0),
        model=ModelConfig("tiny", uncertainty="calibrated"),
        optim=dataclasses.replace(optim, **{k: v for k, v in changes.items() if k in of_optim}),
    )
    other_changes = {name: value for name, value in changes.items() if name not in of_optim}
    return dataclasses.replace(experiment, **other_changes)


GATHER = jax.jit(windows.gather, static_argnums=2)


def mean_square_error(run, walk):
    """Of the displacements that a run's network predicts for every window of a walk, m², in plain
    NumPy."""
    walk = data.resample(walk, 50.0)
    source = jax.device_put(windows.window_source([walk], run.config.data, 5))
    which = np.arange(source.start.shape[0], dtype=np.int32)
    assert len(which) % 16 != 0  # so that the filled-up last batch is part of the test
    every = jax.device_get(GATHER(source, which, 50))
    params, statistics = float64(run.variables)
    h = np.float64(every.imu).mean(axis=1) @ params["encoder"]["kernel"]
    h = np.tanh(batch_norm(h, params["norm"], statistics["norm"]))
    error = linear(h, params["head"]) - every.displacement
    return np.mean(np.sum(error**2, axis=1))


def rows(workdir):
    """The log of a run, without what the clock says."""
    lines = (Path(workdir) / "metrics.jsonl").read_text().splitlines()
    return [
        {name: value for name, value in json.loads(line).items() if "second" not in name}
        for line in lines
    ]


def arrays(workdir, which="latest"):
    """What a run has learnt: its network's variables and its filter's numbers."""
    load = checkpoint.load_latest if which == "latest" else read_network
    run = load(Path(workdir))
    numbers = run.config.filter.noise, run.config.filter.start
    return jax.tree.map(np.asarray, (run.variables, numbers))


def same(a, b):
    """Whether two trees hold the same bits."""
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, a, b)))


def assert_same_runs(workdir, other):
    """To the bit; sums over an epoch are made of fewer or more parts: equal but for rounding."""
    for which in ("latest", "best"):
        assert same(arrays(workdir, which), arrays(other, which)), which
    for ours, theirs in zip(rows(workdir), rows(other), strict=True):
        assert ours == pytest.approx(theirs, rel=1e-6)


@contextlib.contextmanager
def stopped_at(step, act=lambda: signal.raise_signal(signal.SIGTERM)):
    """One step a dispatch, and `act` once a run has reached this one."""
    real = loop.add_steps

    def add_steps(*arguments):
        at = real(*arguments)
        if at.step == step:
            act()
        return at

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "DISPATCH_SECONDS", 0)
        patch.setattr(loop, "add_steps", add_steps)
        yield
