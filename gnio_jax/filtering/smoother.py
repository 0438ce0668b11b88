"""Fixed-interval smoothing (ours): every estimate of the filter is corrected by all later
measurements, for use offline.

A displacement relates the present to the pose one second ago, so the augmented error with all
clones must be smoothed. Its covariance is singular, because the newest clone duplicates the core's
pose. The modified Bryson–Frazier form (Bierman 1973) never inverts it. With the filter's error e ~
N(0, P) after step k,

    e | all measurements ~ N(−P λ, P − P Λ P),

where the adjoint λ, Λ runs backwards from zero. Backwards over an update with S = L Lᵀ, M = L⁻¹ H
and Y = M P it becomes

    λ ← λ − Mᵀ (Y λ + L⁻¹ r),   Λ ← (I − Yᵀ M)ᵀ Λ (I − Yᵀ M) + Mᵀ M,

and backwards over a propagation with the augmented transition F, which puts the core's pose into
the slot of the oldest clone,

    λ ← Fᵀ λ,   Λ ← Fᵀ Λ F.

An update that was not applied has no term, and a weighted update has its weight. e is the error as
the filter holds it (see `state`): an invariant error becomes an additive one only where it is added
to the mean.

Everything is linearised at the filter's own estimates, as in any extended smoother: Jacobians are
not computed again at the smoothed ones.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gnio_jax import geometry
from gnio_jax.filtering.checks import (
    FilterInputs,
    check_frame,
    checked_displacements,
    checked_inputs,
)
from gnio_jax.filtering.displacement import scaled_displacement
from gnio_jax.filtering.filter import Filter
from gnio_jax.filtering.history import StepRecord, healthy_rows
from gnio_jax.filtering.propagation import Transition, put
from gnio_jax.filtering.scan import StepTrace, clone_steps, take_row
from gnio_jax.filtering.settings import DisplacementFrame, FilterConfig
from gnio_jax.filtering.state import (
    CLONE,
    CORE,
    OFFSET,
    THETA,
    FilterState,
    Mean,
    additive_core,
    arc_covariance,
    first_order_covariance,
    with_position,
)
from gnio_jax.filtering.update import Correction, Measurement, measurable_errors
from gnio_jax.geometry import matmul
from gnio_jax.types import Array


class SmoothedHistory(NamedTuple):
    """The smoothed estimates of K clone intervals: rows, frames and units as in `FilterHistory`."""

    rotation: Float[Array, "k 3 3"]
    velocity: Float[Array, "k 3"]
    position: Float[Array, "k 3"]
    gyro_bias: Float[Array, "k 3"]
    accel_bias: Float[Array, "k 3"]
    covariance_diagonal: Float[Array, "k 15"]
    covariance: Float[Array, "k 15 15"] | None
    healthy: Float[Array, "k"]
    """That of the filter's run, 0 from the first row on that is impossible. The measurements of
    all rows correct each smoothed row, so a 0 anywhere makes all rows invalid."""


def smooth(
    ekf: Filter,
    state: FilterState,
    gyro: Any,
    accel: Any,
    displacement: Any,
    covariance: Any,
    imu_valid: Any = None,
    frame: DisplacementFrame = "given",
    measurements: tuple[Measurement, ...] = (),
    variance: Any = None,
    diagnostics: Mapping[str, Any] = MappingProxyType({}),
) -> SmoothedHistory:
    """Filter K clone intervals as `run_filter` does, then smooth: each row is the estimate given
    all measurements of the K intervals.

    The updates of `run_filter` are smoothed exactly as they were made. A run of `run_odometry` that
    returned `history` is smoothed without its network by

        smooth(ekf, state, gyro, accel, *history.unscaled_displacements(ekf.noise),
               frame=ekf.config.displacement_frame, diagnostics=history.diagnostics)

    `state` is the prior, and earlier measurements are not smoothed. It works under `jax.jit`,
    `jax.vmap` and `jax.grad`.

    Smoothing trusts the IMU as far as `ekf.noise` says. Where the IMU is sampled too slowly for the
    motion, as on a swinging leg at 100 Hz, its integration errs by more than that, and the smoothed
    positions can be worse than those of the filter. With 200 Hz, or with a larger `accel_density`
    (0.03 there), they are better.

    Memory: about K · (18 m + 500) numbers, m = 21 + e + 6 (W + 1) with e correlated errors: 25 kB
    for each interval at W = 20, in float64. Smoothed variances are differences. In float32 a
    variance that becomes smaller by many orders of magnitude, as at the start, keeps few digits and
    can become negative.

    Args:
        ekf: The filter (`Filter`, `make_filter`).
        state: The start (`initial_state`, `level_state`), or the final state of an earlier run.
        gyro: (K·n, 3) angular rate, body frame, rad/s, raw: the filter subtracts its bias.
        accel: (K·n, 3) specific force, body frame, m/s², raw.
        displacement: (K, 3) m, as in `run_filter`.
        covariance: (K, 3, 3) m², as in `run_filter`.
        imu_valid: (K·n,) booleans, False where an IMU sample is missing; None: the stream is
            complete.
        frame: The attitude that defines the frame of the displacements, as in `run_filter`.
        measurements: Measurements with a row for each interval.
        variance: (K·n, 6) variances of the samples, as in `run_filter`.
        diagnostics: A network's diagnostics of every interval, as in `run_filter`.

    Raises:
        ValueError: As `run_filter`.
    """
    check_frame(frame)
    inputs = checked_inputs(ekf, state, gyro, accel, imu_valid, measurements, variance)
    rows = checked_displacements(displacement, covariance, inputs)
    return _smooth(inputs, *rows, dict(diagnostics), frame)


class _ForwardStep(NamedTuple):
    """The results of one forward step that the backward pass needs."""

    slot: Int[Array, "*k"]
    """Slot of the ring for the clone at the end of the interval."""
    mean: Mean
    """The mean after the step."""
    covariance: Float[Array, "*k 15 15"]
    """Covariance of θ, v, p, b_g, b_a in first order."""
    cross: Float[Array, "*k 15 m"]
    """Covariance of θ, v, p, b_g, b_a with the whole error, core and clones."""
    trace: StepTrace


@functools.partial(jax.jit, static_argnames="frame")
def _smooth(
    inputs: FilterInputs,
    displacement: Array,
    covariance: Array,
    diagnostics: dict[str, Array],
    frame: DisplacementFrame,
) -> SmoothedHistory:
    config = inputs.ekf.config
    rows = scaled_displacement(displacement, covariance, inputs.ekf.noise, frame)

    def keep(slot: Array, state: FilterState, record: StepRecord, trace: StepTrace) -> _ForwardStep:
        whole = jnp.concatenate([state.core_covariance, state.cross_covariance], axis=1)
        cross = additive_core(state, with_position(whole))
        return _ForwardStep(slot, record.mean, first_order_covariance(state), cross, trace)

    state, steps, _ = clone_steps(take_row, inputs, (rows, diagnostics), keep)
    size, dtype = sum(state.cross_covariance.shape), state.offset.dtype
    nothing = Adjoint(jnp.zeros(size, dtype), jnp.zeros((size, size), dtype))
    backward = functools.partial(_step_back, config=config)
    _, (mean, covariance) = jax.lax.scan(backward, nothing, steps, reverse=True)
    diagonal = jnp.diagonal(covariance, axis1=1, axis2=2)
    healthy = healthy_rows(steps.mean, steps.covariance, inputs.state.healthy, config)
    whole = covariance if config.history == "core" else None
    return SmoothedHistory(*mean, diagonal, whole, healthy.astype(dtype))


def _step_back(
    adjoint: Adjoint, step: _ForwardStep, config: FilterConfig
) -> tuple[Adjoint, tuple[Mean, Array]]:
    """The smoothed estimate after a step, and the adjoint before it."""
    error = -(step.cross @ adjoint.vector)
    covariance = step.covariance - step.cross @ adjoint.matrix @ step.cross.T
    turn, *others = jnp.split(error, 5)
    if config.invariant:
        covariance = covariance + arc_covariance(covariance)
        others[:2] = (geometry.exp_rigid(turn, part)[1] for part in others[:2])
    rotation = matmul(geometry.exp(turn), step.mean.rotation)
    mean = Mean(rotation, *map(jnp.add, step.mean[1:], others))
    oldest = (step.slot + 1) % config.clones
    for correction in reversed(step.trace.corrections):
        adjoint = _pull_back_update(adjoint, correction, oldest)
    adjoint = _pull_back_propagation(adjoint, step.trace.transition, step.slot)
    return adjoint, (mean, covariance)


class Adjoint(NamedTuple):
    """λ and Λ over the core and the ring of clones."""

    vector: Float[Array, "m"]
    matrix: Float[Array, "m m"]


def _pull_back_update(adjoint: Adjoint, correction: Correction, oldest: Int[Array, ""]) -> Adjoint:
    """The adjoint before an update; `oldest` is the slot of the oldest clone."""

    measured = functools.partial(measurable_errors, correction.jacobian, oldest=oldest)
    rows = jnp.concatenate([correction.core, correction.clones], axis=1)
    blocks = jnp.concatenate(list(correction.jacobian.values()), axis=1).T
    transposed = jax.linear_transpose(measured, correction.core.T, correction.clones.T)
    jacobian = jnp.concatenate(transposed(blocks)).T
    over = rows @ adjoint.matrix
    # Λ − Mᵀ G − Gᵀ M with G = Y Λ − ½ (Y Λ Yᵀ + I) M
    half = 0.5 * (matmul(over, rows.T) + np.eye(len(rows), dtype=over.dtype))
    gain = over - matmul(half, jacobian)
    return Adjoint(
        adjoint.vector - jacobian.T @ (rows @ adjoint.vector + correction.residual),
        adjoint.matrix - matmul(jacobian.T, gain) - matmul(gain.T, jacobian),
    )


def _pull_back_propagation(
    adjoint: Adjoint, transition: Transition, slot: Int[Array, ""]
) -> Adjoint:
    """The adjoint before the propagation and the cloning into `slot`."""
    size, core = len(adjoint.vector), CORE + len(transition.decay)

    def step(rows: Float[Array, "m r"]) -> Float[Array, "m r"]:
        """The product of F and `rows`."""
        moved, clones = transition(rows[:core]), rows[core:]
        pose = jnp.concatenate([moved[THETA], moved[OFFSET]])
        return jnp.concatenate([moved, put(clones, pose, CLONE * slot, 0)])

    def pull_back(rows: Float[Array, "m r"]) -> Float[Array, "m r"]:
        like = jax.ShapeDtypeStruct((size, rows.shape[1]), rows.dtype)
        return jax.linear_transpose(step, like)(rows)[0]

    return Adjoint(pull_back(adjoint.vector[:, None])[:, 0], pull_back(pull_back(adjoint.matrix).T))
