"""The filter online: IMU samples as they come, a pose after every clone interval, or at any time.

A stream has a present, so `Tracker` is an object that changes. It holds the samples that are not
yet used (`resampler.Stream`), and on the device the filter with the last window of samples
(`Core`). The samples reach the filter on its own uniform clock, and every n of them make the clone
step that `run_odometry` makes, in one compiled program.

Grid sample k, at t_0 + k·dt, drives the interval up to t_0 + (k + 1)·dt. It is known when the first
stamp at or after its own has come, so the latency is at most one sample; the pose is that of the
end of its interval. Where the IMU is faster than the filter, the low-pass adds its delay to the
latency: `Tracker.delay`, some 22 samples of the filter, 0.11 s at 200 Hz.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gnio_jax.config import ConsideredStd, InitialStd, NoiseModel
from gnio_jax.config.schema import TLIO_STD
from gnio_jax.filtering.checks import checked_noise, checked_state
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.consider import (
    Tangents,
    check_considered,
    considered_covariance,
    core_sensitivity,
    start_tangents,
    step_with_tangents,
)
from gnio_jax.filtering.displacement import Displacement
from gnio_jax.filtering.gaps import Imu, bridge
from gnio_jax.filtering.history import FilterHistory, finished_history
from gnio_jax.filtering.network import (
    Predict,
    no_prediction,
    predict_window,
    predicted_displacement,
    prediction_shapes,
)
from gnio_jax.filtering.propagation import integrate
from gnio_jax.filtering.resampler import ACCEL, GYRO, VALID, Stream, create_grid, is_finite_number
from gnio_jax.filtering.scan import Measure, clone_step
from gnio_jax.filtering.start import initial_state, rest_state
from gnio_jax.filtering.state import (
    BIASES,
    FilterState,
    ImuMemory,
    Mean,
    core_covariance,
    unroll_clones,
)
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Array, Prediction


class Pose(NamedTuple):
    """The estimate at one time. Host arrays."""

    time: float
    """s, on the clock of the stamps."""
    rotation: Float[np.ndarray, "3 3"]
    """Body → world."""
    velocity: Float[np.ndarray, "3"]
    """World frame, m/s."""
    position: Float[np.ndarray, "3"]
    """World frame, m."""
    gyro_bias: Float[np.ndarray, "3"]
    """rad/s"""
    accel_bias: Float[np.ndarray, "3"]
    """m/s²"""
    covariance: Float[np.ndarray, "15 15"]
    """Of the error in θ (world frame, left), v, p, b_g, b_a, considered errors included."""
    accepted: float
    """Of the last clone step: 1 its measurement was used, 0 it was not, NaN there was none."""
    nis: float
    """Of the last clone step: rᵀ S⁻¹ r of its measurement; NaN where there was none."""
    healthy: bool
    """False once a clone step left a state that is not finite, a negative variance or a speed above
    `FilterConfig.speed_limit`: all since is void."""


PoseVector = Float[Array, "l"]
"""A `Pose` without its time, so that one transfer from the device is enough: rotation, velocity,
position, biases, covariance, and the flags accepted, nis and healthy."""
_SIZES = (9, 3, 3, 3, 3, 225, 3)
_SPLITS = np.cumsum(_SIZES)[:-1]


class Core(NamedTuple):
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


class Tracker:
    """The filter with the network in the loop, fed sample by sample.

    - predict, config, noise: as `run_odometry` takes them.
    - state: the start, at the time of the first sample (`initial_state`, `level_state`, or what a
      run left). None: it is made of the first `rest_seconds`, in which the device must lie still
      (`rest_state`); until then there is no pose, and then these samples are filtered, too. A
      sample that is missing, or without any acceleration, begins the rest anew.
    - rest_seconds, std: length of that rest, s, and the standard deviations of that start.
    - hole: samples further apart than this leave the grid samples between them missing, s; None:
      1.5 dt. A slower IMU needs more.
    - imu_rate: Hz, nominal, of the samples that will come; None: 1/dt. A faster IMU is band-limited
      as `data.resample` does it, and poses come later by `delay`. The stamps could tell the rate,
      but no pose could be given before, and jitter would decide on the delay.
    - considered: errors that the covariances of the poses count in and the filter does not estimate
      (see `considered`); constant since the start. None: there are none.

    Everything is compiled here, so that no sample waits for a compiler. Poses are new arrays, which
    later samples do not touch. Not for several threads at once. Raises `ValueError` naming an
    argument that makes no sense.
    """

    def __init__(
        self,
        predict: Callable[[Any], Prediction],
        config: FilterConfig,
        noise: NoiseModel,
        state: FilterState | None = None,
        *,
        rest_seconds: float = 1.0,
        std: InitialStd = TLIO_STD,
        hole: float | None = None,
        imu_rate: float | None = None,
        considered: ConsideredStd | None = None,
    ):
        if not (is_finite_number(rest_seconds) and round(rest_seconds / config.dt) >= 2):
            raise ValueError(
                f"rest_seconds: must be a time of at least two samples of {config.dt:g} s, "
                f"found {rest_seconds!r}"
            )
        if considered is not None:
            check_considered(considered)
        self._config, self._std, self._considered = config, std, considered
        self._rest = round(rest_seconds / config.dt)
        self._stream = Stream(create_grid(config.dt, hole, imu_rate))
        dtype = jax.dtypes.canonicalize_dtype(np.float64) if state is None else state.offset.dtype
        self._noise = checked_noise(noise, dtype)
        start = state
        if start is None:  # Any start will do to compile for.
            nothing = jnp.zeros(3, dtype)
            start = initial_state(config, jnp.eye(3, dtype=dtype), nothing, nothing, std=std)
        core = self._start(start)
        self._programs = compile_programs(predict, core, config, self._noise, considered)
        if state is None:
            self._core = None

    def push(self, time: Any, gyro: Any, accel: Any) -> Pose | None:
        """Take one sample: time s, gyro (3,) rad/s, accel (3,) m/s², raw, in the body frame; a
        value that is not finite: missing.

        Returns the pose of a clone step, if one was made (of the last, after a gap), else None:
        then `pose()` has the newest. A stamp that is more than `LONGEST_TRUSTED` after the one
        before is believed once that of the next sample agrees with it; until then its sample waits.

        Raises `ValueError` naming the argument if the time does not increase, or by more than
        `LONGEST_GAP`, or a shape is wrong, or a value is beyond what an IMU measures; then nothing
        has changed. So does an IMU that is so much faster than `imu_rate` that it would alias;
        every hundred grid samples that is looked at. So does a rest without gravity, whose samples
        are left out.
        """
        sample = _three_numbers("gyro", gyro, FASTEST_TURN, "rad/s")
        sample += _three_numbers("accel", accel, STRONGEST_FORCE, "m/s²")
        self._stream.push(_finite_seconds(time), sample)
        if self._core is None:
            self._start_from_rest()
        n, vector = self._config.samples_per_clone, None
        while self._core is not None and self._stream.known >= n:
            rows = self._stream.rows(n).astype(self._core.window.dtype)
            self._stream.take(n)
            self._core, vector = self._programs.advance(self._core, rows)
        if vector is None:
            return None
        self._vector, self._ahead = vector, None
        return self._as_pose(vector, 0)

    def pose(self) -> Pose | None:
        """The pose after the newest grid sample; between clone steps by integrating the samples
        since. None while there is no start.

        Its time is NaN before the first sample on the grid. Costs a dispatch for each sample
        since it was last asked.
        """
        if self._core is None:
            return None
        done, vector, memory = self._ahead or (0, self._vector, self._core.filter.imu)
        known = self._stream.known
        for row in self._stream.rows(known)[done:].astype(self._core.window.dtype):
            vector, memory = self._programs.look_ahead(vector, memory, row)
        self._ahead = known, vector, memory
        return self._as_pose(vector, known)

    def filter_state(self) -> FilterState | None:
        """The filter after the last clone step, as `run_odometry` would return it; None while there
        is no start."""
        if self._core is None:
            return None
        oldest = int(self._core.intervals) % self._config.clones
        return unroll_clones(_copied(self._core.filter), oldest)

    @property
    def delay(self) -> float:
        """By how much the low-pass of a faster IMU delays all poses, s; 0 without one.

        It is latency: the times of the poses are right.
        """
        return self._stream.grid.delay

    def _start_from_rest(self) -> None:
        """Start, once the next samples are a whole rest; they stay to be filtered."""
        while self._core is None and self._stream.known >= self._rest:
            rows = self._stream.rows(self._rest)
            unusable = np.flatnonzero((rows[:, VALID] == 0) | ~rows[:, ACCEL].any(axis=1))
            if len(unusable):
                self._stream.take(int(unusable[-1]) + 1)
                continue
            try:
                state = rest_state(self._config, rows[:, GYRO], rows[:, ACCEL], self._std)
            except ValueError:  # It shows no gravity: the next samples may.
                self._stream.take(self._rest)
                raise
            self._start(state)

    def _start(self, state: FilterState) -> Core:
        """The filter begins with `state`, at the time of the next sample."""
        state = checked_state(state, self._config, self._noise)
        window = jnp.zeros((self._config.reach, 7), state.offset.dtype)
        tangents = None if self._considered is None else start_tangents(state)
        # Copies: the compiled step takes the memory of its argument, which may not be shared, not
        # even between two of its fields.
        core = _copied(Core(state, window, jnp.int32(0), tangents))
        flags = jnp.stack([jnp.nan, jnp.nan, state.healthy])
        covariance = core_covariance(state.core_covariance)
        self._core: Core | None = core
        self._vector = _pose_vector(state.mean, covariance, flags, tangents, self._considered)
        self._ahead: tuple[int, PoseVector, ImuMemory] | None = None
        """How many known samples `pose` has integrated, its vector and IMU memory after them."""
        return core

    def _as_pose(self, vector: PoseVector, ahead: int) -> Pose:
        """On the host, at the end of the interval of the last sample taken, or of one `ahead`."""
        rotation, velocity, position, gyro_bias, accel_bias, covariance, flags = np.split(
            np.array(vector), _SPLITS
        )
        accepted, nis, healthy = flags.tolist()
        samples = self._stream.taken + ahead
        return Pose(
            time=self._stream.origin + samples * self._config.dt,
            rotation=rotation.reshape(3, 3),
            velocity=velocity,
            position=position,
            gyro_bias=gyro_bias,
            accel_bias=accel_bias,
            covariance=covariance.reshape(15, 15),
            accepted=accepted,
            nis=nis,
            healthy=healthy > 0,
        )


class Programs(NamedTuple):
    """The compiled programs of a tracker."""

    advance: Callable[[Core, np.ndarray], tuple[Core, jax.Array]]
    look_ahead: Callable[[PoseVector, ImuMemory, np.ndarray], tuple[jax.Array, ImuMemory]]


def compile_programs(
    predict: Predict,
    core: Core,
    config: FilterConfig,
    noise: NoiseModel,
    considered: ConsideredStd | None,
) -> Programs:
    """Compile `advance` and `look_ahead` for cores like this one."""
    config = dataclasses.replace(config, history="core")
    of_type = functools.partial(jax.ShapeDtypeStruct, dtype=core.window.dtype)
    step = functools.partial(
        advance, predict=predict, config=config, noise=noise, considered=considered
    )
    ahead = functools.partial(look_ahead, config=config, noise=noise)
    rows, row, vector = (config.samples_per_clone, 7), (7,), (sum(_SIZES),)
    return Programs(
        jax.jit(step, donate_argnums=0).lower(core, of_type(rows)).compile(),
        jax.jit(ahead).lower(of_type(vector), core.filter.imu, of_type(row)).compile(),
    )


def advance(
    core: Core,
    rows: Float[Array, "n 7"],
    predict: Predict,
    config: FilterConfig,
    noise: NoiseModel,
    considered: ConsideredStd | None,
) -> tuple[Core, PoseVector]:
    """One clone step, as `run_odometry` makes it, from the n grid samples (gyro, accel, valid) of
    its interval; and its pose.

    `config.history` must be "core". Where the window is no measurement the network is not called.
    """
    valid = rows[:, VALID] > 0
    imu, age, memory = bridge(rows[:, GYRO], rows[:, ACCEL], valid, core.filter.imu, config)
    assert imu.gap is not None
    latest = jnp.concatenate([imu.gyro, imu.accel, imu.gap.used[:, None]], axis=1)
    window = jnp.concatenate([core.window[config.samples_per_clone :], latest])
    complete = (core.intervals >= config.clones_per_window) & jnp.all(window[:, VALID] > 0)
    shapes = prediction_shapes(predict, config)

    def infer(state: FilterState, oldest: Array) -> Prediction:
        return predict_window(predict, state, oldest, window[:, GYRO], window[:, ACCEL], config)

    def measure(state: FilterState, oldest: Array | int) -> tuple[Displacement, dict]:
        prediction = jax.lax.cond(
            complete, infer, lambda *_: no_prediction(shapes), state, jnp.asarray(oldest)
        )
        return predicted_displacement(prediction, config, noise, rows.dtype), {}

    def step(state: FilterState, measure: Measure) -> tuple[FilterState, FilterHistory]:
        slot = core.intervals % config.clones
        return advance_filter(state, imu, age, measure, slot, config, noise)

    if core.tangents is None:
        (state, history), tangents = step(core.filter, measure), None
    else:
        state, history, tangents = step_with_tangents(step, core.filter, core.tangents, measure)
    state = state._replace(imu=memory._replace(quiet=state.imu.quiet))
    mean = Mean(*(getattr(history, name)[0] for name in Mean._fields))
    flags = jnp.stack([history.accepted[0], history.nis[0], history.healthy[0]])
    assert history.covariance is not None
    vector = _pose_vector(mean, history.covariance[0], flags, tangents, considered)
    return Core(state, window, core.intervals + 1, tangents), vector


def advance_filter(
    state: FilterState,
    imu: Imu,
    age: Float[Array, "n"],
    measure: Measure,
    slot: Array,
    config: FilterConfig,
    noise: NoiseModel,
) -> tuple[FilterState, FilterHistory]:
    """One clone step, and a history of one row. `age` of each held sample, s: see `gaps.bridge`."""
    state, record, _ = clone_step(state, imu, slot, measure, config, noise)
    records = jax.tree.map(lambda leaf: leaf[None], record)
    history = finished_history(records, jnp.max(age)[None], state.healthy, config)
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
    rotation, velocity, position, *biases, covariance, flags = jnp.split(pose, _SPLITS)
    start = Mean(rotation.reshape(3, 3), velocity, position, *biases)
    imu, _, memory = bridge(row[None, GYRO], row[None, ACCEL], row[None, VALID] > 0, memory, config)
    ahead = integrate(start, imu, noise, config.dt)
    transition = jnp.concatenate([ahead.transition, jnp.eye(15, dtype=pose.dtype)[BIASES]])
    covariance = transition @ covariance.reshape(15, 15) @ transition.T + ahead.noise
    mean = Mean(ahead.rotation, ahead.velocity, ahead.position, *biases)
    return _pose_vector(mean, 0.5 * (covariance + covariance.T), flags), memory


def _pose_vector(
    mean: Mean,
    covariance: Float[Array, "15 15"],
    flags: Float[Array, "3"],
    tangents: Tangents | None = None,
    considered: ConsideredStd | None = None,
) -> PoseVector:
    """With the errors that are considered added to the covariance."""
    if tangents is not None and considered is not None:
        sensitivity = core_sensitivity(mean, tangents)
        covariance = covariance + considered_covariance(sensitivity[None], considered)[0]
    parts = (*mean, covariance, flags)
    return jnp.concatenate([jnp.ravel(part).astype(covariance.dtype) for part in parts])


def _finite_seconds(time: Any) -> float:
    try:
        seconds = float(time)
    except (TypeError, ValueError):
        seconds = math.nan
    if not math.isfinite(seconds):
        raise ValueError(f"time: must be a finite number of seconds, found {time!r}")
    return seconds


def _three_numbers(name: str, value: Any, largest: float, unit: str) -> tuple[float, ...]:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: must be three numbers, found {value!r}") from None
    if array.shape != (3,):
        raise ValueError(f"{name}: must be three numbers, found shape {array.shape}")
    numbers = tuple(array.tolist())
    if any(largest < abs(number) < math.inf for number in numbers):
        problem = f"no IMU measures more than {largest:g} {unit}"
        raise ValueError(f"{name}: {problem}, found {max(map(abs, numbers)):g}")
    return numbers


def _copied(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), tree)
