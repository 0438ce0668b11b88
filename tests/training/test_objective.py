"""Losses by hand, the schedule by its formula, Adam against a plain NumPy loop."""

import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gnio_jax.config import LossConfig, OptimConfig
from gnio_jax.training import losses, optimizer
from gnio_jax.types import Prediction


def test_losses_by_hand():
    prediction = Prediction(jnp.array([[1.0, 0, 0], [0, 0, 0]], jnp.float32), jnp.array([[0, 0, 0], [np.log(2), 0, -1]], jnp.float32))
    target = jnp.array([[0.0, 0, 0], [2, 1, 0]], jnp.float32)
    # First window: error 1 on x. Second: errors 2 and 1, standard deviations 2, 1, 1/e.
    mse = (1 + (4 + 1)) / 2
    nll = ((0.5) + (0.5 * 4 / 4 + 0.5 * 1 + np.log(2) - 1)) / 2
    found = losses.losses(prediction, target, LossConfig(), 1e-4)
    np.testing.assert_allclose([found.mse, found.nll, found.total], [mse, nll, 100 * mse + 1e-4 * nll], rtol=1e-6)


def test_floor_limits_what_the_likelihood_sees():
    prediction = Prediction(jnp.zeros((1, 3), jnp.float32), jnp.full((1, 3), -20.0, jnp.float32))
    target = jnp.array([[0.1, 0, 0]], jnp.float32)
    floor = float(np.log(1e-3))
    found = losses.losses(prediction, target, LossConfig(log_std_floor=floor), 1.0)
    np.testing.assert_allclose(found.nll, 0.5 * 0.1**2 / 1e-6 + 3 * floor, rtol=1e-5)


def by_formula(step, steps_per_epoch, warmup, epochs):
    if step < warmup * steps_per_epoch:
        return 1e-6 + (1e-4 - 1e-6) * step / (warmup * steps_per_epoch)
    share = (step - warmup * steps_per_epoch) / ((epochs - warmup) * steps_per_epoch)
    return 1e-6 + (1e-4 - 1e-6) * 0.5 * (1 + np.cos(np.pi * share))


@pytest.mark.parametrize("epochs, warmup", [(200, 5), (4, 2)])
def test_schedule_of_the_paper(epochs, warmup):
    """Short runs (4 epochs for a warm-up of 5) warm up for their first half."""
    rate = optimizer.schedule(OptimConfig(epochs=epochs), 7)
    for step in range(0, 7 * epochs + 1):
        assert float(rate(step)) == pytest.approx(by_formula(step, 7, warmup, epochs), rel=1e-4), step


@pytest.mark.parametrize("clip", [None, 0.5])
def test_adam_against_numpy(clip):
    config = OptimConfig(epochs=10, clip_norm=clip)
    tx = optimizer.create(config, 3)
    params = {"w": jnp.array([1.0, -2.0, 3.0], jnp.float32)}
    state = tx.init(params)
    w, m, v = np.array([1.0, -2.0, 3.0]), np.zeros(3), np.zeros(3)
    rng = np.random.default_rng(0)
    for step in range(20):
        gradient = rng.standard_normal(3)
        update, state = tx.update({"w": jnp.asarray(gradient, jnp.float32)}, state, params)
        params = optax.apply_updates(params, update)
        if clip:
            gradient = gradient * min(1, clip / np.linalg.norm(gradient))
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        rate = by_formula(step, 3, 5, 10)
        w = w - rate * (m / (1 - 0.9 ** (step + 1))) / (np.sqrt(v / (1 - 0.999 ** (step + 1))) + 1e-8)
    np.testing.assert_allclose(params["w"], w, atol=1e-6)
