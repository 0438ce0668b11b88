"""Windows/s of the whole training step beside the bare gradient of its loss, and beside PyTorch's
gradient of TLIO's network.

    python -m benchmarks.train_step [--width 64] [--samples 200] [--batches 128 1024] [--repeats 5]

The whole step gathers, rotates and augments its windows, runs forward and backward and updates the
parameters; the bare gradient has its batch given. A batch of statistics is what the estimate of the
batch normalisations takes for each of its batches, once an epoch. Claims: the whole step costs at
most 10 % more than the bare gradient, it is no slower than PyTorch, and a batch of statistics costs
less than half a step. They are timed in turn, round after round, so that a busy machine slows them
alike; compile time is apart. The best round counts (noise only ever adds), medians are printed
beside it.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import baseline
from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.data.windows import WindowSource, gather
from gnio_jax.training import optimizer as optimizers
from gnio_jax.training.checkpoint import create_model
from gnio_jax.training.losses import losses, stage
from gnio_jax.training.step import (
    create_state,
    estimate_statistics,
    statistics_batches,
    train_steps,
)

STEPS = 4
"""Steps per dispatch, as the training loop has them."""


def recordings(samples: int, batch: int) -> WindowSource:
    """Random numbers in the shape of ten minutes of recording; speed does not depend on what they
    say."""
    rng = np.random.default_rng(0)
    count = max(6000, STEPS * batch)
    rows = count * samples // 10 + samples
    return jax.device_put(WindowSource(
        imu=rng.standard_normal((rows, 6), np.float32), start=(np.arange(count) * (samples // 10)).astype(np.int32),
        rotation=np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)), displacement=rng.standard_normal((count, 3), np.float32),
        step=np.zeros((rows, 3), np.float32), unyaw=np.tile(np.float32([1, 0]), (count, 1)), visited=np.arange(count, dtype=np.int32),
    ))  # fmt: skip


def ours(config: TrainConfig):
    """Two functions that run one step's work and wait for it: the whole step (amortised over STEPS)
    and the bare gradient."""
    size, samples = config.optim.batch_size, config.data.window
    source, model = recordings(samples, size), create_model(config)
    optimizer = optimizers.create(config.optim, config.loss, 1000)
    holder = [create_state(model, optimizer, jax.random.key(0), samples)]
    order, key = jnp.arange(source.start.shape[0], dtype=jnp.int32), jax.random.key(1)
    fixed = jax.jit(gather, static_argnums=2)(source, order[:size], samples)

    def whole():
        holder[0], progress = train_steps(holder[0], source, order, jnp.int32(0), jnp.int32(STEPS), jnp.float32(1), key,
                                          model=model, optimizer=optimizer, config=config)  # fmt: skip
        jax.block_until_ready(progress)
        return STEPS

    def objective(params, batch_stats, windows):
        prediction, changed = model.apply(
            {"params": params, "batch_stats": batch_stats},
            windows.imu,
            train=True,
            mutable=["batch_stats"],
        )
        return losses(prediction, windows, config.loss, stage(config.loss, 0, 1000)).total, changed

    gradient = jax.jit(jax.grad(objective, has_aux=True))
    params, batch_stats = jax.tree.map(jnp.copy, (holder[0].params, holder[0].batch_stats))

    def bare():
        jax.block_until_ready(gradient(params, batch_stats, fixed))
        return 1

    def statistics():
        estimated = estimate_statistics(holder[0], source, key, model=model, config=config)
        jax.block_until_ready(estimated.batch_stats)
        return statistics_batches(source, config)

    return {"whole step": whole, "bare gradient": bare, "batch of statistics": statistics}


def theirs(samples: int, size: int):
    """The gradient of TLIO's network in PyTorch on a fixed batch, or nothing where torch is not
    installed."""
    try:
        import torch

        from benchmarks.tlio_torch import TlioNetwork
    except ImportError:
        return {}
    torch.manual_seed(0)
    network, windows, target = (
        TlioNetwork(samples),
        torch.randn(size, 6, samples),
        torch.randn(size, 3),
    )

    def gradient():
        network.zero_grad(set_to_none=True)
        mean, log_std = network(windows)
        (0.5 * (mean - target) ** 2 * torch.exp(-2 * log_std) + log_std).sum(1).mean().backward()
        return 1

    return {"PyTorch, TLIO": gradient}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--width", type=int, default=64)
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--batches", type=int, nargs="+", default=[128, 1024])
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    print(
        f"{jax.devices()[0].device_kind}, jax {jax.__version__}, width {arguments.width}, windows of {arguments.samples} samples"
    )
    figures: dict[str, float] = {}
    for size in arguments.batches:
        config = TrainConfig(data=DataConfig(rate=float(arguments.samples)), model=ModelConfig(width=arguments.width),
                             optim=OptimConfig(batch_size=size))  # fmt: skip
        programs = ours(config) | (theirs(arguments.samples, size) if arguments.width == 64 else {})
        times: dict[str, list[float]] = {name: [] for name in programs}
        for name, program in programs.items():
            began = time.perf_counter()
            program()
            print(
                f"  batch {size}: {name:19s} first call {time.perf_counter() - began:6.1f} s (compiled)",
                flush=True,
            )
        for _ in range(arguments.repeats):
            for name, program in programs.items():
                began = time.perf_counter()
                steps = program()
                times[name].append((time.perf_counter() - began) / steps)
        for name, seconds in times.items():
            best, median = min(seconds), float(np.median(seconds))
            print(
                f"  batch {size}: {name:19s} {1e3 * best:8.1f} ms (median {1e3 * median:8.1f})   {size / best:8,.0f} windows/s"
            )
        figures[f"batch of statistics / whole step, batch {size}"] = min(
            times["batch of statistics"]
        ) / min(times["whole step"])
        figures[f"whole step / bare gradient, batch {size}"] = min(times["whole step"]) / min(
            times["bare gradient"]
        )
        if "PyTorch, TLIO" in times:
            figures[f"PyTorch / whole step, batch {size}"] = min(times["PyTorch, TLIO"]) / min(
                times["whole step"]
            )
    if (arguments.width, arguments.samples) == (64, 200):
        baseline.compare("train_step", figures)


if __name__ == "__main__":
    main()
