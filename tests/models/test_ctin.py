"""CTIN against a plain NumPy forward pass of the whole network, and its causality."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from gnio_jax.models import ctin, heads
from tests.support import networks
from tests.support.compiling import quick
from tests.support.networks import drawn

SMALL = networks.SMALL["ctin"]
shapes = functools.partial(networks.shapes, "ctin")


def softmax(x, axis):
    e = np.exp(x - x.max(axis=axis, keepdims=True))
    return e / e.sum(axis=axis, keepdims=True)


def linear(x, q):
    return x @ q["kernel"] + q.get("bias", 0)


def layer_norm(x, q):
    return (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5) * q[
        "scale"
    ] + q["bias"]


def attention(x, memory, q, causal=False):
    """Step by step, head by head; causal: a step sees no later one."""
    out = np.zeros((len(x), q["out"]["kernel"].shape[-1])) + q["out"]["bias"]
    for h in range(q["query"]["kernel"].shape[1]):
        query, key, value = (
            source @ q[name]["kernel"][:, h] + q[name]["bias"][h]
            for name, source in (("query", x), ("key", memory), ("value", memory))
        )
        for i in range(len(x)):
            seen = i + 1 if causal else len(memory)
            weights = softmax(key[:seen] @ query[i] / np.sqrt(query.shape[1]), 0)
            out[i] += weights @ value[:seen] @ q["out"]["kernel"][h]
    return out


def lstm(x, q):
    sigmoid = lambda z: 1 / (1 + np.exp(-z))  # noqa: E731
    h = c = np.zeros(q["hi"]["bias"].shape)
    states = []
    for step in x:
        i, f, g, o = (
            step @ q[f"i{gate}"]["kernel"] + h @ q[f"h{gate}"]["kernel"] + q[f"h{gate}"]["bias"]
            for gate in "ifgo"
        )
        c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
        h = sigmoid(o) * np.tanh(c)
        states.append(h)
    return np.array(states)


def local_attention(x, q, norm, groups=4):
    n, channels = x.shape
    padded, each = np.vstack([np.zeros(channels), x, np.zeros(channels)]), channels // groups
    key = np.zeros((n, channels))
    for t in range(n):
        for out in range(channels):
            first = out // each * each
            key[t, out] = sum(
                padded[t + k, first : first + each] @ q["key_conv"]["kernel"][k, :, out]
                for k in range(3)
            )
    key = np.maximum(norm(key, "key_bn"), 0)
    value = norm(x @ q["value_conv"]["kernel"][0], "value_bn")
    hidden = np.maximum(norm(np.hstack([x, key]) @ q["hidden_conv"]["kernel"][0], "hidden_bn"), 0)
    scores = linear(hidden, q["weights"])
    context = np.zeros((n, channels))
    for t in range(n):
        for c in range(channels):
            weights = softmax(scores[t, c::channels], 0)
            context[t, c] = sum(
                weights[k] * value[t + k - 1, c] for k in range(3) if 0 <= t + k - 1 < n
            )
    pooled = (context + key).mean(axis=0)
    shares = softmax(
        linear(np.maximum(linear(pooled, q["squeeze"]), 0), q["excite"]).reshape(2, channels), 0
    )
    return shares[0] * context + shares[1] * key


def numpy_forward(variables, windows):
    """Float64, one window at a time: velocities and log standard deviations of every step."""
    p, s = (
        jax.tree.map(lambda x: np.asarray(x, np.float64), variables[name])
        for name in ("params", "batch_stats")
    )

    def norm_of(params, stats):
        return lambda x, name: (
            (x - stats[name]["mean"]) / np.sqrt(stats[name]["var"] + 1e-5) * params[name]["scale"]
            + params[name]["bias"]
        )

    velocity, log_std = [], []
    for window in np.asarray(windows, np.float64):
        e, n = p["spatial_embedding"], len(window)
        padded = np.vstack([np.zeros(6), window, np.zeros(6)])
        x = np.array(
            [sum(padded[t + k] @ e["conv"]["kernel"][k] for k in range(3)) for t in range(n)]
        )
        x = linear(norm_of(e, s["spatial_embedding"])(x, "bn"), e["linear"])
        e = p["encoder"]
        norm = norm_of(e, s["encoder"])
        y = np.maximum(norm(x @ e["reduce_conv"]["kernel"][0], "reduce_bn"), 0)
        y = local_attention(y, e["local"], norm_of(e["local"], s["encoder"]["local"]))
        y = attention(y, y, e["global"])
        memory = np.maximum(x + norm(y @ e["expand_conv"]["kernel"][0], "expand_bn"), 0)
        t = p["temporal_embedding"]
        x = (
            np.hstack(
                [lstm(window, t["lstm_forward"]), lstm(window[::-1], t["lstm_backward"])[::-1]]
            )
            + t["positions"]
        )
        for layer in (1, 2):
            q = p[f"decoder_{layer}"]
            x = layer_norm(x + attention(x, x, q["self"], causal=True), q["self_norm"])
            x = layer_norm(x + attention(x, memory, q["cross"]), q["cross_norm"])
            x = layer_norm(
                x + linear(np.maximum(linear(x, q["expand"]), 0), q["contract"]), q["ffn_norm"]
            )
        for head, values in (("velocity", velocity), ("log_std", log_std)):
            values.append(
                linear(layer_norm(linear(x, p[head]["hidden"]), p[head]["norm"]), p[head]["output"])
            )
    return np.array(velocity), np.array(log_std)


@pytest.mark.parametrize("samples, output_dim", [(20, 3), (11, 2)])
def test_forward_against_numpy_frozen_or_not(samples, output_dim):
    model = models.create("ctin", output_dim=output_dim, **SMALL)
    variables = drawn(shapes(samples, output_dim=output_dim, **SMALL), size=0.4)
    windows = jax.random.normal(jax.random.key(1), (2, samples, 6), jnp.float32)
    apply, (velocity, log_std) = quick(model.apply), numpy_forward(variables, windows)
    missing = ((0, 0), (0, 0), (0, 3 - output_dim))
    velocity, log_std = np.pad(velocity, missing), np.pad(log_std, missing)
    for values in (velocity, log_std):  # windows and steps are told apart
        assert (
            np.ptp(values[..., :output_dim], axis=0).max() > 0.1
            and np.ptp(values[..., :output_dim], axis=1).min() > 0.05
        )
    frozen = models.inference_variables(model, variables)
    for given in (variables, frozen.variables):
        found = apply(given, windows)
        np.testing.assert_allclose(found.diagnostics["velocity"], velocity, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(
            found.diagnostics["velocity_log_std"], log_std, rtol=1e-3, atol=1e-4
        )
        np.testing.assert_allclose(found.displacement, velocity.mean(axis=1), rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(
            found.log_std,
            np.log(np.sqrt(np.mean(np.exp(log_std) ** 2, axis=1))),
            rtol=1e-3,
            atol=1e-4,
        )
        task = variables["params"]["task_log_std"]
        np.testing.assert_array_equal(found.diagnostics["task_log_std"], np.stack([task, task]))


def test_a_decoded_step_depends_on_no_later_one():
    layer = ctin.DecoderLayer(2, 10, 0.0)
    x, memory = np.random.default_rng(0).standard_normal((2, 1, 9, 12)).astype(np.float32)
    key = jax.random.key(0)
    init = lambda key, x, memory: layer.init(key, x, memory, False)  # noqa: E731
    variables = drawn(jax.eval_shape(init, key, x, memory), size=0.4)
    program = quick(lambda x, memory: layer.apply(variables, x, memory, False))
    apply = lambda x, memory: np.asarray(program(x, memory))  # noqa: E731
    later, last = (np.float32(np.arange(9) == row)[None, :, None] for row in (5, 8))
    still, changed = apply(x, memory), apply(x + later, memory)
    np.testing.assert_array_equal(still[:, :5], changed[:, :5])
    assert (np.abs(still - changed)[:, 5:].max(axis=-1) > 1e-4).all()  # and every later one does
    # The encoder is seen whole.
    assert (np.abs(still - apply(x, memory + last)).max(axis=-1) > 1e-5).all()


def test_the_mean_of_variances_does_not_overflow():
    log_std = jnp.array([[[-2.0, 0.0, 90.0], [1.0, 0.0, -90.0]]], jnp.float32)
    found = quick(heads.root_mean_square)(log_std)
    np.testing.assert_allclose(
        found, [[0.5 * np.log((np.exp(-4) + np.exp(2)) / 2), 0, 90 - 0.5 * np.log(2)]], rtol=1e-6
    )
