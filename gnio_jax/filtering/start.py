"""The start of the filter: from a known pose, or level from the first samples at rest.

The definition of rest depends on its use:

- The mean of the gyro is its bias if the device is as quiet as on a table: over a second no axis
  has a standard deviation above `REST_GYRO_STD` and `REST_ACCEL_STD` (`rest_at_start`).
- The accelerations of a level start are averaged without rotation if the standard deviations, added
  in quadrature over the axes, are below `FilterConfig.rest_gyro` and `rest_accel`. Deviations are
  taken from the mean, because no bias is known yet; a turn at a constant rate shows in the
  accelerations.
- The velocity is zero if no single sample differs from the estimated biases by more than those
  bounds (`zero_velocity.detect_rest`).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.config.schema import NOT_NEGATIVE
from gnio_jax.filtering.checks import (
    as_array,
    check_bounds,
    check_filter,
    check_numbers,
    check_rotation,
    checked_array,
    count_rows,
)
from gnio_jax.filtering.filter import Filter
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import FilterState, Mean, without_clones
from gnio_jax.numerics import finite_rows
from gnio_jax.types import GRAVITY, Array

_SPEED_OF_SPREAD, _STILL_STD, _MOVING_STD = 1.5, 0.05, 1.0
"""Standard deviation of the velocity at a level start (ours): 1.5 s times the spread of the
accelerations, which grows with the speed of walking, between 0.05 and 1 m/s. In OxIOD,
accelerations that spread by 0.1 to 0.2 m/s² come with a speed of 0.08 m/s, those by 0.3 to 0.5 m/s²
with 0.6 m/s, and those by more than 0.8 m/s² with 0.9 m/s."""

REST_GYRO_STD = 0.01
"""Largest standard deviation of each gyro axis at rest, rad/s: a phone on a table, not in a hand.
"""
REST_ACCEL_STD = 0.1
"""Largest standard deviation of each accelerometer axis at rest, m/s²."""
REST_SECONDS = 1.0
"""Shortest rest that gives a bias, s; the tilt is also taken from this time."""
LEAST_GRAVITY = 0.5 * GRAVITY
"""A mean acceleration below this does not show the vertical, m/s² (ours)."""
_LEAST_ERROR = 1e-6
"""Least standard deviation of the mean acceleration, m/s²."""


class NoGravity(ValueError):
    """Samples whose mean acceleration does not show the vertical."""


# The arguments of the public functions have no shapes for the run-time checker: a wrong shape is
# the user's mistake and a ValueError.
def initial_state(
    ekf: Filter,
    rotation: Any,
    velocity: Any,
    position: Any,
    gyro_bias: Any = 0,
    accel_bias: Any = 0,
    level_gyro_bias: Any = None,
) -> FilterState:
    """Start of the filter from a known pose, without clones.

    Gravity shows the level components of a gyro bias to the filter. Without a rest and without
    fixes, only the displacements show the vertical one, and their errors are temporally correlated:
    a filter that learns it from them loses the yaw.

    Args:
        ekf: The filter. `ekf.start` has the standard deviations of the errors of all values here,
            which are independent.
        rotation: (3, 3) body → world.
        velocity: (3,) world frame, m/s.
        position: (3,) world frame, m.
        gyro_bias: (3,) body frame, rad/s, or one number for all axes.
        accel_bias: (3,) body frame, m/s², or one number for all axes.
        level_gyro_bias: Standard deviation of the two components of the gyro bias that are level at
            the start, rad/s (ours, for a raw gyro); None: `ekf.start.gyro_bias`.

    Raises:
        ValueError: An argument has the wrong shape or precision.
    """
    check_filter(ekf)
    config = ekf.config
    rotation = checked_array("rotation", rotation, (3, 3), config)
    check_rotation("rotation", rotation)
    parts = {"velocity": velocity, "position": position}
    biases = {"gyro_bias": gyro_bias, "accel_bias": accel_bias}
    for name, value in biases.items():
        bias = as_array(name, value)
        parts[name] = bias if bias.ndim else jnp.full(3, bias, rotation.dtype)
    vectors = [
        checked_array(name, value, (3,), config).astype(rotation.dtype)
        for name, value in parts.items()
    ]
    check_numbers("ekf.start", ekf.start)
    check_bounds("level_gyro_bias", level_gyro_bias, [NOT_NEGATIVE])
    return without_clones(Mean(rotation, *vectors), ekf.start, config.clones, level_gyro_bias)


def level_state(ekf: Filter, gyro: Any, accel: Any) -> FilterState:
    """Start without a reference: tilt from gravity, yaw, velocity and position zero (ours).

    gyro rad/s and accel m/s² (m, 3), raw, are the first samples, of a second or so, in which the
    device should be still. If their standard deviations are not below `rest_gyro` and `rest_accel`,
    the accelerations are rotated by the gyro into the frame of the first sample before they are
    averaged, because a hand may turn the phone. If a second or more is as quiet as on a table, the
    bias of the gyro is its mean, as in `rest_at_start`; otherwise it is zero.

    The standard deviations of tilt and velocity are not those of `ekf.start`. That of the tilt
    follows from the accelerometer's bias and from the spread of the averaged accelerations, with
    one independent sample per half second. That of the velocity is proportional to this spread,
    from 0.05 m/s on a table to 1 m/s for a walker. The yaw is zero by definition, so it keeps that
    of `ekf.start`. Raises `ValueError` naming an argument of wrong shape or precision, that is not
    finite, or that shows no gravity (`NoGravity`); inside `jax.jit` the attitude is then NaN.
    """
    check_filter(ekf)
    config, std = ekf.config, ekf.start
    gyro, accel = as_array("gyro", gyro), as_array("accel", accel)
    samples = count_rows(accel)
    gyro = checked_array("gyro", gyro, (samples, 3), config)
    accel = checked_array("accel", accel, (samples, 3), config)
    if samples < 2:
        raise ValueError(f"accel: at least two samples are needed, found {samples}")
    rotation, gyro_bias, tilt_std, velocity_std, up = _level(
        gyro, accel, jnp.asarray(std.accel_bias), config
    )
    if not isinstance(up, Tracer) and (size := np.linalg.norm(up)) < LEAST_GRAVITY:
        problem = f"shows no gravity, its mean is {size:.2g} m/s²"
        raise NoGravity(f"accel: {problem}; it must be in m/s² and include gravity")
    ekf = dataclasses.replace(ekf, start=std._replace(tilt=tilt_std, velocity=velocity_std))
    zeros = np.zeros(3, accel.dtype)
    return initial_state(ekf, rotation, zeros, zeros, gyro_bias)


# jit: one compiled program, as in `without_clones`.
@functools.partial(jax.jit, static_argnames="config")
def _level(
    gyro: Array, accel: Array, bias_std: Array, config: FilterConfig
) -> tuple[Array, Array, Array, Array, Array]:
    """The attitude from gravity, the gyro's bias, the standard deviations of tilt and velocity, and
    the mean acceleration, m/s²."""
    of_gyro, of_accel = jnp.var(gyro, axis=0), jnp.var(accel, axis=0)
    on_a_table = jnp.all(of_gyro <= REST_GYRO_STD**2) & jnp.all(of_accel <= REST_ACCEL_STD**2)
    long_enough = len(gyro) >= round(REST_SECONDS / config.dt)
    gyro_bias = jnp.where(on_a_table & long_enough, gyro.mean(0), 0.0)
    quiet = of_gyro.sum() < config.rest_gyro**2
    quiet = quiet & (of_accel.sum() < config.rest_accel**2)
    attitudes = geometry.integrate_turns(jnp.eye(3, dtype=gyro.dtype), gyro[:-1] * config.dt)
    # A gyro at rest measures only its bias.
    accel = jnp.where(quiet, accel, jnp.einsum("ijn,nj->ni", attitudes, accel))
    variance, up = jnp.sum(jnp.var(accel, axis=0)), accel.mean(0)
    independent = max(1.0, 2 * len(gyro) * config.dt)
    # Both values are bounded before the root, whose slope at zero is infinite.
    mean_variance = jnp.maximum(bias_std**2 + variance / independent, _LEAST_ERROR**2)
    velocity = jnp.clip(_SPEED_OF_SPREAD**2 * variance, _STILL_STD**2, _MOVING_STD**2)
    rotation = jnp.where(jnp.sum(up**2) < LEAST_GRAVITY**2, jnp.nan, geometry.level(up))
    return rotation, gyro_bias, jnp.sqrt(mean_variance) / GRAVITY, jnp.sqrt(velocity), up


class Rest(NamedTuple):
    """The gyro while the device rests at the start."""

    gyro_bias: Float[np.ndarray, "3"]
    """Its mean, rad/s; zero where there is no rest."""
    seconds: float
    """Duration of the rest, in whole seconds."""


def rest_at_start(
    gyro: Float[np.ndarray, "m 3"], accel: Float[np.ndarray, "m 3"], dt: float
) -> Rest:
    """The whole seconds at the start in which raw gyro (rad/s) and accel (m/s²) are as quiet as on
    a table (ours). NaN means that a sample is missing; a second without more than half of its
    samples is not quiet."""
    second, end = round(REST_SECONDS / dt), 0
    present = finite_rows(gyro) & finite_rows(accel)
    while end + second <= len(gyro):
        rows = end + np.flatnonzero(present[end : end + second])
        if 2 * len(rows) < second or gyro[rows].std(0).max() > REST_GYRO_STD:
            break
        if accel[rows].std(0).max() > REST_ACCEL_STD:
            break
        end += second
    bias = gyro[:end][present[:end]].mean(0) if end else np.zeros(3)
    return Rest(np.asarray(bias, np.float64), end * dt)
