"""The Motion Bank: a learnt matrix of motion prototypes that each window's feature queries (paper
§III-C)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Float

from gnio_jax.models.precision import Dtype, dot_general, einsum

# PyTorch's `MultiheadAttention`: query, key and value are one (3d, d) matrix to its Xavier-uniform
# start, so that their bound is √(6 / 4d) = √(3 · 0.5 / d), and the output is a linear layer with
# its usual bound 1/√d.
stacked_xavier = nn.initializers.variance_scaling(0.5, "fan_in", "uniform")
fan_in_uniform = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")


class MotionBank(nn.Module):
    """c = MultiHeadAttention(query f, keys M, values M), with M ∈ R^{m×d} a parameter; h = f + c is
    left to the caller.

    The bank is the same for every window, so its keys and values are projected once per call and
    not once per window. Ours, where the paper is silent: 8 heads, projections with bias that start
    as PyTorch's attention starts them, and M ~ N(0, std²), std = 1. Prototypes that start near each
    other (std = 1/√d) are attended to alike, and stay so.
    """

    size: int = 64
    heads: int = 8
    width: int = 512
    std: float = 1.0
    dtype: Dtype = "float32"

    def setup(self) -> None:
        shape = (self.heads, self.width // self.heads)
        product = partial(dot_general, dtype=self.dtype)
        self.prototypes = self.param(
            "prototypes", nn.initializers.normal(self.std), (self.size, self.width), jnp.float32
        )
        self.query, self.key, self.value = (
            nn.DenseGeneral(
                shape,
                kernel_init=stacked_xavier,
                dtype=jnp.float32,
                param_dtype=jnp.float32,
                dot_general=product,
            )
            for _ in range(3)
        )
        self.output = nn.DenseGeneral(
            self.width,
            axis=(-2, -1),
            kernel_init=fan_in_uniform,
            dtype=jnp.float32,
            param_dtype=jnp.float32,
            dot_general=product,
        )

    def __call__(
        self,
        feature: Float[jax.Array, "b d"],
        memory: tuple[Float[jax.Array, "h m k"], Float[jax.Array, "h k m"]] | None = None,
    ) -> tuple[Float[jax.Array, "b d"], Float[jax.Array, "b h m"]]:
        """Context (b, d) and attention weights (b, heads, m) of each feature; `memory` is that of
        an earlier call, if there was one."""
        query, (key, value) = self.query(feature), self.memory() if memory is None else memory
        scores = einsum("bhk,hmk->bhm", query, key, self.dtype) / jnp.sqrt(
            jnp.float32(self.width // self.heads)
        )
        attention = nn.softmax(scores, axis=-1)
        return self.output(einsum("bhm,hkm->bhk", attention, value, self.dtype)), attention

    def memory(self) -> tuple[Float[jax.Array, "h m k"], Float[jax.Array, "h k m"]]:
        """Keys (heads, m, d / heads) and values (heads, d / heads, m) of the prototypes: as the
        products with one window read them."""
        return self.key(self.prototypes).transpose(1, 0, 2), self.value(self.prototypes).transpose(
            1, 2, 0
        )
