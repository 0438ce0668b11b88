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

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.filtering.state import CLONE, CORE, POSITION, THETA, FilterState, NoiseModel
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
    tail = np.triu(np.ones((n, n)))  # row m sums the samples from m on
    lever = tail * ((n - 0.5 - np.arange(n)) * dt)  # and carries a step in velocity on to the position at the end
    left = np.concatenate([(n - 1.5 - np.arange(n)) * dt])[:, None, None] + dt  # same lever, per sample

    phi = (gyro - state.gyro_bias[None]) * dt
    rotations = _matmul(state.rotation[None], geometry.cumulative_rotation(phi))  # R_0 … R_n
    velocity_steps = _matvec(rotations[:-1], (accel - state.accel_bias[None]) * dt)
    velocity_tail, position_tail = tail.astype(dtype) @ velocity_steps, lever.astype(dtype) @ velocity_steps
    carry_velocity, carry_position = -jax.vmap(geometry.hat)(velocity_tail), -jax.vmap(geometry.hat)(position_tail)

    # N_l, rows θ, v, p: the noise of sample l turns the rotation after it and so all later Δv.
    by_gyro = dt * _matmul(rotations[1:], jax.vmap(geometry.right_jacobian)(phi))
    by_accel = dt * rotations[:-1]
    zero = jnp.zeros((1, 3, 3), dtype)
    reach = jnp.concatenate([
        jnp.concatenate([by_gyro, _matmul(jnp.concatenate([carry_velocity[1:], zero]), by_gyro),
                         _matmul(jnp.concatenate([carry_position[1:], zero]), by_gyro)], axis=1),
        jnp.concatenate([jnp.zeros((n, 3, 3), dtype), by_accel, left.astype(dtype) * by_accel], axis=1)], axis=2)
    bias_tail = -(tail.astype(dtype) @ reach.reshape(n, 54)).reshape(n, 9, 6)  # Φ_m[θ v p, b], m = 0 … n−1; Φ_n's is zero

    identity = jnp.eye(3, dtype=dtype)
    transition = jnp.eye(CORE, dtype=dtype).at[3:6, 0:3].set(carry_velocity[0]).at[6:9, 0:3].set(carry_position[0])
    transition = transition.at[6:9, 3:6].set(n * dt * identity).at[:9, 9:].set(bias_tail[0])
    std = jnp.stack([jnp.asarray(value, dtype) for value in noise])
    white = (std[:2] / np.sqrt(dt))[np.array([0, 0, 0, 1, 1, 1])]
    walk = (std[2:] * np.sqrt(dt))[np.array([0, 0, 0, 1, 1, 1])]
    by_white = jnp.concatenate([reach, jnp.zeros((n, 6, 6), dtype)], axis=1) * white[None, None]
    by_walk = jnp.concatenate([jnp.concatenate([bias_tail[1:], jnp.zeros((1, 9, 6), dtype)]),
                               jnp.tile(jnp.eye(6, dtype=dtype)[None], (n, 1, 1))], axis=1) * walk[None, None]
    columns = jnp.concatenate([by_white, by_walk], axis=2).transpose(1, 0, 2).reshape(CORE, n * 12)

    duration = n * dt
    gravity = jnp.array([0.0, 0.0, -GRAVITY], dtype)
    return Interval(
        rotation=rotations[-1], velocity=state.velocity + velocity_tail[0] + gravity * duration,
        position=state.position + state.velocity * duration + position_tail[0] + gravity * (0.5 * duration**2),
        transition=transition, noise=columns @ columns.T)


def propagate(state: FilterState, motion: Interval, slot: Array | int) -> FilterState:
    """Move mean and covariance over one interval and clone the new pose into `slot` of the ring, in the place of the oldest."""
    core = motion.transition @ state.core_covariance @ motion.transition.T + motion.noise
    pose = np.r_[THETA, POSITION]
    cross = _put(motion.transition @ state.cross_covariance, core[:, pose], 0, CLONE * slot)
    rows = cross[pose]
    clones = _put(_put(state.clone_covariance, rows, CLONE * slot, 0), rows.T, 0, CLONE * slot)
    return state._replace(
        rotation=motion.rotation, velocity=motion.velocity, position=motion.position,
        clone_rotation=jax.lax.dynamic_update_index_in_dim(state.clone_rotation, motion.rotation, slot, 0),
        clone_position=jax.lax.dynamic_update_index_in_dim(state.clone_position, motion.position, slot, 0),
        core_covariance=core, cross_covariance=cross, clone_covariance=clones, step=state.step + 1)


def _put(matrix: Array, block: Array, row: Array | int, column: Array | int) -> Array:
    return jax.lax.dynamic_update_slice(matrix, block, (jnp.int32(row), jnp.int32(column)))


# Written as sums: XLA fuses them with their neighbours, where a batch of 3×3 dots would be a call each.
def _matmul(a: Float[Array, "#n 3 3"], b: Float[Array, "#n 3 3"]) -> Float[Array, "n 3 3"]:
    return jnp.sum(a[:, :, :, None] * b[:, None, :, :], axis=2)


def _matvec(a: Float[Array, "n 3 3"], v: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return jnp.sum(a * v[:, None, :], axis=2)
