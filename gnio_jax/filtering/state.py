"""State of the stochastic-cloning EKF (paper §III-G, after TLIO).

The error state is δ = (θ, v, o, b_g, b_a, a, s, e | θ_0, o_0, θ_1, o_1, …): 21 core entries and
those of e, then 6 per clone, oldest clone first. Rotation errors are world-frame and left,
R ← exp(δθ) R; everything else adds. e are the errors of the displacements that last (see
`lasting_errors`): none, or 3 entries.

Positions are held as offsets o = p − a from an anchor a, a past position that moves up to the
present once in a window; s is its last move. A clone keeps the anchor that it was taken with: the
present one, or the one before. The variance of a position grows without bound, since only
differences of positions are measured; those of offsets and moves do not. So no update subtracts
large variances from each other, which is what makes the plain form (θ, v, p, …) diverge in float32.
The change of variables is linear with constant coefficients (p = a + o for the core), so the filter
is the plain one, exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gnio_jax.types import Array

CORE, CLONE = 21, 6
"""Entries of the error state: of the core without e, and of each clone."""
THETA, VELOCITY, OFFSET, GYRO_BIAS, ACCEL_BIAS, ANCHOR, MOVE = (
    slice(3 * i, 3 * i + 3) for i in range(7)
)
"""Where each part of the core's error lies."""
MOTION = slice(THETA.start, OFFSET.stop)
"""θ, v, o: what an interval moves."""
BIASES = slice(GYRO_BIAS.start, ACCEL_BIAS.stop)
"""b_g, b_a: what an interval keeps."""
LOCAL = slice(THETA.start, ANCHOR.start)
"""θ, v, o, b_g, b_a: all but the anchor, its move and e."""
LASTING = slice(MOVE.stop, None)
"""e: 0 or 3 entries."""
CLONE_THETA, CLONE_OFFSET = slice(0, 3), slice(3, 6)
"""Where each part of a clone's error lies."""


class GateState(NamedTuple):
    """Memory of the χ² gate. Times count IMU samples since initialisation, so that no rounding can
    move a decision."""

    converged: Bool[Array, ""]
    """Latched by the first update whose oldest clone is old enough."""
    last_success: Int[Array, ""]
    """Sample of the last measurement that was not rejected, and by as much later as there was none
    since; −1 before the first."""
    pause_end: Int[Array, ""]
    """First sample at which the gate may be active again."""


class ImuMemory(NamedTuple):
    """What one clone interval leaves of the IMU to the next."""

    gyro: Float[Array, "3"]
    """The last sample that was not missing, rad/s, raw; NaN before there was one."""
    accel: Float[Array, "3"]
    """The same, m/s²."""
    missing: Int[Array, ""]
    """Samples missing since."""
    quiet: Int[Array, ""]
    """Clone intervals in a row in which the IMU was quiet; counted where `zero_velocity_std` is
    above 0."""


class FirstEstimates(NamedTuple):
    """What was known of velocity and positions when they were first estimated, before any update at
    or after that time.

    Jacobians at these values leave the yaw of the whole trajectory as unobservable to the filter as
    it is (Huang, Mourikis and Roumeliotis 2010); at the latest values an update learns something of
    it that the measurement does not tell.

    That is for small corrections: Φ[v, θ] holds −hat(v − v_first), the last correction. Below the
    χ² threshold it is bounded by the filter's own standard deviations, as δᵀ P⁻¹ δ ≤ rᵀ S⁻¹ r;
    above it, it feeds itself: a larger Φ[v, θ], a larger variance, a larger gain, a larger
    correction. So an update above the threshold sets all of them to the latest estimates (ours).
    S is that of the update: a measurement with a weight or a scaled covariance corrects less.
    """

    velocity: Float[Array, "3"]
    offset: Float[Array, "3"]
    move: Float[Array, "3"]
    clone_offset: Float[Array, "c 3"]


class Mean(NamedTuple):
    """Estimates of one time, or stacked over K of them."""

    rotation: Float[Array, "*k 3 3"]
    """Body → world."""
    velocity: Float[Array, "*k 3"]
    """World frame, m/s."""
    position: Float[Array, "*k 3"]
    """World frame, m."""
    gyro_bias: Float[Array, "*k 3"]
    """rad/s"""
    accel_bias: Float[Array, "*k 3"]
    """m/s²"""


class FilterState(NamedTuple):
    """Mean and covariance, clones oldest first. c = W + 1 clones; those not yet taken are zero
    (their rotations the identity)."""

    rotation: Float[Array, "3 3"]
    """Body → world."""
    velocity: Float[Array, "3"]
    """World frame, m/s."""
    offset: Float[Array, "3"]
    """World frame, from the anchor, m."""
    gyro_bias: Float[Array, "3"]
    """rad/s"""
    accel_bias: Float[Array, "3"]
    """m/s²"""
    anchor: Float[Array, "3"]
    """A past position in the world frame, m."""
    move: Float[Array, "3"]
    """From the anchor before it, m."""
    lasting: Float[Array, "e"]
    """Errors of the displacements that last (`lasting_errors`): none, or 3."""
    clone_rotation: Float[Array, "c 3 3"]
    """Cloned rotations."""
    clone_offset: Float[Array, "c 3"]
    """Cloned positions, from the anchor they were taken with; between runs, from the present one,
    m."""
    core_covariance: Float[Array, "n n"]
    """θ, v, o, b_g, b_a, a, s, e: n = 21, or 24 with lasting errors."""
    cross_covariance: Float[Array, "n 6c"]
    """Core against the clones' θ, o."""
    clone_covariance: Float[Array, "6c 6c"]
    """Among the clones."""
    step: Int[Array, ""]
    """Clone intervals since initialisation."""
    gate: GateState
    imu: ImuMemory
    healthy: Bool[Array, ""]
    """Never False again where it once was: see `FilterHistory.healthy`."""
    first: FirstEstimates | None
    """Where `FilterConfig.jacobians` is "first"."""

    @property
    def position(self) -> Float[Array, "3"]:
        """World frame, m."""
        return self.anchor + self.offset

    @property
    def mean(self) -> Mean:
        """Of the core, with the position instead of the offset."""
        return Mean(self.rotation, self.velocity, self.position, self.gyro_bias, self.accel_bias)


def core_covariance(covariance: Float[Array, "n n"]) -> Float[Array, "15 15"]:
    """Covariance of θ, v, p, b_g, b_a from that of the core's error: p = a + o."""
    both = covariance + _onto_offset(covariance[ANCHOR], 0)
    return (both + _onto_offset(both[:, ANCHOR], 1))[LOCAL, LOCAL]


def _onto_offset(part: Array, axis: int) -> Array:
    """Padded with zeros, along `axis`, to where the offset lies."""
    around = [(0, 0), (0, 0)]
    around[axis] = (OFFSET.start, part.shape[1 - axis] - OFFSET.stop)
    return jnp.pad(part, around)


def covariance(state: FilterState) -> Float[Array, "d d"]:
    """The whole covariance of θ, v, p, b_g, b_a and the clones' θ, p from the oldest, d = 15 + 6 (W
    + 1)."""
    core, clones = len(state.core_covariance), state.clone_offset.shape[0]
    world = np.eye(core + CLONE * clones)  # p = a + o for the core and for every clone
    for start in [OFFSET.start, *range(core + CLONE_OFFSET.start, len(world), CLONE)]:
        world[start : start + 3, ANCHOR] = np.eye(3)
    world = np.delete(world, np.r_[ANCHOR.start : core], axis=0).astype(state.core_covariance.dtype)
    whole = jnp.block(
        [
            [state.core_covariance, state.cross_covariance],
            [state.cross_covariance.T, state.clone_covariance],
        ]
    )
    return world @ whole @ world.T
