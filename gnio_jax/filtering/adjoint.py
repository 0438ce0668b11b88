"""The adjoint of the smoother (Bierman 1973): what later measurements say of the filter's error.

Vector λ and matrix Λ run backwards from zero. Back over an update with S = L Lᵀ, M = L⁻¹ H and
Y = M P,

    λ ← λ − Mᵀ (Y λ + L⁻¹ r),   Λ ← (I − Yᵀ M)ᵀ Λ (I − Yᵀ M) + Mᵀ M,

and over a propagation with the augmented transition F, which puts the core's pose into a slot of
the ring over the oldest clone,

    λ ← Fᵀ λ,   Λ ← Fᵀ Λ F:

what the later measurements say of the clone goes over onto the pose, and of the clone that it
displaced they say nothing. What the filter did not apply leaves no term, and what it weighed has
that weight. No measurement touches the anchor, so λ and Λ are zero there and leave it out: the
growing variance of the position meets only differences.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gnio_jax.filtering.state import BIASES, CLONE, LASTING, LOCAL, MOVE, OFFSET, THETA
from gnio_jax.filtering.update import Correction
from gnio_jax.geometry import matmul
from gnio_jax.types import Array

_MOVE = slice(LOCAL.stop, LOCAL.stop + 3)
"""Where the anchor's last move lies in the adjoint: behind θ, v, o, b_g, b_a, before e."""


class Adjoint(NamedTuple):
    """λ and Λ over θ, v, o, b_g, b_a, s, e and the ring of clones."""

    vector: Float[Array, "m"]
    matrix: Float[Array, "m m"]


def no_adjoint(clones: int, errors: int, dtype: np.dtype) -> Adjoint:
    """Zero: nothing is measured after the last step."""
    size = _MOVE.stop + errors + CLONE * clones
    return Adjoint(jnp.zeros(size, dtype), jnp.zeros((size, size), dtype))


def without_anchor(rows: Float[Array, "r n"]) -> Float[Array, "r k"]:
    """Columns of the core that the adjoint runs over."""
    return jnp.concatenate([rows[:, LOCAL], rows[:, MOVE], rows[:, LASTING]], axis=1)


def before_update(adjoint: Adjoint, correction: Correction, oldest: Int[Array, ""]) -> Adjoint:
    """Back over an update; `oldest` is where the oldest clone lies among the clones."""
    core_rows, core_jacobian = map(without_anchor, (correction.core_rows, correction.core_jacobian))
    rows = jnp.concatenate([core_rows, correction.clone_rows], axis=1)
    jacobian = jax.lax.dynamic_update_slice_in_dim(
        jnp.concatenate([core_jacobian, jnp.zeros_like(correction.clone_rows)], axis=1),
        correction.oldest_jacobian,
        core_jacobian.shape[1] + oldest,
        1,
    )
    over = rows @ adjoint.matrix
    # Λ − Mᵀ G − Gᵀ M with G = Y Λ − ½ (Y Λ Yᵀ + I) M
    half = 0.5 * (matmul(over, rows.T) + np.eye(3, dtype=over.dtype))
    gain = over - matmul(half, jacobian)
    return Adjoint(
        adjoint.vector - jacobian.T @ (rows @ adjoint.vector + correction.whitened),
        adjoint.matrix - matmul(jacobian.T, gain) - matmul(gain.T, jacobian),
    )


def before_propagation(
    adjoint: Adjoint,
    transition: Float[Array, "9 15"],
    decay: Float[Array, "e"],
    slot: Int[Array, ""],
) -> Adjoint:
    """Back over cloning into `slot`, the motion and, in slot 0, the anchor's move before it."""
    core = _core_transition(transition, decay, slot)
    pose = jnp.concatenate([core[THETA], core[OFFSET]])  # what the clone is made of

    def back(rows: Float[Array, "m r"]) -> Float[Array, "m r"]:
        of_core, of_clones = rows[: len(core)], rows[len(core) :]
        clone = jax.lax.dynamic_slice_in_dim(of_clones, CLONE * slot, CLONE)
        moved = jnp.concatenate([core, pose]).T @ jnp.concatenate([of_core, clone])
        forgotten = jnp.zeros_like(clone)
        of_clones = jax.lax.dynamic_update_slice_in_dim(of_clones, forgotten, CLONE * slot, 0)
        return jnp.concatenate([moved, of_clones])

    return Adjoint(back(adjoint.vector[:, None])[:, 0], back(back(adjoint.matrix).T))


def _core_transition(
    transition: Float[Array, "9 15"], decay: Float[Array, "e"], slot: Int[Array, ""]
) -> Float[Array, "k k"]:
    """F of θ, v, o, b_g, b_a, s, e: in slot 0 the offset has become the anchor's last move."""
    dtype = transition.dtype
    anchored = (slot == 0).astype(dtype)
    eye = np.eye(3, dtype=dtype)
    of_motion = jnp.pad(transition, ((0, 0), (0, 3)))
    of_biases = np.eye(_MOVE.stop, dtype=dtype)[BIASES]
    before_offset, between = jnp.zeros((3, OFFSET.start), dtype), jnp.zeros((3, 6), dtype)
    of_move = jnp.concatenate(
        [before_offset, anchored * eye, between, (1 - anchored) * eye], axis=1
    )
    of_rest = jnp.pad(jnp.diag(decay), ((0, 0), (_MOVE.stop, 0)))
    whole = jnp.concatenate([of_motion, of_biases, of_move])
    return jnp.concatenate([jnp.pad(whole, ((0, 0), (0, len(decay)))), of_rest])
