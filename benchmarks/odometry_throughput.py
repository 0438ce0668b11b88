"""Speed of the whole odometry: a network inside the filter's loop.

    python -m benchmarks.odometry_throughput [--network gru] [--batches 1 8 32] [--seconds 20]
    python -m benchmarks.odometry_throughput --network pedestrian --batches 1 32

A network of the package has its full width, with fresh weights. A trained one, by its name or
folder, runs at its own rate with its own filter. The figure is seconds of recording per second of
computing, for one sequence and for many side by side. Compile time is measured apart, and the best
of the repeats counts. The same filter with given measurements is timed too: the difference is the
network's share. Where PyTorch is installed, the forward pass of TLIO's network over the same number
of windows at once is timed as well. It bounds any filter that uses that network.
"""

from __future__ import annotations

import argparse
import time

import jax
import numpy as np

from benchmarks import baseline

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402

from benchmarks.filter_throughput import DT, walk  # noqa: E402
from gnio_jax import filtering, models, networks  # noqa: E402


def best(program, arguments, repeats: int) -> float:
    """Seconds of the quickest call after a first one that is not counted."""
    jax.block_until_ready(program(*arguments))
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        times.append(time.perf_counter() - begin)
    return min(times)


def fresh(name: str, clone_rate: int) -> tuple[models.Network, filtering.Filter]:
    """A network of the package at full width, and a filter with the default measurements."""
    config = filtering.FilterConfig(DT, round(1 / DT) // clone_rate, clone_rate)
    noise = filtering.NoiseModel.per_sample(1e-2, 3.16e-2, config.dt)
    model = models.create(name)
    variables = models.initialise(model, jax.random.key(0), config.input_samples)
    return models.Network.of(model, variables), filtering.Filter(config, noise)


def trained(name: str) -> tuple[models.Network, filtering.Filter]:
    """A trained network and its filter."""
    loaded = networks.load(name)
    ekf = filtering.make_filter(loaded.config.data, loaded.config.filter)
    return models.Network.of(loaded.model, loaded.variables), ekf


def measure(
    network: models.Network, ekf: filtering.Filter, batch: int, seconds: float, repeats: int
) -> dict[str, float]:
    """Times real time of the whole odometry and of the filter alone, and the network's share."""
    config = ekf.config
    gyro, accel, displacement, covariance = (
        np.tile(signal[None], (batch, *[1] * signal.ndim)) for signal in walk(seconds, config)
    )
    state = filtering.initial_state(ekf, np.eye(3), np.array([1.2, 0.0, 0.0]), np.zeros(3))

    def with_network(frozen, gyro, accel):
        plain = lambda prediction: prediction._replace(diagnostics={})  # noqa: E731
        predict = network._replace(variables=frozen).predict(plain)
        return filtering.run_odometry(predict, ekf, state, gyro, accel)[1].position

    def filter_alone(gyro, accel, displacement, covariance):
        signals = (gyro, accel, displacement, covariance)
        _, history = filtering.run_filter(ekf, state, *signals)
        return history.position

    def for_all(function, shared: int):
        # A batch of one runs the plain program, so that the figure is that of a single recording.
        if batch == 1:
            return lambda *a: function(*a[:shared], *(x[0] for x in a[shared:]))
        return filtering.over_sequences(function, shared)

    signals = jax.device_put((gyro, accel))
    begin = time.perf_counter()
    program = jax.jit(for_all(with_network, 1)).lower(network.variables, *signals).compile()
    compiled = time.perf_counter() - begin
    assert bool(jnp.isfinite(program(network.variables, *signals)).all())
    whole = best(program, (network.variables, *signals), repeats)
    filter_seconds = best(
        jax.jit(for_all(filter_alone, 0)), (*signals, displacement, covariance), repeats
    )
    samples = gyro.shape[1]
    duration = batch * samples * config.dt
    windows = batch * (samples // config.samples_per_clone - config.clones_per_window)
    return {
        "whole": duration / whole,
        "filter": duration / filter_seconds,
        "ms a window": (whole - filter_seconds) / windows * 1e3,
        "compile": compiled,
        "seconds": whole,
        "windows": windows,
    }


def torch_forward(windows: int, batch: int, repeats: int) -> float | None:
    """Seconds of PyTorch's forward pass of TLIO's network over `windows` windows, `batch` at once.

    None where PyTorch is not installed.
    """
    try:
        import torch

        from benchmarks.tlio_torch import TlioNetwork
    except ImportError:
        return None
    network, x = TlioNetwork(200).eval(), torch.randn(batch, 6, 200)
    calls = max(1, min(windows // batch, 50))
    times = []
    with torch.no_grad():
        for _ in range(repeats + 1):
            begin = time.perf_counter()
            for _ in range(calls):
                network(x)
            times.append(time.perf_counter() - begin)
    return min(times) / (calls * batch) * windows


def report_row(
    network: str, rate: int, batch: int, seconds: float, repeats: int
) -> dict[str, float]:
    """Measure and print one row; its figures by their names in the baseline."""
    subject = fresh(network, rate) if network in models.names() else trained(network)
    row = measure(*subject, batch, seconds, repeats)
    torch_seconds = torch_forward(int(row["windows"]), batch, repeats)
    rate = round(1 / (subject[1].config.samples_per_clone * subject[1].config.dt))
    name = f"{rate} Hz clones, batch {batch}"
    if network != "gnio":
        name = f"{network}, {name}"
    figures = {f"times real time, {name}": row["whole"]}
    share = ""
    if torch_seconds is not None:
        ratio = torch_seconds / row["seconds"]
        share = f"{ratio:.2f} of its time"
        figures[f"PyTorch forward / whole odometry, {name}"] = ratio
    print(
        f"{rate:4} Hz {batch:6} {row['whole']:9.1f} {row['filter']:9.0f} "
        f"{row['ms a window']:10.2f} {row['compile']:10.1f} {share:>25}",
        flush=True,
    )
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--network", default="gnio", help="of the package, or a trained one")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument(
        "--clone-rates",
        type=int,
        nargs="+",
        default=[20],
        help="clones per second; the network runs once for each (a trained one has its own)",
    )
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the simulated walk")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    filtering.cores_as_devices()
    device = jax.devices()[0].device_kind
    print(f"{device}, jax {jax.__version__}, {arguments.network}; times real time\n")
    print(
        f"{'clones':>7} {'batch':>6} {'whole':>9} {'filter':>9} "
        f"{'ms/window':>10} {'compile s':>10} {'TLIO in PyTorch, forward':>25}"
    )
    figures: dict[str, float] = {}
    for rate in arguments.clone_rates:
        for batch in arguments.batches:
            row = arguments.network, rate, batch, arguments.seconds, arguments.repeats
            figures |= report_row(*row)
    baseline.compare("odometry_throughput", figures)


if __name__ == "__main__":
    main()
