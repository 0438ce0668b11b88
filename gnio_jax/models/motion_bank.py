"""The Motion Bank: a trainable matrix of motion prototypes that the feature of each window queries
(paper §III-C)."""

from __future__ import annotations

import chex
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.models.layers import FLOAT32

# PyTorch's `MultiheadAttention` initialises query, key and value as one Xavier-uniform (3d, d)
# matrix, so their bound is √(6 / 4d) = √(3 · 0.5 / d). The output is a linear layer with its usual
# bound 1/√d.
stacked_xavier = nn.initializers.variance_scaling(0.5, "fan_in", "uniform")
fan_in_uniform = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")


class MotionBank(nn.Module):
    """c = MultiHeadAttention(query f, keys M, values M), with M ∈ R^{m×d} a parameter; h = f + c is
    left to the caller.

    The bank is the same for every window, so its keys and values are projected once per call and
    not once per window. Ours, where the paper gives no details: 8 heads, projections with bias that
    are initialised as in PyTorch's attention, and M ~ N(0, std²), std = 1. Prototypes that start
    near each other (std = 1/√d) receive equal attention, and training does not change this.
    """

    size: int = 64
    heads: int = 8
    width: int = 512
    std: float = 1.0

    def setup(self) -> None:
        shape = (self.heads, self.width // self.heads)
        self.prototypes = self.param(
            "prototypes", nn.initializers.normal(self.std), (self.size, self.width), jnp.float32
        )
        self.query, self.key, self.value = (
            nn.DenseGeneral(shape, kernel_init=stacked_xavier, **FLOAT32) for _ in range(3)
        )
        self.output = nn.DenseGeneral(
            self.width, axis=(-2, -1), kernel_init=fan_in_uniform, **FLOAT32
        )

    def __call__(
        self,
        feature: Float[Array, "b d"],
        memory: tuple[Float[Array, "h m k"], Float[Array, "h k m"]] | None = None,
    ) -> tuple[Float[Array, "b d"], Float[Array, "b h m"]]:
        """Context (b, d) and attention weights (b, heads, m) of each feature; `memory` is the
        result of an earlier call of `memory()`, if there was one."""
        chex.assert_shape(feature, (None, self.width))
        query, (key, value) = self.query(feature), self.memory() if memory is None else memory
        size = jnp.float32(self.width // self.heads)
        scores = jnp.einsum("bhk,hmk->bhm", query, key) / jnp.sqrt(size)
        attention = nn.softmax(scores, axis=-1)
        return self.output(jnp.einsum("bhm,hkm->bhk", attention, value)), attention

    def memory(self) -> tuple[Float[Array, "h m k"], Float[Array, "h k m"]]:
        """Keys (heads, m, d / heads) and values (heads, d / heads, m) of the prototypes, in the
        order that the products with one window need."""
        keys = self.key(self.prototypes).transpose(1, 0, 2)
        return keys, self.value(self.prototypes).transpose(1, 2, 0)
