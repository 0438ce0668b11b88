"""What the filter believes where samples are missing: nothing but what a walker may do.

All filters here have the tracker's own settings; the network says nothing.
"""

import numpy as np
import pytest
from flax import linen as nn
from scipy.spatial.transform import Rotation

from gnio_jax.apps.track import GAP_ACCEL_STD, GAP_GYRO_STD, tracking_filter
from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.data.resampling import resample
from gnio_jax.evaluation import estimate, no_displacements, prepare
from gnio_jax.filtering import InitialStd
from gnio_jax.training.checkpoint import Run
from gnio_jax.types import Sequence
from tests.support import known_walk

RATE, SECONDS = 50.0, 5.0
WINDOWS = DataConfig(rate=RATE)
CONFIG = TrainConfig(data=WINDOWS, model=ModelConfig(name="tiny"))
FILTER = tracking_filter(Run(CONFIG, nn.Dense(1), {}, epoch=0, step=0))._replace(
    initial_std=InitialStd(
        1e-3, 1e-3, velocity=0.01, position=0.01, gyro_bias=1e-5, accel_bias=1e-3
    )
)
"""Sure of its start, so that what it doubts is the hole."""
HOLE = (1.5, 4.0)
"""s: the samples between are missing."""
DRAWS = 48


def recordings():
    """Parts of one walk, each with a hole and with the truth before it alone."""
    stamps = np.arange(0, SECONDS + 0.5 / RATE, 1 / RATE)
    kept = stamps[(stamps < HOLE[0] + 1e-9) | (stamps > HOLE[1] - 1e-9)]
    for begin in np.linspace(0.0, 170.0, DRAWS):
        time = begin + kept
        sequence = Sequence(
            name=f"{begin:.2f}",
            time=kept,
            gyro=known_walk.rate(time),
            accel=known_walk.force(time),
            orientation=known_walk.attitude(time).as_quat(scalar_first=True),
            position=known_walk.position(time),
            velocity=known_walk.velocity(time),
            valid=np.ones(len(kept), bool),
        )
        yield resample(sequence, RATE)


@pytest.fixture(scope="module")
def prepared():
    found, left_out = prepare(recordings(), WINDOWS, FILTER.initial_std)
    assert not left_out
    return found


def ends(prepared):
    """Errors of the position where the hole ends, and their covariances, with z left out."""
    n = FILTER.config.samples_per_clone
    row = round(HOLE[1] * RATE) // n
    mute = [no_displacements(each) for each in prepared]
    estimates = estimate(prepared, mute, WINDOWS, FILTER, DRAWS)
    time = np.array([float(each.name) + HOLE[1] for each in estimates])
    error = np.array([each.trajectory.position[row] for each in estimates])
    error = error - known_walk.position(time)
    covariance = np.array([each.filtered.covariance[row] for each in estimates])
    return error[:, :2], covariance[:, :2, :2], estimates


def normalised(error, covariance):
    return np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariance), error) / 2


def test_the_true_end_of_a_hole_lies_within_what_the_filter_says(prepared):
    error, covariance, _ = ends(prepared)
    nees = normalised(error, covariance)
    assert 0.4 < nees.mean() < 1.6 and (2 * nees < 11.8).mean() > 0.97  # 99.7 % of χ² with 2
    believed = [each._replace(imu_valid=None) for each in prepared]
    error, covariance, _ = ends(believed)  # the lines across the hole taken for measurements
    assert normalised(error, covariance).mean() > 100.0


def test_the_covariance_over_a_hole_is_that_of_a_held_and_of_no_sample(prepared):
    """Sample by sample, in NumPy: held for 0.1 s, then neither turn nor force, only doubt."""
    one = prepared[0]
    _, _, (found, *_) = ends(prepared)
    n, dt, row = FILTER.config.samples_per_clone, 1 / RATE, round(HOLE[1] * RATE)
    noise, mask = FILTER.noise, one.imu_valid
    first = int(np.argmin(mask))
    np.testing.assert_array_equal(np.flatnonzero(~mask), np.arange(first, row))
    assert first == round(HOLE[0] * RATE) + 1
    R = one.start.rotation
    std = np.repeat(np.array(FILTER.initial_std), [2, 1, 3, 3, 3, 3])
    P = np.diag(std**2)
    doubt_before = 0.0
    for k in range(row):
        age = 0 if mask[k] else k - first + 1
        held = one.gyro[k], one.accel[k]
        if age:
            held = one.gyro[first - 1], one.accel[first - 1]
        used = age <= 5
        doubt = np.minimum(np.arange(1, age + 1) / 5, 1.0).sum()
        extra, doubt_before = doubt**2 - doubt_before**2 if age else 0.0, doubt
        turn = (held[0] - one.start.gyro_bias) * dt * used
        push = R @ held[1] * dt * used
        A = np.eye(15)
        A[3:6, :3] = -cross(push)
        A[6:9, :3] = A[3:6, :3] * dt / 2
        A[6:9, 3:6] = dt * np.eye(3)
        step = Rotation.from_rotvec(turn).as_matrix()
        B = np.zeros((15, 6))
        B[:3, :3] = R @ step * dt  # J_r of a turn of some degrees is the identity to a per mille
        B[3:6, 3:], B[6:9, 3:] = R * dt, R * dt**2 / 2
        if used:
            A[:9, 9:] = -B[:9]
        white = [
            noise.gyro_density**2 / dt + extra * GAP_GYRO_STD**2,
            noise.accel_density**2 / dt + extra * GAP_ACCEL_STD**2,
        ]
        P = A @ P @ A.T + B @ np.diag(np.repeat(white, 3)) @ B.T
        P[9:12, 9:12] += np.eye(3) * noise.gyro_bias_walk**2 * dt
        P[12:, 12:] += np.eye(3) * noise.accel_bias_walk**2 * dt
        R = R @ step
    np.testing.assert_allclose(found.std[row // n], np.sqrt(np.diag(P)), rtol=0.01)


def cross(v):
    """cross(v) @ w = v × w."""
    return np.cross(v, np.eye(3)).T
