"""The update of the EKF, the same for every measurement (paper §III-G).

A measurement of m = 1 to 3 numbers is linearised at the present estimate to

    r = H δ + w,   w ~ N(0, R),

where r is the residual (measured − predicted) and δ the error of the state. H touches the core and
the oldest clone; the newest clone is the core's own pose. With S = H P Hᵀ + R = L Lᵀ and
Y = L⁻¹ H P the gain is Yᵀ L⁻¹, the correction of the error Yᵀ L⁻¹ r, and P ← P − Yᵀ Y, symmetric
to the last bit.

A measurement is an object with a method

    update(state, step) -> (state, Outcome, Correction),

which linearises it (`linearise`) and takes it (`measure`); see `Displacement`, `ZeroVelocity`, and
"A measurement of your own" in docs/differentiable_filter.md.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol, runtime_checkable

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.config import NoiseModel
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.state import (
    ACCEL_BIAS,
    ANCHOR,
    CLONE,
    CLONE_OFFSET,
    CLONE_THETA,
    CORRELATED,
    GYRO_BIAS,
    MOVE,
    VELOCITY,
    FilterState,
)
from gnio_jax.geometry import contract_left, contract_right, matmul
from gnio_jax.types import Array


class Linearised(NamedTuple):
    """r = H δ + w."""

    residual: Float[Array, "m"]
    """r, measured − predicted."""
    core: Float[Array, "m n"]
    """H over the core's error."""
    oldest: Float[Array, "m 6"]
    """H over θ and o of the oldest clone."""
    covariance: Float[Array, "m m"]
    """R."""


class Outcome(NamedTuple):
    """What became of a measurement."""

    present: Bool[Array, ""]
    """Whether there was one. What follows is zero or False where there was none, and √det S is 1.
    """
    tested: Bool[Array, ""]
    """Whether a χ² test judged it."""
    residual: Float[Array, "m"]
    """r."""
    nis: Float[Array, ""]
    """Normalised innovation squared, rᵀ S⁻¹ r, with R as it was measured."""
    volume: Float[Array, ""]
    """√det S, with the same R."""
    weight: Float[Array, ""]
    """1 where the test passed, 0 where it failed, between them behind a gate with a slope."""
    accepted: Bool[Array, ""]
    """Whether it was applied, with whatever covariance."""


class Correction(NamedTuple):
    """What an update did to the error e: e ← e − Yᵀ L⁻¹ r, where L⁻¹ r = L⁻¹ (H e + w). All is zero
    where no update was made. Smoothing undoes it."""

    residual: Float[Array, "m"]
    """L⁻¹ r."""
    core: Float[Array, "m n"]
    """Y against the core …"""
    clones: Float[Array, "m c"]
    """… and against the clones."""
    core_jacobian: Float[Array, "m n"]
    """L⁻¹ H over the core …"""
    oldest_jacobian: Float[Array, "m 6"]
    """… and over the oldest clone; it is zero over the others."""


class Step(NamedTuple):
    """The clone interval at whose end a measurement is taken."""

    imu: Imu
    """Its samples."""
    newest: Array | int
    """Slot of the newest clone in the ring."""
    oldest: Array | int
    """Slot of the oldest clone."""
    config: FilterConfig
    noise: NoiseModel
    before: tuple[Outcome, ...] = ()
    """What became of the measurements of this interval before this one; the first is the
    displacement."""


@runtime_checkable
class Measurement(Protocol):
    """A measurement that is taken at the end of every clone interval: a tree of arrays, e.g. a
    NamedTuple, with this method."""

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]: ...


def linearise(
    state: FilterState,
    step: Step,
    residual: Float[Array, "m"],
    covariance: Float[Array, "m m"],
    *,
    rotation: Any = None,
    velocity: Any = None,
    position: Any = None,
    gyro_bias: Any = None,
    accel_bias: Any = None,
    oldest_rotation: Any = None,
    oldest_position: Any = None,
    correlated: Any = None,
) -> Linearised:
    """A measurement from the blocks of its Jacobian H, the derivative of the predicted value.

    Each block is (m, 3): by the rotation's error δθ (rad, world frame, R ← exp(δθ) R), by velocity,
    position and the biases of the present, by the rotation and position of the oldest clone, and by
    the temporally correlated error, where there is one. Those that are left out are zero.
    """
    rows, dtype = residual.shape[0], state.offset.dtype

    def block(value: Any) -> Array:
        return np.zeros((rows, 3), dtype) if value is None else jnp.asarray(value, dtype)

    here, there = block(position), block(oldest_position)
    core = [block(rotation), block(velocity), here, block(gyro_bias), block(accel_bias)]
    # p = a + o; the oldest clone's position is a − s + o_i where it still has the anchor before.
    core += [here + there, -anchors_apart(step.oldest, dtype) * there]
    core += [block(correlated)] if len(state.correlated) else []
    oldest = [block(oldest_rotation), there]
    return Linearised(
        jnp.asarray(residual, dtype),
        jnp.concatenate(core, axis=1),
        jnp.concatenate(oldest, axis=1),
        jnp.asarray(covariance, dtype),
    )


def anchors_apart(oldest: Array | int, dtype: np.dtype) -> Float[Array, ""]:
    """Moves of the anchor between the oldest clone and the core: 0 once in a round of the ring,
    else 1."""
    return jnp.where(jnp.asarray(oldest) == 0, 0.0, 1.0).astype(dtype)


def oldest_offset(state: FilterState, oldest: Array | int) -> Float[Array, "3"]:
    """Position of the oldest clone from the core's anchor, m."""
    apart = anchors_apart(oldest, state.move.dtype)
    return state.clone_offset[oldest] - apart * state.move


def measure(
    state: FilterState, linear: Linearised, step: Step, threshold: float = math.inf
) -> tuple[FilterState, Outcome, Correction]:
    """One EKF update. A residual or covariance with a NaN is no measurement, and one whose
    rᵀ S⁻¹ r is above `threshold` is refused (e.g. a quantile of χ² with m degrees of freedom)."""
    finite = [jnp.all(jnp.isfinite(part)) for part in (linear.residual, linear.covariance)]
    present = finite[0] & finite[1]
    linear = where_present(linear, present)
    correction, nis, volume = project(state, linear, step.oldest)
    accepted = present & (nis <= threshold)
    weight = accepted.astype(nis.dtype)
    outcome = Outcome(present, present, linear.residual, nis, volume, weight, accepted)
    state, correction = correct(state, correction, accepted, step.newest)
    return state, outcome, correction


def where_present(linear: Linearised, present: Bool[Array, ""]) -> Linearised:
    """Without a measurement zeros and R = I, so that NaN stays out of the arithmetic, and out of
    the derivatives."""
    rows = linear.residual.shape[0]
    shape = [(rows,), (rows, linear.core.shape[1]), (rows, CLONE), (rows, rows)]
    chex.assert_shape(
        linear, shape, custom_message="Linearised: residual, core, oldest, covariance"
    )
    eye = np.eye(rows, dtype=linear.covariance.dtype)
    known = jax.tree.map(lambda part: jnp.where(present, part, 0.0), linear)
    return known._replace(covariance=jnp.where(present, linear.covariance, eye))


def project(
    state: FilterState, linear: Linearised, oldest: Array | int
) -> tuple[Correction, Float[Array, ""], Float[Array, ""]]:
    """The correction by a measurement that is accepted, rᵀ S⁻¹ r and √det S."""
    entry = CLONE * oldest
    core_oldest = jax.lax.dynamic_slice_in_dim(state.cross_covariance, entry, CLONE, 1)
    oldest_clones = jax.lax.dynamic_slice_in_dim(state.clone_covariance, entry, CLONE, 0)
    # H P by dots: spelt out, the sums would read the blocks of H anew for every entry.
    core = linear.core @ state.core_covariance + linear.oldest @ core_oldest.T
    clones = linear.core @ state.cross_covariance + linear.oldest @ oldest_clones
    of_oldest = jax.lax.dynamic_slice_in_dim(clones, entry, CLONE, 1)
    spread = matmul(core, linear.core.T) + matmul(of_oldest, linear.oldest.T)
    rows = linear.residual[:, None], core, clones, linear.core, linear.oldest
    (residual, *whitened), volume = whiten(spread + linear.covariance, rows)
    correction = Correction(residual[:, 0], *whitened)
    return correction, jnp.dot(correction.residual, correction.residual), volume


def correct(
    state: FilterState, correction: Correction, accepted: Bool[Array, ""], newest: Array | int
) -> tuple[FilterState, Correction]:
    """Mean and covariance after an update, and the correction, which is zero where it is not
    `accepted`. `newest` is the slot of the newest clone."""
    correction = jax.tree.map(lambda rows: jnp.where(accepted, rows, 0.0), correction)
    # A reduction on purpose: it is kept, where the sum spelt out would be computed anew for every
    # entry that the correction of the mean reads.
    core, clones = (
        jnp.sum(correction.residual[:, None] * rows, axis=0)
        for rows in (correction.core, correction.clones)
    )
    corrected = retract(state, core, clones.reshape(-1, CLONE), newest)._replace(
        core_covariance=downdate(state.core_covariance, correction.core),
        cross_covariance=state.cross_covariance - matmul(correction.core.T, correction.clones),
        clone_covariance=downdate(state.clone_covariance, correction.clones),
    )
    return corrected, correction


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
        correlated=state.correlated + core[CORRELATED],
        clone_rotation=rotations,
        clone_offset=offsets,
    )


# Small matrices
# ------------------------------------------------------------------------------------------------


def cholesky(s: Float[Array, "m m"]) -> list[list[Array]]:
    """The lower triangle of L with L Lᵀ = S, row by row, written out: a call to LAPACK costs more
    than the whole update. NaN where S is not positive definite."""
    root: list[list[Array]] = []
    for i in range(s.shape[0]):
        row: list[Array] = []
        for j, above in enumerate(root):
            row.append((s[i, j] - _dot(row, above)) / above[j])
        row.append(jnp.sqrt(s[i, i] - _dot(row, row)))
        root.append(row)
    return root


def _dot(left: list[Array], right: list[Array]) -> Array | float:
    return sum((x * y for x, y in zip(left, right, strict=False)), start=0.0)


def lower_triangular(root: list[list[Array]]) -> Float[Array, "m m"]:
    """L as a matrix."""
    zero = jnp.zeros_like(root[0][0])
    entries = [entry for row in root for entry in [*row, *[zero] * (len(root) - len(row))]]
    return jnp.stack(entries).reshape(len(root), len(root))


@jax.custom_jvp
def whiten(
    s: Float[Array, "m m"], rows: tuple[Float[Array, "m _"], ...]
) -> tuple[tuple[Float[Array, "m _"], ...], Float[Array, ""]]:
    """L⁻¹ of each of the rows, for a symmetric S = L Lᵀ, and √det S."""
    root = cholesky(s)

    def solve(part: Array) -> Array:
        solved: list[Array] = []
        for i, row in enumerate(root):
            solved.append((part[i] - _dot(row[:-1], solved)) / row[-1])
        return jnp.stack(solved)

    volume = math.prod((row[-1] for row in root[1:]), start=root[0][-1])
    return tuple(solve(part) for part in rows), volume


@whiten.defjvp
def _whiten_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    """With A = L⁻¹ dS L⁻ᵀ and Y = L⁻¹ X: dY = L⁻¹ dX − Φ(A) Y, where Φ takes the lower triangle and
    half of the diagonal, and d√det S = ½ tr(A) √det S."""
    (s, rows), (ds, d_rows) = primals, tangents
    eye = np.eye(s.shape[0], dtype=s.dtype)
    (inverse, *whitened), volume = whiten(s, (jnp.asarray(eye), *rows))
    triangle = np.tril(np.ones_like(eye)) - 0.5 * eye
    lower = triangle * contract_left(contract_right(inverse, ds), inverse.T)
    d_whitened = [
        contract_right(inverse, dx) - contract_left(lower, y)
        for dx, y in zip(d_rows, whitened, strict=True)
    ]
    d_volume = volume * jnp.sum(eye * lower)
    return (tuple(whitened), volume), (tuple(d_whitened), d_volume)


@jax.custom_jvp
def downdate(covariance: Float[Array, "c c"], rows: Float[Array, "m c"]) -> Float[Array, "c c"]:
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
