"""Displacement measurement between two clones: residual, Jacobian, gate, gain (paper §III-G, after TLIO)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.filtering.state import ACCEL_BIAS, CLONE, GYRO_BIAS, POSITION, VELOCITY, FilterConfig, FilterState, GateState
from gnio_jax.geometry import matmul
from gnio_jax.types import Array

GIMBAL = 1e-5
"""Below this |cos pitch| the yaw of the oldest clone has no derivative and the measurement is not used."""


class Measurement(NamedTuple):
    """Displacement from the oldest to the newest clone, m, in the yaw frame of the oldest, finite also where there is none."""

    displacement: Float[Array, "3"]
    covariance: Float[Array, "3 3"]
    """After scaling, m²; positive definite also where there is none."""
    present: Bool[Array, ""]


class Outcome(NamedTuple):
    """What became of a measurement; zeros and False where there was none."""

    present: Bool[Array, ""]
    innovation: Float[Array, "3"]
    """r, m."""
    nis: Float[Array, ""]
    """Normalised innovation squared, rᵀ S⁻¹ r, before any fail scale."""
    gate_passed: Bool[Array, ""]
    accepted: Bool[Array, ""]


def displacement_residual(rotation_i: Float[Array, "3 3"], position_i: Float[Array, "3"], position_j: Float[Array, "3"],
                          displacement: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3 9"], Bool[Array, ""]]:
    """r = d − R_γ(R_i)ᵀ (p_j − p_i), its prediction's Jacobian H over (θ_i, p_i, p_j), and whether H exists (no gimbal lock).

    H[θ_i] = R_γᵀ hat(p_j − p_i) Hz, where only the last row of Hz, (cos y tan q, sin y tan q, 1), is not zero: the change of the yaw y
    of exp(δθ) R_i, q being its pitch (R = Rz(y) Ry(q) Rx).  At gimbal lock tan q is taken as 0.
    """
    unyaw = geometry.yaw_rotation(rotation_i).T
    predicted = unyaw @ (position_j - position_i)
    cosine_squared = rotation_i[0, 0] ** 2 + rotation_i[1, 0] ** 2
    defined = cosine_squared >= GIMBAL**2
    scale = jnp.where(defined, -rotation_i[2, 0] / jnp.where(defined, cosine_squared, 1.0), 0.0)  # tan q / cos q
    yaw_row = jnp.stack([scale * rotation_i[0, 0], scale * rotation_i[1, 0], jnp.ones_like(scale)])
    # hat(d) Hz is a single outer product, (d × z) ⊗ yaw_row, and the yaw leaves z alone.
    turned = jnp.stack([predicted[1], -predicted[0], jnp.zeros_like(scale)])
    jacobian = jnp.concatenate([turned[:, None] * yaw_row[None, :], -unyaw, unyaw], axis=1)
    return displacement - predicted, jacobian, defined


def gate(memory: GateState, config: FilterConfig, now: Array, oldest: Array, nis: Array, tried: Array) -> tuple[GateState, Bool[Array, ""]]:
    """TLIO's gate: whether the measurement passes as it is, and the gate's memory after it.

    `now` and `oldest` are the samples of the newest and the oldest clone; where `tried` is False nothing changes.
    Comparisons are strict, as "more than" and "older" say; at the very end of a pause the gate is active again.
    """
    def whole(seconds: float) -> int:  # t·dt > seconds  ⇔  t > whole(seconds), whatever the last bit of seconds / dt
        return int(np.floor(seconds / config.dt + 1e-6))

    converged = memory.converged | (tried & (oldest > whole(config.convergence_seconds)))
    watching = converged & (now >= memory.pause_end)
    stale = watching & (memory.last_success >= 0) & (now - memory.last_success > whole(config.success_seconds))
    passed = ~(watching & ~stale & (nis > config.gate_threshold))
    pause = -int(np.floor(-config.pause_seconds / config.dt + 1e-6))
    return GateState(
        converged=converged,
        last_success=jnp.where(tried & passed, now, memory.last_success),
        pause_end=jnp.where(tried & stale, now + pause, memory.pause_end)), passed & tried


def update(state: FilterState, measurement: Measurement, newest: Array | int, oldest: Array | int, full: Array | bool,
           config: FilterConfig) -> tuple[FilterState, Outcome]:
    """One EKF update with the displacement between the clones in slots `oldest` and `newest`; `full` says whether both exist.

    H touches nine rows of the covariance P, so H P is three rows. With S = H P Hᵀ + R = L Lᵀ and Y = L⁻¹ H P the gain is Yᵀ L⁻¹ and
    P ← P − Yᵀ Y, symmetric to the last bit. Nothing changes where there is no measurement, or it is rejected, or at gimbal lock.
    """
    present = measurement.present & full
    innovation, jacobian, defined = displacement_residual(
        state.clone_rotation[oldest], state.clone_position[oldest], state.position, measurement.displacement)

    # The newest clone is the core's own pose: its rows of P are the core's.
    old = CLONE * oldest
    old_core = jax.lax.dynamic_slice_in_dim(state.cross_covariance, old, CLONE, 1)
    old_clones = jax.lax.dynamic_slice_in_dim(state.clone_covariance, old, CLONE, 0)
    over_core = matmul(jacobian, jnp.concatenate([old_core.T, state.core_covariance[POSITION]]))
    over_clones = matmul(jacobian, jnp.concatenate([old_clones, state.cross_covariance[POSITION]]))
    over_touched = jnp.concatenate([jax.lax.dynamic_slice_in_dim(over_clones, old, CLONE, 1), over_core[:, POSITION]], axis=1)
    innovation_covariance = matmul(over_touched, jacobian.T)

    whiten = _whitener(innovation_covariance + measurement.covariance, present)
    whitened = whiten(innovation[:, None])[:, 0]
    nis = jnp.dot(whitened, whitened)
    tried = present & defined
    now = state.step * config.samples_per_clone
    memory, passed = gate(state.gate, config, now, now - config.window, nis, tried)
    accepted = passed
    if config.mahalanobis_fail_scale > 0:
        factor = jnp.where(tried & ~passed, config.mahalanobis_fail_scale, 1.0).astype(nis.dtype)
        whiten = _whitener(innovation_covariance + factor * measurement.covariance, present)
        whitened = whiten(innovation[:, None])[:, 0]
        accepted = tried

    over_core, over_clones = (jnp.where(accepted, whiten(rows), 0.0) for rows in (over_core, over_clones))
    # A reduction on purpose: it is kept, where the sum spelt out would be computed anew for every entry that the retraction reads.
    error, clone_errors = (jnp.sum(whitened[:, None] * rows, axis=0) for rows in (over_core, over_clones))
    corrected = _retract(state, error, clone_errors.reshape(-1, CLONE), newest)
    return corrected._replace(
        core_covariance=state.core_covariance - matmul(over_core.T, over_core),
        cross_covariance=state.cross_covariance - matmul(over_core.T, over_clones),
        clone_covariance=state.clone_covariance - matmul(over_clones.T, over_clones),
        gate=memory,
    ), Outcome(present=present, innovation=innovation, nis=nis, gate_passed=passed, accepted=accepted)


def _whitener(covariance: Float[Array, "3 3"], present: Array):
    """The function x → L⁻¹ x, L Lᵀ = covariance; written out, because a call to LAPACK costs more than the whole update."""
    s = jnp.where(present, covariance, jnp.eye(3, dtype=covariance.dtype))
    a = jnp.sqrt(s[0, 0])
    b, c = s[1, 0] / a, s[2, 0] / a
    d = jnp.sqrt(s[1, 1] - b * b)
    e = (s[2, 1] - c * b) / d
    f = jnp.sqrt(s[2, 2] - c * c - e * e)

    def whiten(rows: Float[Array, "3 m"]) -> Float[Array, "3 m"]:
        x = rows[0] / a
        y = (rows[1] - b * x) / d
        return jnp.stack([x, y, (rows[2] - c * x - e * y) / f])

    return whiten


def _retract(state: FilterState, core: Float[Array, "15"], clones: Float[Array, "c 6"], newest: Array | int) -> FilterState:
    """Add an error to the mean: R ← exp(δθ) R, the rest adds. The core's pose is that of the newest clone."""
    rotations = jax.vmap(matmul)(jax.vmap(geometry.exp)(clones[:, :3]), state.clone_rotation)
    positions = state.clone_position + clones[:, 3:]
    return state._replace(
        rotation=rotations[newest], velocity=state.velocity + core[VELOCITY], position=positions[newest],
        gyro_bias=state.gyro_bias + core[GYRO_BIAS], accel_bias=state.accel_bias + core[ACCEL_BIAS],
        clone_rotation=rotations, clone_position=positions)
