"""Errors of the displacements that last longer than a window (ours): part of each window's error,
the walk's speed and its heading.

Windows overlap, so the errors of neighbours are alike; and a network misjudges a walker's speed and
direction for as long as the phone is held like that. White noise can say neither. With u the true
displacement in the yaw frame of the window, and Σ = L Lᵀ the covariance that the network says,

    d = exp(s) Rz(ψ) u + L (c b + √(1 − c²) w),   w ~ N(0, I) white,

where b (3), s and ψ are first-order Gauss–Markov processes,

    x_{k+1} = a x_k + √(1 − a²) σ n_k,   a = exp(−T / τ),   n_k ~ N(0, I),

with σ = 1 for b, over clone intervals of T seconds. The covariance of each measurement alone stays
Σ, but what an average of them can tell is bounded. If the error of a window were the sum of
independent errors of its W strides, its correlation would fall linearly to zero at the window's
length; the exponential with half that length for τ has the same integral, and so the same error of
a long sum, for three entries in the place of 3 W. Where c, σ_s and σ_ψ are 0 it is the filter
without them.

The errors are entries e = (b, s, ψ) of the core's error state, with the derivatives

    ∂d/∂b = c L,   ∂d/∂s = exp(s) Rz(ψ) u,   ∂d/∂ψ = e_z × exp(s) Rz(ψ) u,

and exp(s) Rz(ψ) before those by the poses.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.types import Array

ENTRIES = 5
OF_WINDOW, OF_SCALE, OF_HEADING = slice(0, 3), 3, 4
"""Where b, s and ψ lie."""


class LastingErrors(NamedTuple):
    """How large the errors are and how long they last. Each a scalar; differentiable."""

    window_share: Float[Array, ""] | float
    """c, from 0 to below 1: the part of a window's standard deviation that lasts."""
    window_seconds: Float[Array, ""] | float
    """τ of b, s."""
    scale_std: Float[Array, ""] | float
    """σ of the logarithm of the displacements' scale."""
    heading_std: Float[Array, ""] | float
    """σ of their heading, rad."""
    walk_seconds: Float[Array, ""] | float
    """τ of s and ψ, s."""


class LastingMotion(NamedTuple):
    """What a clone interval does to the errors; no entries where they are not estimated."""

    decay: Float[Array, "e"]
    """a."""
    variance: Float[Array, "e"]
    """(1 − a²) σ², what is added."""


class Distortion(NamedTuple):
    """What the errors make of a displacement."""

    gain: Float[Array, "3 3"]
    """exp(s) Rz(ψ), the derivative by u."""
    displacement: Float[Array, "3"]
    """Expected of the network, m."""
    jacobian: Float[Array, "3 5"]
    """Its derivative by e."""


def prior_variance(errors: LastingErrors, dtype: np.dtype) -> Float[Array, "5"]:
    """Of e before anything is measured, which is that of all times."""
    one, scale, heading = (
        jnp.asarray(value, dtype) ** 2 for value in (1.0, errors.scale_std, errors.heading_std)
    )
    return jnp.stack([one, one, one, scale, heading])


def lasting_motion(errors: LastingErrors | None, duration: float, dtype: np.dtype) -> LastingMotion:
    """Over a clone interval of `duration` seconds."""
    if errors is None:
        return LastingMotion(jnp.zeros(0, dtype), jnp.zeros(0, dtype))
    of_window, of_walk = (
        jnp.exp(-duration / jnp.asarray(seconds, dtype))
        for seconds in (errors.window_seconds, errors.walk_seconds)
    )
    decay = jnp.stack([of_window, of_window, of_window, of_walk, of_walk])
    return LastingMotion(decay, (1 - decay**2) * prior_variance(errors, dtype))


def distort(
    displacement: Float[Array, "3"],
    root: Float[Array, "3 3"],
    lasting: Float[Array, "5"],
    errors: LastingErrors,
) -> Distortion:
    """What the network is expected to say of a true displacement, m, whose covariance it says has
    the lower triangular `root`."""
    heading = lasting[OF_HEADING]
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    zero, one = jnp.zeros_like(cosine), jnp.ones_like(cosine)
    turn = jnp.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, one]).reshape(3, 3)
    gain = jnp.exp(lasting[OF_SCALE]) * turn
    moved = geometry.matmul(gain, displacement[:, None])[:, 0]
    by_window = errors.window_share * root
    by_heading = jnp.stack([-moved[1], moved[0], zero])
    expected = moved + geometry.matmul(by_window, lasting[OF_WINDOW, None])[:, 0]
    columns = [by_window, moved[:, None], by_heading[:, None]]
    return Distortion(gain, expected, jnp.concatenate(columns, axis=1))
