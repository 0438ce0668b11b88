"""The blocks of the trunk against plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from gnio_jax.models import trunk
from tests.support.compiling import quick
from tests.support.networks import drawn, predicted
from tests.support.numpy_layers import conv, conv_norm, float64, linear, relu, sigmoid, softmax

RNG = np.random.default_rng(2)
SIGNAL = RNG.standard_normal((2, 13, 4)).astype(np.float32)


def star(x, q, s):
    u = np.zeros_like(x)
    for t in range(len(x)):
        for k in range(7):
            if 0 <= t + k - 3 < len(x):
                u[t] += x[t + k - 3] * q["depthwise"]["kernel"][k, 0]
    y = np.clip(linear(u, q["first"]), 0, 6) * linear(u, q["second"])
    y = conv_norm(y, "conv", q, s)
    squeeze, excite = (q["channels"][name]["kernel"] for name in ("squeeze", "excite"))
    channels = sigmoid(sum(relu(part @ squeeze) @ excite for part in (y.mean(0), y.max(0))))
    pooled = np.stack([y.mean(1), y.max(1)], axis=1)
    time = sigmoid(conv(pooled, q["time"]["conv"]["kernel"], 1, 3))
    return x + (y * channels + y * time) / 2


def rep(x, q, s):
    return relu(conv_norm(x, "conv3", q, s, 1, 1) + conv_norm(x, "conv1", q, s) + x)


def fourier(x, q, s):
    """The filter is a circular convolution along the channels."""
    spectrum = q["gain"] + 1j * q["quadrature"]
    spectrum = np.concatenate([spectrum, np.conj(spectrum[1:-1][::-1])])
    spectrum[[0, len(spectrum) // 2]] = spectrum[[0, len(spectrum) // 2]].real
    taps, count = np.fft.ifft(spectrum).real, len(spectrum)
    rows = [
        [sum(taps[(c - d) % count] * v[d] for d in range(count)) for c in range(count)] for v in x
    ]
    return x + relu(conv_norm(np.array(rows), "conv", q, s, 1, 1))


@pytest.mark.parametrize(
    "block, oracle",
    [(trunk.StarBlock, star), (trunk.RepBlock, rep), (trunk.FourierBlock, fourier)],
)
def test_a_block_against_numpy(block, oracle):
    network = block()
    shapes = jax.eval_shape(lambda key, x: network.init(key, x, False), jax.random.key(0), SIGNAL)
    variables = drawn(shapes)
    outputs = quick(lambda v, x: network.apply(v, x, False))(variables, jnp.asarray(SIGNAL))
    expected = [oracle(x, *float64(variables)) for x in SIGNAL.astype(float)]
    np.testing.assert_allclose(outputs, expected, atol=1e-5)


def test_the_folded_block_gives_the_same_by_one_convolution():
    model = models.create("trunk", width=4, block="rep")
    variables = drawn(models.variable_shapes(model, 40))
    windows = RNG.standard_normal((2, 40, 6)).astype(np.float32)
    plain, frozen = predicted(model, variables, windows)
    np.testing.assert_allclose(frozen.displacement, plain.displacement, rtol=1e-4, atol=1e-5)


def shrunk(x, thresholds, low):
    """À trous, level by level, by loops."""
    high = low[::-1] * (-1.0) ** np.arange(len(low))
    n = len(x)
    apply = lambda y, h, step: np.array(  # noqa: E731
        [sum(h[k] * y[(t + k * step) % n] for k in range(len(h))) for t in range(n)]
    )
    details = []
    for level in range(3):
        d = apply(x, high, 2**level)
        details.append(np.sign(d) * np.maximum(np.abs(d) - thresholds[level], 0))
        x = apply(x, low, 2**level)
    for level in (2, 1, 0):
        x = apply(x, low, -(2**level)) + apply(details[level], high, -(2**level))
    return x


def test_shrinkage_weighs_three_bases_that_reconstruct_exactly():
    layer = trunk.Shrinkage()
    shapes = jax.eval_shape(layer.init, jax.random.key(0), SIGNAL)
    variables = drawn({"batch_stats": {}, **shapes})
    outputs, shares = quick(layer.apply)(variables, jnp.asarray(SIGNAL))
    (q, _), root = float64(variables), np.sqrt(3)
    filters = [np.array([0.5, 0.5]), np.array([1 + root, 3 + root, 3 - root, 1 - root]) / 8]
    # Daubechies 3 is the one of six with three vanishing moments: its sums are checked below.
    filters.append(trunk.WAVELETS[2])
    for taps, moments in zip(filters, (1, 2, 3), strict=True):
        high = taps[::-1] * (-1.0) ** np.arange(len(taps))
        np.testing.assert_allclose(2 * taps @ taps, 1, atol=1e-12)
        for power in range(moments):
            np.testing.assert_allclose(high @ np.arange(len(taps)) ** power, 0, atol=1e-12)
    for x, output, p in zip(SIGNAL.astype(float), outputs, shares, strict=True):
        mean, level = x.mean(0), np.log(x.var(0) + 1e-4)
        rough = np.log(np.mean(np.diff(x, axis=0) ** 2, axis=0) + 1e-4)
        hidden = relu(linear(np.concatenate([mean, level, rough]), q["hidden"]))
        weights = softmax(linear(hidden, q["basis"]))
        np.testing.assert_allclose(p, weights, atol=1e-5)
        limits = np.logaddexp(0, q["thresholds"])
        parts = [shrunk(x, t, h) for t, h in zip(limits, filters, strict=True)]
        expected = sum(w * part for w, part in zip(weights, parts, strict=True))
        np.testing.assert_allclose(output, expected, atol=1e-5)
        np.testing.assert_allclose(shrunk(x, np.zeros((3, 4)), filters[2]), x, atol=1e-9)
