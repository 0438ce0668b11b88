"""NEES, NIS and coverage against drawn errors and matrix inverses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import metrics
from tests.support.trajectories import lost, moved_by, perturbed, walk


def test_nees_of_a_consistent_filter():
    random = np.random.default_rng(0)
    root = random.normal(size=(20000, 3, 3))
    covariance = np.einsum("nij,nkj->nik", root, root) + 0.1 * np.eye(3)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), random.normal(size=(20000, 3)))
    squared = metrics.normalised_squared(error, covariance)
    assert squared[7] == pytest.approx(error[7] @ np.linalg.inv(covariance[7]) @ error[7])
    assert metrics.mean_normalised(squared, 3) == pytest.approx(1.0, abs=0.03)
    assert metrics.coverage(squared, 3) == pytest.approx(95, abs=0.7)
    assert metrics.mean_normalised(4 * squared, 3) == pytest.approx(4.0, abs=0.1)
    assert metrics.coverage(np.array([1.0, np.nan, 7.8, 7.9]), 3) == pytest.approx(200 / 3)


def test_nees_does_not_depend_on_the_frame():
    truth = walk()
    random = np.random.default_rng(3)
    covariance = np.broadcast_to(np.diag([4.0, 1.0, 0.25]), (900, 3, 3))
    error = random.normal(size=(900, 3)) * [2.0, 1.0, 0.5]
    error[0] = 0
    estimate = truth._replace(position=truth.position + error)
    straight = metrics.measure(estimate, truth, position_covariance=covariance).values
    turned = moved_by(truth, Rotation.from_euler("z", 1.0), [1.0, 2.0, 3.0])
    elsewhere = metrics.measure(estimate, turned, position_covariance=covariance).values
    for name in ("nees", "nees_2d", "nees_coverage", "nees_coverage_2d"):
        assert straight[name] == pytest.approx(elsewhere[name])
    assert straight["nees"] == pytest.approx(np.mean(np.sum((error / [2.0, 1.0, 0.5]) ** 2, 1)) / 3)


def test_a_covariance_that_is_not_finite_is_no_consistent_one():
    truth = walk()
    covariance = np.broadcast_to(np.eye(3), (900, 3, 3)).copy()
    covariance[100:] = np.nan
    found = metrics.measure(perturbed(truth, scale=0), truth, position_covariance=covariance).values
    assert found["nees"] == np.inf and found["nees_coverage"] == pytest.approx(100 / 9)
    assert np.isfinite(found["ate"])


@pytest.mark.parametrize("row", [150, 900])  # lost in the middle, or whole
@pytest.mark.parametrize(
    "bad",
    [
        np.full((3, 3), 1e30),
        np.eye(3) + 1e40 * np.outer([1, 2, 3], [1, 2, 3]),
        np.diag([1.0, -1.0, 1.0]),
        [[1, 2, 0], [2, 1, 0], [0, 0, 1]],
    ],
)
def test_a_singular_or_indefinite_covariance_is_no_consistent_one(bad, row):
    truth = walk()
    covariance = np.broadcast_to(np.eye(3), (900, 3, 3)).copy()
    covariance[150:] = bad
    estimate = lost(perturbed(truth, scale=0), row)
    found = metrics.measure(estimate, truth, position_covariance=covariance).values
    share = pytest.approx(100 / 6) if row == 900 else 0
    for tag in ("", "_2d"):
        assert found[f"nees{tag}"] == np.inf and found[f"nees_coverage{tag}"] == share


def test_normalised_errors_against_the_inverse_whatever_the_units():
    random = np.random.default_rng(4)
    root, error = random.normal(size=(50, 3, 3)), random.normal(size=(50, 3))
    unit = np.array([1e-9, 1.0, 1e9])
    covariance = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    expected = [e @ np.linalg.inv(p) @ e for e, p in zip(error, covariance, strict=True)]
    found = metrics.normalised_squared(unit * error, unit[:, None] * covariance * unit)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
