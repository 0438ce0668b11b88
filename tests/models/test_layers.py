"""Attention by fewer passes against its definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax.models.layers import attend


@pytest.mark.parametrize("keys, causal", [(5, False), (5, True), (3, False), (9, False)])
def test_attention_and_its_gradient_against_the_definition(keys, causal):
    """Scores of hundreds too, which an exponential alone would not stand, and more or fewer keys
    than queries."""
    shapes = ((2, 5, 3, 4), (2, keys, 3, 4), (2, keys, 3, 4), (2, 5, 3, 4))
    query, key, value, weight = (
        jax.random.normal(k, shape, jnp.float64)
        for k, shape in zip(jax.random.split(jax.random.key(0), 4), shapes, strict=True)
    )
    query = query.at[0].multiply(300.0)
    mask = jnp.tril(jnp.ones((5, 5), bool))[None, None] if causal else None

    def definition(query, key, value):
        scores = jnp.einsum("bnhd,bmhd->bhnm", query, key) / 2
        scores = jnp.where(mask, scores, -1e9) if causal else scores
        return jnp.einsum("bhnm,bmhd->bnhd", jax.nn.softmax(scores, axis=-1), value)

    ours = lambda *x: attend(*x, mask=mask)  # noqa: E731
    np.testing.assert_allclose(
        ours(query, key, value), definition(query, key, value), rtol=1e-5, atol=1e-6
    )
    found, wanted = (
        jax.grad(lambda *x, f=f: jnp.sum(f(*x) * weight), (0, 1, 2))(query, key, value)
        for f in (ours, definition)
    )
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5)
