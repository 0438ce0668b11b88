"""The filter online: it takes IMU samples as they come and gives a pose after every clone interval,
or at any time.

The samples reach the filter on its own uniform clock (`resampler.Stream`). Grid sample k, at t_0 +
k·dt, drives the interval up to t_0 + (k + 1)·dt. It is known when the first stamp at or after its
own has come, so the latency is at most one sample. The pose is that of the end of its interval.
Where the IMU is faster than the filter, a low-pass adds its delay to the latency: `Tracker.delay`,
some 22 samples of the filter, 0.11 s at 200 Hz.
"""

from __future__ import annotations

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
from gnio_jax.filtering.checks import check_number, checked_noise, checked_state
from gnio_jax.filtering.consider import (
    Tangents,
    considered_covariance,
    core_sensitivity,
    start_tangents,
    step_with_tangents,
)
from gnio_jax.filtering.displacement import Displacement
from gnio_jax.filtering.gaps import Imu, bridge
from gnio_jax.filtering.history import FilterHistory, finished_history
from gnio_jax.filtering.network import Predict, network_measurement
from gnio_jax.filtering.propagation import integrate
from gnio_jax.filtering.resampler import ACCEL, GYRO, VALID, Stream, create_grid
from gnio_jax.filtering.scan import Measure, clone_step
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.start import initial_state, level_state
from gnio_jax.filtering.state import (
    BIASES,
    FilterState,
    ImuMemory,
    Mean,
    core_covariance,
    invariant_errors,
    unroll_clones,
)
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Array


class Pose(NamedTuple):
    """The estimate at one time, in the frames and units of `FilterHistory`. Host arrays."""

    time: float
    """s, on the clock of the stamps."""
    rotation: Float[np.ndarray, "3 3"]
    velocity: Float[np.ndarray, "3"]
    position: Float[np.ndarray, "3"]
    gyro_bias: Float[np.ndarray, "3"]
    accel_bias: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "15 15"]
    """Covariance of the error in θ (world frame, left), v, p, b_g, b_a, including the consider
    covariance."""
    accepted: float
    """1 if the last clone step used its measurement, 0 if not, NaN if it had none."""
    nis: float
    """rᵀ S⁻¹ r of the measurement of the last clone step; NaN if it had none."""
    healthy: bool
    """False from the first clone step on whose state is not finite, has a negative variance or a
    speed above `FilterConfig.speed_limit`. All poses from there on are invalid."""


class Estimate(NamedTuple):
    """A `Pose` on the device, without its time."""

    mean: Mean
    covariance: Float[Array, "15 15"]
    flags: Float[Array, "3"]
    """accepted, nis and healthy."""


class Core(NamedTuple):
    """The arrays on the device."""

    filter: FilterState
    """The state after the last clone step. Its clones are a ring, whose next slot to be written is
    `intervals` modulo W + 1."""
    window: Float[Array, "r 7"]
    """The last `FilterConfig.reach` grid samples before it, with holes bridged: gyro rad/s, accel
    m/s², raw, and whether the filter used the sample."""
    intervals: Int[Array, ""]
    """Number of clone steps so far."""
    tangents: Tangents | None
    """Derivatives of the filter by the errors that it does not estimate; None: there are none."""


class Tracker:
    """The filter with the network in the loop, fed sample by sample.

    - predict, config, noise: as `run_odometry` takes them.
    - state: the start, at the time of the first sample (`initial_state`, `level_state`, or the
      final state of a run). None: it is made of the first `rest_seconds`, in which the device must
      be still (`level_state`). Until then there is no pose; afterwards these samples are filtered
      too. A sample that is missing, or without any acceleration, begins the rest anew.
    - rest_seconds, std: length of that rest, s, and the standard deviations of that start.
    - hole: samples further apart than this leave the grid samples between them missing, s; None:
      1.5 dt. A slower IMU needs a larger value.
    - imu_rate: Hz, nominal, of the samples that will come; None: 1/dt. A faster IMU is band-limited
      as in `data.resample`, and poses come later by `delay`. The rate could be estimated from the
      stamps, but then there would be no pose before, and the delay would depend on jitter.
    - considered: errors that the filter does not estimate, constant since the start, whose consider
      covariance is added to that of the poses (see `consider`). None: there are none. A tracker
      takes no gyro as raw, so `raw_gyro_bias` has no effect.

    The constructor compiles everything, so that no sample waits for a compiler. Poses are new
    arrays, which later samples do not change. A tracker must not be used by several threads at
    once. Raises `ValueError` naming an argument that makes no sense.
    """

    def __init__(
        self,
        predict: Predict,
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
        check_number("rest_seconds", rest_seconds, 1.5 * config.dt, "s")
        self._config, self._std, self._considered = config, std, considered
        self._rest = round(rest_seconds / config.dt)
        self._stream = Stream(create_grid(config.dt, hole, imu_rate))
        dtype = jax.dtypes.canonicalize_dtype(np.float64) if state is None else state.offset.dtype
        self._noise = checked_noise(noise, dtype)
        start = state
        if start is None:  # The programs are compiled for the shapes of any start.
            nothing = jnp.zeros(3, dtype)
            start = initial_state(config, jnp.eye(3, dtype=dtype), nothing, nothing, std=std)
        core = self._start(start)
        self._advance, self._look_ahead = compile_programs(
            predict, core, config, self._noise, considered
        )
        if state is None:
            self._core = None

    def expect(self, imu_rate: float, hole: float | None = None) -> None:
        """Change `imu_rate` and `hole` before the first sample. Nothing is compiled again."""
        self._stream = Stream(create_grid(self._config.dt, hole, imu_rate))

    def push(self, time: Any, gyro: Any, accel: Any) -> Pose | None:
        """Take one sample: time s, gyro (3,) rad/s, accel (3,) m/s², raw, in the body frame. A
        sample with a value that is not finite is missing.

        Returns the pose of a clone step, if one was made (of the last one after a gap), else None:
        `pose()` gives the newest pose at any time. A stamp that is more than `LONGEST_TRUSTED`
        after the one before is accepted when that of the next sample agrees with it; until then its
        sample waits.

        Raises `ValueError` naming the argument, and changes nothing, if the time does not increase,
        if it increases by more than `LONGEST_GAP`, if a shape is wrong, or if a value is beyond the
        range of an IMU. It also raises `ValueError` from the hundredth grid sample on if the IMU is
        so much faster than `imu_rate` that it would alias, and for a rest without gravity, whose
        samples are left out.
        """
        self._stream.push(*_checked_sample(time, gyro, accel))
        if self._core is None:
            self._start_from_rest()
        n, made = self._config.samples_per_clone, False
        while self._core is not None and self._stream.known >= n:
            rows = self._stream.rows(n).astype(self._core.window.dtype)
            self._stream.take(n)
            self._core, estimate = self._advance(self._core, rows)
            self._ahead, made = (0, estimate, self._core.filter.imu), True
        return self._as_pose() if made else None

    def pose(self) -> Pose | None:
        """The pose after the newest grid sample; between clone steps the samples since the last
        step are integrated. None while there is no start.

        Its time is NaN before the first sample on the grid. A call costs a dispatch for each sample
        since the last call.
        """
        if self._core is None:
            return None
        done, estimate, memory = self._ahead
        known = self._stream.known
        for row in self._stream.rows(known)[done:].astype(self._core.window.dtype):
            estimate, memory = self._look_ahead(estimate, memory, row)
        self._ahead = known, estimate, memory
        return self._as_pose()

    def filter_state(self) -> FilterState | None:
        """The filter after the last clone step, as `run_odometry` would return it; None while there
        is no start."""
        if self._core is None:
            return None
        oldest = int(self._core.intervals) % self._config.clones
        return unroll_clones(_copied(self._core.filter), oldest)

    @property
    def delay(self) -> float:
        """Delay of all poses by the low-pass of a faster IMU, s; 0 without one.

        It is a latency: the times of the poses are correct.
        """
        return self._stream.grid.delay

    def _start_from_rest(self) -> None:
        """Start as soon as the next samples make a whole rest; they are filtered afterwards."""
        while self._core is None and self._stream.known >= self._rest:
            rows = self._stream.rows(self._rest)
            unusable = np.flatnonzero((rows[:, VALID] == 0) | ~rows[:, ACCEL].any(axis=1))
            if len(unusable):
                self._stream.take(int(unusable[-1]) + 1)
                continue
            try:
                state = level_state(self._config, rows[:, GYRO], rows[:, ACCEL], self._std)
            except ValueError:  # It shows no gravity, but the next samples may.
                self._stream.take(self._rest)
                raise
            self._start(state)

    def _start(self, state: FilterState) -> Core:
        """The filter begins with `state`, at the time of the next sample."""
        state = checked_state(state, self._config, self._noise)
        window = jnp.zeros((self._config.reach, 7), state.offset.dtype)
        state = invariant_errors(state, self._config)
        tangents = None if self._considered is None else start_tangents(state)
        # Copies, because the compiled step takes the memory of its argument, which no other array,
        # nor two of its fields, may share.
        core = _copied(Core(state, window, jnp.int32(0), tangents))
        flags = jnp.stack([jnp.nan, jnp.nan, state.healthy]).astype(window.dtype)
        self._core: Core | None = core
        estimate = estimated(state, flags, tangents, self._considered, self._config)
        self._ahead: tuple[int, Estimate, ImuMemory] = 0, estimate, core.filter.imu
        """Number of known samples that `pose` has integrated, and the result."""
        return core

    def _as_pose(self) -> Pose:
        """The newest estimate on the host, at the end of the interval of its last sample."""
        ahead, estimate, _ = self._ahead
        mean, covariance, numbers = jax.tree.map(np.array, estimate)
        accepted, nis, healthy = numbers.tolist()
        time = self._stream.origin + (self._stream.taken + ahead) * self._config.dt
        flags = {"accepted": accepted, "nis": nis, "healthy": healthy > 0}
        return Pose(time, *mean, covariance=covariance, **flags)


def compile_programs(
    predict: Predict,
    core: Core,
    config: FilterConfig,
    noise: NoiseModel,
    considered: ConsideredStd | None,
) -> tuple[Callable[..., tuple[Core, Estimate]], Callable[..., tuple[Estimate, ImuMemory]]]:
    """`advance` and `look_ahead`, compiled for cores like this one."""
    rows = jax.ShapeDtypeStruct((config.samples_per_clone, 7), core.window.dtype)
    fixed = {"config": config, "noise": noise}
    step = functools.partial(advance, predict=predict, considered=considered, **fixed)
    advancing = jax.jit(step, donate_argnums=0).lower(core, rows)
    ahead, row = functools.partial(look_ahead, **fixed), rows.update(shape=(7,))
    looking = jax.jit(ahead).lower(advancing.out_info[1], core.filter.imu, row)
    return advancing.compile(), looking.compile()


def advance(
    core: Core,
    rows: Float[Array, "n 7"],
    predict: Predict,
    config: FilterConfig,
    noise: NoiseModel,
    considered: ConsideredStd | None,
) -> tuple[Core, Estimate]:
    """One clone step, as `run_odometry` makes it, from the n grid samples (gyro, accel, valid) of
    its interval. The network is not called if the window is no measurement."""
    valid = rows[:, VALID] > 0
    imu, age, memory = bridge(rows[:, GYRO], rows[:, ACCEL], valid, core.filter.imu, config)
    assert imu.gap is not None
    newest = jnp.concatenate([imu.gyro, imu.accel, imu.gap.used[:, None]], axis=1)
    window = jnp.concatenate([core.window[config.samples_per_clone :], newest])
    complete = (core.intervals >= config.clones_per_window) & jnp.all(window[:, VALID] > 0)
    of_window = network_measurement(predict, config, noise)
    latest = Imu(window[:, GYRO], window[:, ACCEL], None)

    def measure(state: FilterState, oldest: Array | int) -> tuple[Displacement, dict]:
        return of_window(complete, lambda: latest, state, oldest)[0], {}

    def step(state: FilterState, measure: Measure) -> tuple[FilterState, FilterHistory]:
        slot = core.intervals % config.clones
        return advance_filter(state, imu, age, measure, slot, config, noise)

    if core.tangents is None:
        (state, history), tangents = step(core.filter, measure), None
    else:
        state, history, tangents = step_with_tangents(step, core.filter, core.tangents, measure)
    state = state._replace(imu=memory._replace(quiet=state.imu.quiet))
    flags = jnp.stack([history.accepted[0], history.nis[0], history.healthy[0]])
    estimate = estimated(state, flags, tangents, considered, config)
    return Core(state, window, core.intervals + 1, tangents), estimate


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
    estimate: Estimate,
    memory: ImuMemory,
    row: Float[Array, "7"],
    config: FilterConfig,
    noise: NoiseModel,
) -> tuple[Estimate, ImuMemory]:
    """The estimate and the memory of the IMU after one more grid sample, by integration alone.

    A consider covariance is propagated by the same transition as the filter's own.
    """
    mean, covariance, flags = estimate
    imu, _, memory = bridge(row[None, GYRO], row[None, ACCEL], row[None, VALID] > 0, memory, config)
    ahead = integrate(mean, imu, noise, config.dt)
    transition = jnp.concatenate([ahead.transition, jnp.eye(15, dtype=row.dtype)[BIASES]])
    covariance = transition @ covariance @ transition.T + ahead.noise
    mean = Mean(ahead.rotation, ahead.velocity, ahead.position, *mean[3:])
    return Estimate(mean, 0.5 * (covariance + covariance.T), flags), memory


def estimated(
    state: FilterState,
    flags: Float[Array, "3"],
    tangents: Tangents | None,
    considered: ConsideredStd | None,
    config: FilterConfig,
) -> Estimate:
    """The state's estimate; the consider covariance is added to its own."""
    covariance = core_covariance(state, config)
    if tangents is not None and considered is not None:
        sensitivity = core_sensitivity(state.mean, tangents)
        covariance = covariance + considered_covariance(sensitivity[None], considered)[0]
    return Estimate(state.mean, covariance, flags)


def _checked_sample(time: Any, gyro: Any, accel: Any) -> tuple[float, tuple[float, ...]]:
    """The time, and gyro and accel in one tuple."""
    (seconds,) = _numbers("time", time, (), "a finite number of seconds", math.inf)
    if not math.isfinite(seconds):
        raise ValueError(f"time: must be a finite number of seconds, found {time!r}")
    rate = _numbers("gyro", gyro, (3,), "three numbers", FASTEST_TURN, "rad/s")
    return seconds, rate + _numbers("accel", accel, (3,), "three numbers", STRONGEST_FORCE, "m/s²")


def _numbers(
    name: str, value: Any, shape: tuple[int, ...], wanted: str, largest: float, unit: str = ""
) -> tuple[float, ...]:
    """The numbers of an array of this shape, which must be within the range of an IMU."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape:
        raise ValueError(f"{name}: must be {wanted}, found {value!r}")
    numbers = tuple(array.reshape(-1).tolist())
    size = max((abs(each) for each in numbers if math.isfinite(each)), default=0.0)
    if size > largest:
        raise ValueError(f"{name}: no IMU measures more than {largest:g} {unit}, found {size:g}")
    return numbers


def _copied(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), tree)
