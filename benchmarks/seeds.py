"""Windows per second of several seeds of one experiment: in turn, and as one program.

    python -m benchmarks.seeds [--width 16] [--batch 128] [--seeds 4] [--devices 2] [--repeats 3]

Ways to take the same steps with every seed:

  alone    each seed compiles a program of its own, as runs that are started one by one
  in turn  one program, called for each seed: `gnio train --seeds` on a CPU
  map      one program with a loop over the seeds
  batched  one program whose operations have the seed as an axis: `gnio train --seeds` on a GPU
  devices  one program for several devices, each of which trains its own seeds

Each way runs in turn with the others, round after round. The first round compiles and is printed
apart; of the others the best counts.
"""

import argparse
import contextlib
import math
import time

import jax
import numpy as np

from benchmarks.train_step import recordings
from gnio_jax.config import ModelConfig, OptimConfig, TrainConfig
from gnio_jax.scaling import devices
from gnio_jax.training import optimizer as optimizers
from gnio_jax.training.checkpoint import create_model
from gnio_jax.training.kinds import keys_of
from gnio_jax.training.on_windows import WindowTraining
from gnio_jax.training.supply import OnDevice
from gnio_jax.training.together import InTurn, SideBySide

STEPS, STEPS_PER_EPOCH = 4, 1000
"""Steps per dispatch, as in the training loop, and those of the schedule."""


def training_of(width: int, batch: int) -> WindowTraining:
    """The paper's network on random recordings."""
    config = TrainConfig(model=ModelConfig(width=width), optim=OptimConfig(batch_size=batch))
    model, source = create_model(config), recordings(config.data.seen, batch)
    return WindowTraining(
        config,
        model,
        model,
        optimizers.create(config.optim, config.loss, STEPS_PER_EPOCH),
        optimizers.schedule(config.optim, STEPS_PER_EPOCH),
        devices.everywhere(jax.device_get(source)),
        source,
        {},
        STEPS_PER_EPOCH,
        keys_of(0),
        OnDevice(),
    )


def own_program(training: WindowTraining) -> WindowTraining:
    """The same training, compiled once more: an optimizer is equal to none but itself."""
    config = training.config
    optimizer = optimizers.create(config.optim, config.loss, STEPS_PER_EPOCH)
    return training._replace(optimizer=optimizer)


def running(together, sharers):
    """A function that takes STEPS steps with every seed of `together` and waits for them."""
    context = devices.sharing(sharers, devices.SEEDS) if sharers else contextlib.nullcontext()
    with context:
        start = [training.new_state(None) for training in together.trainings]
    holder = [None]

    def run():
        context = devices.sharing(sharers, devices.SEEDS) if sharers else contextlib.nullcontext()
        with context:
            holder[0] = together.joined(start) if holder[0] is None else holder[0]
            order, factors = together.order(0), [1.0] * len(start)
            holder[0], progress = together.take_steps(holder[0], order, 0, STEPS, factors)
            jax.block_until_ready(progress)

    return run


def ways(arguments: argparse.Namespace):
    """Functions that take STEPS steps with every seed, by their names."""
    training = training_of(arguments.width, arguments.batch)
    seeds = tuple(training.with_seed(k) for k in range(arguments.seeds))
    alone = [running(InTurn((own_program(each),)), None) for each in seeds]
    found = {
        "alone": lambda: [run() for run in alone],
        "in turn": running(InTurn(seeds), None),
        "map": running(SideBySide(seeds, batched=False), None),
        "batched": running(SideBySide(seeds, batched=True), None),
    }
    if arguments.devices > 1:
        sharers = devices.chosen(arguments.devices)
        with devices.sharing(sharers, devices.SEEDS):
            training = training_of(arguments.width, arguments.batch)
        seeds = tuple(training.with_seed(k) for k in range(arguments.seeds))
        found["devices"] = running(SideBySide(seeds, jax.default_backend() != "cpu"), sharers)
    return {name: found[name] for name in arguments.ways if name in found}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    for name, default in (("width", 16), ("batch", 128), ("seeds", 4), ("devices", 2)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--repeats", type=int, default=3)
    names = ("alone", "in turn", "map", "batched", "devices")
    parser.add_argument("--ways", nargs="+", default=names, choices=names)
    arguments = parser.parse_args()
    devices.cpu_devices(arguments.devices)
    seconds = {name: [] for name in arguments.ways}
    runs = ways(arguments)
    for _ in range(arguments.repeats + 1):
        for name, run in runs.items():
            began = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - began)
    print(f"width {arguments.width}, batch {arguments.batch}, {arguments.seeds} seeds:")
    windows = arguments.seeds * STEPS * arguments.batch
    for name in runs:
        first, others = seconds[name][0], seconds[name][1:]
        best, median = min(others, default=math.nan), float(np.median(others))
        print(
            f"  {name:>8s}  {windows / best:8,.0f} windows/s (median {windows / median:8,.0f})  "
            f"{best / STEPS / arguments.seeds * 1e3:7.1f} ms a seed and step  "
            f"first dispatch {first:6.1f} s"
        )


if __name__ == "__main__":
    main()
