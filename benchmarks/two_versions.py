"""The whole training step of two versions of the package, in turn.

    git worktree add ../before COMMIT
    taskset -c 0 python -m benchmarks.two_versions ../before [--widths 16 32 64]
        [--samples 100 200] [--batch 128] [--rounds 20]

Each version is a process of its own, which waits while the other one runs, so that a busy machine
slows them alike. The best round counts. Besides the time on the clock it prints the time on the
processor, on which other programs have less influence, and what share of the speed of one large
product the products of the convolutions reach. Pin it to one core: where several cores share a
step, the time on the processor counts waiting, too.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp

HERE = Path(__file__).resolve().parents[1]
CHILD = """
import sys, time
from benchmarks.train_step import ours
from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, TrainConfig
width, samples, batch = map(int, sys.argv[1:])
data, model = DataConfig(rate=float(samples)), ModelConfig(width=width)
config = TrainConfig(data=data, model=model, optim=OptimConfig(batch_size=batch))
whole = ours(config)["whole step"]
for line in sys.stdin:
    clock, processor = time.perf_counter(), time.process_time()
    steps = whole()
    clock, processor = time.perf_counter() - clock, time.process_time() - processor
    print(clock / steps, processor / steps, flush=True)
"""


class Version:
    """A process that takes steps when it is asked to."""

    def __init__(self, root: Path, sizes: tuple[int, int, int]) -> None:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        command = [sys.executable, "-c", CHILD, *map(str, sizes)]
        environment = os.environ | {"PYTHONPATH": str(root)}
        self.process = subprocess.Popen(command, cwd=root, env=environment, **pipes)
        self.step()  # compiled

    def step(self) -> tuple[float, float]:
        """Seconds of a step on the clock and on the processor."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        clock, processor = self.process.stdout.readline().split()
        return float(clock), float(processor)

    def end(self) -> None:
        self.process.stdin.close()
        self.process.wait()


def products(width: int, samples: int) -> float:
    """Floating-point operations of the encoder's convolutions for a window: forward and both
    gradients."""
    length = -(-samples // 2)
    total = 2 * length * 7 * 6 * width
    length, before = -(-length // 2), width
    for group in range(4):
        features = width * 2**group
        for block in range(2):
            halves = group > 0 and block == 0
            length = -(-length // 2) if halves else length
            total += 2 * length * features * (3 * before + 3 * features + halves * before)
            before = features
    return 3 * total


def speed_of_a_large_product(size: int = 2048) -> float:
    """Floating-point operations per second on the processor of a product of two square matrices."""
    factor, times = jnp.ones((size, size), jnp.float32), []
    multiply = jax.jit(jnp.matmul)
    for _ in range(5):
        began = time.process_time()
        multiply(factor, factor).block_until_ready()
        times.append(time.process_time() - began)
    return 2 * size**3 / min(times)


def compare(other: Path, sizes: tuple[int, int, int], rounds: int) -> None:
    """Print one row."""
    width, samples, batch = sizes
    versions = [Version(other, sizes), Version(HERE, sizes)]
    found = [[version.step() for version in versions] for _ in range(rounds)]
    for version in versions:
        version.end()
    (before, processor_before), (now, processor_now) = (
        map(min, zip(*(both[i] for both in found), strict=True)) for i in range(2)
    )
    share = products(width, samples) * batch / processor_now / speed_of_a_large_product()
    print(
        f"width {width}, {samples} samples, batch {batch}: {1e3 * before:.1f} → {1e3 * now:.1f} ms"
        f" ({before / now:.2f} times), {batch / now:,.0f} windows/s; processor"
        f" {1e3 * processor_before:.1f} → {1e3 * processor_now:.1f} ms"
        f" ({processor_before / processor_now:.2f} times), {share:.0%} of a large product's speed",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("other", type=Path, help="a checkout of the other version")
    parser.add_argument("--widths", type=int, nargs="+", default=[16, 32, 64])
    parser.add_argument("--samples", type=int, nargs="+", default=[100, 200])
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--rounds", type=int, default=20)
    arguments = parser.parse_args()
    for width in arguments.widths:
        for samples in arguments.samples:
            sizes = width, samples, arguments.batch
            compare(arguments.other.resolve(), sizes, arguments.rounds)


if __name__ == "__main__":
    main()
