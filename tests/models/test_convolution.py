"""Every way to convolve against XLA's own or the definition, and where each is used."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from gnio_jax import models
from gnio_jax.models import convolution, layers
from gnio_jax.models.convolution import convolve_three
from tests.support.compiling import quick

GIVEN = dict(window_strides=(1,), padding=[(1, 1)], dimension_numbers=("NWC", "WIO", "NWC"))


def drawn(length, channels=3, features=2, batch=2):
    random = np.random.default_rng(length)
    x = random.standard_normal((batch, length, channels)).astype(np.float32)
    return x, random.standard_normal((3, channels, features)).astype(np.float32)


def by_definition(x, kernel):
    """In float64, sample by sample."""
    padded = np.pad(np.asarray(x, np.float64), ((0, 0), (1, 1), (0, 0)))
    samples = range(x.shape[1])
    return np.stack([np.einsum("bkc,kcd->bd", padded[:, n : n + 3], kernel) for n in samples], 1)


@pytest.mark.parametrize("length", [1, 4, 13])
def test_values_and_gradients_are_those_of_the_definition(length):
    x, kernel = drawn(length)
    weight = np.random.default_rng(9).standard_normal((2, length, 2)).astype(np.float32)

    def loss(convolution, x, kernel):
        return jnp.sum(convolution(x, kernel) * weight)

    def native(x, kernel):
        return jax.lax.conv_general_dilated(x, kernel, **GIVEN)

    @quick
    def both(x, kernel):
        gradients = (jax.grad(loss, (1, 2))(each, x, kernel) for each in (convolve_three, native))
        return convolve_three(x, kernel), *gradients

    found, gradient, wanted = both(x, kernel)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, by_definition(x, kernel), atol=2e-5)
    for one, other in zip(gradient, wanted, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-5)


def test_it_loses_a_digit_at_most():
    """Of many channels, the error as a share of the result's size."""
    x, kernel = drawn(25, channels=128, features=128, batch=8)
    wanted = by_definition(x, kernel)
    size = np.sqrt(np.mean(wanted**2))

    def error(convolution):
        return np.sqrt(np.mean((np.asarray(convolution(x, kernel)) - wanted) ** 2)) / size

    def product(x, kernel):
        return convolution.convolve(x, kernel, (1,), [(1, 1)])

    assert error(quick(product)) < 1e-6
    assert error(quick(convolve_three)) < 5e-6


def test_devices_that_share_a_batch_and_seeds_side_by_side_have_the_same_gradients():
    x, kernel = drawn(8)
    kernels = np.stack([kernel, 2 * kernel])

    @quick
    def gradients(x, kernels):
        def loss(x, kernel):
            return jnp.mean(convolve_three(x, kernel) ** 2)

        return jax.vmap(jax.grad(loss, (0, 1)), (None, 0))(x, kernels)

    alone = gradients(x, kernels)
    mesh = jax.make_mesh((2,), ("batch",), (AxisType.Auto,))
    shared = jax.device_put(x, NamedSharding(mesh, PartitionSpec("batch")))
    jax.tree.map(
        lambda one, other: np.testing.assert_allclose(one, other, 1e-5, 1e-6),
        gradients(shared, kernels),
        alone,
    )
    np.testing.assert_allclose(alone[1][1], 2 * alone[1][0], rtol=1e-5)


def test_no_derivative_in_forward_mode_is_promised():
    x, kernel = map(jnp.asarray, drawn(4))
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(convolve_three, (x, kernel), (x, kernel))


def used(monkeypatch, channels=64, length=8, stride=1, train=True, winograd=True):
    """Whether a layer of a network uses it."""
    calls = []
    monkeypatch.setattr(convolution, "convolve_three", lambda *x: calls.append(x) or x[0])
    layer = layers.conv(channels, 3, stride, train, "conv", winograd=winograd)
    jax.eval_shape(layer.init, jax.random.key(0), jnp.zeros((1, length, channels), jnp.float32))
    return bool(calls)


def test_training_uses_it_where_it_is_quicker(monkeypatch):
    assert used(monkeypatch) and used(monkeypatch, length=3)
    assert not used(monkeypatch, channels=32)
    assert not used(monkeypatch, length=2)
    assert not used(monkeypatch, stride=2)
    assert not used(monkeypatch, train=False)
    assert not used(monkeypatch, winograd=False)


@pytest.mark.parametrize("name", ["gnio", "tlio", "ronin_resnet"])
def test_it_is_chosen_when_the_network_is_made(monkeypatch, name):
    """On a CPU, in one process: products of other devices may have fewer digits than float32. The
    network keeps the choice wherever it is traced, and may be given another."""
    made = models.create(name)
    assert made.winograd and not models.create(name, winograd=False).winograd
    with monkeypatch.context() as several:
        several.setattr(jax, "process_count", lambda: 2)
        assert not models.create(name).winograd
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not models.create(name).winograd
    calls = []
    monkeypatch.setattr(convolution, "convolve_three", lambda *x: calls.append(x) or x[0])
    variables, windows = models.variable_shapes(made, 64), jnp.zeros((1, 64, 6), jnp.float32)
    train = {"train": True, "mutable": ["batch_stats"], "rngs": {"dropout": jax.random.key(0)}}
    jax.eval_shape(lambda given: made.apply(given, windows, **train), variables)
    assert calls


@pytest.mark.parametrize("stride", [1, 2])
def test_depthwise_and_grouped_convolutions_and_their_gradients_against_xla(stride):
    random = np.random.default_rng(0)
    x = random.standard_normal((2, 11, 8))
    ways = {8: convolution.convolve_depthwise, 4: convolution.convolve_groups}
    for groups, ours in ways.items() if stride == 1 else [(8, convolution.convolve_depthwise)]:
        kernel = random.standard_normal((3, 8 // groups, 8))
        given = dict(window_strides=(stride,), padding=[(1, 1)], feature_group_count=groups)
        axes = ("NWC", "WIO", "NWC")
        weight = random.standard_normal((2, 11 if stride == 1 else 6, 8))

        def with_gradient(function, x, kernel, weight=weight, given=given):
            value, pull_back = jax.vjp(lambda x, kernel: function(x, kernel, **given), x, kernel)
            return value, *pull_back(jnp.asarray(weight))

        def native(x, kernel, axes=axes, **given):
            return jax.lax.conv_general_dilated(x, kernel, dimension_numbers=axes, **given)

        both = quick(lambda *g, f=with_gradient, o=ours, n=native: [f(each, *g) for each in (o, n)])
        for one, other in zip(*both(x, kernel), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-12)


def test_float64_keeps_its_digits_and_no_windows_make_none():
    with jax.enable_x64(True):
        x, kernel = (jnp.asarray(each, jnp.float64) for each in drawn(9))
        np.testing.assert_allclose(convolve_three(x, kernel), by_definition(x, kernel), atol=1e-13)
    assert convolve_three(jnp.zeros((0, 9, 3)), kernel.astype(jnp.float32)).shape == (0, 9, 2)


@pytest.mark.parametrize("length", [50, 13])
def test_max_pool_against_torch_convention(length):
    x = -1 - np.random.default_rng(0).random((2, length, 3)).astype(
        np.float32
    )  # negative: a zero padding would show
    rows = range(0, length + 2 - 3 + 1, 2)
    padded = np.pad(x, ((0, 0), (1, 1), (0, 0)), constant_values=-np.inf)
    np.testing.assert_array_equal(
        quick(convolution.max_pool)(jnp.asarray(x)),
        np.stack([padded[:, r : r + 3].max(axis=1) for r in rows], axis=1),
    )


@pytest.mark.parametrize("size, stride, length", [(7, 2, 11), (3, 2, 12), (3, 1, 5), (1, 2, 12)])
def test_both_convolutions_are_one_function(size, stride, length):
    """Values, forward and reverse derivatives, against plain NumPy and against each other."""
    rng = np.random.default_rng(0)
    x, kernel = rng.normal(size=(2, length, 3)), rng.normal(size=(size, 3, 4))
    padding = [((size - 1) // 2,) * 2]
    padded = np.pad(x, ((0, 0), padding[0], (0, 0)))
    wanted = np.stack(
        [
            np.einsum("bkc,kcd->bd", padded[:, i : i + size], kernel)
            for i in range(0, padded.shape[1] - size + 1, stride)
        ],
        axis=1,
    )
    found = {}
    for function in (convolution.convolve, convolution.convolve_forward):

        def apply(x, kernel, function=function):
            return function(x, kernel, (stride,), padding)

        @quick
        def with_derivatives(x, kernel, apply=apply):
            weights = np.random.default_rng(1).normal(size=wanted.shape)
            value, forward = jax.jvp(apply, (x, kernel), (x[::-1], kernel[::-1]))
            weighted = jax.grad(lambda x, kernel: jnp.sum(weights * apply(x, kernel)), (0, 1))
            return value, (forward, *weighted(x, kernel))

        value, found[function] = with_derivatives(x, kernel)
        np.testing.assert_allclose(value, wanted, atol=1e-12)
    for one, other in zip(*found.values(), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
