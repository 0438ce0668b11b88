"""Two versions of the package in turn: the filter, its gradient, the odometry, the training step.

    git worktree add ../before COMMIT
    taskset -c 0 python -m benchmarks.two_versions ../before
        [--only filter sequences gradient odometry training] [--widths 16 32 64] [--samples 100 200]
        [--batch 128] [--rounds 20]

Each version is a process of its own, which waits while the other one runs, so that a busy machine
slows them alike. The best round counts, and nothing is compiled in it. Besides the time on the
clock the benchmark prints the time on the processor, on which other programs have less influence.
For the training step it also prints what share of the speed of one large product the products of
the convolutions reach. Pin it to one core: where several cores share a step, the time on the
processor counts waiting, too.
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
TRAINING = """
from benchmarks.train_step import ours
from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, TrainConfig
width, samples, batch = map(int, sys.argv[1:])
data, model = DataConfig(rate=float(samples)), ModelConfig(width=width)
config = TrainConfig(data=data, model=model, optim=OptimConfig(batch_size=batch))
work = ours(config)["whole step"]
"""
"""Each of these programs defines `work()`, which computes something and returns how often."""
FORMS = """
def one(function, config, noise, *arguments):
    \"""A call of this version, or of one before the filter was one value.\"""
    if hasattr(filtering, "Filter"):
        return function(filtering.Filter(config, noise), *arguments)
    return function(*arguments, config, noise)

def begin(config, *pose):
    first = filtering.Filter(config) if hasattr(filtering, "Filter") else config
    return filtering.initial_state(first, *pose)
"""
FILTER = (
    FORMS
    + """
from benchmarks.filter_throughput import DT, jax, jnp, np, filtering, walk
config = filtering.FilterConfig(DT, 10, 20)
signals = jax.device_put(walk(60.0, config))
densities = filtering.NoiseModel.per_sample(1e-2, 3.16e-2, DT)[:4]

def value(logarithms, velocity, gyro, accel, displacement, covariance):
    state = begin(config, np.eye(3), velocity, np.zeros(3))
    noise, rows = filtering.NoiseModel(*jnp.exp(logarithms)), (displacement, covariance)
    _, history = one(filtering.run_filter, config, noise, state, gyro, accel, *rows)
    return jnp.sum(history.position**2) + jnp.nansum(history.nis)

arguments = jnp.log(jnp.array(densities)), jnp.array([1.2, 0.0, 0.0]), *signals
program = jax.jit(value).lower(*arguments).compile()

def work():
    for _ in range(5):
        jax.block_until_ready(program(*arguments))
    return 5
"""
)
SEQUENCES = (
    FILTER
    + """
side = [jnp.stack([part] * 16) for part in arguments[1:]]
program = jax.jit(jax.vmap(value, (None, 0, 0, 0, 0, 0))).lower(arguments[0], *side).compile()
arguments = arguments[0], *side
"""
)
GRADIENT = (
    FILTER
    + """
program = jax.jit(jax.value_and_grad(value, (0, 1, 4))).lower(*arguments).compile()
"""
)
ODOMETRY = (
    FORMS
    + """
from benchmarks.filter_throughput import DT, jax, jnp, np, filtering, walk
from gnio_jax import models
config = filtering.FilterConfig(DT, 10, 20)
gyro, accel, *_ = jax.device_put(walk(10.0, config))
state = begin(config, np.eye(3), np.array([1.2, 0.0, 0.0]), np.zeros(3))
noise = filtering.NoiseModel.per_sample(1e-2, 3.16e-2, DT)
model = models.create("gnio")
samples = getattr(config, "input_samples", None) or config.seen  # its earlier name
frozen = models.inference_variables(model, models.initialise(model, jax.random.key(0), samples))
apply = models.Inference(model)

def odometry(frozen, gyro, accel):
    def predict(windows):
        return apply(frozen, windows)._replace(diagnostics={})
    def run(*arguments):
        return filtering.run_odometry(predict, *arguments)
    return one(run, config, noise, state, gyro, accel)[1].position

program = jax.jit(odometry).lower(frozen, gyro, accel).compile()

def work():
    jax.block_until_ready(program(frozen, gyro, accel))
    return 1
"""
)
LOOP = """
for line in sys.stdin:
    clock, processor = time.perf_counter(), time.process_time()
    times = work()
    clock, processor = time.perf_counter() - clock, time.process_time() - processor
    print(clock / times, processor / times, flush=True)
"""
PROGRAMS = {
    "filter": ("the filter over 60 s", FILTER),
    "sequences": ("the filter over 60 s, 16 sequences", SEQUENCES),
    "gradient": ("value and gradient of the filter over 60 s", GRADIENT),
    "odometry": ("the odometry over 10 s, network of full width", ODOMETRY),
}


class Version:
    """A process that does its work when it is asked to."""

    def __init__(self, root: Path, program: str, *arguments: int) -> None:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        source = f"import sys, time\n{program}{LOOP}"
        command = [sys.executable, "-c", source, *map(str, arguments)]
        environment = os.environ | {"PYTHONPATH": str(root)}
        self.process = subprocess.Popen(command, cwd=root, env=environment, **pipes)
        self.work()  # compiled

    def work(self) -> tuple[float, float]:
        """Seconds on the clock and on the processor of doing it once."""
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


def in_turn(other: Path, rounds: int, program: str, *arguments: int) -> tuple[list, list]:
    """The best seconds (clock, processor) of the other version and of this one."""
    versions = [Version(root, program, *arguments) for root in (other, HERE)]
    times_by_round = [[version.work() for version in versions] for _ in range(rounds)]
    for version in versions:
        version.end()
    other_seconds, seconds_here = (
        [min(seconds) for seconds in zip(*times, strict=True)]
        for times in zip(*times_by_round, strict=True)
    )
    return other_seconds, seconds_here


def row(name: str, before: list, now: list) -> str:
    """Both versions' milliseconds and what the new one takes of the old one's."""
    clock, processor = (1e3 * before[0], 1e3 * now[0]), (1e3 * before[1], 1e3 * now[1])
    return (
        f"{name}: {clock[0]:.1f} → {clock[1]:.1f} ms ({clock[1] / clock[0]:.2f} of the time); "
        f"processor {processor[0]:.1f} → {processor[1]:.1f} ms ({processor[1] / processor[0]:.2f})"
    )


def compare_training(other: Path, sizes: tuple[int, int, int], rounds: int) -> None:
    """Print the row of a training step."""
    width, samples, batch = sizes
    before, now = in_turn(other, rounds, TRAINING, *sizes)
    share = products(width, samples) * batch / now[1] / speed_of_a_large_product()
    name = f"training step, width {width}, {samples} samples, batch {batch}"
    speed = f"{batch / now[0]:,.0f} windows/s, {share:.0%} of a large product's speed"
    print(f"{row(name, before, now)}; {speed}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("other", type=Path, help="a checkout of the other version")
    kinds = [*PROGRAMS, "training"]
    parser.add_argument("--only", nargs="+", choices=kinds, default=kinds)
    parser.add_argument("--widths", type=int, nargs="+", default=[16, 32, 64])
    parser.add_argument("--samples", type=int, nargs="+", default=[100, 200])
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--rounds", type=int, default=20)
    arguments = parser.parse_args()
    other = arguments.other.resolve()
    for kind, (name, program) in PROGRAMS.items():
        if kind in arguments.only:
            print(row(name, *in_turn(other, arguments.rounds, program)), flush=True)
    if "training" in arguments.only:
        for width in arguments.widths:
            for samples in arguments.samples:
                compare_training(other, (width, samples, arguments.batch), arguments.rounds)


if __name__ == "__main__":
    main()
