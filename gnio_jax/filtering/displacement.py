"""The displacement between the oldest and the newest clone as a measurement (paper §III-G, after
TLIO).

Windows overlap, so the errors of successive windows are correlated, which white noise cannot
express. If `NoiseModel.correlation` is given (ours), the model is, with the true displacement u in
the yaw frame of the window and the network's covariance Σ = L Lᵀ,

    d = u + L (c b + √(1 − c²) w),   w ~ N(0, I) white,

where b (3) is a first-order Gauss–Markov process of variance 1 and time constant τ, which adds
three entries to the state. The covariance of each single measurement remains Σ, but the information
of their average is bounded. If the error of a window were the sum of independent errors of its W
strides, its correlation would fall linearly to zero at the window's length; the exponential with τ
equal to half that length has the same integral, and so the same error of a long sum, with three
entries instead of 3 W.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import geometry, numerics
from gnio_jax.config import NoiseModel
from gnio_jax.filtering.settings import DisplacementFrame, FilterConfig
from gnio_jax.filtering.state import OF_DISPLACEMENT, FilterState, GateState
from gnio_jax.filtering.update import (
    Correction,
    Linearised,
    Outcome,
    Step,
    correct,
    linearise,
    project,
    since_oldest,
    whiten,
)
from gnio_jax.types import Array

LEAST_WEIGHT = 1e-6
"""Smallest weight that a gate with a slope gives to a measurement, so that its covariance is
bounded."""
GIMBAL = 1e-5
"""Below this |cos pitch| the yaw of the oldest clone has no derivative, and a displacement that is
expressed in a given frame is not used."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Displacement:
    """Displacement from the oldest to the newest clone, expressed in the yaw frame of the oldest,
    or the velocity at the newest in metres per window, expressed in the body; or K of them. The
    numbers are finite even where there is none."""

    displacement: Float[Array, "*k 3"]
    """m"""
    covariance: Float[Array, "*k 3 3"]
    """Covariance after scaling, m²; positive definite even where there is no displacement."""
    present: Bool[Array, "*k"]
    """Whether there is a displacement."""
    frame: DisplacementFrame = field(metadata={"static": True})
    """The yaw frame by the filter's own attitude of the oldest clone, or by another one, or the
    body (`DisplacementFrame`)."""
    name: ClassVar[str] = "displacement"

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]:
        """Nothing changes without a measurement, before the ring is full, at gimbal lock, where
        the χ² gate rejects it, or where it is faster than `FilterConfig.speed_limit`. With
        `mahalanobis_fail_scale` or `gate_softness` what the gate rejects is applied with a larger
        covariance instead."""
        config = step.config
        linear, defined = linearise_displacement(self, state, step)
        linear = linear._replace(residual=jnp.where(self.present, linear.residual, jnp.nan))
        outcome, innovation = project(state, linear, step)
        tested = outcome.present & defined
        # The gate is open at the start and after a series of rejections.
        longest = config.speed_limit * config.window * config.dt
        plausible = jnp.sum(self.displacement**2) <= longest**2
        possible = tested & plausible
        gate, weight = innovation_gate(state.gate, config, state.step, outcome.nis, possible)
        accepted, factor = weight > 0, None
        if config.mahalanobis_fail_scale > 0:
            failed = possible & ~accepted
            factor = jnp.where(failed, config.mahalanobis_fail_scale, 1.0).astype(weight.dtype)
        elif config.gate_softness > 0:
            factor = 1 / jnp.clip(jnp.where(possible, weight, 1.0), LEAST_WEIGHT)
        if factor is not None:  # applied with a larger covariance
            weaker = linear._replace(covariance=linear.covariance + (factor - 1) * self.covariance)
            _, innovation = project(state, weaker, step)
            accepted = possible
        # A matrix that is no covariance must spoil the state, and `healthy` then reports it.
        accepted = accepted | (outcome.present & plausible & jnp.isnan(outcome.nis))
        outcome = outcome._replace(tested=tested, weight=weight, accepted=accepted)
        return correct(state._replace(gate=gate), outcome, innovation, step)


def scaled_displacement(
    displacement: Float[Array, "*k 3"],
    covariance: Float[Array, "*k 3 3"],
    noise: NoiseModel,
    frame: DisplacementFrame,
) -> Displacement:
    """A displacement, m, with its covariance, m², scaled by `measurement_scale` and `std_factor`,
    or K of them. A NaN in either means that there is no measurement. NaN is kept out of the
    arithmetic, because otherwise the derivatives would be NaN too."""
    dtype, shape = covariance.dtype, covariance.shape
    present = jnp.isfinite(displacement).all(-1) & jnp.isfinite(covariance).all((-2, -1))
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), shape)
    factor = jnp.stack(jax.tree.map(jnp.asarray, noise.std_factor)).astype(dtype)
    scale = jnp.asarray(noise.measurement_scale, dtype) * (factor[:, None] * factor[None])
    mask = present[..., None, None]
    finite_covariance = jnp.where(mask, covariance, eye)
    return Displacement(
        displacement=jnp.where(present[..., None], displacement, 0.0),
        covariance=jnp.where(mask, jnp.broadcast_to(scale, shape) * finite_covariance, eye),
        present=present,
        frame=frame,
    )


def linearise_displacement(
    measurement: Displacement, state: FilterState, step: Step
) -> tuple[Linearised, Bool[Array, ""]]:
    """r = d − R_γ(R_i)ᵀ (p_j − p_i) of the oldest clone i and the newest j, linearised, and whether
    its Jacobian is defined (no gimbal lock).

    H[p_j − p_i] = R_γᵀ, and H[θ_i] = R_γᵀ hat(p_j − p_i) e_z hᵀ: only the yaw of R_i matters, and h
    is its derivative by δθ. For d in a given frame it is TLIO's h = (cos y tan q, sin y tan q, 1)
    with the yaw y and the pitch q of R_i = Rz(y) Ry(q) Rx. At gimbal lock tan q is taken as 0.

    In the filter's own frame h = (0, 0, 1) (ours). The window is cut with the yaw of the estimate
    R̂_i = exp(−δθ) R_i, and the network answers in that frame. If it is equivariant to yaw and a
    small tilt changes nothing, d = R_γ(R̂_i)ᵀ exp(−δθ_z e_z) (p_j − p_i): an error of the frame
    turns d and the prediction by the same angle, and only δθ_z remains in r. The yaw is not
    differentiated, so there is no gimbal lock. The frame "turning" is this one, and the derivative
    of its R_γ is that by δθ_z alone.

    In the body d is the velocity times the length T of the window (AirIO): r = d − T Rᵀ v for the
    present attitude R and velocity v, H[v] = T Rᵀ, and H[θ] = T Rᵀ hat(v).

    With a correlation of share c, the part c L b of the error is predicted, and R = (1 − c²) Σ.
    """
    if measurement.frame == "body":
        moved, jacobian = _predict_velocity(state, step.config)
        defined = jnp.bool_(True)
    else:
        moved, jacobian, defined = _predict_displacement(measurement.frame, state, step.oldest)
    residual, covariance = measurement.displacement - moved, measurement.covariance
    correlation = step.noise.correlation
    if correlation is not None:
        (transposed,), _ = whiten(covariance, (covariance,))  # L⁻¹ Σ = Lᵀ
        jacobian["correlated"] = correlation.share * transposed.T
        errors = state.correlated[OF_DISPLACEMENT]
        predicted = geometry.matmul(jacobian["correlated"], errors[:, None])[:, 0]
        # NaN if Σ is no covariance, which is not the same as no measurement.
        predicted = jnp.where(jnp.isnan(predicted), 0.0, predicted)
        residual, covariance = residual - predicted, (1 - correlation.share**2) * covariance
    return linearise(state, residual, covariance, **jacobian), defined


def _predict_velocity(
    state: FilterState, config: FilterConfig
) -> tuple[Float[Array, "3"], dict[str, Array]]:
    """N dt Rᵀ v, the velocity in the body in metres per window, and its derivatives."""
    to_body = config.window * config.dt * state.rotation.T
    moved = geometry.matmul(to_body, state.velocity[:, None])[:, 0]
    by_turn = geometry.matmul(to_body, geometry.hat(state.velocity))
    return moved, {"velocity": to_body, "rotation": by_turn}


def _predict_displacement(
    frame: DisplacementFrame, state: FilterState, oldest: Array | int
) -> tuple[Float[Array, "3"], dict[str, Array], Bool[Array, ""]]:
    """R_γ(R_i)ᵀ (p_j − p_i), its derivatives, and whether they are defined."""
    rotation = state.clone_rotation[oldest]
    yaw_frame = geometry.yaw_rotation(rotation)
    if frame == "turning":
        fixed = jax.lax.stop_gradient(rotation)
        turn = geometry.twist_direction(geometry.matmul(rotation, fixed.T))
        yaw_frame = geometry.heading_rotation(*turn) @ jax.lax.stop_gradient(yaw_frame)
    to_yaw_frame = yaw_frame.T
    moved = to_yaw_frame @ since_oldest(state, oldest)
    zero, one = jnp.zeros_like(moved[0]), jnp.ones_like(moved[0])
    if frame in ("own", "turning"):
        defined, yaw_row = jnp.bool_(True), jnp.stack([zero, zero, one])
    else:
        cosine_squared = rotation[0, 0] ** 2 + rotation[1, 0] ** 2
        defined = cosine_squared >= GIMBAL**2
        divisor = jnp.where(defined, cosine_squared, 1.0)
        scale = jnp.where(defined, -rotation[2, 0] / divisor, 0.0)  # tan q / cos q
        yaw_row = jnp.stack([scale * rotation[0, 0], scale * rotation[1, 0], one])
    # R_γᵀ hat(p_j − p_i) e_z = (R_γᵀ (p_j − p_i)) × e_z, since the yaw leaves e_z as it is.
    by_yaw = jnp.stack([moved[1], -moved[0], zero])
    jacobian: dict[str, Array] = {
        "since_oldest": to_yaw_frame,
        "oldest_rotation": by_yaw[:, None] * yaw_row[None],
    }
    return moved, jacobian, defined


def displacements(rotation: Any, position: Any, config: FilterConfig) -> Float[np.ndarray, "k 3"]:
    """Displacements of a known trajectory as `run_filter` takes them, m, e.g. of a reference.

    rotation (K + 1, 3, 3) body → world and position (K + 1, 3), m, are those at the start and at
    the end of each clone interval: every n-th row of a reference at the rate of the IMU. Row k of
    the K rows is from clone k − W to clone k, the rows k + 1 − W and k + 1 of the trajectory,
    expressed in the yaw frame of clone k − W; NaN for k < W, before there are W + 1 clones. Raises
    `ValueError` if there is no row, or a shape differs.
    """
    rotation, position = np.asarray(rotation), np.asarray(position)
    rows = len(position) if position.ndim else 0
    if not rows or rotation.shape != (rows, 3, 3) or position.shape != (rows, 3):
        shapes = f"{rotation.shape} and {position.shape}"
        raise ValueError(
            f"rotation and position: must be (K + 1, 3, 3) and (K + 1, 3), found {shapes}"
        )
    window = config.clones_per_window
    displacement = np.full((len(position) - 1, 3), np.nan)
    measured = max(len(displacement) - window, 0)
    oldest = slice(1, 1 + measured)
    moved = position[1 + window :] - position[oldest]
    yaw = numerics.yaw_rotation(rotation[oldest])
    displacement[window:] = np.einsum("kji,kj->ki", yaw, moved)
    return displacement


# TLIO's χ² gate: which displacements the filter accepts. It has nothing to do with the gate of the
# network's head, which scales a displacement.
# ------------------------------------------------------------------------------------------------


def gate_activity(
    memory: GateState, config: FilterConfig, now: Array
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether the gate is active at sample `now`, and whether it would be active if the last
    success were not too old."""
    ready = memory.converged & (now >= memory.pause_end)
    old = now - memory.last_success > config.whole_samples(config.success_seconds)
    stale = ready & (memory.last_success >= 0) & old
    return ready & ~stale, stale


def innovation_gate(
    memory: GateState,
    config: FilterConfig,
    step: Array,
    nis: Float[Array, ""],
    tested: Array,
) -> tuple[GateState, Float[Array, ""]]:
    """The gate's memory after clone interval `step` (counted from 1), and the weight of its
    measurement: 1 accepted, 0 rejected.

    While no measurement is `tested`, the time of the last success moves along (ours). Otherwise the
    first second after any hole would pass unchecked, because the last success would be too old.
    TLIO has a measurement at every clone. Comparisons are strict ("more than", "older"); exactly at
    the end of a pause the gate is active again. With `gate_softness` the active gate gives a weight
    instead (ours); its memory still counts what is above the threshold as a failure.
    """
    now = step * config.samples_per_clone
    old_enough = now - config.window > config.whole_samples(config.convergence_seconds)
    memory = memory._replace(converged=memory.converged | (tested & old_enough))
    active, stale = gate_activity(memory, config, now)
    passed = tested & (~active | (nis <= config.gate_threshold))
    weight = passed.astype(nis.dtype)
    if config.gate_softness > 0:
        slope = jax.nn.sigmoid((config.gate_threshold - nis) / config.gate_softness)
        weight = jnp.where(tested, jnp.where(active, slope, 1.0), 0.0)
    waited = jnp.where(~tested & (memory.last_success >= 0), config.samples_per_clone, 0)
    # Samples until a pause is over, rounded up independently of the rounding of pause / dt.
    pause_end = now - int(np.floor(-config.pause_seconds / config.dt + 1e-6))
    memory = memory._replace(
        last_success=jnp.where(passed, now, memory.last_success + waited.astype(jnp.int32)),
        pause_end=jnp.where(tested & stale, pause_end, memory.pause_end),
    )
    return memory, weight
