"""The data of pictures and pages: contours of covariances, and one frame for both trajectories."""

import numpy as np

from gnio_jax.evaluation import Trajectory
from gnio_jax.evaluation.views import ellipses, make_view
from tests.support.estimates import with_covariance


def test_ellipses_are_contours_of_their_covariance():
    covariance = np.array([[[4.0, 1.5, 0], [1.5, 1.0, 0], [0, 0, 9]], np.full((3, 3), np.nan)])
    contours = ellipses(covariance)
    angle = np.linspace(0, 2 * np.pi, 25)
    along, across = contours.major[0] * np.cos(angle), contours.minor[0] * np.sin(angle)
    cosine, sine = np.cos(contours.angle[0]), np.sin(contours.angle[0])
    points = np.stack([cosine * along - sine * across, sine * along + cosine * across], 1)
    inverse = np.linalg.inv(covariance[0, :2, :2])
    distance = np.einsum("ki,ij,kj->k", points, inverse, points)
    np.testing.assert_allclose(distance, 9.0)
    assert contours.major[0] > contours.minor[0] and np.isnan(contours.major[1])


def test_the_estimate_is_moved_to_the_frame_of_the_reference(estimates):
    """The estimate is turned by 90° and shifted; the alignment removes both, for ellipses too."""
    walk = estimates[0]
    walk = with_covariance(walk, walk.filtered.covariance * np.array([1.0, 4.0, 1.0]))
    path, half = walk.trajectory, np.sqrt(0.5)
    turned = np.stack([-path.position[:, 1], path.position[:, 0], path.position[:, 2]], 1)
    w, x, y, z = path.orientation.T
    attitude = half * np.stack([w - z, x - y, y + x, z + w], 1)  # a quarter turn from the left
    covariance = walk.filtered.covariance[:, [1, 0, 2]][:, :, [1, 0, 2]]
    moved = with_covariance(walk, covariance)
    moved = moved._replace(trajectory=Trajectory(path.time, turned + 5.0, attitude))
    whole, aligned = make_view(walk), make_view(moved)
    np.testing.assert_allclose(aligned.position, whole.position, atol=1e-9)
    angles = [ellipses(view.filtered.covariance).angle for view in (whole, aligned)]
    np.testing.assert_allclose(np.abs(np.sin(angles)), 1.0, atol=1e-6)
    # The starts and yaws are the same, so only a shift remains.
    shift = path.position[0] - walk.reference.position[0]
    np.testing.assert_allclose(whole.position, path.position - shift, atol=1e-9)
    np.testing.assert_array_equal(whole.reference, walk.reference.position)
    # Without an alignment the reference is moved to the estimate.
    unaligned = make_view(moved, alignment=None)
    np.testing.assert_array_equal(unaligned.position, moved.trajectory.position)
    np.testing.assert_allclose(unaligned.reference[0], moved.trajectory.position[0], atol=1e-9)
