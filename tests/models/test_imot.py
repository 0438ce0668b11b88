"""iMoT against a plain NumPy forward pass of the whole network."""

import numpy as np
from scipy.special import erf

from gnio_jax import models
from gnio_jax.models import imot
from tests.support.networks import SMALL, drawn, predicted, shapes
from tests.support.numpy_layers import (
    attention,
    float64,
    layer_norm,
    linear,
    relu,
    sigmoid,
    softmax,
)

OPTIONS = SMALL["imot"] | {"output_dim": 2}


def test_heads_divide_the_window():
    assert [imot.head_count(t, most) for t, most in ((200, 8), (100, 8), (97, 8))] == [8, 5, 1]


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


def perceptron(x, q):
    return linear(relu(linear(x, q["hidden"])), q["output"])


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
    y = linear(y * sigmoid(y.mean(axis=0)), q["conv1"])
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
    """Velocity, particles, weights."""
    (p, _), results = float64(variables), []
    for window in np.asarray(windows, np.float64):
        t, channels = len(window), window.T
        for layer in (1, 2):
            q = p[f"encoder_{layer}"]
            x = decoupled(channels)
            e = perceptron(x, q["positions"]) * np.array([waves(i, t) for i in range(18)])
            y = spatial(x, q["attention_spatial"]) + attention(x + e, x + e, x, q["attention"])
            x = layer_norm(y, q["attention_norm"])
            x = layer_norm(spatial(x, q["ffn_spatial"]) + perceptron(x, q["ffn"]), q["ffn_norm"])
            parts = [(x[i : i + 3] + x[i + 3 : i + 6] + x[i + 6 : i + 9]) / 2 for i in (0, 9)]
            channels = np.vstack(parts)
        particles = p["particles"]
        content = np.zeros((len(particles), t))
        size = 2 * (t // (2 * particles.shape[1]))
        for layer in (1, 2):
            q = p[f"decoder_{layer}"]
            rows = [[wave for c in row for wave in waves(2 * np.pi * c, size)] for row in particles]
            located = np.array([row + [0] * (t - len(row)) for row in rows])
            where = perceptron(located, p["particle_positions"])
            among = among_particles(content, where, q["self"], heads)
            content = layer_norm(content + among, q["self_norm"])
            contents = []
            for name, rows in (("accel", slice(0, 9)), ("gyro", slice(9, 18))):
                inputs = np.hstack([content, where]), np.hstack([x[rows], e[rows]]), x[rows]
                contents.append(
                    layer_norm(content + attention(*inputs, q[name]), q[f"{name}_norm"])
                )
            content = perceptron(np.hstack(contents), q["fusion"])
            content = layer_norm(content + perceptron(content, q["ffn"]), q["ffn_norm"])
            particles = particles + perceptron(content, p["refinement"])
        scores = [perceptron(content[:, feature], p["scores"]["mlp"]) for feature in range(t)]
        weights = softmax(np.mean(scores, axis=0))
        results.append((weights @ particles, particles, weights))
    return tuple(map(np.array, zip(*results, strict=True)))


def test_forward_against_numpy():
    model = models.create("imot", **OPTIONS)
    variables = drawn(shapes("imot", 14, **OPTIONS), size=0.3)
    windows = np.random.default_rng(4).standard_normal((2, 14, 6)).astype(np.float32)
    velocity, particles, weights = numpy_forward(variables, windows, heads=2)
    # The windows are told apart.
    assert np.ptp(velocity, axis=0).min() > 0.02 and np.ptp(weights, axis=0).max() > 1e-3
    constant = variables["batch_stats"]["uncertainty"]["log_std"]
    for prediction in predicted(model, variables, windows):
        diagnostics = prediction.diagnostics
        np.testing.assert_allclose(diagnostics["particles"], particles, rtol=1e-3, atol=2e-4)
        np.testing.assert_allclose(diagnostics["particle_weights"], weights, rtol=1e-3, atol=1e-5)
        displacement = np.pad(velocity, ((0, 0), (0, 1)))
        np.testing.assert_allclose(prediction.displacement, displacement, rtol=1e-3, atol=2e-4)
        np.testing.assert_array_equal(prediction.log_std, np.stack([constant, constant]))
