"""How far an export is from the package, over one synthetic walk of fixed seed."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from gnio_jax.config import DataConfig
from gnio_jax.data.readers.gait import PLACEMENTS, person
from gnio_jax.data.readers.synthetic import pedestrian
from gnio_jax.deployment.driver import Models, Walked, run, walk
from gnio_jax.deployment.flat_state import start_arrays
from gnio_jax.errors import InputError
from gnio_jax.evaluation.inference import Network
from gnio_jax.evaluation.metrics import ate
from gnio_jax.filtering import initial_state, run_odometry
from gnio_jax.filtering.options import FilterSetup
from gnio_jax.numerics import matrix_from_quaternion
from gnio_jax.types import Prediction

SECONDS = 60.0
DISPLACEMENT_LIMIT, POSITION_LIMIT = 1e-5, 1e-3
"""How far a float32 export may be from the package, m: more is a fault of the conversion."""


class Drawn(NamedTuple):
    """What a walk is drawn from; no split has these."""

    seed: int
    person: int
    placement: str


MEASURED = Drawn(9000, 900, "handheld")
"""The walk on which exports are measured."""
CALIBRATION = tuple(Drawn(9001 + i, 901 + i, where) for i, where in enumerate(PLACEMENTS))
"""The walks from which int8 takes its ranges: one walk alone knows too few."""
CALIBRATION_SECONDS = 30.0


class Walk(NamedTuple):
    """A walk of K clone intervals, and its true start."""

    gyro: Float[np.ndarray, "s 3"]
    accel: Float[np.ndarray, "s 3"]
    start: dict[str, np.ndarray]
    """Rotation, velocity, position, gyro bias 0."""
    position: Float[np.ndarray, "k 3"]
    """True, at the end of each clone interval, m."""


class Said(NamedTuple):
    """What an odometry says of a walk."""

    position: Float[np.ndarray, "k 3"]
    """m."""
    displacement: Float[np.ndarray, "m 3"]
    """Of each of the m windows, m."""


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


def draw_walk(windows: DataConfig, seconds: float, drawn: Drawn = MEASURED) -> Walk:
    """A pedestrian at the network's rate."""
    n, rate = windows.stride, windows.rate
    samples = int(seconds * rate) // n * n
    found = pedestrian(
        drawn.seed,
        person(drawn.person),
        drawn.placement,
        seconds=samples / rate + 1,
        rate=rate,
    )
    start = {
        "rotation": matrix_from_quaternion(found.orientation[0]),
        "velocity": found.velocity[0],
        "position": found.position[0],
        "gyro_bias": np.zeros(3),
    }
    truth = found.position[n : samples + 1 : n]
    return Walk(found.gyro[:samples], found.accel[:samples], start, truth)


def of_package(network: Network, setup: FilterSetup, drawn: Walk) -> Said:
    """`run_odometry` over the walk."""

    def predict(windows: Any) -> Prediction:
        return network.apply(network.variables, windows)._replace(diagnostics={})

    @jax.jit
    def odometry(start: dict[str, Any], gyro: Any, accel: Any) -> Said:
        state = initial_state(setup.config, **start, std=setup.initial_std)
        _, history = run_odometry(predict, state, gyro, accel, setup.config, setup.noise)
        return Said(history.position, history.displacement[setup.config.first_measured :])

    return Said(*map(np.asarray, odometry(drawn.start, drawn.gyro, drawn.accel)))


def drive(models: Models, drawn: Walk, setup: FilterSetup) -> Walked:
    """The exported models over the walk, from its true start."""
    state = initial_state(setup.config, **drawn.start, std=setup.initial_std)
    return walk(models, start_arrays(state, setup), drawn.gyro, drawn.accel)


def calibration_windows(
    models: Models, windows: DataConfig, setup: FilterSetup
) -> Float[np.ndarray, "m n 6"]:
    """What the network sees on the walks of `CALIBRATION`."""
    walks = (draw_walk(windows, CALIBRATION_SECONDS, drawn) for drawn in CALIBRATION)
    return np.concatenate([drive(models, drawn, setup).windows for drawn in walks])


def deviation(drawn: Walk, package: Said, export: Said) -> Deviation:
    """Of what an export says of the walk from what the package says."""
    moved = np.linalg.norm(export.displacement - package.displacement, axis=1)
    apart = np.linalg.norm(export.position - package.position, axis=1)
    return Deviation(
        displacement_rms=float(np.sqrt(np.mean(moved**2))),
        displacement_largest=float(moved.max()),
        position_largest=float(apart.max()),
        ate=ate(export.position, drawn.position),
        ate_of_package=ate(package.position, drawn.position),
    )


def of_windows(session: Any, windows: Float[np.ndarray, "m n 6"]) -> Float[np.ndarray, "m 3"]:
    """What a network says of windows, m."""
    return np.array([run(session, {"window": each[None]})["displacement"][0] for each in windows])


def check(found: Deviation, where: str, converter: str) -> None:
    """Raise `InputError` where a float32 export is not the package's odometry."""
    largest = found.displacement_largest, found.position_largest
    limits = DISPLACEMENT_LIMIT, POSITION_LIMIT
    if not all(value <= limit for value, limit in zip(largest, limits, strict=True)):
        problem = f"the conversion is off by {largest[0]:.2g} m a window, {largest[1]:.2g} m a walk"
        raise InputError(where, problem, f"another version of {converter} may do better")
