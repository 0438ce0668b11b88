"""CTIN against a plain NumPy forward pass of the whole network, causality included."""

import jax.numpy as jnp
import numpy as np

from gnio_jax import models
from gnio_jax.models import heads
from tests.support.networks import SMALL, drawn, predicted, shapes
from tests.support.numpy_layers import (
    attention,
    batch_norm,
    conv_norm,
    float64,
    layer_norm,
    linear,
    relu,
    sigmoid,
    softmax,
)

OPTIONS = SMALL["ctin"] | {"output_dim": 2}


def lstm(x, q):
    h = c = np.zeros(q["hi"]["bias"].shape)
    states = []
    for step in x:
        i, f, g, o = (
            linear(step, q[f"i{gate}"]) + h @ q[f"h{gate}"]["kernel"] + q[f"h{gate}"]["bias"]
            for gate in "ifgo"
        )
        c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
        h = sigmoid(o) * np.tanh(c)
        states.append(h)
    return np.array(states)


def local_attention(x, q, s, groups=4):
    n, channels = x.shape
    padded, size = np.vstack([np.zeros(channels), x, np.zeros(channels)]), channels // groups
    key = np.zeros((n, channels))
    for t in range(n):
        for out in range(channels):
            group = slice(out // size * size, out // size * size + size)
            kernel = q["key_conv"]["kernel"][:, :, out]
            key[t, out] = sum(padded[t + k, group] @ kernel[k] for k in range(3))
    key = relu(batch_norm(key, q["key_bn"], s["key_bn"]))
    value = conv_norm(x, "value_conv", q, s)
    scores = linear(relu(conv_norm(np.hstack([x, key]), "hidden_conv", q, s)), q["weights"])
    context = np.zeros((n, channels))
    for t in range(n):
        for c in range(channels):
            weights = softmax(scores[t, c::channels])
            inside = [k for k in range(3) if 0 <= t + k - 1 < n]
            context[t, c] = sum(weights[k] * value[t + k - 1, c] for k in inside)
    pooled = relu(linear((context + key).mean(axis=0), q["squeeze"]))
    shares = softmax(linear(pooled, q["excite"]).reshape(2, channels), 0)
    return shares[0] * context + shares[1] * key


def numpy_forward(variables, windows):
    """Velocities and log standard deviations of every step, with a vertical of 0."""
    (p, s), outputs = float64(variables), []
    for window in np.asarray(windows, np.float64):
        q = p["spatial_embedding"]
        x = linear(conv_norm(window, "conv", q, s["spatial_embedding"], 1, 1), q["linear"])
        q, t = p["encoder"], s["encoder"]
        y = local_attention(relu(conv_norm(x, "reduce_conv", q, t)), q["local"], t["local"])
        memory = relu(x + conv_norm(attention(y, y, y, q["global"]), "expand_conv", q, t))
        q = p["temporal_embedding"]
        backward = lstm(window[::-1], q["lstm_backward"])[::-1]
        x = np.hstack([lstm(window, q["lstm_forward"]), backward]) + q["positions"]
        for layer in (1, 2):
            q = p[f"decoder_{layer}"]
            x = layer_norm(x + attention(x, x, x, q["self"], causal=True), q["self_norm"])
            x = layer_norm(x + attention(x, memory, memory, q["cross"]), q["cross_norm"])
            y = linear(relu(linear(x, q["expand"])), q["contract"])
            x = layer_norm(x + y, q["ffn_norm"])
        trees = (p["velocity"], p["log_std"])
        pair = [linear(layer_norm(linear(x, q["hidden"]), q["norm"]), q["output"]) for q in trees]
        outputs.append(pair)
    return np.pad(np.array(outputs), ((0, 0), (0, 0), (0, 0), (0, 1))).swapaxes(0, 1)


def test_forward_against_numpy():
    model = models.create("ctin", **OPTIONS)
    variables = drawn(shapes("ctin", 11, **OPTIONS), size=0.4)
    windows = np.random.default_rng(6).standard_normal((2, 11, 6)).astype(np.float32)
    velocity, log_std = numpy_forward(variables, windows)
    for values in (velocity[..., :2], log_std[..., :2]):  # windows and steps are told apart
        assert np.ptp(values, axis=0).max() > 0.1 and np.ptp(values, axis=1).min() > 0.05
    task = variables["params"]["task_log_std"]
    for prediction in predicted(model, variables, windows):
        for ours, expected in (
            (prediction.diagnostics["velocity"], velocity),
            (prediction.diagnostics["velocity_log_std"], log_std),
            (prediction.diagnostics["task_log_std"], np.stack([task, task])),
            (prediction.displacement, velocity.mean(axis=1)),
            (prediction.log_std, 0.5 * np.log(np.mean(np.exp(2 * log_std), axis=1))),
        ):
            np.testing.assert_allclose(ours, expected, rtol=1e-3, atol=1e-4)


def test_the_mean_of_variances_does_not_overflow():
    log_std = jnp.array([[[-2.0, 0.0, 90.0], [1.0, 0.0, -90.0]]], jnp.float32)
    expected = [[0.5 * np.log((np.exp(-4) + np.exp(2)) / 2), 0, 90 - 0.5 * np.log(2)]]
    np.testing.assert_allclose(heads.root_mean_square(log_std), expected, rtol=1e-6)
