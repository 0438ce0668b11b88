"""Windows per second over devices and processes of this machine, and where GPUs would stop scaling.

    python -m benchmarks.scaling [--width 16] [--batch 128] [--layouts 1x1 1x2 2x1 2x2]
    python -m benchmarks.scaling --model

A layout is PROCESSESxDEVICES on localhost. Strong scaling keeps the batch; weak scaling gives every
device a batch of its own. All devices share this machine's cores, so that the work of a layout is
that of one device and what it loses is the cost of sharing: partitions, sums, processes. Each
layout runs in processes of its own, in turn. Compile time is not counted; the best of the repeats
counts.

`--model` counts the sums over devices in the compiled step of the paper's network and prints what
they would cost on 8, 64 and 512 GPUs. It is a model on paper, with its assumptions; nothing of it
is measured.
"""

import argparse
import math
import re
import resource
import socket
import subprocess
import sys
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from benchmarks.train_step import recordings
from gnio_jax import models, parallel
from gnio_jax.config import ModelConfig, OptimConfig, TrainConfig
from gnio_jax.training.task import train_steps
from gnio_jax.training.window_task import WindowTask

STEPS = 8
"""Steps per dispatch."""


class Cluster(NamedTuple):
    """Assumptions about the GPUs and the network between them."""

    flops: float = 0.35 * 989e12
    """Operations per second of one GPU, bfloat16: the wished share of an H100's peak."""
    inside: float = 300e9
    """Bytes per second between GPUs of a machine of eight (NVLink)."""
    between: float = 40e9
    """Bytes per second of each GPU between machines (400 Gb/s)."""
    latency_inside: float = 10e-6
    """Seconds for a small sum within a machine."""
    latency_between: float = 10e-6
    """Seconds more for each doubling of the machines."""


def configuration(width: int, batch: int) -> TrainConfig:
    """The paper's network and optimizer."""
    return TrainConfig(model=ModelConfig(width=width), optim=OptimConfig(batch_size=batch))


def prepare(config: TrainConfig, model: nn.Module):
    """A function that takes a state through STEPS steps, the state, and its program."""
    samples = config.data.input_samples
    source = parallel.copy_to_devices(jax.device_get(recordings(samples, config.optim.batch_size)))
    task = WindowTask(model, config, 1000)
    state = task.initial_state(jax.random.key(0), None)
    order = parallel.copy_to_devices(np.arange(source.start.shape[0], dtype=np.int32))
    arguments = (source, order, jnp.int32(0), jnp.int32(STEPS), jnp.float32(1), jax.random.key(1))
    return (
        lambda state: train_steps(state, *arguments, task=task),
        state,
        (arguments, {"task": task}),
    )


def work(arguments: argparse.Namespace) -> None:
    """Measure in one of the processes of a layout; the first prints windows/s and memory."""
    parallel.initialise(arguments.worker, arguments.devices)
    with parallel.sharing(arguments.devices):
        config = configuration(arguments.width, arguments.batch)
        run, state, _ = prepare(config, models.from_config(config.model))
        best = math.inf
        for _ in range(arguments.repeats + 1):  # the first compiles
            began = time.perf_counter()
            state, progress = run(state)
            jax.block_until_ready(progress)
            best = min(best, time.perf_counter() - began)
    if parallel.is_first():
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{STEPS * arguments.batch / best:.0f} {memory:.0f}")


def measure_layout(layout: str, width: int, batch: int, repeats: int) -> tuple[float, float]:
    """Windows/s of a layout, and MiB of its first process."""
    processes, devices = (int(word) for word in layout.split("x"))
    with socket.socket() as free:
        free.bind(("localhost", 0))
        coordinator = f"localhost:{free.getsockname()[1]}"
    command = [sys.executable, "-m", "benchmarks.scaling", "--devices", str(devices)]
    command += ["--width", str(width), "--batch", str(batch), "--repeats", str(repeats)]
    workers = [
        subprocess.Popen(
            [*command, "--worker", f"{coordinator},{processes},{k}"],
            stdout=subprocess.PIPE,
            text=True,
        )
        for k in range(processes)
    ]
    outputs = [process.communicate()[0] for process in workers]
    if any(process.returncode for process in workers):
        raise SystemExit(f"layout {layout} failed")
    rate, memory = outputs[0].split()[-2:]
    return float(rate), float(memory)


def measure(arguments: argparse.Namespace) -> None:
    """The table of strong and weak scaling."""
    for name in ("strong", "weak"):
        print(f"{name} scaling, width {arguments.width}, batch {arguments.batch}:")
        first = None
        for layout in arguments.layouts:
            number = math.prod(int(word) for word in layout.split("x"))
            batch = arguments.batch * (number if name == "weak" else 1)
            rate, memory = measure_layout(layout, arguments.width, batch, arguments.repeats)
            first = first or rate
            print(
                f"  {layout:>5s}  batch {batch:5d}  {rate:8,.0f} windows/s  {rate / first:5.2f} of "
                f"{arguments.layouts[0]}  {memory:6,.0f} MiB",
                flush=True,
            )


def model(batch: int) -> None:
    """Time of a step of the paper's network on many GPUs, from its operations and its sums."""
    parallel.initialise(devices=2)
    # A small batch compiles in seconds; operations of a window and sums of a step are the same.
    config = configuration(64, 16)
    network = models.from_config(config.model).clone(winograd=False)  # as on a GPU
    flops = flops_per_window(config, network)
    with parallel.sharing(2):
        _, state, (arguments, static) = prepare(config, network)
        text = train_steps.lower(state, *arguments, **static).compile().as_text()
    sums = [
        numbers(line) for line in text.splitlines() if re.search(r" all-reduce(-start)?\(", line)
    ]
    print(
        f"{flops / 1e9:.2f} GFLOP a window (forward and backward); a step sums "
        f"{4 * sum(sums) / 1e6:.1f} MB over the devices, in {len(sums)} sums"
    )
    gpu = Cluster()
    print(f"assumed: {assumptions(gpu)}")
    print("GPUs  batch each  computing ms  sums ms  share of the time that computes")
    for gpus in (8, 64, 512):
        for windows in (batch // gpus, batch, 8 * batch):
            row(gpus, windows, flops, sums, gpu)


def row(gpus: int, windows: int, flops: float, sums: list[int], cluster: Cluster) -> None:
    """One line of the model: `windows` windows on every GPU."""
    machines = max(1, gpus // 8)
    speed = cluster.inside if machines == 1 else cluster.between
    ring = 2 * (gpus - 1) / gpus * 4 * sum(sums) / speed
    waits = cluster.latency_inside + cluster.latency_between * math.log2(machines)
    computing, summing = windows * flops / cluster.flops, ring + len(sums) * waits
    share = computing / (computing + summing) if windows else 0.0
    print(f"{gpus:4d}  {windows:10d}  {1e3 * computing:12.2f}  {1e3 * summing:7.2f}  {share:6.0%}")


def flops_per_window(config: TrainConfig, network: nn.Module) -> float:
    """Operations of the gradient, as XLA counts those of the program for one device."""
    imu = jnp.zeros((config.optim.batch_size, config.data.input_samples, 6), jnp.float32)
    variables = jax.eval_shape(network.init, jax.random.key(0), imu[:1])

    def loss(params, state):
        state = {name: tree for name, tree in state.items() if name != "params"}
        prediction, _ = network.apply(
            {"params": params, **state}, imu, train=True, mutable=["batch_stats"]
        )
        return jnp.sum(prediction.displacement**2) + jnp.sum(prediction.log_std)

    counted = jax.jit(jax.grad(loss)).lower(variables["params"], variables).cost_analysis()
    return counted["flops"] / config.optim.batch_size


def numbers(line: str) -> int:
    """Numbers in the result of an operation, from its shapes in the text of a program."""
    result = line.split(" all-reduce")[0]
    shapes = re.findall(r"\w\d+\[([\d,]*)\]", result)
    return sum(math.prod(int(size) for size in shape.split(",") if size) for shape in shapes)


def assumptions(cluster: Cluster) -> str:
    """The assumptions in one line."""
    inside, between = cluster.inside / 1e9, cluster.between / 1e9
    wait, more = 1e6 * cluster.latency_inside, 1e6 * cluster.latency_between
    return (
        f"{cluster.flops / 1e12:.0f} TFLOP/s a GPU, {inside:.0f} GB/s within a machine of 8, "
        f"{between:.0f} GB/s between machines, {wait:.0f} us for a small sum, {more:.0f} us more "
        "for each doubling of the machines, no sum while computing"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--width", type=int, default=16)
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--layouts", nargs="+", default=["1x1", "1x2", "2x1", "2x2"])
    parser.add_argument("--model", action="store_true")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--devices", type=int, default=1, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        work(arguments)
    elif arguments.model:
        model(1024)
    else:
        measure(arguments)


if __name__ == "__main__":
    main()
