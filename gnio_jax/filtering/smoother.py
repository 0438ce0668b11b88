"""Fixed-interval smoothing (ours): every estimate of the filter corrected by all that was measured
after it, for use offline.

A displacement ties the present to a pose of a second ago, so the error that must be smoothed is the
augmented one, clones and all. Its covariance is singular, because the newest clone duplicates the
core's pose, and is never inverted in the modified Bryson–Frazier form (Bierman 1973): with the
filter's error e ~ N(0, P) after step k, what the later measurements say of it is

    e | all ~ N(−P λ, P − P Λ P),

and the adjoint λ, Λ runs backwards from zero. Back over an update with S = L Lᵀ, M = L⁻¹ H, Y = M
P,

    λ ← λ − Mᵀ (Y λ + L⁻¹ r),   Λ ← (I − Yᵀ M)ᵀ Λ (I − Yᵀ M) + Mᵀ M,

and over a propagation with the augmented transition F, which puts the core's pose into a slot of
the ring over the oldest clone,

    λ ← Fᵀ λ,   Λ ← Fᵀ Λ F:

what the later measurements say of the clone goes over onto the pose, and of the clone that it
displaced they say nothing. What the filter did not apply leaves no term, and what it weighed has
that weight. No measurement touches the anchor, so λ and Λ are zero there and leave it out: the
growing variance of the position meets only differences.

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
import numpy as np
from jaxtyping import Float, Int

from gnio_jax import geometry
from gnio_jax.filtering.checkpointing import join_blocks, split_blocks
from gnio_jax.filtering.checks import checked_array
from gnio_jax.filtering.config import FilterConfig, YawFrame
from gnio_jax.filtering.displacement import Measurement, scaled_measurement
from gnio_jax.filtering.gaps import Imu, bridge
from gnio_jax.filtering.history import FilterHistory
from gnio_jax.filtering.inputs import Signals, checked_inputs, checked_measurements
from gnio_jax.filtering.noise import NoiseModel
from gnio_jax.filtering.scan import interval_inputs
from gnio_jax.filtering.state import (
    ACCEL_BIAS,
    ANCHOR,
    BIASES,
    CLONE,
    GYRO_BIAS,
    LOCAL,
    MOVE,
    OFFSET,
    THETA,
    VELOCITY,
    FilterState,
    Mean,
)
from gnio_jax.filtering.step import StepTrace, traced_clone_step
from gnio_jax.filtering.update import Correction
from gnio_jax.geometry import matmul
from gnio_jax.types import Array

_ADJOINT_CORE = LOCAL.stop + 3
"""Core entries of the adjoint: θ, v, o, b_g, b_a and the anchor's last move."""


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
    """
    state, signals, noise = checked_inputs(state, gyro, accel, imu_valid, config, noise)
    displacement, covariance = checked_measurements(displacement, covariance, signals, config)
    return _smooth(state, signals, displacement, covariance, config, noise, "given")


def smooth_odometry(
    state: FilterState,
    gyro: Any,
    accel: Any,
    history: FilterHistory,
    config: FilterConfig,
    noise: NoiseModel,
    imu_valid: Any = None,
) -> SmoothedHistory:
    """Smooth a run of `run_odometry`, whose arguments these are, with the `history` that it left.

    The network is not called again: the filter's updates are repeated with the displacements of
    the history, which are told in the filter's own yaw frame. All else as in `smooth`. Raises
    `ValueError` as `run_odometry` does, or if the history is not as long as the signals.
    """
    state, signals, noise = checked_inputs(state, gyro, accel, imu_valid, config, noise)
    shape = (signals.gyro.shape[0] // config.samples_per_clone, 3)
    displacement, std = (
        checked_array(f"history.{name}", value, shape, config).astype(signals.gyro.dtype)
        for name, value in [
            ("displacement", history.displacement),
            ("measurement_std", history.measurement_std),
        ]
    )
    covariance = jax.vmap(jnp.diag)(std**2 / config.measurement_scale)
    frame = config.displacement_frame
    return _smooth(state, signals, displacement, covariance, config, noise, frame)


class _Adjoint(NamedTuple):
    """λ and Λ over θ, v, o, b_g, b_a, s and the ring of clones."""

    vector: Float[Array, "m"]
    matrix: Float[Array, "m m"]


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
    scale = functools.partial(scaled_measurement, config=config)
    measurements = jax.vmap(scale)(displacement, covariance)
    stream, _, _ = bridge(*signals, state.imu, config)
    numbers, by_interval = interval_inputs(stream, config)
    inputs = _Inputs(numbers % config.clones, by_interval, measurements)
    forward = functools.partial(_forward, config=config, noise=noise, frame=frame)
    backward = functools.partial(_backward, config=config)
    size = _ADJOINT_CORE + CLONE * config.clones
    nothing = _Adjoint(
        jnp.zeros(size, displacement.dtype), jnp.zeros((size,) * 2, displacement.dtype)
    )

    def there_and_back(
        state: FilterState, adjoint: _Adjoint, inputs: _Inputs
    ) -> tuple[_Adjoint, _Smoothed]:
        _, steps = jax.lax.scan(forward, state, inputs)
        return jax.lax.scan(backward, adjoint, steps, reverse=True)

    every = config.checkpoint_every
    if every == 0 or every >= len(numbers):
        _, smoothed = there_and_back(state, nothing, inputs)
    else:
        smoothed = _smooth_in_blocks(there_and_back, forward, state, nothing, inputs, every)
    return _smoothed_history(smoothed, config)


def _smooth_in_blocks(
    there_and_back: Callable[..., tuple[_Adjoint, _Smoothed]],
    forward: Callable,
    state: FilterState,
    adjoint: _Adjoint,
    inputs: _Inputs,
    every: int,
) -> _Smoothed:
    """Keep the state before every block of `every` steps, and filter each block once more on the
    way back."""
    there_and_back = jax.checkpoint(there_and_back, prevent_cse=False)
    blocks, rest = split_blocks(inputs, every)

    def filter_block(state: FilterState, block: _Inputs) -> tuple[FilterState, FilterState]:
        return jax.lax.scan(forward, state, block)[0], state

    def smooth_block(adjoint: _Adjoint, start: tuple) -> tuple[_Adjoint, _Smoothed]:
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
    cross = jnp.concatenate([_without_anchor(core), clones], axis=1)
    return state, _ForwardStep(inputs.slot, record.mean, record.covariance, cross, trace)


def _without_anchor(rows: Float[Array, "r 21"]) -> Float[Array, "r 18"]:
    """Columns of the core that the adjoint runs over."""
    return jnp.concatenate([rows[:, LOCAL], rows[:, MOVE]], axis=1)


def _backward(
    adjoint: _Adjoint, step: _ForwardStep, config: FilterConfig
) -> tuple[_Adjoint, _Smoothed]:
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
        adjoint = _before_update(adjoint, correction, oldest)
    return _before_propagation(adjoint, step.trace.transition, step.slot), smoothed


def _corrected(mean: Mean, error: Float[Array, "15"]) -> Mean:
    """With an error in θ, v, p, b_g, b_a added: p takes the place of o."""
    return Mean(
        rotation=matmul(geometry.exp(error[THETA]), mean.rotation),
        velocity=mean.velocity + error[VELOCITY],
        position=mean.position + error[OFFSET],
        gyro_bias=mean.gyro_bias + error[GYRO_BIAS],
        accel_bias=mean.accel_bias + error[ACCEL_BIAS],
    )


def _before_update(adjoint: _Adjoint, correction: Correction, oldest: Int[Array, ""]) -> _Adjoint:
    """See the head of the file; `oldest` is where the oldest clone lies among the clones."""
    core_rows, core_jacobian = map(
        _without_anchor, (correction.core_rows, correction.core_jacobian)
    )
    rows = jnp.concatenate([core_rows, correction.clone_rows], axis=1)
    jacobian = jax.lax.dynamic_update_slice_in_dim(
        jnp.concatenate([core_jacobian, jnp.zeros_like(correction.clone_rows)], axis=1),
        correction.oldest_jacobian,
        _ADJOINT_CORE + oldest,
        1,
    )
    over = rows @ adjoint.matrix
    # Λ − Mᵀ G − Gᵀ M with G = Y Λ − ½ (Y Λ Yᵀ + I) M
    half = 0.5 * (matmul(over, rows.T) + np.eye(3, dtype=over.dtype))
    gain = over - matmul(half, jacobian)
    return _Adjoint(
        adjoint.vector - jacobian.T @ (rows @ adjoint.vector + correction.whitened),
        adjoint.matrix - matmul(jacobian.T, gain) - matmul(gain.T, jacobian),
    )


def _before_propagation(
    adjoint: _Adjoint, transition: Float[Array, "9 15"], slot: Int[Array, ""]
) -> _Adjoint:
    """Back over cloning into `slot`, the motion and, in slot 0, the anchor's move before it."""
    core = _core_transition(transition, slot)
    pose = jnp.concatenate([core[THETA], core[OFFSET]])  # what the clone is made of

    def back(rows: Float[Array, "m r"]) -> Float[Array, "m r"]:
        of_core, of_clones = rows[:_ADJOINT_CORE], rows[_ADJOINT_CORE:]
        clone = jax.lax.dynamic_slice_in_dim(of_clones, CLONE * slot, CLONE)
        moved = jnp.concatenate([core, pose]).T @ jnp.concatenate([of_core, clone])
        forgotten = jnp.zeros_like(clone)
        of_clones = jax.lax.dynamic_update_slice_in_dim(of_clones, forgotten, CLONE * slot, 0)
        return jnp.concatenate([moved, of_clones])

    return _Adjoint(back(adjoint.vector[:, None])[:, 0], back(back(adjoint.matrix).T))


def _core_transition(
    transition: Float[Array, "9 15"], slot: Int[Array, ""]
) -> Float[Array, "18 18"]:
    """F of θ, v, o, b_g, b_a, s: in slot 0 the offset has become the anchor's last move."""
    dtype = transition.dtype
    anchored = (slot == 0).astype(dtype)
    eye = np.eye(3, dtype=dtype)
    of_motion = jnp.pad(transition, ((0, 0), (0, 3)))
    of_biases = np.eye(_ADJOINT_CORE, dtype=dtype)[BIASES]
    before_offset, between = jnp.zeros((3, OFFSET.start), dtype), jnp.zeros((3, 6), dtype)
    of_move = jnp.concatenate(
        [before_offset, anchored * eye, between, (1 - anchored) * eye], axis=1
    )
    return jnp.concatenate([of_motion, of_biases, of_move])


def _smoothed_history(smoothed: _Smoothed, config: FilterConfig) -> SmoothedHistory:
    covariance, whole = smoothed.covariance, config.history == "core"
    diagonal = jnp.diagonal(covariance, axis1=1, axis2=2) if whole else covariance
    return SmoothedHistory(
        *smoothed.mean, covariance_diagonal=diagonal, covariance=covariance if whole else None
    )
