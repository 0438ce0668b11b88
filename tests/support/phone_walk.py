"""A long walk of a phone with a magnetometer, a barometer and a receiver, and a network that knows
its pace but for some per cent.

The phone lies flat, its x axis ahead. The walk is an arc on which the heading turns slowly, up and
down a hill. The gyro has a bias that nobody has subtracted.
"""

from __future__ import annotations

import numpy as np
from flax import linen as nn
from jax import numpy as jnp

from gnio_jax.types import Prediction, Readings, Sequence

RATE, SECONDS, SPEED, TURN = 50.0, 240.0, 1.3, 0.02
GYRO_BIAS = np.array([0.0, 0.0, 0.01])
"""rad/s: 138° in the time of the walk."""
NORTHWARD = 0.9
"""Angle from the world of the walk to one of east and north, rad."""
LATITUDE, LONGITUDE, ALTITUDE = 48.1, 11.6, 520.0
FIELD = np.array([16.0, 12.0, -43.0])
"""The earth's field in the world of the walk, µT."""
IRON = np.array([12.0, -7.0, 5.0])
"""The phone's own, µT."""


class Pace(nn.Module):
    """Says for each window that the phone moves ahead by 5 % less than it does."""

    @nn.compact
    def __call__(self, windows, train=False):
        one = self.param("one", nn.initializers.ones, (1,), jnp.float32)
        ahead = jnp.array([0.95 * SPEED, 0.5 * TURN * SPEED, 0.0], jnp.float32)
        displacement = jnp.broadcast_to(one * ahead, (windows.shape[0], 3))
        return Prediction(displacement, jnp.full_like(displacement, jnp.log(0.1)), {})


def true_position(time):
    """(n, 3) position in the world of the walk, m."""
    radius, angle = SPEED / TURN, TURN * time
    height = 3.0 * (1 - np.cos(2 * np.pi * time / 160.0))
    return np.stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), height], axis=1)


def on_map(time):
    """(n, 3) metres east, north and up of the start."""
    cosine, sine = np.cos(NORTHWARD), np.sin(NORTHWARD)
    x, y, z = true_position(time).T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)


def degrees(position):
    """Latitude, longitude and altitude of metres east, north and up, by the radii of curvature of
    WGS 84 there (m), to some centimetres in a kilometre."""
    along, across = 6371096.0 + 1126.0, 6390019.0
    square = 0.00669437999014 * np.sin(np.radians(LATITUDE)) ** 2
    along = 6378137.0 * (1 - 0.00669437999014) / (1 - square) ** 1.5
    across = 6378137.0 / np.sqrt(1 - square)
    east, north, up = position.T
    latitude = LATITUDE + np.degrees(north / along)
    longitude = LONGITUDE + np.degrees(east / (across * np.cos(np.radians(LATITUDE))))
    return np.stack([latitude, longitude, ALTITUDE + up], axis=1)


def wandering(random, count, step, std, seconds):
    """(count,) errors that last for some seconds, with a sample every `step` s."""
    decay = np.exp(-step / seconds)
    errors = std * random.normal(size=count)
    for k in range(1, count):
        errors[k] = decay * errors[k - 1] + np.sqrt(1 - decay**2) * errors[k]
    return errors


def magnetometer(random, time):
    yaw = TURN * time
    north = np.stack(
        [
            np.cos(yaw) * FIELD[0] + np.sin(yaw) * FIELD[1],
            np.cos(yaw) * FIELD[1] - np.sin(yaw) * FIELD[0],
            0 * time + FIELD[2],
        ],
        axis=1,
    )
    bent = np.stack([wandering(random, len(time), 0.02, 2.0, 4.0) for _ in range(3)], axis=1)
    return north + IRON + bent


def pressure(random, time):
    """Of the standard atmosphere at the height, with the weather's drift, Pa."""
    height = ALTITUDE + true_position(time)[:, 2]
    noise = 3.0 * random.normal(size=len(time)) + 0.05 * time
    return 101325.0 * (1 - 0.0065 * height / 288.15) ** 5.25588 + noise


def fixes(random, time, std=4.0):
    """Places whose errors last for half a minute, as a phone's do."""
    error = [wandering(random, len(time), 1.0, std, 30.0) for _ in range(2)]
    error.append(wandering(random, len(time), 1.0, 2 * std, 60.0))
    return degrees(on_map(time) + np.stack(error, axis=1))


def walk(seed=0, seconds=SECONDS, **changes) -> Sequence:
    """The walk with its readings; `changes` replace or add those of a sensor."""
    random = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE)) / RATE
    gyro = np.tile([0.0, 0.0, TURN], (len(time), 1)) + GYRO_BIAS
    rise = 3.0 * (2 * np.pi / 160.0) ** 2 * np.cos(2 * np.pi * time / 160.0)
    gait = 2.0 * np.sin(4 * np.pi * time)
    accel = np.stack([0 * time, SPEED * TURN + 0 * time, 9.81 + rise + gait], axis=1)
    gyro += 1e-3 * random.normal(size=gyro.shape)
    accel += 0.02 * random.normal(size=accel.shape)
    often, slow = np.arange(0.01, seconds, 0.02), np.arange(0.3, seconds, 1.0)
    place_std = np.tile([4.0, 4.0, 8.0], (len(slow), 1))
    unknown = np.full((len(often), 3), np.nan)
    readings = {
        "magnetometer": Readings(often, magnetometer(random, often), unknown),
        "barometer": Readings(
            slow, pressure(random, slow)[:, None], np.full((len(slow), 1), np.nan)
        ),
        "gnss": Readings(slow, fixes(random, slow), place_std),
    } | changes
    nothing = np.full((len(time), 3), np.nan)
    return Sequence(
        "walk",
        time,
        gyro,
        accel,
        np.full((len(time), 4), np.nan),
        nothing,
        nothing,
        np.zeros(len(time), bool),
        readings={name: one for name, one in readings.items() if one is not None},
        attributes={"imu_compensated": "no", "start_time": 1.7e9},
    )
