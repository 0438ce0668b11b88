"""Latency of exported models in ONNX Runtime beside the package's own online filter.

    python -m benchmarks.export RUN [--seconds 60] [--threads 1]

RUN is exported to a temporary folder. A synthetic walk is then filtered by `filtering.Tracker` and
by the exported models, a clone interval of each in turn. The table gives medians over the intervals
that have a window, by part where the models have parts.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

from gnio_jax import filtering, networks  # noqa: E402
from gnio_jax.apps.onnx import driver, export_run  # noqa: E402
from gnio_jax.apps.onnx.networks import deploy_network  # noqa: E402
from gnio_jax.apps.onnx.programs import start_arrays  # noqa: E402
from gnio_jax.apps.onnx.run import draw_walk  # noqa: E402
from gnio_jax.evaluation import PreparedRecording  # noqa: E402
from gnio_jax.filtering import make_filter  # noqa: E402
from gnio_jax.models import Network  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", help="folder of the run, a package or its name")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the walk")
    parser.add_argument("--threads", type=int, default=1, help="of ONNX Runtime")
    arguments = parser.parse_args()
    run = networks.load(arguments.run)
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}, {run.config.model}")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "models"
        export_run(arguments.run, out)
        models = driver.open_models(out, arguments.threads)
        ekf = make_filter(run.config.data, run.config.filter)
        recording = draw_walk(run.config.data, ekf, arguments.seconds)
        times = measure(run, models, recording)
    period = 1e3 * ekf.config.clone_seconds
    print(f"\n{'part':>34} {'p50 ms':>8} {'p99 ms':>8} {'of the period':>14}")
    for part, values in times.items():
        p50, p99 = np.percentile(1e3 * np.array(values), [50, 99])
        print(f"{part:>34} {p50:8.3f} {p99:8.3f} {p50 / period:13.2%}")
    ours, theirs = (np.median(times[part]) for part in ("gnio-jax, whole", "ONNX, whole"))
    print(f"\nONNX / gnio-jax, whole interval: {theirs / ours:.2f}")
    ours, theirs = (np.median(times[part]) for part in ("gnio-jax, network", "ONNX, network"))
    print(f"ONNX / gnio-jax, network:        {theirs / ours:.2f}")


def measure(
    run: Any, models: driver.Models, recording: PreparedRecording
) -> dict[str, list[float]]:
    """Seconds of each part of each clone interval that has a window."""
    ekf = make_filter(run.config.data, run.config.filter)
    network = Network.of(run.model, run.variables)
    deployed = deploy_network(network, ekf)
    infer = jax.jit(deployed.infer)
    state = recording.start.state(ekf)
    predict = network.predict(lambda prediction: prediction._replace(diagnostics={}))
    tracker = filtering.Tracker(predict, ekf, state)
    arrays, dt = start_arrays(state, deployed, ekf), ekf.config.dt
    times: dict[str, list[float]] = defaultdict(list)
    for k, rows in enumerate(clone_intervals(len(recording.gyro), ekf.config.samples_per_clone)):
        stride = {"gyro": recording.gyro[rows], "accel": recording.accel[rows]}
        stamps = dt * np.arange(rows.start, rows.stop)
        samples = list(zip(stamps, *stride.values(), strict=True))
        for sample in samples[:-1]:
            tracker.push(*sample)
        ours, _ = timed(lambda sample=samples[-1]: tracker.push(*sample))
        measured = {"displacement": np.full(3, np.nan), "covariance": np.eye(3)}
        parts = {}
        if k >= models.first_inferred:
            inputs = {**arrays, **stride}
            parts["window"], cut = timed(lambda inputs=inputs: driver.run(models.window, inputs))
            inputs = {**arrays, **cut}
            parts["network"], prediction = timed(
                lambda inputs=inputs: driver.run(models.network, inputs)
            )
            if k >= models.first_measured:
                measured = driver.measure(models, prediction)
            times["gnio-jax, whole"].append(ours)
            inputs = {name: inputs[name] for name in deployed.inputs}
            jitted, _ = timed(lambda inputs=inputs: jax.block_until_ready(infer(inputs)))
            times["gnio-jax, network"].append(jitted)
            arrays = {**arrays, **driver.next_state(prediction)}
        inputs = {**arrays, **stride, **measured}
        parts["filter step"], outputs = timed(lambda inputs=inputs: driver.run(models.step, inputs))
        arrays = {**arrays, **driver.next_state(outputs)}
        if "network" in parts:
            times["ONNX, whole"].append(sum(parts.values()))
            for part, seconds in parts.items():
                times[f"ONNX, {part}"].append(seconds)
    return times


def clone_intervals(samples: int, n: int) -> list[slice]:
    """The rows of each clone interval."""
    return [slice(first, first + n) for first in range(0, samples - n + 1, n)]


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and its result, which is on the host or waited for."""
    begin = time.perf_counter()
    result = call()
    return time.perf_counter() - begin, result


if __name__ == "__main__":
    main()
