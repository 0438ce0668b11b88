"""DeepILS: a ResNet-18 of depthwise-separable convolutions with channel and time attention, written
from the network's description."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Float

from gnio_jax.models.layers import linear
from gnio_jax.models.precision import Dtype
from gnio_jax.models.resnet import batch_norm, conv, max_pool, residual_groups
from gnio_jax.models.ronin import DisplacementRegressor

REDUCTION = 16
"""Channels per hidden unit of the channel attention."""


class DeepILS(DisplacementRegressor):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement; the uncertainty is a
    constant.

    Published: the horizontal velocity over a window of 1 s, `output_dim = 2`, 2,290,226 parameters
    for windows of 200 samples. Ours: the displacement over the window, which is that velocity in a
    window of 1 s, along three axes (2,290,739) unless two are asked for; then the vertical one is
    0. Ours too: the shortcut where the shape changes is an ordinary 1×1 convolution with
    normalisation (the count leaves no other), and the linear layers start as in TLIO's head. Widths
    other than 64 scale every layer, for machines without an accelerator.
    """

    def features(self, windows: Float[jax.Array, "b n 6"], train: bool) -> jax.Array:
        padded = jnp.pad(windows, ((0, 0), (1, 1), (0, 0)))  # one more than its kernel asks for
        x = conv(self.width, 5, 2, train, "stem_conv", self.dtype)(padded)
        x = max_pool(nn.relu(batch_norm(train, "stem_bn")(x)))
        return residual_groups(partial(AttentiveBlock, dtype=self.dtype), self.width, x, train)


class AttentiveBlock(nn.Module):
    """Two depthwise-separable convolutions, attention over channels, then over time, and a
    shortcut, projected where the shape changes."""

    features: int
    stride: int
    dtype: Dtype = "float32"

    @nn.compact
    def __call__(self, x: Float[jax.Array, "b n c"], train: bool) -> Float[jax.Array, "b m d"]:
        y = _depthwise(x.shape[-1], self.stride, "depthwise1")(x)
        y = conv(self.features, 1, 1, train, "conv1", self.dtype)(y)
        y = nn.relu(batch_norm(train, "bn1")(y))
        y = _depthwise(self.features, 1, "depthwise2")(y)
        y = conv(self.features, 1, 1, train, "conv2", self.dtype)(y)
        y = batch_norm(train, "bn2")(y)
        y = ChannelAttention(self.dtype, name="channel_attention")(y)
        y = TimeAttention(self.dtype, name="time_attention")(y, train)
        if self.stride != 1 or x.shape[-1] != self.features:
            x = conv(self.features, 1, self.stride, train, "shortcut_conv", self.dtype)(x)
            x = batch_norm(train, "shortcut_bn")(x)
        return nn.relu(x + y)


class ChannelAttention(nn.Module):
    """x ⊙ σ(f(mean over time) + f(maximum over time)), f a shared C → C/16 → C without biases
    (ours: ReLU between, one unit at least)."""

    dtype: Dtype = "float32"

    @nn.compact
    def __call__(self, x: Float[jax.Array, "b n c"]) -> Float[jax.Array, "b n c"]:
        channels = x.shape[-1]
        pooled = jnp.stack([x.mean(axis=1), _maximum(x, 1)], axis=1)
        squeeze = linear(max(channels // REDUCTION, 1), "squeeze", self.dtype, use_bias=False)
        excite = linear(channels, "excite", self.dtype, use_bias=False)
        return x * nn.sigmoid(excite(nn.relu(squeeze(pooled))).sum(axis=1, keepdims=True))


class TimeAttention(nn.Module):
    """x ⊙ σ(convolution over 7 samples of the mean and the maximum over channels), without bias."""

    dtype: Dtype = "float32"

    @nn.compact
    def __call__(self, x: Float[jax.Array, "b n c"], train: bool) -> Float[jax.Array, "b n c"]:
        pooled = jnp.stack([x.mean(axis=-1), _maximum(x, 2)], axis=-1)
        return x * nn.sigmoid(conv(1, 7, 1, train, "conv", self.dtype)(pooled))


def _maximum(x: Float[jax.Array, "b n c"], axis: int) -> Float[jax.Array, "b k"]:
    """The maximum, whose gradient goes to the first place that holds it, as in PyTorch.

    That of `jnp.max` is shared by all values equal to the maximum; compilers may compute x a second
    time for the comparison and round differently, and a maximum that no value equals has the
    gradient 0/0.
    """
    places = jax.lax.broadcasted_iota(jnp.int32, x.shape, axis)
    return jnp.sum(jnp.where(places == jnp.argmax(x, axis=axis, keepdims=True), x, 0), axis=axis)


def _convolve_depthwise(
    x: Float[jax.Array, "b n c"],
    kernel: Float[jax.Array, "k 1 c"],
    window_strides: tuple[int],
    padding: list[tuple[int, int]],
    **_: object,
) -> Float[jax.Array, "b m c"]:
    """A convolution of every channel by itself, as a sum of k shifted products: XLA's own takes a
    generic loop for it on CPUs."""
    x = jnp.pad(x, ((0, 0), padding[0], (0, 0)))
    stride, size = window_strides[0], kernel.shape[0]
    length = (x.shape[1] - size) // stride + 1
    terms = [
        x[:, i : i + stride * (length - 1) + 1 : stride] * kernel[None, i] for i in range(size)
    ]
    return sum(terms[1:], terms[0])


def _depthwise(channels: int, stride: int, name: str) -> nn.Conv:
    """Over three samples, without bias. Ours: He's normal start over the three samples that a
    channel sees."""
    return nn.Conv(
        channels,
        (3,),
        stride,
        padding=[(1, 1)],
        feature_group_count=channels,
        use_bias=False,
        kernel_init=nn.initializers.variance_scaling(2.0, "fan_in", "normal"),
        dtype=jnp.float32,
        param_dtype=jnp.float32,
        conv_general_dilated=_convolve_depthwise,
        name=name,
    )
