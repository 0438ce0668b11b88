"""Absolute errors against hand-computed values."""

import numpy as np
import pytest

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Undefined
from tests.support.trajectories import STEP, walk


def test_constant_offset():
    truth = walk().position
    estimate = truth + np.array([3.0, 4.0, 12.0])
    assert metrics.ate(estimate, truth) == pytest.approx(13.0)
    assert metrics.ate(estimate[:, :2], truth[:, :2]) == pytest.approx(5.0)
    assert metrics.ate_mean(estimate, truth) == pytest.approx(13.0)
    assert metrics.ate_ronin(estimate, truth) == pytest.approx(13.0 / np.sqrt(3))
    assert metrics.ate_ronin(estimate[:, :2], truth[:, :2]) == pytest.approx(5.0 / np.sqrt(2))
    assert metrics.rte(estimate, truth, STEP) == pytest.approx(0.0, abs=1e-12)


def test_ate_is_not_ate_mean():
    truth = np.zeros((2, 3))
    estimate = np.array([[0.0, 0, 0], [2.0, 0, 0]])
    assert metrics.ate(estimate, truth) == pytest.approx(np.sqrt(2))
    assert metrics.ate_mean(estimate, truth) == pytest.approx(1.0)


def test_drift():
    truth = np.zeros((101, 3))
    truth[:, 0] = np.arange(101) * STEP * 2
    estimate = truth * [1.05, 1, 1]
    assert metrics.drift(estimate, truth, STEP) == pytest.approx(5.0)
    with pytest.raises(Undefined, match="under 1 m"):
        metrics.drift(estimate * 0.01, truth * 0.01, STEP)
