"""The whole covariance of the filter in the textbook's variables."""

import jax.numpy as jnp
import numpy as np

from gnio_jax.filtering.state import ANCHOR, CLONE, CLONE_OFFSET, OFFSET


def covariance(state):
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
