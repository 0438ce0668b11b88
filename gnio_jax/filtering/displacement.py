"""The displacement between two clones as a measurement: residual, Jacobian, update (paper §III-G,
after TLIO)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.config import CorrelatedError, NoiseModel
from gnio_jax.filtering.config import FilterConfig, YawFrame
from gnio_jax.filtering.gate import innovation_gate
from gnio_jax.filtering.state import CLONE, LASTING, MOVE, OFFSET, FilterState
from gnio_jax.filtering.update import (
    Correction,
    Whitened,
    apply_correction,
    cholesky,
    relinearize,
    whiten,
)
from gnio_jax.geometry import matmul
from gnio_jax.types import Array

LEAST_WEIGHT = 1e-6
"""Of a measurement behind a gate with a slope: its covariance grows no further."""
GIMBAL = 1e-5
"""Below this |cos pitch| the yaw of the oldest clone has no derivative, and a displacement that is
told in a given frame is not used."""
OF_OLDEST, OF_NEWEST = slice(0, CLONE), slice(CLONE, CLONE + 3)
"""Columns of the residual's Jacobian: θ_i and p_i of the oldest clone, p_j of the newest."""


class Measurement(NamedTuple):
    """Displacement from the oldest to the newest clone, m, in the yaw frame of the oldest, finite
    also where there is none."""

    displacement: Float[Array, "3"]
    covariance: Float[Array, "3 3"]
    """After scaling, m²; positive definite also where there is none."""
    present: Bool[Array, ""]


class Residual(NamedTuple):
    """r = d − R_γ(R_i)ᵀ (p_j − p_i) and how its prediction depends on the two clones."""

    innovation: Float[Array, "3"]
    """r, m."""
    jacobian: Float[Array, "3 9"]
    """H of the prediction over θ_i, p_i, p_j."""
    lasting_jacobian: Float[Array, "3 e"]
    """H over the errors that last."""
    lasting_covariance: Float[Array, "3 3"]
    """The part of the measurement's covariance that those make, which H P Hᵀ has already."""
    defined: Bool[Array, ""]
    """Whether H exists: no gimbal lock."""


class DisplacementUpdate(NamedTuple):
    """What became of a measurement; zeros and False where there was none."""

    present: Bool[Array, ""]
    tested: Bool[Array, ""]
    """Present, and not at gimbal lock: the χ² gate judged it."""
    innovation: Float[Array, "3"]
    """r, m."""
    nis: Float[Array, ""]
    """Normalised innovation squared, rᵀ S⁻¹ r, before any fail scale."""
    volume: Float[Array, ""]
    """√det S, m³, before any fail scale; 1 where there was no measurement."""
    gate_passed: Float[Array, ""]
    """1 if the gate let it through as it is, 0 if not, between them with `gate_softness`."""
    accepted: Bool[Array, ""]
    """Whether it was applied, with whatever covariance."""


def scaled_measurement(
    displacement: Float[Array, "3"],
    covariance: Float[Array, "3 3"],
    noise: NoiseModel,
) -> Measurement:
    """Scale by `measurement_scale` and `std_factor`; keep NaN out of the arithmetic, or its
    derivatives would be NaN too."""
    present = jnp.all(jnp.isfinite(displacement)) & jnp.all(jnp.isfinite(covariance))
    eye = jnp.eye(3, dtype=covariance.dtype)
    factor = jnp.stack(jax.tree.map(jnp.asarray, noise.std_factor)).astype(covariance.dtype)
    scale = jnp.asarray(noise.measurement_scale, covariance.dtype)
    scale = scale * (factor[:, None] * factor[None])
    known = jnp.where(present, covariance, eye)
    return Measurement(
        displacement=jnp.where(present, displacement, 0.0),
        covariance=jnp.where(present, scale * known, eye),
        present=present,
    )


def displacement_residual(
    rotation_i: Float[Array, "3 3"],
    moved: Float[Array, "3"],
    displacement: Float[Array, "3"],
    moved_linearized: Float[Array, "3"],
    frame: YawFrame = "given",
) -> Residual:
    """r = d − R_γ(R_i)ᵀ (p_j − p_i), its prediction's Jacobian H over (θ_i, p_i, p_j), and whether
    H exists (no gimbal lock).

    `moved` is p_j − p_i; `moved_linearized` the same where H[θ_i] is to be taken.

    H[θ_i] = R_γᵀ hat(p_j − p_i) Hz, where only the last row of Hz is not zero. With d in a given
    frame it is TLIO's, (cos y tan q, sin y tan q, 1): the change of the yaw y of exp(δθ) R_i, q
    being its pitch (R = Rz(y) Ry(q) Rx). At gimbal lock tan q is taken as 0.

    In the filter's own frame it is (0, 0, 1) (ours). The window is cut with the yaw of the estimate
    R̂_i = exp(−δθ) R_i, and the network answers in that frame. If it is equivariant to yaw and a
    small tilt changes nothing, d = R_γ(R̂_i)ᵀ exp(−δθ_z e_z) (p_j − p_i): however the error turns
    the frame, it turns d and the prediction alike, and r feels δθ_z alone. The yaw is not
    differentiated, so there is no gimbal lock.
    """
    unyaw = geometry.yaw_rotation(rotation_i).T
    predicted, lever = unyaw @ moved, unyaw @ moved_linearized
    zero, one = jnp.zeros_like(moved[0]), jnp.ones_like(moved[0])
    if frame == "own":
        defined, yaw_row = jnp.bool_(True), jnp.stack([zero, zero, one])
    else:
        cosine_squared = rotation_i[0, 0] ** 2 + rotation_i[1, 0] ** 2
        defined = cosine_squared >= GIMBAL**2
        divisor = jnp.where(defined, cosine_squared, 1.0)
        scale = jnp.where(defined, -rotation_i[2, 0] / divisor, 0.0)  # tan q / cos q
        yaw_row = jnp.stack([scale * rotation_i[0, 0], scale * rotation_i[1, 0], one])
    # hat(d) Hz is a single outer product, (d × z) ⊗ yaw_row, and the yaw leaves z alone.
    turned = jnp.stack([lever[1], -lever[0], zero])
    jacobian = jnp.concatenate([turned[:, None] * yaw_row[None, :], -unyaw, unyaw], axis=1)
    none, nothing = jnp.zeros((3, 0), jacobian.dtype), jnp.zeros((3, 3), jacobian.dtype)
    return Residual(displacement - predicted, jacobian, none, nothing, defined)


def update(
    state: FilterState,
    measurement: Measurement,
    newest: Array | int,
    oldest: Array | int,
    config: FilterConfig,
    frame: YawFrame = "given",
    errors: CorrelatedError | None = None,
) -> tuple[FilterState, DisplacementUpdate]:
    """`update_with_correction` for those who do not smooth."""
    state, result, _ = update_with_correction(
        state, measurement, newest, oldest, config, frame, errors
    )
    return state, result


def update_with_correction(
    state: FilterState,
    measurement: Measurement,
    newest: Array | int,
    oldest: Array | int,
    config: FilterConfig,
    frame: YawFrame,
    errors: CorrelatedError | None = None,
) -> tuple[FilterState, DisplacementUpdate, Correction]:
    """One EKF update with the displacement between the clones in slots `oldest` and `newest` of the
    ring, once it is full.

    H touches twelve rows of the covariance P and those of the `errors` that last, so H P is three
    rows. Nothing changes where there is no measurement, or it is rejected, or at gimbal lock.
    """
    full = state.step >= state.clone_offset.shape[0]
    measurement = measurement._replace(present=measurement.present & full)
    # Once in a round of the ring the oldest clone has the core's anchor, else the one before it.
    moves_apart = jnp.where(oldest == 0, 0.0, 1.0).astype(state.move.dtype)
    residual = _residual_of_state(state, measurement.displacement, oldest, moves_apart, frame)
    if errors is not None:
        residual = _with_lasting_errors(residual, measurement, state, errors)
    projected = _project(state, residual, oldest, moves_apart)

    white = _whiten(residual, projected, measurement, 1.0)
    whitened = white.rows[0][:, 0]
    nis = jnp.dot(whitened, whitened)
    tested = measurement.present & residual.defined
    now = state.step * config.samples_per_clone
    memory, weight = innovation_gate(state.gate, config, now, now - config.window, nis, tested)
    result = DisplacementUpdate(
        present=measurement.present,
        tested=tested,
        innovation=residual.innovation,
        nis=nis,
        volume=white.volume,
        gate_passed=weight,
        accepted=weight > 0,
    )
    scale = _covariance_scale(weight, tested, config)
    if scale is not None:
        white = _whiten(residual, projected, measurement, scale)
        result = result._replace(accepted=tested)
    correction = _correction(white, moves_apart, result.accepted)
    # What bounds the correction is rᵀ S⁻¹ r with the S of the update, that is after any scaling.
    whitened = correction.whitened
    large = result.accepted & (jnp.dot(whitened, whitened) > config.gate_threshold)
    state = relinearize(apply_correction(state, correction, newest), large)
    return state._replace(gate=memory), result, correction


def _residual_of_state(
    state: FilterState,
    displacement: Float[Array, "3"],
    oldest: Array | int,
    moves_apart: Float[Array, ""],
    frame: YawFrame,
) -> Residual:
    """Between the oldest clone and the core, whose anchors are `moves_apart` moves apart."""
    moved = state.offset + moves_apart * state.move - state.clone_offset[oldest]
    first, moved_first = state.first, moved
    if first is not None:
        moved_first = first.offset + moves_apart * first.move - first.clone_offset[oldest]
    rotation = state.clone_rotation[oldest]
    return displacement_residual(rotation, moved, displacement, moved_first, frame)


def _with_lasting_errors(
    residual: Residual, measurement: Measurement, state: FilterState, errors: CorrelatedError
) -> Residual:
    """The residual of a displacement with errors that last."""
    jacobian = errors.share * cholesky(measurement.covariance).matrix
    expected = matmul(jacobian, state.lasting[:, None])[:, 0]
    return residual._replace(
        innovation=residual.innovation - expected,
        lasting_jacobian=jacobian,
        lasting_covariance=errors.share**2 * measurement.covariance,
    )


class _Projected(NamedTuple):
    """The covariance as the measurement sees it."""

    core_rows: Float[Array, "3 n"]
    """H P against the core."""
    clone_rows: Float[Array, "3 m"]
    """H P against the clones."""
    innovation_covariance: Float[Array, "3 3"]
    """H P Hᵀ."""


def _project(
    state: FilterState, residual: Residual, oldest: Array | int, moves_apart: Array
) -> _Projected:
    """H P and H P Hᵀ. The newest clone is the core's own pose: its rows of P are the core's."""
    entry = CLONE * oldest
    old_core = jax.lax.dynamic_slice_in_dim(state.cross_covariance, entry, CLONE, 1)
    old_clones = jax.lax.dynamic_slice_in_dim(state.clone_covariance, entry, CLONE, 0)
    new_core, new_clones = (
        part[OFFSET] + moves_apart * part[MOVE]
        for part in (state.core_covariance, state.cross_covariance)
    )
    of_errors = state.core_covariance[LASTING], state.cross_covariance[LASTING]
    jacobian = jnp.concatenate([residual.jacobian, residual.lasting_jacobian], axis=1)
    core_rows = matmul(jacobian, jnp.concatenate([old_core.T, new_core, of_errors[0]]))
    clone_rows = matmul(jacobian, jnp.concatenate([old_clones, new_clones, of_errors[1]]))
    of_old = jax.lax.dynamic_slice_in_dim(clone_rows, entry, CLONE, 1)
    of_new = core_rows[:, OFFSET] + moves_apart * core_rows[:, MOVE]
    touched = jnp.concatenate([of_old, of_new, core_rows[:, LASTING]], axis=1)
    return _Projected(core_rows, clone_rows, matmul(touched, jacobian.T))


def _whiten(
    residual: Residual, projected: _Projected, measurement: Measurement, scale: Array | float
) -> Whitened:
    """L⁻¹ of r, H P (core, clones) and H (clones, errors that last), with L of S = H P Hᵀ + scale ·
    R, the identity where there is no measurement. What of R lasts is in H P Hᵀ, once."""
    whole = projected.innovation_covariance + scale * measurement.covariance
    whole = whole - residual.lasting_covariance
    spread = jnp.where(measurement.present, whole, jnp.eye(3, dtype=whole.dtype))
    rows = (
        residual.innovation[:, None],
        projected.core_rows,
        projected.clone_rows,
        residual.jacobian,
        residual.lasting_jacobian,
    )
    return whiten(spread, rows)


def _covariance_scale(
    weight: Float[Array, ""], tested: Bool[Array, ""], config: FilterConfig
) -> Float[Array, ""] | None:
    """Factor of the measurement's covariance by which a gated measurement is applied all the same;
    None where the gate accepts or rejects."""
    if config.mahalanobis_fail_scale > 0:
        failed = tested & ~(weight > 0)
        return jnp.where(failed, config.mahalanobis_fail_scale, 1.0).astype(weight.dtype)
    if config.gate_softness > 0:
        return 1 / jnp.clip(jnp.where(tested, weight, 1.0), LEAST_WEIGHT)
    return None


def _correction(
    white: Whitened, moves_apart: Float[Array, ""], accepted: Bool[Array, ""]
) -> Correction:
    """Of what `_whiten` returns; rows of zeros where the measurement is not `accepted`."""
    whitened, *rows = white.rows
    core_rows, clone_rows, jacobian, of_errors = (jnp.where(accepted, part, 0.0) for part in rows)
    of_new = jacobian[:, OF_NEWEST]
    core_jacobian = jnp.zeros_like(core_rows).at[:, OFFSET].set(of_new)
    core_jacobian = core_jacobian.at[:, MOVE].set(moves_apart * of_new)
    core_jacobian = core_jacobian.at[:, LASTING].set(of_errors)
    of_oldest = jacobian[:, OF_OLDEST]
    return Correction(whitened[:, 0], core_rows, clone_rows, core_jacobian, of_oldest)
