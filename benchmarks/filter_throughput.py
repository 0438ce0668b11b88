"""IMU samples per second of the stochastic-cloning EKF: alone and vmapped, beside a plain NumPy filter, over rates of cloning and windows.

    python benchmarks/filter_throughput.py [--seconds 60] [--repeats 7]

Compilation is timed apart; every timing waits for the result. Reported is the best and the median of the repeats, and the samples per
second of processor time, which other programs on the machine disturb less.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import baseline
import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

from gnio_jax import filtering  # noqa: E402

DT = 1 / 200


def walk(seconds: float, config: filtering.FilterConfig) -> tuple[np.ndarray, ...]:
    """A level walk at 1.2 m/s along a circle of 5 m radius with a bobbing phone: noisy gyro and accel, exact displacements."""
    rng = np.random.default_rng(0)
    n, window = config.samples_per_clone, config.clones_per_window
    intervals = int(seconds / DT) // n
    t = np.arange(intervals * n) * DT
    speed, rate = 1.2, 0.24
    gyro = np.stack([0 * t, 0 * t, np.full_like(t, rate)], 1) + 1e-3 * rng.standard_normal((len(t), 3))
    accel = np.stack([0 * t, np.full_like(t, speed * rate), 9.81 + 2 * np.sin(4 * np.pi * t)], 1) + 1e-2 * rng.standard_normal((len(t), 3))
    turned = rate * window * n * DT
    displacement = np.tile(speed / rate * np.array([np.sin(turned), 1 - np.cos(turned), 0.0]), (intervals, 1))
    displacement += 0.02 * rng.standard_normal(displacement.shape)
    return gyro, accel, displacement, np.tile(0.02**2 * np.eye(3), (intervals, 1, 1))


def measure(config: filtering.FilterConfig, batch: int, seconds: float, repeats: int) -> dict[str, float]:
    signals = walk(seconds, config)
    state = filtering.initial_state(config, np.eye(3), np.array([1.2, 0.0, 0.0]), np.zeros(3))
    noise = filtering.NoiseModel.per_sample(1e-2, 3.16e-2, config.dt)

    def run(*signals):
        return filtering.run_filter(state, *signals, config, noise)

    if batch > 1:
        signals = tuple(np.tile(signal[None], (batch, *[1] * signal.ndim)) for signal in signals)
        run = jax.vmap(run)
    signals = jax.device_put(signals)
    begin = time.perf_counter()
    program = jax.jit(run).lower(*signals).compile()
    compiled = time.perf_counter() - begin
    final, _ = jax.block_until_ready(program(*signals))
    assert bool(np.isfinite(final.core_covariance).all()), "the filter diverged: the timing would mean nothing"
    wall, cpu = [], []
    for _ in range(repeats):
        begin, spent = time.perf_counter(), time.process_time()
        jax.block_until_ready(program(*signals))
        wall.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - spent)
    samples = signals[0].size // 3
    memory = program.memory_analysis()
    return {"compile": compiled, "best": samples / min(wall), "median": samples / np.median(wall), "cpu": samples / min(cpu),
            "memory": (memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes) / 2**20}


def measure_numpy(config: filtering.FilterConfig, seconds: float) -> float:
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from tests.reference.scekf_numpy import run

    gyro, accel, displacement, covariance = walk(seconds, config)
    begin = time.perf_counter()
    run(gyro, accel, displacement, covariance, np.eye(3), np.array([1.2, 0.0, 0.0]), np.zeros(3), dt=config.dt, n=config.samples_per_clone,
        clones=config.clones_per_window, sigma_gyro=1e-2, sigma_accel=3.16e-2)
    return len(gyro) / (time.perf_counter() - begin)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the simulated walk")
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}, 200 Hz IMU, float64; samples per second\n")
    print(f"{'clones':>8} {'window':>8} {'batch':>6} {'best':>10} {'median':>10} {'per cpu-s':>10} {'compile s':>10} {'MiB':>7}")
    rows: dict[str, dict[str, float]] = {}
    for n, clones, batch in [(10, 20, 1), (10, 20, 16), (10, 20, 64), (20, 10, 1), (20, 10, 16), (10, 40, 1), (20, 20, 1)]:
        config = filtering.FilterConfig(DT, n, clones)
        row = measure(config, batch, arguments.seconds if batch < 64 else arguments.seconds / 4, arguments.repeats)
        rows[f"samples/s, {1 / (n * DT):.0f} Hz clones, {n * clones * DT:.0f} s window, batch {batch}"] = row
        print(f"{1 / (n * DT):5.0f} Hz {n * clones * DT:6.1f} s {batch:6} {row['best']:10,.0f} {row['median']:10,.0f} {row['cpu']:10,.0f} "
              f"{row['compile']:10.1f} {row['memory']:7.1f}", flush=True)
    rate = measure_numpy(filtering.FilterConfig(DT, 10, 20), min(arguments.seconds, 10.0))
    print(f"\nplain NumPy filter, 20 Hz clones, 1 s window, one sequence: {rate:,.0f}")
    baseline.compare("filter_throughput", {name: row["best"] for name, row in rows.items()})


if __name__ == "__main__":
    main()
