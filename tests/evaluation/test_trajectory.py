"""Yaw errors, alignments and the TUM format: against SciPy, searches and known motions."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import Filtered, SequenceEstimate, metrics
from gnio_jax.evaluation.estimate import in_one_frame
from gnio_jax.evaluation.trajectory import (
    align,
    read_tum,
    relative_yaw,
    write_tum,
)
from gnio_jax.numerics import matrix_from_quaternion
from tests.support.trajectories import lost, masked, moved_by, perturbed, walk


def test_alignment_at_the_origin_removes_a_yaw_and_a_shift():
    truth = walk(tilt=0.3)
    estimate = moved_by(truth, Rotation.from_euler("z", -2.0), [5.0, -3.0, 1.0])
    aligned = align(estimate, masked(truth, slice(0, 7)), "origin")
    np.testing.assert_allclose(aligned.position, truth.position, atol=1e-9)
    ours, true = (matrix_from_quaternion(path.orientation) for path in (aligned, truth))
    np.testing.assert_allclose(ours, true, atol=1e-9)
    assert align(estimate, truth, "none") is estimate


def test_a_covariance_is_turned_with_its_trajectory():
    truth = walk(tilt=0.3)
    estimate = moved_by(truth, Rotation.from_euler("z", -2.0), [5.0, -3.0, 1.0])
    spread = np.random.default_rng(0).normal(size=(len(truth.time), 20, 3))
    spread *= [3.0, 1.0, 0.5]
    before = np.einsum("nki,nkj->nij", spread, spread)
    turned = Rotation.from_euler("z", 2.0).apply(spread.reshape(-1, 3)).reshape(spread.shape)
    expected = np.einsum("nki,nkj->nij", turned, turned)
    filtered = Filtered(before, *np.full((2, len(before)), np.nan))
    sequence = SequenceEstimate("walk", estimate, truth, filtered=filtered)
    covariance = in_one_frame(sequence).filtered.covariance
    np.testing.assert_allclose(covariance, expected, atol=1e-9)
    assert in_one_frame(sequence, "none").filtered.covariance is before


@pytest.mark.parametrize("mirrored", [False, True])
def test_alignment_of_se3_equals_scipys(mirrored):
    truth = walk(tilt=0.3)
    estimate = moved_by(perturbed(truth), Rotation.from_rotvec([0.4, -0.9, 1.7]), [5.0, -3.0, 1.0])
    if mirrored:
        truth = truth._replace(position=np.random.default_rng(4).normal(size=(900, 3)))
        estimate = truth._replace(position=truth.position * [1, 1, -1])
    (a, _), (b, centre) = (
        (path.position - path.position.mean(0), path.position.mean(0)) for path in (estimate, truth)
    )
    best, _ = Rotation.align_vectors(b, a)
    position = align(estimate, truth, "se3").position
    np.testing.assert_allclose(position, best.apply(a) + centre, atol=1e-8)


def test_alignment_of_yaw_and_position_has_the_smallest_error_over_yaw():
    truth = walk(tilt=0.3)
    estimate = moved_by(perturbed(truth), Rotation.from_euler("z", 2.5), [5.0, -3.0, 1.0])
    error = metrics.ate(align(estimate, truth, "yaw_position").position, truth.position)
    centred, target = (path.position - path.position.mean(0) for path in (estimate, truth))

    def cost(angle):
        return metrics.ate(Rotation.from_euler("z", angle).apply(centred), target)

    start = min(np.linspace(-np.pi, np.pi, 61), key=cost)
    least = minimize_scalar(cost, (start - 0.1, start, start + 0.1), tol=1e-9).fun
    assert error == pytest.approx(least, rel=1e-9)
    assert metrics.ate(align(estimate, truth, "se3").position, truth.position) <= error


@pytest.mark.parametrize("how", ["origin", "yaw_position", "se3"])
def test_alignment_uses_only_finite_rows(how):
    truth = walk(tilt=0.3)
    estimate = moved_by(truth, Rotation.from_euler("z", 1.2), [5.0, -3.0, 1.0])
    aligned = align(lost(estimate, 500), truth, how)
    np.testing.assert_allclose(aligned.position[:500], truth.position[:500], atol=1e-9)
    assert np.isnan(aligned.position[500:]).all()


def test_yaw_is_finite_where_it_has_no_value():
    """Half a turn about a horizontal axis: no yaw is nearer than another. NaN stays NaN."""
    level, over = np.array([[1.0, 0, 0, 0]]), np.array([[0.0, np.sqrt(0.5), np.sqrt(0.5), 0]])
    np.testing.assert_array_equal(relative_yaw(over, level), 0.0)
    assert np.isnan(relative_yaw(level, level * np.nan)).all()


def test_tum_files_are_read_back(tmp_path):
    """Rows that are not known are not written. The columns have evo's order."""
    path = lost(walk(n=40, tilt=0.3), 30)
    path.orientation[5] = np.nan
    write_tum(tmp_path / "a.txt", path)
    trajectory, rows = read_tum(tmp_path / "a.txt"), np.r_[0:5, 6:30]
    for one, other in zip(trajectory, path, strict=True):
        np.testing.assert_allclose(one, other[rows], atol=1e-8)
    row = np.loadtxt(tmp_path / "a.txt")[3]
    np.testing.assert_allclose(row[[7, 4, 5, 6]], path.orientation[3], atol=1e-8)
