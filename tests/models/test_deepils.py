"""DeepILS against a plain NumPy forward pass of the whole network."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from gnio_jax.models import deepils
from tests.support import networks
from tests.support.compiling import quick
from tests.support.networks import drawn

shapes = functools.partial(networks.shapes, "deepils")


def numpy_forward(variables, windows):
    """Float64, one window at a time; sums over taps and channels written out."""
    p, s = (
        jax.tree.map(lambda x: np.asarray(x, np.float64), variables[name])
        for name in ("params", "batch_stats")
    )
    relu, sigmoid = (lambda x: np.maximum(x, 0)), (lambda x: 1 / (1 + np.exp(-x)))

    def conv(x, kernel, stride, padding):
        x = np.pad(x, ((padding, padding), (0, 0)))
        return np.array(
            [
                sum(x[r + k] @ kernel[k] for k in range(len(kernel)))
                for r in range(0, len(x) - len(kernel) + 1, stride)
            ]
        )

    def depthwise(x, kernel, stride):
        out = np.zeros((-(-len(x) // stride), x.shape[1]))
        for r in range(len(out)):
            for k in (0, 1, 2):
                if 0 <= r * stride + k - 1 < len(x):
                    out[r] += x[r * stride + k - 1] * kernel[k, 0]
        return out

    def norm(x, name, params, stats):
        return (x - stats[name]["mean"]) / np.sqrt(stats[name]["var"] + 1e-5) * params[name][
            "scale"
        ] + params[name]["bias"]

    def block(x, q, t, stride):
        y = conv(depthwise(x, q["depthwise1"]["kernel"], stride), q["conv1"]["kernel"], 1, 0)
        y = relu(norm(y, "bn1", q, t))
        y = norm(
            conv(depthwise(y, q["depthwise2"]["kernel"], 1), q["conv2"]["kernel"], 1, 0),
            "bn2",
            q,
            t,
        )
        squeeze, excite = (q["channel_attention"][name]["kernel"] for name in ("squeeze", "excite"))
        y = y * sigmoid(
            sum(relu(pooled @ squeeze) @ excite for pooled in (y.mean(axis=0), y.max(axis=0)))
        )
        over_channels = np.array([[step.mean(), step.max()] for step in y])
        y = y * sigmoid(conv(over_channels, q["time_attention"]["conv"]["kernel"], 1, 3))
        if "shortcut_conv" in q:
            x = norm(x[::stride] @ q["shortcut_conv"]["kernel"][0], "shortcut_bn", q, t)
        return relu(x + y)

    outputs = []
    for x in np.asarray(windows, np.float64):
        x = relu(norm(conv(x, p["stem_conv"]["kernel"], 2, 3), "stem_bn", p, s))
        x = np.array([x[max(0, r - 1) : r + 2].max(axis=0) for r in range(0, len(x), 2)])
        for group in range(4):
            for b in range(2):
                name = f"group{group + 1}_block{b + 1}"
                x = block(x, p[name], s[name], 2 if group and not b else 1)
        head = p["displacement"]
        x = norm(x @ head["neck_conv"]["kernel"][0], "neck_bn", head, s["displacement"])
        x = np.concatenate([x[:, channel] for channel in range(x.shape[1])])
        for name in ("fc1", "fc2", "fc3"):
            x = x @ head[name]["kernel"] + head[name]["bias"]
            x = relu(x) if name != "fc3" else x
        outputs.append(x)
    return np.array(outputs)


@pytest.mark.parametrize("samples, output_dim", [(100, 2), (200, 3)])
def test_forward_against_numpy_frozen_or_not(samples, output_dim):
    model = models.create("deepils", width=8, output_dim=output_dim)
    variables = drawn(shapes(samples, width=8, output_dim=output_dim))
    windows = jax.random.normal(jax.random.key(1), (2, samples, 6), jnp.float32)
    apply, wanted = quick(model.apply), numpy_forward(variables, windows)
    found = apply(variables, windows)
    assert np.ptp(wanted, axis=0).min() > 1e-2  # the windows are told apart
    np.testing.assert_allclose(found.displacement[:, :output_dim], wanted, rtol=2e-4, atol=2e-5)
    np.testing.assert_array_equal(found.displacement[:, output_dim:], 0)
    constant = variables["batch_stats"]["uncertainty"]["log_std"]
    np.testing.assert_array_equal(found.log_std, np.stack([constant, constant]))

    frozen = models.inference_variables(model, variables)
    frozen = apply(frozen.variables, windows).displacement[:, :output_dim]
    np.testing.assert_allclose(frozen, wanted, rtol=2e-4, atol=2e-5)


def test_the_gradient_of_a_maximum_goes_to_one_place():
    x = jnp.asarray([[[1.0, -4.0], [3.0, -2.0], [3.0, -5.0]]], jnp.float32)
    for axis, first in ((1, [[0, 0], [1, 1], [0, 0]]), (2, [[1, 0], [1, 0], [1, 0]])):
        largest = functools.partial(deepils._maximum, axis=axis)
        gradient = jax.grad(lambda x, largest=largest: jnp.sum(largest(x)))
        found, slope = quick(lambda x, f=largest, g=gradient: (f(x), g(x)))(x)
        np.testing.assert_array_equal(found, np.max(x, axis=axis))
        np.testing.assert_array_equal(slope[0], first)
