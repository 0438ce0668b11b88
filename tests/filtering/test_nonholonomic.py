"""The non-holonomic constraint: its update against finite differences, squared errors of simulated
rides, a slide, and its singular points."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import config as configuration
from gnio_jax import filtering
from gnio_jax.filtering.gaps import Gap, Imu
from gnio_jax.filtering.nonholonomic import THRESHOLD, NonHolonomic, car_axes
from tests.support import manifold
from tests.support.cars import drive
from tests.support.compiling import optimised, quick
from tests.support.random_walk import random_walk
from tests.support.walks import errors
from tests.support.whole_covariance import covariance

N, DT, RUNS, INTERVALS = 5, 0.02, 100, 200
MOUNTED = NonHolonomic(0.05, 0.1, 0.4, -0.3, 0.2, 1.2, -0.3, -0.8)
NOISE = filtering.NoiseModel(5e-4, 5e-3, 1e-5, 1e-4)
STD = filtering.InitialStd(0.02, 0.02, 0.5, 1e-3, 2e-3, 0.05)
CONFIG = filtering.FilterConfig(DT, N, 1, history="core")


@pytest.mark.parametrize("angles", [(0.4, -0.3, 0.2), (3.0, 1.2, -2.0), (0.0, np.pi / 2, 0.0)])
def test_the_axes_of_the_car_are_those_of_its_mounting(angles):
    expected = Rotation.from_euler("ZYX", angles).as_matrix().T
    np.testing.assert_allclose(car_axes(*angles), expected, atol=1e-12)


def predicted(poses, gyro):
    """Velocity of the point to the left and up, in NumPy, for poses with axes in front."""
    rotation, velocity, _, gyro_bias, _ = poses
    in_body = np.einsum("...ji,...j->...i", rotation, velocity)
    in_body = in_body + np.cross(gyro - gyro_bias, np.array(MOUNTED[-3:]))
    return (in_body @ Rotation.from_euler("ZYX", MOUNTED[2:5]).as_matrix())[..., 1:]


@quick
def updated(state, gyro):
    config = dataclasses.replace(CONFIG, clones_per_window=4, error="additive")
    imu = Imu(gyro, jnp.zeros((N, 3)), None)
    step = filtering.Step(imu, 0, 1, config, NOISE)
    return MOUNTED.update(state, step)[:2]


def test_an_update_is_the_textbooks_with_the_derivatives_by_finite_differences():
    config = dataclasses.replace(CONFIG, clones_per_window=4, error="additive")
    start, *signals = random_walk(5, n=N, clones=4, intervals=12, dt=DT, nan_rows=range(12))
    std = filtering.InitialStd(0.1, 0.1, 3.0, 1.0, 0.01, 0.1)
    ekf = filtering.Filter(config, NOISE, std)
    state, _ = filtering.run_filter(ekf, filtering.initial_state(ekf, *start), *signals)
    gyro = np.random.default_rng(0).normal(size=(N, 3))
    poses = [np.asarray(part) for part in state.mean]
    jacobian = manifold.differences(
        lambda errors: predicted(manifold.plus(poses, errors), gyro[-1]), 15
    )
    before = np.asarray(covariance(state))
    rows = np.pad(jacobian, ((0, 0), (0, len(before) - 15)))
    spread = rows @ before @ rows.T + np.diag(np.square(MOUNTED[:2]))
    gain = np.linalg.solve(spread, rows @ before).T
    residual = -predicted(poses, gyro[-1])
    after, outcome = updated(state, gyro)
    assert bool(outcome.accepted)
    np.testing.assert_allclose(outcome.residual, residual, atol=1e-12)
    nis = residual @ np.linalg.solve(spread, residual)
    np.testing.assert_allclose(outcome.nis, nis, rtol=1e-6)
    np.testing.assert_allclose(covariance(after), before - gain @ rows @ before, atol=1e-8)
    moved = manifold.plus(poses, (gain @ residual)[:15])
    for value, expected in zip(after.mean, moved, strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-7)


@optimised
def run(rides, constraint):
    def one(rotation, velocity, position, gyro, accel, displacement):
        ekf = filtering.Filter(CONFIG, NOISE, STD, measurements=(constraint,))
        state = filtering.initial_state(ekf, rotation, velocity, position)
        spread = jnp.tile(jnp.eye(3)[None], (len(displacement), 1, 1))
        return filtering.run_filter(ekf, state, gyro, accel, displacement, spread)[1]

    return jax.vmap(one)(*rides[:6])


def test_squared_errors_of_rides_are_as_the_covariance_says():
    """By degree of freedom, of 100 rides of 20 s; the mean of three components over 100 rides has a
    standard deviation of 0.08. Without the constraint the velocity would be off by metres."""
    rides = drive(2, RUNS, INTERVALS, N, DT, NOISE, STD, MOUNTED, *MOUNTED[:2])
    history = run(rides, MOUNTED)
    error, spread = errors(rides, history), np.asarray(history.covariance)
    parts = {
        "θ": [0, 1, 2],
        "v": [3, 4, 5],
        "p": [6, 7, 8],
        "b_g": [9, 10, 11],
        "b_a": [12, 13, 14],
    }
    for row in (9, 49, INTERVALS - 1):
        for name, index in parts.items():
            e, p = error[:, row][:, index], spread[:, row][:, index][:, :, index]
            nees = np.einsum("ri,ri->r", e, np.linalg.solve(p, e[:, :, None])[:, :, 0]) / 3
            assert 0.7 < nees.mean() < 1.35, (row, name, nees.mean())
    accepted = np.asarray(history.outcomes["nonholonomic"].accepted)
    assert 0.995 < accepted.mean() < 1.0
    moved = np.einsum("rkji,rkj->rki", history.rotation, history.velocity)
    moved = moved - np.einsum("rkji,rkj->rki", rides.rotation, rides.velocity)
    across = moved[:, -1] @ Rotation.from_euler("ZYX", MOUNTED[2:5]).as_matrix()[:, 1:]
    assert np.sqrt(np.mean(across**2)) < 0.15


def test_a_car_that_slides_is_not_believed_to_go_straight():
    """It drifts aside with up to 4 m/s for two seconds."""
    tight = MOUNTED._replace(lateral_std=0.1)
    seconds = np.arange(INTERVALS * N + 1) * DT
    slide = np.where(abs(seconds - 11) < 1, 2 + 2 * np.cos(np.pi * (seconds - 11)), 0.0)
    rides = drive(4, 1, INTERVALS, N, DT, NOISE, STD, tight, 0.02, 0.02, slide)
    history = run(rides, tight)
    accepted = np.asarray(history.outcomes["nonholonomic"].accepted[0])
    assert not accepted[107:114].any() and accepted[:99].mean() > 0.98 and accepted[-50:].all()
    left = Rotation.from_euler("ZYX", tight[2:5]).as_matrix()[:, 1]
    rate = rides.gyro[0, 110 * N - 1] - history.gyro_bias[0, 109]
    velocity = history.rotation[0, 109].T @ history.velocity[0, 109]
    assert abs(left @ (velocity + np.cross(rate, np.array(tight[-3:]))) - 4.0) < 0.3
    error = np.asarray(history.velocity[0]) - rides.velocity[0]
    assert np.abs(error[-1]).max() < 0.5


def test_no_velocity_is_measured_where_the_rate_is_missing():
    imu = Imu(jnp.zeros((N, 3)), jnp.zeros((N, 3)), Gap(*jnp.zeros((2, N)), jnp.ones(N)))
    held = imu._replace(gap=imu.gap._replace(gyro_variance=jnp.zeros(N).at[-1].set(1e-6)))
    ekf = filtering.Filter(CONFIG)
    state = filtering.initial_state(ekf, np.eye(3), np.ones(3), np.zeros(3))
    for samples, present in ((imu, True), (held, False)):
        step = filtering.Step(samples, 0, 1, CONFIG, NOISE)
        after, outcome, _ = MOUNTED.update(state, step)
        assert bool(outcome.present) == bool(outcome.accepted) == present
        assert np.array_equal(after.velocity, state.velocity) != present


def test_derivatives_are_finite_at_rest_and_with_the_axis_ahead_upright():
    """Also where the measurement is refused."""
    ekf = filtering.Filter(CONFIG)

    def loss(numbers, velocity):
        state = filtering.initial_state(ekf, jnp.eye(3), velocity, jnp.zeros(3))
        imu = Imu(jnp.zeros((N, 3)), jnp.zeros((N, 3)), None)
        step = filtering.Step(imu, 0, 1, CONFIG, NOISE)
        after, outcome, _ = NonHolonomic(*numbers).update(state, step)
        return jnp.sum(after.velocity**2) + outcome.nis

    gradient = quick(jax.grad(loss, (0, 1)))
    for velocity in (np.zeros(3), np.array([0.0, 100.0, 0.0]), np.array([10.0, 0.5, -0.2])):
        for pitch in (0.0, np.pi / 2, np.pi):
            numbers = np.array([*MOUNTED[:3], pitch, *MOUNTED[4:]])
            slopes = gradient(numbers, velocity)
            assert all(np.isfinite(slope).all() for slope in slopes)


def test_it_is_a_measurement_of_the_settings():
    text = "filter: {measurements: {nonholonomic: {pitch: -0.01, lateral_std: 0.5}}}"
    settings = configuration.parse(text, "text")
    (constraint,) = filtering.make_filter(settings.data, settings.filter).measurements
    assert constraint == NonHolonomic(lateral_std=0.5, pitch=-0.01)
    assert THRESHOLD == pytest.approx(-2 * np.log(0.001), abs=1e-3)
