"""Simulated walks with a known truth, for the demo and the tests.

The motion of the phone is that of `walker.draw_motion`. Sample k of the IMU is the mean over its
interval, gyro_k = log(R_kᵀ R_{k+1}) / dt and accel_k = R_kᵀ ((v_{k+1} − v_k) / dt − g), so that
integrating the noise-free IMU sample by sample returns the trajectory.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.simulated.walker import (
    CARRYING,
    PhoneMotion,
    draw_motion,
    wander,
)
from gnio_jax.numerics import about_z, quaternions, turns_between
from gnio_jax.types import GRAVITY, Sequence


class SensorErrors(NamedTuple):
    """White noise and random walk of an IMU as densities, and constant biases by their
    magnitude."""

    gyro_density: float
    """rad/s/√Hz."""
    accel_density: float
    """m/s²/√Hz."""
    gyro_bias_walk: float
    """rad/s/√s."""
    accel_bias_walk: float
    """m/s²/√s."""
    gyro_bias: tuple[float, float]
    """Range of the magnitude of the gyro bias, rad/s."""
    accel_bias: tuple[float, float]
    """Range of the magnitude of the accelerometer bias, m/s²."""


PHONE = SensorErrors(
    gyro_density=9e-5,
    accel_density=1.5e-3,
    gyro_bias_walk=1e-6,
    accel_bias_walk=1e-4,
    gyro_bias=(1e-4, 4e-4),
    accel_bias=(0.05, 0.10),
)
"""A phone's IMU after a rest-period calibration of its gyro."""


def pedestrian(
    seed: int,
    person: int,
    placement: str = "handheld",
    seconds: float = 120.0,
    rate: float = 200.0,
    imu_errors: bool = True,
) -> Sequence:
    """A walk of person number `person`, for `seconds` at `rate` Hz. Everything except the gait is
    drawn from `seed`; the motion is the same at every rate.

    It starts with 3 s of standing. Without `imu_errors` the IMU has neither bias nor noise. The
    attributes include the true biases at the start.
    """
    rng = np.random.default_rng([seed])
    time, dt = np.arange(round(seconds * rate) + 1) / rate, 1.0 / rate
    motion = draw_motion(rng, placement, time, person)
    attributes = {"dataset": "synthetic", "placement": placement, "seed": seed}
    attributes |= {"subject": f"person {person}", "licence": SYNTHETIC.licence}
    return walk_sequence(
        rng, f"synthetic_{seed}_{placement}", motion, dt, PHONE, attributes, imu_errors
    )


def walk_sequence(
    rng: np.random.Generator,
    name: str,
    motion: PhoneMotion,
    dt: float,
    errors: SensorErrors,
    attributes: dict[str, object],
    imu_errors: bool = True,
) -> Sequence:
    """The sequence of a simulated walk. Errors of its IMU are always drawn. The true biases at the
    start are added to the attributes."""
    gyro = turns_between(motion.attitude) / dt
    force = np.diff(motion.velocity, axis=0) / dt + np.array([0.0, 0.0, GRAVITY])
    accel = motion.attitude[:-1].inv().apply(force)
    count = len(gyro)
    gyro_bias, gyro_error = _sensor_error(
        rng, count, dt, errors.gyro_bias, errors.gyro_density, errors.gyro_bias_walk
    )
    accel_bias, accel_error = _sensor_error(
        rng, count, dt, errors.accel_bias, errors.accel_density, errors.accel_bias_walk
    )
    device = device_attitude(rng, motion, dt)
    attributes = {"device": "simulated phone", "truth": "simulated", **attributes}
    attributes["gyro_density"] = errors.gyro_density * imu_errors
    attributes["accel_density"] = errors.accel_density * imu_errors
    for axis, letter in enumerate("xyz"):
        attributes[f"gyro_bias_{letter}"] = float(gyro_bias[axis] * imu_errors)
        attributes[f"accel_bias_{letter}"] = float(accel_bias[axis] * imu_errors)
    return Sequence(
        name=name,
        time=motion.time[:-1],
        gyro=gyro + gyro_error if imu_errors else gyro,
        accel=accel + accel_error if imu_errors else accel,
        orientation=quaternions(motion.attitude[:-1]),
        position=motion.position[:-1],
        velocity=motion.velocity[:-1],
        valid=np.ones(count, dtype=bool),
        device_orientation=quaternions(device),
        attributes=attributes,
    )


def _sensor_error(
    rng: np.random.Generator,
    count: int,
    dt: float,
    length: tuple[float, float],
    density: float,
    walk: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The constant bias (3,), and its sum with random walk and white noise (count, 3)."""
    direction = rng.standard_normal(3)
    bias = direction / np.linalg.norm(direction) * rng.uniform(*length)
    bias_drift = np.cumsum(rng.standard_normal((count, 3)), axis=0) * walk * np.sqrt(dt)
    return bias, bias + bias_drift + rng.standard_normal((count, 3)) * density / np.sqrt(dt)


def device_attitude(rng: np.random.Generator, motion: PhoneMotion, dt: float) -> Rotation:
    """The phone's own attitude: an arbitrary yaw that drifts by some degrees, and a tilt error of a
    degree."""
    count = len(motion.time) - 1
    drift = np.cumsum(rng.standard_normal(count)) * np.radians(0.4) * np.sqrt(dt)
    drift = drift + rng.uniform(-np.pi, np.pi)
    tilt = wander(rng, motion.time[:-1], 2, np.radians(0.7), 0.01, 0.05)
    tilt_error = np.concatenate([tilt, np.zeros((count, 1))], axis=1)
    return about_z(drift) * Rotation.from_rotvec(tilt_error) * motion.attitude[:-1]


# --- the dataset

# split: (first seed of its sequences, first person, number of people, number of sequences,
# seconds); no person is in two splits.
_SPLITS = {
    "train": (1000, 0, 12, 24, 120.0),
    "val": (2000, 100, 4, 4, 60.0),
    "test": (3000, 200, 6, 6, 120.0),
}


def _recordings(_: Path | None, split: str) -> list[RecordingSource]:
    """The walks, not yet computed."""
    seed, first_person, people, count, seconds = _SPLITS[split]
    placements, walks = list(CARRYING), []
    for index in range(count):
        person = first_person + index % people
        # The placement is shifted by one per round of people, so that nobody carries the phone in
        # one place only.
        placement = placements[(index + index // people) % len(placements)]
        compute = partial(_compute_one, pedestrian, seed + index, person, placement, seconds)
        walks.append(RecordingSource(f"synthetic_{seed + index}_{placement}", compute))
    return walks


def _compute_one(compute: Any, *arguments: Any) -> list[Sequence]:
    return [compute(*arguments)]


SYNTHETIC = Dataset(
    name="synthetic",
    recordings=_recordings,
    splits=tuple(_SPLITS),
    rate=200.0,
    source="computed by gnio_jax.data.simulated",
    layout="no files are needed",
    licence="Apache-2.0, as this package",
    needs_root=False,
)
