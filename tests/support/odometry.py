"""A short recording, and a network that is a linear function of its windows."""

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax import filtering

N, INTERVALS, DT = 4, 20, 0.02

PARAMETERS = np.random.default_rng(5).standard_normal((6, 3)) * 0.02


def recording(seed):
    rng = np.random.default_rng(seed)
    t = np.arange(N * INTERVALS) * DT
    gyro = np.sin(t[:, None] * rng.uniform(2, 5, 3) + rng.uniform(0, 6, 3))
    accel = np.cos(t[:, None] * rng.uniform(2, 5, 3)) + Rotation.from_euler(
        "xyz", [0.3, -0.2, 1.0]
    ).inv().apply([0, 0, 9.81])
    return gyro, accel


def start(config):
    rotation = Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_matrix()
    return filtering.initial_state(
        filtering.Filter(config),
        rotation,
        np.array([0.5, 0.0, 0.0]),
        np.zeros(3),
        np.array([0.02, -0.01, 0.03]),
        0.1,
    )
