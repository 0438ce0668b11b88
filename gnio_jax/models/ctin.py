"""CTIN (Rao et al., "CTIN: Robust Contextual Transformer Network for Inertial Navigation", AAAI
2022, arXiv 2112.02143)."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Float

from gnio_jax.models.heads import root_mean_square, to_axes
from gnio_jax.models.layers import attention, check_dropout, check_output_dim, layer_norm, linear
from gnio_jax.models.precision import Dtype, einsum
from gnio_jax.models.resnet import batch_norm, conv, he_normal_fan_out
from gnio_jax.types import Prediction

SPAN = 3
"""Samples that the local attention sees."""
KEY_GROUPS = 4
"""Groups of the convolution that makes its keys (ours, from the contextual transformer block that
it resembles)."""
SQUEEZE = 4
"""Channels per hidden unit where the local attention weighs (ours, from there too)."""


class CTIN(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to a velocity and its log standard
    deviation at every sample.

    A spatial encoder looks over the whole window, a temporal embedding (BiLSTM and learnt
    positions) goes through a decoder whose self-attention is causal and which attends to the
    encoder. The publication gives the parts and 0.56 M parameters in all, not the sizes; ours are
    96 features, 64 in the encoder, 192 in the feed-forward parts, 48 LSTM units a direction and 8
    heads: 555,364 with `output_dim = 2`, as published, for windows of 200 samples (the positions
    follow the window), and two for the loss below. A third axis costs 98. Training needs the random
    stream `dropout`.

    Velocities are in metres per duration of the window, m/s for the publication's 1 s. The window's
    displacement is their mean, m. Ours: its standard deviation per axis is the root mean square of
    the steps', as if their errors were one, since those of neighbours all but are. With two axes
    the vertical velocity is 0 and so is its log standard deviation, 1 m per window.

    Diagnostics: `velocity` and `velocity_log_std` (b, n, 3); `task_log_std` (b, 2), the trained log
    δ_v and log δ_c with which the loss L_v / 2δ_v² + L_c / 2δ_c² + log δ_v δ_c balances the errors
    of the velocity and its likelihood.

    Ours, beyond the sizes: ReLU where an activation is not named; post-normalised layers as in the
    first transformer; dropout of the encoder after its global attention, of the decoder before
    every sum.
    """

    width: int = 96
    encoder_width: int = 64
    ffn: int = 192
    heads: int = 8
    decoder_layers: int = 4
    encoder_dropout: float = 0.5
    decoder_dropout: float = 0.05
    output_dim: int = 3
    dtype: Dtype = "float32"

    def __post_init__(self) -> None:
        check_dropout(self.encoder_dropout)
        check_dropout(self.decoder_dropout)
        check_output_dim(self.output_dim)
        for name in ("heads", "ffn", "decoder_layers"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, found {getattr(self, name)!r}")
        if self.width % 2 or self.width % self.heads:
            raise ValueError(
                f"width must be even and a multiple of the {self.heads} heads, found {self.width}"
            )
        if self.encoder_width % self.heads or self.encoder_width % KEY_GROUPS:
            raise ValueError(
                f"encoder_width must be a multiple of the {self.heads} heads and of {KEY_GROUPS}, "
                f"found {self.encoder_width}"
            )
        super().__post_init__()

    @nn.compact
    def __call__(self, windows: Float[jax.Array, "b n 6"], train: bool = False) -> Prediction:
        windows = windows.astype(jnp.float32)
        x = SpatialEmbedding(self.width, self.dtype, name="spatial_embedding")(windows, train)
        sizes = self.encoder_width, self.heads, self.encoder_dropout
        memory = SpatialEncoder(*sizes, self.dtype, name="encoder")(x, train)
        x = TemporalEmbedding(self.width, name="temporal_embedding")(windows)
        sizes = self.heads, self.ffn, self.decoder_dropout
        for layer in range(self.decoder_layers):
            name = f"decoder_{layer + 1}"
            x = DecoderLayer(*sizes, self.dtype, name=name)(x, memory, train)
        # The uncertainty starts at σ = 1 (ours), as in `heads.UncertaintyHead` and for its reason.
        starts = {"velocity": nn.initializers.lecun_normal(), "log_std": nn.initializers.zeros}
        velocity, log_std = (
            jax.vmap(to_axes)(SampleHead(self.output_dim, start, self.dtype, name=name)(x))
            for name, start in starts.items()
        )
        task_log_std = self.param("task_log_std", nn.initializers.zeros, (2,), jnp.float32)
        return Prediction(
            velocity.mean(axis=1),
            root_mean_square(log_std),
            {
                "velocity": velocity,
                "velocity_log_std": log_std,
                "task_log_std": jnp.broadcast_to(task_log_std[None], (windows.shape[0], 2)),
            },
        )


class SpatialEmbedding(nn.Module):
    """Convolution (ours: over 3 samples), normalisation, linear layer."""

    width: int
    dtype: Dtype = "float32"

    @nn.compact
    def __call__(
        self, windows: Float[jax.Array, "b n c"], train: bool
    ) -> Float[jax.Array, "b n d"]:
        x = conv(self.width, 3, 1, train, "conv", self.dtype)(windows)
        return linear(self.width, "linear", self.dtype)(batch_norm(train, "bn")(x))


class SpatialEncoder(nn.Module):
    """A residual bottleneck: 1×1 convolution, local attention, global multi-head attention, 1×1
    convolution."""

    width: int
    heads: int
    dropout: float
    dtype: Dtype = "float32"

    @nn.compact
    def __call__(self, x: Float[jax.Array, "b n d"], train: bool) -> Float[jax.Array, "b n d"]:
        drop = nn.Dropout(self.dropout, deterministic=not train)
        y = conv(self.width, 1, 1, train, "reduce_conv", self.dtype)(x)
        y = nn.relu(batch_norm(train, "reduce_bn")(y))
        y = LocalAttention(self.dtype, name="local")(y, train)
        y = drop(attention(self.heads, "global", self.dtype)(y))
        y = conv(x.shape[-1], 1, 1, train, "expand_conv", self.dtype)(y)
        y = batch_norm(train, "expand_bn")(y)
        return nn.relu(x + y)


class LocalAttention(nn.Module):
    """Every channel of every sample attends to three samples, with weights from the sample and the
    context that its key holds.

    Keys: a convolution of groups over 3 samples, the static context; queries: the samples
    themselves; values: a 1×1 convolution. Two 1×1 convolutions make the weights from [query, key]
    (ours: softmax over the three samples; beyond the window the values are 0), which give the local
    context. An attention over the two, from their sum's mean over time, fuses the local context and
    the keys.
    """

    dtype: Dtype = "float32"

    @nn.compact
    def __call__(self, x: Float[jax.Array, "b n c"], train: bool) -> Float[jax.Array, "b n c"]:
        batch, samples, channels = x.shape
        key_conv = nn.Conv(
            channels,
            (SPAN,),
            padding=[(1, 1)],
            feature_group_count=KEY_GROUPS,
            use_bias=False,
            kernel_init=he_normal_fan_out,
            dtype=jnp.float32,
            param_dtype=jnp.float32,
            conv_general_dilated=partial(_convolve_groups, dtype=self.dtype),
            name="key_conv",
        )
        key = nn.relu(batch_norm(train, "key_bn")(key_conv(x)))
        value = conv(channels, 1, 1, train, "value_conv", self.dtype)(x)
        value = batch_norm(train, "value_bn")(value)
        hidden = conv(channels // SQUEEZE, 1, 1, train, "hidden_conv", self.dtype)(
            jnp.concatenate([x, key], axis=-1)
        )
        hidden = nn.relu(batch_norm(train, "hidden_bn")(hidden))
        scores = linear(SPAN * channels, "weights", self.dtype)(hidden)
        weights = nn.softmax(scores.reshape(batch, samples, SPAN, channels), axis=2)
        context = jnp.sum(weights * _neighbours(value, SPAN), axis=2)

        both = jnp.stack([context, key], axis=1)
        squeeze = linear(channels // SQUEEZE, "squeeze", self.dtype, use_bias=False)
        pooled = nn.relu(squeeze(both.sum(axis=1).mean(axis=1)))
        excited = linear(2 * channels, "excite", self.dtype)(pooled)
        shares = nn.softmax(excited.reshape(batch, 2, 1, channels), axis=1)
        return jnp.sum(shares * both, axis=1)


class TemporalEmbedding(nn.Module):
    """A bidirectional LSTM over the samples, plus a learnt vector for each place in the window."""

    width: int

    @nn.compact
    def __call__(self, windows: Float[jax.Array, "b n c"]) -> Float[jax.Array, "b n d"]:
        forward, backward = (
            nn.RNN(
                nn.OptimizedLSTMCell(
                    self.width // 2, dtype=jnp.float32, param_dtype=jnp.float32, name=name
                )
            )
            for name in ("lstm_forward", "lstm_backward")
        )
        positions = self.param(
            "positions", nn.initializers.normal(0.02), (windows.shape[1], self.width), jnp.float32
        )
        return jnp.add(nn.Bidirectional(forward, backward)(windows), positions[None])


class DecoderLayer(nn.Module):
    """Causal self-attention, attention to the encoder, feed-forward; each added to its input, then
    normalised."""

    heads: int
    ffn: int
    dropout: float
    dtype: Dtype = "float32"

    @nn.compact
    def __call__(
        self, x: Float[jax.Array, "b n d"], memory: Float[jax.Array, "b n d"], train: bool
    ) -> Float[jax.Array, "b n d"]:
        drop = nn.Dropout(self.dropout, deterministic=not train)
        causal = jnp.tril(jnp.ones((x.shape[1], x.shape[1]), bool))[None, None]
        y = attention(self.heads, "self", self.dtype)(x, mask=causal)
        x = layer_norm("self_norm")(x + drop(y))
        y = attention(self.heads, "cross", self.dtype)(x, memory)
        x = layer_norm("cross_norm")(x + drop(y))
        y = drop(nn.relu(linear(self.ffn, "expand", self.dtype)(x)))
        y = linear(x.shape[-1], "contract", self.dtype)(y)
        return layer_norm("ffn_norm")(x + drop(y))


class SampleHead(nn.Module):
    """Linear, layer normalisation, linear, at every sample.

    The publication's text can be read as normalising the output itself, which would take its scale
    away. Ours: half the features between.
    """

    outputs: int
    output_init: nn.initializers.Initializer
    dtype: Dtype = "float32"

    @nn.compact
    def __call__(self, x: Float[jax.Array, "b n d"]) -> Float[jax.Array, "b n k"]:
        hidden = layer_norm("norm")(linear(x.shape[-1] // 2, "hidden", self.dtype)(x))
        return linear(self.outputs, "output", self.dtype, kernel_init=self.output_init)(hidden)


def _neighbours(x: Float[jax.Array, "b n c"], span: int) -> Float[jax.Array, "b n s c"]:
    """Of every sample the `span` samples around it, zeros beyond the ends."""
    padded = jnp.pad(x, ((0, 0), (span // 2, span // 2), (0, 0)))
    return jnp.stack([padded[:, i : i + x.shape[1]] for i in range(span)], axis=2)


def _convolve_groups(
    x: Float[jax.Array, "b n c"],
    kernel: Float[jax.Array, "k g d"],
    *_: object,
    feature_group_count: int = 1,
    dtype: Dtype,
    **__: object,
) -> Float[jax.Array, "b n d"]:
    """A convolution of groups of channels that keeps the length, as products: the gradient of XLA's
    own is slow on CPUs."""
    size, channels, features = kernel.shape
    batch, samples, _channels = x.shape
    shifted = _neighbours(x, size).reshape(batch, samples, size, feature_group_count, channels)
    kernel = kernel.reshape(size, channels, feature_group_count, features // feature_group_count)
    product = einsum("bnkgc,kcgd->bngd", shifted, kernel, dtype)
    return product.reshape(batch, samples, features)
