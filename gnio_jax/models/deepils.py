"""DeepILS: a ResNet-18 of depthwise-separable convolutions with channel and time attention, written
from the network's description."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.models.convolution import convolve_depthwise, max_pool
from gnio_jax.models.layers import conv, conv_norm, linear
from gnio_jax.models.resnet import residual_groups, shortcut
from gnio_jax.models.ronin import DisplacementRegressor

REDUCTION = 16
"""Channels per hidden unit of the channel attention."""


class DeepILS(DisplacementRegressor):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement; the uncertainty is a
    constant.

    Published: the horizontal velocity over a window of 1 s, `output_dim = 2`, 2,290,226 parameters
    for windows of 200 samples. Ours: the displacement over the window, which is that velocity in a
    window of 1 s, along three axes (2,290,739) unless two are asked for; then the vertical one is
    0. Also ours: the shortcut where the shape changes is an ordinary 1×1 convolution with
    normalisation (the number of parameters allows no other), and the linear layers start as in
    TLIO's head. Widths other than 64 scale every layer, for machines without an accelerator.
    """

    def features(self, windows: Float[Array, "b n 6"], train: bool) -> Array:
        padded = jnp.pad(windows, ((0, 0), (1, 1), (0, 0)))  # one more than its kernel needs
        x = max_pool(nn.relu(conv_norm(padded, self.width, 5, 2, train, "stem_conv")))
        return residual_groups(AttentiveBlock, self.width, x, train)


class AttentiveBlock(nn.Module):
    """Two depthwise-separable convolutions, attention over channels, then over time, and a
    shortcut, projected where the shape changes."""

    features: int
    stride: int

    @nn.compact
    def __call__(self, x: Float[Array, "b n c"], train: bool) -> Float[Array, "b m d"]:
        y = _depthwise(x.shape[-1], self.stride, train, "depthwise1")(x)
        y = nn.relu(conv_norm(y, self.features, 1, 1, train, "conv1"))
        y = _depthwise(self.features, 1, train, "depthwise2")(y)
        y = conv_norm(y, self.features, 1, 1, train, "conv2")
        y = ChannelAttention(name="channel_attention")(y)
        y = TimeAttention(name="time_attention")(y, train)
        return nn.relu(shortcut(x, self.features, self.stride, train) + y)


class ChannelAttention(nn.Module):
    """x ⊙ σ(f(mean over time) + f(maximum over time)), f a shared C → C/16 → C without biases
    (ours: ReLU between, one unit at least)."""

    @nn.compact
    def __call__(self, x: Float[Array, "b n c"]) -> Float[Array, "b n c"]:
        channels = x.shape[-1]
        pooled = jnp.stack([x.mean(axis=1), maximum(x, 1)], axis=1)
        squeeze = linear(max(channels // REDUCTION, 1), "squeeze", use_bias=False)
        excite = linear(channels, "excite", use_bias=False)
        return x * nn.sigmoid(excite(nn.relu(squeeze(pooled))).sum(axis=1, keepdims=True))


class TimeAttention(nn.Module):
    """x ⊙ σ(convolution over 7 samples of the mean and the maximum over channels), without bias."""

    @nn.compact
    def __call__(self, x: Float[Array, "b n c"], train: bool) -> Float[Array, "b n c"]:
        pooled = jnp.stack([x.mean(axis=-1), maximum(x, 2)], axis=-1)
        return x * nn.sigmoid(conv(1, 7, 1, train, "conv")(pooled))


def maximum(x: Float[Array, "b n c"], axis: int) -> Float[Array, "b k"]:
    """The maximum, whose gradient goes to the first place that has this value, as in PyTorch.

    The gradient of `jnp.max` is divided among all values that equal the maximum. Compilers may
    compute x a second time for the comparison and round differently, and if no value equals the
    maximum, the gradient is 0/0.
    """
    places = jax.lax.broadcasted_iota(jnp.int32, x.shape, axis)
    return jnp.sum(jnp.where(places == jnp.argmax(x, axis=axis, keepdims=True), x, 0), axis=axis)


def _depthwise(channels: int, stride: int, train: bool, name: str) -> nn.Conv:
    """A depthwise convolution over three samples. Ours: He's normal initialisation for the three
    samples that a channel sees."""
    options = {
        "feature_group_count": channels,
        "kernel_init": nn.initializers.variance_scaling(2.0, "fan_in", "normal"),
        "conv_general_dilated": convolve_depthwise,
    }
    return conv(channels, 3, stride, train, name, **options)
