"""The stochastic-cloning EKF as one scan over clone intervals: with given measurements, or with the
network in the loop."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gnio_jax.config import NoiseModel
from gnio_jax.filtering.checkpointing import truncated_scan
from gnio_jax.filtering.clones import unroll_clones
from gnio_jax.filtering.config import FilterConfig, YawFrame
from gnio_jax.filtering.displacement import Measurement, scaled_measurement
from gnio_jax.filtering.gaps import Imu, bridge
from gnio_jax.filtering.history import FilterHistory, StepRecord, stacked_history
from gnio_jax.filtering.inputs import (
    Signals,
    checked_displacements,
    checked_inputs,
    checked_measurements,
)
from gnio_jax.filtering.network import (
    Predict,
    no_prediction,
    predict_window,
    predicted_measurement,
    prediction_shapes,
)
from gnio_jax.filtering.state import FilterState
from gnio_jax.filtering.step import clone_step
from gnio_jax.types import Array, Prediction


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
    state, signals, noise = checked_inputs(state, gyro, accel, imu_valid, config, noise)
    displacement, covariance = checked_measurements(displacement, covariance, signals, config)
    return _run_filter(state, signals, displacement, covariance, config, noise, "given")


def repeat_odometry(
    state: FilterState,
    gyro: Any,
    accel: Any,
    displacement: Any,
    std: Any,
    config: FilterConfig,
    noise: NoiseModel,
    imu_valid: Any = None,
    frame: YawFrame | None = None,
) -> tuple[FilterState, FilterHistory]:
    """Filter a run of `run_odometry` again, with the displacements that the network said then.

    displacement (K, 3) and std (K, 3), m, are `displacement` and `measurement_std` of that run's
    history, told in the filter's own yaw frame; std is the network's own, before any scaling: that
    run had `measurement_scale` 1 and no `std_factor`. With another noise or start this is the run
    that would have been, but for the small changes of the windows that another attitude or bias
    would have made. Differentiable without a network, so that calibration is cheap. With the frame
    "given" it is a run of `run_filter` that is repeated. All else as in `run_filter`.
    """
    state, signals, noise = checked_inputs(state, gyro, accel, imu_valid, config, noise)
    displacement, std = checked_displacements(displacement, std, signals, config)
    covariance = jax.vmap(jnp.diag)(std**2)
    frame = frame or config.displacement_frame
    return _run_filter(state, signals, displacement, covariance, config, noise, frame)


@functools.partial(jax.jit, static_argnames=("config", "frame"))
def _run_filter(
    state: FilterState,
    signals: Signals,
    displacement: Array,
    covariance: Array,
    config: FilterConfig,
    noise: NoiseModel,
    frame: YawFrame,
) -> tuple[FilterState, FilterHistory]:
    scale = functools.partial(scaled_measurement, noise=noise)
    measurements = jax.vmap(scale)(displacement, covariance)

    def measure(step: _Step, state: FilterState, oldest: Array) -> tuple[Measurement, dict]:
        return step.measurement, {}

    return _scan(measure, state, signals, measurements, config, noise, frame)


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

    predict maps windows (1, C + N, 6) float32, N = n·W, channels [accel m/s², gyro rad/s], to a
    `Prediction` with the same leading axis. A window spans the samples between its two clones i and
    j, and before them come the C samples of its context (`FilterConfig.context_samples`). The
    filter's present biases are subtracted and the samples rotated by R_γ(R_i)ᵀ R_j, R_j being the
    present estimate of clone i advanced by integrating gyro − b_g (paper eq. 1; backwards through
    the context), unless `FilterConfig.window_rotation` says otherwise. Its displacement is told in
    the filter's own yaw frame, and taken so (`displacement.displacement_residual`), but with
    "tlio". The measurement's covariance is diag(exp 2u), u raised to `log_std_min`. The network is
    not called in the first `FilterConfig.first_measured` intervals, which have no whole window, and
    a window in which the filter coasted through a gap is no measurement. gyro, accel and imu_valid
    as in `run_filter`. Jit it from outside; differentiable in whatever `predict` closes over, too.
    Raises `ValueError` as `run_filter` does, or for a `predict` that returns something else.
    """
    state, signals, noise = checked_inputs(state, gyro, accel, imu_valid, config, noise)
    shapes = prediction_shapes(predict, config)
    infer = functools.partial(_infer, predict=predict, config=config)

    def nothing(step: _Step, state: FilterState, oldest: Array) -> Prediction:
        return no_prediction(shapes)

    def measure(step: _Step, state: FilterState, oldest: Array) -> tuple[Measurement, dict]:
        # The number is the scan's own counter, the same for every sequence of a batch, so that this
        # stays a branch under vmap.
        has_window = step.number >= config.first_measured
        prediction = jax.lax.cond(has_window, infer, nothing, step, state, oldest)
        measurement = predicted_measurement(prediction, config, noise, signals.gyro.dtype)
        return measurement, prediction.diagnostics

    return _scan(measure, state, signals, None, config, noise, config.displacement_frame)


class _Step(NamedTuple):
    """What a measurement may be made of at one step of the scan."""

    number: Array
    """Of the clone interval, from 0."""
    stream: Imu
    """The samples of all intervals."""
    measurement: Any
    """The given `Measurement`; None with a network."""


def _infer(
    step: _Step, state: FilterState, oldest: Array, predict: Predict, config: FilterConfig
) -> Prediction:
    """The network's prediction; its displacement is NaN where the filter coasted in the window."""
    intervals = step.number - config.clones_per_window + 1
    first = intervals * config.samples_per_clone - config.context_samples - config.cut.lead
    gyro, accel = (
        jax.lax.dynamic_slice_in_dim(signal, first, config.reach)
        for signal in (step.stream.gyro, step.stream.accel)
    )
    rotation = state.clone_rotation[oldest]
    prediction = predict_window(predict, state, rotation, gyro, accel, config)
    gap = step.stream.gap
    if gap is None:
        return prediction
    whole = jnp.all(jax.lax.dynamic_slice_in_dim(gap.used, first, config.reach) > 0)
    return prediction._replace(displacement=jnp.where(whole, prediction.displacement, jnp.nan))


def _scan(
    measure: Callable[[_Step, FilterState, Array], tuple[Measurement, dict]],
    state: FilterState,
    signals: Signals,
    measurements: Measurement | None,
    config: FilterConfig,
    noise: NoiseModel,
    frame: YawFrame,
) -> tuple[FilterState, FilterHistory]:
    """Bridge the stream's holes, make a clone step of every interval, collect the history."""
    stream, age, memory = bridge(*signals, state.imu, config)
    numbers, by_interval = interval_inputs(stream, config)

    def step(state: FilterState, inputs: tuple) -> tuple[FilterState, StepRecord]:
        number, imu, measurement = inputs
        of_step = functools.partial(measure, _Step(number, stream, measurement))
        return clone_step(state, imu, of_step, number % config.clones, config, noise, frame)

    inputs = numbers, by_interval, measurements
    bounds = config.checkpoint_every, config.truncate_every
    state, records = truncated_scan(step, state, inputs, *bounds)
    oldest_held = age.reshape(numbers.shape[0], config.samples_per_clone).max(1)
    history = stacked_history(records, oldest_held, state.healthy, config)
    memory = memory._replace(quiet=state.imu.quiet)
    state = state._replace(imu=memory, healthy=history.healthy[-1] > 0)
    return unroll_clones(state, numbers.shape[0] % config.clones), history


def interval_inputs(stream: Imu, config: FilterConfig) -> tuple[Array, Imu]:
    """Numbers of the K clone intervals, and their samples (K, n, …)."""
    n = config.samples_per_clone
    intervals = stream.gyro.shape[0] // n
    by_interval = jax.tree.map(lambda x: x.reshape(intervals, n, *x.shape[1:]), stream)
    return jnp.arange(intervals), by_interval
