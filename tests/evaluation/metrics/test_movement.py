"""Path lengths and standing still against hand-computed values."""

import numpy as np
import pytest

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Undefined
from tests.support.trajectories import STEP


def test_path_length_of_a_scaled_circle():
    angle = np.linspace(0, 2 * np.pi, 1201)
    circle = 10 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)  # 62.8 m in 120 s
    assert metrics.path_length(circle, STEP) == pytest.approx(
        120 * 20 * np.sin(np.pi / 120), rel=1e-12
    )
    assert metrics.path_length_ratio(circle * 0.8, circle, STEP) == pytest.approx(0.8)
    assert metrics.path_length_ratio(circle * 0, circle, STEP) == 0.0
    holes = circle.copy()
    holes[300:400] = np.nan
    assert metrics.path_length_ratio(circle * 0.8, holes, STEP) == pytest.approx(0.8)


def test_path_length_is_hardly_inflated_by_noise():
    truth = np.zeros((1201, 3))
    truth[:, 0] = np.arange(1201) * STEP
    noisy = truth + np.random.default_rng(0).normal(0, 0.02, truth.shape)
    assert metrics.path_length(truth[:996], STEP) == pytest.approx(
        99.5
    )  # the odd rows at the end count too
    assert metrics.path_length_ratio(noisy, truth, STEP) == pytest.approx(1.0, abs=2e-3)
    assert np.linalg.norm(np.diff(noisy, axis=0), axis=1).sum() > 1.05 * 120


def test_stationary_drift():
    truth = np.zeros((1000, 3))
    truth[400:, 0] = np.minimum(np.arange(600), 300) * STEP  # stands 40 s, walks 30 s, stands 30 s
    still = metrics.standing(truth, STEP)
    assert still[:400].all() and still[701:].all() and not still[402:699].any()
    estimate = truth.copy()
    estimate[:, 1] += np.arange(1000) * STEP * 0.02  # 1.2 m a minute
    assert metrics.stationary_drift(estimate, truth, STEP) == pytest.approx(1.2, rel=1e-3)
    moving = truth[401:700]
    with pytest.raises(Undefined, match="never stands"):
        metrics.stationary_drift(moving, moving, STEP)
    brief = np.zeros((40, 3))
    brief[:, 0] = np.r_[np.arange(12), np.full(15, 11), np.arange(11, 24)] * STEP  # still for 1.5 s
    assert not metrics.standing(brief, STEP).any()
