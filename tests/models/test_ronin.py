"""RoNIN's ResNet with normalisation of groups, as RIO has it, in plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from tests.support.compiling import quick
from tests.support.networks import drawn, predicted
from tests.support.numpy_layers import conv, float64, linear, relu

WIDTH = 6
OPTIONS = {"width": WIDTH, "normalisation": "group", "output_dim": 2}


def group_norm(x, q):
    """Group by group, the largest number of groups that divides 32 and the channels."""
    count = max(k for k in (1, 2, 4, 8, 16, 32) if x.shape[1] % k == 0)
    size, out = x.shape[1] // count, np.empty_like(x)
    for first in range(0, x.shape[1], size):
        part = x[:, first : first + size]
        spread = np.sqrt(np.mean((part - part.mean()) ** 2) + 1e-5)
        out[:, first : first + size] = (part - part.mean()) / spread
    return out * q["scale"] + q["bias"]


def conv_norm(x, name, q, stride=1, padding=0):
    y = conv(x, q[name]["kernel"], stride, padding)
    return group_norm(y, q[name.replace("conv", "norm")])


def displacement(x, q):
    encoder, head = q["encoder"], q["displacement"]
    x = relu(conv_norm(x, "stem_conv", encoder, 2, 3))
    x = np.array([x[max(0, r - 1) : r + 2].max(axis=0) for r in range(0, len(x), 2)])
    for group in range(4):
        for number in range(2):
            block = encoder[f"group{group + 1}_block{number + 1}"]
            stride = 2 if group and not number else 1
            y = relu(conv_norm(x, "conv1", block, stride, 1))
            y = conv_norm(y, "conv2", block, 1, 1)
            shortcut = "shortcut_conv" in block
            x = relu(y + (conv_norm(x, "shortcut_conv", block, stride) if shortcut else x))
    x = conv_norm(x, "neck_conv", head).T.ravel()
    return linear(relu(linear(relu(linear(x, head["fc1"])), head["fc2"])), head["fc3"])


def test_forward_against_numpy():
    model = models.create("ronin_resnet", **OPTIONS)
    windows = np.random.default_rng(4).standard_normal((2, 70, 6)).astype(np.float32)
    variables = drawn(models.variable_shapes(model, 70))
    params, statistics = float64(variables)
    assert statistics.keys() == {"uncertainty"}
    displacements = [displacement(window.astype(float), params) for window in windows]
    assert np.abs(displacements).max() > 0.05
    for prediction in predicted(model, variables, windows):
        np.testing.assert_allclose(prediction.displacement[:, :2], displacements, atol=1e-5)
        np.testing.assert_array_equal(prediction.displacement[:, 2], 0)


@pytest.mark.parametrize("gravity", [0.0, 9.81])
def test_at_rest_the_gradient_is_finite_and_training_is_inference_but_for_dropout(gravity):
    model = models.create("ronin_resnet", **OPTIONS, dropout=0.0)
    variables = drawn(models.variable_shapes(model, 70))
    still = np.zeros((2, 70, 6), np.float32)
    still[..., 2] = gravity

    def total(params, windows):
        outputs = [
            model.apply({**variables, "params": params}, windows, train=train, **more)[0]
            for train, more in ((True, {"mutable": ["batch_stats"]}), (False, {"mutable": []}))
        ]
        (trained, _, *_), (inferred, _, *_) = outputs
        return jnp.sum(trained**2), (trained, inferred)

    slopes, (trained, inferred) = quick(jax.grad(total, (0, 1), has_aux=True))(
        variables["params"], jnp.asarray(still)
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
    np.testing.assert_allclose(trained, inferred, atol=1e-5)
