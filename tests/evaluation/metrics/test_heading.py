"""Yaw errors, level and tilted."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Undefined
from tests.support.trajectories import PITCHES, STEP, moved_by, pitched, quaternions


def test_yaw_errors_wrap():
    def level(yaw):
        return quaternions(Rotation.from_euler("z", yaw[:, None]))

    yaw_true = np.linspace(0, 20, 601)
    truth = level(yaw_true)
    assert metrics.yaw_rmse(level(yaw_true + np.radians(10)), truth) == pytest.approx(10.0)
    growing = yaw_true + np.radians(5) * np.linspace(0, 100, 601)  # 500° in 60 s, several turns
    assert metrics.yaw_drift(level(growing), truth, STEP) == pytest.approx(500 * 60, rel=1e-9)
    with pytest.raises(Undefined, match="10 s"):
        metrics.yaw_drift(truth[:50], truth[:50], STEP)


@pytest.mark.parametrize("pitch", PITCHES)
def test_yaw_of_a_tilted_phone_is_the_turn_about_the_vertical(pitch):
    """Against SciPy's minimum of ‖R̂ − R_z(ψ) R‖, with half a degree of tilt error too."""
    random = np.random.default_rng(pitch)
    headings = random.uniform(-3, 3, 12)
    truth = Rotation.from_euler("ZY", np.column_stack([headings, np.full(12, np.radians(pitch))]))
    yaws = np.concatenate([random.uniform(-3, 3, 10), [0.0, np.pi]])
    tilt = Rotation.from_rotvec(np.column_stack([random.normal(0, 0.01, (12, 2)), np.zeros(12)]))
    estimate = Rotation.from_euler("z", yaws[:, None]) * tilt * truth

    def nearest(r_hat, r):
        def cost(angle):
            return np.linalg.norm(r_hat - Rotation.from_euler("z", angle).as_matrix() @ r) ** 2

        start = min(np.linspace(-np.pi, np.pi, 73), key=cost)
        return minimize_scalar(cost, (start - 0.1, start, start + 0.1), tol=1e-9).x

    pairs = zip(estimate.as_matrix(), truth.as_matrix(), strict=True)
    expected = [nearest(*pair) for pair in pairs]
    found = metrics.relative_yaw(quaternions(estimate), quaternions(truth))
    assert np.abs(found).max() <= np.pi
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * np.array(expected)), atol=1e-6)
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * yaws), atol=1e-12)


def test_yaw_of_level_phones_is_the_difference_of_their_yaws():
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, (2, 50))
    level = (quaternions(Rotation.from_euler("z", of_one[:, None])) for of_one in angles)
    found = metrics.relative_yaw(*level)
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * (angles[0] - angles[1])), atol=1e-12)


def test_yaw_is_finite_where_it_has_no_value():
    """Half a turn about a horizontal axis: no yaw is nearer than another. NaN stays NaN."""
    level, over = np.array([[1.0, 0, 0, 0]]), np.array([[0.0, np.sqrt(0.5), np.sqrt(0.5), 0]])
    np.testing.assert_array_equal(metrics.relative_yaw(over, level), 0.0)
    assert np.isnan(metrics.relative_yaw(level, level * np.nan)).all()


@pytest.mark.parametrize("pitch", PITCHES)
def test_a_little_tilt_is_no_yaw_error(pitch):
    """0.1° of noise about both horizontal axes on a perfect path, on whose phone the body's x axis
    may be vertical."""
    truth = pitched(pitch)
    noise = np.zeros((900, 3))
    noise[:, :2] = np.random.default_rng(1).normal(0, np.radians(0.1), (900, 2))
    turn = Rotation.from_rotvec(noise) * Rotation.from_quat(np.roll(truth.orientation, -1, 1))
    found = metrics.measure(truth._replace(orientation=quaternions(turn)), truth).values
    assert found["yaw_rmse"] < 0.01 and found["yaw_drift"] < 1.0
    assert found["rpe_1s"] < 1e-4 and found["rpe_10s"] < 1e-3 and found["ate"] < 1e-3


@pytest.mark.parametrize("pitch", PITCHES)
def test_a_wrong_heading_of_a_tilted_phone_is_measured_and_undone(pitch):
    truth = pitched(pitch)
    turn = Rotation.from_euler("z", 40, degrees=True)
    estimate = moved_by(truth, turn, [5.0, -3.0, 1.0])
    assert metrics.measure(estimate, truth, "none").values["yaw_rmse"] == pytest.approx(40.0)
    covariance = np.broadcast_to(np.eye(3), (900, 3, 3))
    found = metrics.measure(estimate, truth, position_covariance=covariance).values
    for name in ("rpe_10s", "ate", "nees"):
        assert found[name] == pytest.approx(0, abs=1e-9)
    assert found["yaw_rmse"] == pytest.approx(0, abs=1e-6)
