"""Where the filter starts: from a known pose, or level from the first samples at rest."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.config import InitialStd
from gnio_jax.config.schema import TLIO_STD
from gnio_jax.filtering.checks import (
    check_finite,
    check_not_negative,
    check_rotation,
    checked_array,
)
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.lasting_errors import ENTRIES
from gnio_jax.filtering.state import (
    ACCEL_BIAS,
    ANCHOR,
    CLONE,
    CORE,
    GYRO_BIAS,
    THETA,
    VELOCITY,
    FilterState,
    FirstEstimates,
    GateState,
    ImuMemory,
)
from gnio_jax.numerics import finite_rows
from gnio_jax.types import GRAVITY, Array

_NEVER = -1
_SPEED_OF_SPREAD, _STILL_STD, _MOVING_STD = 1.5, 0.05, 1.0
"""Standard deviation of the velocity at a level start (ours): 1.5 s times the spread of the
accelerations, since walking shakes, between 0.05 and 1 m/s. OxIOD's people who spread theirs by 0.1
to 0.2 m/s² move at 0.08 m/s, by 0.3 to 0.5 m/s² at 0.6 m/s and by more than 0.8 m/s² at 0.9 m/s."""

REST_GYRO_STD = 0.01
"""Largest standard deviation of each gyro axis at rest, rad/s: a phone on a table, not in a hand.
"""
REST_ACCEL_STD = 0.1
"""Largest standard deviation of each accelerometer axis at rest, m/s²."""
REST_SECONDS = 1.0
"""Shortest rest from which a bias is taken, s; also what the tilt is taken from."""
LEAST_GRAVITY = 0.5 * GRAVITY
"""A mean acceleration below this does not show where up is, m/s² (ours)."""


# The arguments of the public functions carry no shapes for the run-time checker: a wrong one is the
# user's mistake and a ValueError.
def initial_state(
    config: FilterConfig,
    rotation: Any,
    velocity: Any,
    position: Any,
    gyro_bias: Any = 0,
    accel_bias: Any = 0,
    std: InitialStd = TLIO_STD,
) -> FilterState:
    """Start of the filter from a known pose, without clones.

    rotation (3, 3) body → world; velocity (3,) m/s and position (3,) m in the world frame;
    gyro_bias rad/s and accel_bias m/s², each (3,) or one number for all axes; std the standard
    deviations of their errors, independent of each other. Raises `ValueError` naming an argument of
    wrong shape or precision.
    """
    rotation = checked_array("rotation", rotation, (3, 3), config)
    dtype = rotation.dtype
    velocity, position, gyro_bias, accel_bias = (
        _checked_vector(name, value, dtype, config)
        for name, value in [
            ("velocity", velocity),
            ("position", position),
            ("gyro_bias", _on_all_axes(gyro_bias, dtype)),
            ("accel_bias", _on_all_axes(accel_bias, dtype)),
        ]
    )
    check_rotation("rotation", rotation)
    for name, value in std._asdict().items():
        check_not_negative(f"std.{name}", value)
    pose = _Pose(rotation, velocity, position, gyro_bias, accel_bias)
    return _without_clones(pose, std, config.clones, config.jacobians == "first")


class _Pose(NamedTuple):
    """Where the filter starts, in one precision; the arguments of `initial_state`."""

    rotation: Array
    velocity: Array
    position: Array
    gyro_bias: Array
    accel_bias: Array


# One program in place of thirty, which take three times as long when first called.
@functools.partial(jax.jit, static_argnames=("clones", "first_estimates"))
def _without_clones(
    pose: _Pose, std: InitialStd, clones: int, first_estimates: bool
) -> FilterState:
    dtype = pose.rotation.dtype
    nothing = jnp.zeros(3, dtype)
    first = FirstEstimates(pose.velocity, nothing, nothing, jnp.zeros((clones, 3), dtype))
    return FilterState(
        rotation=pose.rotation,
        velocity=pose.velocity,
        offset=nothing,
        gyro_bias=pose.gyro_bias,
        accel_bias=pose.accel_bias,
        anchor=pose.position,
        move=nothing,
        clone_rotation=jnp.tile(jnp.eye(3, dtype=dtype)[None], (clones, 1, 1)),
        clone_offset=jnp.zeros((clones, 3), dtype),
        lasting=jnp.zeros(0, dtype),
        core_covariance=jnp.diag(_core_std(std, dtype) ** 2),
        cross_covariance=jnp.zeros((CORE, CLONE * clones), dtype),
        clone_covariance=jnp.zeros((CLONE * clones, CLONE * clones), dtype),
        step=jnp.int32(0),
        gate=GateState(jnp.bool_(False), last_success=jnp.int32(_NEVER), pause_end=jnp.int32(0)),
        imu=_no_imu(dtype),
        healthy=jnp.bool_(True),
        first=first if first_estimates else None,
    )


def with_lasting_errors(state: FilterState) -> FilterState:
    """A state that knows nothing yet of the correlated errors of the windows, whose variances are
    one; a state that has them is as it was."""
    return state if len(state.lasting) else _with_lasting_errors(state)


@jax.jit
def _with_lasting_errors(state: FilterState) -> FilterState:
    dtype = state.offset.dtype
    return state._replace(
        lasting=jnp.zeros(ENTRIES, dtype),
        core_covariance=jnp.pad(state.core_covariance, (0, ENTRIES))
        + jnp.diag(jnp.pad(jnp.ones(ENTRIES, dtype), (CORE, 0))),
        cross_covariance=jnp.pad(state.cross_covariance, ((0, ENTRIES), (0, 0))),
    )


def _on_all_axes(value: Any, dtype: Any) -> Any:
    return jnp.full(3, value, dtype) if jnp.ndim(value) == 0 else value


def _checked_vector(name: str, value: Any, dtype: Any, config: FilterConfig) -> jax.Array:
    vector = checked_array(name, value, (3,), config).astype(dtype)
    check_finite(name, vector)
    return vector


def _core_std(std: InitialStd, dtype: Any) -> jax.Array:
    """(21,) standard deviations of the core's error: the whole uncertainty of the position is in
    the anchor, and there is no offset and no move yet."""
    tilt, yaw, velocity, position, gyro_bias, accel_bias = range(len(std))
    index = np.full(CORE, len(std))  # the zero behind them
    index[THETA] = tilt, tilt, yaw
    index[VELOCITY], index[ANCHOR] = velocity, position
    index[GYRO_BIAS], index[ACCEL_BIAS] = gyro_bias, accel_bias
    values = jnp.stack([jnp.asarray(value, dtype) for value in std])
    return jnp.append(values, 0.0)[index]


def _no_imu(dtype: Any) -> ImuMemory:
    unknown = jnp.full(3, jnp.nan, dtype)
    return ImuMemory(unknown, unknown, missing=jnp.int32(0), quiet=jnp.int32(0))


def level_state(
    config: FilterConfig, gyro: Any, accel: Any, std: InitialStd = TLIO_STD
) -> FilterState:
    """Start without a reference: tilt from gravity, yaw, velocity and position zero (ours).

    gyro rad/s and accel m/s² (m, 3), raw, are the first samples, of a second or so, in which the
    device should be still. Where they are not quiet by `rest_gyro` and `rest_accel`, the gyro turns
    the accelerations into the frame of the first sample before they are averaged: a hand that turns
    the phone takes gravity along. Where a second or more is as quiet as on a table, the bias of the
    gyro is its mean, as in `rest_at_start`; else it is zero.

    Of `std`, tilt and velocity are replaced: the tilt's is what the accelerometer's bias and the
    spread of what is averaged leave of the mean, over half a second to an independent sample; the
    velocity's is 0.05 m/s where that spread is that of a table, 1 m/s where it is a walker's, and
    between them in proportion. The yaw is zero by definition, so its own is kept. Raises
    `ValueError` naming an argument of wrong shape or precision or that is not finite.
    """
    samples = jnp.shape(accel)[0] if jnp.ndim(accel) else 0
    gyro = checked_array("gyro", gyro, (samples, 3), config)
    accel = checked_array("accel", accel, (samples, 3), config)
    if samples < 2:
        raise ValueError(f"accel: at least two samples are needed, found {samples}")
    check_finite("gyro", gyro)
    check_finite("accel", accel)
    independent = max(1.0, 2 * samples * config.dt)
    bias_std, quiet = jnp.asarray(std.accel_bias), (config.rest_gyro, config.rest_accel)
    long_enough = samples >= round(REST_SECONDS / config.dt)
    level = _levelled(gyro, accel, config.dt, bias_std, independent, quiet, long_enough)
    if not isinstance(level.up, Tracer) and (size := np.linalg.norm(level.up)) < LEAST_GRAVITY:
        problem = f"shows no gravity, its mean is {size:.2g} m/s²"
        raise ValueError(f"accel: {problem}; it must be in m/s² and include gravity")
    std = std._replace(tilt=level.tilt_std, velocity=level.velocity_std)
    nothing = np.zeros(3, accel.dtype)
    return initial_state(config, level.rotation, nothing, nothing, level.gyro_bias, std=std)


class _Level(NamedTuple):
    """What the samples of a level start show."""

    rotation: Array
    gyro_bias: Array
    tilt_std: Array
    velocity_std: Array
    up: Array
    """Mean acceleration, m/s²."""


# One program, as in `_without_clones`.
@jax.jit
def _levelled(
    gyro: Array,
    accel: Array,
    dt: Any,
    bias_std: Array,
    independent: Any,
    quiet_below: tuple[Any, Any],
    long_enough: Any,
) -> _Level:
    """Attitude from gravity, the gyro's bias, and the standard deviations of tilt and velocity."""
    of_gyro, of_accel = jnp.var(gyro, axis=0), jnp.var(accel, axis=0)
    at_rest = jnp.all(of_gyro <= REST_GYRO_STD**2) & jnp.all(of_accel <= REST_ACCEL_STD**2)
    gyro_bias = jnp.where(at_rest & long_enough, gyro.mean(0), 0.0)
    quiet = (of_gyro.sum() < quiet_below[0] ** 2) & (of_accel.sum() < quiet_below[1] ** 2)
    attitudes = geometry.integrate_turns(jnp.eye(3, dtype=gyro.dtype), gyro[:-1] * dt)
    # A quiet gyro shows its bias alone.
    accel = jnp.where(quiet, accel, jnp.einsum("ijn,nj->ni", attitudes, accel))
    variance, up = jnp.sum(jnp.var(accel, axis=0)), accel.mean(0)
    mean_error = jnp.sqrt(bias_std**2 + variance / independent)
    # Bounded before the root, whose slope at zero is infinite.
    velocity = jnp.clip(_SPEED_OF_SPREAD**2 * variance, _STILL_STD**2, _MOVING_STD**2)
    return _Level(
        rotation=geometry.level(up),
        gyro_bias=gyro_bias,
        tilt_std=mean_error / GRAVITY,
        velocity_std=jnp.sqrt(velocity),
        up=up,
    )


class Rest(NamedTuple):
    """The gyro while the device rests at the start."""

    gyro_bias: Float[np.ndarray, "3"]
    """Its mean, rad/s; zero where there is no rest."""
    seconds: float
    """How long it rests, in whole seconds."""


def rest_at_start(
    gyro: Float[np.ndarray, "m 3"], accel: Float[np.ndarray, "m 3"], dt: float
) -> Rest:
    """The whole seconds at the start in which raw gyro (rad/s) and accel (m/s²) are as quiet as on
    a table (ours). NaN: a sample is missing; a second that lacks more than half of them is not."""
    second, rest = round(REST_SECONDS / dt), 0
    there = finite_rows(gyro) & finite_rows(accel)
    while rest + second <= len(gyro):
        rows = rest + np.flatnonzero(there[rest : rest + second])
        if 2 * len(rows) < second or gyro[rows].std(0).max() > REST_GYRO_STD:
            break
        if accel[rows].std(0).max() > REST_ACCEL_STD:
            break
        rest += second
    bias = gyro[:rest][there[:rest]].mean(0) if rest else np.zeros(3)
    return Rest(np.asarray(bias, np.float64), rest * dt)


def rest_state(
    config: FilterConfig,
    gyro: Float[np.ndarray, "m 3"],
    accel: Float[np.ndarray, "m 3"],
    std: InitialStd = TLIO_STD,
) -> FilterState:
    """Start from the first samples, raw, in which the device should lie still: `level_state` of the
    first second, and the gyro's bias where it rests (`rest_at_start`)."""
    second = slice(max(round(REST_SECONDS / config.dt), 2))
    state = level_state(config, gyro[second], accel[second], std)
    bias = rest_at_start(gyro, accel, config.dt).gyro_bias
    return state._replace(gyro_bias=jnp.asarray(bias, state.gyro_bias.dtype))
