"""Displacement measurement between two clones: residual, Jacobian, gate, gain (paper §III-G, after
TLIO)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.state import (
    ACCEL_BIAS,
    ANCHOR,
    CLONE,
    CORE,
    GYRO_BIAS,
    MOVE,
    OFFSET,
    VELOCITY,
    FilterConfig,
    FilterState,
    FirstEstimates,
    Frame,
    GateState,
)
from gnio_jax.geometry import matmul
from gnio_jax.types import GRAVITY, Array

LEAST_WEIGHT = 1e-6
"""Of a measurement behind a gate with a slope: its covariance grows no further."""
GIMBAL = 1e-5
"""Below this |cos pitch| the yaw of the oldest clone has no derivative, and a displacement that is
told in a given frame is not used."""


class Measurement(NamedTuple):
    """Displacement from the oldest to the newest clone, m, in the yaw frame of the oldest, finite
    also where there is none."""

    displacement: Float[Array, "3"]
    covariance: Float[Array, "3 3"]
    """After scaling, m²; positive definite also where there is none."""
    present: Bool[Array, ""]


class Correction(NamedTuple):
    """What an update with S = L Lᵀ did to the error e: e ← e − Yᵀ (L⁻¹ r), where L⁻¹ r = L⁻¹ H e
    and noise. Smoothing undoes it."""

    whitened: Float[Array, "3"]
    """L⁻¹ r."""
    core_rows: Float[Array, "3 21"]
    """Y = L⁻¹ H P against the core; zero where there was no update, and so are the other rows."""
    clone_rows: Float[Array, "3 m"]
    """Y against the clones."""
    core_jacobian: Float[Array, "3 21"]
    """L⁻¹ H over the core …"""
    oldest_jacobian: Float[Array, "3 6"]
    """… and over the oldest clone; it is zero over the others."""


class Outcome(NamedTuple):
    """What became of a measurement; zeros and False where there was none."""

    present: Bool[Array, ""]
    tried: Bool[Array, ""]
    """Present, and not at gimbal lock: the gate judged it."""
    innovation: Float[Array, "3"]
    """r, m."""
    nis: Float[Array, ""]
    """Normalised innovation squared, rᵀ S⁻¹ r, before any fail scale."""
    volume: Float[Array, ""]
    """√det S, m³, before any fail scale."""
    gate_passed: Float[Array, ""]
    """1 or 0, or the weight of a gate with a slope."""
    accepted: Bool[Array, ""]


def displacement_residual(
    rotation_i: Float[Array, "3 3"],
    moved: Float[Array, "3"],
    displacement: Float[Array, "3"],
    turning: Float[Array, "3"],
    frame: Frame = "given",
) -> tuple[Float[Array, "3"], Float[Array, "3 9"], Bool[Array, ""]]:
    """r = d − R_γ(R_i)ᵀ (p_j − p_i), its prediction's Jacobian H over (θ_i, p_i, p_j), and whether
    H exists (no gimbal lock).

    `moved` is p_j − p_i; `turning` the same where H[θ_i] is to be taken.

    H[θ_i] = R_γᵀ hat(p_j − p_i) Hz, where only the last row of Hz is not zero. With d in a given
    frame it is TLIO's, (cos y tan q, sin y tan q, 1): the change of the yaw y of exp(δθ) R_i, q
    being its pitch (R = Rz(y) Ry(q) Rx). At gimbal lock tan q is taken as 0.

    In the filter's own frame it is (0, 0, 1) (ours). The window is cut with the yaw of the estimate
    R̂_i = exp(−δθ) R_i, and the network answers in that frame. If it is equivariant to yaw and a
    small tilt changes nothing, d = R_γ(R̂_i)ᵀ exp(−δθ_z e_z) (p_j − p_i): however the error turns
    the frame, it turns d and the prediction alike, and r feels δθ_z alone. The yaw is not
    differentiated, so there is no gimbal lock.
    """
    unyaw = geometry.yaw_rotation(rotation_i).T
    predicted, levered = unyaw @ moved, unyaw @ turning
    nothing, one = jnp.zeros_like(moved[0]), jnp.ones_like(moved[0])
    if frame == "own":
        defined, yaw_row = jnp.bool_(True), jnp.stack([nothing, nothing, one])
    else:
        cosine_squared = rotation_i[0, 0] ** 2 + rotation_i[1, 0] ** 2
        defined = cosine_squared >= GIMBAL**2
        divisor = jnp.where(defined, cosine_squared, 1.0)
        scale = jnp.where(defined, -rotation_i[2, 0] / divisor, 0.0)  # tan q / cos q
        yaw_row = jnp.stack([scale * rotation_i[0, 0], scale * rotation_i[1, 0], one])
    # hat(d) Hz is a single outer product, (d × z) ⊗ yaw_row, and the yaw leaves z alone.
    turned = jnp.stack([levered[1], -levered[0], nothing])
    jacobian = jnp.concatenate([turned[:, None] * yaw_row[None, :], -unyaw, unyaw], axis=1)
    return displacement - predicted, jacobian, defined


def gate(
    memory: GateState,
    config: FilterConfig,
    now: Array,
    oldest: Array,
    nis: Float[Array, ""],
    tried: Array,
) -> tuple[GateState, Float[Array, ""]]:
    """TLIO's gate: the weight of the measurement, 1 if it passes as it is and 0 if not, and the
    gate's memory after it.

    `now` and `oldest` are the samples of the newest and the oldest clone. Where `tried` is False,
    an earlier last success moves along (ours): absence is not staleness, or the first second after
    any hole would pass unchecked. TLIO has a measurement at every clone. Comparisons are strict, as
    "more than" and "older" say; at the very end of a pause the gate is active again. With
    `gate_softness` the active gate weighs instead (ours); its memory still takes what is above the
    threshold for a failure.
    """
    old_enough = oldest > _whole(config.convergence_seconds, config)
    memory = memory._replace(converged=memory.converged | (tried & old_enough))
    active, stale = _watching(memory, config, now)
    fits = nis <= config.gate_threshold
    passed = tried & (~active | fits)
    pause = -int(np.floor(-config.pause_seconds / config.dt + 1e-6))
    weight = passed.astype(nis.dtype)
    if config.gate_softness > 0:
        slope = jax.nn.sigmoid((config.gate_threshold - nis) / config.gate_softness)
        weight = jnp.where(tried, jnp.where(active, slope, 1.0), 0.0)
    waited = ~tried & (memory.last_success >= 0)
    last_success = memory.last_success + config.samples_per_clone * waited.astype(jnp.int32)
    return GateState(
        converged=memory.converged,
        last_success=jnp.where(passed, now, last_success),
        pause_end=jnp.where(tried & stale, now + pause, memory.pause_end),
    ), weight


def _whole(seconds: float, config: FilterConfig) -> int:
    """In samples: t·dt > seconds  ⇔  t > _whole(seconds), whatever the last bit of seconds / dt."""
    return int(np.floor(seconds / config.dt + 1e-6))


def _watching(
    memory: GateState, config: FilterConfig, now: Array
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether the gate is active at sample `now`, and whether only an old success hinders it."""
    watching = memory.converged & (now >= memory.pause_end)
    old = now - memory.last_success > _whole(config.success_seconds, config)
    stale = watching & (memory.last_success >= 0) & old
    return watching & ~stale, stale


def update(
    state: FilterState,
    measurement: Measurement,
    newest: Array | int,
    oldest: Array | int,
    config: FilterConfig,
    frame: Frame = "given",
) -> tuple[FilterState, Outcome]:
    """`correct` for those who do not smooth."""
    state, outcome, _ = correct(state, measurement, newest, oldest, config, frame)
    return state, outcome


def correct(
    state: FilterState,
    measurement: Measurement,
    newest: Array | int,
    oldest: Array | int,
    config: FilterConfig,
    frame: Frame,
) -> tuple[FilterState, Outcome, Correction]:
    """One EKF update with the displacement between the clones in slots `oldest` and `newest` of the
    ring, once it is full.

    H touches twelve rows of the covariance P, so H P is three rows. With S = H P Hᵀ + R = L Lᵀ and
    Y = L⁻¹ H P the gain is Yᵀ L⁻¹ and P ← P − Yᵀ Y, symmetric to the last bit. Nothing changes
    where there is no measurement, or it is rejected, or at gimbal lock.
    """
    present = measurement.present & (state.step >= state.clone_offset.shape[0])
    # Once in a round of the ring the oldest clone has the core's anchor, else the one before it.
    apart = jnp.where(oldest == 0, 0.0, 1.0).astype(state.move.dtype)
    moved = state.offset + apart * state.move - state.clone_offset[oldest]
    first = state.first
    turning = (
        moved if first is None else first.offset + apart * first.move - first.clone_offset[oldest]
    )
    innovation, jacobian, defined = displacement_residual(
        state.clone_rotation[oldest], moved, measurement.displacement, turning, frame
    )

    # The newest clone is the core's own pose: its rows of P are the core's.
    old = CLONE * oldest
    old_core = jax.lax.dynamic_slice_in_dim(state.cross_covariance, old, CLONE, 1)
    old_clones = jax.lax.dynamic_slice_in_dim(state.clone_covariance, old, CLONE, 0)
    new_core, new_clones = (
        part[OFFSET] + apart * part[MOVE]
        for part in (state.core_covariance, state.cross_covariance)
    )
    over_core = matmul(jacobian, jnp.concatenate([old_core.T, new_core]))
    over_clones = matmul(jacobian, jnp.concatenate([old_clones, new_clones]))
    over_new = over_core[:, OFFSET] + apart * over_core[:, MOVE]
    over_touched = jnp.concatenate(
        [jax.lax.dynamic_slice_in_dim(over_clones, old, CLONE, 1), over_new], axis=1
    )
    innovation_covariance = matmul(over_touched, jacobian.T)

    def factor(scale: Array | float) -> Cholesky:
        return cholesky(
            jnp.where(
                present,
                innovation_covariance + scale * measurement.covariance,
                jnp.eye(3, dtype=innovation.dtype),
            )
        )

    root = factor(1.0)
    whitened = root.solve(innovation[:, None])[:, 0]
    nis = jnp.dot(whitened, whitened)
    volume = root.diagonal[0] * root.diagonal[1] * root.diagonal[2]
    tried = present & defined
    now = state.step * config.samples_per_clone
    memory, weight = gate(state.gate, config, now, now - config.window, nis, tried)
    accepted = weight > 0
    if config.mahalanobis_fail_scale > 0:
        root, accepted = (
            factor(
                jnp.where(tried & ~accepted, config.mahalanobis_fail_scale, 1.0).astype(nis.dtype)
            ),
            tried,
        )
    if config.gate_softness > 0:
        root, accepted = factor(1 / jnp.clip(jnp.where(tried, weight, 1.0), LEAST_WEIGHT)), tried
    whitened = root.solve(innovation[:, None])[:, 0]
    over_core, over_clones, jacobian = (
        jnp.where(accepted, root.solve(rows), 0.0) for rows in (over_core, over_clones, jacobian)
    )
    of_new = (
        jnp.zeros_like(over_core)
        .at[:, OFFSET]
        .set(jacobian[:, 6:])
        .at[:, MOVE]
        .set(apart * jacobian[:, 6:])
    )
    correction = Correction(whitened, over_core, over_clones, of_new, jacobian[:, :CLONE])
    outcome = Outcome(
        present=present,
        tried=tried,
        innovation=innovation,
        nis=nis,
        volume=volume,
        gate_passed=weight,
        accepted=accepted,
    )
    # What bounds the correction is rᵀ S⁻¹ r with the S of the update, that is after any scaling.
    large = accepted & (jnp.dot(whitened, whitened) > config.gate_threshold)
    state = _relinearized(_apply(state, correction, newest), large)
    return state._replace(gate=memory), outcome, correction


def _relinearized(state: FilterState, wanted: Bool[Array, ""]) -> FilterState:
    """With the latest estimates in the place of the first, if `wanted`: see `FirstEstimates`."""
    if state.first is None:
        return state
    latest = FirstEstimates(state.velocity, state.offset, state.move, state.clone_offset)
    first = jax.tree.map(lambda new, old: jnp.where(wanted, new, old), latest, state.first)
    return state._replace(first=first)


def rest(state: FilterState, imu: Imu, config: FilterConfig) -> tuple[FilterState, Bool[Array, ""]]:
    """Whether the IMU has been quiet for `rest_seconds` (ours), and the state with the intervals
    that it has been so counted on."""
    gyro, force = imu.gyro - state.gyro_bias[None], imu.accel - state.accel_bias[None]
    quiet = jnp.all(jnp.sum(gyro**2, axis=1) < config.rest_gyro**2) & jnp.all(
        jnp.abs(jnp.sqrt(jnp.maximum(jnp.sum(force**2, axis=1), 1e-12)) - GRAVITY)
        < config.rest_accel
    )
    if imu.gap is not None:
        quiet = quiet & jnp.all(imu.gap.gyro_variance == 0)
    count = jnp.where(quiet, state.imu.quiet + 1, 0).astype(state.imu.quiet.dtype)
    enough = int(np.ceil(config.rest_seconds / (config.dt * config.samples_per_clone) - 1e-6))
    return state._replace(imu=state.imu._replace(quiet=count)), count >= max(enough, 1)


class Rest(NamedTuple):
    """What became of the velocity measured as zero; False and zero where it was not."""

    quiet: Bool[Array, ""]
    """Whether the IMU was quiet for long enough."""
    nis: Float[Array, ""]
    """vᵀ S⁻¹ v."""
    accepted: Bool[Array, ""]


def zero_velocity(
    state: FilterState,
    quiet: Bool[Array, ""],
    tried: Bool[Array, ""],
    newest: Array | int,
    config: FilterConfig,
) -> tuple[FilterState, Rest, Correction]:
    """One EKF update with the velocity measured as zero, if `quiet` (ours).

    The paper's gated head makes displacements small at rest instead. A quiet IMU may also glide at
    constant velocity, and a displacement of the same interval can tell. So where one was `tried`
    and the gate is active, this measurement has to pass the same χ² test. Elsewhere the filter may
    be wrong about its velocity, and rest is what can tell it: after the start, after a series of
    rejections, and where there are no displacements. Without them the gate never becomes stale, and
    a rest refused once would be refused for ever. The gate's memory is that of the displacements
    alone: a false rest must not open their gate, nor keep it shut.
    """
    noise = config.zero_velocity_std**2 * np.eye(3, dtype=state.velocity.dtype)
    root = cholesky(jnp.where(quiet, state.core_covariance[VELOCITY, VELOCITY], 0.0) + noise)
    whitened = -root.solve(state.velocity[:, None])[:, 0]
    nis = jnp.dot(whitened, whitened)
    fits = nis <= config.gate_threshold
    active, _ = _watching(state.gate, config, state.step * config.samples_per_clone)
    accepted = quiet & (~(active & tried) | fits)
    picked = np.eye(CORE, dtype=state.velocity.dtype)[VELOCITY]
    rows = (state.core_covariance[VELOCITY], state.cross_covariance[VELOCITY], picked)
    core, clones, jacobian = (jnp.where(accepted, root.solve(part), 0.0) for part in rows)
    correction = Correction(
        whitened,
        core,
        clones,
        jacobian,
        oldest_jacobian=jnp.zeros((3, CLONE), state.velocity.dtype),
    )
    state = _relinearized(_apply(state, correction, newest), accepted & ~fits)
    return state, Rest(quiet, jnp.where(quiet, nis, 0.0), accepted), correction


class Cholesky(NamedTuple):
    """L of L Lᵀ = S, 3×3, written out, because a call to LAPACK costs more than the whole update."""

    diagonal: tuple[Array, Array, Array]
    below: tuple[Array, Array, Array]
    """L[1,0], L[2,0], L[2,1]."""

    def solve(self, rows: Float[Array, "3 m"]) -> Float[Array, "3 m"]:
        """L⁻¹ rows."""
        (a, d, f), (b, c, e) = self.diagonal, self.below
        x = rows[0] / a
        y = (rows[1] - b * x) / d
        return jnp.stack([x, y, (rows[2] - c * x - e * y) / f])


def cholesky(s: Float[Array, "3 3"]) -> Cholesky:
    """The lower triangular root of S; NaN where S is not positive definite."""
    a = jnp.sqrt(s[0, 0])
    b, c = s[1, 0] / a, s[2, 0] / a
    d = jnp.sqrt(s[1, 1] - b * b)
    e = (s[2, 1] - c * b) / d
    return Cholesky((a, d, jnp.sqrt(s[2, 2] - c * c - e * e)), (b, c, e))


def _apply(state: FilterState, correction: Correction, newest: Array | int) -> FilterState:
    """Mean and covariance after an update: the error is Yᵀ L⁻¹ r, and P ← P − Yᵀ Y."""
    whitened, over_core, over_clones = correction[:3]
    # A reduction on purpose: it is kept, where the sum spelt out would be computed anew for every
    # entry that the retraction reads.
    error, clone_errors = (
        jnp.sum(whitened[:, None] * rows, axis=0) for rows in (over_core, over_clones)
    )
    return retract(state, error, clone_errors.reshape(-1, CLONE), newest)._replace(
        core_covariance=state.core_covariance - matmul(over_core.T, over_core),
        cross_covariance=state.cross_covariance - matmul(over_core.T, over_clones),
        clone_covariance=state.clone_covariance - matmul(over_clones.T, over_clones),
    )


def retract(
    state: FilterState, core: Float[Array, "21"], clones: Float[Array, "c 6"], newest: Array | int
) -> FilterState:
    """Add an error to the mean: R ← exp(δθ) R, the rest adds. The core's pose is that of the newest
    clone."""
    rotations = jax.vmap(matmul)(jax.vmap(geometry.exp)(clones[:, :3]), state.clone_rotation)
    offsets = state.clone_offset + clones[:, 3:]
    return state._replace(
        rotation=rotations[newest],
        velocity=state.velocity + core[VELOCITY],
        offset=offsets[newest],
        gyro_bias=state.gyro_bias + core[GYRO_BIAS],
        accel_bias=state.accel_bias + core[ACCEL_BIAS],
        anchor=state.anchor + core[ANCHOR],
        move=state.move + core[MOVE],
        clone_rotation=rotations,
        clone_offset=offsets,
    )
