"""Positions and velocities of a noisy tracker, against a walk in closed form."""

from __future__ import annotations

import numpy as np

from gnio_jax.data import alignment
from tests.support import oxiod_files as files


def test_smooth_positions_keeps_a_gait_and_drops_jumps():
    step = 0.01
    time = np.arange(3000) * step
    truth = files.Truth()
    known = files.position(time, truth)
    measured = known + np.random.default_rng(0).normal(0, 2e-4, known.shape)
    good = np.ones(len(time), dtype=bool)
    measured[1000:1002] += 0.3
    good[2000:2015] = False
    measured[2000:2015] = 0
    found, velocity, believed = alignment.smooth_positions(measured, good, step)
    assert np.abs(found - known).max() < 2e-3
    assert np.abs(velocity - files.velocity(time, truth))[5:-5].max() < 0.03
    assert not believed[1000:1002].any() and not believed[2000:2015].any() and believed[:950].all()
