"""IMU samples per second of the stochastic-cloning EKF, beside a plain NumPy filter.

    python -m benchmarks.filter_throughput [--seconds 180] [--repeats 5]
        [--only batch|window|length|precision|gradient]

The table covers batch sizes, clone rates, window lengths, recording lengths and precisions. A batch
runs under `vmap` on one device, or is shared out among the cores (`filtering.over_sequences`).
Compile time is measured apart, and every timing waits for its result. A row gives the best and the
median of the repeats, the samples per second of processor time (which other programs on the machine
disturb less), and the memory of the program: arguments, results and temporaries. The last part
gives the cost of derivatives: value and gradient over the value, in time and memory, with and
without checkpoints, of one piece and of several under `vmap`.
"""

from __future__ import annotations

import argparse
import time
from typing import NamedTuple

import jax
import numpy as np

from benchmarks import baseline

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402

from gnio_jax import filtering  # noqa: E402

DT = 1 / 200


def walk(seconds: float, config: filtering.FilterConfig) -> tuple[np.ndarray, ...]:
    """Signals of a level walk at 1.2 m/s along a circle of 5 m radius, with a bobbing phone.

    Returns gyro (rad/s) and accel (m/s²), (k·n, 3) each, with noise; displacements (k, 3) with 2 cm
    of noise; their covariances (k, 3, 3).
    """
    rng = np.random.default_rng(0)
    n, window = config.samples_per_clone, config.clones_per_window
    intervals = int(seconds / config.dt) // n
    t = np.arange(intervals * n) * config.dt
    speed, rate = 1.2, 0.24
    bobbing = 9.81 + 2 * np.sin(4 * np.pi * t)
    gyro = np.stack([0 * t, 0 * t, np.full_like(t, rate)], 1)
    gyro += 1e-3 * rng.standard_normal((len(t), 3))
    accel = np.stack([0 * t, np.full_like(t, speed * rate), bobbing], 1)
    accel += 1e-2 * rng.standard_normal((len(t), 3))
    turned = rate * window * n * config.dt
    chord = speed / rate * np.array([np.sin(turned), 1 - np.cos(turned), 0.0])
    displacement = np.tile(chord, (intervals, 1))
    displacement += 0.02 * rng.standard_normal(displacement.shape)
    return gyro, accel, displacement, np.tile(0.02**2 * np.eye(3), (intervals, 1, 1))


def measure(
    config: filtering.FilterConfig, batch: int, spread: bool, seconds: float, repeats: int
) -> dict[str, float]:
    """Samples per second (best, median, per processor second), compile time in s, memory in MiB.

    `spread` shares the batch out among all cores.
    """
    dtype = np.float32 if config.allow_float32 else np.float64
    signals = tuple(signal.astype(dtype) for signal in walk(seconds, config))
    start = (np.eye(3, dtype=dtype), np.array([1.2, 0.0, 0.0], dtype), np.zeros(3, dtype))
    state = filtering.initial_state(filtering.Filter(config), *start)
    noise = filtering.NoiseModel.per_sample(1e-2, 3.16e-2, config.dt)

    def run(gyro, accel, displacement, covariance):
        signals = (gyro, accel, displacement, covariance)
        return filtering.run_filter(filtering.Filter(config, noise), state, *signals)

    if batch > 1:
        signals = tuple(np.tile(signal[None], (batch, *[1] * signal.ndim)) for signal in signals)
        run = filtering.over_sequences(run) if spread else jax.vmap(run)
    signals = jax.device_put(signals)
    begin = time.perf_counter()
    program = jax.jit(run).lower(*signals).compile()
    compiled = time.perf_counter() - begin
    final, _ = jax.block_until_ready(program(*signals))
    finite = bool(np.isfinite(final.core_covariance).all())
    assert finite, "the filter diverged: the timing would mean nothing"
    wall, cpu = [], []
    for _ in range(repeats):
        begin, spent = time.perf_counter(), time.process_time()
        jax.block_until_ready(program(*signals))
        wall.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - spent)
    samples = signals[0].size // 3
    devices = jax.device_count() if spread else 1
    return {
        "compile": compiled,
        "best": samples / min(wall),
        "median": samples / np.median(wall),
        "cpu": samples / min(cpu),
        "devices": devices,
        "memory": devices * mebibytes(program),
    }


def mebibytes(program) -> float:
    """Memory of a compiled program on one device: temporaries, arguments and results."""
    memory = program.memory_analysis()
    interface = memory.argument_size_in_bytes + memory.output_size_in_bytes
    return (memory.temp_size_in_bytes + interface) / 2**20


def measure_numpy(config: filtering.FilterConfig, seconds: float) -> float:
    """Samples per second of the tests' plain NumPy filter."""
    from tests.support.scekf_numpy import run

    gyro, accel, displacement, covariance = walk(seconds, config)
    begin = time.perf_counter()
    run(
        gyro,
        accel,
        displacement,
        covariance,
        np.eye(3),
        np.array([1.2, 0.0, 0.0]),
        np.zeros(3),
        dt=config.dt,
        n=config.samples_per_clone,
        clones=config.clones_per_window,
        sigma_gyro=1e-2,
        sigma_accel=3.16e-2,
    )
    return len(gyro) / (time.perf_counter() - begin)


class GradientCost(NamedTuple):
    """The cost of value and gradient of a number of pieces."""

    ratio: float
    """Their time over that of the value alone."""
    speed: float
    """Pieces per second."""
    memory: float
    """MiB of temporaries."""


def measure_gradient(
    config: filtering.FilterConfig, seconds: float, pieces: int, repeats: int
) -> GradientCost:
    """The cost of value and gradient of `pieces` walks side by side.

    The value is a function of the history. The gradient is with respect to the noise model, the
    initial velocities and every measurement. Both programs run in turn.
    """
    gyro, accel, displacement, covariance = jax.device_put(walk(seconds, config))

    def value_of_piece(logarithms, velocity, displacement):
        state = filtering.initial_state(filtering.Filter(config), np.eye(3), velocity, np.zeros(3))
        noise = filtering.NoiseModel(*jnp.exp(logarithms))
        _, history = filtering.run_filter(
            filtering.Filter(config, noise), state, gyro, accel, displacement, covariance
        )
        return jnp.sum(history.position**2) + jnp.nansum(history.nis)

    def value(logarithms, velocity, displacement):
        of_pieces = jax.vmap(value_of_piece, in_axes=(None, 0, 0))
        return jnp.sum(of_pieces(logarithms, velocity, displacement))

    densities = filtering.NoiseModel.per_sample(1e-2, 3.16e-2, DT)[:4]
    arguments = jnp.log(jnp.array(densities)), jnp.array([1.2, 0.0, 0.0]), displacement
    if pieces == 1:
        value = value_of_piece
    else:
        logarithms, *of_piece = arguments
        arguments = logarithms, *(jnp.stack([part] * pieces) for part in of_piece)
    with_gradient = jax.value_and_grad(value, argnums=(0, 1, 2))
    programs = [
        jax.jit(function).lower(*arguments).compile() for function in (value, with_gradient)
    ]
    for program in programs:
        result = jax.block_until_ready(program(*arguments))
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(result))
    times = [[timed(program, arguments) for program in programs] for _ in range(repeats)]
    value_seconds, gradient_seconds = np.min(times, axis=0)
    memory = programs[1].memory_analysis().temp_size_in_bytes / 2**20
    return GradientCost(gradient_seconds / value_seconds, pieces / gradient_seconds, memory)


def timed(program, arguments: tuple) -> float:
    """Seconds of one run."""
    begin = time.perf_counter()
    jax.block_until_ready(program(*arguments))
    return time.perf_counter() - begin


class Case(NamedTuple):
    """One row of the table."""

    per_clone: int
    """Samples between two clones."""
    clones: int
    """Clones in a window."""
    batch: int
    """Sequences side by side."""
    spread: bool = False
    """Share the batch out among all cores."""
    share: float = 1
    """Length of the walk as a share of --seconds."""
    float32: bool = False


CASES = {
    "batch": [
        Case(10, 20, 1),
        Case(10, 20, 16),
        Case(10, 20, 16, spread=True),
        Case(10, 20, 64, spread=True),
    ],
    "window": [
        Case(20, 10, 1),
        Case(20, 10, 16, spread=True),
        Case(20, 20, 1),
        Case(10, 40, 1),
    ],
    "length": [
        Case(10, 20, 1, share=1 / 4),
        Case(10, 20, 1, share=4),
    ],
    "precision": [
        Case(10, 20, 1, float32=True),
        Case(10, 20, 16, spread=True, float32=True),
    ],
}
GRADIENTS = [(60, 0, 1), (60, 0, 8), (60, 0, 32), (60, 32, 1), (600, 128, 1)]
"""(seconds, checkpoint_every, pieces)."""


def report_case(case: Case, length: float, repeats: int) -> tuple[str, float]:
    """Measure one row, print it, and return its name in the baseline and its best speed."""
    seconds = length * case.share
    rate, window = 1 / (case.per_clone * DT), case.per_clone * case.clones * DT
    config = filtering.FilterConfig(DT, case.per_clone, case.clones, allow_float32=case.float32)
    repeats = repeats if case.batch < 64 else min(repeats, 3)
    row = measure(config, case.batch, case.spread, seconds, repeats)
    precision = "float32" if case.float32 else "float64"
    setting = f"{rate:5.0f} Hz {window:6.1f} s {seconds:8.0f} {case.batch:6} {row['devices']:7}"
    speeds = f"{row['best']:10,.0f} {row['median']:10,.0f} {row['cpu']:10,.0f}"
    cost = f"{row['compile']:10.1f} {row['memory']:7.1f}"
    print(f"{setting} {precision:>8} {speeds} {cost}", flush=True)
    name = f"samples/s, {rate:.0f} Hz clones, {window:.0f} s window, batch {case.batch}"
    name += ", all cores" if case.spread else ""
    name += ", float32" if case.float32 else ""
    name += f", {seconds:.0f} s" if case.share != 1 else ""
    return name, row["best"]


def report_gradients() -> dict[str, float]:
    """Measure and print the cost of derivatives."""
    figures = {}
    print("\nvalue and gradient, 20 Hz clones, 1 s window, one device, float64:")
    for seconds, every, pieces in GRADIENTS:
        config = filtering.FilterConfig(DT, 10, 20, checkpoint_every=every)
        cost = measure_gradient(config, seconds, pieces, 3)
        print(
            f"  {pieces:2} × {seconds:3} s, checkpoint_every {every:3}: {cost.ratio:5.1f} × the "
            f"value's time, {cost.speed:5.2f} pieces/s, {cost.memory:5.0f} MiB of temporaries",
            flush=True,
        )
        name = f"{seconds} s, checkpoint_every {every}"
        name += f", {pieces} pieces" if pieces > 1 else ""
        figures[f"gradient / value, {name}"] = cost.ratio
        figures[f"pieces/s of value and gradient, {name}"] = cost.speed
        figures[f"MiB of the gradient, {name}"] = cost.memory
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=180.0, help="length of the simulated walk")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", choices=[*CASES, "gradient"], help="one part of the table")
    arguments = parser.parse_args()
    filtering.cores_as_devices()
    device = jax.devices()[0].device_kind
    print(f"{device}, jax {jax.__version__}, 200 Hz IMU; samples per second\n")
    setting = f"{'clones':>8} {'window':>8} {'seconds':>8} {'batch':>6} {'devices':>7}"
    speeds = f"{'best':>10} {'median':>10} {'per cpu-s':>10}"
    print(f"{setting} {'':>8} {speeds} {'compile s':>10} {'MiB':>7}")

    figures: dict[str, float] = {}
    for part, cases in CASES.items():
        if arguments.only in (None, part):
            for case in cases:
                name, speed = report_case(case, arguments.seconds, arguments.repeats)
                figures[name] = speed
    if arguments.only in (None, "batch"):
        rate = measure_numpy(filtering.FilterConfig(DT, 10, 20), 10.0)
        print(f"\nplain NumPy filter, 20 Hz clones, 1 s window, one sequence: {rate:,.0f}")
        ours = figures["samples/s, 20 Hz clones, 1 s window, batch 1"]
        figures["this filter / plain NumPy"] = ours / rate
    if arguments.only in (None, "gradient"):
        figures |= report_gradients()
    baseline.compare("filter_throughput", figures)


if __name__ == "__main__":
    main()
