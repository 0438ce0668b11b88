"""The network's velocity in the body as a measurement, in the place of its displacement."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering.consider import disturb
from gnio_jax.training.filter_losses import velocity_error
from gnio_jax.training.segments import MotionPath
from gnio_jax.types import Prediction, Velocity
from tests.support.compiling import quick

VELOCITY, SECONDS = np.array([0.8, -0.3, 0.1]), 0.3
CONFIG = filtering.FilterConfig(
    dt=0.05,
    samples_per_clone=2,
    clones_per_window=3,
    window_rotation="body_axes",
    measures="velocity",
    history="core",
)
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def predict(windows):
    """Whatever it sees: a displacement that is nonsense, and the velocity of the body."""
    assert windows.shape == (1, 6, 12)
    velocity = Velocity(SECONDS * jnp.asarray(VELOCITY, jnp.float32)[None], jnp.full((1, 3), -5.0))
    return Prediction(jnp.full((1, 3), 99.0), jnp.zeros((1, 3)), velocity=velocity)


def setting(intervals=12, **options):
    noise = filtering.NoiseModel(measurement_scale=0.1)
    ekf = filtering.Filter(dataclasses.replace(CONFIG, **options), noise=noise)
    state = filtering.initial_state(ekf, TURN, TURN @ VELOCITY + 0.2, np.zeros(3))
    samples = 2 * intervals
    return ekf, state, np.zeros((samples, 3)), np.tile([0.0, 0.0, 9.81], (samples, 1))


def test_the_velocity_is_measured_in_the_body_and_the_displacement_is_not():
    state, history = filtering.run_odometry(predict, *setting())
    np.testing.assert_array_equal(np.isfinite(history.accepted), np.arange(12) >= 3)
    np.testing.assert_allclose(state.velocity, TURN @ VELOCITY, atol=0.05)
    # The first innovation is the error of the start, in the body and in metres per window.
    start_error = -SECONDS * TURN.T @ np.full(3, 0.2)
    np.testing.assert_allclose(history.innovation[3], start_error, atol=1e-6)
    # The covariance is that of the network times the scale, not below the smallest of the filter.
    variance = np.diagonal(history.measurement_covariance[5])
    np.testing.assert_allclose(variance, 0.1 * np.exp(-8.0), rtol=1e-6)


def test_its_jacobian_is_the_derivative_of_the_predicted_velocity():
    """By finite differences of T Rᵀ v."""
    rng = np.random.default_rng(3)
    ekf, state, *_ = setting()
    axis = rng.standard_normal(3)
    rotation = np.asarray(jax.scipy.linalg.expm(np.cross(np.eye(3), axis)))
    velocity = rng.standard_normal(3)

    def predicted(error):
        turn = jax.scipy.linalg.expm(np.cross(np.eye(3), error[:3]))
        return SECONDS * (turn @ rotation).T @ (velocity + error[3:])

    step = 1e-6
    slopes = [(predicted(step * e) - predicted(-step * e)) / (2 * step) for e in np.eye(6)]
    differences = np.array(slopes).T
    state = state._replace(rotation=jnp.asarray(rotation), velocity=jnp.asarray(velocity))
    measurement = filtering.displacement.scaled_displacement(
        jnp.zeros(3), jnp.eye(3), ekf.noise, "body"
    )
    inputs = filtering.Step(None, 0, 1, ekf.config, ekf.noise)
    linear, defined = filtering.displacement.linearise_displacement(measurement, state, inputs)
    assert defined
    np.testing.assert_allclose(linear.jacobian["rotation"], differences[:, :3], atol=1e-7)
    np.testing.assert_allclose(linear.jacobian["velocity"], differences[:, 3:], atol=1e-7)
    np.testing.assert_allclose(linear.residual, -predicted(np.zeros(6)), atol=1e-9)


def test_a_network_without_a_velocity_is_refused():
    plain = lambda windows: Prediction(jnp.zeros((1, 3)), jnp.zeros((1, 3)))  # noqa: E731
    with pytest.raises(ValueError, match="is velocity, which this network does not predict"):
        filtering.run_odometry(plain, *setting())


def test_its_rows_repeat_the_run_without_the_network():
    """As loose coupling, calibration and consider covariance do."""
    ekf, *start = setting()
    _, history = filtering.run_odometry(predict, ekf, *start)
    rows = history.unscaled_displacements(ekf.noise)
    _, repeated = filtering.run_filter(ekf, *start, *rows, frame="body")
    np.testing.assert_allclose(repeated.velocity, history.velocity, atol=1e-9)
    np.testing.assert_allclose(repeated.nis[3:], history.nis[3:], rtol=1e-6)


def test_the_tracker_measures_it_too():
    ekf, state, gyro, accel = setting()
    considered = filtering.ConsideredStd(scale=0.1, heading=0.1)
    ekf = dataclasses.replace(ekf, considered=considered)
    _, history = filtering.run_odometry(predict, ekf, state, gyro, accel)
    tracker = filtering.Tracker(predict, ekf, state)
    poses = [tracker.push(0.05 * k, *row) for k, row in enumerate(zip(gyro, accel, strict=True))]
    poses = [pose for pose in poses if pose is not None]
    assert len(poses) >= 11
    for row, pose in enumerate(poses):
        np.testing.assert_allclose(pose.velocity, history.velocity[row], atol=1e-9)
        np.testing.assert_equal(pose.accepted, float(history.accepted[row]))

    def repeat(start, rows):
        return filtering.run_filter(ekf, start, gyro, accel, rows, covariance, frame="body")[1]

    displacement, covariance = history.unscaled_displacements(ekf.noise)
    rows = filtering.sensitivity(repeat, state, displacement, history.rotation)
    added = filtering.considered_covariance(rows, considered)
    whole = filtering.with_considered(history.covariance, added, ekf.config)
    # The run disturbs a row in the attitude after its update, and the tracker in that before it.
    np.testing.assert_allclose(poses[-1].covariance, whole[len(poses) - 1], atol=1e-6)
    assert np.abs(added[-1]).max() > 1e-4


def test_a_disturbed_velocity_is_disturbed_in_the_world():
    c = np.array([0, 0, 0, 0.1, 0.3, 0.05])
    rows = VELOCITY[None]
    world = np.asarray(disturb(rows @ TURN.T, c))
    np.testing.assert_allclose(disturb(rows, c, TURN[None]), world @ TURN, atol=1e-12)


def test_training_through_the_filter_compares_velocities():
    rng = np.random.default_rng(1)
    rotation = np.stack([np.eye(3), TURN, TURN @ TURN, TURN.T])
    velocity, position = rng.standard_normal((2, 4, 3))
    truth = MotionPath(*map(jnp.asarray, (rotation, velocity, position)))
    errors = np.array([[np.nan] * 3, [0.1, 0.0, 0.2], [0.0, 0.3, 0.0]])
    measured = [
        SECONDS * rotation[k + 1].T @ velocity[k + 1] + error for k, error in enumerate(errors)
    ]
    program = quick(lambda rows, truth: velocity_error(rows, truth, SECONDS))
    loss = program(jnp.asarray(np.array(measured)), truth)
    assert float(loss) == pytest.approx((0.05 + 0.09) / 2)
