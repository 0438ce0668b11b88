"""The filter online: IMU samples as they come, one compiled program per clone step, a pose at any
time.

The core is pure: a `TrackerState`, `intake.take` for the low-pass of a faster IMU, `resample` for
the clock, `advance` for a clone step, `look_ahead` for the samples since. `Tracker` around it is
the one object of the package that changes: a stream has a present, and somebody must hold it.

What comes out is `run_odometry`'s, to rounding: grid sample k, at t_0 + k·dt, drives the interval
up to t_0 + (k + 1)·dt. It is known when the first stamp at or after its own has come, so the
latency is at most one sample; the pose is then given for the end of its interval. Where the IMU is
faster than the filter, the low-pass adds its delay to the latency: `Tracker.delay`, some 22 samples
of the filter, 0.11 s at 200 Hz.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gnio_jax.files import replacing
from gnio_jax.filtering.gaps import bridge
from gnio_jax.filtering.intake import Intake, Run, design, measure_rate, rounding, take
from gnio_jax.filtering.measurement import Measurement
from gnio_jax.filtering.propagation import interval
from gnio_jax.filtering.scan import (
    clone_step,
    expect,
    history,
    infer_window,
    measured,
    no_prediction,
    settled,
)
from gnio_jax.filtering.state import (
    TLIO_STD,
    FilterConfig,
    FilterState,
    ImuMemory,
    InitialStd,
    NoiseModel,
    admit_noise,
    admit_state,
    core_covariance,
    initial_state,
    level_state,
)
from gnio_jax.types import Array, InputError, Prediction

LONGEST_GAP = 60.0
"""A stamp further than this from the one before is taken for a mistake (of its unit, most often),
s."""

_FORMAT = "gnio-jax tracker 3"
_TRIAL = 100
"""Every so many grid samples the IMU's rate is held against `imu_rate`: by the number of stamps
till then, which jitter hardly changes. The time in which the IMU stopped does not count."""
_MISSING = (math.nan,) * 6 + (0.0,)
_PARTS = {
    "rotation": (3, 3),
    "velocity": (3,),
    "position": (3,),
    "gyro_bias": (3,),
    "accel_bias": (3,),
    "covariance": (15, 15),
    "accepted": (),
    "nis": (),
    "healthy": (),
}
"""What a program hands over, laid into one vector: one transfer a step."""
_ENDS = np.cumsum([math.prod(shape) for shape in _PARTS.values()]).tolist()
_SLICES = {
    name: slice(end - math.prod(shape), end)
    for (name, shape), end in zip(_PARTS.items(), _ENDS, strict=True)
}
_LENGTH = _ENDS[-1]
_MOMENTS = tuple(_PARTS)[:6]


class Pose(NamedTuple):
    """What is known at one time. Host arrays."""

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
    """Of the error in θ (world frame, left), v, p, b_g, b_a."""
    accepted: float
    """Of the last clone step: 1 its measurement was used, 0 it was not, NaN there was none."""
    nis: float
    """Of the last clone step: rᵀ S⁻¹ r of its measurement; NaN where there was none."""
    healthy: bool
    """False once a clone step left a state that is not finite, a negative variance or a speed
    above `FilterConfig.speed_limit`: all since is void."""


class Clock(NamedTuple):
    """Where resampling stands: sample `count` of the grid, at origin + count·dt, is the next to
    come."""

    origin: float
    """Stamp of the first sample, s."""
    count: int
    """Grid samples so far."""
    newest: float
    """The newest stamp, s."""
    stamp: float
    """The newest stamp of a sample that was not missing, s; −inf before there was one."""
    sample: tuple[float, ...]
    """That sample: gyro rad/s, accel m/s²."""


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


class TrackerState(NamedTuple):
    """All that a tracker knows beside what it was made of."""

    core: Core | None
    """None while the first samples at rest are collected."""
    latest: Float[np.ndarray, "l"] | None
    """The last clone step's (at first the start's) `Pose` without its time, in one vector."""
    pending: Float[np.ndarray, "m 7"]
    """Grid samples since: gyro, accel, and 1 or, for a missing one, 0."""
    clock: Clock | None
    """None before the first sample on the grid."""
    intake: Intake | None
    """None before the first sample."""


def resample(
    clock: Clock | None, time: float, sample: tuple[float, ...], dt: float, hole: float
) -> tuple[Clock, list[tuple[float, ...]]]:
    """The clock after one sample (gyro, accel; any NaN: missing), and the grid samples (gyro,
    accel, valid) that are known now.

    Causal linear interpolation between the sample and the last that was there. Grid samples
    strictly between two that are more than `hole` seconds apart are missing. A missing sample says
    that time goes by: what no later sample can fill any more is missing at once.
    """
    if clock is None:
        clock = Clock(time, 0, -math.inf, -math.inf, (math.nan,) * 6)
    slack = rounding(dt, time, clock.origin)
    elapsed, count, rows = time - clock.origin, clock.count, []
    there = all(map(math.isfinite, sample))
    apart = time - clock.stamp > hole
    if not there and not apart:
        return clock._replace(newest=time), rows
    before = clock.stamp - clock.origin
    while (target := count * dt) <= elapsed + slack:
        if there and target >= elapsed - slack:
            rows.append((*sample, 1.0))
        elif apart:
            rows.append(_MISSING)
        else:
            share = (target - before) / (elapsed - before)
            rows.append(
                (*(a + share * (b - a) for a, b in zip(clock.sample, sample, strict=True)), 1.0)
            )
        count += 1
    clock = clock._replace(count=count, newest=time)
    return (clock._replace(stamp=time, sample=sample) if there else clock), rows


def advance(
    core: Core,
    rows: Float[Array, "n 7"],
    predict: Callable[[Any], Prediction],
    config: FilterConfig,
    noise: NoiseModel,
) -> tuple[Core, Float[Array, "l"]]:
    """One clone step, as `run_odometry` makes it, from the n grid samples (gyro, accel, valid) of
    its interval; and its pose.

    `config.history` must be "core". Where the window is no measurement the network is not called.
    """
    clones = config.clones_per_window + 1
    stream, age, memory = bridge(rows[:, :3], rows[:, 3:6], rows[:, 6] > 0, core.filter.imu, config)
    assert stream.gap is not None
    latest = jnp.concatenate([stream.gyro, stream.accel, stream.gap.used[:, None]], axis=1)
    window = jnp.concatenate([core.window[config.samples_per_clone :], latest])
    complete = (core.intervals >= config.clones_per_window) & jnp.all(window[:, 6] > 0)

    def infer(state: FilterState, oldest: Array) -> Prediction:
        return infer_window(
            predict, state, state.clone_rotation[oldest], window[:, :3], window[:, 3:6], config
        )._replace(diagnostics={})

    def nothing(state: FilterState, oldest: Array) -> Prediction:
        return no_prediction(expect(predict, config))._replace(diagnostics={})

    def measure(state: FilterState, oldest: Array | int) -> tuple[Measurement, dict]:
        return measured(
            jax.lax.cond(complete, infer, nothing, state, jnp.asarray(oldest)), config, rows.dtype
        ), {}

    slot = core.intervals % clones
    state, row = clone_step(
        core.filter, stream, measure, slot, config, noise, config.displacement_frame
    )
    seen = history(jax.tree.map(lambda x: x[None], row), jnp.max(age)[None], state.healthy, config)
    state = state._replace(imu=memory._replace(quiet=state.imu.quiet), healthy=seen.healthy[-1] > 0)
    return Core(state, window, core.intervals + 1), jnp.concatenate(
        [getattr(seen, name).reshape(-1) for name in _PARTS]
    )


def look_ahead(
    pose: Float[Array, "l"],
    memory: ImuMemory,
    row: Float[Array, "7"],
    config: FilterConfig,
    noise: NoiseModel,
) -> tuple[Float[Array, "l"], ImuMemory]:
    """The pose and the memory of the IMU after one more grid sample, by integration alone."""
    rotation, velocity, position, gyro_bias, accel_bias, covariance = (
        pose[_SLICES[name]].reshape(_PARTS[name]) for name in _MOMENTS
    )
    state = initial_state(config, rotation, velocity, position, gyro_bias, accel_bias)
    stream, _, memory = bridge(row[None, :3], row[None, 3:6], row[None, 6] > 0, memory, config)
    motion = interval(state, stream, noise, config.dt)
    covariance = motion.transition @ covariance @ motion.transition.T + motion.noise
    moved = [
        motion.rotation,
        motion.velocity,
        position + motion.offset,
        gyro_bias,
        accel_bias,
        0.5 * (covariance + covariance.T),
    ]
    return jnp.concatenate(
        [*(part.reshape(-1) for part in moved), pose[_SLICES["accepted"].start :]]
    ), memory


class Tracker:
    """The filter with the network in the loop, fed sample by sample.

    predict   as `run_odometry` takes it. state     the start, at the time of the first sample
    (`initial_state`, `level_state`, or what a run left). config, noise  the filter's. hole
    samples further apart than this leave the grid samples between them missing, s; None: 1.5 dt. A
    slower IMU needs more. imu_rate  Hz, nominal, of the samples that will come; None: 1/dt. A
    faster IMU is band-limited
              as `data.resample` does it, and poses come later by `delay`. The stamps could tell
              the rate, but no pose could be given before, and jitter would decide on the delay.

    Everything is compiled here, so that no sample waits for a compiler. Poses are new arrays, which
    later samples do not touch. Not for several threads at once. Raises `ValueError` naming an
    argument that makes no sense.
    """

    def __init__(
        self,
        predict: Callable[[Any], Prediction],
        state: FilterState,
        config: FilterConfig,
        noise: NoiseModel,
        hole: float | None = None,
        imu_rate: float | None = None,
    ):
        state = admit_state(state, config)
        self._build(predict, config, noise, hole, imu_rate, state.offset.dtype)
        self._start(state)
        self._pending = self._empty(config.samples_per_clone)

    @classmethod
    def from_rest(
        cls,
        predict: Callable[[Any], Prediction],
        config: FilterConfig,
        noise: NoiseModel,
        seconds: float = 1.0,
        std: InitialStd = TLIO_STD,
        hole: float | None = None,
        imu_rate: float | None = None,
    ) -> Tracker:
        """Start without a state: the device lies still for the first `seconds`, from which
        `level_state` makes one for the first sample.

        Until then there is no pose; then these samples are filtered, too. A missing sample begins
        the collection anew.
        """
        if not (
            isinstance(seconds, int | float)
            and math.isfinite(seconds)
            and round(seconds / config.dt) >= 2
        ):
            raise ValueError(
                f"seconds: must be a time of at least two samples of {config.dt:g} s, found {seconds!r}"
            )
        dtype = jax.dtypes.canonicalize_dtype(np.float64)
        initial_state(
            config, jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype), jnp.zeros(3, dtype), std=std
        )  # complains of precision, std
        tracker = cls.__new__(cls)
        tracker._build(predict, config, noise, hole, imu_rate, dtype)
        tracker._rest = round(seconds / config.dt)
        tracker._std = InitialStd(*(float(value) for value in std))
        tracker._pending = tracker._empty(max(tracker._rest, config.samples_per_clone))
        return tracker

    def push(self, time: Any, gyro: Any, accel: Any) -> Pose | None:
        """Take one sample: time s, gyro (3,) rad/s, accel (3,) m/s², raw, in the body frame; a
        value that is not finite: missing.

        Returns the pose of a clone step, if one was made (of the last, after a gap), else None:
        then `pose()` has the newest. Raises `ValueError` naming the argument if the time does not
        increase, or by more than `LONGEST_GAP`, or a shape is wrong; then nothing has changed. So
        does an IMU that is so much faster than `imu_rate` that it would alias; every hundred grid
        samples that is looked at.
        """
        stamp, sample = self._stamp(time), (*_three("gyro", gyro), *_three("accel", accel))
        self._intake, events = take(self._intake, stamp, sample, self._design)
        pose = None
        for event in events:
            clock, rows = resample(self._clock, *event, self._config.dt, self._hole)
            self._clock = clock
            for place, row in enumerate(rows):
                made = self._take(row, clock.count - len(rows) + place + 1)
                pose = made or pose
        return pose

    def pose(self) -> Pose | None:
        """The pose after the newest grid sample; between clone steps by integrating the samples
        since. None while there is no start.

        Its time is NaN before the first sample on the grid. Costs a dispatch for each sample
        since it was last asked.
        """
        if self._core is None or self._latest is None:
            return None
        if self._ahead is None:
            self._ahead = 0, self._latest, self._core.filter.imu
        done, vector, memory = self._ahead
        for row in self._pending[done : self._filled]:
            vector, memory = self._look_ahead(vector, memory, row)
        self._ahead = self._filled, vector, memory
        return self._pose(
            np.asarray(vector), math.nan if self._clock is None else self._clock.count
        )

    def filter_state(self) -> FilterState | None:
        """The filter after the last clone step, as `run_odometry` would return it; None while there
        is no start."""
        if self._core is None:
            return None
        return settled(
            _copied(self._core.filter),
            int(self._core.intervals) % (self._config.clones_per_window + 1),
        )

    @property
    def delay(self) -> float:
        """By how much the low-pass of a faster IMU delays all poses, s; 0 without one.

        It is latency: the times of the poses are right.
        """
        return self._design.delay

    @property
    def state(self) -> TrackerState:
        """A copy of all that changes."""
        return TrackerState(
            _copied(self._core),
            None if self._latest is None else self._latest.copy(),
            self._pending[: self._filled].copy(),
            self._clock,
            self._intake,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all but the network into an .npz file, whole or not at all; `restore` goes on from
        it to the bit."""
        state = self.state
        arrays = {"pending": state.pending}
        if state.core is not None:
            assert state.latest is not None
            arrays |= {
                "latest": state.latest,
                **{name: np.asarray(leaf) for name, leaf in _named(state.core).items()},
            }
        stream = None if state.intake is None else state.intake._asdict()
        if state.intake is not None and (run := state.intake.run) is not None:
            arrays |= {"stamps": run.stamps, "samples": run.samples}
            stream = {**state.intake._asdict(), "run": run.first}
        about = {
            "format": _FORMAT,
            "config": dataclasses.asdict(self._config),
            "noise": {k: float(v) for k, v in self._noise._asdict().items()},
            "hole": self._hole,
            "rest": self._rest,
            "std": list(self._std),
            "dtype": self._dtype.name,
            "clock": None if state.clock is None else state.clock._asdict(),
            "imu_rate": self._design.imu_rate,
            "intake": stream,
        }
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, about=np.array(json.dumps(about)), **arrays)  # pyright: ignore[reportArgumentType]

    @classmethod
    def restore(
        cls,
        path: str | os.PathLike[str],
        predict: Callable[[Any], Prediction],
        config: FilterConfig,
        noise: NoiseModel,
    ) -> Tracker:
        """A tracker as `save` left it. Raises `InputError` for a file that is damaged or of another
        config or noise."""
        path = Path(path)
        about, arrays = _read(path)
        for what, found, given in [
            ("FilterConfig", about["config"], dataclasses.asdict(config)),
            ("NoiseModel", about["noise"], {k: float(v) for k, v in noise._asdict().items()}),
        ]:
            for name in sorted(found.keys() | given.keys()):
                if found.get(name) != given.get(name):
                    raise InputError(
                        path,
                        f"was saved with {what}.{name} = {found.get(name)!r}, not {given.get(name)!r}",
                        "restore it with the settings it was saved with",
                    )
        tracker = cls.__new__(cls)
        dtype = np.dtype(about["dtype"])
        tracker._build(predict, config, noise, about["hole"], about["imu_rate"], dtype)
        tracker._rest, tracker._std = about["rest"], InitialStd(*about["std"])
        tracker._clock = (
            None
            if about["clock"] is None
            else Clock(**(about["clock"] | {"sample": tuple(about["clock"]["sample"])}))
        )
        waiting, stream = "latest" not in arrays, about["intake"]
        tracker._pending = tracker._empty(max(tracker._rest, config.samples_per_clone))
        wanted = {
            "pending": jax.ShapeDtypeStruct((len(arrays.get("pending", ())), 7), tracker._dtype)
        }
        if stream is not None and stream["run"] is not None:
            kept = len(arrays.get("stamps", ()))
            wanted |= {
                "stamps": jax.ShapeDtypeStruct((kept,), np.float64),
                "samples": jax.ShapeDtypeStruct((kept, 6), np.float64),
            }
        if not waiting:
            wanted |= {
                "latest": jax.ShapeDtypeStruct((_LENGTH,), tracker._dtype),
                **_named(tracker._shapes),
            }
        for name, like in wanted.items():
            if (
                name not in arrays
                or arrays[name].shape != like.shape
                or arrays[name].dtype != like.dtype
            ):
                raise InputError(
                    path,
                    f"its array '{name}' is missing or not {like.dtype} of shape {like.shape}",
                    "it is damaged",
                )
        tracker._filled = len(arrays["pending"])
        if tracker._filled >= (tracker._rest if waiting else config.samples_per_clone):
            raise InputError(
                path,
                f"holds {tracker._filled} samples of an interval of {config.samples_per_clone}",
                "it is damaged",
            )
        tracker._pending[: tracker._filled] = arrays["pending"]
        if stream is not None:
            first = stream["run"]
            run = None if first is None else Run(first, arrays["stamps"], arrays["samples"])
            tracker._intake = Intake(**(stream | {"run": run}))
        if not waiting:
            leaves = [jnp.array(arrays[name]) for name in _named(tracker._shapes)]
            tracker._core = jax.tree.unflatten(jax.tree.structure(tracker._shapes), leaves)
            tracker._latest = arrays["latest"]
        return tracker

    def _build(
        self,
        predict: Callable[[Any], Prediction],
        config: FilterConfig,
        noise: NoiseModel,
        hole: float | None,
        imu_rate: float | None,
        dtype: Any,
    ) -> None:
        hole = 1.5 * config.dt if hole is None else hole
        if not (isinstance(hole, int | float) and math.isfinite(hole) and hole >= config.dt):
            raise ValueError(
                f"hole: must be a time of at least dt = {config.dt:g} s, found {hole!r}"
            )
        imu_rate = 1 / config.dt if imu_rate is None else imu_rate
        if not (isinstance(imu_rate, int | float) and math.isfinite(imu_rate) and imu_rate > 0):
            raise ValueError(f"imu_rate: must be a rate in Hz, found {imu_rate!r}")
        expect(predict, config)
        self._design = design(config.dt, float(hole), float(imu_rate))
        self._intake: Intake | None = None
        self._config, self._hole, self._dtype = config, float(hole), np.dtype(dtype)
        self._noise = admit_noise(noise, dtype)
        self._core: Core | None = None
        self._latest: np.ndarray | None = None
        self._clock: Clock | None = None
        self._ahead: tuple[int, Any, ImuMemory] | None = None
        self._filled, self._rest, self._std = 0, 0, TLIO_STD
        whole = dataclasses.replace(config, history="core")

        def begin() -> Core:
            state = initial_state(
                config, jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype), jnp.zeros(3, dtype)
            )
            return Core(state, jnp.zeros((config.reach, 7), dtype), jnp.int32(0))

        self._shapes = jax.eval_shape(begin)
        rows = jax.ShapeDtypeStruct((config.samples_per_clone, 7), dtype)
        step = functools.partial(advance, predict=predict, config=whole, noise=self._noise)
        self._advance = jax.jit(step, donate_argnums=0).lower(self._shapes, rows).compile()
        ahead = functools.partial(look_ahead, config=config, noise=self._noise)
        self._look_ahead = (
            jax.jit(ahead)
            .lower(
                jax.ShapeDtypeStruct((_LENGTH,), dtype),
                self._shapes.filter.imu,
                jax.ShapeDtypeStruct((7,), dtype),
            )
            .compile()
        )

    def _start(self, state: FilterState) -> None:
        # Copies: the first step is given their memory, and it may not be shared, not even between
        # two fields.
        self._core = _copied(
            Core(state, jnp.zeros((self._config.reach, 7), self._dtype), jnp.int32(0))
        )
        mean = (
            state.rotation,
            state.velocity,
            state.position,
            state.gyro_bias,
            state.accel_bias,
            core_covariance(state.core_covariance),
        )
        flags = [math.nan, math.nan, float(state.healthy)]
        parts = [*(np.asarray(part).reshape(-1) for part in mean), flags]
        self._latest = np.concatenate(parts, dtype=self._dtype)

    def _empty(self, rows: int) -> np.ndarray:
        return np.zeros((rows, 7), self._dtype)

    def _stamp(self, time: Any) -> float:
        try:
            stamp = float(time)
        except (TypeError, ValueError):
            stamp = math.nan
        if not math.isfinite(stamp):
            raise ValueError(f"time: must be a finite number of seconds, found {time!r}")
        if self._intake is not None:
            before = self._intake.newest
            if stamp <= before:
                raise ValueError(f"time: must increase, found {stamp!r} after {before!r}")
            if stamp - before > LONGEST_GAP:
                raise ValueError(
                    f"time: {stamp!r} is {stamp - before:g} s after the sample before, more than {LONGEST_GAP:g} s; "
                    "stamps are in seconds, and after a long stop a new tracker starts better"
                )
            counted, slack = (
                measure_rate(self._intake, stamp, self._design),
                rounding(self._config.dt, stamp, self._intake.origin),
            )
            trials, now = (
                (each.covered + slack) // (_TRIAL * self._config.dt)
                for each in (self._intake, counted)
            )
            if now > trials:
                found = counted.intervals / counted.covered
                if found > 1.05 * self._design.fastest:
                    raise ValueError(
                        f"imu_rate: the samples come at {found:.4g} Hz, the tracker "
                        f"was made for {self._design.imu_rate:.4g} Hz: vibrations "
                        f"would alias; make it with imu_rate={found:.4g}"
                    )
        return stamp

    def _take(self, row: tuple[float, ...], count: int) -> Pose | None:
        """One grid sample, after which there have been `count`."""
        self._pending[self._filled] = row
        self._filled += 1
        if self._core is None:
            return self._collect(count)
        if self._filled < self._config.samples_per_clone:
            return None
        return self._step(self._pending[: self._config.samples_per_clone], count)

    def _step(self, rows: np.ndarray, count: int) -> Pose:
        self._core, vector = self._advance(self._core, rows)
        self._latest, self._ahead, self._filled = np.asarray(vector), None, 0
        return self._pose(self._latest, count)

    def _collect(self, count: int) -> Pose | None:
        """Start, once the samples at rest are together."""
        if self._pending[self._filled - 1, 6] == 0:
            self._filled = 0
        if self._filled < self._rest:
            return None
        samples, n = self._pending[: self._rest].copy(), self._config.samples_per_clone
        self._start(level_state(self._config, samples[:, :3], samples[:, 3:6], std=self._std))
        pose, first = None, count - self._rest
        for done in range(n, self._rest + 1, n):
            pose = self._step(samples[done - n : done], first + done)
        left = self._rest % n
        self._pending[:left], self._filled = samples[self._rest - left :], left
        return pose

    def _pose(self, vector: np.ndarray, count: int | float) -> Pose:
        time = math.nan if self._clock is None else self._clock.origin + count * self._config.dt
        parts = {name: vector[_SLICES[name]].reshape(_PARTS[name]) for name in _MOMENTS}
        accepted, nis, healthy = vector[-3:].tolist()
        return Pose(time, **parts, accepted=accepted, nis=nis, healthy=healthy > 0)


def _three(name: str, value: Any) -> tuple[float, ...]:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: must be three numbers, found {value!r}") from None
    if array.shape != (3,):
        raise ValueError(f"{name}: must be three numbers, found shape {array.shape}")
    return tuple(array.tolist())


def _copied(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), tree)


def _named(core: Core) -> dict[str, Any]:
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(core)
    }


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays.pop("about")))
    except FileNotFoundError:
        raise InputError(path, "no such file", "write one with Tracker.save") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error})") from None
    except (
        ValueError,
        KeyError,
        AttributeError,
        EOFError,
        zipfile.BadZipFile,
        json.JSONDecodeError,
    ):
        raise InputError(path, "is no file of Tracker.save, or damaged", "write it again") from None
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        raise InputError(path, f"is not a '{_FORMAT}' file", "write it again with this version")
    return about, arrays
