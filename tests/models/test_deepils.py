"""DeepILS against a plain NumPy forward pass of the whole network."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import models
from gnio_jax.models import deepils
from tests.support.compiling import quick
from tests.support.networks import drawn, predicted, shapes
from tests.support.numpy_layers import conv, conv_norm, float64, linear, relu, resnet, sigmoid


def depthwise(x, kernel, stride):
    out = np.zeros((-(-len(x) // stride), x.shape[1]))
    for r in range(len(out)):
        for k in (0, 1, 2):
            if 0 <= r * stride + k - 1 < len(x):
                out[r] += x[r * stride + k - 1] * kernel[k, 0]
    return out


def block(x, q, s, stride):
    y = relu(conv_norm(depthwise(x, q["depthwise1"]["kernel"], stride), "conv1", q, s))
    y = conv_norm(depthwise(y, q["depthwise2"]["kernel"], 1), "conv2", q, s)
    squeeze, excite = (q["channel_attention"][name]["kernel"] for name in ("squeeze", "excite"))
    pooled = (y.mean(axis=0), y.max(axis=0))
    y = y * sigmoid(sum(relu(vector @ squeeze) @ excite for vector in pooled))
    over_channels = np.array([[step.mean(), step.max()] for step in y])
    y = y * sigmoid(conv(over_channels, q["time_attention"]["conv"]["kernel"], 1, 3))
    return relu(y + (conv_norm(x, "shortcut_conv", q, s, stride) if "shortcut_conv" in q else x))


def numpy_forward(variables, windows):
    (q, s), outputs = float64(variables), []
    for x in np.asarray(windows, np.float64):
        x = resnet(x, q, s, block)
        x = conv_norm(x, "neck_conv", q["displacement"], s["displacement"])
        x = np.concatenate([x[:, channel] for channel in range(x.shape[1])])
        for name in ("fc1", "fc2"):
            x = relu(linear(x, q["displacement"][name]))
        outputs.append(linear(x, q["displacement"]["fc3"]))
    return np.array(outputs)


def test_forward_against_numpy():
    model = models.create("deepils", width=8, output_dim=2)
    variables = drawn(shapes("deepils", 100, width=8, output_dim=2))
    windows = np.random.default_rng(1).standard_normal((2, 100, 6)).astype(np.float32)
    displacements = numpy_forward(variables, windows)
    assert np.ptp(displacements, axis=0).min() > 1e-2  # the windows are told apart
    constant = variables["batch_stats"]["uncertainty"]["log_std"]
    for prediction in predicted(model, variables, windows):
        np.testing.assert_allclose(
            prediction.displacement[:, :2], displacements, rtol=2e-4, atol=2e-5
        )
        np.testing.assert_array_equal(prediction.displacement[:, 2:], 0)
        np.testing.assert_array_equal(prediction.log_std, np.stack([constant, constant]))


def test_the_gradient_of_a_maximum_goes_to_one_place():
    x = jnp.asarray([[[1.0, -4.0], [3.0, -2.0], [3.0, -5.0]]], jnp.float32)
    for axis, first in ((1, [[0, 0], [1, 1], [0, 0]]), (2, [[1, 0], [1, 0], [1, 0]])):

        @quick
        def with_slope(x, axis=axis):
            largest, pull_back = jax.vjp(functools.partial(deepils.maximum, axis=axis), x)
            return largest, pull_back(jnp.ones_like(largest))[0]

        largest, slope = with_slope(x)
        np.testing.assert_array_equal(largest, np.max(x, axis=axis))
        np.testing.assert_array_equal(slope[0], first)
