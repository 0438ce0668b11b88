"""The ring of clones and their anchor: what keeps the filter's variances small (see `state`)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from gnio_jax.filtering.state import CLONE, CLONE_OFFSET, MOVE, FilterState
from gnio_jax.types import Array


def move_anchor(state: FilterState, wanted: Bool[Array, ""]) -> FilterState:
    """The mean with the anchor moved up to the present position, if `wanted`."""

    def moved(offset: Array, move: Array) -> tuple[Array, Array]:
        return jnp.where(wanted, 0.0, offset), jnp.where(wanted, offset, move)

    offset, move = moved(state.offset, state.move)
    first = state.first
    if first is not None:
        first_offset, first_move = moved(first.offset, first.move)
        first = first._replace(offset=first_offset, move=first_move)
    anchor = state.anchor + (state.offset - offset)
    return state._replace(anchor=anchor, offset=offset, move=move, first=first)


def unroll_clones(state: FilterState, oldest: int) -> FilterState:
    """The state between runs: oldest clone first, and all clones at the present anchor.

    `oldest` is the slot of the oldest clone. The slots before it, written since the anchor's last
    move, are at the present anchor already.
    """
    clones, dtype = state.clone_offset.shape[0], state.move.dtype
    at_anchor_before = (np.arange(clones) >= (oldest or clones)).astype(dtype)[:, None]
    # o ← o − s for those, in the mean and in the covariance.
    by_move = np.zeros((CLONE, 3))
    by_move[CLONE_OFFSET] = np.eye(3)
    loss = np.kron(at_anchor_before, by_move).astype(dtype)
    across = loss @ state.cross_covariance[MOVE]
    of_moves = loss @ state.core_covariance[MOVE, MOVE] @ loss.T
    clone_covariance = state.clone_covariance - across - across.T + of_moves
    cross_covariance = state.cross_covariance - state.core_covariance[:, MOVE] @ loss.T
    first, entries = state.first, CLONE * oldest
    if first is not None:
        offset = first.clone_offset - at_anchor_before * first.move[None]
        first = first._replace(clone_offset=jnp.roll(offset, -oldest, 0))
    offset = state.clone_offset - at_anchor_before * state.move[None]
    return state._replace(
        clone_rotation=jnp.roll(state.clone_rotation, -oldest, 0),
        clone_offset=jnp.roll(offset, -oldest, 0),
        cross_covariance=jnp.roll(cross_covariance, -entries, 1),
        clone_covariance=jnp.roll(clone_covariance, (-entries, -entries), (0, 1)),
        first=first,
    )
