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

from gnio_jax import numerics
from gnio_jax.filtering.checks import (
    check_filter,
    check_number,
    checked_state,
    converted_filter,
)
from gnio_jax.filtering.consider import (
    Tangents,
    considered_covariance,
    core_sensitivity,
    start_tangents,
    step_with_tangents,
    with_considered,
)
from gnio_jax.filtering.corrected_stream import CorrectedStream, SampleCorrector
from gnio_jax.filtering.displacement import Displacement
from gnio_jax.filtering.filter import Filter
from gnio_jax.filtering.gaps import Imu, bridge
from gnio_jax.filtering.history import FilterHistory, describe_failure, finished_history
from gnio_jax.filtering.network import (
    Predict,
    PredictWithMemory,
    first_memory,
    has_memory,
    memory_step,
    network_measurement,
    recalled_displacement,
)
from gnio_jax.filtering.propagation import integrate
from gnio_jax.filtering.resampler import ACCEL, GYRO, VALID, Grid, Stream, create_grid
from gnio_jax.filtering.scan import Measure, clone_step
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.start import NoGravity, initial_state, level_state
from gnio_jax.filtering.state import (
    BIASES,
    FilterState,
    ImuMemory,
    Mean,
    core_covariance,
    invariant_errors,
    unroll_clones,
)
from gnio_jax.filtering.zero_velocity import is_quiet, unbiased_output
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Array, Memory


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
    failure: str = ""
    """What made the first pose that is not healthy impossible; empty before it."""
    quiet: bool = False
    """Whether the last clone interval was quiet (`zero_velocity.is_quiet`) and complete."""


class DevicePose(NamedTuple):
    """A `Pose` on the device, without its time."""

    mean: Mean
    covariance: Float[Array, "15 15"]
    flags: Float[Array, "4"]
    """accepted, nis, healthy and quiet."""


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
    memory: Memory | None
    """The memory of a network that has one."""


class Tracker:
    """The filter with the network in the loop, fed sample by sample.

    The constructor compiles everything, so that no sample waits for a compiler. Poses are new
    arrays, which later samples do not change. A tracker must not be used by several threads at
    once.

    Args:
        predict: The network, as in `run_odometry`.
        ekf: The filter, with its measurements. The consider covariance of `ekf.considered` is added
            to that of the poses. A tracker takes no gyro as raw, so `raw_gyro_bias` has no effect.
        state: The start, at the time of the first sample (`initial_state`, `level_state`, or the
            final state of a run). None: it is made of the first `rest_seconds`, in which the device
            must be still (`level_state`). Until then there is no pose; afterwards these samples are
            filtered too. Missing samples are interpolated, because the filter bridges such holes as
            well. A hole of more than `FilterConfig.bridge_seconds`, a sample without any
            acceleration, and a rest of which more than half is missing begin the rest anew
            (`hindrance` says which).
        rest_seconds: Length of that rest, s.
        hole: Samples further apart than this leave the grid samples between them missing, s; None:
            1.5 dt. A slower IMU needs a larger value.
        imu_rate: Nominal rate of the samples that will come, Hz; None: 1/dt. A faster IMU is
            band-limited as in `data.resample`, and poses come later by `delay`. The rate could be
            estimated from the stamps, but then there would be no pose before, and the delay would
            depend on jitter.
        corrector: A corrector of the samples on the grid, before everything else. It needs
            samples that come later, so poses come later too (`delay`).

    Raises:
        ValueError: An argument makes no sense.
    """

    def __init__(
        self,
        predict: Predict | PredictWithMemory,
        ekf: Filter,
        state: FilterState | None = None,
        *,
        rest_seconds: float = 1.0,
        hole: float | None = None,
        imu_rate: float | None = None,
        corrector: SampleCorrector | None = None,
    ):
        check_filter(ekf)
        self._dt = dt = ekf.config.dt
        check_number("rest_seconds", rest_seconds, 1.5 * dt, "s")
        self._rest, self._failure = round(rest_seconds / dt), ""
        self.hindrance = ""
        """Why the samples before the start were no rest; empty if they were."""
        self._corrector = corrector
        self._stream = self._open_stream(create_grid(dt, hole, imu_rate))
        if state is not None:
            state = checked_state(state, ekf)
        dtype = jax.dtypes.canonicalize_dtype(np.float64) if state is None else state.offset.dtype
        self._ekf, self._dtype = converted_filter(ekf, dtype), dtype
        start = state
        if start is None:  # The programs are compiled for the shapes of any start.
            zeros = jnp.zeros(3, dtype)
            start = initial_state(ekf, jnp.eye(3, dtype=dtype), zeros, zeros)
        self._predict = predict
        core = self._start(start)
        columns = 7 if corrector is None else 13
        self._advance, self._look_ahead = compile_programs(predict, core, self._ekf, columns)
        if state is None:
            self._core = None

    def set_rate(self, imu_rate: float, hole: float | None = None) -> None:
        """Change `imu_rate` and `hole` before the first sample. Nothing is compiled again."""
        self._stream = self._open_stream(create_grid(self._dt, hole, imu_rate))

    def restart(self) -> None:
        """Forget all samples, and make the start from the next rest, as a tracker without `state`
        does: after a long stop, or for stamps of another clock. Nothing is compiled again."""
        self._stream = self._open_stream(self._stream.grid)
        self._core, self._failure, self.hindrance = None, "", ""

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
        self._stream.push(*_check_sample(time, gyro, accel))
        if self._core is None:
            self._start_from_rest()
        n, stepped = self._ekf.config.samples_per_clone, False
        while self._core is not None and self._stream.ready >= n:
            rows = self._stream.rows(n).astype(self._core.window.dtype)
            self._stream.take(n)
            self._core, estimate = self._advance(self._core, rows)
            self._ahead, stepped = (0, estimate, self._core.filter.imu), True
        return self._read_pose() if stepped else None

    def pose(self) -> Pose | None:
        """The pose after the newest grid sample; between clone steps the samples since the last
        step are integrated. None while there is no start.

        Its time is NaN before the first sample on the grid. A call costs a dispatch for each sample
        since the last call.
        """
        if self._core is None:
            return None
        done, estimate, memory = self._ahead
        ready = self._stream.ready
        for row in self._stream.rows(ready)[done:].astype(self._core.window.dtype):
            estimate, memory = self._look_ahead(estimate, memory, row)
        self._ahead = ready, estimate, memory
        return self._read_pose()

    def filter_state(self) -> FilterState | None:
        """The filter after the last clone step, as `run_odometry` would return it; None while there
        is no start."""
        if self._core is None:
            return None
        config, core = self._ekf.config, _copy(self._core)
        state = unroll_clones(core.filter, int(core.intervals) % config.clones)
        return state._replace(window=core.window, memory=core.memory)

    @property
    def newest(self) -> float:
        """The newest stamp, s; NaN before the first one. One that jumps by more than 0.2 s counts
        when the next one agrees with it."""
        return self._stream.newest

    @property
    def delay(self) -> float:
        """Delay of all poses by the low-pass of a faster IMU and by a corrector, s; 0 without
        both.

        It is a latency: the times of the poses are correct.
        """
        return self._stream.delay

    def _open_stream(self, grid: Grid) -> Stream | CorrectedStream:
        stream = Stream(grid)
        return stream if self._corrector is None else CorrectedStream(stream, self._corrector)

    def _start_from_rest(self) -> None:
        """Start as soon as the next samples make a rest; they are filtered afterwards."""
        while self._core is None and self._stream.ready >= self._rest:
            rows = self._stream.rows(self._rest)
            self.hindrance, unusable = rest_problem(rows, self._ekf.config)
            if unusable:
                self._stream.take(unusable)
                continue
            number, measured = np.arange(float(self._rest)), rows[:, VALID] > 0
            rows = numerics.interpolate(number, number[measured], rows[measured])
            rows = rows.astype(self._dtype)
            try:
                state = level_state(self._ekf, rows[:, GYRO], rows[:, ACCEL])
            except NoGravity:  # The next samples may show it.
                self.hindrance = "its accelerations show no gravity"
                self._stream.take(self._rest)
                raise
            self._start(state)

    def _start(self, state: FilterState) -> Core:
        """The filter begins with `state`, at the time of the next sample."""
        config, state = self._ekf.config, checked_state(state, self._ekf)
        window = state.window
        if window is None:
            window = jnp.zeros((config.reach, 7), state.offset.dtype)
        remembers = has_memory(self._predict)
        memory = first_memory(self._predict, self._ekf, state) if remembers else None
        state = invariant_errors(state._replace(window=None, memory=None), config)
        tangents = None if self._ekf.considered is None else start_tangents(state)
        # Copies, because the compiled step takes the memory of its argument, which no other array,
        # nor two of its fields, may share.
        core = _copy(Core(state, window, jnp.int32(0), tangents, memory))
        flags = jnp.stack([jnp.nan, jnp.nan, state.healthy, 0.0]).astype(window.dtype)
        self._core: Core | None = core
        estimate = device_pose(self._ekf, state, flags, tangents)
        self._ahead: tuple[int, DevicePose, ImuMemory] = 0, estimate, core.filter.imu
        """Number of ready samples that `pose` has integrated, and the result."""
        return core

    def _read_pose(self) -> Pose:
        """The newest estimate on the host, at the end of the interval of its last sample."""
        ahead, estimate, _ = self._ahead
        mean, covariance, numbers = jax.tree.map(np.array, estimate)
        accepted, nis, healthy, quiet = numbers.tolist()
        if not healthy and not self._failure:
            self._failure = describe_failure(mean, np.diag(covariance), self._ekf.config)
        time = self._stream.origin + (self._stream.taken + ahead) * self._ekf.config.dt
        flags = {"accepted": accepted, "nis": nis, "healthy": healthy > 0, "quiet": quiet > 0}
        return Pose(time, *mean, covariance=covariance, **flags, failure=self._failure)


def rest_problem(rows: Float[np.ndarray, "n 7"], config: FilterConfig) -> tuple[str, int]:
    """Why grid samples (gyro, accel, valid) are no rest, and how many of them cannot be in one;
    ("", 0) if they are one.

    A rest begins with a sample that the filter can hold, has no longer hole than it holds a sample,
    and has at least half of its samples, as `rest_at_start` asks.
    """
    valid = rows[:, VALID] > 0
    dead = np.flatnonzero(valid & ~rows[:, ACCEL].any(axis=1))
    if len(dead):
        return "the accelerometer reads zero", int(dead[-1]) + 1
    ends = np.concatenate([[-1], np.flatnonzero(valid), [len(rows)]])
    holes, longest = np.diff(ends) - 1, max(round(config.bridge_seconds / config.dt), 1)
    broken = np.flatnonzero(holes > longest)
    if len(broken):
        hole = holes[broken[-1]] * config.dt
        return f"samples are missing for {hole:.2g} s", int(ends[broken[-1] + 1])
    if holes[0]:
        return "its first sample is missing", int(holes[0])
    if 2 * valid.sum() < len(rows):
        return f"only {valid.sum()} of its {len(rows)} samples have come", int(ends[2])
    return "", 0


def compile_programs(
    predict: Predict | PredictWithMemory, core: Core, ekf: Filter, columns: int = 7
) -> tuple[Callable[..., tuple[Core, DevicePose]], Callable[..., tuple[DevicePose, ImuMemory]]]:
    """`advance` and `look_ahead`, compiled for cores like this one, and for grid samples with so
    many columns: 7, or 13 with the variances of a corrector."""
    rows = jax.ShapeDtypeStruct((ekf.config.samples_per_clone, columns), core.window.dtype)
    step = functools.partial(advance, predict=predict, ekf=ekf)
    advancing = jax.jit(step, donate_argnums=0).lower(core, rows)
    ahead, row = functools.partial(look_ahead, ekf=ekf), rows.update(shape=(columns,))
    looking = jax.jit(ahead).lower(advancing.out_info[1], core.filter.imu, row)
    return advancing.compile(), looking.compile()


def advance(
    core: Core,
    rows: Float[Array, "n k"],
    predict: Predict | PredictWithMemory,
    ekf: Filter,
) -> tuple[Core, DevicePose]:
    """One clone step, as `run_odometry` makes it, from the n grid samples (gyro, accel, valid, and
    the variances of a corrector) of its interval. The network is not called if the window is no
    measurement."""
    config, valid = ekf.config, rows[:, VALID] > 0
    signals = rows[:, GYRO], rows[:, ACCEL], valid
    imu, age, imu_memory = bridge(*signals, core.filter.imu, config)
    imu = imu._replace(variance=_variance(rows))
    assert imu.gap is not None
    newest = jnp.concatenate([imu.gyro, imu.accel, imu.gap.used[:, None]], axis=1)
    window = jnp.concatenate([core.window[config.samples_per_clone :], newest])
    memory = core.memory
    if has_memory(predict):
        memory, recall = memory_step(predict, ekf)(memory, core.filter, imu)

        def measure(state: FilterState, oldest: Array | int) -> tuple[Displacement, dict]:
            return recalled_displacement(ekf, recall, state, oldest)

    else:
        complete = core.filter.step >= config.clones_per_window
        complete = complete & jnp.all(window[:, VALID] > 0)
        measure_window = network_measurement(predict, ekf)
        latest = Imu(window[:, GYRO], window[:, ACCEL], None)

        def measure(state: FilterState, oldest: Array | int) -> tuple[Displacement, dict]:
            return measure_window(complete, lambda: latest, state, oldest)

    def step(state: FilterState, measure: Measure) -> tuple[FilterState, FilterHistory]:
        slot = core.intervals % config.clones
        return advance_filter(ekf, state, imu, age, measure, slot)

    if core.tangents is None:
        (state, history), tangents = step(core.filter, measure), None
    else:
        state, history, tangents = step_with_tangents(step, core.filter, core.tangents, measure)
    state = state._replace(imu=imu_memory._replace(quiet=state.imu.quiet))
    quiet = jnp.all(valid) & is_quiet(*unbiased_output(imu, state), config)
    flags = [history.accepted[0], history.nis[0], history.healthy[0]]
    flags = jnp.stack([*flags, quiet.astype(flags[0].dtype)])
    estimate = device_pose(ekf, state, flags, tangents)
    return Core(state, window, core.intervals + 1, tangents, memory), estimate


def _variance(rows: Float[Array, "n k"]) -> Float[Array, "n 6"] | None:
    """The variances of grid samples that a corrector has corrected."""
    return rows[:, 7:] if rows.shape[1] > 7 else None


def advance_filter(
    ekf: Filter,
    state: FilterState,
    imu: Imu,
    age: Float[Array, "n"],
    measure: Measure,
    slot: Array,
) -> tuple[FilterState, FilterHistory]:
    """One clone step, and a history of one row. `age` of each held sample, s: see `gaps.bridge`."""
    state, record, _ = clone_step(ekf, state, imu, slot, measure)
    records = jax.tree.map(lambda leaf: leaf[None], record)
    history = finished_history(records, jnp.max(age)[None], state.healthy, ekf.config)
    return state._replace(healthy=history.healthy[-1] > 0), history


def look_ahead(
    estimate: DevicePose,
    memory: ImuMemory,
    row: Float[Array, "k"],
    ekf: Filter,
) -> tuple[DevicePose, ImuMemory]:
    """The estimate and the memory of the IMU after one more grid sample, by integration alone.

    A consider covariance is propagated by the same transition as the filter's own.
    """
    mean, covariance, flags = estimate
    config = ekf.config
    imu, _, memory = bridge(row[None, GYRO], row[None, ACCEL], row[None, VALID] > 0, memory, config)
    imu = imu._replace(variance=_variance(row[None]))
    ahead = integrate(mean, imu, ekf.noise, config.dt)
    transition = jnp.concatenate([ahead.transition, jnp.eye(15, dtype=row.dtype)[BIASES]])
    covariance = transition @ covariance @ transition.T + ahead.noise
    mean = Mean(ahead.rotation, ahead.velocity, ahead.position, *mean[3:])
    return DevicePose(mean, 0.5 * (covariance + covariance.T), flags), memory


def device_pose(
    ekf: Filter, state: FilterState, flags: Float[Array, "4"], tangents: Tangents | None
) -> DevicePose:
    """The state's estimate; the consider covariance is added to its own."""
    covariance = core_covariance(state, ekf.config)
    if tangents is not None and ekf.considered is not None:
        sensitivity = core_sensitivity(state.mean, tangents)
        added = considered_covariance(sensitivity[None], ekf.considered)
        covariance = with_considered(covariance[None], added, ekf.config)[0]
    return DevicePose(state.mean, covariance, flags)


def _check_sample(time: Any, gyro: Any, accel: Any) -> tuple[float, tuple[float, ...]]:
    """The time, and gyro and accel in one tuple."""
    (seconds,) = _check_numbers("time", time, (), "a finite number of seconds", math.inf)
    if not math.isfinite(seconds):
        raise ValueError(f"time: must be a finite number of seconds, found {time!r}")
    rate = _check_numbers("gyro", gyro, (3,), "three numbers", FASTEST_TURN, "rad/s")
    return seconds, rate + _check_numbers(
        "accel", accel, (3,), "three numbers", STRONGEST_FORCE, "m/s²"
    )


def _check_numbers(
    name: str, value: Any, shape: tuple[int, ...], kind: str, largest: float, unit: str = ""
) -> tuple[float, ...]:
    """The numbers of an array of this shape, which must be within the range of an IMU."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape:
        raise ValueError(f"{name}: must be {kind}, found {value!r}")
    numbers = tuple(array.reshape(-1).tolist())
    size = max((abs(number) for number in numbers if math.isfinite(number)), default=0.0)
    if size > largest:
        raise ValueError(f"{name}: no IMU measures more than {largest:g} {unit}, found {size:g}")
    return numbers


def _copy(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), tree)
