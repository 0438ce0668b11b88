"""The algebra of an EKF update, whatever is measured.

With r the innovation, H its Jacobian and S = H P Hᵀ + R = L Lᵀ, the gain is Yᵀ L⁻¹, Y = L⁻¹ H P.
The error is Yᵀ L⁻¹ r, and P ← P − Yᵀ Y, symmetric to the last bit.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.filtering.state import (
    ACCEL_BIAS,
    ANCHOR,
    CLONE,
    CLONE_OFFSET,
    CLONE_THETA,
    GYRO_BIAS,
    LASTING,
    MOVE,
    VELOCITY,
    FilterState,
    FirstEstimates,
)
from gnio_jax.geometry import contract_left, contract_right, matmul
from gnio_jax.types import Array


class Correction(NamedTuple):
    """What an update with S = L Lᵀ did to the error e: e ← e − Yᵀ (L⁻¹ r), where L⁻¹ r = L⁻¹ H e
    and noise. Smoothing undoes it."""

    whitened: Float[Array, "3"]
    """L⁻¹ r."""
    core_rows: Float[Array, "3 n"]
    """Y = L⁻¹ H P against the core; zero where there was no update, and so are the other rows."""
    clone_rows: Float[Array, "3 m"]
    """Y against the clones."""
    core_jacobian: Float[Array, "3 n"]
    """L⁻¹ H over the core …"""
    oldest_jacobian: Float[Array, "3 6"]
    """… and over the oldest clone; it is zero over the others."""


class Cholesky(NamedTuple):
    """L of L Lᵀ = S, 3×3, written out: a call to LAPACK costs more than the whole update."""

    diagonal: tuple[Array, Array, Array]
    below: tuple[Array, Array, Array]
    """L[1,0], L[2,0], L[2,1]."""

    def solve(self, rows: Float[Array, "3 m"]) -> Float[Array, "3 m"]:
        """L⁻¹ rows."""
        (a, d, f), (b, c, e) = self.diagonal, self.below
        x = rows[0] / a
        y = (rows[1] - b * x) / d
        return jnp.stack([x, y, (rows[2] - c * x - e * y) / f])

    @property
    def matrix(self) -> Float[Array, "3 3"]:
        """L."""
        (a, d, f), (b, c, e) = self.diagonal, self.below
        zero = jnp.zeros_like(a)
        return jnp.stack([a, zero, zero, b, d, zero, c, e, f]).reshape(3, 3)

    @property
    def volume(self) -> Float[Array, ""]:
        """√det S."""
        return self.diagonal[0] * self.diagonal[1] * self.diagonal[2]


def cholesky(s: Float[Array, "3 3"]) -> Cholesky:
    """The lower triangular root of S; NaN where S is not positive definite."""
    a = jnp.sqrt(s[0, 0])
    b, c = s[1, 0] / a, s[2, 0] / a
    d = jnp.sqrt(s[1, 1] - b * b)
    e = (s[2, 1] - c * b) / d
    return Cholesky((a, d, jnp.sqrt(s[2, 2] - c * c - e * e)), (b, c, e))


class Whitened(NamedTuple):
    """What S = L Lᵀ makes of some rows."""

    rows: tuple[Float[Array, "3 _"], ...]
    """L⁻¹ of each."""
    volume: Float[Array, ""]
    """√det S."""


@jax.custom_jvp
def whiten(s: Float[Array, "3 3"], rows: tuple[Float[Array, "3 _"], ...]) -> Whitened:
    """L⁻¹ of each of the rows, for a symmetric S = L Lᵀ."""
    root = cholesky(s)
    return Whitened(tuple(root.solve(part) for part in rows), root.volume)


@whiten.defjvp
def _whiten_jvp(primals: tuple, tangents: tuple) -> tuple[Whitened, Whitened]:
    """With A = L⁻¹ dS L⁻ᵀ and Y = L⁻¹ X: dY = L⁻¹ dX − Φ(A) Y, where Φ takes the lower triangle and
    half of the diagonal, and d√det S = ½ tr(A) √det S."""
    (s, rows), (ds, d_rows) = primals, tangents
    eye = np.eye(3, dtype=s.dtype)
    (inverse, *whitened), volume = whiten(s, (jnp.asarray(eye), *rows))
    triangle = np.tril(np.ones((3, 3), s.dtype)) - 0.5 * eye
    lower = triangle * contract_left(contract_right(inverse, ds), inverse.T)
    d_whitened = [
        contract_right(inverse, dx) - contract_left(lower, y)
        for dx, y in zip(d_rows, whitened, strict=True)
    ]
    d_volume = volume * jnp.sum(eye * lower)
    return Whitened(tuple(whitened), volume), Whitened(tuple(d_whitened), d_volume)


@jax.custom_jvp
def downdate(covariance: Float[Array, "m m"], rows: Float[Array, "3 m"]) -> Float[Array, "m m"]:
    """P − Yᵀ Y."""
    return covariance - matmul(rows.T, rows)


@downdate.defjvp
def _downdate_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """The signs are with the rows, or the backward pass would turn that of the whole matrix. Two
    products, as the transpose of one and its mirror image would add a matrix to its own transpose.
    """
    (covariance, rows), (d_covariance, d_rows) = primals, tangents
    change = (-d_rows).T @ rows + (-rows).T @ d_rows
    return downdate(covariance, rows), d_covariance + change


def apply_correction(
    state: FilterState, correction: Correction, newest: Array | int
) -> FilterState:
    """Mean and covariance after an update; `newest` is the slot of the newest clone."""
    whitened, core_rows, clone_rows = correction[:3]
    # A reduction on purpose: it is kept, where the sum spelt out would be computed anew for every
    # entry that the retraction reads.
    error, clone_errors = (
        jnp.sum(whitened[:, None] * rows, axis=0) for rows in (core_rows, clone_rows)
    )
    corrected = retract(state, error, clone_errors.reshape(-1, CLONE), newest)
    return corrected._replace(
        core_covariance=downdate(state.core_covariance, core_rows),
        cross_covariance=state.cross_covariance - matmul(core_rows.T, clone_rows),
        clone_covariance=downdate(state.clone_covariance, clone_rows),
    )


def retract(
    state: FilterState, core: Float[Array, "n"], clones: Float[Array, "c 6"], newest: Array | int
) -> FilterState:
    """Add an error to the mean: R ← exp(δθ) R, the rest adds. The core's pose is that of the newest
    clone."""
    turns = jax.vmap(geometry.exp)(clones[:, CLONE_THETA])
    rotations = jax.vmap(matmul)(turns, state.clone_rotation)
    offsets = state.clone_offset + clones[:, CLONE_OFFSET]
    return state._replace(
        rotation=rotations[newest],
        velocity=state.velocity + core[VELOCITY],
        offset=offsets[newest],
        gyro_bias=state.gyro_bias + core[GYRO_BIAS],
        accel_bias=state.accel_bias + core[ACCEL_BIAS],
        anchor=state.anchor + core[ANCHOR],
        move=state.move + core[MOVE],
        lasting=state.lasting + core[LASTING],
        clone_rotation=rotations,
        clone_offset=offsets,
    )


def relinearize(state: FilterState, wanted: Bool[Array, ""]) -> FilterState:
    """With the latest estimates in the place of the first, if `wanted`: see `FirstEstimates`."""
    if state.first is None:
        return state
    latest = FirstEstimates(state.velocity, state.offset, state.move, state.clone_offset)
    first = jax.tree.map(lambda new, old: jnp.where(wanted, new, old), latest, state.first)
    return state._replace(first=first)
