"""The whole odometry, network in the loop, as one StableHLO program (`jax.export`).

Its recordings may have any length of whole rounds of the clones: R (W + 1) n samples, where R is a
symbol of the program. `load_odometry` fills a recording up to that and cuts the results again; the
filter is causal, so what fills up changes nothing before it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from gnio_jax.deployment.manifest import read_file, read_manifest
from gnio_jax.errors import require_packages
from gnio_jax.evaluation.inference import Network
from gnio_jax.filtering import initial_state, run_odometry
from gnio_jax.filtering.options import FilterSetup
from gnio_jax.types import Array

FILE = "odometry.stablehlo"
PLATFORMS = ("cpu", "cuda")
"""The program is lowered for each of them."""
START = {"rotation": (3, 3), "velocity": (3,), "position": (3,), "gyro_bias": (3,)}
"""Shapes of the start's arrays, as `initial_state` takes them; its accelerometer's bias is 0."""
RESULTS = (
    "rotation",
    "velocity",
    "position",
    "gyro_bias",
    "accel_bias",
    "covariance",
    "displacement",
    "accepted",
    "nis",
    "healthy",
)
"""The fields of `FilterHistory` that the program returns."""


class OdometryProgram(NamedTuple):
    """The program, serialised, with the arrays that go in and out."""

    content: bytes
    inputs: dict[str, jax.ShapeDtypeStruct]
    outputs: dict[str, jax.ShapeDtypeStruct]


def odometry_program(network: Network, setup: FilterSetup) -> OdometryProgram:
    """Arrays by name in, arrays by name out. JAX's x64 must be on.

    In: gyro rad/s and accel m/s² (R (W + 1) n, 3), raw, and `START`; float64. Out: `RESULTS`.
    """
    (rounds,) = jax.export.symbolic_shape("rounds")
    samples = setup.config.clones * setup.config.samples_per_clone * rounds
    shapes = {"gyro": (samples, 3), "accel": (samples, 3), **START}
    inputs = {name: jax.ShapeDtypeStruct(each, jnp.float64) for name, each in shapes.items()}

    def predict(windows: Array) -> Any:
        prediction = network.apply(network.variables, windows)
        return prediction._replace(diagnostics={})

    def odometry(arrays: dict[str, Array]) -> dict[str, Array]:
        signals = arrays["gyro"], arrays["accel"]
        start = {name: arrays[name] for name in START}
        state = initial_state(setup.config, **start, std=setup.initial_std)
        _, history = run_odometry(predict, state, *signals, setup.config, setup.noise)
        return {name: getattr(history, name) for name in RESULTS}

    exported = jax.export.export(jax.jit(odometry), platforms=PLATFORMS)(inputs)
    outputs = jax.tree.unflatten(exported.out_tree, exported.out_avals)
    return OdometryProgram(bytes(exported.serialize()), inputs, outputs)


def load_odometry(folder: str | Path) -> Callable[[dict[str, Any]], dict[str, np.ndarray]]:
    """The program of an export, as a function of recordings of K·n samples, K clone intervals.

    It takes and returns what `odometry_program` says, with K rows, and compiles for each number of
    rounds. Switches JAX's x64 on. Raises `InputError` for a folder that is no such export.
    """
    require_packages(folder, "stablehlo", "flatbuffers")
    manifest = read_manifest(Path(folder))
    content = read_file(Path(folder), FILE, manifest)
    n = manifest["samples_per_clone"]
    return whole_odometry(content, n, manifest["clones_per_window"] + 1)


def whole_odometry(
    content: bytes, samples_per_clone: int, clones: int
) -> Callable[[dict[str, Any]], dict[str, np.ndarray]]:
    """`load_odometry` of a serialised program."""
    jax.config.update("jax_enable_x64", True)
    call = jax.jit(jax.export.deserialize(bytearray(content)).call)

    def odometry(arrays: dict[str, Any]) -> dict[str, np.ndarray]:
        rows = len(arrays["gyro"]) // samples_per_clone
        missing = -rows % clones * samples_per_clone
        whole = {
            name: np.pad(
                arrays[name][: rows * samples_per_clone], ((0, missing), (0, 0)), mode="edge"
            )
            for name in ("gyro", "accel")
        }
        found = call({**arrays, **whole})
        return {name: np.asarray(value)[:rows] for name, value in found.items()}

    return odometry
