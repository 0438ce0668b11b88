"""Measurements of the caller's own: in the filter, and as they are refused."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from tests.support.compiling import quick
from tests.support.random_walk import random_walk
from tests.support.whole_covariance import covariance

N, CLONES, INTERVALS, DT = 5, 4, 30, 0.02
CONFIG = filtering.FilterConfig(DT, N, CLONES, history="core", error="additive")
NOISE = filtering.NoiseModel(2e-3, 2e-2, measurement_scale=1.0)
START, GYRO, ACCEL, DISPLACEMENT, SPREAD = random_walk(
    5, n=N, clones=CLONES, intervals=INTERVALS, dt=DT, nan_rows=[9, 17]
)


class Height(NamedTuple):
    """m, above the origin of the world."""

    height: jax.Array
    std: jax.Array

    def update(self, state, step):
        residual = jnp.stack([self.height - state.position[2]])
        linear = filtering.linearise(
            state, residual, self.std[None, None] ** 2, position=[[0.0, 0.0, 1.0]]
        )
        return filtering.measure(state, linear, step, threshold=10.8)


def start():
    return filtering.initial_state(CONFIG, *START)


@functools.partial(quick, static_argnames="config")
def run(state, gyro, accel, displacement, covariance, config, measurements):
    given = state, gyro, accel, displacement, covariance, config, NOISE
    return filtering.run_filter(*given, measurements=measurements)


def test_a_height_is_the_textbooks_update():
    """In the whole covariance, clones and all, for every interval; one that is 100 m off fails its
    χ² test, and a NaN is none."""
    std, state = 0.05, start()
    whole = jax.jit(covariance)
    for k in range(INTERVALS):
        rows, row = slice(N * k, N * (k + 1)), slice(k, k + 1)
        given = GYRO[rows], ACCEL[rows], DISPLACEMENT[row], SPREAD[row]
        none = Height(np.full(1, np.nan), np.full(1, std))
        without, _ = run(state, *given, CONFIG, (none,))
        height = np.nan if k % 3 == 0 else without.position[2] + 0.1 * np.sin(k)
        height = np.asarray(100.0 if k == 20 else height)
        state, history = run(state, *given, CONFIG, (none._replace(height=height[None]),))
        (outcome,) = history.others
        assert outcome.present[0] == np.isfinite(height)
        assert outcome.accepted[0] == (np.isfinite(height) and k != 20)
        before = np.asarray(whole(without))
        spread, residual = before[8, 8] + std**2, height - without.position[2]
        gain = before[:, 8] / spread * float(outcome.accepted[0])
        np.testing.assert_allclose(
            whole(state), before - np.outer(gain, before[8]), rtol=1e-9, atol=1e-12
        )
        correction = gain * np.nan_to_num(residual)
        np.testing.assert_allclose(state.velocity, without.velocity + correction[3:6], atol=1e-12)
        np.testing.assert_allclose(state.position, without.position + correction[6:9], atol=1e-12)
        if outcome.present[0]:
            np.testing.assert_allclose(outcome.residual[0], [residual], atol=1e-12)
            np.testing.assert_allclose(outcome.nis[0], residual**2 / spread, rtol=1e-9)


def test_rows_that_are_missing_are_refused_by_name():
    measured = (Height(np.zeros(INTERVALS - 1), np.ones(INTERVALS)),)
    with pytest.raises(ValueError, match=r"^measurements\[0\]\.height: the shape must be \(30,\)"):
        run(start(), GYRO, ACCEL, DISPLACEMENT, SPREAD, CONFIG, measured)
    with pytest.raises(ValueError, match=r"^linearise: height: is none of rotation, velocity"):
        filtering.linearise(start(), [0.0], [[1.0]], height=[[0.0, 0.0, 1.0]])


def test_known_displacements_are_those_of_the_filter():
    rng = np.random.default_rng(0)
    (rotation, _, _), turn = START, rng.normal(size=3)
    angles = np.arange(INTERVALS + 1)[:, None] * 0.1 * turn
    rotations = Rotation.from_rotvec(angles).as_matrix() @ rotation
    position = rng.normal(size=(INTERVALS + 1, 3))
    found = filtering.displacements(rotations, position, CONFIG)
    assert np.isnan(found[:CLONES]).all() and found.shape == (INTERVALS, 3)
    for k in range(CLONES, INTERVALS):
        # Clone k is taken at the end of interval k, that is at row k + 1.
        old, new = k - CLONES + 1, k + 1
        yaw = np.arctan2(rotations[old, 1, 0], rotations[old, 0, 0])
        c, s = np.cos(yaw), np.sin(yaw)
        x, y, z = position[new] - position[old]
        np.testing.assert_allclose(found[k], [c * x + s * y, c * y - s * x, z], atol=1e-12)
    assert np.isnan(filtering.displacements(rotations[:3], position[:3], CONFIG)).all()
