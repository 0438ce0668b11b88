"""IONext (arXiv 2507.17089, 2025): a convolutional network whose blocks choose between three sizes
of kernel by softmax."""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count
from gnio_jax.models.airio import norm
from gnio_jax.models.convolution import convolve_depthwise
from gnio_jax.models.deepils import maximum
from gnio_jax.models.heads import ConstantUncertainty, to_axes
from gnio_jax.models.layers import FLOAT32, checked_windows, linear, repeat_ends, unpadded_conv
from gnio_jax.types import Prediction

DEPTHS = (2, 2, 6, 2)
"""Blocks of each stage."""
SIZES = ((1, 3, 11), (1, 5, 17))
"""Kernels of the two halves of the channels."""
GATE_SIZE = 3
"""Samples of the gated convolution (assumed)."""


class IONext(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement; the uncertainty is a
    constant. 10,641,506 parameters with two outputs, against 1.1e7 in the publication.

    A stem of stride 4, and four stages of 96, 192, 384 and 768 channels, between which a
    convolution of stride 2 halves the length. A block is x ← x + ADM(norm x), x ← x + AGU(norm x);
    there are no other nonlinearities. Assumed, because the publication does not say it: a norm
    before the head and after the stem, the softmax over the branches, three samples in the gate's
    convolution. Published: the mean horizontal velocity over 1 s at 200 Hz. Ours: the displacement.

    `width`: channels of the first stage.
    """

    width: Count = 96
    output_dim: Literal[2, 3] = 3

    def __post_init__(self) -> None:
        if self.width % 2:
            raise ValueError(f"width must be even, found {self.width}")
        super().__post_init__()

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 6"], train: bool = False) -> Prediction:
        x = unpadded_conv(self.width, 4, 4, train, "stem")(checked_windows(windows))
        x = norm("stem_norm", train)(x)
        for stage, depth in enumerate(DEPTHS):
            if stage:
                x = norm(f"down{stage}_norm", train)(x)
                x = repeat_ends(x, 0, x.shape[1] % 2, axis=1)
                x = unpadded_conv(self.width * 2**stage, 2, 2, train, f"down{stage}")(x)
            for number in range(depth):
                x = DynamicBlock(name=f"stage{stage + 1}_block{number + 1}")(x, train)
        h = norm("last_norm", train)(x).mean(axis=1)
        displacement = to_axes(linear(self.output_dim, "displacement")(h))
        return Prediction(displacement, ConstantUncertainty(name="uncertainty")(h, train))


class DynamicBlock(nn.Module):
    """Adaptive dynamic mixer (ADM) and spatio-temporal gating unit (AGU), each with a norm before
    it and a shortcut; 4.5 C² + 35 C parameters for C channels."""

    @nn.compact
    def __call__(self, x: Float[Array, "b n c"], train: bool) -> Float[Array, "b n c"]:
        channels = x.shape[-1]
        y = norm("mixer_norm", train)(x)
        halves = []
        for half, (part, sizes) in enumerate(zip(jnp.split(y, 2, axis=-1), SIZES, strict=True)):
            branches = [
                _depthwise(part.shape[-1], size, f"half{half}_k{size}")(part) for size in sizes
            ]
            scores = linear(3 * part.shape[-1], f"half{half}_choice")(part.mean(axis=1))
            shares = nn.softmax(scores.reshape(len(scores), 1, 3, -1), axis=2)
            halves.append(jnp.sum(shares * jnp.stack(branches, axis=2), axis=2))
        x = x + linear(channels, "mixer")(jnp.concatenate(halves, axis=-1))
        y = norm("gate_norm", train)(x)
        pooled = jnp.concatenate([y.mean(axis=1), maximum(y, 1)], axis=-1)
        gate = nn.sigmoid(linear(channels, "gate")(pooled))
        return x + gate[:, None] * _depthwise(channels, GATE_SIZE, "gated")(y)


def _depthwise(channels: int, size: int, name: str) -> nn.Conv:
    return nn.Conv(
        channels,
        (size,),
        (1,),
        [(size // 2, size // 2)],
        feature_group_count=channels,
        conv_general_dilated=convolve_depthwise,
        name=name,
        **FLOAT32,
    )
