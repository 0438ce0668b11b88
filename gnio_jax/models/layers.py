"""Layers that several networks share, in float32, and checks of the options that they share."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Bool, Float

from gnio_jax.models.precision import Dtype, dot_general, einsum


def linear(features: int, name: str, dtype: Dtype, **options: Any) -> nn.Dense:
    """A linear layer; `dtype` is that of its product's factors."""
    return nn.Dense(
        features,
        dtype=jnp.float32,
        param_dtype=jnp.float32,
        dot_general=partial(dot_general, dtype=dtype),
        name=name,
        **options,
    )


def layer_norm(name: str) -> nn.LayerNorm:
    """Layer normalisation with PyTorch's ε."""
    return nn.LayerNorm(epsilon=1e-5, dtype=jnp.float32, param_dtype=jnp.float32, name=name)


def attend(
    query: Float[jax.Array, "b n h d"],
    key: Float[jax.Array, "b m h d"],
    value: Float[jax.Array, "b m h d"],
    mask: Bool[jax.Array, "1 1 n m"] | None = None,
    *,
    dtype: Dtype = "float32",
) -> Float[jax.Array, "b n h d"]:
    """Scaled dot-product attention in the place of Flax's: with few features a head, passes over
    the scores cost more than products.

    So there are fewer: the softmax divides by its sum after meeting the values, and heads lie
    beside windows.
    """
    batch, samples, heads, size = query.shape
    query, key, value = (
        x.swapaxes(1, 2).reshape(batch * heads, -1, size) for x in (query, key, value)
    )
    scores = einsum("bnd,bmd->bnm", query / jnp.sqrt(jnp.float32(size)), key, dtype)
    if mask is not None:
        scores = jnp.where(mask[0], scores, -jnp.inf)
    weights = jnp.exp(scores - jax.lax.stop_gradient(scores.max(axis=-1, keepdims=True)))
    context = einsum("bnm,bmd->bnd", weights, value, dtype) / weights.sum(axis=-1, keepdims=True)
    return context.reshape(batch, heads, samples, size).swapaxes(1, 2)


def attention(
    heads: int, name: str, dtype: Dtype, features: int | None = None
) -> nn.MultiHeadDotProductAttention:
    """Multi-head attention by `attend`, as wide inside as its query; `features` come out, the
    query's number of them where it is None."""

    def attention_fn(
        query: jax.Array, key: jax.Array, value: jax.Array, mask: Any = None, **_: object
    ) -> jax.Array:
        return attend(query, key, value, mask, dtype=dtype)

    product = partial(dot_general, dtype=dtype)
    return nn.MultiHeadDotProductAttention(
        heads,
        out_features=features,
        dtype=jnp.float32,
        param_dtype=jnp.float32,
        attention_fn=attention_fn,
        qkv_dot_general=product,
        out_dot_general=product,
        name=name,
    )


def check_dropout(share: Any) -> None:
    """`ValueError` unless it is a share that leaves something."""
    if not 0 <= share < 1:
        raise ValueError(f"dropout must be at least 0 and below 1, found {share!r}")


def check_output_dim(output_dim: object) -> None:
    """`ValueError` unless the network is asked for two axes or three."""
    if output_dim not in (2, 3):
        raise ValueError(f"output_dim must be 2 or 3, found {output_dim!r}")
