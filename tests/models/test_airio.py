"""AirIO against plain NumPy, and its velocity in the filter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import models
from gnio_jax.config import LossConfig
from gnio_jax.models import airio
from gnio_jax.training.losses import loss_stage, losses
from gnio_jax.types import Prediction, Windows
from tests.support.compiling import quick
from tests.support.networks import drawn, predicted
from tests.support.numpy_layers import batch_norm, both_ways, conv, float64, gelu, linear

RNG = np.random.default_rng(4)


def with_axes(attitude, accel, gyro):
    """Windows of 12 channels from samples in the body, one window after the other."""
    parts = [
        np.einsum("nij,nj->ni", turn, vector)
        for turn, *vectors in zip(attitude, accel, gyro, strict=True)
        for vector in vectors
    ]
    first, second = (np.stack(parts[k::2]) for k in (0, 1))
    return np.float32(np.concatenate([first, second, *np.moveaxis(attitude[..., :2], 3, 0)], -1))


def encoded(x, q, s):
    for k in "12":
        x = conv(x, q[f"filter{k}"]["kernel"], 3, 3) + q[f"filter{k}"]["bias"]
        x = gelu(batch_norm(x, q[f"norm{k}"], s[f"norm{k}"]))
    return x


def decoded(x, q):
    return linear(gelu(linear(x, q["fc1"])), q["fc2"])


def test_forward_against_numpy():
    attitude = Rotation.random(2 * 40, RNG).as_matrix().reshape(2, 40, 3, 3)
    accel, gyro = RNG.standard_normal((2, 2, 40, 3))
    model = models.create("airio", width=4)
    variables = drawn(models.variable_shapes(model, 40))
    (q, s), expected = float64(variables), []
    for turn, a, w in zip(attitude, accel, gyro, strict=True):
        vector = Rotation.from_matrix(turn).as_rotvec()
        parts = {"imu": np.hstack([a, w]), "attitude": vector}
        x = np.hstack([encoded(parts[k], q[k], s[k]) for k in parts])
        x = gelu(batch_norm(linear(x, q["projection"]), q["projection_norm"], s["projection_norm"]))
        for layer in ("gru1", "gru2"):
            x, _ = both_ways(x, q[layer], "gru")
        rows, steps = [14, 23, 32, 40, 40], [18.5, 9, 8.5, 4, 0]  # steps nearest to each row
        turn = np.concatenate([turn, [turn[-1] @ turn[-2].T @ turn[-1]]])  # of the window's end
        v, variance = decoded(x, q["displacement"]), np.exp(decoded(x, q["log_std"]) - 5)
        moved = np.average([turn[r] @ v[k] for k, r in enumerate(rows)], axis=0, weights=steps)
        spread = [np.diag(turn[r] @ np.diag(variance[k]) @ turn[r].T) for k, r in enumerate(rows)]
        expected.append((v, moved, np.log(np.average(spread, axis=0, weights=steps)) / 2))
    velocity, moved, log_std = (np.stack(part) for part in zip(*expected, strict=True))
    for prediction in predicted(model, variables, with_axes(attitude, accel, gyro), False):
        np.testing.assert_allclose(prediction.diagnostics["body_velocity"], velocity, atol=1e-5)
        np.testing.assert_allclose(prediction.displacement, moved, atol=1e-5)
        np.testing.assert_allclose(prediction.log_std, log_std, atol=1e-5)


def test_rotation_vectors_are_scipys_and_their_derivative_is_finite_at_the_identity():
    angles = np.concatenate([[1e-9, 1e-5, 1e-3], np.linspace(0.1, np.pi - 1e-3, 40)])
    axis = RNG.standard_normal((len(angles), 3))
    vectors = angles[:, None] * axis / np.linalg.norm(axis, axis=1)[:, None]
    matrices = Rotation.from_rotvec(vectors).as_matrix()
    rotation_vectors = quick(airio.rotation_vector)(jnp.asarray(matrices))
    np.testing.assert_allclose(rotation_vectors, vectors, atol=1e-9)
    slope = quick(jax.jacrev(airio.rotation_vector))(jnp.eye(3))
    # The vector of I + hat(v) is v to first order.
    hat = np.array([[0, -3, 2], [3, 0, -1], [-2, 1, 0]]) * 1.0
    np.testing.assert_allclose(np.einsum("ijk,jk->i", slope, hat), [1, 2, 3], atol=1e-9)


def test_the_loss_is_hubers_and_the_likelihood_of_the_velocity_in_the_body():
    """On a flight with constant acceleration and rate, whose velocities and attitudes at the labels
    and at the window's end are known."""
    samples, rows = 30, np.array([14, 23, 30, 30])
    dt = 1 / samples  # a window of 1 s, so that m/s are metres per window
    start, accel, rate = [2.0, -1.0, 0.5], np.array([3.0, 5.0, -4.0]), np.array([1.0, -2.0, 4.0])
    time = dt * np.arange(samples + 1)[:, None]
    position = start * time + accel * time**2 / 2
    tilted = Rotation.from_euler("xyz", [0.4, -0.2, 0.9])
    turns = tilted * Rotation.from_rotvec(rate * time)
    attitude, steps = turns[:-1].as_matrix()[None], np.diff(position, axis=0)[None]
    zeros = np.zeros((1, samples, 3))
    velocity, log_std = RNG.standard_normal((2, 1, 4, 3))
    # One error is within Huber's bound.
    truth = turns[rows].inv().apply(start + accel * time[rows])
    velocity[0, 0] = truth[0] + 0.004
    error, bound = truth - velocity[0], 0.005
    huber = np.where(abs(error) < bound, error**2 / 2, bound * (abs(error) - bound / 2))
    likelihood = error**2 / np.exp(2 * log_std[0]) + 2 * log_std[0]
    expected = 100 * (huber.mean() + 1e-4 * likelihood.mean())
    says = {"body_velocity": jnp.asarray(velocity), "body_velocity_log_std": jnp.asarray(log_std)}
    prediction = Prediction(jnp.zeros((1, 3)), jnp.zeros((1, 3)), says)
    imu = jnp.asarray(with_axes(attitude, zeros, zeros), jnp.float32)
    windows = Windows(imu, jnp.zeros((1, 3)), jnp.asarray(steps))
    config = LossConfig(name="body_velocity")
    loss = losses(prediction, windows, config, loss_stage(config, 0, 1)).total
    np.testing.assert_allclose(loss, expected, rtol=1e-5)


@pytest.mark.parametrize("samples", [100, 200])
def test_true_velocities_add_up_to_the_displacement_and_the_last_is_that_of_the_end(samples):
    dt = 1 / samples
    time = dt * np.arange(samples + 1)
    position = 0.7 * time + 1.5 * time**2 + 0.04 * np.sin(9 * time)  # 3 m/s² forwards
    true = 0.7 + 3.0 * time + 0.36 * np.cos(9 * time)
    steps = jnp.asarray(np.outer(np.diff(position), [1.0, 1.0, 1.0]))[None]
    velocity = np.asarray(airio.velocities(steps))[0, :, 0] / dt
    np.testing.assert_allclose(velocity, true, atol=40 * dt**2)
    rows = airio.label_rows(samples)
    assert rows[-1] == samples
    np.testing.assert_allclose(airio.label_shares(samples) @ true[rows], position[-1], atol=0.04)
