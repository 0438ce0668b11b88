"""IMU samples per second of the stochastic-cloning EKF: alone, vmapped and over all cores, beside a
plain NumPy filter.

    python -m benchmarks.filter_throughput [--seconds 180] [--repeats 5] [--only batch|window|length|precision|gradient]

Over rates of cloning, windows, lengths and precisions. A batch runs under `vmap` on one device, and
shared out among the cores (`filtering.over_sequences`). Compilation is timed apart; every timing
waits for the result. Reported is the best and the median of the repeats, the samples per second of
processor time, which other programs on the machine disturb less, and the memory of the program: its
arguments, results and temporaries. Last comes what derivatives cost: value and gradient over value,
in time and memory, with and without checkpoints.
"""

from __future__ import annotations

import argparse
import time

import jax
import numpy as np

from benchmarks import baseline

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402

from gnio_jax import filtering  # noqa: E402

DT = 1 / 200


def walk(seconds: float, config: filtering.FilterConfig) -> tuple[np.ndarray, ...]:
    """A level walk at 1.2 m/s along a circle of 5 m radius with a bobbing phone: noisy gyro and
    accel, exact displacements."""
    rng = np.random.default_rng(0)
    n, window = config.samples_per_clone, config.clones_per_window
    intervals = int(seconds / DT) // n
    t = np.arange(intervals * n) * DT
    speed, rate = 1.2, 0.24
    gyro = np.stack([0 * t, 0 * t, np.full_like(t, rate)], 1) + 1e-3 * rng.standard_normal(
        (len(t), 3)
    )
    accel = np.stack(
        [0 * t, np.full_like(t, speed * rate), 9.81 + 2 * np.sin(4 * np.pi * t)], 1
    ) + 1e-2 * rng.standard_normal((len(t), 3))
    turned = rate * window * n * DT
    displacement = np.tile(
        speed / rate * np.array([np.sin(turned), 1 - np.cos(turned), 0.0]), (intervals, 1)
    )
    displacement += 0.02 * rng.standard_normal(displacement.shape)
    return gyro, accel, displacement, np.tile(0.02**2 * np.eye(3), (intervals, 1, 1))


def measure(
    config: filtering.FilterConfig, batch: int, spread: bool, seconds: float, repeats: int
) -> dict[str, float]:
    dtype = np.float32 if config.allow_float32 else np.float64
    signals = tuple(signal.astype(dtype) for signal in walk(seconds, config))
    state = filtering.initial_state(
        config, np.eye(3, dtype=dtype), np.array([1.2, 0.0, 0.0], dtype), np.zeros(3, dtype)
    )
    noise = filtering.NoiseModel.per_sample(1e-2, 3.16e-2, config.dt)

    def run(*signals):
        return filtering.run_filter(state, *signals, config, noise)

    if batch > 1:
        signals = tuple(np.tile(signal[None], (batch, *[1] * signal.ndim)) for signal in signals)
        run = filtering.over_sequences(run) if spread else jax.vmap(run)
    signals = jax.device_put(signals)
    begin = time.perf_counter()
    program = jax.jit(run).lower(*signals).compile()
    compiled = time.perf_counter() - begin
    final, _ = jax.block_until_ready(program(*signals))
    assert bool(np.isfinite(final.core_covariance).all()), (
        "the filter diverged: the timing would mean nothing"
    )
    wall, cpu = [], []
    for _ in range(repeats):
        begin, spent = time.perf_counter(), time.process_time()
        jax.block_until_ready(program(*signals))
        wall.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - spent)
    samples = signals[0].size // 3
    memory, devices = program.memory_analysis(), jax.device_count() if spread else 1
    return {
        "compile": compiled,
        "best": samples / min(wall),
        "median": samples / np.median(wall),
        "cpu": samples / min(cpu),
        "devices": devices,  # the analysis is that of one of them
        "memory": devices
        * (memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes)
        / 2**20,
    }


def measure_numpy(config: filtering.FilterConfig, seconds: float) -> float:
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


def measure_gradient(
    config: filtering.FilterConfig, seconds: float, repeats: int
) -> tuple[float, float]:
    """Seconds and MiB of the value and gradient of a function of the history, with respect to
    noise, start and every measurement."""
    gyro, accel, displacement, covariance = jax.device_put(walk(seconds, config))

    def value(logarithms, velocity, displacement):
        state = filtering.initial_state(config, np.eye(3), velocity, np.zeros(3))
        noise = filtering.NoiseModel(*jnp.exp(logarithms))
        _, history = filtering.run_filter(
            state, gyro, accel, displacement, covariance, config, noise
        )
        return jnp.sum(history.position**2) + jnp.nansum(history.nis)

    arguments = (
        jnp.log(jnp.array(filtering.NoiseModel.per_sample(1e-2, 3.16e-2, DT))),
        jnp.array([1.2, 0.0, 0.0]),
        displacement,
    )
    out = []
    for function in (value, jax.value_and_grad(value, argnums=(0, 1, 2))):
        program = jax.jit(function).lower(*arguments).compile()
        result = jax.block_until_ready(program(*arguments))
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(result))
        times = []
        for _ in range(repeats):
            begin = time.perf_counter()
            jax.block_until_ready(program(*arguments))
            times.append(time.perf_counter() - begin)
        out += [min(times), program.memory_analysis().temp_size_in_bytes / 2**20]
    return out[2] / out[0], out[3]


CASES = {  # clone interval in samples, clones in a window, sequences, over all cores, share of --seconds, float32
    "batch": [
        (10, 20, 1, False, 1, False),
        (10, 20, 16, False, 1, False),
        (10, 20, 16, True, 1, False),
        (10, 20, 64, True, 1, False),
    ],
    "window": [
        (20, 10, 1, False, 1, False),
        (20, 10, 16, True, 1, False),
        (20, 20, 1, False, 1, False),
        (10, 40, 1, False, 1, False),
    ],
    "length": [(10, 20, 1, False, 1 / 4, False), (10, 20, 1, False, 4, False)],
    "precision": [(10, 20, 1, False, 1, True), (10, 20, 16, True, 1, True)],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=180.0, help="length of the simulated walk")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", choices=[*CASES, "gradient"], help="one part of the table")
    arguments = parser.parse_args()
    filtering.cores_as_devices()
    print(
        f"{jax.devices()[0].device_kind}, jax {jax.__version__}, 200 Hz IMU; samples per second\n"
    )
    print(
        f"{'clones':>8} {'window':>8} {'seconds':>8} {'batch':>6} {'devices':>7} {'':>8} {'best':>10} {'median':>10} {'per cpu-s':>10} "
        f"{'compile s':>10} {'MiB':>7}"
    )
    figures: dict[str, float] = {}
    for part in [arguments.only] if arguments.only in CASES else [] if arguments.only else CASES:
        for n, clones, batch, spread, share, single in CASES[part]:
            config, seconds = (
                filtering.FilterConfig(DT, n, clones, allow_float32=single),
                arguments.seconds * share,
            )
            row = measure(
                config,
                batch,
                spread,
                seconds,
                arguments.repeats if batch < 64 else min(arguments.repeats, 3),
            )
            name = f"samples/s, {1 / (n * DT):.0f} Hz clones, {n * clones * DT:.0f} s window, batch {batch}"
            name += (
                ", all cores" * spread + ", float32" * single + f", {seconds:.0f} s" * (share != 1)
            )
            figures[name] = row["best"]
            print(
                f"{1 / (n * DT):5.0f} Hz {n * clones * DT:6.1f} s {seconds:8.0f} {batch:6} {row['devices']:7} "
                f"{'float32' if single else 'float64':>8} {row['best']:10,.0f} {row['median']:10,.0f} {row['cpu']:10,.0f} "
                f"{row['compile']:10.1f} {row['memory']:7.1f}",
                flush=True,
            )
    if arguments.only in (None, "batch"):
        rate = measure_numpy(filtering.FilterConfig(DT, 10, 20), 10.0)
        print(f"\nplain NumPy filter, 20 Hz clones, 1 s window, one sequence: {rate:,.0f}")
        figures["this filter / plain NumPy"] = (
            figures["samples/s, 20 Hz clones, 1 s window, batch 1"] / rate
        )
    if arguments.only in (None, "gradient"):
        print("\nvalue and gradient, 20 Hz clones, 1 s window, one sequence, float64:")
        for seconds, every in [(60, 0), (60, 32), (600, 128)]:
            ratio, memory = measure_gradient(
                filtering.FilterConfig(DT, 10, 20, checkpoint_every=every), seconds, 2
            )
            print(
                f"  {seconds:4} s, checkpoint_every {every:4}: {ratio:5.1f} × the value's time, {memory:7.0f} MiB of temporaries",
                flush=True,
            )
            figures[f"gradient / value, {seconds} s, checkpoint_every {every}"] = ratio
            figures[f"MiB of the gradient, {seconds} s, checkpoint_every {every}"] = memory
    baseline.compare("filter_throughput", figures)


if __name__ == "__main__":
    main()
