"""How far an export is from the package, over one synthetic walk of fixed seed."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from gnio_jax.config import DataConfig
from gnio_jax.data.simulated.walks import pedestrian
from gnio_jax.errors import InputError
from gnio_jax.evaluation.metrics import ate
from gnio_jax.filtering import FilterHistory, initial_state, run_odometry
from gnio_jax.filtering.settings import FilterSetup
from gnio_jax.models import Network
from gnio_jax.numerics import matrix_from_quaternion
from gnio_jax.types import Prediction

SEED, PERSON, PLACEMENT = 9000, 900, "handheld"
"""What the walk is drawn from; no split has these."""
DISPLACEMENT_LIMIT, POSITION_LIMIT = 1e-5, 1e-3
"""How far an export may be from the package, m: more is a fault of the conversion."""


class Walk(NamedTuple):
    """A walk of K clone intervals, and its true start."""

    gyro: Float[np.ndarray, "s 3"]
    """rad/s, raw."""
    accel: Float[np.ndarray, "s 3"]
    """m/s², raw."""
    start: dict[str, np.ndarray]
    """Rotation, velocity and position; the biases are zero."""
    position: Float[np.ndarray, "k 3"]
    """True, at the end of each clone interval, m."""


class Deviation(NamedTuple):
    """Of what was exported from the package's own odometry."""

    displacement_rms: float
    """Of the network, over the windows of the walk, m."""
    displacement_largest: float
    """m."""
    position_largest: float
    """Of the filter, m."""
    ate: float
    """Error of the exported odometry against the truth, m …"""
    ate_of_package: float
    """… and of the package's own."""


def draw_walk(windows: DataConfig, seconds: float) -> Walk:
    """A pedestrian at the network's rate."""
    n, rate = windows.stride, windows.rate
    samples = int(seconds * rate) // n * n
    drawn = pedestrian(SEED, PERSON, PLACEMENT, seconds=samples / rate + 1, rate=rate)
    rotation = matrix_from_quaternion(drawn.orientation[0])
    start = {"rotation": rotation, "velocity": drawn.velocity[0], "position": drawn.position[0]}
    return Walk(
        drawn.gyro[:samples], drawn.accel[:samples], start, drawn.position[n : samples + 1 : n]
    )


def package_history(network: Network, setup: FilterSetup, walk: Walk) -> FilterHistory:
    """`run_odometry` over the walk."""

    def predict(windows: Any) -> Prediction:
        return network.apply(network.variables, windows)._replace(diagnostics={})

    @jax.jit
    def odometry(start: dict[str, Any], gyro: Any, accel: Any) -> FilterHistory:
        state = initial_state(setup.config, **start, std=setup.initial_std)
        return run_odometry(predict, state, gyro, accel, setup.config, setup.noise)[1]

    return odometry(walk.start, walk.gyro, walk.accel)


def deviation(
    position: Float[np.ndarray, "k 3"],
    displacement: Float[np.ndarray, "m 3"],
    history: FilterHistory,
    walk: Walk,
) -> Deviation:
    """Of the positions and of the displacements of m windows, m, from the package's `history`."""
    measured = np.asarray(history.displacement)[-len(displacement) :]
    apart = np.linalg.norm(displacement - measured, axis=1)
    return Deviation(
        displacement_rms=float(np.sqrt(np.mean(apart**2))),
        displacement_largest=float(apart.max()),
        position_largest=float(np.linalg.norm(position - history.position, axis=1).max()),
        ate=ate(position, walk.position),
        ate_of_package=ate(np.asarray(history.position), walk.position),
    )


def check(found: Deviation, where: Any) -> None:
    """Raise `InputError` where an export is not the package's odometry."""
    largest = found.displacement_largest, found.position_largest
    if not (largest[0] <= DISPLACEMENT_LIMIT and largest[1] <= POSITION_LIMIT):
        problem = f"the conversion is off by {largest[0]:.2g} m a window, {largest[1]:.2g} m a walk"
        raise InputError(where, problem, "another version of jax2onnx may do better")
