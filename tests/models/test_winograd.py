"""Winograd's convolution against XLA's own and against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, NamedSharding, PartitionSpec

from gnio_jax.models import resnet
from gnio_jax.models.winograd import convolve_three
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


@pytest.mark.parametrize("length", [1, 3, 4, 5, 8, 13])
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
        return resnet.convolve(x, kernel, (1,), [(1, 1)])

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


def used(monkeypatch, channels=64, length=8, stride=1, train=True, dtype="float32"):
    """Whether a layer of the network uses it."""
    calls = []
    monkeypatch.setattr(resnet, "convolve_three", lambda *given: calls.append(given) or given[0])
    layer = resnet.conv(channels, 3, stride, train, "conv", dtype)
    jax.eval_shape(layer.init, jax.random.key(0), jnp.zeros((1, length, channels), jnp.float32))
    return bool(calls)


def test_training_uses_it_where_it_is_quicker(monkeypatch):
    assert used(monkeypatch) and used(monkeypatch, length=3)
    assert not used(monkeypatch, channels=32)
    assert not used(monkeypatch, length=2)
    assert not used(monkeypatch, stride=2)
    assert not used(monkeypatch, train=False)
    assert not used(monkeypatch, dtype="bfloat16")
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    assert not used(monkeypatch)


def test_other_devices_train_with_the_product(monkeypatch):
    """Their products may have fewer digits than float32."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not used(monkeypatch)


def test_float64_keeps_its_digits_and_no_windows_make_none():
    with jax.enable_x64(True):
        x, kernel = (jnp.asarray(each, jnp.float64) for each in drawn(9))
        np.testing.assert_allclose(convolve_three(x, kernel), by_definition(x, kernel), atol=1e-13)
    assert convolve_three(jnp.zeros((0, 9, 3)), kernel.astype(jnp.float32)).shape == (0, 9, 2)
