"""What each measurement costs a filter that takes displacements.

    python -m benchmarks.measurements [--seconds 60] [--repeats 20] [--only magnetometer ...]
    python -m benchmarks.measurements --network pedestrian

Every row is the filter with displacements and one other measurement in every clone interval, over
the filter with displacements alone. With a trained network, by its name or folder, it is the whole
odometry: the network in the loop of its own filter.

The programs are compiled first, and the compile time is in a column of its own. Then they run in
turn, and every timing waits for its result. A ratio is the median over the rounds of a program's
processor time over that of displacements alone in the same round, so that other programs on the
machine disturb it less. The best of the rounds is beside it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from benchmarks import baseline
from benchmarks.filter_throughput import DT, walk
from benchmarks.odometry_throughput import trained
from gnio_jax import filtering
from gnio_jax.filtering import nonholonomic, wheel_speed, zero_velocity

CONFIG = filtering.FilterConfig(DT, 10, 20)
"""20 Hz clones, a window of 1 s."""


def make_measurements(
    intervals: int, config: filtering.FilterConfig
) -> dict[str, tuple[tuple, tuple]]:
    """Name -> the measurements of the filter and those with rows, for `walk` of the throughput."""
    stamps = config.clone_seconds * np.arange(intervals + 2)
    yaw = 0.24 * stamps
    zero, one = np.zeros_like(stamps), np.ones_like(stamps)
    field = np.stack([20 * np.cos(yaw), -20 * np.sin(yaw), -40 * one], axis=1)
    turn = np.stack([np.cos(yaw), -np.sin(yaw), zero, np.sin(yaw), np.cos(yaw), zero], axis=1)
    turn = np.concatenate([turn, np.tile([0.0, 0.0, 1.0], (len(stamps), 1))], axis=1)
    rotation = turn.reshape(-1, 3, 3)[1 : intervals + 1]
    places = 5.0 * np.stack([np.sin(yaw), 1 - np.cos(yaw)], axis=1)[1:-1]
    covariance = np.tile(np.eye(2), (intervals, 1, 1))
    car = nonholonomic.NonHolonomic()
    return {
        "zero_velocity": ((zero_velocity.ZeroVelocity(),), ()),
        "nonholonomic": ((car,), ()),
        "… with states": ((nonholonomic.NonHolonomic(mounting_std=0.01, lever_std=0.5),), ()),
        "magnetometer": (
            (),
            (filtering.magnetometer_on_intervals(stamps, field, rotation, config),),
        ),
        "barometer": (
            (),
            (filtering.barometer_on_intervals(stamps, 101325.0 * one, intervals, config),),
        ),
        "fix": (
            (),
            (filtering.fixes_on_intervals(stamps[1:-1], places, covariance, intervals, config),),
        ),
        "wheel_speed": (
            (),
            (wheel_speed.speeds_on_intervals(stamps, 1.2 * one, intervals, config, car),),
        ),
    }


def make_filter(name: str | None) -> tuple[Callable, filtering.Filter]:
    """The run of a filter over the rows of `walk`, and the filter without other measurements: that
    of the trained network `name`, or one with given displacements."""
    if name is None:
        noise = filtering.NoiseModel.per_sample(1e-2, 3.16e-2, DT)
        return filtering.run_filter, filtering.Filter(CONFIG, noise)
    network, ekf = trained(name)

    def run(ekf, state, gyro, accel, displacement, covariance, measurements):
        signals = gyro, accel
        return filtering.run_odometry(
            network.predict(), ekf, state, *signals, measurements=measurements
        )

    return run, replace(ekf, measurements=())


def compile_filter(
    run_rows: Callable, ekf: filtering.Filter, rows: tuple, with_rows: tuple
) -> tuple[Any, tuple, float]:
    """The compiled program, its arguments, and the seconds of its compilation."""
    state = filtering.initial_state(ekf, np.eye(3), np.array([1.2, 0.0, 0.0]), np.zeros(3))

    def run(ekf, state, rows, with_rows):
        return run_rows(ekf, state, *rows, measurements=with_rows)

    arguments = jax.device_put((ekf, state, rows, with_rows))
    begin = time.perf_counter()
    program = jax.jit(run).lower(*arguments).compile()
    return program, arguments, time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the simulated walk")
    parser.add_argument("--repeats", type=int, default=20, help="rounds")
    parser.add_argument("--only", nargs="+", help="names of measurements; default: all")
    parser.add_argument("--network", help="a trained network in the loop, by its name or folder")
    arguments = parser.parse_args()
    run, ekf = make_filter(arguments.network)
    rows = walk(arguments.seconds, ekf.config)
    kinds = make_measurements(len(rows[2]), ekf.config)
    if unknown := set(arguments.only or ()) - kinds.keys():
        parser.error(f"--only: {', '.join(sorted(unknown))}; known: {', '.join(kinds)}")
    chosen = arguments.only or list(kinds)
    programs = {"displacement alone": compile_filter(run, ekf, rows, ())}
    for name in chosen:
        of_filter, with_rows = kinds[name]
        with_measurement = replace(ekf, measurements=of_filter)
        programs[name] = compile_filter(run, with_measurement, rows, with_rows)
    for name, (program, inputs, _) in programs.items():
        _, history = jax.block_until_ready(program(*inputs))
        assert bool(np.isfinite(history.position).all()), "the filter diverged: no timing counts"
        for kind, outcome in history.outcomes.items():
            print(f"{name}: {kind} is used in {outcome.accepted.mean():.0%} of the intervals")
    spent = {name: [] for name in programs}
    for _ in range(arguments.repeats):
        for name, (program, inputs, _) in programs.items():
            begin = time.process_time()
            jax.block_until_ready(program(*inputs))
            spent[name].append(time.process_time() - begin)
    base = np.array(spent["displacement alone"])
    device, config = jax.devices()[0].device_kind, ekf.config
    clones = f"{1 / config.clone_seconds:g} Hz clones, {config.window * config.dt:g} s window"
    network = f"network {arguments.network} in the loop" if arguments.network else "no network"
    print(f"\n{device}, jax {jax.__version__}, {clones}, {network}, one sequence, float64")
    print(f"{'':20} {'µs a step':>10} {'ratio':>7} {'of best':>8} {'compile s':>10}")
    figures = {}
    for name, times in spent.items():
        ratio, best = float(np.median(np.array(times) / base)), min(times) / base.min()
        step = 1e6 * min(times) / len(rows[2])
        print(f"{name:20} {step:10.1f} {ratio:7.2f} {best:8.2f} {programs[name][2]:10.1f}")
        figures[f"{name} / displacement alone"] = ratio
    del figures["displacement alone / displacement alone"]
    if arguments.network is None:
        baseline.compare("measurements", figures)


if __name__ == "__main__":
    main()
