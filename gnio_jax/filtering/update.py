"""The update of the EKF, the same for every measurement (paper §III-G).

A measurement of m = 1 to 3 numbers is linearised at the present estimate to

    r = H δ + w,   w ~ N(0, R),

where r is the residual (measured − predicted) and δ the error of the state. H depends on few parts
of the error (`PARTS`), so H P needs few rows of P. With S = H P Hᵀ + R = L Lᵀ and Y = L⁻¹ H P the
gain is Yᵀ L⁻¹, the correction of the error is Yᵀ L⁻¹ r, and P ← P − Yᵀ Y is symmetric to the last
bit.

A turn of the world changes the additive error δx of a velocity or a position by e_z × x, which
depends on the estimate x. An update moves x, and the next displacement would take the difference
for a measurement of the yaw. So P is that of the errors ξ, which do not depend on it (see `state`),
H is taken over ξ (`with_turns`), and the mean moves on the group (`retract`). This is the
right-invariant EKF on SE_2(3) (Barrau and Bonnabel 2017); `FilterConfig.error` switches it off.
docs/filter.md has the derivation.

A measurement is an object with a `name` and a method

    update(state, step) -> (state, Outcome, Correction),

which linearises it (`linearise`) and applies it (`measure`); see `Displacement`, `ZeroVelocity`
and docs/measurements.md.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, Protocol, get_args, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.config import NoiseModel
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import (
    ACCEL_BIAS,
    ANCHOR,
    CLONE,
    CLONE_OFFSET,
    CLONE_THETA,
    CORRELATED,
    GYRO_BIAS,
    MOVE,
    OF_DISPLACEMENT,
    OF_LEVER,
    OF_MOUNTING,
    OFFSET,
    THETA,
    VELOCITY,
    FilterState,
    Shift,
    additive_core,
    with_position,
    yaw_lever,
)
from gnio_jax.geometry import contract_left, contract_right, matmul
from gnio_jax.types import Array

PARTS = (
    *("rotation", "velocity", "position", "gyro_bias", "accel_bias"),
    *("correlated", "mounting", "lever", "oldest_rotation", "since_oldest"),
)
"""The parts of the error on which a measurement may depend, each with 3 entries. Parts of the
present state are the rotation δθ (rad, world frame, R ← exp(δθ) R), velocity, position, both
biases, and in units of their standard deviations the temporally correlated errors of the
displacements, of a car's mounting and of its lever, where the filter has them. The others are the
rotation of the oldest clone, and the position since that clone, p_j − p_i."""


class Linearised(NamedTuple):
    """r = H δ + w."""

    residual: Float[Array, "m"]
    """r, measured − predicted. A NaN here or in R means that there is no measurement."""
    jacobian: dict[str, Float[Array, "m 3"]]
    """The blocks of H that are not zero, by the names of `PARTS`."""
    covariance: Float[Array, "m m"]
    """R."""


class Outcome(NamedTuple):
    """The outcome of a measurement."""

    present: Bool[Array, ""]
    """Whether there was a measurement. Without one all following fields are zero or False, except
    √det S, which is 1."""
    tested: Bool[Array, ""]
    """Whether a χ² test was applied."""
    residual: Float[Array, "m"]
    """r."""
    nis: Float[Array, ""]
    """Normalised innovation squared, rᵀ S⁻¹ r, with the covariance R of the measurement before any
    enlargement."""
    volume: Float[Array, ""]
    """√det S, with the same R."""
    weight: Float[Array, ""]
    """1 if the test passed, 0 if it failed, between 0 and 1 for a gate with a slope."""
    accepted: Bool[Array, ""]
    """Whether it was applied, with R or with an enlarged covariance."""


class Innovation(NamedTuple):
    """The innovation of a measurement, before it is decided whether it is used."""

    whitened: Float[Array, "m"]
    """L⁻¹ r"""
    covariance: Float[Array, "m m"]
    """S"""
    core: Float[Array, "m n"]
    """Rows of H P for the error of the core."""
    clones: Float[Array, "m c"]
    """Rows of H P for the errors of the clones."""
    jacobian: dict[str, Float[Array, "m 3"]]
    """The blocks of H over the errors ξ."""


class Correction(NamedTuple):
    """The change of the error e by an update: e ← e − Yᵀ L⁻¹ r, where L⁻¹ r = L⁻¹ (H e + w). All
    entries are zero if no update was made. The smoother runs backwards over it."""

    residual: Float[Array, "m"]
    """L⁻¹ r."""
    core: Float[Array, "m n"]
    """Rows of Y for the error of the core."""
    clones: Float[Array, "m c"]
    """Rows of Y for the errors of the clones."""
    jacobian: dict[str, Float[Array, "m 3"]]
    """The blocks of L⁻¹ H."""


MeasuredFrame = Literal["carrier", "world"]
"""Whether a measured quantity turns with the carrier, as a displacement or a speed in the body
does, or is fixed to the world, as a position on a map."""


class Step(NamedTuple):
    """The clone interval at whose end a measurement is taken."""

    imu: Imu
    """The samples of the interval."""
    newest: Array | int
    """Slot of the newest clone in the ring."""
    oldest: Array | int
    """Slot of the oldest clone."""
    config: FilterConfig
    noise: NoiseModel
    before: Mapping[str, Outcome] = MappingProxyType({})
    """Outcomes, by name, of the measurements that this interval has already taken; the first is
    that of the displacement."""
    diagnostics: Mapping[str, Array] = MappingProxyType({})
    """The network's diagnostics by their names; NaN where it was not called."""


@runtime_checkable
class Measurement(Protocol):
    """A measurement that is taken at the end of every clone interval: a tree of arrays, e.g. a
    NamedTuple, with this name and method."""

    @property
    def name(self) -> str:
        """The key of its outcomes in `FilterHistory.outcomes`. In a NamedTuple it is an attribute
        of the class, `name = "height"`."""
        ...

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]: ...


def linearise(state: FilterState, residual: Any, covariance: Any, **jacobian: Any) -> Linearised:
    """A measurement with the residual r (m,) and the covariance R (m, m), in the state's precision.

    `jacobian` has the blocks (m, 3) of H, the derivative of the predicted value, by the names of
    `PARTS`; blocks that are left out are zero. Raises `ValueError` for another name or shape.
    """
    if unknown := set(jacobian) - set(PARTS):
        raise ValueError(f"linearise: {min(unknown)}: is none of {', '.join(PARTS)}")
    dtype = state.offset.dtype
    linear = Linearised(
        jnp.asarray(residual, dtype),
        {name: jnp.asarray(block, dtype) for name, block in jacobian.items()},
        jnp.asarray(covariance, dtype),
    )
    if linear.residual.ndim != 1:
        problem = f"the shape must be (m,), found {linear.residual.shape}"
        remedy = "a measurement with rows is one of the `measurements` of a run"
        raise ValueError(f"linearise: residual: {problem}; {remedy}")
    rows = len(linear.residual)
    shapes = {"covariance": (rows, rows), **dict.fromkeys(linear.jacobian, (rows, 3))}
    for name, value in {"covariance": linear.covariance, **linear.jacobian}.items():
        if value.shape != shapes[name]:
            problem = f"the shape must be {shapes[name]}, found {value.shape}"
            raise ValueError(f"linearise: {name}: {problem}")
    return linear


def measurable_errors(
    names: Iterable[str],
    core: Float[Array, "n k"],
    clones: Float[Array, "c k"],
    oldest: Array | int,
) -> Float[Array, "_ k"]:
    """The named `PARTS`, one below the other, of k errors of core and clones.

    p = a + o. p_j − p_i is o + s − o_i if the oldest clone refers to the anchor before, else
    o − o_i.
    """
    of_oldest = jax.lax.dynamic_slice_in_dim(clones, CLONE * oldest, CLONE)
    parts = {
        "rotation": lambda: core[THETA],
        "velocity": lambda: core[VELOCITY],
        "position": lambda: core[OFFSET] + core[ANCHOR],
        "gyro_bias": lambda: core[GYRO_BIAS],
        "accel_bias": lambda: core[ACCEL_BIAS],
        "correlated": lambda: core[CORRELATED][OF_DISPLACEMENT],
        "mounting": lambda: core[CORRELATED][OF_MOUNTING],
        "lever": lambda: core[CORRELATED][OF_LEVER],
        "oldest_rotation": lambda: of_oldest[CLONE_THETA],
        "since_oldest": lambda: (
            core[OFFSET] + anchors_apart(oldest, core.dtype) * core[MOVE] - of_oldest[CLONE_OFFSET]
        ),
    }
    return jnp.concatenate([parts[name]() for name in names])


def anchors_apart(oldest: Array | int, dtype: np.dtype) -> Float[Array, ""]:
    """Number of moves of the anchor between the oldest clone and the core: 0 once in a round of the
    ring, else 1."""
    return jnp.where(jnp.asarray(oldest) == 0, 0.0, 1.0).astype(dtype)


def since_oldest(state: FilterState, oldest: Array | int) -> Float[Array, "3"]:
    """Position since the oldest clone, p_j − p_i, in the world frame, m."""
    present = state.offset + anchors_apart(oldest, state.move.dtype) * state.move
    return present - state.clone_offset[oldest]


def measure(
    state: FilterState,
    linear: Linearised,
    step: Step,
    threshold: Array | float = math.inf,
    frame: MeasuredFrame = "carrier",
) -> tuple[FilterState, Outcome, Correction]:
    """One EKF update.

    Args:
        state: The state at the end of the interval.
        linear: Residual, blocks of the Jacobian, and covariance. A residual or covariance with a
            NaN means that there is no measurement, and so does a measurement from the oldest clone
            before there are W + 1 of them.
        step: The clone interval.
        threshold: Largest rᵀ S⁻¹ r of a measurement that is used, e.g. a quantile of χ² with m
            degrees of freedom. In the world S has the arc of an uncertain yaw (`with_arc`).
        frame: The frame to which the measured quantity is fixed, "carrier" or "world". A position
            in the world that is measured with "carrier" would show a yaw that nobody measured.

    Returns:
        The updated state, the outcome, and the correction. If S is not positive definite, the state
        becomes NaN, which `FilterHistory.healthy` reports.

    Raises:
        ValueError: `frame` is another word.
    """
    if frame not in get_args(MeasuredFrame):
        names = " or ".join(map(repr, get_args(MeasuredFrame)))
        raise ValueError(f"measure: frame must be {names}, found {frame!r}")
    outcome, innovation = project(state, linear, step)
    if frame == "world" and step.config.invariant:
        outcome = with_arc(outcome, innovation, state)
    tested = outcome.present & jnp.isfinite(threshold)
    accepted = outcome.present & ~(outcome.nis > threshold)
    weight = accepted.astype(outcome.nis.dtype)
    outcome = outcome._replace(tested=tested, weight=weight, accepted=accepted)
    return correct(state, outcome, innovation, step, linear if frame == "world" else None)


def project(state: FilterState, linear: Linearised, step: Step) -> tuple[Outcome, Innovation]:
    """The outcome of a measurement that is accepted if it exists, and its innovation. If there is
    none, r is zero and S the identity, so that no NaN enters the arithmetic or the derivatives."""
    present = jnp.isfinite(linear.residual).all() & jnp.isfinite(linear.covariance).all()
    by_part = dict(linear.jacobian)
    if {"oldest_rotation", "since_oldest"} & by_part.keys():
        present = present & (state.step >= step.config.clones)
    if step.config.invariant:
        by_part = with_turns(by_part, state, step.oldest)
    jacobian = jnp.concatenate(list(by_part.values()), axis=1)
    touched = functools.partial(measurable_errors, by_part, oldest=step.oldest)
    core = matmul(jacobian, touched(state.core_covariance, state.cross_covariance.T))
    clones = matmul(jacobian, touched(state.cross_covariance, state.clone_covariance))
    spread = matmul(jacobian, touched(core.T, clones.T)) + linear.covariance
    spread = jnp.where(present, spread, jnp.eye(len(spread), dtype=spread.dtype))
    residual = jnp.where(present, linear.residual, 0.0)
    (whitened,), volume = whiten(spread, (residual[:, None],))
    weight = present.astype(volume.dtype)
    outcome = Outcome(present, present, residual, jnp.sum(whitened**2), volume, weight, present)
    return outcome, Innovation(whitened[:, 0], spread, core, clones, by_part)


def correction_by(innovation: Innovation, accepted: Bool[Array, ""]) -> Correction:
    """The correction by an innovation, zero if it is not accepted.

    The rows are masked before they are whitened. Otherwise XLA would repeat the choice for each
    entry of the covariance: a sixth of the time of a filter with two measurements.
    """
    whitened, spread, core, clones, by_part = innovation
    rows = (core, clones, jnp.concatenate(list(by_part.values()), axis=1))
    masked = tuple(jnp.where(accepted, part, 0.0) for part in rows)
    # Without a root of S the rows of a refused measurement would be no zeros.
    spread = jnp.where(accepted, spread, jnp.eye(len(spread), dtype=spread.dtype))
    (core, clones, jacobian), _ = whiten(spread, masked)
    blocks = jnp.split(jacobian, len(by_part), axis=1)
    by_part = dict(zip(by_part, blocks, strict=True))
    return Correction(jnp.where(accepted, whitened, 0.0), core, clones, by_part)


def with_arc(outcome: Outcome, innovation: Innovation, state: FilterState) -> Outcome:
    """The outcome of a measurement in the world, S with the second order of an uncertain yaw in
    velocity and position (`state.arc_covariance`), which the reported covariance has too.

    Otherwise a correct fix would be refused where it lies on the arc, beside its tangent, and so
    would all later ones. With a = √¾ J σ² l, S becomes S + a aᵀ.
    """
    with_yaw = additive_core(state, with_position(state.core_covariance[:, THETA.stop - 1, None]))
    arc = jnp.zeros_like(innovation.whitened)
    for part, entries in (("velocity", VELOCITY), ("position", OFFSET)):
        if part in innovation.jacobian:
            lever = math.sqrt(0.75) * yaw_lever(with_yaw[entries, 0])
            arc += matmul(innovation.jacobian[part], lever[:, None])[:, 0]
    (arc,), _ = whiten(innovation.covariance, (arc[:, None],))
    growth = 1 + jnp.sum(arc**2)  # of det S
    explained = jnp.sum(arc[:, 0] * innovation.whitened) ** 2 / growth
    volume = jnp.where(outcome.present, outcome.volume * jnp.sqrt(growth), outcome.volume)
    return outcome._replace(nis=outcome.nis - explained, volume=volume)


def with_turns(
    jacobian: dict[str, Float[Array, "m 3"]], state: FilterState, oldest: Array | int
) -> dict[str, Float[Array, "m 3"]]:
    """The blocks of H over the errors ξ, from those over the errors δx = ξ − hat(x − c) θ."""
    shifts = [("since_oldest", "oldest_rotation", -state.clone_shift[oldest])]
    if state.shift is not None:
        velocity, position = state.shift
        shifts += [("velocity", "rotation", velocity), ("position", "rotation", position)]
        shifts += [("since_oldest", "rotation", position)]
    blocks = dict(jacobian)
    for part, rotation, shift in shifts:
        if part in jacobian:
            of_turn = matmul(jacobian[part], geometry.hat(shift))
            blocks[rotation] = blocks.get(rotation, 0.0) - of_turn
    return blocks


def correct(
    state: FilterState,
    outcome: Outcome,
    innovation: Innovation,
    step: Step,
    in_world: Linearised | None = None,
) -> tuple[FilterState, Outcome, Correction]:
    """Mean and covariance after an update, and its correction, which is zero if the measurement was
    not accepted.

    A measurement of a quantity that is fixed to the world is given as `in_world`. Its Jacobian over
    the errors ξ depends on the estimate, so the update is made again with the Jacobian at the
    estimate that the first one reached, as in an iterated EKF (Bell and Cathey 1993). Mean,
    covariance and smoother then have one gain.
    """
    correction = correction_by(innovation, outcome.accepted)
    moved = moved_mean(state, correction, step)
    if in_world is not None and step.config.invariant:
        linear = linearised_again(in_world, state, moved, correction, step)
        _, innovation = project(moved, linear, step)
        correction = correction_by(innovation, outcome.accepted)
        moved = moved_mean(state, correction, step)
    cross = matmul(correction.core.T, correction.clones)
    reduced = moved._replace(
        core_covariance=downdate(state.core_covariance, correction.core),
        cross_covariance=state.cross_covariance - cross,
        clone_covariance=downdate(state.clone_covariance, correction.clones),
    )
    return reduced, outcome, correction


def linearised_again(
    linear: Linearised, state: FilterState, moved: FilterState, correction: Correction, step: Step
) -> Linearised:
    """A measurement at the estimate x_1 = `moved`, to which `correction` has moved `state`: its
    residual is r(x_1) + H(x_1) e, with the error e of that correction.

    With r(x_1) = r − J Δx for the moved velocity and positions this is r + J (δx − Δx), where
    δx = ξ − hat(x_1 − c) θ. The difference is of second order.
    """
    moves = {
        "velocity": moved.velocity - state.velocity,
        "position": moved.position - state.position,
        "since_oldest": since_oldest(moved, step.oldest) - since_oldest(state, step.oldest),
    }
    blocks = {part: block for part, block in linear.jacobian.items() if part in moves}
    core, clones = (error[:, None] for error in error_of(correction))
    residual = linear.residual
    for part, block in with_turns(blocks, moved, step.oldest).items():
        error = measurable_errors([part], core, clones, step.oldest)
        residual = residual + matmul(block, error)[:, 0]
    for part, block in blocks.items():
        residual = residual - matmul(block, moves[part][:, None])[:, 0]
    return linear._replace(residual=residual)


def error_of(correction: Correction) -> tuple[Float[Array, "n"], Float[Array, "c"]]:
    """The error e of core and clones by which a correction moves the mean."""
    # A reduction is used on purpose: its result is kept, but a sum that is written out would be
    # computed again for every entry that the correction of the mean reads.
    core, clones = (
        jnp.sum(correction.residual[:, None] * rows, axis=0)
        for rows in (correction.core, correction.clones)
    )
    return core, clones


def moved_mean(state: FilterState, correction: Correction, step: Step) -> FilterState:
    """The state with the mean after a correction."""
    core, clones = error_of(correction)
    return retract(state, core, clones.reshape(-1, CLONE), step)


def retract(
    state: FilterState, core: Float[Array, "n"], clones: Float[Array, "c 6"], step: Step
) -> FilterState:
    """Move the mean by an error. The newest clone has the core's pose.

    R ← exp(θ) R, and all other parts are added. In the invariant form v and all positions x move
    rigidly with the θ and ξ of the same pose, x − c ← exp(θ) (x − c) + J_l(θ) ξ.
    """
    before = (jnp.arange(len(clones)) > step.newest).astype(core.dtype)[:, None]
    anchor_step = core[ANCHOR][None] - before * core[MOVE][None]
    # One row for the position of every clone, then for the core's velocity and its position.
    thetas = jnp.concatenate([clones[:, CLONE_THETA], *2 * [core[THETA][None]]])
    core_steps = jnp.stack([core[VELOCITY], core[ANCHOR] + core[OFFSET]])
    steps = jnp.concatenate([clones[:, CLONE_OFFSET] + anchor_step, core_steps])
    turns, translations = jax.vmap(geometry.exp_rigid)(thetas, steps)
    # A reduction, so that the next measurement does not compute the clones of this one again.
    turned = jax.vmap(contract_left)
    clone_shift, shift = state.clone_shift, state.shift
    if step.config.invariant:
        core_shifts = jnp.zeros_like(core_steps) if shift is None else jnp.stack(shift)
        shifts = jnp.concatenate([clone_shift, core_shifts])
        new_shifts = turned(turns, shifts[:, :, None])[:, :, 0] + translations
        steps = new_shifts - shifts
        clone_shift, shift = new_shifts[:-2], Shift(new_shifts[-2], new_shifts[-1])
    return state._replace(
        rotation=matmul(turns[-1], state.rotation),
        velocity=state.velocity + steps[-2],
        offset=state.offset + steps[-1] - core[ANCHOR],
        gyro_bias=state.gyro_bias + core[GYRO_BIAS],
        accel_bias=state.accel_bias + core[ACCEL_BIAS],
        anchor=state.anchor + core[ANCHOR],
        move=state.move + core[MOVE],
        correlated=state.correlated + core[CORRELATED],
        clone_rotation=turned(turns[:-2], state.clone_rotation),
        clone_offset=state.clone_offset + steps[:-2] - anchor_step,
        clone_shift=clone_shift,
        shift=shift,
    )


# Small matrices
# ------------------------------------------------------------------------------------------------


@jax.custom_jvp
def whiten(
    s: Float[Array, "m m"], rows: tuple[Float[Array, "m _"], ...]
) -> tuple[tuple[Float[Array, "m _"], ...], Float[Array, ""]]:
    """L⁻¹ of each of the rows, for a symmetric S = L Lᵀ, and √det S; NaN where S is not positive
    definite.

    It is written out number by number: a call to LAPACK costs more than the whole update, and
    eliminating S row by row makes a clone step some percent slower.
    """
    root: list[list[Array]] = []  # the lower triangle of L, row by row
    for i in range(len(s)):
        row: list[Array] = []
        for j, above in enumerate(root):
            row.append((s[i, j] - _dot(row, above)) / above[j])
        root.append([*row, jnp.sqrt(s[i, i] - _dot(row, row))])

    def solve(part: Array) -> Array:
        solved: list[Array] = []
        for i, row in enumerate(root):
            solved.append((part[i] - _dot(row[:-1], solved)) / row[-1])
        return jnp.stack(solved)

    volume = math.prod((row[-1] for row in root[1:]), start=root[0][-1])
    return tuple(solve(part) for part in rows), volume


def _dot(row: list[Array], column: list[Array]) -> Array | float:
    return sum((x * y for x, y in zip(row, column, strict=False)), start=0.0)


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
    """The signs are applied to the rows, because otherwise the backward pass would negate the whole
    matrix. There are two products, because the transpose of one product and its mirror image would
    add a matrix to its own transpose."""
    (covariance, rows), (d_covariance, d_rows) = primals, tangents
    change = (-d_rows).T @ rows + (-rows).T @ d_rows
    return downdate(covariance, rows), d_covariance + change
