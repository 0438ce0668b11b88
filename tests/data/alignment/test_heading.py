"""Lag and heading against tracked positions, against a walk in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from gnio_jax.data import alignment
from tests.support import known_walk as walk


def test_lag_and_a_drifting_yaw_are_found_and_a_relocalisation_does_not_matter():
    time = np.arange(0.0, 125.0, 0.01)
    yaw = 0.5 + 0.003 * time
    known = walk.acceleration(time)
    turned = (known[:, 0] + 1j * known[:, 1]) * np.exp(-1j * yaw)
    felt = np.stack([turned.real, turned.imag], axis=1)
    track_time = np.arange(0.0, 120.0, 0.01)
    position = walk.position(track_time + 1.3)
    position[6000:] += 2.0
    good = np.ones(len(track_time), dtype=bool)
    found = alignment.align_heading(time, felt, track_time, position, good)
    np.testing.assert_allclose(found.lag, 1.3, atol=0.01)
    expected = 0.5 + 0.003 * (found.knots + 1.3)
    np.testing.assert_allclose(found.yaw, expected, atol=0.05)
    assert found.correlation > 0.9 and found.runner_up < 1.0


def test_half_a_minute_is_too_little():
    time = np.arange(0.0, 29.0, 0.01)
    position, good = walk.position(time), np.ones(len(time), dtype=bool)
    with pytest.raises(ValueError, match="less than 30 s"):
        alignment.align_heading(time, walk.acceleration(time)[:, :2], time, position, good)
