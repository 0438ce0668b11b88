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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gnio_jax import geometry
from gnio_jax.filtering.gaps import Imu, bridge
from gnio_jax.filtering.measurement import Correction, Measurement
from gnio_jax.filtering.scan import FilterHistory, Trace, _admit, _measurement, traced_step
from gnio_jax.filtering.state import (
    ACCEL_BIAS,
    ANCHOR,
    CLONE,
    GYRO_BIAS,
    MOVE,
    OFFSET,
    THETA,
    VELOCITY,
    FilterConfig,
    FilterState,
    Frame,
    NoiseModel,
    check,
    check_positive,
)
from gnio_jax.geometry import matmul
from gnio_jax.types import Array

LOCAL = ANCHOR.start + 3
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


class Kept(NamedTuple):
    """What the way back needs of one step forward."""

    mean: tuple[Array, ...]
    """Rotation, velocity, position, gyro bias, accel bias after the step."""
    covariance: Array
    """Of θ, v, p, b_g, b_a, or its diagonal."""
    cross: Float[Array, "15 m"]
    """P of those against all that the adjoint runs over."""
    trace: Trace


class Adjoint(NamedTuple):
    """λ and Λ over θ, v, o, b_g, b_a, s and the ring of clones."""

    vector: Float[Array, "m"]
    matrix: Float[Array, "m m"]


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
    state, gyro, accel, valid, noise = _admit(state, gyro, accel, imu_valid, config, noise)
    intervals = gyro.shape[0] // config.samples_per_clone
    displacement = check("displacement", displacement, (intervals, 3), config).astype(gyro.dtype)
    covariance = check("covariance", covariance, (intervals, 3, 3), config).astype(gyro.dtype)
    check_positive("covariance", covariance)
    return _smooth(state, gyro, accel, valid, displacement, covariance, config, noise, "given")


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
    state, gyro, accel, valid, noise = _admit(state, gyro, accel, imu_valid, config, noise)
    intervals = gyro.shape[0] // config.samples_per_clone
    displacement, std = (
        check(f"history.{name}", getattr(history, name), (intervals, 3), config).astype(gyro.dtype)
        for name in ("displacement", "measurement_std")
    )
    covariance = jax.vmap(jnp.diag)(std**2 / config.measurement_scale)
    frame = config.displacement_frame
    return _smooth(state, gyro, accel, valid, displacement, covariance, config, noise, frame)


@functools.partial(jax.jit, static_argnames=("config", "frame"))
def _smooth(state, gyro, accel, valid, displacement, covariance, config, noise, frame):
    n, clones = config.samples_per_clone, config.clones_per_window + 1
    intervals = len(displacement)
    measurements = jax.vmap(functools.partial(_measurement, config=config))(
        displacement, covariance
    )
    stream, _, _ = bridge(gyro, accel, valid, state.imu, config)
    inputs = (
        jnp.arange(intervals) % clones,
        jax.tree.map(lambda x: x.reshape(intervals, n, *x.shape[1:]), stream),
        measurements,
    )

    def forward(state: FilterState, given: tuple) -> tuple[FilterState, Kept]:
        return _forward(state, *given, config=config, noise=noise, frame=frame)

    def there_and_back(
        state: FilterState, adjoint: Adjoint, inputs: tuple
    ) -> tuple[Adjoint, tuple]:
        _, kept = jax.lax.scan(forward, state, inputs)
        return jax.lax.scan(
            functools.partial(_backward, config=config), adjoint, (inputs[0], kept), reverse=True
        )

    size = LOCAL + CLONE * clones
    nothing = Adjoint(jnp.zeros(size, gyro.dtype), jnp.zeros((size, size), gyro.dtype))
    every = config.checkpoint_every
    if every == 0 or every >= intervals:
        return _history(there_and_back(state, nothing, inputs)[1], config)

    there_and_back = jax.checkpoint(there_and_back, prevent_cse=False)
    blocks = intervals // every
    whole = jax.tree.map(lambda x: x[: blocks * every].reshape(blocks, every, *x.shape[1:]), inputs)
    last, starts = jax.lax.scan(
        lambda state, block: (jax.lax.scan(forward, state, block)[0], state), state, whole
    )
    adjoint, tail = nothing, []
    if intervals % every:
        adjoint, rows = there_and_back(
            last, adjoint, jax.tree.map(lambda x: x[blocks * every :], inputs)
        )
        tail.append(rows)
    _, rows = jax.lax.scan(
        lambda adjoint, block: there_and_back(block[0], adjoint, block[1]),
        adjoint,
        (starts, whole),
        reverse=True,
    )
    rows = jax.tree.map(lambda x: x.reshape(blocks * every, *x.shape[2:]), rows)
    return _history(jax.tree.map(lambda *parts: jnp.concatenate(parts), rows, *tail), config)


def _forward(
    state: FilterState,
    slot: Int[Array, ""],
    imu: Imu,
    measurement: Measurement,
    config: FilterConfig,
    noise: NoiseModel,
    frame: Frame,
) -> tuple[FilterState, Kept]:
    given = lambda _state, _oldest: (measurement, {})  # noqa: E731
    state, row, trace = traced_step(state, imu, given, slot, config, noise, frame)
    parts = map(jnp.asarray, (state.core_covariance, state.cross_covariance))
    core, clones = (part[: ANCHOR.start].at[OFFSET].add(part[ANCHOR]) for part in parts)
    return state, Kept(
        row.state, row.covariance, jnp.concatenate([_local(core), clones], axis=1), trace
    )


def _local(rows: Float[Array, "r 21"]) -> Float[Array, "r 18"]:
    """Without the columns of the anchor."""
    return jnp.concatenate([rows[:, : ANCHOR.start], rows[:, MOVE]], axis=1)


def _backward(adjoint: Adjoint, given: tuple, config: FilterConfig) -> tuple[Adjoint, tuple]:
    """The smoothed estimate after a step, and the adjoint before it."""
    slot, kept = given
    over = kept.cross @ adjoint.matrix
    error = -(kept.cross @ adjoint.vector)
    if config.history == "core":
        covariance = kept.covariance - over @ kept.cross.T
    else:
        covariance = kept.covariance - jnp.sum(over * kept.cross, axis=1)
    rotation, velocity, position, gyro_bias, accel_bias = kept.mean
    mean = (
        matmul(geometry.exp(error[THETA]), rotation),
        velocity + error[VELOCITY],
        position + error[OFFSET],
        gyro_bias + error[GYRO_BIAS],
        accel_bias + error[ACCEL_BIAS],
    )

    oldest = CLONE * ((slot + 1) % (config.clones_per_window + 1))
    for correction in reversed(kept.trace.corrections):
        adjoint = _before_update(adjoint, correction, oldest)
    return _before_propagation(adjoint, kept.trace.transition, slot), (mean, covariance)


def _before_update(adjoint: Adjoint, correction: Correction, oldest: Int[Array, ""]) -> Adjoint:
    """See the head of the file; `oldest` is where the oldest clone lies among the clones."""
    rows = jnp.concatenate([_local(correction.core_rows), correction.clone_rows], axis=1)
    jacobian = jax.lax.dynamic_update_slice_in_dim(
        jnp.concatenate(
            [_local(correction.core_jacobian), jnp.zeros_like(correction.clone_rows)], axis=1
        ),
        correction.oldest_jacobian,
        LOCAL + oldest,
        1,
    )
    over = rows @ adjoint.matrix
    # Λ − Mᵀ G − Gᵀ M with G = Y Λ − ½ (Y Λ Yᵀ + I) M
    half = 0.5 * (matmul(over, rows.T) + np.eye(3, dtype=over.dtype))
    gain = over - matmul(half, jacobian)
    return Adjoint(
        adjoint.vector - jacobian.T @ (rows @ adjoint.vector + correction.whitened),
        adjoint.matrix - matmul(jacobian.T, gain) - matmul(gain.T, jacobian),
    )


def _before_propagation(
    adjoint: Adjoint, transition: Float[Array, "9 15"], slot: Int[Array, ""]
) -> Adjoint:
    """Back over cloning into `slot`, the motion and, in slot 0, the anchor's move before it."""
    dtype = transition.dtype
    anchored = (slot == 0).astype(dtype)
    eye, biases = (
        np.eye(3, dtype=dtype),
        np.eye(LOCAL, dtype=dtype)[GYRO_BIAS.start : ACCEL_BIAS.stop],
    )
    of_move = jnp.concatenate(
        [
            jnp.zeros((3, OFFSET.start), dtype),
            anchored * eye,
            jnp.zeros((3, 6), dtype),
            (1 - anchored) * eye,
        ],
        axis=1,
    )
    core = jnp.concatenate([jnp.pad(transition, ((0, 0), (0, 3))), biases, of_move])
    pose = jnp.concatenate([core[THETA], core[OFFSET]])  # what the clone is made of

    def back(rows: Float[Array, "m r"]) -> Float[Array, "m r"]:
        clone = jax.lax.dynamic_slice_in_dim(rows, LOCAL + CLONE * slot, CLONE)
        moved = jnp.concatenate([core, pose]).T @ jnp.concatenate([rows[:LOCAL], clone])
        rest = jax.lax.dynamic_update_slice_in_dim(
            rows[LOCAL:], jnp.zeros_like(clone), CLONE * slot, 0
        )
        return jnp.concatenate([moved, rest])

    return Adjoint(back(adjoint.vector[:, None])[:, 0], back(back(adjoint.matrix).T))


def _history(rows: tuple, config: FilterConfig) -> SmoothedHistory:
    mean, covariance = rows
    whole = config.history == "core"
    diagonal = jnp.diagonal(covariance, axis1=1, axis2=2) if whole else covariance
    return SmoothedHistory(
        *mean, covariance_diagonal=diagonal, covariance=covariance if whole else None
    )
