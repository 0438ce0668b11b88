"""Errors that the filter considers but does not estimate (ours; consider covariance analysis:
Tapley, Schutz and Born 2004, ch. 6).

A filter that is to estimate every error it may have can do worse than one that leaves some out: a
displacement of uncertain heading corrects the yaw with what is wrong in itself. But a covariance P
that leaves them out is too small. With c the errors that are left out, constant over a recording,
E[c cᵀ] = C and S = ∂x̂/∂c the sensitivity of the estimate x̂, the covariance of its error is

    P + S C Sᵀ.

The estimate, its gains and its innovations are as before. c is the bias that the gyro has beside
its first estimate (3, rad/s), and what is wrong with all displacements u of a walk (ours):

    d = exp(s) Rz(ψ) u + γ |u_xy| e_z,

the logarithm s of their scale, their heading ψ (rad) and their slope γ. S is the derivative of the
whole filter, taken forward through every update that it made.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.config import ConsideredStd, NoiseModel
from gnio_jax.filtering.checks import check_not_negative
from gnio_jax.filtering.config import FilterConfig, YawFrame
from gnio_jax.filtering.history import FilterHistory
from gnio_jax.filtering.scan import repeat_odometry
from gnio_jax.filtering.state import FilterState, Mean
from gnio_jax.types import Array

ENTRIES = 6
OF_BIAS, OF_SCALE, OF_HEADING, OF_SLOPE = slice(0, 3), 3, 4, 5
"""Where the gyro's bias, s, ψ and γ lie in c."""
STILL = 1e-6
"""Added in squares to the length of a displacement, m: standing still is no singular point."""


def check_considered(std: ConsideredStd) -> None:
    """Raise `ValueError` where a standard deviation is negative or not finite."""
    for name, value in std._asdict().items():
        check_not_negative(f"considered.{name}", value)


def sensitivity(
    state: FilterState,
    gyro: Any,
    accel: Any,
    history: FilterHistory,
    config: FilterConfig,
    noise: NoiseModel,
    imu_valid: Any = None,
    frame: YawFrame | None = None,
) -> Float[jax.Array, "k 15 6"]:
    """S of θ, v, p, b_g, b_a after each clone interval of a run of `run_odometry`, whose arguments
    and `history` these are.

    The displacements are those of the history: the network is not called again, and that other
    biases would have changed its windows a little is left out. `frame` is "given" for a run of
    `run_filter`, whose measurements must have had diagonal covariances.
    """
    factors = jnp.stack(jax.tree.map(jnp.asarray, noise.std_factor))
    # S is of the whole run, from its start.
    config = dataclasses.replace(config, truncate_every=0, checkpoint_every=0)
    scale = jnp.sqrt(noise.measurement_scale)
    own_std = history.measurement_std / (factors[None] * scale)

    def means(c: Float[Array, "6"]) -> Mean:
        displacement = disturbed(history.displacement, c)
        start = state._replace(gyro_bias=state.gyro_bias + c[OF_BIAS])
        told = displacement, own_std
        _, found = repeat_odometry(start, gyro, accel, *told, config, noise, imu_valid, frame)
        return Mean(*(getattr(found, name) for name in Mean._fields))

    nothing = jnp.zeros(ENTRIES, history.position.dtype)
    return of_error(history.rotation, jax.jacfwd(means)(nothing))


def of_error(rotation: Float[Array, "k 3 3"], derivatives: Mean) -> Float[jax.Array, "k 15 6"]:
    """S of θ, v, p, b_g, b_a from the derivatives of estimates by c, its 6 entries last, where the
    rotations are `rotation`."""
    of_rotation, *others = derivatives
    # The change of R by a small turn θ in the world is [θ]× R.
    turn = jnp.einsum("kilc,kjl->kijc", of_rotation, rotation)
    theta = jnp.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
    return jnp.concatenate([theta, *others], axis=1)


def disturbed(displacement: Float[Array, "k 3"], c: Float[Array, "6"]) -> Float[jax.Array, "k 3"]:
    """d of the displacements u = `displacement`, m; NaN stays NaN."""
    displacement, c = jnp.asarray(displacement), jnp.asarray(c)
    turn = geometry.rotation_z(c[OF_HEADING])
    length = jnp.sqrt(jnp.sum(displacement[:, :2] ** 2, axis=1) + STILL**2)
    turned = jnp.exp(c[OF_SCALE]) * geometry.matmul(displacement, turn.T)
    return turned.at[:, 2].add(c[OF_SLOPE] * length)


def considered_covariance(
    sensitivity: Float[Array, "k d 6"], std: ConsideredStd
) -> Float[jax.Array, "k d d"]:
    """S C Sᵀ, to be added to P; of as many rows of S as are given."""
    bias, *others = std
    each = jnp.stack([jnp.asarray(value) for value in (bias, bias, bias, *others)])
    root = sensitivity * each[None, None]
    return jnp.einsum("kic,kjc->kij", root, root)
