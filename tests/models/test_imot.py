"""iMoT against a plain NumPy forward pass of the whole network, and its decoupler."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf

from gnio_jax import models
from gnio_jax.models import imot
from tests.support import networks
from tests.support.compiling import quick
from tests.support.networks import drawn

SMALL = networks.SMALL["imot"]
shapes = functools.partial(networks.shapes, "imot")


def test_heads_divide_the_window():
    params = shapes(100)["params"]
    assert params["encoder_1"]["attention"]["query"]["kernel"].shape == (100, 5, 20)
    assert params["decoder_1"]["gyro"]["key"]["kernel"].shape == (200, 5, 40)
    assert [imot.head_count(t, most) for t, most in ((200, 8), (100, 4), (97, 8))] == [8, 4, 1]


def decoupled(channels):
    """Sample by sample: the six series (6, n) to acceleration's nine and angular rate's nine."""
    n = channels.shape[1]
    at = lambda x, i: x[min(max(i, 0), n - 1)]  # noqa: E731
    rows = []
    for modality in (channels[:3], channels[3:]):
        trends = []
        for x in modality:
            nine = [sum(at(x, t + k) for k in range(-4, 5)) / 9 for t in range(n)]
            trends.append([(at(nine, t - 1) + nine[t] + at(nine, t + 1)) / 3 for t in range(n)])
        rows += [*modality, *trends, *(modality - np.array(trends))]
    return np.array(rows)


def test_a_series_is_its_trend_and_its_season():
    x = np.random.default_rng(0).normal(size=(2, 6, 25)).astype(np.float32)
    decouple = quick(imot.decouple)
    found = decouple(jnp.asarray(x))
    np.testing.assert_allclose(
        found, np.stack([decoupled(each.astype(np.float64)) for each in x]), atol=1e-5
    )
    parts = np.asarray(found).reshape(2, 2, 3, 3, 25)
    np.testing.assert_allclose(parts[:, :, 1] + parts[:, :, 2], parts[:, :, 0], atol=1e-6)
    ramp = np.tile(np.arange(25, dtype=np.float32), (2, 6, 1))
    np.testing.assert_allclose(
        decouple(ramp)[0, 6, 5:-5], 0, atol=1e-5
    )  # a steady change is trend alone, away from the ends


def softmax(x):
    e = np.exp(x - x.max())
    return e / e.sum()


def linear(x, q):
    return x @ q["kernel"] + q["bias"]


def perceptron(x, q):
    return linear(np.maximum(linear(x, q["hidden"]), 0), q["output"])


def layer_norm(x, q):
    return (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5) * q[
        "scale"
    ] + q["bias"]


def attention(query, key, value, q):
    out = np.zeros((len(query), q["out"]["kernel"].shape[-1])) + q["out"]["bias"]
    for h in range(q["query"]["kernel"].shape[1]):
        a, b, c = (
            x @ q[name]["kernel"][:, h] + q[name]["bias"][h]
            for name, x in (("query", query), ("key", key), ("value", value))
        )
        for i in range(len(a)):
            out[i] += softmax(b @ a[i] / np.sqrt(a.shape[1])) @ c @ q["out"]["kernel"][h]
    return out


def waves(x, features):
    half = features // 2
    angles = [x / 10_000 ** (i / half) for i in range(half)]
    return [np.sin(a) for a in angles] + [np.cos(a) for a in angles]


def spatial(x, q):
    y = np.hstack([x[:9], x[9:]])
    rows = np.vstack([0 * y[:1], y, 0 * y[:1]])
    y = np.array(
        [linear(np.concatenate([rows[i], rows[i + 1], rows[i + 2]]), q["conv3"]) for i in range(9)]
    )
    y = linear(y / (1 + np.exp(-y.mean(axis=0))), q["conv1"])
    y = y * 0.5 * (1 + erf(y / np.sqrt(2)))
    return np.vstack([y[:, : x.shape[1]], y[:, x.shape[1] :]])


def among_particles(content, where, q, heads):
    query, key = (
        linear(content, q[f"{name}_content"]) + linear(where, q[f"{name}_position"])
        for name in ("query", "key")
    )
    value = linear(content, q["value"])
    size = content.shape[1] // heads
    out = np.zeros_like(content)
    for h in range(heads):
        part = slice(h * size, (h + 1) * size)
        for i in range(len(content)):
            out[i, part] = softmax(key[:, part] @ query[i, part] / np.sqrt(size)) @ value[:, part]
    return linear(out, q["output"])


def numpy_forward(variables, windows, heads):
    """Float64, one window at a time: velocity, particles, weights."""
    p = jax.tree.map(lambda x: np.asarray(x, np.float64), variables["params"])
    results = []
    for window in np.asarray(windows, np.float64):
        t = len(window)
        channels = window.T
        for layer in (1, 2):
            q = p[f"encoder_{layer}"]
            x = decoupled(channels)
            e = perceptron(x, q["positions"]) * np.array([waves(i, t) for i in range(18)])
            x = layer_norm(
                spatial(x, q["attention_spatial"]) + attention(x + e, x + e, x, q["attention"]),
                q["attention_norm"],
            )
            x = layer_norm(spatial(x, q["ffn_spatial"]) + perceptron(x, q["ffn"]), q["ffn_norm"])
            channels = np.vstack(
                [(x[i : i + 3] + x[i + 3 : i + 6] + x[i + 6 : i + 9]) / 2 for i in (0, 9)]
            )
        particles = p["particles"]
        content = np.zeros((len(particles), t))
        each = 2 * (t // (2 * particles.shape[1]))
        for layer in (1, 2):
            q = p[f"decoder_{layer}"]
            located = [
                [wave for c in particle for wave in waves(2 * np.pi * c, each)]
                for particle in particles
            ]
            where = perceptron(
                np.array([row + [0] * (t - len(row)) for row in located]), p["particle_positions"]
            )
            content = layer_norm(
                content + among_particles(content, where, q["self"], heads), q["self_norm"]
            )
            found = [
                layer_norm(
                    content
                    + attention(
                        np.hstack([content, where]), np.hstack([x[rows], e[rows]]), x[rows], q[name]
                    ),
                    q[f"{name}_norm"],
                )
                for name, rows in (("accel", slice(0, 9)), ("gyro", slice(9, 18)))
            ]
            content = perceptron(np.hstack(found), q["fusion"])
            content = layer_norm(content + perceptron(content, q["ffn"]), q["ffn_norm"])
            particles = particles + perceptron(content, p["refinement"])
        weights = softmax(
            np.mean(
                [perceptron(content[:, feature], p["scores"]["mlp"]) for feature in range(t)],
                axis=0,
            )
        )
        results.append((weights @ particles, particles, weights))
    return tuple(map(np.array, zip(*results, strict=True)))


@pytest.mark.parametrize("samples, output_dim", [(20, 3), (14, 2)])
def test_forward_against_numpy(samples, output_dim):
    model = models.create("imot", output_dim=output_dim, **SMALL)
    variables = drawn(shapes(samples, output_dim=output_dim, **SMALL), size=0.3)
    windows = jax.random.normal(jax.random.key(1), (2, samples, 6), jnp.float32)
    found = quick(model.apply)(variables, windows)
    velocity, particles, weights = numpy_forward(
        variables, windows, heads=4 if samples == 20 else 2
    )
    assert (
        np.ptp(velocity, axis=0).min() > 0.02 and np.ptp(weights, axis=0).max() > 1e-3
    )  # the windows are told apart
    np.testing.assert_allclose(found.diagnostics["particles"], particles, rtol=1e-3, atol=2e-4)
    np.testing.assert_allclose(found.diagnostics["particle_weights"], weights, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(
        found.displacement, np.pad(velocity, ((0, 0), (0, 3 - output_dim))), rtol=1e-3, atol=2e-4
    )
    constant = variables["batch_stats"]["uncertainty"]["log_std"]
    np.testing.assert_array_equal(found.log_std, np.stack([constant, constant]))
