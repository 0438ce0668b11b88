"""The network's velocity in the body as a measurement, in the place of its displacement."""

import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering.velocity import BodyVelocity
from gnio_jax.types import Prediction

VELOCITY = np.array([0.8, -0.3, 0.1])
CONFIG = filtering.FilterConfig(
    dt=0.05, samples_per_clone=2, clones_per_window=3, window_rotation="body_axes"
)
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def predict(windows):
    """Whatever it sees: a displacement that is nonsense, and the velocity of the body, of which
    the last one counts."""
    assert windows.shape == (1, 6, 12)
    seconds = 0.3
    velocity = jnp.stack([jnp.full(3, 50.0), seconds * jnp.asarray(VELOCITY)])[None]
    says = {"body_velocity": velocity, "body_velocity_log_std": jnp.full((1, 2, 3), -5.0)}
    return Prediction(jnp.full((1, 3), 99.0), jnp.zeros((1, 3)), says)


def run(predict, intervals=12):
    ekf = filtering.Filter(CONFIG, measurements=(BodyVelocity(),))
    state = filtering.initial_state(ekf, TURN, TURN @ VELOCITY + 0.2, np.zeros(3))
    samples = 2 * intervals
    accel = np.tile([0.0, 0.0, 9.81], (samples, 1))
    return filtering.run_odometry(predict, ekf, state, np.zeros((samples, 3)), accel)


def test_the_velocity_is_measured_in_the_body_and_the_displacement_is_not():
    state, history = run(predict)
    outcome = history.outcomes["body_velocity"]
    assert np.isnan(history.accepted).all()
    np.testing.assert_array_equal(outcome.present, np.arange(12) >= 3)
    np.testing.assert_allclose(state.velocity, TURN @ VELOCITY, atol=0.05)
    # The first residual is the error of the start, in the body.
    np.testing.assert_allclose(outcome.residual[3], -TURN.T @ np.full(3, 0.2), atol=1e-6)


def test_a_network_without_a_velocity_is_refused():
    plain = lambda windows: Prediction(jnp.zeros((1, 3)), jnp.zeros((1, 3)))  # noqa: E731
    with pytest.raises(ValueError, match="'body_velocity' needs the diagnostics 'body_velocity'"):
        run(plain)


def test_a_run_with_given_displacements_has_no_velocity():
    ekf = filtering.Filter(CONFIG, measurements=(BodyVelocity(),))
    state = filtering.initial_state(ekf, TURN, np.zeros(3), np.zeros(3))
    accel = np.tile([0.0, 0.0, 9.81], (10, 1))
    given = np.zeros((5, 3)), np.tile(0.01 * np.eye(3), (5, 1, 1))
    _, history = filtering.run_filter(ekf, state, np.zeros((10, 3)), accel, *given)
    assert not np.any(history.outcomes["body_velocity"].present)
    np.testing.assert_array_equal(history.accepted[3:], 1.0)
