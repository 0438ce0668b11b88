"""Losses of a filtered segment against plain NumPy and SciPy, row by row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from gnio_jax.config import ThroughFilter
from gnio_jax.filtering import FilterConfig, FilterHistory
from gnio_jax.training import filter_losses
from gnio_jax.training.segments import MotionPath, Segment
from tests.support.compiling import quick

K, W = 40, 5
CONFIG = FilterConfig(0.05, 4, W, history="core")
"""Five clones a second: horizons of 5 and 25 intervals fit into 8 s."""

relative_displacement = quick(filter_losses.relative_displacement, static_argnums=2)
relative_yaw = quick(filter_losses.relative_yaw, static_argnums=2)
window_error = quick(jax.value_and_grad(filter_losses.window_error, (0, 1)), static_argnums=3)
"""With its derivatives by what the network says and by the filter's path."""


def paths(seed=0):
    """A true path that turns, and an estimate that is off by tilt, yaw, velocity and position; the
    body's x axis is nearly vertical, where the difference of two yaws would be useless."""
    rng = np.random.default_rng(seed)
    turns = np.cumsum(0.1 * rng.standard_normal(K + 1))
    upright = Rotation.from_euler("y", -1.5)
    true = Rotation.from_euler("z", turns[:, None]) * upright
    error = Rotation.from_rotvec(0.2 * rng.standard_normal((K + 1, 3)))
    position = np.cumsum(0.3 * rng.standard_normal((K + 1, 3)), 0)
    truth = MotionPath(true.as_matrix(), rng.standard_normal((K + 1, 3)), position)
    estimate = MotionPath(
        (error * true).as_matrix(),
        truth.velocity + 0.1 * rng.standard_normal((K + 1, 3)),
        position + 0.1 * rng.standard_normal((K + 1, 3)),
    )
    return estimate, truth


def yaw_errors(estimate, truth):
    turn = np.einsum("kij,klj->kil", estimate.rotation, truth.rotation)
    return np.arctan2(turn[:, 1, 0], turn[:, 0, 0])


def distance(position, i, j):
    return sum(np.linalg.norm(position[m + 1] - position[m]) for m in range(i, j))


def relative(count):
    estimate, truth = paths()
    psi = yaw_errors(estimate, truth)
    displacement, yaw = [], []
    for i in range(K + 1 - count):
        j = i + count
        back = Rotation.from_euler("z", -psi[i])
        moved = back.apply(estimate.position[j] - estimate.position[i])
        error = moved - (truth.position[j] - truth.position[i])
        scale = distance(truth.position, i, j) ** 2 + 1.0
        displacement.append(error @ error / scale)
        yaw.append(4 * np.sin((psi[j] - psi[i]) / 2) ** 2 / scale)
    return np.mean(displacement), np.mean(yaw)


def test_a_turned_and_shifted_estimate_has_no_relative_error():
    _, truth = paths()
    turn = Rotation.from_euler("z", 2.0)
    moved = turn.apply(truth.position) + np.array([3.0, 2.0, 1.0])
    estimate = MotionPath(turn.as_matrix() @ truth.rotation, truth.velocity, moved)
    for loss in (relative_displacement, relative_yaw):
        assert abs(loss(estimate, truth, 7)) < 1e-25
    # Where the path stands still, too, with a gradient.
    still = truth._replace(position=np.zeros_like(truth.position))

    def of(position):
        return filter_losses.relative_displacement(estimate._replace(position=position), still, 3)

    assert np.isfinite(quick(jax.grad(of))(jnp.zeros((K + 1, 3)))).all()


def test_the_relative_translation_is_kittis():
    """The mean over pieces one by one, in 100 m units here: 1 % where the estimate is 1 % long."""
    _, truth = paths(1)
    steps = np.random.default_rng(2).uniform(5.0, 25.0, (K, 1)) * [[1.0, 0.2, -0.1]]
    position = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)])
    truth = truth._replace(position=position)
    turn = Rotation.from_rotvec([0.02, -0.03, 0.01]).as_matrix()
    estimate = truth._replace(position=1.02 * position, rotation=turn @ truth.rotation)
    every, errors = 5, []
    for i in range(0, K, every):
        for length in range(100, 900, 100):
            far = [j for j in range(i, K + 1) if distance(position, i, j) > length]
            if far:
                moves = [
                    path.rotation[i].T @ (path.position[far[0]] - path.position[i])
                    for path in (estimate, truth)
                ]
                errors.append(np.hypot(np.linalg.norm(moves[0] - moves[1]) / length, 1e-3))
    relative = jax.value_and_grad(filter_losses.relative_translation, has_aux=True)
    relative = quick(relative, static_argnums=2)
    (value, pieces), slope = relative(estimate, truth, every)
    assert len(errors) > 20 and value == pytest.approx(np.mean(errors), rel=1e-9)
    assert pieces == len(errors)
    # A path that is too short has none, and an error of zero has a derivative.
    assert relative(*paths(), every)[0] == (0, 0)
    for one, other in ((truth, truth), paths()):
        assert np.isfinite(relative(one, other, every)[1].position).all()
    assert np.abs(slope.position).max() > 0


def test_the_likelihood_of_innovations_is_the_mean_over_those_that_there_are():
    likelihood = np.array([np.nan, 2.0, np.nan, 5.0])
    value_and_slope = quick(jax.value_and_grad(filter_losses.innovation_nll))
    value, slope = value_and_slope(likelihood)
    assert value == -3.5 and value_and_slope(np.full(4, np.nan))[0] == 0
    np.testing.assert_array_equal(slope, [0, -0.5, 0, -0.5])


def windows_told(estimate, truth):
    """What a network without error says: the true displacement in the filter's own yaw frame, which
    is off the true one by the yaw error."""
    psi = yaw_errors(estimate, truth)
    yaws = np.arctan2(estimate.rotation[:, 1, 0], estimate.rotation[:, 0, 0])
    displacements = np.full((K, 3), np.nan)
    for k in range(W, K):  # row k: after interval k, at index k + 1 of a path
        i, j = k + 1 - W, k + 1
        displacements[k] = Rotation.from_euler("z", psi[i] - yaws[i]).apply(
            truth.position[j] - truth.position[i]
        )
    return displacements


def test_window_error():
    """The filter's frame is no part of it: no gradient turns it to make the network right."""
    estimate, truth = paths()
    displacements = windows_told(estimate, truth)
    assert window_error(displacements, estimate, truth, W)[0] < 1e-25
    off = 0.1 * np.random.default_rng(2).standard_normal((K, 3))
    off[10] = np.nan
    error, (slope, of_frame) = window_error(displacements + off, estimate, truth, W)
    np.testing.assert_allclose(error, np.nanmean(np.sum(off[W:] ** 2, 1)), rtol=1e-12)
    assert np.isfinite(slope).all() and slope[W:10].any()
    assert not slope[10].any() and not slope[:W].any() and not of_frame.rotation.any()


def test_the_sum_has_the_weights_and_the_horizons_that_fit():
    estimate, truth = paths()
    rng = np.random.default_rng(4)
    roots = rng.standard_normal((K, 15, 15)) + 4 * np.eye(15)
    nothing = {name: None for name in FilterHistory._fields}
    history = FilterHistory(**nothing)._replace(
        covariance=roots @ roots.transpose(0, 2, 1),
        log_likelihood=rng.standard_normal(K),
        displacement=windows_told(estimate, truth) + 0.1,
        nis=np.where(np.arange(K) < 5, np.nan, 6.0),
        healthy=np.ones(K),
    )
    names = ("displacement", "yaw", "innovation", "state", "window", "translation")
    of_each = dict(zip(names, (2.0, 3.0, 5.0, 7.0, 11.0, 13.0), strict=True))
    weights = ThroughFilter(**{f"{name}_weight": value for name, value in of_each.items()})
    losses = quick(filter_losses.filter_losses, static_argnums=(3, 4))
    signal, nowhere = np.zeros((4 * K, 3)), np.full((4 * K, 2), np.nan)
    segment = Segment(signal, signal, truth, nowhere, jnp.bool_(False))
    figures = losses(estimate, segment, history, CONFIG, weights)
    np.testing.assert_allclose(figures.displacement, [relative(5)[0], relative(25)[0]], rtol=1e-12)
    np.testing.assert_allclose(figures.yaw, [relative(5)[1], relative(25)[1]], rtol=1e-12)
    error = np.concatenate(
        [truth.velocity - estimate.velocity, truth.position - estimate.position], 1
    )[1:]
    nll = [
        -multivariate_normal(cov=p[3:9, 3:9]).logpdf(e) - 3 * np.log(2 * np.pi)
        for e, p in zip(error, history.covariance, strict=True)
    ]
    np.testing.assert_allclose(figures.state, np.mean(nll), rtol=1e-9)
    np.testing.assert_allclose(figures.innovation, -history.log_likelihood.mean(), rtol=1e-12)
    np.testing.assert_allclose(figures.window, 0.03, rtol=1e-12)
    total = sum(np.mean(getattr(figures, name)) * value for name, value in of_each.items())
    np.testing.assert_allclose(figures.total, total, rtol=1e-12)
    squares = [
        e[3:] @ np.linalg.solve(p[6:9, 6:9], e[3:])
        for e, p in zip(error, history.covariance, strict=True)
    ]
    np.testing.assert_allclose(figures.nees, np.mean(squares) / 3, rtol=1e-9)
    assert figures.nis == 2.0 and figures.healthy
