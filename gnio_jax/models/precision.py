"""Matrix products and convolutions in bfloat16; everything else stays float32.

The factors of a product are rounded to bfloat16, and so are those of the products of its gradient.
Results are float32; those of the gradient's products are rounded to bfloat16 first. bfloat16 has
the range of float32, so that losses need no scaling.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp

Dtype = Literal["float32", "bfloat16"]
"""Type of the factors of a network's products: its option `dtype`."""


def dot_general(
    a: jax.Array, b: jax.Array, dimension_numbers: Any, *, dtype: Dtype, **options: Any
) -> jax.Array:
    """`jax.lax.dot_general`; for the layers of Flax, with `dtype` bound by `partial`."""
    if dtype == "float32":
        return jax.lax.dot_general(a, b, dimension_numbers, **options)
    multiply = partial(jax.lax.dot_general, dimension_numbers=dimension_numbers)
    return _rounded(multiply, a, b)


def einsum(subscripts: str, a: jax.Array, b: jax.Array, dtype: Dtype) -> jax.Array:
    """`jnp.einsum` of two arrays."""
    if dtype == "float32":
        return jnp.einsum(subscripts, a, b)
    return _rounded(partial(jnp.einsum, subscripts), a, b)


def matmul(a: jax.Array, b: jax.Array, dtype: Dtype) -> jax.Array:
    """`a @ b`."""
    return a @ b if dtype == "float32" else _rounded(jnp.matmul, a, b)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _rounded(multiply: Callable[..., jax.Array], a: jax.Array, b: jax.Array) -> jax.Array:
    return multiply(*_low(a, b), preferred_element_type=jnp.float32)


def _forward(multiply: Callable[..., jax.Array], a: jax.Array, b: jax.Array) -> Any:
    return _rounded(multiply, a, b), _low(a, b)


def _backward(multiply: Callable[..., jax.Array], factors: Any, cotangent: jax.Array) -> Any:
    _, pull = jax.vjp(multiply, *factors)
    return tuple(each.astype(jnp.float32) for each in pull(*_low(cotangent)))


def _low(*arrays: jax.Array) -> tuple[jax.Array, ...]:
    return tuple(each.astype(jnp.bfloat16) for each in arrays)


_rounded.defvjp(_forward, _backward)
