"""A walk in a circle whose every field is known in closed form."""

import numpy as np

from gnio_jax.types import Sequence


def circle(rate=100.0, seconds=30.0, speed=1.2, turn=0.4, stamps=None) -> Sequence:
    """Walking a circle on the level, phone flat and x ahead, up and down by a gait of 2 Hz: every
    field in closed form."""
    time = np.arange(round(seconds * rate)) / rate if stamps is None else stamps
    yaw, radius = turn * time, speed / turn
    lift, omega = 0.02, 4 * np.pi
    position = np.stack(
        [radius * np.sin(yaw), -radius * np.cos(yaw), lift * np.sin(omega * time)], axis=1
    )
    velocity = np.stack(
        [speed * np.cos(yaw), speed * np.sin(yaw), lift * omega * np.cos(omega * time)], axis=1
    )
    accel = np.stack(
        [0 * time, speed * turn + 0 * time, 9.81 - lift * omega**2 * np.sin(omega * time)], axis=1
    )
    gyro = np.stack([0 * time, 0 * time, turn + 0 * time], axis=1)
    orientation = np.stack([np.cos(yaw / 2), 0 * time, 0 * time, np.sin(yaw / 2)], axis=1)
    return Sequence(
        "circle",
        time,
        gyro,
        accel,
        orientation,
        position,
        velocity,
        np.ones(len(time), dtype=bool),
        attributes={"dataset": "test"},
    )


def changed(sequence, field, row, value):
    """`sequence` with one row (or entry) of one field overwritten."""
    values = getattr(sequence, field).copy()
    values[row] = value
    return sequence._replace(**{field: values})
