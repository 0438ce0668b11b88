"""The filter online: IMU samples as they come, one compiled program per clone step, a pose at any
time.

A sample passes the low-pass (`intake`), the clock (`clock`), and every n-th grid sample makes a
clone step (`online`). All of these are pure; `Tracker` around them is the one object of the package
that changes: a stream has a present, and somebody must hold it.

Grid sample k, at t_0 + k·dt, drives the interval up to t_0 + (k + 1)·dt. It is known when the first
stamp at or after its own has come, so the latency is at most one sample; the pose is then given for
the end of its interval. Where the IMU is faster than the filter, the low-pass adds its delay to the
latency: `Tracker.delay`, some 22 samples of the filter, 0.11 s at 200 Hz.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax.config import ConsideredStd, InitialStd, NoiseModel
from gnio_jax.config.schema import TLIO_STD
from gnio_jax.filtering.clock import Clock, GridSample, advance_clock
from gnio_jax.filtering.clones import unroll_clones
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.considered import check_considered
from gnio_jax.filtering.inputs import checked_noise, checked_state
from gnio_jax.filtering.intake import (
    Intake,
    check_rate,
    checked_design,
    is_finite_number,
    low_pass_sample,
)
from gnio_jax.filtering.network import Predict, prediction_shapes
from gnio_jax.filtering.online import (
    ACCEL,
    GRID_COLUMNS,
    GYRO,
    VALID,
    TrackerCore,
    TrackerSettings,
    TrackerState,
    compile_programs,
    start_core,
    with_considered,
)
from gnio_jax.filtering.pose import Pose, pose_from_vector, start_vector
from gnio_jax.filtering.start import initial_state, rest_state, with_lasting_errors
from gnio_jax.filtering.state import FilterState, ImuMemory
from gnio_jax.filtering.tracker_file import load_tracker, save_tracker
from gnio_jax.types import Prediction

LONGEST_GAP = 60.0
"""A stamp further than this from the one before is taken for a mistake (of its unit, most often),
s."""


class Tracker:
    """The filter with the network in the loop, fed sample by sample.

    - predict: as `run_odometry` takes it.
    - state: the start, at the time of the first sample (`initial_state`, `level_state`, or what a
      run left).
    - config, noise: the filter's.
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
        state: FilterState,
        config: FilterConfig,
        noise: NoiseModel,
        hole: float | None = None,
        imu_rate: float | None = None,
        considered: ConsideredStd | None = None,
    ):
        state = checked_state(state, config, noise)
        dtype = np.dtype(state.offset.dtype)
        low_pass = checked_design(config.dt, hole, imu_rate)
        settings = TrackerSettings(
            config=config,
            noise=checked_noise(noise, dtype),
            design=low_pass,
            dtype=dtype,
            considered=_checked_numbers(considered),
        )
        self._make(predict, settings)
        self._start(state)

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
        considered: ConsideredStd | None = None,
    ) -> Tracker:
        """Start without a state: the device lies still for the first `seconds`, from which
        `rest_state` makes one for the first sample: tilt, velocity, and the gyro's bias where a
        second or more is as quiet as on a table.

        Until then there is no pose; then these samples are filtered, too. A missing sample begins
        the collection anew.
        """
        if not (is_finite_number(seconds) and round(seconds / config.dt) >= 2):
            raise ValueError(
                f"seconds: must be a time of at least two samples of {config.dt:g} s, "
                f"found {seconds!r}"
            )
        dtype = np.dtype(jax.dtypes.canonicalize_dtype(np.float64))
        eye, nothing = jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype)
        initial_state(config, eye, nothing, nothing, std=std)  # complains of precision and std
        low_pass = checked_design(config.dt, hole, imu_rate)
        settings = TrackerSettings(
            config=config,
            noise=checked_noise(noise, dtype),
            design=low_pass,
            dtype=dtype,
            rest=round(seconds / config.dt),
            std=InitialStd(*(float(value) for value in std)),
            considered=_checked_numbers(considered),
        )
        tracker = cls.__new__(cls)
        tracker._make(predict, settings)
        return tracker

    @classmethod
    def restore(
        cls,
        path: str | os.PathLike[str],
        predict: Callable[[Any], Prediction],
        config: FilterConfig,
        noise: NoiseModel,
    ) -> Tracker:
        """A tracker as `save` left it, with what it considers. Raises `InputError` for a file that
        is damaged or of another config or noise."""
        settings, state = load_tracker(path, config, noise)
        tracker = cls.__new__(cls)
        tracker._make(predict, settings)
        tracker._core, tracker._latest = state.core, state.latest
        tracker._pending = [tuple(row) for row in state.pending.tolist()]
        tracker._clock, tracker._intake = state.clock, state.intake
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
        stamp = self._checked_stamp(time)
        sample = (*_three_numbers("gyro", gyro), *_three_numbers("accel", accel))
        low_pass = self._settings.design
        self._intake, events = low_pass_sample(self._intake, stamp, sample, low_pass)
        newest_pose = None
        for event in events:
            self._clock, rows = advance_clock(self._clock, *event, low_pass.dt, low_pass.hole)
            before = self._clock.count - len(rows)
            for number, row in enumerate(rows, start=before + 1):
                newest_pose = self._push_grid_sample(row, number) or newest_pose
        return newest_pose

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
        for row in self._rows(self._pending[done:]):
            vector, memory = self._programs.look_ahead(vector, memory, row)
        self._ahead = len(self._pending), vector, memory
        samples = math.nan if self._clock is None else self._clock.count
        return pose_from_vector(np.asarray(vector), self._time_after(samples))

    def filter_state(self) -> FilterState | None:
        """The filter after the last clone step, as `run_odometry` would return it; None while there
        is no start."""
        if self._core is None:
            return None
        oldest = int(self._core.intervals) % self._settings.config.clones
        return unroll_clones(_copied(self._core.filter), oldest)

    @property
    def delay(self) -> float:
        """By how much the low-pass of a faster IMU delays all poses, s; 0 without one.

        It is latency: the times of the poses are right.
        """
        return self._settings.design.delay

    @property
    def state(self) -> TrackerState:
        """A copy of all that changes."""
        return TrackerState(
            _copied(self._core),
            None if self._latest is None else self._latest.copy(),
            self._rows(self._pending),
            self._clock,
            self._intake,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all but the network into an .npz file, whole or not at all; `restore` goes on from
        it to the bit."""
        save_tracker(path, self._settings, self.state)

    def _make(self, predict: Predict, settings: TrackerSettings) -> None:
        """Compile for these settings; nothing has come yet."""
        prediction_shapes(predict, settings.config)
        self._settings = settings
        self._programs = compile_programs(predict, settings)
        self._core: TrackerCore | None = None
        self._latest: np.ndarray | None = None
        self._pending: list[GridSample] = []
        self._clock: Clock | None = None
        self._intake: Intake | None = None
        self._ahead: tuple[int, Any, ImuMemory] | None = None
        """How many pending samples `pose` has integrated, its vector and IMU memory after them."""

    def _start(self, state: FilterState) -> None:
        considered = self._settings.considered
        if self._settings.noise.correlation is not None:
            state = with_lasting_errors(state)
        # Copies: the first step is given their memory, and it may not be shared, not even between
        # two fields.
        core = start_core(state, self._settings)
        self._core = _copied(core)
        self._latest = start_vector(state, self._settings.dtype)
        if considered is not None and core.tangents is not None:
            pose = with_considered(self._latest, state, core.tangents, considered)
            self._latest = np.asarray(pose)
        self._pending, self._ahead = [], None

    def _push_grid_sample(self, row: GridSample, number: int) -> Pose | None:
        """Take the `number`-th grid sample, counted from 1."""
        self._pending.append(row)
        if self._core is None:
            return self._collect_rest(number)
        if len(self._pending) < self._settings.config.samples_per_clone:
            return None
        rows, self._pending = self._rows(self._pending), []
        return self._clone_step(self._core, rows, number)

    def _clone_step(self, core: TrackerCore, rows: np.ndarray, number: int) -> Pose:
        """A clone step with the samples up to the `number`-th."""
        self._core, vector = self._programs.advance(core, rows)
        self._latest, self._ahead = np.asarray(vector), None
        return pose_from_vector(self._latest, self._time_after(number))

    def _collect_rest(self, number: int) -> Pose | None:
        """Start, once the samples at rest are together, and filter them."""
        if self._pending[-1][VALID] == 0:
            self._pending = []
        config, rest, std = self._settings.config, self._settings.rest, self._settings.std
        if len(self._pending) < rest:
            return None
        collected = self._pending
        samples = self._rows(collected)
        self._start(rest_state(config, samples[:, GYRO], samples[:, ACCEL], std))
        pose, n, before = None, config.samples_per_clone, number - rest
        for done in range(n, rest + 1, n):
            assert self._core is not None
            pose = self._clone_step(self._core, samples[done - n : done], before + done)
        self._pending = collected[rest - rest % n :]
        return pose

    def _rows(self, samples: list[GridSample]) -> np.ndarray:
        return np.array(samples, self._settings.dtype).reshape(-1, GRID_COLUMNS)

    def _time_after(self, samples: int | float) -> float:
        """End of the interval of the last of so many grid samples, s."""
        return math.nan if self._clock is None else self._clock.origin + samples * self._dt

    @property
    def _dt(self) -> float:
        return self._settings.config.dt

    def _checked_stamp(self, time: Any) -> float:
        try:
            stamp = float(time)
        except (TypeError, ValueError):
            stamp = math.nan
        if not math.isfinite(stamp):
            raise ValueError(f"time: must be a finite number of seconds, found {time!r}")
        if self._intake is None:
            return stamp
        before = self._intake.newest
        if stamp <= before:
            raise ValueError(f"time: must increase, found {stamp!r} after {before!r}")
        if stamp - before > LONGEST_GAP:
            raise ValueError(
                f"time: {stamp!r} is {stamp - before:g} s after the sample before, more than "
                f"{LONGEST_GAP:g} s; stamps are in seconds, and after a long stop a new tracker "
                "starts better"
            )
        check_rate(self._intake, stamp, self._settings.design)
        return stamp


def _checked_numbers(considered: ConsideredStd | None) -> ConsideredStd | None:
    """The same as numbers of Python, which a program and a file hold."""
    if considered is None:
        return None
    check_considered(considered)
    return ConsideredStd(*(float(value) for value in considered))


def _three_numbers(name: str, value: Any) -> tuple[float, ...]:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: must be three numbers, found {value!r}") from None
    if array.shape != (3,):
        raise ValueError(f"{name}: must be three numbers, found shape {array.shape}")
    return tuple(array.tolist())


def _copied(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), tree)
