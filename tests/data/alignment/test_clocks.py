"""The lag of poses behind an IMU, against a walk in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.data import alignment
from tests.support import known_walk as walk
from tests.support.idol_files import BIAS


@pytest.mark.parametrize("lag", [-0.12, 0.0, 0.033, 0.187])
def test_lag_from_noisy_rates_with_a_bias(lag):
    noise = np.random.default_rng(1)
    time = np.arange(0, 60, 0.01)
    gyro = walk.rate(time) + BIAS + noise.normal(0, 0.02, (len(time), 3))
    gyro[2000:2020] += 8.0  # a knock
    poses = walk.attitude(time - lag) * Rotation.from_rotvec(
        noise.normal(0, np.radians(0.05), (len(time), 3))
    )
    keep = (time < 30) | (time > 30.4)
    fit = alignment.pose_lag(time, gyro, time[keep], poses[keep])
    assert fit.lag == pytest.approx(lag, abs=3e-3) and fit.correlation > 0.5


def test_what_stands_still_has_no_lag():
    time = np.arange(0, 20, 0.01)
    gyro = np.full((len(time), 3), 0.01) + np.random.default_rng(0).normal(0, 0.005, (len(time), 3))
    assert alignment.pose_lag(time, gyro, time, Rotation.identity(len(time))) == alignment.PoseLag(
        0.0, 1.0
    )
