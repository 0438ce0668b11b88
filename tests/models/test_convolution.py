"""Every way to convolve against XLA's own and the definition, and where each is used."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from gnio_jax import models
from gnio_jax.models import convolution, resnet
from gnio_jax.models.convolution import (
    convolve,
    convolve_depthwise,
    convolve_forward,
    convolve_groups,
    convolve_long,
    convolve_three,
)
from tests.support.comparing import assert_close_in_size
from tests.support.compiling import quick


def drawn(length, channels=3, features=2, batch=2, size=3):
    random = np.random.default_rng(length)
    x = random.standard_normal((batch, length, channels)).astype(np.float32)
    return x, random.standard_normal((size, channels, features)).astype(np.float32)


def by_definition(x, kernel, stride=1):
    """In float64, sample by sample."""
    half = (len(kernel) - 1) // 2
    padded = np.pad(np.asarray(x, np.float64), ((0, 0), (half, half), (0, 0)))
    places = range(0, padded.shape[1] - len(kernel) + 1, stride)
    samples = [np.einsum("bkc,kcd->bd", padded[:, n : n + len(kernel)], kernel) for n in places]
    return np.stack(samples, axis=1)


@pytest.mark.parametrize(
    "function, size, stride, length, groups",
    [
        *((convolve, *shape, 1) for shape in ((7, 2, 11), (3, 2, 12), (3, 1, 5), (1, 2, 12))),
        *((convolve_forward, *shape, 1) for shape in ((7, 2, 11), (3, 1, 5))),
        *((convolve_long, *shape, 1) for shape in ((31, 1, 50), (17, 1, 40), (3, 1, 5), (1, 1, 8))),
        *((convolve_three, 3, 1, length, 1) for length in (1, 4, 13)),
        *((convolve_depthwise, 3, stride, 11, 8) for stride in (1, 2)),
        (convolve_groups, 3, 1, 11, 4),
    ],
)
def test_values_and_derivatives_are_those_of_the_convolution(
    function, size, stride, length, groups
):
    """In float64, which all of them keep; Winograd's has no derivative in forward mode."""
    random = np.random.default_rng(0)
    x, kernel = random.normal(size=(2, length, 8)), random.normal(size=(size, 8 // groups, 8))
    keywords = {"window_strides": (stride,), "padding": [((size - 1) // 2,) * 2]}
    weight = random.normal(size=(2, -(-length // stride), 8))

    def native(x, kernel):
        axes = ("NWC", "WIO", "NWC")
        named = {**keywords, "dimension_numbers": axes, "feature_group_count": groups}
        return jax.lax.conv_general_dilated(x, kernel, **named)

    def ours(x, kernel):
        if function is convolve_three:
            return function(x, kernel)
        return function(x, kernel, **keywords, feature_group_count=groups)

    def with_derivatives(function, x, kernel, forward):
        value, pull_back = jax.vjp(function, x, kernel)
        results = value, *pull_back(jnp.asarray(weight))
        tangents = x[::-1], kernel[::-1]
        return *results, jax.jvp(function, (x, kernel), tangents)[1] if forward else results[0]

    forward = function in (convolve, convolve_forward, convolve_long)
    program = quick(
        lambda *g: [with_derivatives(variant, *g, forward) for variant in (ours, native)]
    )
    results, expected = program(x, kernel)
    for one, other in zip(results, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-11)
    if groups == 1:
        np.testing.assert_allclose(results[0], by_definition(x, kernel, stride), atol=1e-11)


def test_it_loses_a_digit_at_most():
    """Of many channels in float32, the error as a share of the result's size."""
    x, kernel = drawn(25, channels=128, features=128, batch=8)
    reference = by_definition(x, kernel)
    size = np.sqrt(np.mean(reference**2))

    def error(convolution):
        return np.sqrt(np.mean((np.asarray(convolution(x, kernel)) - reference) ** 2)) / size

    assert error(quick(lambda x, kernel: convolve(x, kernel, (1,), [(1, 1)]))) < 1e-6
    assert error(quick(lambda x, kernel: convolve_long(x, kernel, (1,), [(1, 1)]))) < 1e-6
    assert error(quick(convolve_three)) < 5e-6


def test_devices_that_share_a_batch_have_the_same_gradients():
    x, kernel = drawn(8)

    @quick
    def gradients(x, kernel):
        return jax.grad(lambda x, k: jnp.mean(convolve_three(x, k) ** 2), (0, 1))(x, kernel)

    mesh = jax.make_mesh((2,), ("batch",), (AxisType.Auto,))
    shared = jax.device_put(x, NamedSharding(mesh, PartitionSpec("batch")))
    results = gradients(shared, kernel), gradients(x, kernel)
    jax.tree.map(lambda one, other: assert_close_in_size(one, other, 1e-5), *results)


@pytest.fixture
def calls(monkeypatch):
    """What Winograd's convolution is called with."""
    arguments = []
    monkeypatch.setattr(convolution, "convolve_three", lambda *x: arguments.append(x) or x[0])
    return arguments


@pytest.mark.parametrize("name", ["gnio", "tlio", "ronin_resnet"])
def test_it_is_chosen_when_the_network_is_made(monkeypatch, calls, name):
    """On a CPU, in one process: products of other devices may have fewer digits than float32. The
    network keeps the choice wherever it is traced, and may be given another."""
    network = models.create(name)
    assert network.winograd and not models.create(name, winograd=False).winograd
    with monkeypatch.context() as several:
        several.setattr(jax, "process_count", lambda: 2)
        assert not models.create(name).winograd
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not models.create(name).winograd
    monkeypatch.setattr(resnet, "BLOCKS_PER_GROUP", 1)
    windows = jnp.zeros((1, 64, 6), jnp.float32)
    jax.eval_shape(lambda key: network.init(key, windows, train=True), jax.random.key(0))
    assert calls
