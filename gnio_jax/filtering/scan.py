"""The stochastic-cloning EKF as one scan over clone intervals: with given measurements, or with the
network in the loop."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax.filtering.gaps import Imu, bridge
from gnio_jax.filtering.measurement import (
    Correction,
    Measurement,
    Outcome,
    Rest,
    correct,
    rest,
    zero_velocity,
)
from gnio_jax.filtering.propagation import interval, move_anchor, propagate, transition
from gnio_jax.filtering.state import (
    CLONE,
    MOVE,
    FilterConfig,
    FilterState,
    Frame,
    NoiseModel,
    admit_noise,
    admit_state,
    check,
    check_finite,
    check_positive,
    core_covariance,
)
from gnio_jax.types import Array, Prediction
from gnio_jax.windows import cut_window


class FilterHistory(NamedTuple):
    """The filter after each of K clone intervals: row k is at t_0 + (k + 1)·n·dt, after its update."""

    rotation: Float[Array, "k 3 3"]
    """Body → world."""
    velocity: Float[Array, "k 3"]
    """World frame, m/s."""
    position: Float[Array, "k 3"]
    """World frame, m."""
    gyro_bias: Float[Array, "k 3"]
    """rad/s"""
    accel_bias: Float[Array, "k 3"]
    """m/s²"""
    displacement: Float[Array, "k 3"]
    """The measurement, m, in the yaw frame of the oldest clone; NaN where none."""
    measurement_std: Float[Array, "k 3"]
    """Its standard deviations after `FilterConfig.measurement_scale`, m; NaN where none."""
    innovation: Float[Array, "k 3"]
    """Measured − predicted displacement, m; NaN where no measurement."""
    covariance_diagonal: Float[Array, "k 15"]
    """Variances of θ, v, p, b_g, b_a."""
    covariance: Float[Array, "k 15 15"] | None
    """The whole core block where `FilterConfig.history` is "core", else None."""
    accepted: Float[Array, "k"]
    """1 an update was applied (also one with scaled covariance), 0 none was (gate or gimbal lock),
    NaN no measurement."""
    gate_passed: Float[Array, "k"]
    """1 the gate let the measurement through as it is, 0 it did not, between them its weight
    (`gate_softness`), NaN no measurement."""
    nis: Float[Array, "k"]
    """Normalised innovation squared, rᵀ S⁻¹ r; NaN where no measurement."""
    log_likelihood: Float[Array, "k"]
    """ln N(r; 0, S) of the innovation, r in m; NaN where no measurement. Their sum is the evidence
    for the noise model."""
    at_rest: Float[Array, "k"]
    """1 the velocity was measured as zero (`zero_velocity_std`), else 0, also where the gate
    refused that."""
    rest_nis: Float[Array, "k"]
    """Normalised innovation squared of the velocity at rest; NaN where the IMU was not quiet."""
    imu_gap: Float[Array, "k"]
    """Age of the oldest held IMU sample of the interval, s; 0 where none was missing. Above
    `bridge_seconds` the filter coasted."""
    healthy: Float[Array, "k"]
    """0 from the first row on where the state is not finite, a variance is negative or the speed
    above `FilterConfig.speed_limit`: bad input that could not be seen before, and all after it is
    void. The final state remembers it, and a later run from that begins with 0."""
    diagnostics: dict[str, Array]
    """The network's diagnostics stacked over K, NaN where it had no window; empty without a
    network."""


def run_filter(
    state: FilterState,
    gyro: Any,
    accel: Any,
    displacement: Any,
    covariance: Any,
    config: FilterConfig,
    noise: NoiseModel,
    imu_valid: Any = None,
) -> tuple[FilterState, FilterHistory]:
    """Filter K clone intervals of IMU samples with given displacement measurements.

    gyro rad/s and accel m/s² (K·n, 3), raw, in the body frame: the filter's biases are subtracted
    inside; displacement (K, 3), m, row k from clone k−W to clone k in the yaw frame of clone k−W,
    by another attitude than the filter's; covariance (K, 3, 3), m², before `measurement_scale`. A
    row with a NaN, or before there are W + 1 clones, is no measurement. imu_valid (K·n,) says which
    IMU samples are there; the others, and with it those that are not finite, are bridged (see
    `gaps`). Returns the final state, from which a later call goes on (clone numbers k then count
    on, too), and the history. Works under `jax.jit`, `jax.vmap` and `jax.grad`. Raises `ValueError`
    naming an argument of wrong shape or precision, with values that are not finite, or a covariance
    that is not positive definite; of values that only exist inside `jit`, `FilterHistory.healthy`
    tells.
    """
    state, gyro, accel, valid, noise = _admit(state, gyro, accel, imu_valid, config, noise)
    intervals = gyro.shape[0] // config.samples_per_clone
    displacement = check("displacement", displacement, (intervals, 3), config).astype(gyro.dtype)
    covariance = check("covariance", covariance, (intervals, 3, 3), config).astype(gyro.dtype)
    check_positive("covariance", covariance)
    return _run_filter(state, gyro, accel, valid, displacement, covariance, config, noise)


@functools.partial(jax.jit, static_argnames="config")
def _run_filter(state, gyro, accel, valid, displacement, covariance, config, noise):
    measurements = jax.vmap(functools.partial(_measurement, config=config))(
        displacement, covariance
    )
    return _scan(
        lambda k, _state, _oldest, _imu, given: (given, {}),
        state,
        gyro,
        accel,
        valid,
        config,
        noise,
        measurements,
        "given",
    )


def run_odometry(
    predict: Callable[[Any], Prediction],
    state: FilterState,
    gyro: Any,
    accel: Any,
    config: FilterConfig,
    noise: NoiseModel,
    imu_valid: Any = None,
) -> tuple[FilterState, FilterHistory]:
    """Filter K clone intervals with the network in the loop (paper fig. 2): its windows are cut
    with the filter's own state.

    predict maps windows (1, N, 6) float32, N = n·W, channels [accel m/s², gyro rad/s], to a
    `Prediction` with the same leading axis. A window spans the samples between its two clones i and
    j; the filter's present biases are subtracted and the samples rotated by R_γ(R_i)ᵀ R_j, R_j
    being the present estimate of clone i advanced by integrating gyro − b_g (paper eq. 1), unless
    `FilterConfig.window_rotation` says otherwise. Its displacement is told in the filter's own yaw
    frame, and taken so (`update.displacement_residual`), but with "tlio". The measurement's
    covariance is diag(exp 2u), u raised to `log_std_min`. The network is not called in the first W
    intervals, which have no window, and a window in which the filter coasted through a gap is no
    measurement. gyro, accel and imu_valid as in `run_filter`. Jit it from outside; differentiable
    in whatever `predict` closes over, too. Raises `ValueError` as `run_filter` does, or for a
    `predict` that returns something else.
    """
    state, gyro, accel, valid, noise = _admit(state, gyro, accel, imu_valid, config, noise)
    dtype, expected = gyro.dtype, expect(predict, config)

    def infer(k: Array, state: FilterState, oldest: Array, imu: Imu) -> Prediction:
        start = (k - config.clones_per_window + 1) * config.samples_per_clone - config.cut.lead
        gyro, accel = (
            jax.lax.dynamic_slice_in_dim(signal, start, config.reach)
            for signal in (imu.gyro, imu.accel)
        )
        prediction = infer_window(predict, state, state.clone_rotation[oldest], gyro, accel, config)
        if imu.gap is not None:
            whole = jnp.all(jax.lax.dynamic_slice_in_dim(imu.gap.used, start, config.reach) > 0)
            prediction = prediction._replace(
                displacement=jnp.where(whole, prediction.displacement, jnp.nan)
            )
        return prediction

    def nothing(k: Array, state: FilterState, oldest: Array, imu: Imu) -> Prediction:
        return no_prediction(expected)

    def measure(
        k: Array, state: FilterState, oldest: Array, imu: Imu, _given: None
    ) -> tuple[Measurement, dict]:
        # k is the scan's own counter, the same for every sequence of a batch, so that this stays a
        # branch under vmap.
        prediction = jax.lax.cond(
            k >= config.clones_per_window, infer, nothing, k, state, oldest, imu
        )
        return measured(prediction, config, dtype), prediction.diagnostics

    return _scan(measure, state, gyro, accel, valid, config, noise, None, config.displacement_frame)


def expect(predict: Callable[[Any], Prediction], config: FilterConfig) -> Prediction:
    """Shapes of what `predict` returns for one window; `ValueError` if that is not what the filter
    needs."""
    expected = jax.eval_shape(predict, jax.ShapeDtypeStruct((1, config.window, 6), jnp.float32))
    if not isinstance(expected, Prediction):
        raise ValueError(
            f"predict: must return a gnio_jax.types.Prediction, found {type(expected).__name__}"
        )
    for name, value in [("displacement", expected.displacement), ("log_std", expected.log_std)]:
        if value.shape != (1, 3):
            raise ValueError(f"predict: {name} must be (1, 3) for one window, found {value.shape}")
    for name, value in expected.diagnostics.items():
        if value.shape[:1] != (1,):
            raise ValueError(
                f"predict: diagnostics['{name}'] must have a leading axis of one window, found {value.shape}"
            )
    return expected


def infer_window(
    predict: Callable[[Any], Prediction],
    state: FilterState,
    rotation: Float[Array, "3 3"],
    gyro: Float[Array, "r 3"],
    accel: Float[Array, "r 3"],
    config: FilterConfig,
) -> Prediction:
    """What the network says of one window, of which the last `config.reach` raw samples up to its
    newer clone are given and the attitude of its older clone; the leading axis of one is gone."""
    gyro, accel = gyro[: config.window], accel[: config.window]
    imu = cut_window(
        rotation, gyro, accel, state.gyro_bias, state.accel_bias, config.cut, config.dt
    )
    return jax.tree.map(lambda leaf: _floating(leaf[0]), predict(imu[None].astype(jnp.float32)))


def no_prediction(expected: Prediction) -> Prediction:
    """NaN in the shapes of one window's prediction."""
    return jax.tree.map(
        lambda leaf: jnp.full(leaf.shape[1:], jnp.nan, _floating(leaf).dtype), expected
    )


def measured(prediction: Prediction, config: FilterConfig, dtype: Any) -> Measurement:
    """The measurement that the filter makes of a prediction."""
    log_std = jnp.maximum(prediction.log_std.astype(dtype), config.log_std_min)
    return _measurement(
        prediction.displacement.astype(dtype), jnp.diag(jnp.exp(2 * log_std)), config
    )


class Row(NamedTuple):
    """What one step adds to the history."""

    state: tuple[Array, ...]
    """Rotation, velocity, position, gyro bias, accel bias."""
    covariance: Array
    """Of θ, v, p, b_g, b_a, or its diagonal."""
    measurement: Measurement
    outcome: Outcome
    rest: Rest
    diagnostics: dict[str, Array]


def clone_step(
    state: FilterState,
    imu: Imu,
    measure: Callable[[FilterState, Array | int], tuple[Measurement, dict]],
    slot: Array | int,
    config: FilterConfig,
    noise: NoiseModel,
    frame: Frame,
) -> tuple[FilterState, Row]:
    """One clone interval: propagate, clone into `slot` of the ring, measure, update.

    `measure` is given the state and the oldest slot; its displacement is told in `frame`.
    """
    state, row, _ = traced_step(state, imu, measure, slot, config, noise, frame)
    return state, row


class Trace(NamedTuple):
    """What happened to the error in one clone interval, as smoothing needs it."""

    transition: Float[Array, "9 15"]
    """See `propagation.transition`."""
    corrections: tuple[Correction, ...]
    """The updates in the order in which they were made."""


def traced_step(
    state: FilterState,
    imu: Imu,
    measure: Callable[[FilterState, Array | int], tuple[Measurement, dict]],
    slot: Array | int,
    config: FilterConfig,
    noise: NoiseModel,
    frame: Frame,
) -> tuple[FilterState, Row, Trace]:
    """`clone_step` and its trace."""
    # A ring of clones: the newest takes the place of the one that has served as oldest, and the
    # next slot is the oldest now.
    newest, oldest = slot, (slot + 1) % (config.clones_per_window + 1)
    state = move_anchor(state, newest == 0)
    motion = interval(state, imu, noise, config.dt)
    turned = transition(state, motion, newest == 0)
    state = propagate(state, motion, newest == 0, newest)
    measurement, diagnostics = measure(state, oldest)
    state, outcome, *corrections = correct(state, measurement, newest, oldest, config, frame)
    resting = Rest(jnp.bool_(False), jnp.zeros_like(outcome.nis), jnp.bool_(False))
    if config.zero_velocity_std > 0:
        state, quiet = rest(state, imu, config)
        state, resting, correction = zero_velocity(state, quiet, outcome.tried, newest, config)
        corrections.append(correction)
    kept = core_covariance(state.core_covariance)
    mean = (state.rotation, state.velocity, state.position, state.gyro_bias, state.accel_bias)
    kept = kept if config.history == "core" else jnp.diagonal(kept)
    row = Row(mean, kept, measurement, outcome, resting, diagnostics)
    return state, row, Trace(turned, tuple(corrections))


def _scan(
    measure: Callable,
    state: FilterState,
    gyro: Array,
    accel: Array,
    valid: Array | None,
    config: FilterConfig,
    noise: NoiseModel,
    measurements: Any,
    frame: Frame,
) -> tuple[FilterState, FilterHistory]:
    n, clones = config.samples_per_clone, config.clones_per_window + 1
    intervals = gyro.shape[0] // n
    stream, age, memory = bridge(gyro, accel, valid, state.imu, config)

    def step(state: FilterState, inputs: tuple) -> tuple[FilterState, Row]:
        k, imu, given = inputs
        now = lambda state, oldest: measure(k, state, oldest, stream, given)  # noqa: E731
        return clone_step(state, imu, now, k % clones, config, noise, frame)

    by_interval = jax.tree.map(lambda x: x.reshape(intervals, n, *x.shape[1:]), stream)
    state, rows = checkpointed_scan(
        step, state, (jnp.arange(intervals), by_interval, measurements), config.checkpoint_every
    )
    seen = history(rows, age.reshape(intervals, n).max(1), state.healthy, config)
    state = state._replace(imu=memory._replace(quiet=state.imu.quiet), healthy=seen.healthy[-1] > 0)
    return settled(state, intervals % clones), seen


def checkpointed_scan(step: Callable, carry: Any, inputs: Any, every: int) -> tuple[Any, Any]:
    """`lax.scan` whose backward pass keeps the carry of every `every`-th step only, and computes
    the steps between them again."""
    length = jax.tree.leaves(inputs)[0].shape[0]
    if every == 0 or every >= length:
        return jax.lax.scan(step, carry, inputs)
    blocks = length // every
    whole = jax.tree.map(lambda x: x[: blocks * every].reshape(blocks, every, *x.shape[1:]), inputs)
    carry, out = jax.lax.scan(
        jax.checkpoint(lambda carry, block: jax.lax.scan(step, carry, block), prevent_cse=False),
        carry,
        whole,
    )
    out = jax.tree.map(lambda x: x.reshape(blocks * every, *x.shape[2:]), out)
    if length % every:
        carry, rest = jax.lax.scan(step, carry, jax.tree.map(lambda x: x[blocks * every :], inputs))
        out = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), out, rest)
    return carry, out


def history(
    rows: Row, imu_gap: Float[Array, "k"], healthy: Bool[Array, ""], config: FilterConfig
) -> FilterHistory:
    """The history of the rows stacked over K steps from a state that was `healthy` or not."""
    outcome, kept = rows.outcome, rows.covariance

    def where_present(value: Array) -> Array:
        present = outcome.present.reshape(-1, *[1] * (value.ndim - 1))
        return jnp.where(present, value, jnp.nan).astype(kept.dtype)

    # S is the identity where there is no measurement, so that the logarithm has a derivative there.
    log_likelihood = -0.5 * (outcome.nis + 3 * math.log(2 * math.pi)) - jnp.log(outcome.volume)
    std = jnp.sqrt(jnp.diagonal(rows.measurement.covariance, axis1=1, axis2=2))
    diagonal = jnp.diagonal(kept, axis1=1, axis2=2) if config.history == "core" else kept
    finite = [
        jnp.all(jnp.isfinite(part.reshape(len(part), -1)), axis=1) for part in (*rows.state, kept)
    ]
    plausible = jnp.sum(rows.state[1] ** 2, axis=1) <= config.speed_limit**2
    sound = jnp.all(jnp.stack(finite), axis=0) & jnp.all(diagonal >= 0, axis=1) & plausible
    healthy = healthy & (jax.lax.cummin(sound.astype(jnp.int32)) > 0)
    return FilterHistory(
        *rows.state,
        displacement=where_present(rows.measurement.displacement),
        measurement_std=where_present(std),
        innovation=where_present(outcome.innovation),
        covariance_diagonal=diagonal,
        covariance=kept if config.history == "core" else None,
        accepted=where_present(outcome.accepted),
        gate_passed=where_present(outcome.gate_passed),
        nis=where_present(outcome.nis),
        log_likelihood=where_present(log_likelihood),
        at_rest=rows.rest.accepted.astype(kept.dtype),
        rest_nis=jnp.where(rows.rest.quiet, rows.rest.nis, jnp.nan).astype(kept.dtype),
        imu_gap=imu_gap.astype(kept.dtype),
        healthy=healthy.astype(kept.dtype),
        diagnostics=rows.diagnostics,
    )


def _measurement(
    displacement: Float[Array, "3"], covariance: Float[Array, "3 3"], config: FilterConfig
) -> Measurement:
    """Scale; keep NaN out of the arithmetic, or its derivatives would be NaN too."""
    present = jnp.all(jnp.isfinite(displacement)) & jnp.all(jnp.isfinite(covariance))
    scaled = jnp.where(
        present, config.measurement_scale * covariance, jnp.eye(3, dtype=covariance.dtype)
    )
    return Measurement(
        displacement=jnp.where(present, displacement, 0.0), covariance=scaled, present=present
    )


def settled(state: FilterState, newer: int) -> FilterState:
    """The state between runs: all clones at the present anchor, which the first `newer` of the ring
    have already, and the oldest first."""
    clones, dtype = state.clone_offset.shape[0], state.move.dtype
    older = (np.arange(clones) >= (newer or clones)).astype(dtype)[:, None]
    # o ← o − s for those, in the mean and in the covariance
    loss = np.kron(older, np.concatenate([np.zeros((3, 3)), np.eye(3)])).astype(dtype)
    across = loss @ state.cross_covariance[MOVE]
    among = (
        state.clone_covariance
        - across
        - across.T
        + loss @ state.core_covariance[MOVE, MOVE] @ loss.T
    )
    first, blocks = state.first, CLONE * newer
    if first is not None:
        first = first._replace(
            clone_offset=jnp.roll(first.clone_offset - older * first.move[None], -newer, 0)
        )
    return state._replace(
        clone_rotation=jnp.roll(state.clone_rotation, -newer, 0),
        clone_offset=jnp.roll(state.clone_offset - older * state.move[None], -newer, 0),
        cross_covariance=jnp.roll(
            state.cross_covariance - state.core_covariance[:, MOVE] @ loss.T, -blocks, 1
        ),
        clone_covariance=jnp.roll(among, (-blocks, -blocks), (0, 1)),
        first=first,
    )


def _floating(value: Any) -> Any:
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.float32)


def _admit(
    state: FilterState,
    gyro: Any,
    accel: Any,
    imu_valid: Any,
    config: FilterConfig,
    noise: NoiseModel,
) -> tuple[FilterState, Array, Array, Array | None, NoiseModel]:
    """Check what both doors take, and bring it to the state's precision."""
    state = admit_state(state, config)
    samples = jnp.shape(gyro)[0] if jnp.ndim(gyro) else 0
    if samples < config.samples_per_clone or samples % config.samples_per_clone:
        raise ValueError(
            f"gyro: the samples must be a multiple of samples_per_clone = {config.samples_per_clone}, found {samples}"
        )
    gyro, accel = (
        check(name, value, (samples, 3), config)
        for name, value in [("gyro", gyro), ("accel", accel)]
    )
    if imu_valid is not None:
        imu_valid = jnp.asarray(imu_valid)
        if imu_valid.shape != (samples,) or imu_valid.dtype != jnp.bool_:
            raise ValueError(
                f"imu_valid: must be {samples} booleans, found {imu_valid.dtype} of shape {imu_valid.shape}"
            )
    else:
        check_finite("gyro", gyro, "name the missing samples with imu_valid to have them bridged")
        check_finite("accel", accel, "name the missing samples with imu_valid to have them bridged")
    return (
        state,
        gyro.astype(state.offset.dtype),
        accel.astype(state.offset.dtype),
        imu_valid,
        admit_noise(noise, state.offset.dtype),
    )
