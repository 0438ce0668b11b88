"""Pedestrians that are computed, not recorded: the demo and the tests need no file, and every
figure has a known truth.

A walk is a plan and a gait (`gait`) and a phone that hangs on the walker somewhere
(`simulated_phone`). The heading of the phone says nothing about the direction of travel: its
mounting is drawn per sequence.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
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
)
from gnio_jax.data.readers.simulated_phone import (
    Motion,
    SensorErrors,
    device_attitude,
    imu,
    motion,
    phone_sequence,
)
from gnio_jax.types import Sequence

PHONE = SensorErrors(
    gyro_density=9e-5,
    accel_density=1.5e-3,
    gyro_bias_walk=1e-6,
    accel_bias_walk=1e-4,
    gyro_bias=(1e-4, 4e-4),
    accel_bias=(0.05, 0.10),
)
"""A phone's IMU after a rest-period calibration of its gyro."""

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
    count, dt = round(seconds * rate), 1.0 / rate
    walk = _motion(rng, walker, PLACEMENTS[placement], count, dt)
    samples = imu(rng, walk, dt, PHONE, imu_errors)
    device = device_attitude(rng, walk, dt)
    attributes = {
        "dataset": "synthetic",
        "placement": placement,
        "seed": seed,
        "licence": DATASET.licence,
        "gyro_density": PHONE.gyro_density * imu_errors,
        "accel_density": PHONE.accel_density * imu_errors,
    }
    return phone_sequence(_name(placement, seed), walk, samples, device, attributes)


def _motion(
    rng: np.random.Generator, walker: Person, carried: Placement, count: int, dt: float
) -> Motion:
    time = np.arange(count + 1) * dt
    planned = plan(rng, time, dt)
    steps = integral(time, step_frequency(planned.speed, walker.cadence))
    phase = 2.0 * np.pi * steps + rng.uniform(0.0, 2.0 * np.pi)
    offset, swing = gait(rng, walker, carried, time, planned, phase)
    # The mounting's yaw is anything: where the phone points is no hint of where its owner goes.
    yaw, pitch = rng.uniform(-np.pi, np.pi), rng.uniform(*carried.tilt)
    mounting = Rotation.from_euler("ZXY", [yaw, pitch, carried.roll * rng.standard_normal()])
    return motion(time, planned, offset, swing, mounting)


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
