"""Poses for a walk with waypoints (ours): filter and smoother make a reference from positions that
are known at a few moments, e.g. because somebody tapped them on a map.

The world of the filter is level, and its yaw is 0 at the start; its rotation and shift relative to
the map are not known. So the filter first runs without the waypoints, and the rotation and shift
that align its path with them (`geometry.planar_alignment`) are applied to its start. From there,
with an uncertain yaw and position, the smoother takes the waypoints and the displacements of the
first run. The aligned yaw comes from the same waypoints and must not count as another measurement:
it is only the point at which the smoother is linear, and the covariances are those without it
(`_without_yaw_prior`).

A tap may be too early, too late or in the wrong place. So a waypoint far from the smoothed path
gets a larger covariance, with the weight of Student's t with `FREEDOM` degrees of freedom, and the
path is smoothed again from the start of the smoothed path.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.config import CorrelatedError, InitialStd
from gnio_jax.errors import InputError
from gnio_jax.filtering.batch import padded_masks, padded_signals
from gnio_jax.filtering.filter import Filter
from gnio_jax.filtering.fix import Fix, fixes_on_intervals
from gnio_jax.filtering.history import FilterHistory
from gnio_jax.filtering.network import Predict
from gnio_jax.filtering.scan import run_odometry
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.smoother import SmoothedHistory, smooth
from gnio_jax.filtering.start import NoGravity, initial_state, level_state
from gnio_jax.filtering.state import THETA, FilterState, Mean
from gnio_jax.numerics import (
    filled_up,
    finite_rows,
    interpolate,
    quaternion_from_matrix,
    rotation_z,
)
from gnio_jax.types import GRAVITY, Array, Sequence, Waypoints

PLACE_STD, TIME_STD = 0.3, 0.4
"""Standard deviations of the place, m, and of the time, s, of a tap."""
START_STD = {"tilt": 0.1, "yaw": 0.2, "velocity": 1.0, "position": 10.0, "gyro_bias": 2e-3}
"""Standard deviations of the aligned start: rad, rad, m/s, m, rad/s. With a yaw of 0.5 rad the
filter, which gains no yaw from displacements, swings about the path until fixes show it, and
smoothing is linearised there: on simulated walks with 5 to 13 taps displacements over a second err
by 0.09 to 0.17 m instead of 0.08 to 0.12 m. Every smoothing starts at the yaw of the one before, so
this prior holds the yaw back less and less."""
CORRELATION = CorrelatedError(share=0.95, seconds=5.0)
"""Temporal correlation of the displacements' errors: a network overestimates or underestimates a
walker's speed leg by leg. Their standard deviation is the error of the first path over the legs,
added to the network's own."""
FREEDOM, PASSES = 4.0, 4
"""Degrees of freedom of the weights, and number of smoothings."""
LEAST_WEIGHT = 0.5
"""A waypoint with a smaller weight, more than 2.8 standard deviations from the smoothed path, does
not agree with it."""
MOST_YAW_STD = 0.5
"""Largest standard deviation of the yaw that the waypoints show, rad. Beyond it the yaw is not
known, and the smoother is not linear."""
FEWEST_WAYPOINTS = 2
"""Smallest number of waypoints that determine a rotation and a shift."""
START_SECONDS = 1.0
"""Duration of the samples from which the level start is made, s."""
LONGER = 2.0
"""Recordings are filled up to lengths this factor apart, since each length is a compilation."""


class WaypointPoses(NamedTuple):
    """A walk with its poses and their covariances."""

    sequence: Sequence
    """The walk with a pose and a velocity at every sample in the frame of the map, z relative to
    the start. It is valid from the first waypoint to the last, and has no waypoints."""
    smoothed: SmoothedHistory
    """Poses and velocities at the end of every clone interval that the walk fills, with
    covariances. They do not contain an error of the network's heading that lasts for the whole
    walk."""
    weight: Float[np.ndarray, "f"]
    """Weight of each waypoint: above 1 on the path, towards 0 far from it."""


def waypoint_poses(
    sequence: Sequence,
    predict: Predict,
    ekf: Filter,
    place_std: float = PLACE_STD,
    time_std: float = TIME_STD,
) -> WaypointPoses:
    """Poses of a walk with waypoints.

    Programs are compiled for each `predict` and for a few lengths.

    Args:
        sequence: The walk, at the filter's rate.
        predict: The network, as in `run_odometry`.
        ekf: The filter.
        place_std: Standard deviation of the place of a waypoint, m.
        time_std: Standard deviation of its stamp, s.

    Raises:
        InputError: The sequence has another rate, samples that are not finite, or lacks
            `START_SECONDS` and a window that were measured; its waypoints have a
            `Waypoints.problem`, or do not show the yaw; the filter fails, or most waypoints are far
            from the smoothed path.
        ValueError: An argument of the filter is wrong, or JAX has no float64, which it needs.
    """
    config = dataclasses.replace(ekf.config, history="core")
    ekf = dataclasses.replace(ekf, config=config)
    taps = _checked_waypoints(sequence, config)
    walk = _filled_walk(sequence, config)

    def poses_of(estimates: FilterHistory | SmoothedHistory) -> list[np.ndarray]:
        """Rotation, velocity and position at every sample."""
        ends = Mean(*(getattr(estimates, name) for name in Mean._fields))
        poses = jax.device_get(_between_clones(ends, walk.gyro, walk.accel, walk.count, config))
        poses = [part[: len(sequence.time)] for part in poses]
        healthy = (np.asarray(estimates.healthy)[: walk.count] > 0).all()
        if not healthy or not all(np.isfinite(part).all() for part in poses):
            raise InputError(sequence.name, "the filter fails on it", "leave out the walk")
        return poses

    def at_taps(values: np.ndarray) -> np.ndarray:
        """Horizontal positions or velocities at the taps, from those at the samples."""
        return interpolate(taps.time, sequence.time, values[:, :2])

    # The path without the waypoints, aligned with them.
    level = _level_start(sequence, ekf)
    _, history = _odometry(predict, ekf, level, *walk[:2], walk.imu_valid)
    _, _, position = poses_of(history)
    turn, origin, weight, speed_error = _align(at_taps(position), taps, place_std, config)
    yaw = np.arctan2(turn[1, 0], turn[0, 0])
    displacement, covariance = _displacements(history, speed_error, walk.count, config)
    if not finite_rows(displacement).any():
        problem = f"has no {config.window * config.dt:g} s that were measured without a gap"
        raise InputError(sequence.name, problem, "leave out the walk")

    unscaled = {"measurement_scale": 1.0, "std_factor": (1.0, 1.0, 1.0)}
    noise = ekf.noise._replace(**unscaled, correlation=CORRELATION)
    ekf = dataclasses.replace(ekf, noise=noise, start=_start_std(sequence, ekf, level))
    options = walk.imu_valid, config.displacement_frame
    for _ in range(PASSES):
        rotation, position = rotation_z(yaw) @ level.rotation, np.append(origin, 0.0)
        start = initial_state(ekf, rotation, np.zeros(3), position, level.gyro_bias)
        fixes = _fixes(sequence, taps, weight, place_std, time_std, walk, config)
        smoothed = _smooth(ekf, start, *walk[:2], displacement, covariance, *options, (fixes,))
        rotation, velocity, position = poses_of(smoothed)
        error, travel = taps.position - at_taps(position), time_std * at_taps(velocity)
        spread = place_std**2 * np.eye(2) + travel[:, :, None] * travel[:, None]
        squares = np.einsum("fi,fij,fj->f", error, np.linalg.inv(spread), error)
        weight = (FREEDOM + 2) / (FREEDOM + squares)
        turn, origin = rotation[0] @ np.asarray(level.rotation).T, position[0, :2]
        yaw = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])

    smoothed = jax.tree.map(lambda rows: np.asarray(rows)[: walk.count], smoothed)
    smoothed = _without_yaw_prior(smoothed, ekf.start.yaw)
    _check_result(sequence.name, smoothed, weight)
    poses = sequence._replace(
        orientation=quaternion_from_matrix(rotation),
        position=position,
        velocity=velocity,
        valid=(sequence.time >= taps.time[0]) & (sequence.time <= taps.time[-1]),
        waypoints=None,
        attributes=sequence.attributes | {"reference": "waypoints, smoothed"},
    )
    return WaypointPoses(poses, smoothed, weight)


_odometry = jax.jit(run_odometry, static_argnames="predict")
_smooth = jax.jit(smooth, static_argnames="frame")
_planar_alignment = jax.jit(geometry.planar_alignment)


# The walk and its start
# ------------------------------------------------------------------------------------------------


def _checked_waypoints(sequence: Sequence, config: FilterConfig) -> Waypoints:
    """The waypoints of a sequence that can have poses. Raises `InputError`."""
    waypoints, name, remedy = sequence.waypoints, sequence.name, "repair or leave out the walk"
    least, rate = max(round(START_SECONDS / config.dt), config.samples_per_clone), 1 / config.dt
    if waypoints is None:
        raise InputError(name, "has no waypoints", "leave out the walk")
    if len(sequence.time) < least:
        problem = f"has {len(sequence.time)} samples, at least {least} are needed"
        raise InputError(name, problem, "leave out the walk")
    steps = np.diff(sequence.time) * rate
    if not np.abs(steps - 1).max() < 1e-3:
        problem = (
            f"its stamps are not uniform at {rate:.4g} Hz (median {rate / np.median(steps):.4g})"
        )
        raise InputError(name, problem, "resample it")
    for field in ("gyro", "accel"):
        finite = finite_rows(getattr(sequence, field))
        if not finite.all():
            problem = f"field '{field}' is not finite in {(~finite).sum()} rows"
            raise InputError(name, f"{problem}, first in row {np.argmin(finite) + 1}", remedy)
    if len(sequence.measured_rows) < least:
        problem = f"{len(sequence.measured_rows)} of its samples were measured"
        raise InputError(name, f"{problem}, at least {least} are needed", "leave out the walk")
    # A tap near the first or the last stamp of the phone may lie outside of the uniform clock.
    if problem := waypoints.problem(sequence.time, config.clone_seconds, FEWEST_WAYPOINTS):
        raise InputError(name, f"field 'waypoints' {problem}", remedy)
    return waypoints


class _Walk(NamedTuple):
    """The IMU of a walk, filled up to a length for which programs are compiled."""

    gyro: Float[np.ndarray, "n 3"]
    accel: Float[np.ndarray, "n 3"]
    imu_valid: Bool[np.ndarray, "n"] | None
    count: int
    """Number of clone intervals that the walk fills."""


def _filled_walk(sequence: Sequence, config: FilterConfig) -> _Walk:
    """The samples of the walk, and after them samples of a turn, which is no rest."""
    n, samples = config.samples_per_clone, len(sequence.time)
    rows = n * math.ceil(LONGER ** math.ceil(math.log(-(-samples // n), LONGER)))
    (gyro,), (accel,) = padded_signals([(sequence.gyro, sequence.accel)], rows)
    gyro[samples:] = 1.0  # rad/s
    masks = padded_masks([sequence.imu_valid], rows)
    return _Walk(gyro, accel, None if masks is None else masks[0], samples // n)


def _level_start(sequence: Sequence, ekf: Filter) -> FilterState:
    """The level start from the first second that was measured. Raises `InputError` if it shows no
    gravity."""
    measured, count = sequence.measured_rows, round(START_SECONDS / ekf.config.dt)
    rows = measured[measured < count]
    if 2 * len(rows) < count:  # most of it was not measured
        rows = measured[:count]
    signals = sequence.gyro[rows], sequence.accel[rows]
    try:
        return level_state(ekf, *signals)
    except NoGravity as error:  # a wrong argument is no fault of the walk
        problem = f"has no level start: {error}"
        raise InputError(sequence.name, problem, "repair or leave out the walk") from None


def _start_std(sequence: Sequence, ekf: Filter, level: FilterState) -> InitialStd:
    """Standard deviations of the aligned start."""
    std = ekf.start._replace(**START_STD)
    raw = sequence.attributes.get("imu_compensated") == "no" and not level.gyro_bias.any()
    if raw and ekf.raw_gyro_bias is not None:
        std = std._replace(gyro_bias=ekf.raw_gyro_bias)
    return std


# What the taps say of the path, and the path of the taps
# ------------------------------------------------------------------------------------------------


def _align(
    path: Float[np.ndarray, "f 2"], taps: Waypoints, least: float, config: FilterConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """The rotation and shift that align a path with the waypoints, the weights of the waypoints,
    and the median error of the path over the legs between them, m/s.

    The weights are Cauchy's. Their scale is a distance that half of the waypoints and one more do
    not exceed, or `least` m if that is larger. A leg that is shorter than a window counts as if it
    took as long as one, because it shows no speed.
    """
    weight = np.ones(len(path))
    for _ in range(10):
        turn, shift = jax.device_get(_planar_alignment(path, taps.position, weight))
        error = path @ turn.T + shift - taps.position
        distance = np.linalg.norm(error, axis=1)
        # Two waypoints can always be fitted, so the median would make outliers of some of a few.
        scale = np.sort(distance)[(len(path) + 1) // 2]
        weight = 1 / (1 + (distance / max(scale, least)) ** 2)
    seconds = np.maximum(np.diff(taps.time), config.window * config.dt)
    leg_error = np.linalg.norm(np.diff(error, axis=0), axis=1) / seconds
    return turn, shift, weight, float(np.median(leg_error))


def _displacements(
    history: FilterHistory, speed_error: float, count: int, config: FilterConfig
) -> tuple[np.ndarray, np.ndarray]:
    """The displacements of the intervals that the walk fills, and their covariances with the
    factors of the noise and with the error of the path, m/s."""
    whole = np.arange(len(history.displacement)) < count
    displacement = np.where(whole[:, None], history.displacement, np.nan)
    error = speed_error * config.window * config.dt
    added = np.diag([error, error, 0.0]) ** 2
    return displacement, np.asarray(history.measurement_covariance) + added[None]


def _fixes(
    sequence: Sequence,
    taps: Waypoints,
    weight: Float[np.ndarray, "f"],
    place_std: float,
    time_std: float,
    walk: _Walk,
    config: FilterConfig,
) -> Fix:
    """The taps as fixes in the rows of the intervals that the walk fills, with their weights. No
    test refuses one, because the covariance of the filter does not contain the errors of the
    path."""
    fixes = fixes_on_intervals(
        np.clip(taps.time, sequence.time[0], sequence.time[-1]),
        taps.position,
        (place_std**2 / weight)[:, None, None] * np.eye(2),
        walk.count,
        config,
        sequence.time[0],
        time_std / np.sqrt(weight),
        math.inf,
    )
    rows = len(walk.gyro) // config.samples_per_clone
    filled = Fix(*(filled_up(part, rows) for part in fixes))
    filled.position[walk.count :] = np.nan
    return filled


def _without_yaw_prior(smoothed: SmoothedHistory, yaw_std: float) -> SmoothedHistory:
    """The smoothed estimates with the covariances that they have without a prior of the yaw, whose
    standard deviation was `yaw_std`, rad.

    The gyro carries the yaw through the walk, so its variance p at the best known time is that of
    the walk, and without the prior it is 1 / (1 / p − 1 / yaw_std²), at most that of an angle of
    which nothing is known. Each error contains the yaw's by its regression on it.
    """
    assert smoothed.covariance is not None
    covariance = smoothed.covariance
    variance = covariance[:, THETA.stop - 1, THETA.stop - 1]
    least = variance.min()
    growth = 1 / max(1 / least - 1 / yaw_std**2, 3 / np.pi**2) - least
    regression = covariance[:, THETA.stop - 1] / variance[:, None]
    covariance = covariance + growth * regression[:, :, None] * regression[:, None]
    diagonal = np.diagonal(covariance, axis1=1, axis2=2)
    return smoothed._replace(covariance=covariance, covariance_diagonal=diagonal)


def _check_result(name: str, smoothed: SmoothedHistory, weight: np.ndarray) -> None:
    """Refuse smoothed estimates whose yaw the waypoints do not show, or with which most of them do
    not agree. Raises `InputError`."""
    yaw_std = np.sqrt(smoothed.covariance_diagonal[:, THETA.stop - 1].min())
    if not yaw_std <= MOST_YAW_STD:
        problem = f"its waypoints show its yaw to {np.degrees(yaw_std):.0f}° only"
        remedy = "add waypoints that are farther from each other, or leave out the walk"
        raise InputError(name, problem, remedy)
    distant = int((weight < LEAST_WEIGHT).sum())
    if 2 * distant > len(weight):
        problem = f"{distant} of its {len(weight)} waypoints are far from the smoothed path"
        remedy = "check that they are of this walk and on its clock, or leave out the walk"
        raise InputError(name, problem, remedy)


# Poses at every sample
# ------------------------------------------------------------------------------------------------


@functools.partial(jax.jit, static_argnames="config")
def _between_clones(
    ends: Mean, gyro: Array, accel: Array, count: Array | int, config: FilterConfig
) -> tuple[Array, Array, Array]:
    """Rotation, velocity and position at the stamp of every sample, from the estimates at the ends
    of the clone intervals.

    The IMU is integrated from the estimate before an interval. The difference from the estimate at
    the end is distributed over the interval: the rotation evenly, the position by the cubic that
    also corrects the velocity. From the end of the first `count` intervals on the IMU alone is
    integrated.
    """
    n, dt, seconds = config.samples_per_clone, config.dt, config.clone_seconds

    def integrate(rotation: Array, velocity: Array, position: Array, gyro: Array, accel: Array):
        """At the n stamps of an interval, and at its end."""
        rotations = geometry.integrate_turns(rotation, gyro * dt)
        force = jnp.einsum("ijn,nj->ni", rotations[:, :, :-1], accel)
        steps = (force - jnp.array([[0.0, 0.0, GRAVITY]])) * dt
        velocities = velocity[None] + jnp.cumsum(jnp.pad(steps, ((1, 0), (0, 0))), axis=0)
        moves = (velocities[:-1] + 0.5 * steps) * dt
        positions = position[None] + jnp.cumsum(jnp.pad(moves, ((1, 0), (0, 0))), axis=0)
        return jnp.moveaxis(rotations, 2, 0), velocities, positions

    def interval(
        before: tuple[Array, Array, Array], end: Mean, imu: tuple[Array, Array], whole: Array
    ) -> tuple[Array, Array, Array]:
        rotation, velocity, position = integrate(*before, *imu)
        turn = end.rotation @ rotation[-1].T
        skew = turn - turn.T
        angle = 0.5 * jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
        jumps = angle, end.velocity - velocity[-1], end.position - position[-1]
        angle, speed, shift = (jnp.where(whole, jump, 0.0)[None] for jump in jumps)
        s = (jnp.arange(n) / n)[:, None]
        turns = jax.vmap(geometry.exp)(s * angle)
        by_velocity = shift / seconds * 6 * s * (1 - s) + speed * s * (3 * s - 2)
        by_position = shift * s**2 * (3 - 2 * s) + speed * seconds * s**2 * (s - 1)
        return turns @ rotation[:-1], velocity[:-1] + by_velocity, position[:-1] + by_position

    signals = (gyro, ends.gyro_bias), (accel, ends.accel_bias)
    imu = tuple(signal.reshape(-1, n, 3) - bias[:, None] for signal, bias in signals)
    # The first interval is integrated backwards from its end.
    first, first_imu = jax.tree.map(lambda rows: rows[0], (ends, imu))
    zero = jnp.zeros(3)
    turns, _, _ = integrate(jnp.eye(3), zero, zero, *first_imu)
    rotation = first.rotation @ turns[-1].T
    _, gains, moves = integrate(rotation, zero, zero, *first_imu)
    velocity = first.velocity - gains[-1]
    start = rotation, velocity, first.position - velocity * seconds - moves[-1]
    before = tuple(
        jnp.concatenate([row[None], rows[:-1]]) for row, rows in zip(start, ends[:3], strict=True)
    )
    rows = jax.vmap(interval)(before, ends, imu, jnp.arange(len(imu[0])) < count)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
