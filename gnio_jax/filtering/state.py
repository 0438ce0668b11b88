"""State of the stochastic-cloning EKF (paper §III-G, after TLIO), its ring of clones and the anchor
of its positions.

The error state is δ = (θ, v, o, b_g, b_a, a, s, b | θ_0, o_0, θ_1, o_1, …): 21 core entries and
those of b, then 6 for each clone. Rotation errors are in the world frame and on the left,
R ← exp(δθ) R; everything else adds. b are temporally correlated errors of measurements, each of
variance 1: no entries or 3 of the displacements (see `displacement`), then no entries or 6 of a
car's mounting and lever (see `nonholonomic`).

In the invariant form (`FilterConfig.error`) the covariance inside a run is not that of the error δx
of a velocity or a position, but that of

    ξ = δx + hat(x − c) θ,

with the θ of the same pose (that of a position is held by its offset o). c is fixed: the estimate x
when the pose was propagated or cloned, which updates have moved by its shift x − c since. A turn of
the world changes ξ by e_z × c, whatever x is, so no update has to express the covariance at its new
estimate (see `update`). The next propagation takes up the core's shift (`core_transition`). Between
runs all errors are additive (`invariant_errors`, `unroll_clones`).

Positions are held as offsets o = p − a from an anchor a, a past position that moves up to the
present once in a window; s is its last move. The offset of a clone refers to the anchor at the time
of cloning: the present one, or the one before. The variance of a position grows without bound,
since only differences of positions are measured; those of offsets and moves do not. So no update
subtracts large variances from each other. Such differences make the plain form (θ, v, p, …) diverge
in float32. The change of variables is linear with constant coefficients (p = a + o for the core),
so the filter is equivalent to the plain one.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gnio_jax.config import InitialStd
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.geometry import hat, matmul
from gnio_jax.types import Array, Memory

CORE, CLONE = 21, 6
"""Number of entries of the error state: of the core without b, and of each clone."""
THETA, VELOCITY, OFFSET, GYRO_BIAS, ACCEL_BIAS, ANCHOR, MOVE = (
    slice(3 * i, 3 * i + 3) for i in range(7)
)
"""Entries of each part of the core's error."""
BIASES = slice(GYRO_BIAS.start, ACCEL_BIAS.stop)
"""b_g, b_a: constant over an interval."""
LOCAL = slice(THETA.start, ANCHOR.start)
"""θ, v, o, b_g, b_a: all but the anchor, its move and b."""
CORRELATED = slice(MOVE.stop, None)
"""b: 0, 3, 6 or 9 entries."""
OF_DISPLACEMENT, OF_MOUNTING, OF_LEVER = slice(0, 3), slice(-6, -3), slice(-3, None)
"""Those of b of the displacements, of a car's mounting and of its lever, where b has them."""
CLONE_THETA, CLONE_OFFSET = slice(0, 3), slice(3, 6)
"""Entries of each part of a clone's error."""


class GateState(NamedTuple):
    """Memory of the χ² gate. Times count IMU samples since initialisation, so that rounding cannot
    change a decision."""

    converged: Bool[Array, ""]
    """True from the first update on whose oldest clone is old enough."""
    last_success: Int[Array, ""]
    """Sample of the last measurement that was not rejected; −1 before the first. It moves along
    while there is no measurement."""
    pause_end: Int[Array, ""]
    """First sample at which the gate may be active again."""


class ImuMemory(NamedTuple):
    """The memory of the IMU from one clone interval to the next."""

    gyro: Float[Array, "3"]
    """The last sample that was not missing, rad/s, raw; NaN before there was one."""
    accel: Float[Array, "3"]
    """The last sample that was not missing, m/s², raw; NaN before there was one."""
    missing: Int[Array, ""]
    """Number of samples that are missing since then."""
    quiet: Int[Array, ""]
    """Number of successive clone intervals in which the IMU was quiet; `ZeroVelocity` counts
    them."""


class Mean(NamedTuple):
    """Estimates at one time, or stacked over K times, in the frames and units of `FilterState`."""

    rotation: Float[Array, "*k 3 3"]
    velocity: Float[Array, "*k 3"]
    position: Float[Array, "*k 3"]
    gyro_bias: Float[Array, "*k 3"]
    accel_bias: Float[Array, "*k 3"]


class Shift(NamedTuple):
    """The movement of the core's mean by the updates since its propagation, in the world frame."""

    velocity: Float[Array, "3"]
    """m/s"""
    position: Float[Array, "3"]
    """m"""


class FilterState(NamedTuple):
    """Mean and covariance. c = W + 1 clones, oldest first between runs; inside a run they are a
    ring. Clones that do not exist yet are zero (their rotations the identity)."""

    rotation: Float[Array, "3 3"]
    """Body → world."""
    velocity: Float[Array, "3"]
    """World frame, m/s."""
    offset: Float[Array, "3"]
    """World frame, from the anchor, m."""
    gyro_bias: Float[Array, "3"]
    """rad/s"""
    accel_bias: Float[Array, "3"]
    """m/s²"""
    anchor: Float[Array, "3"]
    """A past position in the world frame, m."""
    move: Float[Array, "3"]
    """From the anchor before it, m."""
    correlated: Float[Array, "e"]
    """Temporally correlated errors of measurements, in units of the standard deviations of the
    filter that ran: no entries or 3 of the displacements, then no entries or 6 of a car's mounting
    and lever. A filter with other standard deviations would continue with other errors."""
    clone_rotation: Float[Array, "c 3 3"]
    """Cloned rotations."""
    clone_offset: Float[Array, "c 3"]
    """Cloned positions, m, from the anchor at the time of cloning; between runs, from the present
    anchor."""
    core_covariance: Float[Array, "n n"]
    """θ, v, o, b_g, b_a, a, s, b: n = 21 + e."""
    cross_covariance: Float[Array, "n 6c"]
    """Covariance of the core with the clones' θ, o."""
    clone_covariance: Float[Array, "6c 6c"]
    """Covariance of the clones' θ, o."""
    step: Int[Array, ""]
    """Clone intervals since initialisation."""
    gate: GateState
    imu: ImuMemory
    clone_shift: Float[Array, "c 3"]
    """Movement of each clone's position since it was cloned, world frame, m; zero between runs and
    with additive errors."""
    shift: Shift | None
    """That of the core; None where no update has moved it since its propagation, between runs, and
    with additive errors."""
    healthy: Bool[Array, ""]
    """Once False, it remains False: see `FilterHistory.healthy`."""
    window: Float[Array, "r 7"] | None = None
    """The last `FilterConfig.reach` samples before the state, with holes bridged: gyro rad/s, accel
    m/s², raw, and whether the filter used the sample. A later run needs them for the network's
    first windows. None at a start, and inside a run."""
    memory: Memory | None = None
    """The memory of a network that has one, with which a later run continues. None at a start, and
    inside a run."""

    @property
    def position(self) -> Float[Array, "*k 3"]:
        """World frame, m."""
        return self.anchor + self.offset

    @property
    def mean(self) -> Mean:
        """The mean of the core, with the position instead of the offset."""
        return Mean(self.rotation, self.velocity, self.position, self.gyro_bias, self.accel_bias)


def gyro_bias_covariance(
    rotation: Float[Array, "3 3"], vertical: Array | float, level: Array | float
) -> Float[Array, "3 3"]:
    """Covariance of a gyro bias in the body, by the standard deviations of its vertical component
    and of each level one; rotation is body → world."""
    up = rotation[2] / jnp.sqrt(jnp.sum(rotation[2] ** 2))
    eye = np.eye(3, dtype=rotation.dtype)
    return vertical**2 * eye + (level**2 - vertical**2) * (eye - up[:, None] * up[None, :])


# jit: one compiled program instead of thirty, in a third of the time at the first call.
@functools.partial(jax.jit, static_argnames="clones")
def without_clones(
    pose: Mean, std: InitialStd, clones: int, level_gyro_bias: Array | float | None = None
) -> FilterState:
    """The state at the start, in the precision of `pose`, with independent errors of `std`; the two
    components of the gyro bias that are level at the start have the standard deviation
    `level_gyro_bias`, rad/s, if it is given.

    The whole uncertainty of the position is in the anchor, because there is no offset and no move
    yet.
    """
    dtype = pose.rotation.dtype
    nothing, unknown = jnp.zeros(3, dtype), jnp.full(3, jnp.nan, dtype)
    # Standard deviations of tilt, yaw, v, o, b_g, b_a, a, s.
    parts = (*std[:3], 0.0, std.gyro_bias, std.accel_bias, std.position, 0.0)
    stds = jnp.stack([jnp.asarray(part, dtype) for part in parts])
    core_std = jnp.repeat(stds, np.array([2, 1, 3, 3, 3, 3, 3, 3]), total_repeat_length=CORE)
    covariance = jnp.diag(core_std**2)
    if level_gyro_bias is not None:
        of_bias = gyro_bias_covariance(pose.rotation, std.gyro_bias, level_gyro_bias)
        covariance = covariance.at[GYRO_BIAS, GYRO_BIAS].set(of_bias.astype(dtype))
    return FilterState(
        rotation=pose.rotation,
        velocity=pose.velocity,
        offset=nothing,
        gyro_bias=pose.gyro_bias,
        accel_bias=pose.accel_bias,
        anchor=pose.position,
        move=nothing,
        correlated=jnp.zeros(0, dtype),
        clone_rotation=jnp.tile(jnp.eye(3, dtype=dtype)[None], (clones, 1, 1)),
        clone_offset=jnp.zeros((clones, 3), dtype),
        core_covariance=covariance,
        cross_covariance=jnp.zeros((CORE, CLONE * clones), dtype),
        clone_covariance=jnp.zeros((CLONE * clones, CLONE * clones), dtype),
        step=jnp.int32(0),
        gate=GateState(jnp.bool_(False), last_success=jnp.int32(-1), pause_end=jnp.int32(0)),
        imu=ImuMemory(unknown, unknown, missing=jnp.int32(0), quiet=jnp.int32(0)),
        clone_shift=jnp.zeros((clones, 3), dtype),
        shift=None,
        healthy=jnp.bool_(True),
    )


def with_correlated_errors(state: FilterState, count: int) -> FilterState:
    """The state with `count` correlated errors of variance 1. A state that has some stays as it
    is."""
    if len(state.correlated):
        return state
    variance = np.diag(np.repeat([0.0, 1.0], [CORE, count])).astype(state.offset.dtype)
    return state._replace(
        correlated=jnp.zeros(count, state.offset.dtype),
        core_covariance=jnp.pad(state.core_covariance, (0, count)) + variance,
        cross_covariance=jnp.pad(state.cross_covariance, ((0, count), (0, 0))),
    )


def state_shapes(config: FilterConfig, correlated: int, dtype: Any) -> FilterState:
    """Shapes and types of the filter's state with this number of correlated errors."""

    def start() -> FilterState:
        pose = Mean(jnp.eye(3, dtype=dtype), *[jnp.zeros(3, dtype)] * 4)
        return with_correlated_errors(without_clones(pose, InitialStd(), config.clones), correlated)

    return jax.eval_shape(start)


def with_position(rows: Float[Array, "n k"]) -> Float[Array, "15 k"]:
    """Rows of θ, v, p, b_g, b_a from those of the core's error: p = a + o."""
    position = rows[OFFSET] + rows[ANCHOR]
    return jnp.concatenate([rows[: OFFSET.start], position, rows[BIASES]])


def core_covariance(state: FilterState, config: FilterConfig) -> Float[Array, "15 15"]:
    """Covariance of the errors δ of θ, v, p, b_g, b_a; in the invariant form with the part of
    second order (`arc_covariance`)."""
    plain = first_order_covariance(state)
    return plain + arc_covariance(plain) if config.invariant else plain


def first_order_covariance(state: FilterState) -> Float[Array, "15 15"]:
    """Covariance of the errors δ of θ, v, p, b_g, b_a."""
    covariance = with_position(with_position(state.core_covariance).T)
    return additive_core(state, additive_core(state, covariance).T)


def arc_covariance(covariance: Float[Array, "*k 15 15"]) -> Float[Array, "*k 15 15"]:
    """The second order (ours) of an error ψ of the yaw in the covariance of θ, v, p, b_g, b_a.

    Velocity and position lie on an arc: an error ψ moves them by ψ e_z × l − ½ ψ² l, where l is
    their horizontal lever. With the variance σ² of ψ, E[ψ⁴] = 3 σ⁴, the second moment of the last
    term is ¾ σ⁴ l lᵀ, and σ² e_z × l is their covariance with ψ.
    """
    yaw = covariance[..., THETA.stop - 1]
    of_velocity, of_position = yaw_lever(yaw[..., VELOCITY]), yaw_lever(yaw[..., OFFSET])
    nothing = jnp.zeros_like(of_velocity)
    lever = [nothing, of_velocity, of_position, nothing, nothing]
    return arc_of(jnp.concatenate(lever, axis=-1))


def yaw_lever(with_yaw: Float[Array, "*k 3"]) -> Float[Array, "*k 3"]:
    """σ² l, from the covariance σ² e_z × l of a velocity or a position with the yaw."""
    x, y, z = jnp.moveaxis(with_yaw, -1, 0)
    return jnp.stack([y, -x, jnp.zeros_like(z)], axis=-1)


def arc_of(lever: Float[Array, "*k d"]) -> Float[Array, "*k d d"]:
    """¾ σ⁴ l lᵀ, from σ² l."""
    return 0.75 * lever[..., :, None] * lever[..., None, :]


# The ring of clones and its anchor
# ------------------------------------------------------------------------------------------------


def invariant_errors(state: FilterState, config: FilterConfig) -> FilterState:
    """The state at the start of a run, with errors in the form of `config`: the additive errors are
    the invariant ones about the present estimate. `unroll_clones` is the way back."""
    if not config.invariant:
        return state
    return state._replace(shift=Shift(*jnp.zeros((2, 3), state.offset.dtype)))


def additive_errors(state: FilterState) -> FilterState:
    """The state with the errors δ in the place of ξ."""
    if state.shift is None:
        return state
    core = additive_core(state, additive_core(state, state.core_covariance).T)
    cross = additive_core(state, state.cross_covariance)
    clones = _additive_clones(state, _additive_clones(state, state.clone_covariance).T)
    return state._replace(
        core_covariance=0.5 * (core + core.T),
        cross_covariance=_additive_clones(state, cross.T).T,
        clone_covariance=0.5 * (clones + clones.T),
        clone_shift=jnp.zeros_like(state.clone_shift),
        shift=None,
    )


def additive_core(state: FilterState, rows: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Rows of the core's errors δx = ξ − hat(x − c) θ from those of ξ; or rows of the errors of θ,
    v, p, b_g, b_a."""
    if state.shift is None:
        return rows
    theta, velocity, offset, others = jnp.split(rows, [THETA.stop, VELOCITY.stop, OFFSET.stop])
    velocity = velocity - matmul(hat(state.shift.velocity), theta)
    offset = offset - matmul(hat(state.shift.position), theta)
    return jnp.concatenate([theta, velocity, offset, others])


def _additive_clones(state: FilterState, rows: Float[Array, "m k"]) -> Float[Array, "m k"]:
    """Rows of the clones' errors δx from those of ξ, as `additive_core` for the core."""
    theta, offset = jnp.split(rows.reshape(-1, CLONE, rows.shape[1]), 2, axis=1)
    offset = offset - jax.vmap(matmul)(jax.vmap(hat)(state.clone_shift), theta)
    return jnp.concatenate([theta, offset], axis=1).reshape(rows.shape)


def move_anchor(state: FilterState, anchored: Float[Array, ""]) -> FilterState:
    """The state with the anchor moved up to the present position if `anchored` is 1, and unchanged
    if it is 0."""
    moves = anchored > 0
    return state._replace(
        anchor=jnp.where(moves, state.anchor + state.offset, state.anchor),
        offset=jnp.where(moves, 0.0, state.offset),
        move=jnp.where(moves, state.offset, state.move),
    )


def unroll_clones(state: FilterState, oldest: int) -> FilterState:
    """The state between runs: oldest clone first, all clones at the present anchor, and all errors
    additive.

    `oldest` is the slot of the oldest clone. The slots before it, written since the anchor's last
    move, are at the present anchor already.
    """
    state = additive_errors(state)
    clones, dtype = state.clone_offset.shape[0], state.move.dtype
    at_anchor_before = (np.arange(clones) >= (oldest or clones)).astype(dtype)[:, None]
    # o ← o − s for those, in the mean and in the covariance.
    by_move = np.zeros((CLONE, 3))
    by_move[CLONE_OFFSET] = np.eye(3)
    loss = np.kron(at_anchor_before, by_move).astype(dtype)
    across = loss @ state.cross_covariance[MOVE]
    of_moves = loss @ state.core_covariance[MOVE, MOVE] @ loss.T
    clone_covariance = state.clone_covariance - across - across.T + of_moves
    cross_covariance = state.cross_covariance - state.core_covariance[:, MOVE] @ loss.T
    offset = state.clone_offset - at_anchor_before * state.move[None]
    entries = CLONE * oldest
    return state._replace(
        clone_rotation=jnp.roll(state.clone_rotation, -oldest, 0),
        clone_offset=jnp.roll(offset, -oldest, 0),
        cross_covariance=jnp.roll(cross_covariance, -entries, 1),
        clone_covariance=jnp.roll(clone_covariance, (-entries, -entries), (0, 1)),
    )
