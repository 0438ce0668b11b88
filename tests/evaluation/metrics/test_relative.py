"""Relative errors against plain loops."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Undefined
from tests.support.trajectories import STEP, masked, moved_by, perturbed, walk


def test_rte_against_a_loop_and_with_a_gap():
    truth, apart = walk(), 600
    estimate = perturbed(truth).position
    reference = masked(truth, slice(620, 640)).position
    errors = []
    for i in range(len(truth.time) - apart):
        j = i + apart
        if np.isfinite(reference[i]).all() and np.isfinite(reference[j]).all():
            errors.append(np.sum((estimate[j] - estimate[i] - reference[j] + reference[i]) ** 2))
    assert len(errors) == 280
    assert metrics.rte(estimate, reference, STEP) == pytest.approx(
        np.sqrt(np.mean(errors)), rel=1e-12
    )
    flat = metrics.rte(estimate[:, :2], reference[:, :2], STEP)
    assert metrics.rte_ronin(estimate[:, :2], reference[:, :2], STEP) == pytest.approx(
        flat / np.sqrt(2)
    )


def test_rte_of_a_short_sequence_is_scaled():
    truth = np.zeros((301, 3))
    estimate = np.zeros((301, 3))
    estimate[:, 0] = np.linspace(0, 2.0, 301)  # 2 m in 30 s
    assert metrics.rte(estimate, truth, STEP) == pytest.approx(4.0)
    with pytest.raises(Undefined, match="single"):
        metrics.rte(estimate[:1], truth[:1], STEP)


@pytest.mark.parametrize("metres", [1.0, 10.0])
def test_rte_distance_against_a_loop(metres):
    truth = walk().position[:, :2]
    estimate = perturbed(walk()).position[:, :2]
    reference = truth.copy()
    reference[300] = np.nan
    errors = []
    for start, stop in [(0, 300), (301, 900)]:
        for i in range(start, stop):
            walked, j = 0.0, i
            while j + 1 < stop and walked < metres - 1e-9:
                walked += np.linalg.norm(truth[j + 1] - truth[j])
                j += 1
            if walked >= metres - 1e-9:
                errors.append(np.sum((estimate[j] - estimate[i] - truth[j] + truth[i]) ** 2))
    assert metrics.rte_distance(estimate, reference, metres) == pytest.approx(
        np.sqrt(np.mean(errors)), rel=1e-9
    )


def test_rte_distance_of_a_scaled_line():
    truth = np.zeros((501, 2))
    truth[:, 0] = np.arange(501) * 0.125
    assert metrics.rte_distance(truth * 1.1, truth, 1.0) == pytest.approx(0.1)
    assert metrics.rte_distance(truth * 1.1, truth, 10.0) == pytest.approx(1.0)
    with pytest.raises(Undefined, match="100 m"):
        metrics.rte_distance(truth, truth, 100.0)


def test_rpe_forgives_a_wrong_heading_and_rte_does_not():
    truth = walk(tilt=0.3)
    estimate = moved_by(truth, Rotation.from_euler("z", 1.2), [5.0, -3.0, 1.0])
    assert metrics.rpe(estimate, truth, STEP, 1.0) == pytest.approx(0.0, abs=1e-12)
    assert metrics.rpe(estimate, truth, STEP, 10.0, dims=2) == pytest.approx(0.0, abs=1e-11)
    assert metrics.rpe_se3(estimate, truth, STEP) == pytest.approx(0.0, abs=1e-12)
    assert metrics.rte(estimate.position, truth.position, STEP, 10.0) > 1.0


@pytest.mark.parametrize("seconds", [1.0, 10.0])
def test_rpe_against_a_loop(seconds):
    truth = walk(tilt=0.3)
    estimate = perturbed(truth)
    apart, errors, errors_2d, errors_se3 = round(seconds / STEP), [], [], []
    turns, turns_true = (
        Rotation.from_quat(np.roll(t.orientation, -1, 1)) for t in (estimate, truth)
    )
    for i in range(len(truth.time) - apart):
        between = turns[i] * turns_true[i].inv()
        _, _, z, w = between.as_quat()
        angle = -2 * np.arctan(z / w)  # the twist about z, turned back
        moved, moved_true = (
            estimate.position[i + apart] - estimate.position[i],
            truth.position[i + apart] - truth.position[i],
        )
        error = Rotation.from_euler("z", angle).apply(moved) - moved_true
        errors.append(np.sum(error**2))
        errors_2d.append(np.sum(error[:2] ** 2))
        errors_se3.append(
            np.sum((turns[i].inv().apply(moved) - turns_true[i].inv().apply(moved_true)) ** 2)
        )
    for dims, squares in ((3, errors), (2, errors_2d)):
        found = metrics.rpe(estimate, truth, STEP, seconds, dims)
        assert found == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-9)
    assert metrics.rpe_se3(estimate, truth, STEP, seconds) == pytest.approx(
        np.sqrt(np.mean(errors_se3)), rel=1e-9
    )
