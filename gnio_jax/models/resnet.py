"""The encoder: a 1-D ResNet-18 over a window of IMU samples (paper §III-B), which TLIO and RoNIN
share."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.models.convolution import max_pool
from gnio_jax.models.layers import Normalisation, conv_norm

BLOCKS_PER_GROUP = 2
GROUP_STRIDES = (1, 2, 2, 2)


class ResNet18(nn.Module):
    """Windows (b, n, 6) to feature maps (b, ⌈n/32⌉, 8·width): stem, max-pool, four groups of two
    basic blocks.

    width: features of the first group. winograd: whether a convolution of three samples trains by
    Winograd's algorithm (`models.convolution`). normalisation: that of every convolution.
    """

    width: int = 64
    winograd: bool = False
    normalisation: Normalisation = "batch"

    @nn.compact
    def __call__(
        self, windows: Float[Array, "b n 6"], train: bool = False
    ) -> Float[Array, "b m d"]:
        stem = conv_norm(windows, self.width, 7, 2, train, "stem_conv", self.normalisation)
        block = partial(BasicBlock, winograd=self.winograd, normalisation=self.normalisation)
        return residual_groups(block, self.width, max_pool(nn.relu(stem)), train)


def residual_groups(
    block: Callable[..., nn.Module], width: int, x: Float[Array, "b n c"], train: bool
) -> Float[Array, "b m d"]:
    """Four groups of two blocks. Each group has twice the features of the one before it, and all
    but the first halve the length. Call it within a module."""
    for group, stride in enumerate(GROUP_STRIDES):
        for number in range(BLOCKS_PER_GROUP):
            name = f"group{group + 1}_block{number + 1}"
            x = block(width * 2**group, stride if number == 0 else 1, name=name)(x, train)
    return x


class BasicBlock(nn.Module):
    """Two 3-sample convolutions and a shortcut, projected by a 1×1 convolution where the shape
    changes."""

    features: int
    stride: int
    winograd: bool = False
    normalisation: Normalisation = "batch"

    @nn.compact
    def __call__(self, x: Float[Array, "b n c"], train: bool) -> Float[Array, "b m d"]:
        options: dict[str, Any] = {"winograd": self.winograd, "normalisation": self.normalisation}
        y = nn.relu(conv_norm(x, self.features, 3, self.stride, train, "conv1", **options))
        y = conv_norm(y, self.features, 3, 1, train, "conv2", **options)
        return nn.relu(shortcut(x, self.features, self.stride, train, self.normalisation) + y)


def shortcut(
    x: Float[Array, "b n c"],
    features: int,
    stride: int,
    train: bool,
    normalisation: Normalisation = "batch",
) -> Float[Array, "b m d"]:
    """The input of a block in the shape of its output: projected by a 1×1 convolution if the shape
    changes. Call it within a module."""
    if stride == 1 and x.shape[-1] == features:
        return x
    return conv_norm(x, features, 1, stride, train, "shortcut_conv", normalisation)
