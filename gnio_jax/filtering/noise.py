"""The filter's noises: of the IMU, and of the start."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.filtering.lasting_errors import LastingErrors
from gnio_jax.types import Array


class NoiseModel(NamedTuple):
    """White noise of the IMU as densities, so that it does not depend on the rate, and random walks
    of its biases, each a scalar; and the errors of the displacements that are not white.

    The defaults are TLIO's per-sample values, tuned at about 1 kHz, as densities.
    """

    gyro_density: Float[Array, ""] | float = 3.16e-4
    """rad/s/√Hz"""
    accel_density: Float[Array, ""] | float = 1.0e-3
    """m/s²/√Hz"""
    gyro_bias_walk: Float[Array, ""] | float = 1e-6
    """rad/s/√s"""
    accel_bias_walk: Float[Array, ""] | float = 1e-4
    """m/s²/√s"""
    std_factor: tuple[Any, Any, Any] = (1.0, 1.0, 1.0)
    """Factors of the displacements' standard deviations along x, y, z of their yaw frame (ours):
    what calibration finds that they lack."""
    displacement: LastingErrors | None = None
    """Errors of the displacements that last, as entries of the filter's state; None: all of them
    are white."""

    @classmethod
    def per_sample(
        cls,
        gyro_std: Any,
        accel_std: Any,
        dt: Any,
        gyro_bias_walk: Any = 1e-6,
        accel_bias_walk: Any = 1e-4,
    ) -> NoiseModel:
        """From the standard deviation of one sample, rad/s and m/s², at `dt` seconds per sample:
        density = σ √dt."""
        root = jnp.sqrt(jnp.asarray(dt))
        return cls(gyro_std * root, accel_std * root, gyro_bias_walk, accel_bias_walk)


class InitialStd(NamedTuple):
    """Standard deviations at the start, each a scalar; the defaults are TLIO's."""

    tilt: Float[Array, ""] | float = math.radians(1.0)
    """Rotation about the world's x and y, rad."""
    yaw: Float[Array, ""] | float = math.radians(0.1)
    """Rotation about the world's z, rad."""
    velocity: Float[Array, ""] | float = 1.0
    """m/s"""
    position: Float[Array, ""] | float = 1e-3
    """m"""
    gyro_bias: Float[Array, ""] | float = 1e-4
    """rad/s"""
    accel_bias: Float[Array, ""] | float = 0.02
    """m/s²"""


TLIO_STD = InitialStd()
