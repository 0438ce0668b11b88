"""Walks at another pace: random changes of a segment that keep the walk physically possible (ours).

A network that sees a second of gait learns the speed at which the people of its training set walk
with such a gait. With these changes the same gait has another speed, and only starts, stops and
turns tell it.

- The moving walkway: the walk goes on a belt that moves with the walker's own slow motion s (the
  positions behind a zero-phase low-pass), at a share k − 1 of its velocity. The phone moves by
  (k − 1) s more and measures (k − 1) s̈ more. The gait is the same, and the mean speed is k times
  as large.
- The gain of the alternating part: what is not slow, in position and acceleration, times a factor.
- Time stretch: the walk in 1/τ of the time. Speeds are τ times, accelerations τ² times as large.

Position and acceleration always belong together: integrating the changed acceleration twice gives
the changed position, to the last digit for the first two and to the interpolation for the third.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray
from scipy.signal import butter, sosfiltfilt

from gnio_jax.config import AugmentConfig
from gnio_jax.numerics import spans
from gnio_jax.types import GRAVITY, Array

SLOW_HERTZ = 0.35
"""Cut-off of the slow motion, far below the rate of steps, Hz."""
EDGE = 2
"""Samples that the slow motion is continued beyond a stretch's ends, along a line."""


class SlowMotion(NamedTuple):
    """The slow part of a walk in the world."""

    position: Float[Array, "*t 3"]
    """m"""
    accel: Float[Array, "*t 3"]
    """Its second derivative, m/s²."""


def slow_motion(
    position: Float[np.ndarray, "t 3"], usable: Bool[np.ndarray, "t"], rate: float
) -> SlowMotion:
    """The slow motion of every stretch of `usable` positions, m; zero elsewhere.

    With the low-passed positions q, the slow motion is p_j = (q_{j−1} + 2 q_j + q_{j+1}) / 4 and
    the acceleration in the interval after j is (q_{j+2} − q_{j+1} − q_j + q_{j−1}) / 2 Δt², which
    is exact for the filter's integration: v' = v + a Δt, p' = p + ½ (v + v') Δt.
    """
    slow, accel = np.zeros_like(position), np.zeros_like(position)
    filter_sections = butter(2, SLOW_HERTZ, fs=rate, output="sos")
    for start, stop in spans(usable):
        part = position[start:stop]
        padding = min(round(3 * rate / SLOW_HERTZ), len(part) - 1)
        q = sosfiltfilt(filter_sections, part, axis=0, padlen=padding)
        q = (
            np.pad(q, ((EDGE, EDGE), (0, 0)), "reflect", reflect_type="odd")
            if len(q) > EDGE
            else (np.pad(q, ((EDGE, EDGE), (0, 0)), "edge"))
        )
        slow[start:stop] = (q[1:-3] + 2 * q[2:-2] + q[3:-1]) / 4
        accel[start:stop] = (q[4:] - q[3:-1] - q[2:-2] + q[1:-3]) * (rate**2 / 2)
    return SlowMotion(slow, accel)


class Pace(NamedTuple):
    """The factors of a change of pace, one for each segment."""

    walkway: Float[Array, "b"]
    """k: horizontal slow motion."""
    gain: Float[Array, "b"]
    """Alternating part."""
    vertical_gain: Float[Array, "b"]
    """Vertical alternating part, times `gain`."""
    stretch: Float[Array, "b"]
    """τ: speed at which the walk is played."""


def unchanged(count: int) -> Pace:
    """The pace of `count` segments as they were walked."""
    return Pace(*jnp.ones((4, count), jnp.float32))


def draw_pace(key: PRNGKeyArray, count: int, config: AugmentConfig) -> Pace:
    """Factors that are uniform in their logarithms, and 1 where a change is switched off; the
    walkway moves in a share of the segments."""
    keys = jax.random.split(key, 5)

    def factors(key: PRNGKeyArray, bounds: tuple[float, float]) -> jax.Array:
        low, high = (jnp.float32(np.log(bound)) for bound in bounds)
        return jnp.exp(jax.random.uniform(key, (count,), jnp.float32, low, high))

    moves = jax.random.uniform(keys[3], (count,), jnp.float32) < config.walkway_share
    return Pace(
        jnp.where(moves, factors(keys[0], config.walkway), 1.0),
        factors(keys[1], config.alternating_gain),
        factors(keys[4], config.vertical_gain),
        factors(keys[2], config.time_stretch),
    )


def change_pace(
    accel: Float[jax.Array, "b s 3"],
    position: Float[jax.Array, "b s 3"],
    slow: SlowMotion,
    pace: Pace,
) -> tuple[Float[jax.Array, "b s 3"], Float[jax.Array, "b s 3"]]:
    """Specific force and position in the world after walkway and gain. Jittable."""
    ones = jnp.ones_like(pace.walkway)
    walkway = jnp.stack([pace.walkway, pace.walkway, ones], axis=1)[:, None]
    gain = pace.gain[:, None] * jnp.stack([ones, ones, pace.vertical_gain], axis=1)
    gain = gain[:, None]
    gravity = jnp.array([[[0, 0, GRAVITY]]], accel.dtype)
    alternating = accel - gravity - slow.accel
    return (
        gravity + walkway * slow.accel + gain * alternating,
        walkway * slow.position + gain * (position - slow.position),
    )
