"""Whole networks with memory over a recording, in plain NumPy: one sample after the other."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from tests.support.comparing import assert_close_in_size
from tests.support.compiling import quick
from tests.support.networks import drawn
from tests.support.numpy_layers import (
    float64,
    layer_norm,
    linear,
    motion_bank,
    recurrence,
    relu,
    sigmoid,
)

EVERY, INTERVALS = 20, 15
"""Samples of an interval, and intervals of the recording: 300 samples, and RoNIN's TCN sees 253."""
PIECES = (1, 9, 1, 4)
"""Intervals of the pieces in which the recording is continued."""
OPTIONS = {
    "gru": {"width": 4, "uncertainty": "calibrated"},
    "ronin_lstm": {"width": 5},
    "ronin_tcn": {"width": 2},
    "state_space": {"width": 6, "state": 5, "layers": 2},
}
GNIO = {"bank_size": 3, "head": "gated"}
"""GNIO's bank and head, which sit on each of them."""


def causal(x, size, dilation=1, stride=1):
    """The inputs (outputs, size, channels) of a causal convolution. Its last input is the newest
    one, there are zeros before the recording, and the first output is at sample `stride` − 1."""
    rows = []
    for newest in range(stride - 1, len(x), stride):
        samples = [newest - dilation * (size - 1 - k) for k in range(size)]
        rows.append([x[s] if s >= 0 else np.zeros(x.shape[1]) for s in samples])
    return np.array(rows)


def strided_conv(x, q, stride):
    return np.array([bias_and_sum(rows, q) for rows in causal(x, len(q["kernel"]), 1, stride)])


def bias_and_sum(rows, q):
    total = q["bias"].copy()
    for row, kernel in zip(rows, q["kernel"], strict=True):
        total += row @ kernel
    return total


def gru(x, q):
    """Features at 10 samples each."""
    x = relu(strided_conv(x, q["conv1"], 5))
    x = relu(strided_conv(x, q["conv2"], 2))
    return recurrence(x, q, "gru")[0]


def ronin_lstm(x, q):
    """Features at every sample."""
    products = np.array([[u * v for u in row for v in row] for row in x])
    mixed = np.concatenate([x, products @ q["bilinear_kernel"] + q["bilinear_bias"]], axis=1)
    x = mixed
    for layer in "123":
        names = ("input", "recurrent_kernel", "recurrent_bias")
        x = recurrence(x, {name: q[f"{name}{layer}"] for name in names}, "lstm")[0]
    return linear(np.concatenate([mixed, x], axis=1), q["linear"])


def prelu(x, q):
    return np.where(x > 0, x, q["negative_slope"] * x)


def ronin_tcn(x, q):
    """Features at every sample."""
    for number in range(6):
        block = q[f"block{number + 1}"]
        y = x
        for name in ("conv1", "conv2"):
            direction = block[f"{name}_direction"].reshape(3, y.shape[1], -1)
            kernel = np.empty_like(direction)
            for feature, length in enumerate(block[f"{name}_length"]):
                of_feature = direction[..., feature]
                kernel[..., feature] = length * of_feature / np.sqrt((of_feature**2).sum())
            weights = {"kernel": kernel, "bias": block[f"{name}_bias"]}
            rows = [bias_and_sum(row, weights) for row in causal(y, 3, 2**number)]
            y = prelu(np.array(rows), block[f"{name}_slope"])
        shortcut = linear(x, block["shortcut"]) if "shortcut" in block else x
        x = prelu(shortcut + y, block["slope"])
    return x


def state_space(x, q):
    """Features at 5 samples each."""
    hann = [np.sin(np.pi * (k + 0.5) / 20) ** 2 for k in range(20)]
    x = np.array([hann @ rows / sum(hann) for rows in causal(x, 20, 1, 5)])
    x = linear(x, q["input"])
    for layer in ("layer1", "layer2"):
        x = state_space_layer(x, q[layer])
    return layer_norm(x, q["norm"])


def state_space_layer(u, q):
    """In complex numbers."""
    rate = -np.exp(q["log_rate"]) + 1j * q["frequency"]
    factor = np.exp(rate * np.exp(q["log_step"]))
    drive = (factor - 1) / rate
    memory, rows = np.zeros(len(rate), complex), []
    for row in u:
        x = layer_norm(row, q["norm"])
        memory = factor * memory + drive * (linear(x, q["real"]) + 1j * linear(x, q["imag"]))
        parts = np.concatenate([memory.real, memory.imag])
        y = 2 * linear(parts, q["out"]) + q["through"] * x
        y = 0.5 * y * (1 + np.tanh(np.sqrt(2 / np.pi) * (y + 0.044715 * y**3)))
        rows.append(row + y * sigmoid(linear(y, q["gate"])))
    return np.array(rows)


ENCODERS = {
    "gru": gru,
    "ronin_lstm": ronin_lstm,
    "ronin_tcn": ronin_tcn,
    "state_space": state_space,
}


def forward(name, x, variables):
    """Displacements and logarithms of the standard deviations at the end of every interval."""
    q, s = float64(variables)
    features = ENCODERS[name](x - [0, 0, 9.81, 0, 0, 0], q)
    step = len(features) // INTERVALS
    h = features[step - 1 :: step]
    if "bank" in q:
        h = h + np.array([motion_bank(row, q["bank"])[0] for row in h])
    if "gate" in q["head"]:
        scale = np.log1p(np.exp(linear(h, q["head"]["scale"])))
        displacement = scale * np.tanh(linear(h, q["head"]["gate"]))
    else:
        displacement = linear(h, q["head"]["displacement"])
    statistics = s.get("uncertainty", {})
    if "log_std" in statistics:  # a constant
        return displacement, np.tile(statistics["log_std"], (len(h), 1))
    log_std = linear(h, q["uncertainty"]["log_std"])
    return displacement, log_std + statistics.get("log_factor", 0.0)


def random_variables(name, model):
    """Random ones; a state-space layer's turn within seconds and remember for seconds."""
    variables = drawn({"batch_stats": {}, **models.variable_shapes(model, EVERY)})
    changes = {"log_step": lambda x: x - 3, "frequency": lambda x: 20 * x}
    return jax.tree.map_with_path(
        lambda path, leaf: changes.get(path[-1].key, lambda x: x)(leaf), variables
    )


@pytest.mark.parametrize("heads", [{}, GNIO], ids=["linear", "bank, gated"])
@pytest.mark.parametrize("name", OPTIONS)
def test_a_recording_at_once_and_in_pieces_against_numpy(name, heads):
    model = models.create(name, **OPTIONS[name], **heads)
    variables = random_variables(name, model)
    x = np.random.default_rng(8).standard_normal((EVERY * INTERVALS, 6)).astype(np.float32)
    x[:, 2] += 9.81
    expected = forward(name, np.float64(x), variables)
    assert np.ptp(expected[0], axis=0).min() > 0.05 and np.abs(expected[1]).max(axis=0).min() > 0.1
    constants = model.constants(variables)  # the bank's keys and values
    assert bool(constants) == bool(heads)
    advance = functools.partial(model.apply, method="advance", **constants)
    program = quick(advance, static_argnums=3)
    for pieces in ((INTERVALS,), PIECES):
        state, rows = model.apply(variables, 1, method="begin"), []
        for piece in np.split(x, np.cumsum(pieces)[:-1] * EVERY):
            state, prediction = program(variables, state, jnp.asarray(piece)[None], EVERY)
            rows.append(jax.device_get((prediction.displacement[0], prediction.log_std[0])))
        for values, parts in zip(expected, zip(*rows, strict=True), strict=True):
            assert_close_in_size(np.concatenate(parts), values, 1e-5)
