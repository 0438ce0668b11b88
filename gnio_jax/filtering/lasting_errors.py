"""The temporally correlated part of a window's error (ours).

Windows overlap, so the errors of neighbours are alike, which white noise cannot express. With u the
true displacement in the yaw frame of the window, and Σ = L Lᵀ the covariance that the network
predicts,

    d = u + L (c b + √(1 − c²) w),   w ~ N(0, I) white,

where b (3) is a first-order Gauss–Markov process over clone intervals of T seconds,

    b_{k+1} = a b_k + √(1 − a²) n_k,   a = exp(−T / τ),   n_k ~ N(0, I).

The covariance of each measurement alone stays Σ, but what an average of them can tell is bounded.
If the error of a window were the sum of independent errors of its W strides, its correlation would
fall linearly to zero at the window's length; the exponential with half that length for τ has the
same integral, and so the same error of a long sum, for three entries in the place of 3 W.

b are entries of the core's error state, with ∂d/∂b = c L, and R = (1 − c²) Σ.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.config import CorrelatedError
from gnio_jax.types import Array

ENTRIES = 3
"""Entries of b."""


class LastingMotion(NamedTuple):
    """What a clone interval does to b; no entries where it is not estimated."""

    decay: Float[Array, "e"]
    """a."""
    variance: Float[Array, "e"]
    """1 − a², what is added."""


def lasting_motion(
    errors: CorrelatedError | None, duration: float, dtype: np.dtype
) -> LastingMotion:
    """Over a clone interval of `duration` seconds."""
    if errors is None:
        return LastingMotion(jnp.zeros(0, dtype), jnp.zeros(0, dtype))
    decay = jnp.full(ENTRIES, jnp.exp(-duration / jnp.asarray(errors.seconds, dtype)))
    return LastingMotion(decay, 1 - decay**2)
