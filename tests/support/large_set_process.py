"""Trains on a set five times as large as the memory that this process may still take.

python -m tests.support.large_set_process MEGABYTES

Prints the steps taken and the bytes of the set, and what taking it into memory raises.
"""

import functools
import itertools
import resource
import sys
from pathlib import Path

import numpy as np

from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.data import windows
from gnio_jax.data.on_disk import bytes_of
from gnio_jax.models import registry
from gnio_jax.reporting import Silence
from gnio_jax.training import on_windows, optimizer, supply
from tests.support.tiny_network import Tiny

CONFIG = TrainConfig(
    "synthetic",
    data=DataConfig(rate=50.0, residency="host"),
    model=ModelConfig("tiny"),
    optim=OptimConfig(epochs=1, batch_size=256, statistics_windows=512),
)


def part():
    """The windows of a recording of 2000 s."""
    rng = np.random.default_rng(0)
    rows, start = 100_000, np.arange(0, 99_000, 20, dtype=np.int32)
    count = len(start)
    return windows.WindowSource(
        imu=rng.normal(size=(rows, 6)).astype(np.float32),
        start=start,
        rotation=np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
        displacement=rng.normal(size=(count, 3)).astype(np.float32),
        step=np.zeros((rows, 3), np.float32),
        unyaw=np.tile(np.float32([1, 0]), (count, 1)),
        visited=np.arange(count, dtype=np.int32),
    )


def train(one, times, validated=None):
    """Some steps here and there in an epoch, and validation, over so many recordings; there of the
    last `validated` windows, by default all."""
    on_windows.windows.window_parts = lambda *_: itertools.repeat(one, times)
    training = on_windows.set_up(CONFIG, Silence())
    held_out = training.held_out
    if validated:
        held_out = held_out._replace(visited=held_out.visited[-validated:])
        training = training._replace(held_out=held_out)
    state, order = training.new_state(None), training.order(0)
    for first in (0, training.steps_per_epoch // 2, training.steps_per_epoch - 8):
        state, _ = training.take_steps(state, order, first, 8, 1.0)
    _, row = training.validate(training.settled(state), 24)
    assert np.isfinite(row["val_loss"])
    return int(state.step), bytes_of(training.source) + bytes_of(training.held_out)


def main(megabytes):
    registry._MODELS["tiny"] = Tiny
    supply.PART_BYTES = 2**22
    # The same optimizer for both, so that the steps are compiled once.
    on_windows.optimizers.create = functools.cache(optimizer.create)
    one, limit = part(), int(megabytes) * 10**6
    times = -(-5 * limit // (2 * bytes_of(one)))  # there are as many validation windows
    # A small set with as many visits: programs and threads are there before the limit.
    few = one._replace(visited=np.tile(one.visited, times))
    whole = 256 * supply.FromHost(256, CONFIG.data.seen, 0).batches()
    train(few, 1, validated=whole + len(few.visited) % whole)
    (line,) = (s for s in Path("/proc/self/status").read_text().split("\n") if "VmData" in s)
    taken = int(line.split()[1]) * 1024
    resource.setrlimit(resource.RLIMIT_DATA, (taken + limit,) * 2)
    print(*train(one, times), flush=True)
    try:
        windows.joined(itertools.repeat(one, 2 * times))
    except MemoryError as error:
        print(type(error).__name__, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
