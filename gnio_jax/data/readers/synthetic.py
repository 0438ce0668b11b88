"""Pedestrians that are computed, not recorded: the demo and the tests need no file, and every
figure has a known truth.

A walk is a plan and a gait (`gait`) and a phone that hangs on the walker somewhere. The heading of
the phone says nothing about the direction of travel: its mounting is drawn per sequence.

Position, velocity and attitude are values and derivatives of one spline. Sample k of the IMU is the
mean over the interval it drives, gyro_k = log(R_kᵀ R_{k+1}) / dt and accel_k = R_kᵀ ((v_{k+1} −
v_k) / dt − g), so that integrating the noise-free IMU sample by sample returns the trajectory.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.readers.gait import (
    PLACEMENTS,
    Person,
    Placement,
    gait,
    integral,
    person,
    plan,
    step_frequency,
    wander,
)
from gnio_jax.numerics import about_z, quaternions, turns_between
from gnio_jax.types import GRAVITY, Sequence

# A phone's IMU: white noise and random walk as densities, constant biases by their length.
GYRO_DENSITY = 9e-5
"""rad/s/√Hz."""
ACCEL_DENSITY = 1.5e-3
"""m/s²/√Hz."""
GYRO_BIAS_WALK = 1e-6
"""rad/s/√s."""
ACCEL_BIAS_WALK = 1e-4
"""m/s²/√s."""
GYRO_BIAS = (1e-4, 4e-4)
"""Range of the length of the gyro bias, rad/s: what is left after a rest-period calibration."""
ACCEL_BIAS = (0.05, 0.10)
"""Range of the length of the accelerometer bias, m/s²."""

# split: (first seed of its sequences, first person, number of people, number of sequences,
# seconds); no person is in two splits.
_SPLITS = {
    "train": (1000, 0, 12, 24, 120.0),
    "val": (2000, 100, 4, 4, 60.0),
    "test": (3000, 200, 6, 6, 120.0),
}


def pedestrian(
    seed: int,
    walker: Person,
    placement: str = "handheld",
    seconds: float = 120.0,
    rate: float = 200.0,
    imu_errors: bool = True,
) -> Sequence:
    """A walk of `seconds` at `rate` Hz with everything but the walker drawn from `seed`; starts
    with 3 s of standing.

    Without `imu_errors` the IMU has neither bias nor noise. The true biases, at the start, are
    among the attributes.
    """
    rng = np.random.default_rng([seed])
    count = round(seconds * rate)
    walk = _motion(rng, walker, PLACEMENTS[placement], count, 1.0 / rate)
    imu = _imu(rng, walk, 1.0 / rate, imu_errors)
    device = _device_attitude(rng, walk, 1.0 / rate)
    attributes = {
        "dataset": "synthetic",
        "device": "simulated phone",
        "placement": placement,
        "truth": "simulated",
        "seed": seed,
        "licence": DATASET.licence,
        "gyro_density": GYRO_DENSITY * imu_errors,
        "accel_density": ACCEL_DENSITY * imu_errors,
    }
    for axis, letter in enumerate("xyz"):
        attributes[f"gyro_bias_{letter}"] = float(imu.gyro_bias[axis])
        attributes[f"accel_bias_{letter}"] = float(imu.accel_bias[axis])
    return Sequence(
        name=_name(placement, seed),
        time=walk.time[:-1],
        gyro=imu.gyro,
        accel=imu.accel,
        orientation=quaternions(walk.attitude[:-1]),
        position=walk.position[:-1],
        velocity=walk.velocity[:-1],
        valid=np.ones(count, dtype=bool),
        device_orientation=quaternions(device),
        attributes=attributes,
    )


class _Motion(NamedTuple):
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


def _motion(
    rng: np.random.Generator, walker: Person, carried: Placement, count: int, dt: float
) -> _Motion:
    time = np.arange(count + 1) * dt
    planned = plan(rng, time, dt)
    speed, heading, rise = planned
    steps = integral(time, step_frequency(speed, walker.cadence))
    phase = 2.0 * np.pi * steps + rng.uniform(0.0, 2.0 * np.pi)
    offset, swing = gait(rng, walker, carried, time, planned, phase)
    course = np.stack([speed * np.cos(heading), speed * np.sin(heading), speed * rise], axis=1)
    turn = about_z(heading)
    path = make_interp_spline(time, integral(time, course) + turn.apply(offset), k=5)
    position, velocity = path(time), path.derivative()(time)

    # The mounting's yaw is anything: where the phone points is no hint of where its owner goes.
    yaw, pitch = rng.uniform(-np.pi, np.pi), rng.uniform(*carried.tilt)
    mounting = Rotation.from_euler("ZXY", [yaw, pitch, carried.roll * rng.standard_normal()])
    attitude = turn * Rotation.from_rotvec(swing) * mounting
    return _Motion(time, position - position[0], velocity, attitude)


class _Imu(NamedTuple):
    """Samples of the phone's IMU, and the biases at their start."""

    gyro: Float[np.ndarray, "n 3"]
    """rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """m/s²."""
    gyro_bias: Float[np.ndarray, "3"]
    accel_bias: Float[np.ndarray, "3"]


def _imu(rng: np.random.Generator, walk: _Motion, dt: float, errors: bool) -> _Imu:
    """The IMU of a walk, with or without errors. These are drawn in any case, so that a seed is the
    same walk with and without."""
    gyro = turns_between(walk.attitude) / dt
    force = np.diff(walk.velocity, axis=0) / dt + np.array([0.0, 0.0, GRAVITY])
    accel = walk.attitude[:-1].inv().apply(force)
    count = len(gyro)
    gyro_bias, gyro_error = _sensor_error(rng, count, dt, GYRO_BIAS, GYRO_DENSITY, GYRO_BIAS_WALK)
    accel_bias, accel_error = _sensor_error(
        rng, count, dt, ACCEL_BIAS, ACCEL_DENSITY, ACCEL_BIAS_WALK
    )
    if not errors:
        return _Imu(gyro, accel, np.zeros(3), np.zeros(3))
    return _Imu(gyro + gyro_error, accel + accel_error, gyro_bias, accel_bias)


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


def _device_attitude(rng: np.random.Generator, walk: _Motion, dt: float) -> Rotation:
    """The phone's own estimate: a yaw from anywhere that drifts by some degrees, a degree of tilt
    error."""
    count = len(walk.time) - 1
    drift = np.cumsum(rng.standard_normal(count)) * np.radians(0.4) * np.sqrt(dt)
    drift = drift + rng.uniform(-np.pi, np.pi)
    tilt = wander(rng, walk.time[:-1], 2, np.radians(0.7), 0.01, 0.05)
    tilt_error = np.concatenate([tilt, np.zeros((count, 1))], axis=1)
    return about_z(drift) * Rotation.from_rotvec(tilt_error) * walk.attitude[:-1]


def recordings(root: Path | None, split: str) -> list[Recording]:
    """The walks of a split, not yet computed."""
    del root
    seed, first_person, people, count, seconds = _SPLITS[split]
    placements = list(PLACEMENTS)
    walks = []
    for index in range(count):
        who = first_person + index % people
        # Shifted by one per round of people, so that nobody carries the phone in one place only.
        where = placements[(index + index // people) % len(placements)]
        walks.append(single(_name(where, seed + index), _walk, seed + index, who, where, seconds))
    return walks


def _name(placement: str, seed: int) -> str:
    return f"synthetic_{seed}_{placement}"


def _walk(seed: int, who: int, where: str, seconds: float) -> Sequence:
    sequence = pedestrian(seed, person(who), where, seconds)
    return sequence._replace(attributes={**sequence.attributes, "subject": f"person {who}"})


DATASET = Dataset(
    name="synthetic",
    recordings=recordings,
    splits=tuple(_SPLITS),
    rate=200.0,
    source="computed by gnio_jax.data.readers.synthetic",
    layout="no files are needed",
    licence="Apache-2.0, as this package",
    needs_root=False,
)
