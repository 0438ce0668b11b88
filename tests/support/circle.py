"""A walk in a circle whose every field is known in closed form."""

import numpy as np

from gnio_jax.types import Sequence


def circle(rate=100.0, seconds=30.0, speed=1.2, turn=0.4, stamps=None) -> Sequence:
    """Walking a circle on the level, phone flat and x ahead, up and down by a gait of 2 Hz: every
    field in closed form."""
    time = np.arange(round(seconds * rate)) / rate if stamps is None else stamps
    yaw, zero, radius, lift, omega = turn * time, 0 * time, speed / turn, 0.02, 4 * np.pi
    sine, cosine, bounce = np.sin(yaw), np.cos(yaw), lift * np.sin(omega * time)
    rise = lift * omega * np.cos(omega * time)
    return Sequence(
        "circle",
        time,
        gyro=np.stack([zero, zero, turn + zero], axis=1),
        accel=np.stack([zero, speed * turn + zero, 9.81 - omega**2 * bounce], axis=1),
        orientation=np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1),
        position=np.stack([radius * sine, -radius * cosine, bounce], axis=1),
        velocity=np.stack([speed * cosine, speed * sine, rise], axis=1),
        valid=np.ones(len(time), dtype=bool),
        attributes={"dataset": "test"},
    )


def changed(sequence, field, row, value):
    """`sequence` with one row (or entry) of one field overwritten."""
    values = getattr(sequence, field).copy()
    values[row] = value
    return sequence._replace(**{field: values})
