"""The Motion Bank: a learnt matrix of motion prototypes that each window's feature queries (paper §III-C)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Float


class MotionBank(nn.Module):
    """c = MultiHeadAttention(query f, keys M, values M), with M ∈ R^{m×d} a parameter; h = f + c is left to the caller.

    The bank is the same for every window, so its keys and values are projected once per call and not once per window.
    Ours, where the paper is silent: 8 heads, projections with bias, M ~ N(0, 1/√d).
    """

    size: int = 64
    heads: int = 8

    @nn.compact
    def __call__(self, feature: Float[jax.Array, "b d"]) -> tuple[Float[jax.Array, "b d"], Float[jax.Array, "b h m"]]:
        """Context (b, d) and attention weights (b, heads, m) of each feature."""
        width = feature.shape[-1]
        bank = self.param("prototypes", nn.initializers.normal(width**-0.5), (self.size, width), jnp.float32)

        def project(name: str, x: jax.Array) -> jax.Array:
            return nn.DenseGeneral((self.heads, width // self.heads), dtype=jnp.float32, param_dtype=jnp.float32, name=name)(x)

        query, key, value = project("query", feature), project("key", bank), project("value", bank)
        scores = jnp.einsum("bhd,mhd->bhm", query, key) / jnp.sqrt(jnp.float32(width // self.heads))
        attention = nn.softmax(scores, axis=-1)
        context = jnp.einsum("bhm,mhd->bhd", attention, value)
        context = nn.DenseGeneral(width, axis=(-2, -1), dtype=jnp.float32, param_dtype=jnp.float32, name="output")(context)
        return context, attention
