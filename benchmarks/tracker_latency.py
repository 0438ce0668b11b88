"""Latency of the online filter with the full-width network.

    python -m benchmarks.tracker_latency [--steps 1500] [--width 64] [--imu-rate 200]

It times pushes with a clone step and without, with garbage collection on and off. The filter runs
at 200 Hz with windows of 200 samples and 20 Hz clones, so that a step has 50 ms. A faster IMU goes
through the low-pass to 200 Hz. The weights are random: time does not depend on them. The table
gives wall time and the processor time of the whole process. Other programs on the machine disturb
processor time less.
"""

from __future__ import annotations

import argparse
import gc
import time

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import baseline

jax.config.update("jax_enable_x64", True)

from gnio_jax import filtering, models  # noqa: E402

RATE, PER_CLONE, CLONES = 200, 10, 20
WARM_UP = 100


def network(width: int):
    """A network with random weights that give displacements of a sensible size."""
    model = models.create("gnio", width=width)
    shapes = jax.eval_shape(
        model.init, jax.random.key(0), jax.ShapeDtypeStruct((1, PER_CLONE * CLONES, 6), jnp.float32)
    )
    random = np.random.default_rng(0)

    def draw(leaf: jax.ShapeDtypeStruct) -> jax.Array:
        fan_in = max(1, int(np.prod(leaf.shape[:-1])))
        return jnp.asarray(
            random.normal(0, fan_in**-0.5, leaf.shape) if leaf.ndim > 1 else np.ones(leaf.shape),
            jnp.float32,
        )

    variables = jax.tree.map(draw, shapes)
    print(f"{sum(leaf.size for leaf in jax.tree.leaves(variables['params'])):,} parameters")
    frozen = models.inference_variables(model, variables)
    return lambda windows: models.Inference(model)(frozen, windows)


def measure(
    tracker: filtering.Tracker, first: int, samples: int, imu_rate: float, collect: bool
) -> dict[str, np.ndarray]:
    """Wall and processor time of each push in ms, for pushes with and without a clone step."""
    random = np.random.default_rng(first)
    gyro = 0.02 * random.standard_normal((samples, 3))
    accel = 0.3 * random.standard_normal((samples, 3)) + [0.0, 0.0, 9.81]
    times: dict[str, list[float]] = {"step": [], "step, cpu": [], "sample": [], "sample, cpu": []}
    gc.collect()
    if not collect:
        gc.disable()
    try:
        for k in range(samples):
            cpu_start, begin = time.process_time(), time.perf_counter()
            pose = tracker.push((first + k) / imu_rate, gyro[k], accel[k])
            wall, cpu = time.perf_counter() - begin, time.process_time() - cpu_start
            kind = "sample" if pose is None else "step"
            times[kind].append(1e3 * wall)
            times[f"{kind}, cpu"].append(1e3 * cpu)
    finally:
        gc.enable()
    return {kind: np.array(values) for kind, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--steps",
        type=int,
        default=1500,
        help="clone steps to measure, each with garbage collection on and off",
    )
    parser.add_argument("--width", type=int, default=64, help="network width; 64 is the paper's")
    parser.add_argument("--imu-rate", type=float, default=RATE, help="rate of the IMU, Hz")
    arguments = parser.parse_args()
    imu_rate, per_step = arguments.imu_rate, round(PER_CLONE * arguments.imu_rate / RATE)
    config = filtering.FilterConfig(1 / RATE, PER_CLONE, CLONES)
    state = filtering.initial_state(filtering.Filter(config), np.eye(3), np.zeros(3), np.zeros(3))
    print(
        f"{jax.devices()[0].device_kind}, jax {jax.__version__}, {imu_rate:g} Hz IMU, "
        f"{RATE} Hz filter, {RATE / PER_CLONE:.0f} Hz clones"
    )
    predict = network(arguments.width)
    begin = time.perf_counter()
    tracker = filtering.Tracker(
        predict, filtering.Filter(config, filtering.NoiseModel()), state, imu_rate=imu_rate
    )
    print(f"compiled in {time.perf_counter() - begin:.1f} s\n")
    sample_count = WARM_UP * per_step
    measure(tracker, 0, sample_count, imu_rate, True)
    figures, period = {}, 1e3 * PER_CLONE / RATE
    print(f"{'':>22} {'collector':>9} {'p50 ms':>8} {'p99 ms':>8} {'max ms':>8} {'p99/period':>10}")
    for collect in (True, False):
        collector = "on" if collect else "off"
        times = measure(tracker, sample_count, arguments.steps * per_step, imu_rate, collect)
        sample_count += arguments.steps * per_step
        for kind, values in times.items():
            p50, p99, longest = np.percentile(values, [50, 99, 100])
            row = f"{kind:>22} {collector:>9} {p50:8.3f} {p99:8.3f} {longest:8.3f}"
            print(f"{row} {p99 / period:10.4f}", flush=True)
            figures[f"{kind}, p50 ms, collector {collector}"] = float(p50)
            figures[f"{kind}, p99 ms, collector {collector}"] = float(p99)
    pose = tracker.pose()
    assert pose is not None and np.isfinite(pose.position).all(), (
        "the filter diverged: the timing would mean nothing"
    )
    if imu_rate == RATE:
        baseline.compare("tracker_latency", figures)


if __name__ == "__main__":
    main()
