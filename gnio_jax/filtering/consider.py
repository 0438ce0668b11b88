"""Errors that are reported in the covariance without being estimated (ours; consider covariance
analysis, after Schmidt: Tapley, Schutz and Born 2004, ch. 6).

A filter that estimates every possible error can be less accurate than one that omits some: a
displacement of uncertain heading corrects the yaw with its own error. But a covariance P that omits
these errors is too small. Let c be the omitted errors, constant over a recording, with E[c cᵀ] = C,
and let S = ∂x̂/∂c be the sensitivity of the estimate x̂. The covariance of its error is then

    P + S C Sᵀ,

and where the filter's error is the invariant one, the second order of an uncertain yaw is that of
this sum (`with_considered`). The estimate, its gains and its innovations do not change. c has the
error of the first gyro bias (3, rad/s) and an error of all displacements u of a walk (ours):

    d = exp(s) Rz(ψ) u + γ |u_xy| e_z,

with the logarithm s of their scale, their heading ψ (rad) and their slope γ. S is the forward-mode
derivative of the whole estimator, through every update that it made: of a whole run
(`sensitivity`), or step by step while the filter runs (`step_with_tangents`).

The bias of a raw gyro has a further error along the vertical at the start, an axis of the body. A
filter that estimates this component learns it from the errors of the displacements
(`start.initial_state`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.config import ConsideredStd
from gnio_jax.filtering.checks import check_kind, check_numbers
from gnio_jax.filtering.displacement import Displacement
from gnio_jax.filtering.history import FilterHistory
from gnio_jax.filtering.scan import Measure
from gnio_jax.filtering.settings import FilterConfig, differentiable_frame
from gnio_jax.filtering.smoother import SmoothedHistory
from gnio_jax.filtering.state import FilterState, Mean, arc_covariance
from gnio_jax.types import Array

T = TypeVar("T")

ENTRIES = 6
OF_BIAS, OF_SCALE, OF_HEADING, OF_SLOPE = slice(0, 3), 3, 4, 5
"""Entries of the gyro's bias, s, ψ and γ in c."""
STILL = 1e-6
"""Added in quadrature to the length of a displacement, m, so that standing still is no singular
point."""


def considered_covariance(
    sensitivity: Float[Array, "k d 6"],
    std: ConsideredStd,
    raw_axis: Float[Array, "k 3"] | None = None,
) -> Float[jax.Array, "k d d"]:
    """S C Sᵀ, to be added to P, for the given rows of S.

    raw_axis has the axis of the body along which the bias of a raw gyro has the further standard
    deviation `std.raw_gyro_bias`, and zeros where the gyro is not raw. None: no gyro is raw. Raises
    `ValueError` for a standard deviation that is negative or not finite.
    """
    check_kind("considered", std, ConsideredStd, "ConsideredStd(scale=0.03)")
    check_numbers("considered", std)
    stds = (std.gyro_bias, std.gyro_bias, std.gyro_bias, std.scale, std.heading, std.slope)
    root = sensitivity * jnp.stack([jnp.asarray(value) for value in stds])[None, None]
    if raw_axis is not None:
        along = jnp.einsum("kdi,ki->kd", sensitivity[:, :, OF_BIAS], raw_axis)
        root = jnp.concatenate([root, std.raw_gyro_bias * along[:, :, None]], axis=2)
    return jnp.einsum("kic,kjc->kij", root, root)


def with_considered(
    covariance: Float[Array, "k 15 15"], added: Float[Array, "k 15 15"], config: FilterConfig
) -> Float[Array, "k 15 15"]:
    """The covariances of θ, v, p, b_g, b_a that a filter or a smoother with `config` reports, with
    S C Sᵀ = `added`.

    In the invariant form the arc of the position (`state.arc_covariance`) is that of the yaw's
    whole uncertainty, and replaces the arc of the filter's part, which `covariance` contains. That
    one is computed from the rows of the yaw, to which an arc adds nothing.
    """
    total = covariance + added
    if not config.invariant:
        return total
    return total + arc_covariance(total) - arc_covariance(covariance)


def disturb(
    displacement: Float[Array, "k 3"],
    c: Float[Array, "6"],
    rotation: Float[Array, "k 3 3"] | None = None,
) -> Float[jax.Array, "k 3"]:
    """d of the displacements u = `displacement`, m; NaN stays NaN. `rotation` is body → world of
    each row if the rows are velocities in the body: they are disturbed in the world."""
    if rotation is not None:
        world = jnp.einsum("kij,kj->ki", rotation, displacement)
        return jnp.einsum("kji,kj->ki", rotation, disturb(world, c))
    displacement, c = jnp.asarray(displacement), jnp.asarray(c)
    turn = geometry.rotation_z(c[OF_HEADING])
    length = jnp.sqrt(jnp.sum(displacement[:, :2] ** 2, axis=1) + STILL**2)
    turned = jnp.exp(c[OF_SCALE]) * geometry.matmul(displacement, turn.T)
    return turned.at[:, 2].add(c[OF_SLOPE] * length)


def sensitivity(
    run: Callable[[FilterState, Array], FilterHistory | SmoothedHistory],
    state: FilterState,
    displacement: Float[Array, "k 3"],
    rotation: Float[Array, "k 3 3"] | None = None,
) -> Float[jax.Array, "k 15 6"]:
    """S of θ, v, p, b_g, b_a after each clone interval of `run(state, displacement)`. `run` is a
    function from the start and the displacements, m, to the history of `run_filter` or `smooth`.

    For a run of `run_odometry` the displacements are those of its history, and if they are
    velocities in the body, `rotation` is body → world of each row (`disturb`). The network is not
    called again, and the effect of other biases on its windows is neglected (docs/filter.md). But
    its displacements turn with the yaw frame of the filter, which a tilt turns too if the x axis is
    steep. So `run` must take them in the frame `FilterConfig.derivative_frame`. `run` must not cut
    its gradient (`FilterConfig.truncate_every`), because S is the derivative of the whole run.
    """

    def run_disturbed(c: Float[Array, "6"]) -> tuple[Mean, Array]:
        start = state._replace(gyro_bias=state.gyro_bias + c[OF_BIAS])
        history = run(start, disturb(displacement, c, rotation))
        return Mean(*(getattr(history, name) for name in Mean._fields)), history.rotation

    nothing = jnp.zeros(ENTRIES, state.offset.dtype)
    derivatives, rotation = jax.jacfwd(run_disturbed, has_aux=True)(nothing)
    return _assemble_sensitivity(rotation, derivatives)


def _assemble_sensitivity(
    rotation: Float[Array, "k 3 3"], derivatives: Mean
) -> Float[jax.Array, "k 15 6"]:
    """S of θ, v, p, b_g, b_a from the derivatives of the estimates by c, whose 6 entries are the
    last axis. `rotation` has the estimated rotations."""
    of_rotation, *others = derivatives
    # The change of R by a small turn θ in the world is [θ]× R.
    turn = jnp.einsum("kilc,kjl->kijc", of_rotation, rotation)
    theta = jnp.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
    return jnp.concatenate([theta, *others], axis=1)


# From clone step to clone step
# ------------------------------------------------------------------------------------------------

Tangents = FilterState
"""∂x/∂c for each floating-point array x of a state, with the 6 entries of c as the leading axis;
None for all other arrays (counters, decisions, memories)."""


def start_tangents(state: FilterState) -> Tangents:
    """The tangents at the start, where only the gyro's bias depends on c."""
    zeros = jax.tree.map(
        lambda leaf: jnp.zeros((ENTRIES, *leaf.shape), leaf.dtype), _select_floating(state)
    )
    return zeros._replace(gyro_bias=jnp.eye(ENTRIES, dtype=state.gyro_bias.dtype)[:, OF_BIAS])


def step_with_tangents(
    step: Callable[[FilterState, Measure], tuple[FilterState, T]],
    state: FilterState,
    tangents: Tangents,
    measure: Measure,
) -> tuple[FilterState, T, Tangents]:
    """One clone step by `step`, and the tangents after it.

    The result of `measure` is held fixed: c disturbs it as a displacement, but the network is
    called once and is not differentiated. After K steps S is that of `sensitivity` at the end of
    the run, to rounding.
    """

    def run_step(
        floating: Tangents, c: Float[Array, "6"]
    ) -> tuple[Tangents, tuple[FilterState, T]]:
        def measure_disturbed(state: FilterState, oldest: Array | int) -> tuple[Displacement, dict]:
            measured, diagnostics = measure(jax.lax.stop_gradient(state), oldest)
            in_body = measured.frame == "body"
            rotation = jax.lax.stop_gradient(state.rotation)[None] if in_body else None
            displacement = disturb(measured.displacement[None], c, rotation)[0]
            frame = differentiable_frame(measured.frame)
            disturbed = dataclasses.replace(measured, displacement=displacement, frame=frame)
            return disturbed, diagnostics

        whole = jax.tree.map(
            lambda part, leaf: leaf if part is None else part,
            floating,
            state,
            is_leaf=lambda part: part is None,
        )
        after, result = step(whole, measure_disturbed)
        return _select_floating(after), (after, result)

    every_entry = jnp.eye(ENTRIES, dtype=state.offset.dtype)
    point = _select_floating(state), jnp.zeros_like(every_entry[0])

    def push_forward(tangent: Tangents, direction: Float[Array, "6"]) -> tuple:
        _, after, result = jax.jvp(run_step, point, (tangent, direction), has_aux=True)
        return after, result

    # vmap runs over the tangents only: the step itself is computed once.
    over_tangents = jax.vmap(push_forward, out_axes=(0, None))
    after, (state, result) = over_tangents(tangents, every_entry)
    return state, result, after


def core_sensitivity(mean: Mean, tangents: Tangents) -> Float[jax.Array, "15 6"]:
    """S of θ, v, p, b_g, b_a."""
    last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1)[None], tangents.mean)
    return _assemble_sensitivity(mean.rotation[None], last)[0]


def _select_floating(state: FilterState) -> Any:
    """The state without its arrays that are not floating-point."""
    return jax.tree.map(
        lambda leaf: leaf if jnp.issubdtype(leaf.dtype, jnp.floating) else None, state
    )
