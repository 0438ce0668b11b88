"""Integration of an IMU in NumPy, with rotation matrices."""

import numpy as np


def matrices(wxyz):
    w, x, y, z = np.moveaxis(wxyz, -1, 0)
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def strap_down(sequence):
    """Positions from integrating the IMU alone, sample by sample: R exp((gyro) dt), v + (R accel +
    g) dt."""
    dt = sequence.time[1] - sequence.time[0]
    gravity = np.array([0, 0, -9.81])
    rotation, velocity, position = (
        matrices(sequence.orientation[0]),
        sequence.velocity[0],
        sequence.position[0],
    )
    angles = np.linalg.norm(sequence.gyro, axis=1)[:, None, None] * dt
    x, y, z = sequence.gyro.T * dt
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    turns = (
        np.eye(3)
        + np.sinc(angles / np.pi) * cross
        + 0.5 * np.sinc(angles / 2 / np.pi) ** 2 * cross @ cross
    )
    positions = np.empty_like(sequence.position)
    for k in range(len(sequence.time)):
        positions[k] = position
        change = rotation @ sequence.accel[k] * dt
        position = position + velocity * dt + 0.5 * change * dt + 0.5 * gravity * dt**2
        velocity = velocity + change + gravity * dt
        rotation = rotation @ turns[k]
    return positions
