"""One clone interval of IMU samples in closed form, and cloning (paper §III-G, after TLIO).

For one sample, with φ = (gyro − b_g) dt and Δv = R (accel − b_a) dt,

    R' = R exp(φ),  v' = v + Δv + g dt,  p' = p + ½ (v + v') dt,

and the error follows δ' = A δ + B w, where B holds the bias columns of A with the opposite sign.
So, with Φ_m the product of the A of samples m … n−1 (the tail from m) and N_l = Φ_{l+1} B_l the
reach of the noise of sample l to the end of the interval,

    Φ_m[v, θ] = −hat(Σ_{j≥m} Δv_j),
    Φ_m[p, θ] = −hat(Σ_{j≥m} (n − j − ½) dt Δv_j),
    Φ_m[p, v] = (n − m) dt I,
    Φ_m[:, b] = I_b − Σ_{l≥m} N_l,
    Q = Σ_l N_l diag(σ_g², σ_a²) N_lᵀ + dt Σ_{m≥1} Φ_m[:, b] diag(η_g², η_a²) Φ_m[:, b]ᵀ,

and every sum is one product with a constant triangular matrix: no loop over samples but that of the
rotations. The samples lie along the last axis of every array of an interval.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.config import NoiseModel
from gnio_jax.filtering.gaps import Gap, Imu
from gnio_jax.filtering.lasting_errors import LastingMotion
from gnio_jax.filtering.state import (
    ANCHOR,
    BIASES,
    CLONE,
    LASTING,
    LOCAL,
    MOTION,
    MOVE,
    OFFSET,
    THETA,
    VELOCITY,
    FilterState,
    FirstEstimates,
)
from gnio_jax.geometry import matmul
from gnio_jax.types import GRAVITY, Array


class IntervalMotion(NamedTuple):
    """What one clone interval does to the state."""

    rotation: Float[Array, "3 3"]
    """At the end, body → world."""
    velocity: Float[Array, "3"]
    """At the end, m/s."""
    offset: Float[Array, "3"]
    """Position at the end, from the anchor, m."""
    transition: Float[Array, "15 15"]
    """Φ of the error of θ, v, o, b_g, b_a over the interval; the anchor stays."""
    noise: Float[Array, "15 15"]
    """Q, the covariance it adds to them."""


class _NoiseReach(NamedTuple):
    """N_l over θ, v, p: what the noise of each sample has become at the end of the interval."""

    gyro: Float[Array, "9 3 n"]
    accel: Float[Array, "9 3 n"]


class _BiasTails(NamedTuple):
    """Φ_m[:, b] over θ, v, p: what biases from sample m on have become at the end."""

    whole: Float[Array, "9 6"]
    """m = 0: of the whole interval."""
    inner: Float[Array, "9 6 n-1"]
    """m = 1 … n − 1."""
    inner_sum: Float[Array, "9 6"]
    """Σ_{m≥1}, which is −Σ_l l N_l."""


def integrate_interval(
    state: FilterState, imu: Imu, noise: NoiseModel, dt: float
) -> IntervalMotion:
    """Integrate the n samples of one clone interval, raw in the body frame, from `state`.

    Where the filter coasts through a gap, nothing turns and nothing falls (a sample like that is no
    function of the biases either), but the noise of the gap is added.
    """
    n, dtype = imu.gyro.shape[0], imu.gyro.dtype
    turns = (imu.gyro - state.gyro_bias[None]) * dt
    pushes = (imu.accel - state.accel_bias[None]) * dt
    if imu.gap is not None:
        turns, pushes = turns * imu.gap.used[:, None], pushes * imu.gap.used[:, None]
    rotations = geometry.integrate_turns(state.rotation, turns)
    velocity_steps = matmul(rotations[:, :, :-1], pushes.T[:, None])[:, 0]  # Δv of every sample

    # Σ_{j≥m} Δv_j for m = 0 … n − 1, then Σ_{j≥m} (n − j − ½) dt Δv_j.
    from_sample, lever = _tail_sums(n), _levers(n, dt)
    both = np.concatenate([from_sample, from_sample * lever[:, None]], axis=1, dtype=dtype)
    tails = velocity_steps @ both
    velocity_gain, position_gain = tails[:, 0], tails[:, n]
    by_tilt = -jax.vmap(geometry.hat, in_axes=1, out_axes=2)(tails).reshape(3, 3, 2, n)

    reach = _noise_reach(turns, rotations, by_tilt, dt)
    bias_tails = _bias_tails(reach, imu.gap)
    fall_velocity, fall_position = _free_fall(n, dt, dtype, imu.gap)
    gravity = np.array([0.0, 0.0, -GRAVITY], dtype)
    duration = n * dt
    return IntervalMotion(
        rotation=geometry.orthonormalize(rotations[:, :, -1]),
        velocity=state.velocity + velocity_gain + gravity * fall_velocity,
        offset=state.offset + state.velocity * duration + position_gain + gravity * fall_position,
        transition=_interval_transition(by_tilt[:, :, :, 0], bias_tails.whole, duration),
        noise=_interval_noise(reach, bias_tails, noise, imu.gap, dt),
    )


def _tail_sums(n: int) -> Float[np.ndarray, "n n"]:
    """Column m sums the samples from m on."""
    return np.tril(np.ones((n, n)))


def _levers(n: int, dt: float) -> Float[np.ndarray, "n"]:
    """Metres at the end of the interval for each m/s that sample l adds: (n − l − ½) dt."""
    return (n - 0.5 - np.arange(n)) * dt


def _free_fall(n: int, dt: float, dtype: np.dtype, gap: Gap | None) -> Float[Array, "2"]:
    """Time and ½ time² under gravity, coasted samples left out."""
    lever = _levers(n, dt)
    if gap is None:
        return np.array([n * dt, lever.sum() * dt], dtype)
    return (np.stack([np.ones(n), lever]) * dt).astype(dtype) @ gap.used


def _noise_reach(
    turns: Float[Array, "n 3"],
    rotations: Float[Array, "3 3 n+1"],
    by_tilt: Float[Array, "3 3 2 n"],
    dt: float,
) -> _NoiseReach:
    """N_l: the noise of a sample turns the rotation after it, and by that every later Δv."""
    n, dtype = turns.shape[0], turns.dtype
    right_jacobians = jax.vmap(geometry.right_jacobian, out_axes=2)(turns)
    theta_by_gyro = dt * matmul(rotations[:, :, 1:], right_jacobians)
    later = jnp.concatenate([by_tilt[:, :, :, 1:], jnp.zeros((3, 3, 2, 1), dtype)], axis=3)
    velocity_by_gyro = matmul(later[:, :, 0], theta_by_gyro)
    position_by_gyro = matmul(later[:, :, 1], theta_by_gyro)
    velocity_by_accel = dt * rotations[:, :, :-1]
    position_by_accel = _levers(n, dt).astype(dtype)[None, None] * velocity_by_accel
    theta_by_accel = jnp.zeros_like(velocity_by_accel)
    return _NoiseReach(
        gyro=jnp.concatenate([theta_by_gyro, velocity_by_gyro, position_by_gyro]),
        accel=jnp.concatenate([theta_by_accel, velocity_by_accel, position_by_accel]),
    )


def _bias_tails(reach: _NoiseReach, gap: Gap | None) -> _BiasTails:
    """Φ_m[:, b] = −Σ_{l≥m} N_l, of the samples that the filter uses."""
    by_bias = jnp.concatenate(reach, axis=1)
    if gap is not None:
        by_bias = by_bias * gap.used[None, None]
    n, dtype = by_bias.shape[2], by_bias.dtype
    sums = np.concatenate([_tail_sums(n), np.arange(n)[:, None]], axis=1, dtype=dtype)
    tails = -(by_bias.reshape(9 * 6, n) @ sums).reshape(9, 6, n + 1)
    return _BiasTails(whole=tails[:, :, 0], inner=tails[:, :, 1:n], inner_sum=tails[:, :, n])


def _interval_transition(
    by_tilt: Float[Array, "3 3 2"], by_bias: Float[Array, "9 6"], duration: float
) -> Float[Array, "15 15"]:
    """Φ of θ, v, o, b_g, b_a: columns of θ, of v and o, of the biases, which stay."""
    dtype = by_tilt.dtype
    eye, zero = np.eye(3, dtype=dtype), np.zeros((3, 3), dtype)
    of_theta = jnp.concatenate([eye, by_tilt[:, :, 0], by_tilt[:, :, 1]])
    of_velocity_offset = np.block([[zero, zero], [eye, zero], [duration * eye, eye]])
    moved = jnp.concatenate([of_theta, of_velocity_offset, by_bias], axis=1)
    return jnp.concatenate([moved, np.eye(15, dtype=dtype)[BIASES]])


def _interval_noise(
    reach: _NoiseReach, bias_tails: _BiasTails, noise: NoiseModel, gap: Gap | None, dt: float
) -> Float[Array, "15 15"]:
    """Q of θ, v, o, b_g, b_a: white noise of both sensors, and the walks of their biases."""
    n = reach.gyro.shape[2]
    gyro_white = noise.gyro_density**2 / dt
    if gap is not None:
        gyro_white = gyro_white + gap.gyro_variance
    walk = jnp.repeat(jnp.stack([noise.gyro_bias_walk, noise.accel_bias_walk]), 3) * math.sqrt(dt)
    # Σ_l N_l σ_g² N_lᵀ and Σ_m Φ_m η² Φ_mᵀ as one product of 9 rows.
    columns = [reach.gyro, bias_tails.inner]
    weighted = [
        reach.gyro * jnp.broadcast_to(gyro_white, (1, 1, n)),
        bias_tails.inner * walk[None, :, None] ** 2,
    ]
    left, right = (
        jnp.concatenate([part.reshape(9, -1) for part in parts], axis=1)
        for parts in (columns, weighted)
    )
    moved = _accel_noise(noise, gap, n, dt, left.dtype) + left @ right.T
    mixed = bias_tails.inner_sum * walk[None] ** 2
    return jnp.concatenate(
        [
            jnp.concatenate([moved, mixed], axis=1),
            jnp.concatenate([mixed.T, jnp.diag(n * walk**2)], axis=1),
        ]
    )


def _accel_noise(
    noise: NoiseModel, gap: Gap | None, n: int, dt: float, dtype: np.dtype
) -> Float[Array, "9 9"]:
    """Σ_l N_l σ_a² N_lᵀ of the accelerometer over θ, v, o.

    Its white noise is isotropic, so its rotations drop out of R Rᵀ: what is left is, for each
    sample, one number for each pair of v and o.
    """
    eye = np.eye(3, dtype=dtype)
    gains = np.stack([np.zeros(n), np.ones(n), _levers(n, dt)])
    pairs = dt**2 * np.einsum("il,jl->ijl", gains, gains)
    accel_white = noise.accel_density**2 / dt
    if gap is None:
        return accel_white * np.kron(pairs.sum(2), eye).astype(dtype)
    return jnp.kron(pairs.astype(dtype) @ (accel_white + gap.accel_variance), eye)


def transition(
    state: FilterState, motion: IntervalMotion, anchored: Bool[Array, ""]
) -> Float[Array, "9 15"]:
    """Φ of θ, v, o from those and the biases over an interval that begins from `state`.

    The anchor's move before it (`anchored`) is included: it leaves no offset.
    """
    kept = 1 - anchored.astype(motion.offset.dtype)
    moved = jnp.asarray(motion.transition)[MOTION].at[:, OFFSET].multiply(kept)
    first = state.first
    if first is None:
        return moved
    # Φ[v, θ] = −hat(v' − v − g T), Φ[p, θ] = −hat(p' − p − v T − ½ g T²), with the first v and p in
    # the place of the latest.
    duration = motion.transition[OFFSET.start, VELOCITY.start]
    velocity = geometry.hat(state.velocity - first.velocity)
    offset = geometry.hat(state.offset - first.offset)
    moved = moved.at[VELOCITY, THETA].add(-velocity)
    return moved.at[OFFSET, THETA].add(-offset - duration * velocity)


def propagate(
    state: FilterState,
    motion: IntervalMotion,
    lasting: LastingMotion,
    anchored: Bool[Array, ""],
    slot: Array | int,
) -> FilterState:
    """Move mean and covariance over one interval and clone the new pose into `slot` of the ring, in
    the place of the oldest.

    `anchored`: the interval began with a new anchor, so the offset's error went over into the
    anchor's and its move's.
    """
    kept = 1 - anchored.astype(motion.offset.dtype)
    moved = transition(state, motion, anchored)

    def move(rows: Float[Array, "n m"]) -> Float[Array, "n m"]:
        over = (1 - kept) * rows[OFFSET]
        anchor, last_move = rows[ANCHOR] + over, kept * rows[MOVE] + over
        errors = lasting.decay[:, None] * rows[LASTING]
        return jnp.concatenate([moved @ rows[LOCAL], rows[BIASES], anchor, last_move, errors])

    core = move(move(state.core_covariance).T) + _core_noise(motion, lasting)
    # The variance of the position grows, and with it what rounding leaves between the triangles.
    core = 0.5 * (core + core.T)
    clone = CLONE * slot
    of_pose = jnp.concatenate([core[:, THETA], core[:, OFFSET]], axis=1)
    cross = _put(move(state.cross_covariance), of_pose, 0, clone)
    rows = jnp.concatenate([cross[THETA], cross[OFFSET]])
    clones = _replace_clone(state.clone_covariance, rows, clone)
    return state._replace(
        rotation=motion.rotation,
        velocity=motion.velocity,
        offset=motion.offset,
        lasting=lasting.decay * state.lasting,
        clone_rotation=_replaced(state.clone_rotation, motion.rotation, slot),
        clone_offset=_replaced(state.clone_offset, motion.offset, slot),
        core_covariance=core,
        cross_covariance=cross,
        clone_covariance=clones,
        step=state.step + 1,
        first=_first_estimates(state.first, motion, slot),
    )


def _core_noise(motion: IntervalMotion, lasting: LastingMotion) -> Float[Array, "n n"]:
    """What an interval adds to the covariance of the core; the anchor and its move stay."""
    of_motion, of_errors = motion.noise, jnp.diag(lasting.variance)
    errors = len(lasting.variance)
    return jnp.pad(of_motion, (0, MOVE.stop + errors - len(of_motion))) + jnp.pad(
        of_errors, (MOVE.stop, 0)
    )


def _first_estimates(
    first: FirstEstimates | None, motion: IntervalMotion, slot: Array | int
) -> FirstEstimates | None:
    """With those of the end of the interval."""
    if first is None:
        return None
    return first._replace(
        velocity=motion.velocity,
        offset=motion.offset,
        clone_offset=_replaced(first.clone_offset, motion.offset, slot),
    )


@jax.custom_jvp
def _replace_clone(
    covariance: Float[Array, "m m"], rows: Float[Array, "6 m"], entry: Array | int
) -> Float[Array, "m m"]:
    """The covariance of the clones with `rows`, and the columns that mirror them, from `entry`."""
    return _put(_put(covariance, rows, entry, 0), rows.T, 0, entry)


@_replace_clone.defjvp
def _replace_clone_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """With a mask: the transpose of overwriting would copy the whole matrix for each write."""
    covariance, _, entry = primals
    d_covariance, d_rows, _ = tangents
    index = np.arange(len(covariance))
    kept = ((index < entry) | (index >= entry + CLONE)).astype(covariance.dtype)
    nothing = jnp.zeros_like(covariance)
    changed = _put(nothing, d_rows * kept[None], entry, 0) + _put(nothing, d_rows.T, 0, entry)
    d_others = d_covariance * kept[:, None] * kept[None]
    return _replace_clone(*primals), d_others + changed


def _replaced(ring: Array, value: Array, slot: Array | int) -> Array:
    return jax.lax.dynamic_update_index_in_dim(ring, value, slot, 0)


def _put(matrix: Array, block: Array, row: Array | int, column: Array | int) -> Array:
    return jax.lax.dynamic_update_slice(matrix, block, (jnp.int32(row), jnp.int32(column)))
