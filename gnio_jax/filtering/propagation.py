"""One clone interval of IMU samples in closed form, and cloning (paper §III-G, after TLIO).

For one sample, with φ = (gyro − b_g) dt and Δv = R (accel − b_a) dt,

    R' = R exp(φ),  v' = v + Δv + g dt,  p' = p + ½ (v + v') dt,

and the error follows δ' = A δ + B w, where B holds the bias columns of A with the opposite sign. So, with Φ_m the product of the A
of samples m … n−1 (the tail from m) and N_l = Φ_{l+1} B_l the reach of the noise of sample l to the end of the interval,

    Φ_m[v, θ] = −hat(Σ_{j≥m} Δv_j),   Φ_m[p, θ] = −hat(Σ_{j≥m} (n − j − ½) dt Δv_j),   Φ_m[p, v] = (n − m) dt I,
    Φ_m[:, b] = I_b − Σ_{l≥m} N_l,
    Q = Σ_l N_l diag(σ_g², σ_a²) N_lᵀ + dt Σ_{m≥1} Φ_m[:, b] diag(η_g², η_a²) Φ_m[:, b]ᵀ,

and every sum is one product with a constant triangular matrix: no loop over samples but that of the rotations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.filtering.state import CLONE, CORE, POSITION, THETA, FilterState, NoiseModel
from gnio_jax.geometry import matmul
from gnio_jax.types import GRAVITY, Array


class Interval(NamedTuple):
    """What one clone interval does to the state."""

    rotation: Float[Array, "3 3"]
    """At the end, body → world."""
    velocity: Float[Array, "3"]
    """At the end, m/s."""
    position: Float[Array, "3"]
    """At the end, m."""
    transition: Float[Array, "15 15"]
    """Φ of the core error over the interval."""
    noise: Float[Array, "15 15"]
    """Q, the covariance it adds."""


def interval(state: FilterState, gyro: Float[Array, "n 3"], accel: Float[Array, "n 3"], noise: NoiseModel, dt: float) -> Interval:
    """Integrate the n samples of one clone interval, gyro rad/s and accel m/s² raw in the body frame, from `state`."""
    n, dtype = gyro.shape[0], gyro.dtype
    after = np.tril(np.ones((n, n)))  # column m sums the samples from m on; the samples lie along the last axis of everything here
    lever = (n - 0.5 - np.arange(n)) * dt  # metres at the end of the interval for each m/s that sample l adds
    eye = np.eye(3, dtype=dtype)

    phi = (gyro - state.gyro_bias[None]) * dt
    rotations = geometry.cumulative_rotation(state.rotation, jax.vmap(geometry.exp, out_axes=2)(phi))
    steps = matmul(rotations[:, :, :-1], ((accel - state.accel_bias[None]) * dt).T[:, None])[:, 0]  # Δv of every sample
    tails = steps @ np.concatenate([after, after * lever[:, None]], axis=1, dtype=dtype)  # Σ_{j≥m} Δv_j, Σ_{j≥m} (n − j − ½) dt Δv_j
    carry = -jax.vmap(geometry.hat, in_axes=1, out_axes=2)(tails).reshape(3, 3, 2, n)  # Φ_m[v, θ] and Φ_m[p, θ], m = 0 … n − 1

    # N_l: the noise of sample l turns the rotation after it, and by that every later Δv.
    by_gyro = dt * matmul(rotations[:, :, 1:], jax.vmap(geometry.right_jacobian, out_axes=2)(phi))
    later = jnp.concatenate([carry[:, :, :, 1:], jnp.zeros((3, 3, 2, 1), dtype)], axis=3)
    by_gyro = jnp.concatenate([by_gyro, matmul(later[:, :, 0], by_gyro), matmul(later[:, :, 1], by_gyro)])
    by_accel = dt * rotations[:, :, :-1]
    by_accel = jnp.concatenate([jnp.zeros_like(by_accel), by_accel, lever.astype(dtype)[None, None] * by_accel])
    reach = jnp.concatenate([by_gyro, by_accel], axis=1)

    # Φ_m[θ v p, b] for m = 0 … n − 1 (it is zero for m = n), and last its sum over m ≥ 1, which is Σ_l l N_l
    bias_tails = -(reach.reshape(54, n) @ np.concatenate([after, np.arange(n)[:, None]], axis=1, dtype=dtype)).reshape(9, 6, n + 1)
    duration = n * dt
    kinematics = np.block([[0 * eye, 0 * eye], [eye, 0 * eye], [duration * eye, eye]])
    by_tilt = jnp.concatenate([eye, carry[:, :, 0, 0], carry[:, :, 1, 0]])
    transition = jnp.concatenate([jnp.concatenate([by_tilt, kinematics, bias_tails[:, :, 0]], axis=1), np.eye(CORE, dtype=dtype)[9:]])

    gyro_white, accel_white = noise.gyro_density / math.sqrt(dt), noise.accel_density / math.sqrt(dt)
    walk = jnp.repeat(jnp.stack([noise.gyro_bias_walk, noise.accel_bias_walk]), 3) * math.sqrt(dt)
    # The accelerometer's white noise is isotropic, so its rotations drop out of R Rᵀ.
    per_axis = dt**2 * np.array([[n, lever.sum()], [lever.sum(), (lever**2).sum()]])
    isotropic = np.kron(np.pad(per_axis, ((1, 0), (1, 0))), np.eye(3)).astype(dtype)
    columns = [by_gyro, bias_tails[:, :, 1:n]]
    weights = [gyro_white**2, walk[:, None, None] ** 2]
    left = jnp.concatenate([part.reshape(9, -1) for part in columns], axis=1)
    right = jnp.concatenate([(weight * part.transpose(1, 2, 0)).reshape(-1, 9) for weight, part in zip(weights, columns, strict=True)])
    moved = accel_white**2 * isotropic + left @ right
    mixed = bias_tails[:, :, n] * walk[None] ** 2
    added = jnp.concatenate([jnp.concatenate([moved, mixed], axis=1),
                             jnp.concatenate([mixed.T, jnp.diag(n * walk**2)], axis=1)])

    gravity = np.array([0.0, 0.0, -GRAVITY], dtype)
    return Interval(
        rotation=rotations[:, :, -1], velocity=state.velocity + tails[:, 0] + gravity * duration,
        position=state.position + state.velocity * duration + tails[:, n] + gravity * (0.5 * duration**2),
        transition=transition, noise=added)


def propagate(state: FilterState, motion: Interval, slot: Array | int) -> FilterState:
    """Move mean and covariance over one interval and clone the new pose into `slot` of the ring, in the place of the oldest."""
    core = matmul(motion.transition @ state.core_covariance, motion.transition.T) + motion.noise
    of_pose = jnp.concatenate([core[:, THETA], core[:, POSITION]], axis=1)
    cross = _put(motion.transition @ state.cross_covariance, of_pose, 0, CLONE * slot)
    rows = jnp.concatenate([cross[THETA], cross[POSITION]])
    clones = _put(_put(state.clone_covariance, rows, CLONE * slot, 0), rows.T, 0, CLONE * slot)
    return state._replace(
        rotation=motion.rotation, velocity=motion.velocity, position=motion.position,
        clone_rotation=jax.lax.dynamic_update_index_in_dim(state.clone_rotation, motion.rotation, slot, 0),
        clone_position=jax.lax.dynamic_update_index_in_dim(state.clone_position, motion.position, slot, 0),
        core_covariance=core, cross_covariance=cross, clone_covariance=clones, step=state.step + 1)


def _put(matrix: Array, block: Array, row: Array | int, column: Array | int) -> Array:
    return jax.lax.dynamic_update_slice(matrix, block, (jnp.int32(row), jnp.int32(column)))
