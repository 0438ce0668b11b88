"""CTIN (Rao et al., "CTIN: Robust Contextual Transformer Network for Inertial Navigation", AAAI
2022, arXiv 2112.02143)."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count, Probability
from gnio_jax.models.convolution import convolve_groups, neighbours
from gnio_jax.models.heads import root_mean_square, to_axes
from gnio_jax.models.layers import (
    FLOAT32,
    attention,
    checked_windows,
    conv_norm,
    layer_norm,
    linear,
)
from gnio_jax.types import Prediction

SPAN = 3
"""Samples that the local attention sees."""
KEY_GROUPS = 4
"""Groups of the convolution that makes the keys of the local attention (ours, from the contextual
transformer block that it resembles)."""
SQUEEZE = 4
"""Channels per hidden unit in the layers that make the weights of the local attention (ours, from
the same block)."""


class CTIN(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to a velocity and its log standard
    deviation at every sample.

    A spatial encoder sees the whole window. A temporal embedding (BiLSTM and trainable positions)
    goes through a decoder whose self-attention is causal and which attends to the encoder. The
    publication gives the parts and the total of 0.56 M parameters, but not the sizes. Ours are 96
    features, 64 in the encoder, 192 in the feed-forward parts, 48 LSTM units a direction and 8
    heads. They give 555,364 parameters with `output_dim = 2`, as published, for windows of 200
    samples (there is a position for each sample), and the loss below has two more. A third axis
    adds 98. Training needs the random stream `dropout`.

    Velocities are in metres per duration of the window, m/s for the publication's 1 s. The window's
    displacement is their mean, m. Ours: its standard deviation per axis is the root mean square of
    those of the steps, as if all steps had the same error, because the errors of neighbouring steps
    are almost equal. With two axes the vertical velocity is 0, and its log standard deviation is 0
    too, which is 1 m per window.

    Diagnostics: `velocity` and `velocity_log_std` (b, n, 3); `task_log_std` (b, 2), the trained log
    δ_v and log δ_c with which the loss L_v / 2δ_v² + L_c / 2δ_c² + log δ_v δ_c balances the errors
    of the velocity and its likelihood.

    Ours, besides the sizes: ReLU where no activation is named; post-normalised layers as in the
    first transformer; dropout after the global attention of the encoder, and before every sum of
    the decoder.
    """

    width: Count = 96
    encoder_width: Count = 64
    ffn: Count = 192
    heads: Count = 8
    decoder_layers: Count = 4
    encoder_dropout: Probability = 0.5
    decoder_dropout: Probability = 0.05
    output_dim: Literal[2, 3] = 3
    takes_context = False

    def __post_init__(self) -> None:
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
    def __call__(self, windows: Float[Array, "b n 6"], train: bool = False) -> Prediction:
        windows = checked_windows(windows)
        x = SpatialEmbedding(self.width, name="spatial_embedding")(windows, train)
        sizes = self.encoder_width, self.heads, self.encoder_dropout
        memory = SpatialEncoder(*sizes, name="encoder")(x, train)
        x = TemporalEmbedding(self.width, name="temporal_embedding")(windows)
        sizes = self.heads, self.ffn, self.decoder_dropout
        for layer in range(self.decoder_layers):
            x = CausalDecoderLayer(*sizes, name=f"decoder_{layer + 1}")(x, memory, train)
        # The uncertainty starts at σ = 1 (ours), as in `heads.UncertaintyHead` and for the same
        # reason.
        starts = {"velocity": nn.initializers.lecun_normal(), "log_std": nn.initializers.zeros}
        velocity, log_std = (
            jax.vmap(to_axes)(SampleHead(self.output_dim, start, name=name)(x))
            for name, start in starts.items()
        )
        task_log_std = self.param("task_log_std", nn.initializers.zeros, (2,), jnp.float32)
        diagnostics = {
            "velocity": velocity,
            "velocity_log_std": log_std,
            "task_log_std": jnp.broadcast_to(task_log_std[None], (windows.shape[0], 2)),
        }
        return Prediction(velocity.mean(axis=1), root_mean_square(log_std), diagnostics)


class SpatialEmbedding(nn.Module):
    """Convolution (ours: over 3 samples), normalisation, linear layer."""

    width: int

    @nn.compact
    def __call__(self, windows: Float[Array, "b n c"], train: bool) -> Float[Array, "b n d"]:
        return linear(self.width, "linear")(conv_norm(windows, self.width, 3, 1, train, "conv"))


class SpatialEncoder(nn.Module):
    """A residual bottleneck: 1×1 convolution, local attention, global multi-head attention, 1×1
    convolution."""

    width: int
    heads: int
    dropout: float

    @nn.compact
    def __call__(self, x: Float[Array, "b n d"], train: bool) -> Float[Array, "b n d"]:
        drop = nn.Dropout(self.dropout, deterministic=not train)
        y = nn.relu(conv_norm(x, self.width, 1, 1, train, "reduce_conv"))
        y = LocalAttention(name="local")(y, train)
        y = drop(attention(self.heads, "global")(y))
        return nn.relu(x + conv_norm(y, x.shape[-1], 1, 1, train, "expand_conv"))


class LocalAttention(nn.Module):
    """Every channel of every sample attends to three samples, with weights that depend on the
    sample and on the context in its key.

    The keys are a grouped convolution over 3 samples, the static context. The queries are the
    samples themselves, and the values are a 1×1 convolution. Two 1×1 convolutions make the weights
    from [query, key] (ours: softmax over the three samples; beyond the window the values are 0),
    and the weighted values are the local context. An attention computed from the mean over time of
    the sum of local context and keys fuses these two.
    """

    @nn.compact
    def __call__(self, x: Float[Array, "b n c"], train: bool) -> Float[Array, "b n c"]:
        batch, samples, channels = x.shape
        groups = {"feature_group_count": KEY_GROUPS, "conv_general_dilated": convolve_groups}
        key = nn.relu(conv_norm(x, channels, SPAN, 1, train, "key_conv", **groups))
        value = conv_norm(x, channels, 1, 1, train, "value_conv")
        hidden = jnp.concatenate([x, key], axis=-1)
        hidden = nn.relu(conv_norm(hidden, channels // SQUEEZE, 1, 1, train, "hidden_conv"))
        scores = linear(SPAN * channels, "weights")(hidden)
        weights = nn.softmax(scores.reshape(batch, samples, SPAN, channels), axis=2)
        context = jnp.sum(weights * neighbours(value, SPAN), axis=2)

        contexts = jnp.stack([context, key], axis=1)
        squeeze = linear(channels // SQUEEZE, "squeeze", use_bias=False)
        pooled = nn.relu(squeeze(contexts.sum(axis=1).mean(axis=1)))
        excited = linear(2 * channels, "excite")(pooled)
        shares = nn.softmax(excited.reshape(batch, 2, 1, channels), axis=1)
        return jnp.sum(shares * contexts, axis=1)


class TemporalEmbedding(nn.Module):
    """A bidirectional LSTM over the samples, plus a trainable vector for each sample."""

    width: int

    @nn.compact
    def __call__(self, windows: Float[Array, "b n c"]) -> Float[Array, "b n d"]:
        forward, backward = (
            nn.RNN(nn.OptimizedLSTMCell(self.width // 2, name=name, **FLOAT32))
            for name in ("lstm_forward", "lstm_backward")
        )
        positions = self.param(
            "positions", nn.initializers.normal(0.02), (windows.shape[1], self.width), jnp.float32
        )
        # Flax's own initial carry is zero too, but it splits a random key, which no export
        # converts.
        zero = jnp.zeros((len(windows), self.width // 2), jnp.float32)
        carry = ((zero, zero), (zero, zero))
        bidirectional = nn.Bidirectional(forward, backward)
        return jnp.add(bidirectional(windows, initial_carry=carry), positions[None])


class CausalDecoderLayer(nn.Module):
    """Causal self-attention, attention to the encoder, feed-forward; each added to its input, then
    normalised."""

    heads: int
    ffn: int
    dropout: float

    @nn.compact
    def __call__(
        self, x: Float[Array, "b n d"], memory: Float[Array, "b n d"], train: bool
    ) -> Float[Array, "b n d"]:
        drop = nn.Dropout(self.dropout, deterministic=not train)
        # A constant: ONNX Runtime has no Where for booleans, by which JAX would make it.
        causal = np.tril(np.ones((x.shape[1], x.shape[1]), bool))[None, None]
        y = attention(self.heads, "self")(x, mask=jnp.asarray(causal))
        x = layer_norm("self_norm")(x + drop(y))
        y = attention(self.heads, "cross")(x, memory)
        x = layer_norm("cross_norm")(x + drop(y))
        y = drop(nn.relu(linear(self.ffn, "expand")(x)))
        y = linear(x.shape[-1], "contract")(y)
        return layer_norm("ffn_norm")(x + drop(y))


class SampleHead(nn.Module):
    """Linear, layer normalisation, linear, at every sample.

    The publication's text can be read as normalising the output itself, which would remove its
    scale. Ours: half the features between.
    """

    outputs: int
    output_init: nn.initializers.Initializer

    @nn.compact
    def __call__(self, x: Float[Array, "b n d"]) -> Float[Array, "b n k"]:
        hidden = layer_norm("norm")(linear(x.shape[-1] // 2, "hidden")(x))
        return linear(self.outputs, "output", kernel_init=self.output_init)(hidden)
