"""Windows per second of the whole training step, beside two gradients of the same size.

    python -m benchmarks.train_step [--width 64] [--samples 200] [--batches 128 1024] [--repeats 5]

The whole step gathers, rotates and augments its windows, runs forward and backward, and updates the
parameters. The first comparison is the bare gradient of its loss on a fixed batch, the second
PyTorch's gradient of TLIO's network. A "batch of statistics" is one batch of the pass that
estimates the statistics of batch normalisation once an epoch.

Claims: the whole step costs at most 10 % more than the bare gradient; it is no slower than PyTorch;
a batch of statistics costs less than half a step. All are timed in turn, round after round, so that
a busy machine slows them alike. Compile time is measured apart. The best round counts, since noise
only ever adds; the median is printed beside it.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import baseline
from gnio_jax import models
from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.training.losses import loss_stage, losses
from gnio_jax.training.task import train_steps
from gnio_jax.training.window_task import WindowTask, estimate_statistics, statistics_order
from gnio_jax.training.windows import WindowSource, gather

STEPS, STEPS_PER_EPOCH = 4, 1000
"""Steps per dispatch, as in the training loop, and those of the schedule."""


def recordings(samples: int, batch: int) -> WindowSource:
    """Random numbers in the shape of ten minutes of recording. Speed does not depend on them."""
    rng = np.random.default_rng(0)
    count, stride = max(6000, STEPS * batch), samples // 10
    rows = count * stride + samples
    source = WindowSource(
        imu=rng.standard_normal((rows, 6), np.float32),
        start=(np.arange(count) * stride).astype(np.int32),
        rotation=np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
        displacement=rng.standard_normal((count, 3), np.float32),
        step=np.zeros((rows, 3), np.float32),
        unyaw=np.tile(np.float32([1, 0]), (count, 1)),
        stretch=np.tile(np.int32([0, rows - 1]), (count, 1)),
        visited=np.arange(count, dtype=np.int32),
    )
    return jax.device_put(source)


def ours(config: TrainConfig):
    """Functions that run the work, wait for it and return how many steps or batches it was.

    The whole step runs STEPS steps in one dispatch, as the training loop does.
    """
    size, samples = config.optim.batch_size, config.data.input_samples
    source, model = recordings(samples, size), models.from_config(config.model)
    task = WindowTask(model, config, STEPS_PER_EPOCH)
    holder = [task.initial_state(jax.random.key(0), None)]
    order, key = jnp.arange(source.start.shape[0], dtype=jnp.int32), jax.random.key(1)
    fixed = jax.jit(gather, static_argnums=2)(source, order[:size], samples)

    def whole():
        first, count, factor = jnp.int32(0), jnp.int32(STEPS), jnp.float32(1)
        arguments = source, order, first, count, factor, key
        holder[0], progress = train_steps(holder[0], *arguments, task=task)
        jax.block_until_ready(progress)
        return STEPS

    def objective(params, batch_stats, windows):
        prediction, changed = model.apply(
            {"params": params, "batch_stats": batch_stats},
            windows.imu,
            train=True,
            mutable=["batch_stats"],
        )
        stage = loss_stage(config.loss, 0, STEPS_PER_EPOCH)
        return losses(prediction, windows, config.loss, stage).total, changed

    gradient = jax.jit(jax.grad(objective, has_aux=True))
    params, batch_stats = jax.tree.map(
        jnp.copy, (holder[0].variables["params"], holder[0].variables["batch_stats"])
    )

    def bare():
        jax.block_until_ready(gradient(params, batch_stats, fixed))
        return 1

    def statistics():
        order = statistics_order(key, source, task)
        estimated = estimate_statistics(holder[0], source, order, key, task=task)
        jax.block_until_ready(estimated.variables)
        return len(order) // size

    return {"whole step": whole, "bare gradient": bare, "batch of statistics": statistics}


def theirs(samples: int, size: int):
    """The gradient of TLIO's network in PyTorch on a fixed batch; empty without torch."""
    try:
        import torch

        from benchmarks.tlio_torch import TlioNetwork
    except ImportError:
        return {}
    torch.manual_seed(0)
    network = TlioNetwork(samples)
    windows, target = torch.randn(size, 6, samples), torch.randn(size, 3)

    def gradient():
        network.zero_grad(set_to_none=True)
        mean, log_std = network(windows)
        (0.5 * (mean - target) ** 2 * torch.exp(-2 * log_std) + log_std).sum(1).mean().backward()
        return 1

    return {"PyTorch, TLIO": gradient}


def measure(programs: dict, size: int, repeats: int) -> dict[str, list[float]]:
    """Seconds per step of each program and round; prints what it measures."""
    for name, program in programs.items():
        began = time.perf_counter()
        program()
        first = time.perf_counter() - began
        print(f"  batch {size}: {name:19s} first call {first:6.1f} s (compiled)", flush=True)
    times: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(repeats):
        for name, program in programs.items():
            began = time.perf_counter()
            steps = program()
            times[name].append((time.perf_counter() - began) / steps)
    for name, seconds in times.items():
        best, median = min(seconds), float(np.median(seconds))
        print(
            f"  batch {size}: {name:19s} {1e3 * best:8.1f} ms (median {1e3 * median:8.1f})"
            f"   {size / best:8,.0f} windows/s"
        )
    return times


def ratios(times: dict[str, list[float]], size: int) -> dict[str, float]:
    """The figures of a batch size by their names in the baseline."""
    best = {name: min(seconds) for name, seconds in times.items()}
    whole = best["whole step"]
    figures = {
        f"batch of statistics / whole step, batch {size}": best["batch of statistics"] / whole,
        f"whole step / bare gradient, batch {size}": whole / best["bare gradient"],
    }
    if "PyTorch, TLIO" in best:
        figures[f"PyTorch / whole step, batch {size}"] = best["PyTorch, TLIO"] / whole
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--batches", type=int, nargs="+", default=[128, 1024])
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    width, samples = arguments.width, arguments.samples
    print(
        f"{jax.devices()[0].device_kind}, jax {jax.__version__}, "
        f"width {width}, windows of {samples} samples"
    )
    figures: dict[str, float] = {}
    for size in arguments.batches:
        config = TrainConfig(
            data=DataConfig(rate=float(samples)),
            model=ModelConfig(width=width),
            optim=OptimConfig(batch_size=size),
        )
        programs = ours(config) | (theirs(samples, size) if width == 64 else {})
        figures |= ratios(measure(programs, size, arguments.repeats), size)
    if (width, samples) == (64, 200):
        baseline.compare("train_step", figures)


if __name__ == "__main__":
    main()
