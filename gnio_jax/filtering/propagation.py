"""Inertial propagation of mean and covariance over one clone interval, and cloning (paper §III-G,
after TLIO).

For one sample, with φ = (gyro − b_g) dt and Δv = R (accel − b_a) dt,

    R' = R exp(φ),  v' = v + Δv + g dt,  p' = p + ½ (v + v') dt,

and the error follows δ' = A δ + B w, where B holds the bias columns of A with the opposite sign.
Over the n samples of an interval, let Φ_m be the product of the A of samples m … n − 1 and
N_l = Φ_{l+1} B_l the effect of the noise of sample l at the end of the interval. Then

    Φ_m[v, θ] = −hat(Σ_{l≥m} Δv_l),
    Φ_m[p, θ] = −hat(Σ_{l≥m} (n − l − ½) dt Δv_l),
    Φ_m[p, v] = (n − m) dt I,
    Φ_m[:, b] = I_b − Σ_{l≥m} N_l,
    Q = Σ_l N_l diag(σ_g², σ_a²) N_lᵀ + dt Σ_{m≥1} Φ_m[:, b] diag(η_g², η_a²) Φ_m[:, b]ᵀ.

Every sum over samples is one product with a constant triangular matrix. Only the rotations need a
loop, of log₂ n rounds. The samples are along the last axis of every array of an interval.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.config import NoiseModel
from gnio_jax.filtering.gaps import Gap, Imu, no_gap
from gnio_jax.filtering.state import (
    ANCHOR,
    BIASES,
    CLONE,
    CORRELATED,
    LOCAL,
    MOVE,
    OFFSET,
    THETA,
    VELOCITY,
    FilterState,
    Mean,
    Shift,
)
from gnio_jax.geometry import hat, matmul
from gnio_jax.types import GRAVITY, Array


class Interval(NamedTuple):
    """The pose at the end of one clone interval, and how the error propagates over it."""

    rotation: Float[Array, "3 3"]
    """Body → world."""
    velocity: Float[Array, "3"]
    """World frame, m/s."""
    position: Float[Array, "3"]
    """m, from the same origin as the position at the start."""
    transition: Float[Array, "9 15"]
    """Rows θ, v, p of Φ over θ, v, p, b_g, b_a. The biases are constant."""
    noise: Float[Array, "15 15"]
    """Q of θ, v, p, b_g, b_a."""


def integrate(start: Mean, imu: Imu, noise: NoiseModel, dt: float) -> Interval:
    """Integrate the n samples of one interval, raw in the body frame, from `start`.

    A sample with `used` = 0 (see `gaps`) neither rotates nor accelerates, not even by gravity: the
    filter coasts there. The variance of the gap is added in any case.
    """
    n, dtype = imu.gyro.shape[0], imu.gyro.dtype
    gap = no_gap(n, dtype) if imu.gap is None else imu.gap
    # From the middle of each sample, s.
    time_to_end = ((n - 0.5 - np.arange(n)) * dt).astype(dtype)
    tail = np.tril(np.ones((n, n), dtype))  # x @ tail sums x over the samples from m on

    turns = (imu.gyro - start.gyro_bias[None]) * dt * gap.used[:, None]
    body_steps = (imu.accel - start.accel_bias[None]) * dt * gap.used[:, None]
    rotations = geometry.integrate_turns(start.rotation, turns)
    before, after = rotations[:, :, :-1], rotations[:, :, 1:]
    velocity_steps = matmul(before, body_steps.T[:, None])[:, 0]  # Δv of every sample
    # Σ_{l≥m} Δv_l for m = 0 … n − 1, then Σ_{l≥m} (n − l − ½) dt Δv_l.
    sums = velocity_steps @ np.concatenate([tail, time_to_end[:, None] * tail], axis=1)
    by_tilt = -jax.vmap(geometry.hat, in_axes=1, out_axes=2)(sums).reshape(3, 3, 2, n)

    # N_l over θ, v, p. The noise of the gyro turns every later Δv; that of the accelerometer adds
    # to the velocity and the position.
    later = jnp.pad(by_tilt[:, :, :, 1:], ((0, 0), (0, 0), (0, 0), (0, 1)))
    right_jacobians = jax.vmap(geometry.right_jacobian, out_axes=2)(turns)
    # A reduction is computed once. A sum that is written out would be computed again in everything
    # that reads it.
    theta = dt * geometry.contract_right(after, right_jacobians)
    of_gyro = [theta, matmul(later[:, :, 0], theta), matmul(later[:, :, 1], theta)]
    velocity = dt * before
    of_accel = [jnp.zeros_like(velocity), velocity, time_to_end[None, None] * velocity]
    effect = jnp.concatenate([jnp.concatenate(of_gyro), jnp.concatenate(of_accel)], axis=1)
    by_bias = -(effect * gap.used[None, None]).reshape(9 * 6, n) @ tail  # Φ_m[:, b]
    by_bias = by_bias.reshape(9, 6, n)

    eye, zero = np.eye(3, dtype=dtype), np.zeros((3, 3), dtype)
    by_theta = jnp.concatenate([eye, by_tilt[:, :, 0, 0], by_tilt[:, :, 1, 0]])
    by_velocity_position = np.block([[zero, zero], [eye, zero], [n * dt * eye, eye]])
    gravity = np.array([0.0, 0.0, -GRAVITY], dtype)
    position = start.position + n * dt * start.velocity
    return Interval(
        rotation=geometry.orthonormalize(rotations[:, :, -1]),
        velocity=start.velocity + sums[:, 0] + gravity * dt * jnp.sum(gap.used),
        position=position + sums[:, n] + gravity * dt * (time_to_end @ gap.used),
        transition=jnp.concatenate([by_theta, by_velocity_position, by_bias[:, :, 0]], axis=1),
        noise=_interval_noise(effect, by_bias[:, :, 1:], gap, imu.variance, noise, dt),
    )


def _interval_noise(
    effect: Float[Array, "9 6 n"],
    by_bias: Float[Array, "9 6 n-1"],
    gap: Gap,
    variance: Float[Array, "n 6"] | None,
    noise: NoiseModel,
    dt: float,
) -> Float[Array, "15 15"]:
    """Q of θ, v, p, b_g, b_a, from N_l and from Φ_m[:, b] for m ≥ 1. `variance` of the samples
    [accel, gyro] is in the place of the densities."""
    n, dtype = effect.shape[2], effect.dtype
    if variance is None:
        gyro_variance = (noise.gyro_density**2 / dt + gap.gyro_variance)[None]
        accel_variance = noise.accel_density**2 / dt + gap.accel_variance
    else:
        gyro_variance = variance[:, 3:].T + gap.gyro_variance[None]
        accel_variance = variance[:, :3].T + gap.accel_variance[None]
    walk = jnp.repeat(jnp.stack([noise.gyro_bias_walk, noise.accel_bias_walk]) ** 2 * dt, 3)
    # The gyro's noise and the walks as one product of 9 rows.
    of_gyro = effect[:, :3]
    weighted_parts = [of_gyro * gyro_variance[None], by_bias * walk[None, :, None]]
    effects, weighted = (
        jnp.concatenate([part.reshape(9, -1) for part in parts], axis=1)
        for parts in ([of_gyro, by_bias], weighted_parts)
    )
    if variance is None:
        # The accelerometer's noise is isotropic, so its rotations cancel in R Rᵀ: each sample adds
        # one number for each pair of v and p.
        gains = np.stack([np.zeros(n), np.ones(n), (n - 0.5 - np.arange(n)) * dt])
        pairs = dt**2 * np.einsum("il,jl->ijl", gains, gains).astype(dtype)
        of_accel = jnp.kron(pairs @ accel_variance, np.eye(3, dtype=dtype))
    else:
        turned = effect[:, 3:]
        of_accel = turned.reshape(9, -1) @ (turned * accel_variance[None]).reshape(9, -1).T
    motion = effects @ weighted.T + of_accel
    mixed = jnp.sum(by_bias, axis=2) * walk[None]
    motion_rows = jnp.concatenate([motion, mixed], axis=1)
    bias_rows = jnp.concatenate([mixed.T, jnp.diag(n * walk)], axis=1)
    return jnp.concatenate([motion_rows, bias_rows])


class Transition(NamedTuple):
    """F, the linear map of the core's error over one clone interval."""

    motion: Float[Array, "12 15"]
    """Rows θ, v, o of the new error, and the change of the anchor's, over θ, v, o, b_g, b_a before
    the anchor moved."""
    decay: Float[Array, "e"]
    """Factors of the temporally correlated errors (`Filter.decay`)."""
    anchored: Float[Array, ""]
    """1 where the anchor moved up to the position at the start of the interval, else 0."""

    def __call__(self, rows: Float[Array, "n m"]) -> Float[Array, "n m"]:
        """The product of F and `rows`. Where the anchor moves, a' = a + o and s' = o."""
        motion, moved = jnp.split(self.motion @ rows[LOCAL], [9])
        anchor, move = rows[ANCHOR] + moved, (1 - self.anchored) * rows[MOVE] + moved
        correlated = self.decay[:, None] * rows[CORRELATED]
        return jnp.concatenate([motion, rows[BIASES], anchor, move, correlated])


def core_transition(
    interval: Interval, decay: Float[Array, "e"], anchored: Float[Array, ""], shift: Shift | None
) -> Transition:
    """F over an interval that starts from the anchor, with o = 0, where the anchor has just
    moved. It takes errors ξ of a core that updates have moved by `shift` to errors δ."""
    to_anchor = anchored * np.eye(LOCAL.stop, dtype=interval.transition.dtype)[OFFSET]
    motion = interval.transition * (1 - jnp.sum(to_anchor, axis=0))[None]
    motion = jnp.concatenate([motion, to_anchor])
    if shift is not None:
        by_turn = matmul(motion[:, VELOCITY], hat(shift.velocity))
        by_turn += matmul(motion[:, OFFSET], hat(shift.position))
        motion = jnp.concatenate([motion[:, THETA] - by_turn, motion[:, THETA.stop :]], axis=1)
    return Transition(motion, decay, anchored)


def propagate(
    state: FilterState, interval: Interval, transition: Transition, slot: Array | int
) -> FilterState:
    """Mean and covariance at the end of an interval, P ← F P Fᵀ + Q, with the new pose cloned into
    `slot` of the ring in the place of the oldest clone. No update has moved either of them yet."""
    core = transition(transition(state.core_covariance).T)
    errors = len(transition.decay)
    core = core + jnp.pad(interval.noise, (0, len(core) - len(interval.noise)))
    core = core + jnp.pad(jnp.diag(1 - transition.decay**2), (len(core) - errors, 0))
    # The variance of the position grows, and with it the rounding difference between both
    # triangles.
    core = 0.5 * (core + core.T)
    pose = jnp.concatenate([core[:, THETA], core[:, OFFSET]], axis=1)
    cross = put(transition(state.cross_covariance), pose, 0, CLONE * slot)
    rows = jnp.concatenate([cross[THETA], cross[OFFSET]])
    return state._replace(
        rotation=interval.rotation,
        velocity=interval.velocity,
        offset=interval.position,
        correlated=transition.decay * state.correlated,
        clone_rotation=put(state.clone_rotation, interval.rotation[None], slot, 0, 0),
        clone_offset=put(state.clone_offset, interval.position[None], slot, 0),
        core_covariance=core,
        cross_covariance=cross,
        clone_covariance=_replace_clone(state.clone_covariance, rows, CLONE * slot),
        clone_shift=put(state.clone_shift, np.zeros((1, 3), core.dtype), slot, 0),
        shift=None,
        step=state.step + 1,
    )


def put(array: Array, block: Array, *start: Array | int) -> Array:
    """`array` with `block` written at `start`."""
    return jax.lax.dynamic_update_slice(array, block, tuple(map(jnp.int32, start)))


@jax.custom_jvp
def _replace_clone(
    covariance: Float[Array, "m m"], rows: Float[Array, "6 m"], entry: Array | int
) -> Float[Array, "m m"]:
    """The covariance of the clones with `rows`, and the columns that mirror them, from `entry`."""
    return put(put(covariance, rows, entry, 0), rows.T, 0, entry)


@_replace_clone.defjvp
def _replace_clone_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """The derivative uses a mask: the transpose of overwriting would copy the whole matrix for each
    write."""
    covariance, _, entry = primals
    d_covariance, d_rows, _ = tangents
    index = np.arange(len(covariance))
    unchanged = ((index < entry) | (index >= entry + CLONE)).astype(covariance.dtype)
    nothing = jnp.zeros_like(covariance)
    changed = put(nothing, d_rows * unchanged[None], entry, 0) + put(nothing, d_rows.T, 0, entry)
    return _replace_clone(*primals), d_covariance * unchanged[:, None] * unchanged[None] + changed
