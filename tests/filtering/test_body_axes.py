"""Windows with the axes of the body, against SciPy's rotations; hidden axes are zero."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.windows import WINDOW_CUTS, align_recording, cut_window, cut_windows

DT, SAMPLES, CONTEXT = 0.02, 12, 4
RANDOM = np.random.default_rng(5)
GYRO, ACCEL = RANDOM.standard_normal((2, SAMPLES, 3))
START = Rotation.from_euler("ZYX", [2.0, 0.4, -0.7])
"""Attitude of the first sample after the context."""
FACTORS = {"body_axes": 1.0, "hidden_axes": 0.0}


def attitudes():
    """Of every sample, in the world."""
    turns = [Rotation.from_rotvec(rate * DT) for rate in GYRO]
    attitude = START
    for turn in turns[:CONTEXT][::-1]:
        attitude = attitude * turn.inv()
    rotations = []
    for turn in turns:
        rotations.append(attitude)
        attitude = attitude * turn
    return rotations


def by_hand(factor):
    level, rows = Rotation.from_euler("Z", -START.as_euler("ZYX")[0]), []
    for attitude, accel, gyro in zip(attitudes(), ACCEL, GYRO, strict=True):
        turned = level * attitude
        axes = factor * turned.as_matrix()[:, :2].T
        rows.append(np.concatenate([turned.apply(accel), turned.apply(gyro), *axes]))
    return np.array(rows)


@pytest.mark.parametrize("kind", FACTORS)
def test_the_window_of_the_filter_has_them(kind):
    none = jnp.zeros(3)
    window = cut_window(
        jnp.asarray(START.as_matrix()), GYRO, ACCEL, none, none, WINDOW_CUTS[kind], DT, CONTEXT
    )
    np.testing.assert_allclose(window, by_hand(FACTORS[kind]), atol=1e-6)


@pytest.mark.parametrize("kind", FACTORS)
def test_the_window_of_a_recording_has_them(kind):
    matrices = np.array([attitude.as_matrix() for attitude in attitudes()])
    imu, rotation = align_recording(ACCEL, GYRO, matrices, np.array([CONTEXT]), kind)
    samples, turn = jnp.asarray(imu), jnp.asarray(rotation)
    (window,) = cut_windows(samples, jnp.zeros(1, jnp.int32), turn, SAMPLES)
    np.testing.assert_allclose(window, by_hand(FACTORS[kind]), atol=1e-5)
