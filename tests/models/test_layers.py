"""Attention by fewer passes against its definition, and the spectrum by products."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax.models.layers import attend, fourier_waves
from tests.support.compiling import quick


@pytest.mark.parametrize("keys, causal", [(5, False), (5, True), (3, False), (9, False)])
def test_attention_and_its_gradient_against_the_definition(keys, causal):
    """Scores of hundreds too, which an exponential alone would not stand, and more or fewer keys
    than queries."""
    shapes = ((2, 5, 3, 4), (2, keys, 3, 4), (2, keys, 3, 4), (2, 5, 3, 4))
    random = np.random.default_rng(0)
    query, key, value, weight = (random.standard_normal(shape) for shape in shapes)
    query[0] *= 300.0
    mask = np.tril(np.ones((5, 5), bool))[None, None] if causal else None

    def definition(query, key, value):
        scores = jnp.einsum("bnhd,bmhd->bhnm", query, key) / 2
        scores = jnp.where(mask, scores, -1e9) if causal else scores
        return jnp.einsum("bhnm,bmhd->bnhd", jax.nn.softmax(scores, axis=-1), value)

    def with_gradient(function):
        output, pull_back = jax.vjp(function, query, key, value)
        return output, pull_back(jnp.asarray(weight))

    ours = functools.partial(attend, mask=None if mask is None else jnp.asarray(mask))
    program = quick(lambda: (with_gradient(ours), with_gradient(definition)))
    (attention, gradient), (expected, of_wanted) = program()
    np.testing.assert_allclose(attention, expected, rtol=1e-5, atol=1e-6)
    for one, other in zip(gradient, of_wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("length", [1, 2, 7, 64, 201])
def test_the_waves_give_numpys_spectrum(length):
    x = np.random.default_rng(length).standard_normal((3, length))
    cosines, sines = fourier_waves(length)
    np.testing.assert_allclose(x @ cosines - 1j * (x @ sines), np.fft.rfft(x), atol=1e-5)
