"""Random changes of training windows, each a pure function of (key, batch) (TLIO's; GNIO's paper is
silent on them).

They act on the rotated windows in TLIO's order: bias, then tilt, then yaw, noise last. float32
throughout.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from gnio_jax.config import AugmentConfig
from gnio_jax.types import Windows
from gnio_jax.windows import rotate_channels, rotate_vectors


def bias(key: PRNGKeyArray, windows: Windows, gyro: float, accel: float) -> Windows:
    """Add a constant bias per window, uniform in ±`gyro` rad/s and ±`accel` m/s² per axis."""
    half_width = jnp.array([accel] * 3 + [gyro] * 3, jnp.float32)
    offset = _uniform(key, (windows.imu.shape[0], 1, 6), -1.0, 1.0) * half_width[None, None, :]
    return windows._replace(imu=windows.imu + offset)


def tilt(key: PRNGKeyArray, windows: Windows, degrees: float) -> Windows:
    """Turn the IMU by up to `degrees` about a random horizontal axis: a wrong gravity direction.
    The target stays."""
    heading_key, angle_key = jax.random.split(key)
    count = windows.imu.shape[0]
    heading = _uniform(heading_key, (count,), 0.0, 2 * jnp.pi)
    angle = _uniform(angle_key, (count,), 0.0, math.radians(degrees))
    x, y, c, s = jnp.cos(heading), jnp.sin(heading), jnp.cos(angle), jnp.sin(angle)
    # Rodrigues' formula for the unit axis (x, y, 0).
    rotation = jnp.stack(
        [
            c + x * x * (1 - c),
            x * y * (1 - c),
            y * s,
            x * y * (1 - c),
            c + y * y * (1 - c),
            -x * s,
            -y * s,
            x * s,
            c,
        ],
        axis=-1,
    ).reshape(count, 3, 3)
    return windows._replace(imu=rotate_channels(rotation, windows.imu))


def yaw(key: PRNGKeyArray, windows: Windows) -> Windows:
    """Turn window and target together by a uniform yaw: the network must not depend on the choice
    of heading."""
    count = windows.imu.shape[0]
    angle = _uniform(key, (count,), 0.0, 2 * jnp.pi)
    c, s, zero, one = (
        jnp.cos(angle),
        jnp.sin(angle),
        jnp.zeros(count, jnp.float32),
        jnp.ones(count, jnp.float32),
    )
    rotation = jnp.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(count, 3, 3)
    target = jnp.einsum(
        "bij,bj->bi", rotation, windows.displacement, precision=jax.lax.Precision.HIGHEST
    )
    return Windows(
        rotate_channels(rotation, windows.imu),
        target,
        rotate_vectors(rotation, windows.steps[:, :, None])[:, :, 0],
    )


def noise(key: PRNGKeyArray, windows: Windows, gyro: float, accel: float) -> Windows:
    """Add white noise of standard deviation `gyro` rad/s and `accel` m/s²."""
    std = jnp.array([accel] * 3 + [gyro] * 3, jnp.float32)
    return windows._replace(
        imu=windows.imu
        + std[None, None, :] * jax.random.normal(key, windows.imu.shape, jnp.float32)
    )


def augment(key: PRNGKeyArray, windows: Windows, config: AugmentConfig) -> Windows:
    """Every augmentation that `config` switches on, each with its own key. `config` is static."""
    bias_key, tilt_key, yaw_key, noise_key = jax.random.split(key, 4)
    if config.gyro_bias or config.accel_bias:
        windows = bias(bias_key, windows, config.gyro_bias, config.accel_bias)
    if config.tilt_degrees:
        windows = tilt(tilt_key, windows, config.tilt_degrees)
    if config.yaw:
        windows = yaw(yaw_key, windows)
    if any(config.noise):
        windows = noise(noise_key, windows, *config.noise)
    return windows


def _uniform(key: PRNGKeyArray, shape: tuple[int, ...], low: float, high: float) -> jax.Array:
    # Plain numbers as limits would be float64 inside where that is switched on.
    return jax.random.uniform(key, shape, jnp.float32, jnp.float32(low), jnp.float32(high))
