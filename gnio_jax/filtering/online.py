"""The tracker's pure core: its state, one clone step, and a look ahead between clone steps.

What comes out is `run_odometry`'s, to rounding: the same clone step on the same numbers.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gnio_jax.config import ConsideredStd, InitialStd, NoiseModel
from gnio_jax.config.schema import TLIO_STD
from gnio_jax.filtering.clock import Clock
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.considered import considered_covariance
from gnio_jax.filtering.displacement import Measurement
from gnio_jax.filtering.gaps import Imu, bridge
from gnio_jax.filtering.history import FilterHistory, stacked_history
from gnio_jax.filtering.inputs import state_shapes
from gnio_jax.filtering.intake import Design, Intake
from gnio_jax.filtering.network import (
    Predict,
    no_prediction,
    predict_window,
    predicted_measurement,
    prediction_shapes,
)
from gnio_jax.filtering.pose import (
    POSE_LENGTH,
    PoseVector,
    history_vector,
    moved_vector,
    pose_parts,
    widened_vector,
)
from gnio_jax.filtering.propagation import integrate_interval
from gnio_jax.filtering.start import initial_state
from gnio_jax.filtering.state import FilterState, ImuMemory
from gnio_jax.filtering.step import Measure, clone_step
from gnio_jax.filtering.tangents import (
    Tangents,
    core_sensitivity,
    start_tangents,
    step_with_tangents,
)
from gnio_jax.types import Array, Prediction

GYRO, ACCEL, VALID = slice(0, 3), slice(3, 6), 6
"""Columns of grid samples."""
GRID_COLUMNS = 7


class TrackerCore(NamedTuple):
    """What lives on the device."""

    filter: FilterState
    """After the last clone step; its clones are a ring, the next of which to be written is
    `intervals` mod W + 1."""
    window: Float[Array, "r 7"]
    """The last `FilterConfig.reach` grid samples before it, holes bridged: gyro rad/s, accel m/s²,
    raw, and whether the filter used the sample."""
    intervals: Int[Array, ""]
    """Clone steps so far."""
    tangents: Tangents | None
    """Derivatives of the filter by the errors that are considered; None where there are none."""


class TrackerState(NamedTuple):
    """All that a tracker knows beside what it was made of."""

    core: TrackerCore | None
    """None while the first samples at rest are collected."""
    latest: Float[np.ndarray, "l"] | None
    """The last clone step's (at first the start's) `Pose` without its time, in one vector."""
    pending: Float[np.ndarray, "m 7"]
    """Grid samples since: gyro, accel, and 1 or, for a missing one, 0."""
    clock: Clock | None
    """None before the first sample on the grid."""
    intake: Intake | None
    """None before the first sample."""


class TrackerSettings(NamedTuple):
    """What a tracker is made of, beside the network."""

    config: FilterConfig
    noise: NoiseModel
    design: Design
    """Of the low-pass."""
    dtype: np.dtype
    rest: int = 0
    """Samples at rest that make the start; 0: the start was given."""
    std: InitialStd = TLIO_STD
    """Of a start from rest."""
    considered: ConsideredStd | None = None
    """Of errors that the poses' covariance counts in, and the filter does not estimate."""


class Programs(NamedTuple):
    """The two compiled programs of a tracker."""

    advance: Callable[[TrackerCore, np.ndarray], tuple[TrackerCore, jax.Array]]
    look_ahead: Callable[[Any, Any, np.ndarray], tuple[jax.Array, ImuMemory]]


def start_core(state: FilterState, settings: TrackerSettings) -> TrackerCore:
    """Before the first clone step."""
    window = jnp.zeros((settings.config.reach, GRID_COLUMNS), state.offset.dtype)
    tangents = None if settings.considered is None else start_tangents(state)
    return TrackerCore(state, window, jnp.int32(0), tangents)


def core_shapes(settings: TrackerSettings) -> TrackerCore:
    """Shapes and types of the core."""
    state = state_shapes(settings.config, settings.noise, settings.dtype)
    return jax.eval_shape(functools.partial(start_core, settings=settings), state)


def compile_programs(predict: Predict, settings: TrackerSettings) -> Programs:
    """Compile both, so that no sample waits for a compiler."""
    config, noise, considered = settings.config, settings.noise, settings.considered
    shapes = core_shapes(settings)
    of_type = functools.partial(jax.ShapeDtypeStruct, dtype=settings.dtype)
    rows, row = of_type((config.samples_per_clone, GRID_COLUMNS)), of_type((GRID_COLUMNS,))
    whole = dataclasses.replace(config, history="core")
    step = functools.partial(
        advance, predict=predict, config=whole, noise=noise, considered=considered
    )
    ahead = functools.partial(look_ahead, config=config, noise=noise)
    return Programs(
        jax.jit(step, donate_argnums=0).lower(shapes, rows).compile(),
        jax.jit(ahead).lower(of_type((POSE_LENGTH,)), shapes.filter.imu, row).compile(),
    )


def advance(
    core: TrackerCore,
    rows: Float[Array, "n 7"],
    predict: Predict,
    config: FilterConfig,
    noise: NoiseModel,
    considered: ConsideredStd | None,
) -> tuple[TrackerCore, PoseVector]:
    """One clone step, as `run_odometry` makes it, from the n grid samples (gyro, accel, valid) of
    its interval; and its pose.

    `config.history` must be "core". Where the window is no measurement the network is not called.
    With errors that are `considered` the core carries the tangents along, and the pose's covariance
    has them.
    """
    valid = rows[:, VALID] > 0
    stream, age, memory = bridge(rows[:, GYRO], rows[:, ACCEL], valid, core.filter.imu, config)
    assert stream.gap is not None
    latest = jnp.concatenate([stream.gyro, stream.accel, stream.gap.used[:, None]], axis=1)
    window = jnp.concatenate([core.window[config.samples_per_clone :], latest])
    complete = (core.intervals >= config.clones_per_window) & jnp.all(window[:, VALID] > 0)

    def infer(state: FilterState, oldest: Array) -> Prediction:
        rotation, gyro, accel = state.clone_rotation[oldest], window[:, GYRO], window[:, ACCEL]
        prediction = predict_window(predict, state, rotation, gyro, accel, config)
        return prediction._replace(diagnostics={})

    def nothing(state: FilterState, oldest: Array) -> Prediction:
        return no_prediction(prediction_shapes(predict, config))._replace(diagnostics={})

    def measure(state: FilterState, oldest: Array | int) -> tuple[Measurement, dict]:
        prediction = jax.lax.cond(complete, infer, nothing, state, jnp.asarray(oldest))
        return predicted_measurement(prediction, config, noise, rows.dtype), {}

    slot = core.intervals % config.clones

    def step(state: FilterState, measure: Measure) -> tuple[FilterState, FilterHistory]:
        return advance_filter(state, stream, age, measure, slot, config, noise)

    state, pose, tangents = _step_and_pose(step, core, measure, considered)
    memory = memory._replace(quiet=state.imu.quiet)
    state = state._replace(imu=memory)
    return TrackerCore(state, window, core.intervals + 1, tangents), pose


def _step_and_pose(
    step: Callable[[FilterState, Measure], tuple[FilterState, FilterHistory]],
    core: TrackerCore,
    measure: Measure,
    considered: ConsideredStd | None,
) -> tuple[FilterState, PoseVector, Tangents | None]:
    """What a clone step makes of the filter, its pose, and the tangents where there are some."""
    if considered is None or core.tangents is None:
        state, history = step(core.filter, measure)
        return state, history_vector(history), None
    state, history, tangents = step_with_tangents(step, core.filter, core.tangents, measure)
    pose = with_considered(history_vector(history), state, tangents, considered)
    return state, pose, tangents


def with_considered(
    pose: PoseVector, state: FilterState, tangents: Tangents, considered: ConsideredStd
) -> PoseVector:
    """The pose of `state`, with the errors that are considered in its covariance."""
    found = core_sensitivity(state.mean, tangents)
    return widened_vector(pose, considered_covariance(found[None], considered)[0])


def advance_filter(
    state: FilterState,
    stream: Imu,
    age: Float[Array, "n"],
    measure: Measure,
    slot: Array,
    config: FilterConfig,
    noise: NoiseModel,
) -> tuple[FilterState, FilterHistory]:
    """One clone step, and a history of one row. `age` of each held sample, s: see `gaps.bridge`."""
    frame = config.displacement_frame
    state, record = clone_step(state, stream, measure, slot, config, noise, frame)
    records = jax.tree.map(lambda leaf: leaf[None], record)
    history = stacked_history(records, jnp.max(age)[None], state.healthy, config)
    return state._replace(healthy=history.healthy[-1] > 0), history


def look_ahead(
    pose: PoseVector,
    memory: ImuMemory,
    row: Float[Array, "7"],
    config: FilterConfig,
    noise: NoiseModel,
) -> tuple[PoseVector, ImuMemory]:
    """The pose and the memory of the IMU after one more grid sample, by integration alone.

    Its covariance is P + S C Sᵀ where errors are considered: both parts take the same transition.
    """
    parts = pose_parts(pose)
    start = (
        parts[name] for name in ("rotation", "velocity", "position", "gyro_bias", "accel_bias")
    )
    state = initial_state(config, *start)
    row = row[None]
    stream, _, memory = bridge(row[:, GYRO], row[:, ACCEL], row[:, VALID] > 0, memory, config)
    motion = integrate_interval(state, stream, noise, config.dt)
    covariance = motion.transition @ parts["covariance"] @ motion.transition.T + motion.noise
    symmetric = 0.5 * (covariance + covariance.T)
    position = parts["position"] + motion.offset
    return moved_vector(pose, motion.rotation, motion.velocity, position, symmetric), memory
