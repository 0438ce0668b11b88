"""How far an export is from the package, over one synthetic walk of fixed seed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.config import DataConfig
from gnio_jax.data.simulated.walks import pedestrian
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Estimate, Recording, prepare
from gnio_jax.evaluation.metrics import ate
from gnio_jax.filtering.settings import FilterSetup

SEED, PERSON, PLACEMENT = 9000, 900, "handheld"
"""What the walk is drawn from; no split has these."""
DISPLACEMENT_LIMIT, POSITION_LIMIT = 1e-5, 1e-3
"""How far an export may be from the package, m: more is a fault of the conversion."""


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


def draw_walk(windows: DataConfig, setup: FilterSetup, seconds: float) -> Recording:
    """A pedestrian at the network's rate, with its true start."""
    length = seconds + 1.0 / windows.rate  # a stride ends with the sample after it
    drawn = pedestrian(SEED, PERSON, PLACEMENT, seconds=length, rate=windows.rate)
    (walk,), _ = prepare([drawn], windows, setup.initial_std)
    return walk


def deviation(
    position: Float[np.ndarray, "k 3"],
    displacement: Float[np.ndarray, "m 3"],
    own: Estimate,
) -> Deviation:
    """Of the positions and of the displacements of m windows, m, from those of the package."""
    ours, true = (each.position[1:] for each in (own.trajectory, own.reference))
    assert own.displacements is not None
    apart = np.linalg.norm(displacement - own.displacements.value[-len(displacement) :], axis=1)
    return Deviation(
        displacement_rms=float(np.sqrt(np.mean(apart**2))),
        displacement_largest=float(apart.max()),
        position_largest=float(np.linalg.norm(position - ours, axis=1).max()),
        ate=ate(position, true),
        ate_of_package=ate(ours, true),
    )


def check(found: Deviation, where: Any) -> None:
    """Raise `InputError` where an export is not the package's odometry."""
    largest = found.displacement_largest, found.position_largest
    if not (largest[0] <= DISPLACEMENT_LIMIT and largest[1] <= POSITION_LIMIT):
        problem = f"the conversion is off by {largest[0]:.2g} m a window, {largest[1]:.2g} m a walk"
        raise InputError(where, problem, "another version of jax2onnx may do better")
