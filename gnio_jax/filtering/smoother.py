"""Fixed-interval smoothing (ours): every estimate of the filter corrected by all that was measured
after it, for use offline.

A displacement ties the present to a pose of a second ago, so the error that must be smoothed is the
augmented one, clones and all. Its covariance is singular, because the newest clone duplicates the
core's pose, and is never inverted in the modified Bryson–Frazier form (Bierman 1973): with the
filter's error e ~ N(0, P) after step k, what the later measurements say of it is

    e | all ~ N(−P λ, P − P Λ P),

and the adjoint λ, Λ runs backwards from zero over updates and propagations (see `adjoint`).

Everything is linear about the filter's own estimates, as in any extended smoother: Jacobians are
not taken anew at the smoothed ones, and that R ← exp(δθ) R turns the frame of the rotation's error
by δθ, a second-order term, is left out as in the filter.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from gnio_jax import geometry
from gnio_jax.config import ConsideredStd, NoiseModel
from gnio_jax.filtering.adjoint import (
    Adjoint,
    before_propagation,
    before_update,
    no_adjoint,
    without_anchor,
)
from gnio_jax.filtering.checkpointing import join_blocks, split_blocks
from gnio_jax.filtering.config import FilterConfig, YawFrame
from gnio_jax.filtering.considered import (
    ENTRIES,
    OF_BIAS,
    check_considered,
    considered_covariance,
    disturbed,
    of_error,
)
from gnio_jax.filtering.displacement import Measurement, scaled_measurement
from gnio_jax.filtering.gaps import Imu, bridge
from gnio_jax.filtering.history import FilterHistory
from gnio_jax.filtering.inputs import (
    Signals,
    checked_displacements,
    checked_inputs,
    checked_measurements,
)
from gnio_jax.filtering.scan import interval_inputs
from gnio_jax.filtering.state import (
    ACCEL_BIAS,
    ANCHOR,
    CLONE,
    GYRO_BIAS,
    LOCAL,
    OFFSET,
    THETA,
    VELOCITY,
    FilterState,
    Mean,
)
from gnio_jax.filtering.step import StepTrace, traced_clone_step
from gnio_jax.geometry import matmul
from gnio_jax.types import Array


class SmoothedHistory(NamedTuple):
    """The smoothed estimates of K clone intervals: row k is at t_0 + (k + 1)·n·dt, as in
    `FilterHistory`."""

    rotation: Float[Array, "k 3 3"]
    """Body → world."""
    velocity: Float[Array, "k 3"]
    """World frame, m/s."""
    position: Float[Array, "k 3"]
    """World frame, m."""
    gyro_bias: Float[Array, "k 3"]
    """rad/s"""
    accel_bias: Float[Array, "k 3"]
    """m/s²"""
    covariance_diagonal: Float[Array, "k 15"]
    """Variances of θ, v, p, b_g, b_a."""
    covariance: Float[Array, "k 15 15"] | None
    """The whole block where `FilterConfig.history` is "core", else None."""


def smooth(
    state: FilterState,
    gyro: Any,
    accel: Any,
    displacement: Any,
    covariance: Any,
    config: FilterConfig,
    noise: NoiseModel,
    imu_valid: Any = None,
    considered: ConsideredStd | None = None,
) -> SmoothedHistory:
    """Filter K clone intervals as `run_filter` does, then smooth: each row is the estimate given
    all measurements of the interval.

    Arguments and `ValueError`s as of `run_filter`, whose updates are smoothed exactly as they were
    made: gate, scaled or weighted covariances, zero velocity and bridged samples included. `state`
    is the prior, and what was measured before it is not touched. After `run_odometry`, use
    `smooth_odometry`. Works under `jax.jit`, `jax.vmap` and `jax.grad`.

    Memory: about K · (18 m + 500) numbers, m = 18 + 6 (W + 1): 26 kB for each interval at W = 20,
    in float64. With `config.checkpoint_every` = E the filter's states, m² numbers each, are kept at
    every E-th interval only, and E intervals at a time are filtered once more on the way back: (K /
    E) · m² + E · (18 m + 500). Smoothed variances are differences: in float32 one that is lowered
    by many orders of magnitude, as at the start, has few digits left and can come out below zero.

    With errors that are `considered` the covariances are P + S C Sᵀ, S the derivative of the whole
    smoother (see `considered`); the estimates are as without. It takes up to seven times the
    memory.
    """
    state, signals, noise = checked_inputs(state, gyro, accel, imu_valid, config, noise)
    measured = checked_measurements(displacement, covariance, signals, config)
    if considered is None:
        return _smooth(state, signals, *measured, config, noise, "given")
    check_considered(considered)
    return _smooth_considering(considered, state, signals, *measured, config, noise, "given")


def smooth_odometry(
    state: FilterState,
    gyro: Any,
    accel: Any,
    history: FilterHistory,
    config: FilterConfig,
    noise: NoiseModel,
    imu_valid: Any = None,
    considered: ConsideredStd | None = None,
) -> SmoothedHistory:
    """Smooth a run of `run_odometry`, whose arguments these are, with the `history` that it left.

    The network is not called again: the filter's updates are repeated with the displacements of
    the history, which are told in the filter's own yaw frame. All else as in `smooth`. Raises
    `ValueError` as `run_odometry` does, or if the history is not as long as the signals.
    """
    state, signals, noise = checked_inputs(state, gyro, accel, imu_valid, config, noise)
    given = history.displacement, history.measurement_std
    displacement, std = checked_displacements(*given, signals, config)
    # The history's are scaled already.
    one = jnp.ones((), std.dtype)
    noise = noise._replace(std_factor=(one, one, one), measurement_scale=one)
    covariance = jax.vmap(jnp.diag)(std**2)
    frame = config.displacement_frame
    if considered is None:
        return _smooth(state, signals, displacement, covariance, config, noise, frame)
    check_considered(considered)
    measured = displacement, covariance
    return _smooth_considering(considered, state, signals, *measured, config, noise, frame)


class _Inputs(NamedTuple):
    """What a step forward takes, or K of them stacked."""

    slot: Int[Array, "*k"]
    """Of the ring, for the clone at the end of the interval."""
    imu: Imu
    measurement: Measurement


class _ForwardStep(NamedTuple):
    """What the way back needs of one step forward."""

    slot: Int[Array, "*k"]
    mean: Mean
    """After the step."""
    covariance: Array
    """Of θ, v, p, b_g, b_a, or its diagonal."""
    cross: Float[Array, "*k 15 m"]
    """P of those against all that the adjoint runs over."""
    trace: StepTrace


class _Smoothed(NamedTuple):
    """The smoothed estimate after one step, or K of them stacked."""

    mean: Mean
    covariance: Array
    """Of θ, v, p, b_g, b_a, or its diagonal."""


@functools.partial(jax.jit, static_argnames=("config", "frame"))
def _smooth(
    state: FilterState,
    signals: Signals,
    displacement: Array,
    covariance: Array,
    config: FilterConfig,
    noise: NoiseModel,
    frame: YawFrame,
) -> SmoothedHistory:
    scale = functools.partial(scaled_measurement, noise=noise)
    measurements = jax.vmap(scale)(displacement, covariance)
    stream, _, _ = bridge(*signals, state.imu, config)
    numbers, by_interval = interval_inputs(stream, config)
    inputs = _Inputs(numbers % config.clones, by_interval, measurements)
    forward = functools.partial(_forward, config=config, noise=noise, frame=frame)
    backward = functools.partial(_backward, config=config)
    nothing = no_adjoint(config.clones, len(state.lasting), displacement.dtype)

    def there_and_back(
        state: FilterState, adjoint: Adjoint, inputs: _Inputs
    ) -> tuple[Adjoint, _Smoothed]:
        _, steps = jax.lax.scan(forward, state, inputs)
        return jax.lax.scan(backward, adjoint, steps, reverse=True)

    every = config.checkpoint_every
    if every == 0 or every >= len(numbers):
        _, smoothed = there_and_back(state, nothing, inputs)
    else:
        smoothed = _smooth_in_blocks(there_and_back, forward, state, nothing, inputs, every)
    return _smoothed_history(smoothed, config)


@functools.partial(jax.jit, static_argnames=("config", "frame"))
def _smooth_considering(
    considered: ConsideredStd,
    state: FilterState,
    signals: Signals,
    displacement: Array,
    covariance: Array,
    config: FilterConfig,
    noise: NoiseModel,
    frame: YawFrame,
) -> SmoothedHistory:
    """`_smooth`, with the errors that are considered in its covariances."""

    def means(c: Float[Array, "6"]) -> tuple[Mean, SmoothedHistory]:
        start = state._replace(gyro_bias=state.gyro_bias + c[OF_BIAS])
        told = disturbed(displacement, c)
        found = _smooth(start, signals, told, covariance, config, noise, frame)
        return Mean(*(getattr(found, name) for name in Mean._fields)), found

    nothing = jnp.zeros(ENTRIES, displacement.dtype)
    derivatives, smoothed = jax.jacfwd(means, has_aux=True)(nothing)
    added = considered_covariance(of_error(smoothed.rotation, derivatives), considered)
    variances = smoothed.covariance_diagonal + jnp.diagonal(added, axis1=1, axis2=2)
    whole = None if smoothed.covariance is None else smoothed.covariance + added
    return smoothed._replace(covariance_diagonal=variances, covariance=whole)


def _smooth_in_blocks(
    there_and_back: Callable[..., tuple[Adjoint, _Smoothed]],
    forward: Callable,
    state: FilterState,
    adjoint: Adjoint,
    inputs: _Inputs,
    every: int,
) -> _Smoothed:
    """Keep the state before every block of `every` steps, and filter each block once more on the
    way back."""
    there_and_back = jax.checkpoint(there_and_back, prevent_cse=False)
    blocks, rest = split_blocks(inputs, every)

    def filter_block(state: FilterState, block: _Inputs) -> tuple[FilterState, FilterState]:
        return jax.lax.scan(forward, state, block)[0], state

    def smooth_block(adjoint: Adjoint, start: tuple) -> tuple[Adjoint, _Smoothed]:
        state, block = start
        return there_and_back(state, adjoint, block)

    last, starts = jax.lax.scan(filter_block, state, blocks)
    smoothed_rest = None
    if rest is not None:
        adjoint, smoothed_rest = there_and_back(last, adjoint, rest)
    _, smoothed = jax.lax.scan(smooth_block, adjoint, (starts, blocks), reverse=True)
    return join_blocks(smoothed, smoothed_rest)


def _forward(
    state: FilterState,
    inputs: _Inputs,
    config: FilterConfig,
    noise: NoiseModel,
    frame: YawFrame,
) -> tuple[FilterState, _ForwardStep]:
    """One step of the filter, and what the way back needs of it."""

    def measure(_state: FilterState, _oldest: Array | int) -> tuple[Measurement, dict]:
        return inputs.measurement, {}

    state, record, trace = traced_clone_step(
        state, inputs.imu, measure, inputs.slot, config, noise, frame
    )
    core, clones = (
        part[LOCAL].at[OFFSET].add(part[ANCHOR])
        for part in map(jnp.asarray, (state.core_covariance, state.cross_covariance))
    )
    cross = jnp.concatenate([without_anchor(core), clones], axis=1)
    return state, _ForwardStep(inputs.slot, record.mean, record.covariance, cross, trace)


def _backward(
    adjoint: Adjoint, step: _ForwardStep, config: FilterConfig
) -> tuple[Adjoint, _Smoothed]:
    """The smoothed estimate after a step, and the adjoint before it."""
    over = step.cross @ adjoint.matrix
    error = -(step.cross @ adjoint.vector)
    if config.history == "core":
        covariance = step.covariance - over @ step.cross.T
    else:
        covariance = step.covariance - jnp.sum(over * step.cross, axis=1)
    smoothed = _Smoothed(_corrected(step.mean, error), covariance)
    oldest = CLONE * ((step.slot + 1) % config.clones)
    for correction in reversed(step.trace.corrections):
        adjoint = before_update(adjoint, correction, oldest)
    return before_propagation(adjoint, step.trace.transition, step.trace.decay, step.slot), smoothed


def _corrected(mean: Mean, error: Float[Array, "15"]) -> Mean:
    """With an error in θ, v, p, b_g, b_a added: p takes the place of o."""
    return Mean(
        rotation=matmul(geometry.exp(error[THETA]), mean.rotation),
        velocity=mean.velocity + error[VELOCITY],
        position=mean.position + error[OFFSET],
        gyro_bias=mean.gyro_bias + error[GYRO_BIAS],
        accel_bias=mean.accel_bias + error[ACCEL_BIAS],
    )


def _smoothed_history(smoothed: _Smoothed, config: FilterConfig) -> SmoothedHistory:
    covariance, whole = smoothed.covariance, config.history == "core"
    diagonal = jnp.diagonal(covariance, axis1=1, axis2=2) if whole else covariance
    return SmoothedHistory(
        *smoothed.mean, covariance_diagonal=diagonal, covariance=covariance if whole else None
    )
