"""One clone interval of IMU samples in closed form, and cloning (paper §III-G, after TLIO).

For one sample, with φ = (gyro − b_g) dt and Δv = R (accel − b_a) dt,

    R' = R exp(φ),  v' = v + Δv + g dt,  p' = p + ½ (v + v') dt,

and the error follows δ' = A δ + B w, where B holds the bias columns of A with the opposite sign.
So, with Φ_m the product of the A of samples m … n−1 (the tail from m) and N_l = Φ_{l+1} B_l the
reach of the noise of sample l to the end of the interval,

    Φ_m[v, θ] = −hat(Σ_{j≥m} Δv_j),   Φ_m[p, θ] = −hat(Σ_{j≥m} (n − j − ½) dt Δv_j),   Φ_m[p, v] =
    (n − m) dt I, Φ_m[:, b] = I_b − Σ_{l≥m} N_l, Q = Σ_l N_l diag(σ_g², σ_a²) N_lᵀ + dt Σ_{m≥1}
    Φ_m[:, b] diag(η_g², η_a²) Φ_m[:, b]ᵀ,

and every sum is one product with a constant triangular matrix: no loop over samples but that of the
rotations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.state import (
    ANCHOR,
    CLONE,
    MOVE,
    OFFSET,
    THETA,
    VELOCITY,
    FilterState,
    NoiseModel,
)
from gnio_jax.geometry import matmul
from gnio_jax.types import GRAVITY, Array


class Interval(NamedTuple):
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


def interval(state: FilterState, imu: Imu, noise: NoiseModel, dt: float) -> Interval:
    """Integrate the n samples of one clone interval, raw in the body frame, from `state`.

    Where the filter coasts through a gap, nothing turns and nothing falls (a sample like that is no
    function of the biases either), but the noise of the gap is added.
    """
    n, dtype = imu.gyro.shape[0], imu.gyro.dtype
    after = np.tril(
        np.ones((n, n))
    )  # column m sums the samples from m on; the samples lie along the last axis of everything here
    lever = (
        n - 0.5 - np.arange(n)
    ) * dt  # metres at the end of the interval for each m/s that sample l adds
    eye = np.eye(3, dtype=dtype)

    phi, force = (imu.gyro - state.gyro_bias[None]) * dt, (imu.accel - state.accel_bias[None]) * dt
    falling = np.array([n * dt, lever.sum() * dt], dtype)  # time and ½ time² under gravity
    if imu.gap is not None:
        phi, force = phi * imu.gap.used[:, None], force * imu.gap.used[:, None]
        falling = (np.stack([np.ones(n), lever]) * dt).astype(dtype) @ imu.gap.used
    rotations = geometry.cumulative_rotation(
        state.rotation, jax.vmap(geometry.exp, out_axes=2)(phi)
    )
    steps = matmul(rotations[:, :, :-1], force.T[:, None])[:, 0]  # Δv of every sample
    tails = steps @ np.concatenate(
        [after, after * lever[:, None]], axis=1, dtype=dtype
    )  # Σ_{j≥m} Δv_j, Σ_{j≥m} (n − j − ½) dt Δv_j
    carry = -jax.vmap(geometry.hat, in_axes=1, out_axes=2)(tails).reshape(
        3, 3, 2, n
    )  # Φ_m[v, θ] and Φ_m[p, θ], m = 0 … n − 1

    # N_l: the noise of sample l turns the rotation after it, and by that every later Δv.
    by_gyro = dt * matmul(rotations[:, :, 1:], jax.vmap(geometry.right_jacobian, out_axes=2)(phi))
    later = jnp.concatenate([carry[:, :, :, 1:], jnp.zeros((3, 3, 2, 1), dtype)], axis=3)
    by_gyro = jnp.concatenate(
        [by_gyro, matmul(later[:, :, 0], by_gyro), matmul(later[:, :, 1], by_gyro)]
    )
    by_accel = dt * rotations[:, :, :-1]
    by_accel = jnp.concatenate(
        [jnp.zeros_like(by_accel), by_accel, lever.astype(dtype)[None, None] * by_accel]
    )
    reach = jnp.concatenate([by_gyro, by_accel], axis=1)

    # Φ_m[θ v p, b] for m = 0 … n − 1 (it is zero for m = n), and last its sum over m ≥ 1, which is
    # Σ_l l N_l
    by_bias = reach if imu.gap is None else reach * imu.gap.used[None, None]
    bias_tails = -(
        by_bias.reshape(54, n) @ np.concatenate([after, np.arange(n)[:, None]], axis=1, dtype=dtype)
    ).reshape(9, 6, n + 1)
    duration = n * dt
    kinematics = np.block([[0 * eye, 0 * eye], [eye, 0 * eye], [duration * eye, eye]])
    by_tilt = jnp.concatenate([eye, carry[:, :, 0, 0], carry[:, :, 1, 0]])
    transition = jnp.concatenate(
        [
            jnp.concatenate([by_tilt, kinematics, bias_tails[:, :, 0]], axis=1),
            np.eye(15, dtype=dtype)[9:],
        ]
    )

    gyro_white, accel_white = noise.gyro_density**2 / dt, noise.accel_density**2 / dt
    walk = jnp.repeat(jnp.stack([noise.gyro_bias_walk, noise.accel_bias_walk]), 3) * math.sqrt(dt)
    # The accelerometer's white noise is isotropic, so its rotations drop out of R Rᵀ: what is left
    # is, for each sample, one number for each pair of v and p.
    pairs = dt**2 * np.einsum("il,jl->ijl", *2 * [np.stack([np.zeros(n), np.ones(n), lever])])
    if imu.gap is None:
        isotropic = accel_white * np.kron(pairs.sum(2), eye).astype(dtype)
    else:
        gyro_white = gyro_white + imu.gap.gyro_variance
        isotropic = jnp.kron(pairs.astype(dtype) @ (accel_white + imu.gap.accel_variance), eye)
    columns = [by_gyro, bias_tails[:, :, 1:n]]
    weighted = [
        by_gyro * jnp.broadcast_to(gyro_white, (1, 1, n)),
        bias_tails[:, :, 1:n] * walk[None, :, None] ** 2,
    ]
    left, right = (
        jnp.concatenate([part.reshape(9, -1) for part in parts], axis=1)
        for parts in (columns, weighted)
    )
    moved = isotropic + left @ right.T
    mixed = bias_tails[:, :, n] * walk[None] ** 2
    added = jnp.concatenate(
        [
            jnp.concatenate([moved, mixed], axis=1),
            jnp.concatenate([mixed.T, jnp.diag(n * walk**2)], axis=1),
        ]
    )

    gravity = np.array([0.0, 0.0, -GRAVITY], dtype)
    return Interval(
        rotation=geometry.orthonormalize(rotations[:, :, -1]),
        velocity=state.velocity + tails[:, 0] + gravity * falling[0],
        offset=state.offset + state.velocity * duration + tails[:, n] + gravity * falling[1],
        transition=transition,
        noise=added,
    )


def move_anchor(state: FilterState, wanted: Bool[Array, ""]) -> FilterState:
    """The mean with the anchor moved up to the present position, if `wanted`."""

    def moved(offset: Array, move: Array) -> tuple[Array, Array]:
        return jnp.where(wanted, 0.0, offset), jnp.where(wanted, offset, move)

    offset, move = moved(state.offset, state.move)
    first = state.first
    if first is not None:
        first = first._replace(
            **dict(zip(("offset", "move"), moved(first.offset, first.move), strict=True))
        )
    return state._replace(
        anchor=state.anchor + (state.offset - offset), offset=offset, move=move, first=first
    )


def transition(
    state: FilterState, motion: Interval, anchored: Bool[Array, ""]
) -> Float[Array, "9 15"]:
    """Of θ, v, o from those and the biases over an interval that begins from `state`, its anchor's
    move (`anchored`) included."""
    turned = (
        jnp.asarray(motion.transition)[:9]
        .at[:, OFFSET]
        .multiply(1 - anchored.astype(motion.offset.dtype))
    )
    first = state.first
    if first is not None:
        # Φ[v, θ] = −hat(v' − v − g T), Φ[p, θ] = −hat(p' − p − v T − ½ g T²), with the first v and
        # p in the place of the latest
        duration = motion.transition[OFFSET.start, VELOCITY.start]
        velocity, offset = (
            geometry.hat(state.velocity - first.velocity),
            geometry.hat(state.offset - first.offset),
        )
        turned = (
            turned.at[VELOCITY, THETA]
            .add(-velocity)
            .at[OFFSET, THETA]
            .add(-offset - duration * velocity)
        )
    return turned


def propagate(
    state: FilterState, motion: Interval, anchored: Bool[Array, ""], slot: Array | int
) -> FilterState:
    """Move mean and covariance over one interval and clone the new pose into `slot` of the ring, in
    the place of the oldest.

    `anchored`: the interval began with a new anchor, so the offset's error went over into the
    anchor's and its move's.
    """
    kept = 1 - anchored.astype(motion.offset.dtype)
    turned = transition(state, motion, anchored)
    first = state.first
    if first is not None:
        first = first._replace(
            velocity=motion.velocity,
            offset=motion.offset,
            clone_offset=jax.lax.dynamic_update_index_in_dim(
                first.clone_offset, motion.offset, slot, 0
            ),
        )

    def move(rows: Float[Array, "21 m"]) -> Float[Array, "21 m"]:
        over = (1 - kept) * rows[OFFSET]
        return jnp.concatenate(
            [
                turned @ rows[: ANCHOR.start],
                rows[9 : ANCHOR.start],
                rows[ANCHOR] + over,
                kept * rows[MOVE] + over,
            ]
        )

    core = move(move(state.core_covariance).T) + jnp.pad(
        motion.noise, (0, MOVE.stop - len(motion.noise))
    )
    core = (
        0.5 * (core + core.T)
    )  # the variance of the position grows, and with it what rounding leaves between the two triangles
    of_pose = jnp.concatenate([core[:, THETA], core[:, OFFSET]], axis=1)
    cross = _put(move(state.cross_covariance), of_pose, 0, CLONE * slot)
    rows = jnp.concatenate([cross[THETA], cross[OFFSET]])
    clones = _put(_put(state.clone_covariance, rows, CLONE * slot, 0), rows.T, 0, CLONE * slot)
    return state._replace(
        rotation=motion.rotation,
        velocity=motion.velocity,
        offset=motion.offset,
        clone_rotation=jax.lax.dynamic_update_index_in_dim(
            state.clone_rotation, motion.rotation, slot, 0
        ),
        clone_offset=jax.lax.dynamic_update_index_in_dim(
            state.clone_offset, motion.offset, slot, 0
        ),
        core_covariance=core,
        cross_covariance=cross,
        clone_covariance=clones,
        step=state.step + 1,
        first=first,
    )


def _put(matrix: Array, block: Array, row: Array | int, column: Array | int) -> Array:
    return jax.lax.dynamic_update_slice(matrix, block, (jnp.int32(row), jnp.int32(column)))
