"""Poses for a walk with waypoints (ours): filter and smoother make a reference from positions that
are known at a few moments, e.g. because somebody tapped them on a map.

The world of the filter is level, and its yaw is 0 at the start; its rotation and shift relative to
the map are not known. So the filter first runs without the waypoints, and the rotation and shift
that align its path with them (`geometry.planar_alignment`) are applied to its start. From there,
with an uncertain yaw and position, the smoother takes the waypoints and the displacements of the
first run. A tap may be too early, too late or in the wrong place. So a waypoint far from the
smoothed path gets a larger covariance, with the weight of Student's t with `FREEDOM` degrees of
freedom, and the path is smoothed again from the start that was found.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.config import CorrelatedError
from gnio_jax.errors import InputError
from gnio_jax.filtering.batch import padded_masks, padded_signals
from gnio_jax.filtering.filter import Filter
from gnio_jax.filtering.fix import fixes_on_intervals
from gnio_jax.filtering.network import Predict
from gnio_jax.filtering.scan import run_odometry
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.smoother import SmoothedHistory, smooth
from gnio_jax.filtering.start import initial_state, level_state
from gnio_jax.filtering.state import Mean
from gnio_jax.numerics import interpolate, quaternion_from_matrix, rotation_z
from gnio_jax.types import GRAVITY, Array, Sequence, Waypoints

PLACE_STD, TIME_STD = 0.3, 0.4
"""Standard deviations of the place, m, and of the time, s, of a tap."""
START_STD = {"tilt": 0.1, "yaw": 0.2, "velocity": 1.0, "position": 10.0, "gyro_bias": 2e-3}
"""Standard deviations of the aligned start: rad, rad, m/s, m, rad/s. With a yaw of 0.5 rad the
filter, which gains no yaw from displacements, swings about the path until fixes show it, and
smoothing is linearised there: on simulated walks with 5 to 13 taps displacements over a second err
by 0.10 to 0.22 m instead of 0.08 to 0.13 m."""
CORRELATION = CorrelatedError(share=0.95, seconds=5.0)
"""Temporal correlation of the displacements' errors: a network overestimates or underestimates a
walker's speed leg by leg. Their standard deviation is the error of the first path over the legs,
added to the network's own."""
FREEDOM, PASSES = 4.0, 4
"""Degrees of freedom of the weights, and number of smoothings."""
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
    """The same at the end of every clone interval, with covariances."""
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
        InputError: The sequence has another rate, is shorter than `START_SECONDS`, has fewer than
            two waypoints or one outside, or the filter fails.
    """
    config, noise = ekf.config, ekf.noise
    waypoints = _checked_waypoints(sequence, config)
    count = -(-len(sequence.time) // config.samples_per_clone)
    padded = math.ceil(LONGER ** math.ceil(math.log(count, LONGER)))
    samples = padded * config.samples_per_clone
    signals = [x[0] for x in padded_signals([(sequence.gyro, sequence.accel)], samples)]
    signals[0][len(sequence.time) :] = 1.0  # rad/s: no rest after the end affects it
    masks = padded_masks([sequence.imu_valid], samples)
    valid = None if masks is None else masks[0]
    time = np.clip(waypoints.time, sequence.time[0], sequence.time[-1])
    after, place = time - sequence.time[0], waypoints.position
    ends = config.clone_seconds * np.arange(1, padded + 1)

    def at_taps(rows: Array) -> np.ndarray:
        """Horizontal positions at the taps, from rows at the ends of intervals."""
        return interpolate(after, ends, np.asarray(rows)[:, :2])

    # The path without the waypoints, aligned with them.
    first = slice(_first(config))
    level = level_state(ekf, signals[0][first], signals[1][first])
    _, history = _odometry(predict, ekf, level, *signals, valid)
    covariance = history.measurement_covariance  # with the factors of `noise`
    displacement = jnp.where(jnp.arange(padded)[:, None] < count, history.displacement, jnp.nan)
    turn, origin, weight, missed = _aligned(at_taps(history.position), place, after, place_std)
    yaw = np.arctan2(turn[1, 0], turn[0, 0])

    # The error of the path over the legs, m/s, as a displacement of a window.
    short = missed * config.clones_per_window * config.clone_seconds
    covariance = covariance + jnp.diag(jnp.array([short, short, 0.0]) ** 2)[None]
    given_noise = {"measurement_scale": 1.0, "std_factor": (1.0, 1.0, 1.0)}
    noise = noise._replace(**given_noise, correlation=CORRELATION)
    rows = displacement, covariance, valid, config.displacement_frame
    std = ekf.start._replace(**START_STD)
    raw = sequence.attributes.get("imu_compensated") == "no" and not level.gyro_bias.any()
    if raw and ekf.raw_gyro_bias is not None:
        std = std._replace(gyro_bias=ekf.raw_gyro_bias)
    ekf = dataclasses.replace(ekf, noise=noise, start=std)
    for _ in range(PASSES):
        rotation, position = rotation_z(yaw) @ level.rotation, np.append(origin, 0.0)
        start = initial_state(ekf, rotation, np.zeros(3), position, level.gyro_bias)
        spread = (place_std**2 / weight)[:, None, None] * np.eye(2)
        late = {"time_std": time_std / np.sqrt(weight), "threshold": math.inf}
        fixes = fixes_on_intervals(after, place, spread, padded, config, **late)
        smoothed = _smooth(ekf, start, *signals, *rows, (fixes,))
        off, speed = place - at_taps(smoothed.position), time_std * at_taps(smoothed.velocity)
        spread = place_std**2 * np.eye(2) + speed[:, :, None] * speed[:, None]
        squares = np.einsum("fi,fij,fj->f", off, np.linalg.inv(spread), off)
        if not np.isfinite(squares).all():
            raise InputError(sequence.name, "the filter fails on it")
        weight = (FREEDOM + 2) / (FREEDOM + squares)
        poses = jax.device_get(_between_clones(smoothed, *signals, config=config))
        rotation, velocity, position = (each[: len(sequence.time)] for each in poses)
        turn, origin = rotation[0] @ np.asarray(level.rotation).T, position[0, :2]
        yaw = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    poses = sequence._replace(
        orientation=quaternion_from_matrix(rotation),
        position=position,
        velocity=velocity,
        valid=(sequence.time >= waypoints.time[0]) & (sequence.time <= waypoints.time[-1]),
        waypoints=None,
        attributes=sequence.attributes | {"reference": "waypoints, smoothed"},
    )
    smoothed = jax.tree.map(lambda rows: np.asarray(rows)[:count], smoothed)
    return WaypointPoses(poses, smoothed, weight)


def _first(config: FilterConfig) -> int:
    """Samples from which the level start is made."""
    return round(START_SECONDS / config.dt)


def _checked_waypoints(sequence: Sequence, config: FilterConfig) -> Waypoints:
    """The waypoints of a sequence that can have poses. Raises `InputError`."""
    waypoints, step = sequence.waypoints, float(np.median(np.diff(sequence.time)))
    if waypoints is None or len(waypoints.time) < 2:
        raise InputError(sequence.name, "has fewer than two waypoints")
    if len(sequence.time) < _first(config) or abs(step / config.dt - 1) > 1e-3:
        found = f"has {len(sequence.time)} samples at {1 / step:.4g} Hz"
        problem = f"{found}, at least {_first(config)} at {1 / config.dt:.4g} Hz are needed"
        raise InputError(sequence.name, problem, "resample it")
    # A tap near the first or the last stamp of the phone may be a sample outside of the uniform
    # clock.
    first, last = sequence.time[0] - config.dt, sequence.time[-1] + config.dt
    if waypoints.time[0] < first or waypoints.time[-1] > last:
        raise InputError(sequence.name, "has waypoints before its start or after its end")
    return waypoints


_odometry = jax.jit(run_odometry, static_argnames="predict")
_smooth = jax.jit(smooth, static_argnames="frame")
_planar_alignment = jax.jit(geometry.planar_alignment)


def _aligned(
    path: Float[np.ndarray, "f 2"],
    place: Float[np.ndarray, "f 2"],
    time: Float[np.ndarray, "f"],
    least: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """The rotation and shift that align a path with the waypoints, the weights of the waypoints
    (Cauchy's, with the median distance as the scale, or `least` m if that is larger), and the
    median error of the path over the legs between them, m/s."""
    weight = np.ones(len(place))
    for _ in range(10):
        turn, shift = jax.device_get(_planar_alignment(path, place, weight))
        off = path @ turn.T + shift - place
        size = np.linalg.norm(off, axis=1)
        weight = 1 / (1 + (size / max(np.median(size), least)) ** 2)
    missed = np.linalg.norm(np.diff(off, axis=0), axis=1) / np.diff(time)
    return turn, shift, weight, float(np.median(missed))


@functools.partial(jax.jit, static_argnames="config")
def _between_clones(
    smoothed: SmoothedHistory, gyro: Array, accel: Array, config: FilterConfig
) -> tuple[Array, Array, Array]:
    """Rotation, velocity and position at the stamp of every sample.

    The IMU is integrated from the smoothed pose before an interval. The difference from the
    smoothed pose at the end is distributed over the interval: the rotation evenly, the position by
    the cubic that also corrects the velocity.
    """
    n, dt, seconds = config.samples_per_clone, config.dt, config.clone_seconds
    ends = Mean(*(getattr(smoothed, name) for name in Mean._fields))

    def integrated(rotation: Array, velocity: Array, position: Array, gyro: Array, accel: Array):
        """At the n stamps of an interval, and at its end."""
        rotations = geometry.integrate_turns(rotation, gyro * dt)
        force = jnp.einsum("ijn,nj->ni", rotations[:, :, :-1], accel)
        steps = (force - jnp.array([[0.0, 0.0, GRAVITY]])) * dt
        velocities = velocity[None] + jnp.cumsum(jnp.pad(steps, ((1, 0), (0, 0))), axis=0)
        moved = (velocities[:-1] + 0.5 * steps) * dt
        positions = position[None] + jnp.cumsum(jnp.pad(moved, ((1, 0), (0, 0))), axis=0)
        return jnp.moveaxis(rotations, 2, 0), velocities, positions

    def interval(
        before: tuple[Array, Array, Array], end: Mean, imu: tuple[Array, Array]
    ) -> tuple[Array, Array, Array]:
        rotation, velocity, position = integrated(*before, *imu)
        missed = end.rotation @ rotation[-1].T
        angle = 0.5 * jnp.stack([(missed - missed.T)[place] for place in ((2, 1), (0, 2), (1, 0))])
        speed = (end.velocity - velocity[-1])[None]
        place = (end.position - position[-1])[None]
        s = (jnp.arange(n) / n)[:, None]
        turns = jax.vmap(geometry.exp)(s * angle[None])
        by_velocity = place / seconds * 6 * s * (1 - s) + speed * s * (3 * s - 2)
        by_position = place * s**2 * (3 - 2 * s) + speed * seconds * s**2 * (s - 1)
        return turns @ rotation[:-1], velocity[:-1] + by_velocity, position[:-1] + by_position

    signals = (gyro, ends.gyro_bias), (accel, ends.accel_bias)
    imu = tuple(signal.reshape(-1, n, 3) - bias[:, None] for signal, bias in signals)
    # The first interval is integrated backwards from its end.
    first, of_first = jax.tree.map(lambda rows: rows[0], (ends, imu))
    nothing = jnp.zeros(3)
    turned, _, _ = integrated(jnp.eye(3), nothing, nothing, *of_first)
    rotation = first.rotation @ turned[-1].T
    _, gained, moved = integrated(rotation, nothing, nothing, *of_first)
    velocity = first.velocity - gained[-1]
    start = rotation, velocity, first.position - velocity * seconds - moved[-1]
    before = tuple(
        jnp.concatenate([row[None], rows[:-1]]) for row, rows in zip(start, ends[:3], strict=True)
    )
    rows = jax.vmap(interval)(before, ends, imu)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
