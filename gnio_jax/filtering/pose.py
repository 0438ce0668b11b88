"""What the tracker hands out: a pose, and the one vector in which it leaves the device."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.filtering.history import FilterHistory
from gnio_jax.filtering.state import FilterState, core_covariance
from gnio_jax.types import Array

_SHAPES = {
    "rotation": (3, 3),
    "velocity": (3,),
    "position": (3,),
    "gyro_bias": (3,),
    "accel_bias": (3,),
    "covariance": (15, 15),
    "accepted": (),
    "nis": (),
    "healthy": (),
}
"""What a program hands over, laid into one vector: one transfer a step."""
_ENDS = np.cumsum([math.prod(shape) for shape in _SHAPES.values()]).tolist()
_SLICES = {
    name: slice(end - math.prod(shape), end)
    for (name, shape), end in zip(_SHAPES.items(), _ENDS, strict=True)
}
POSE_LENGTH = _ENDS[-1]

PoseVector = Float[Array, "l"]
"""A `Pose` without its time, `POSE_LENGTH` numbers."""


class Pose(NamedTuple):
    """What is known at one time. Host arrays."""

    time: float
    """s, on the clock of the stamps."""
    rotation: Float[np.ndarray, "3 3"]
    """Body → world."""
    velocity: Float[np.ndarray, "3"]
    """World frame, m/s."""
    position: Float[np.ndarray, "3"]
    """World frame, m."""
    gyro_bias: Float[np.ndarray, "3"]
    """rad/s"""
    accel_bias: Float[np.ndarray, "3"]
    """m/s²"""
    covariance: Float[np.ndarray, "15 15"]
    """Of the error in θ (world frame, left), v, p, b_g, b_a; with the errors that the tracker
    considers, if any."""
    accepted: float
    """Of the last clone step: 1 its measurement was used, 0 it was not, NaN there was none."""
    nis: float
    """Of the last clone step: rᵀ S⁻¹ r of its measurement; NaN where there was none."""
    healthy: bool
    """False once a clone step left a state that is not finite, a negative variance or a speed
    above `FilterConfig.speed_limit`: all since is void."""


def pose_parts(vector: PoseVector) -> dict[str, Array]:
    """The named parts of a pose vector."""
    return {name: vector[_SLICES[name]].reshape(shape) for name, shape in _SHAPES.items()}


def pose_from_vector(vector: np.ndarray, time: float) -> Pose:
    """On the host."""
    parts = pose_parts(vector)
    flags = {name: parts.pop(name).item() for name in ("accepted", "nis", "healthy")}
    healthy = flags.pop("healthy") > 0
    return Pose(time, **parts, **flags, healthy=healthy)


def history_vector(history: FilterHistory) -> PoseVector:
    """That of the only row of a history."""
    return jnp.concatenate([getattr(history, name).reshape(-1) for name in _SHAPES])


def start_vector(state: FilterState, dtype: np.dtype) -> np.ndarray:
    """That of a start, when there has been no measurement yet."""
    parts = (*state.mean, core_covariance(state.core_covariance))
    flags = [math.nan, math.nan, float(state.healthy)]
    return np.concatenate([*(np.asarray(part).reshape(-1) for part in parts), flags], dtype=dtype)


def moved_vector(
    vector: PoseVector,
    rotation: Float[Array, "3 3"],
    velocity: Float[Array, "3"],
    position: Float[Array, "3"],
    covariance: Float[Array, "15 15"],
) -> PoseVector:
    """With another pose and covariance, all else as it is."""
    moved = {
        "rotation": rotation,
        "velocity": velocity,
        "position": position,
        "covariance": covariance,
    }
    return _vector(pose_parts(vector) | moved)


def widened_vector(vector: PoseVector, added: Float[Array, "15 15"]) -> PoseVector:
    """With `added` to the covariance, all else as it is."""
    parts = pose_parts(vector)
    return _vector(parts | {"covariance": parts["covariance"] + added})


def _vector(parts: dict[str, Array]) -> PoseVector:
    return jnp.concatenate([parts[name].reshape(-1) for name in _SHAPES])
