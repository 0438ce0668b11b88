"""Experts: the mixture of their predictions, the router's input, and the balance."""

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import models
from gnio_jax.config import LossConfig
from gnio_jax.models import experts, resnet
from gnio_jax.training import network_losses
from gnio_jax.training.losses import loss_stage, losses
from gnio_jax.types import Prediction, Windows
from tests.support.compiling import quick
from tests.support.networks import drawn
from tests.support.numpy_layers import float64, linear, relu, softmax

RNG = np.random.default_rng(6)


def test_the_mixture_against_numpy(monkeypatch):
    """Mean and variance are those of draws from the experts; the encoders are taken as they are."""
    monkeypatch.setattr(resnet, "GROUP_STRIDES", (1,))
    monkeypatch.setattr(resnet, "BLOCKS_PER_GROUP", 1)
    model = models.create("experts", width=3, experts=3)
    windows = RNG.normal([0, 0, 9.8, 0, 0, 0], 1.0, (2, 40, 6)).astype(np.float32)
    variables = drawn(models.variable_shapes(model, 40))
    prediction = jax.device_get(quick(model.apply)(variables, jnp.asarray(windows)))
    encoder = quick(lambda v, x: resnet.ResNet18(3).apply(v, x, False))
    q, _ = float64(variables)
    for number, x in enumerate(windows.astype(float)):
        power = np.zeros((16, 2))
        for sensor, part in enumerate((x[:, :3], x[:, 3:])):
            size = np.linalg.norm(part, axis=1)
            for f in range(16):
                line = sum(size[t] * np.exp(-2j * np.pi * f * t / 40) for t in range(40)) / 40
                power[f, sensor] = np.log(abs(line) ** 2 + 1e-6)
        hidden = relu(linear(power.ravel(), q["router_hidden"]))
        shares = softmax(linear(hidden, q["router"]))
        np.testing.assert_allclose(prediction.diagnostics["router"][number], shares, atol=1e-4)
        d, u = [], []
        for k in (1, 2, 3):
            part = {
                kind: tree[f"expert{k}"] for kind, tree in variables.items() if f"expert{k}" in tree
            }
            h = np.asarray(encoder(part, windows[number][None]))[0].mean(0)
            d.append(linear(h, q[f"expert{k}_displacement"]["displacement"]))
            u.append(linear(h, q[f"expert{k}_log_std"]["log_std"]))
        d, u = np.array(d), np.array(u)
        mean = shares @ d
        second = shares @ (np.exp(2 * u) + d**2)
        np.testing.assert_allclose(prediction.displacement[number], mean, atol=2e-4)
        np.testing.assert_allclose(
            np.exp(2 * prediction.log_std[number]), second - mean**2, rtol=2e-3
        )
    jax.clear_caches()


def test_what_the_router_sees_does_not_turn_and_short_windows_are_filled_up():
    windows = RNG.standard_normal((1, 20, 6))
    turn, _ = np.linalg.qr(RNG.standard_normal((3, 3)))
    turned = (windows.reshape(1, 20, 2, 3) @ turn).reshape(1, 20, 6)
    see = quick(experts.spectrum)
    spectrum = see(jnp.asarray(windows))
    np.testing.assert_allclose(see(jnp.asarray(turned)), spectrum, atol=1e-5)
    assert spectrum.shape == (1, 32) and not np.any(spectrum[0, 22:])
    sizes = np.linalg.norm(windows[0].reshape(20, 2, 3), axis=-1)
    power = np.abs(np.fft.rfft(sizes, axis=0) / 20) ** 2
    np.testing.assert_allclose(spectrum[0, :22], np.log(power + 1e-6).ravel(), atol=1e-4)


def test_the_loss_has_the_balance_of_the_shares():
    shares = np.array([[1.0, 0.0], [0.5, 0.5]])
    balance = network_losses.balance(jnp.asarray(shares))
    np.testing.assert_allclose(balance, 2 * (0.75**2 + 0.25**2) - 1)
    zeros = jnp.zeros((2, 3))
    prediction = Prediction(zeros, zeros, {"router": jnp.asarray(shares)})
    windows = Windows(jnp.zeros((2, 5, 6)), zeros, jnp.zeros((2, 5, 3)))
    config = LossConfig(balance_weight=3.0)
    loss = losses(prediction, windows, config, loss_stage(config, 0, 1)).total
    np.testing.assert_allclose(loss, 3 * balance, rtol=1e-6)
