"""Products whose factors are rounded to bfloat16, against NumPy in float64."""

from functools import partial

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest

from gnio_jax import models
from gnio_jax.errors import InputError
from gnio_jax.models import precision


def rounded(x):
    return np.asarray(x).astype(ml_dtypes.bfloat16).astype(np.float64)


def factors():
    rng = np.random.default_rng(0)
    return tuple(rng.normal(size=shape).astype(np.float32) for shape in ((5, 7), (7, 3), (5, 3)))


PRODUCTS = {
    "matmul": precision.matmul,
    "einsum": lambda a, b, dtype: precision.einsum("ij,jk->ik", a, b, dtype),
    "dot_general": lambda a, b, dtype: precision.dot_general(
        a, b, (((1,), (0,)), ((), ())), dtype=dtype
    ),
}


@pytest.mark.parametrize("name", PRODUCTS)
def test_a_product_and_its_gradient_have_rounded_factors(name):
    a, b, weight = factors()
    product = partial(PRODUCTS[name], dtype="bfloat16")
    found, pull = jax.vjp(product, jnp.asarray(a), jnp.asarray(b))
    gradient = pull(jnp.asarray(weight))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, rounded(a) @ rounded(b), rtol=1e-5, atol=1e-5)
    # Sums are float32; what a gradient's product gives is rounded once.
    wanted = rounded(weight) @ rounded(b).T, rounded(a).T @ rounded(weight)
    for ours, theirs in zip(gradient, wanted, strict=True):
        assert ours.dtype == jnp.float32
        np.testing.assert_allclose(ours, theirs, rtol=2**-8, atol=1e-6)


@pytest.mark.parametrize("name", PRODUCTS)
def test_in_float32_a_product_is_the_plain_one(name):
    a, b, _ = (jnp.asarray(x) for x in factors())
    np.testing.assert_array_equal(PRODUCTS[name](a, b, "float32"), a @ b)


def test_an_unknown_dtype_is_told():
    expected = "model 'gnio': unknown dtype 'float16'; known ones: float32, bfloat16"
    with pytest.raises(InputError, match=expected):
        models.create("gnio", dtype="float16")
