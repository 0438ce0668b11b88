"""A phone that is moved along a known path: its exact motion, the samples of its IMU and the
attitude that the phone itself would report. What the simulated pedestrians share.

Position, velocity and attitude are values and derivatives of one spline. Sample k of the IMU is the
mean over the interval it drives, gyro_k = log(R_kᵀ R_{k+1}) / dt and accel_k = R_kᵀ ((v_{k+1} −
v_k) / dt − g), so that integrating the noise-free IMU sample by sample returns the trajectory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from gnio_jax.data.readers.gait import Plan, integral, wander
from gnio_jax.numerics import about_z, quaternions, turns_between
from gnio_jax.types import GRAVITY, Sequence


class SensorErrors(NamedTuple):
    """White noise and random walk of an IMU as densities, constant biases by their length."""

    gyro_density: float
    """rad/s/√Hz."""
    accel_density: float
    """m/s²/√Hz."""
    gyro_bias_walk: float
    """rad/s/√s."""
    accel_bias_walk: float
    """m/s²/√s."""
    gyro_bias: tuple[float, float]
    """Range of the length of the gyro bias, rad/s."""
    accel_bias: tuple[float, float]
    """Range of the length of the accelerometer bias, m/s²."""


class Motion(NamedTuple):
    """True motion of the phone; one more pose than samples, since the last one drives an interval,
    too."""

    time: Float[np.ndarray, " n"]
    """s."""
    position: Float[np.ndarray, "n 3"]
    """m, from the first pose."""
    velocity: Float[np.ndarray, "n 3"]
    """m/s."""
    attitude: Rotation
    """Phone → world."""


def motion(
    time: Float[np.ndarray, " n"],
    planned: Plan,
    offset: Float[np.ndarray, "n 3"],
    swing: Float[np.ndarray, "n 3"],
    mounting: Rotation,
) -> Motion:
    """The motion of a phone on a person who walks as planned. `offset` (m) and `swing` (rotation
    vector) are the phone's against the steadily moving walker: forward, left, up. `mounting` turns
    from the phone to that frame."""
    speed, heading, rise = planned
    course = np.stack([speed * np.cos(heading), speed * np.sin(heading), speed * rise], axis=1)
    turn = about_z(heading)
    path = make_interp_spline(time, integral(time, course) + turn.apply(offset), k=5)
    position, velocity = path(time), path.derivative()(time)
    attitude = turn * Rotation.from_rotvec(swing) * mounting
    return Motion(time, position - position[0], velocity, attitude)


class Imu(NamedTuple):
    """Samples of the phone's IMU, and the biases at their start."""

    gyro: Float[np.ndarray, "n 3"]
    """rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """m/s²."""
    gyro_bias: Float[np.ndarray, "3"]
    accel_bias: Float[np.ndarray, "3"]


def imu(
    rng: np.random.Generator, walk: Motion, dt: float, errors: SensorErrors, with_errors: bool
) -> Imu:
    """The IMU of a walk, with or without errors. These are drawn in any case, so that a seed is the
    same walk with and without."""
    gyro = turns_between(walk.attitude) / dt
    force = np.diff(walk.velocity, axis=0) / dt + np.array([0.0, 0.0, GRAVITY])
    accel = walk.attitude[:-1].inv().apply(force)
    count = len(gyro)
    gyro_bias, gyro_error = _sensor_error(
        rng, count, dt, errors.gyro_bias, errors.gyro_density, errors.gyro_bias_walk
    )
    accel_bias, accel_error = _sensor_error(
        rng, count, dt, errors.accel_bias, errors.accel_density, errors.accel_bias_walk
    )
    if not with_errors:
        return Imu(gyro, accel, np.zeros(3), np.zeros(3))
    return Imu(gyro + gyro_error, accel + accel_error, gyro_bias, accel_bias)


def _sensor_error(
    rng: np.random.Generator,
    count: int,
    dt: float,
    length: tuple[float, float],
    density: float,
    walk: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(constant bias (3,), its sum with random walk and white noise (count, 3))."""
    direction = rng.standard_normal(3)
    bias = direction / np.linalg.norm(direction) * rng.uniform(*length)
    walked = np.cumsum(rng.standard_normal((count, 3)), axis=0) * walk * np.sqrt(dt)
    return bias, bias + walked + rng.standard_normal((count, 3)) * density / np.sqrt(dt)


def device_attitude(rng: np.random.Generator, walk: Motion, dt: float) -> Rotation:
    """The phone's own estimate: a yaw from anywhere that drifts by some degrees, a degree of tilt
    error."""
    count = len(walk.time) - 1
    drift = np.cumsum(rng.standard_normal(count)) * np.radians(0.4) * np.sqrt(dt)
    drift = drift + rng.uniform(-np.pi, np.pi)
    tilt = wander(rng, walk.time[:-1], 2, np.radians(0.7), 0.01, 0.05)
    tilt_error = np.concatenate([tilt, np.zeros((count, 1))], axis=1)
    return about_z(drift) * Rotation.from_rotvec(tilt_error) * walk.attitude[:-1]


def phone_sequence(
    name: str, walk: Motion, samples: Imu, device: Rotation, attributes: dict[str, object]
) -> Sequence:
    """The sequence of a simulated walk; the true biases at the start join its attributes."""
    attributes = {
        "device": "simulated phone",
        "truth": "simulated",
        **attributes,
    }
    for axis, letter in enumerate("xyz"):
        attributes[f"gyro_bias_{letter}"] = float(samples.gyro_bias[axis])
        attributes[f"accel_bias_{letter}"] = float(samples.accel_bias[axis])
    return Sequence(
        name=name,
        time=walk.time[:-1],
        gyro=samples.gyro,
        accel=samples.accel,
        orientation=quaternions(walk.attitude[:-1]),
        position=walk.position[:-1],
        velocity=walk.velocity[:-1],
        valid=np.ones(len(samples.gyro), dtype=bool),
        device_orientation=quaternions(device),
        attributes=attributes,
    )
