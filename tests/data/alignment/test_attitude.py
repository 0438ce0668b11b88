"""Attitudes from a drifting gyro and a faulty tracker, against a walk in closed form."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax import numerics
from gnio_jax.data import alignment
from tests.support import known_walk as walk
from tests.support import oxiod_files as files


def test_fused_attitude_ignores_flips_and_bridges_gaps():
    n, step = 4000, 0.01
    time = np.arange(n) * step
    truth = files.Truth()
    known = files.attitude(time, truth)
    integrated = numerics.integrate_gyro(
        files.rate(time, truth) + np.array([0.01, -0.005, 0.012]), step
    )
    measured = known * Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.002, (n, 3)))
    quaternion = measured.as_quat()
    quaternion[500:600] = (
        measured[500:600] * Rotation.from_euler("x", 120, degrees=True)
    ).as_quat()
    good = np.ones(n, dtype=bool)
    good[2000:2150] = False
    quaternion[2000:2150] = [0, 0, 0, 1]
    found, believed = alignment.fuse_attitude(
        integrated, Rotation.from_quat(quaternion), good, step
    )
    assert np.degrees((found * known.inv()).magnitude()).max() < 0.5
    assert not believed[500:600].any() and believed[:490].all() and not believed[2000:2150].any()


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
