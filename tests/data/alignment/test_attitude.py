"""Attitudes from a drifting gyro and tracked positions, against a walk in closed form."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax import numerics
from gnio_jax.data import alignment
from tests.support import known_walk as walk


def test_accelerations_correct_tilt_and_yaw_of_a_drifting_gyro():
    step = 0.01
    time = np.arange(0, 60, step)
    known = walk.attitude(time)
    drifting = walk.rate(time) + np.array([0.002, -0.001, 0.001])
    integrated = numerics.integrate_gyro(drifting, step)
    guess = Rotation.from_euler("ZYX", [8.0, -4.0, 5.0], degrees=True) * known
    good = np.ones(len(time), dtype=bool)
    good[2000:2100] = False
    position = walk.position(time)
    position[2000:2100] += 3.0  # the tracker relocalised for a second
    found = alignment.attitude_from_acceleration(
        integrated, guess, walk.force(time), position, good, step
    )
    error = (found * known.inv()).as_rotvec()[300:-300]
    assert np.degrees(np.linalg.norm(error[:, :2], axis=1)).max() < 0.5
    assert np.degrees(np.abs(error[:, 2])).max() < 2.0
