"""Layers that several networks share, in float32, and checks of the options that they share."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import linen as nn


def linear(features: int, name: str, **options: Any) -> nn.Dense:
    """A linear layer."""
    return nn.Dense(features, dtype=jnp.float32, param_dtype=jnp.float32, name=name, **options)


def layer_norm(name: str) -> nn.LayerNorm:
    """Layer normalisation with PyTorch's ε."""
    return nn.LayerNorm(epsilon=1e-5, dtype=jnp.float32, param_dtype=jnp.float32, name=name)


def check_dropout(share: Any) -> None:
    """`ValueError` unless it is a share that leaves something."""
    if not 0 <= share < 1:
        raise ValueError(f"dropout must be at least 0 and below 1, found {share!r}")


def check_output_dim(output_dim: object) -> None:
    """`ValueError` unless the network is asked for two axes or three."""
    if output_dim not in (2, 3):
        raise ValueError(f"output_dim must be 2 or 3, found {output_dim!r}")
