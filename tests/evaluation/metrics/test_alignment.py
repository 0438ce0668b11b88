"""Alignments against SciPy, a search over yaw, and known motions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Undefined
from gnio_jax.numerics import matrix_from_quaternion
from tests.support.trajectories import lost, masked, moved_by, perturbed, walk


def test_origin_undoes_a_yaw_and_a_shift():
    truth = walk(tilt=0.3)
    estimate = moved_by(truth, Rotation.from_euler("z", -2.0), [5.0, -3.0, 1.0])
    aligned = metrics.align(estimate, masked(truth, slice(0, 7)), "origin")
    np.testing.assert_allclose(aligned.position, truth.position, atol=1e-9)
    np.testing.assert_allclose(
        matrix_from_quaternion(aligned.orientation),
        matrix_from_quaternion(truth.orientation),
        atol=1e-9,
    )
    assert metrics.align(estimate, truth, "none") is estimate


def test_se3_against_scipy():
    truth = walk(tilt=0.3)
    estimate = moved_by(perturbed(truth), Rotation.from_rotvec([0.4, -0.9, 1.7]), [5.0, -3.0, 1.0])
    a, b = estimate.position - estimate.position.mean(0), truth.position - truth.position.mean(0)
    best, _ = Rotation.align_vectors(b, a)
    np.testing.assert_allclose(
        metrics.align(estimate, truth, "se3").position,
        best.apply(a) + truth.position.mean(0),
        atol=1e-8,
    )


def test_se3_never_mirrors():
    random = np.random.default_rng(4)
    truth = walk()._replace(position=random.normal(size=(900, 3)))
    estimate = truth._replace(position=truth.position * [1, 1, -1])
    a, b = estimate.position - estimate.position.mean(0), truth.position - truth.position.mean(0)
    best, _ = Rotation.align_vectors(b, a)
    np.testing.assert_allclose(
        metrics.align(estimate, truth, "se3").position,
        best.apply(a) + truth.position.mean(0),
        atol=1e-8,
    )


def test_yaw_position_is_the_least_over_yaw():
    truth = walk(tilt=0.3)
    estimate = moved_by(perturbed(truth), Rotation.from_euler("z", 2.5), [5.0, -3.0, 1.0])
    found = metrics.ate(metrics.align(estimate, truth, "yaw_position").position, truth.position)
    centred, target = (
        estimate.position - estimate.position.mean(0),
        truth.position - truth.position.mean(0),
    )
    costs = [
        metrics.ate(Rotation.from_euler("z", angle).apply(centred), target)
        for angle in np.linspace(-np.pi, np.pi, 3001)
    ]
    assert found == pytest.approx(min(costs), rel=1e-3) and found <= min(costs) + 1e-12
    assert metrics.ate(metrics.align(estimate, truth, "se3").position, truth.position) <= found


@pytest.mark.parametrize("how", ["origin", "yaw_position", "se3"])
def test_alignment_sees_finite_rows_alone(how):
    truth = walk(tilt=0.3)
    estimate = moved_by(truth, Rotation.from_euler("z", 1.2), [5.0, -3.0, 1.0])
    found = metrics.align(lost(estimate, 500), truth, how)
    np.testing.assert_allclose(found.position[:500], truth.position[:500], atol=1e-9)
    assert np.isnan(found.position[500:]).all()
    with pytest.raises(Undefined, match="not finite in any trusted row"):
        metrics.align(lost(estimate, 500), masked(truth, slice(0, 500)), how)
