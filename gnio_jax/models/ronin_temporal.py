"""RoNIN's two networks with memory: an LSTM of three layers, and a temporal convolutional network
(Herath, Yan and Furukawa, "RoNIN: Robust Neural Inertial Navigation in the Wild", ICRA 2020; the
TCN after Bai, Kolter and Koltun 2018). The LSTM's sizes are those of their public code. The TCN's
are those of their paper. The settings of the code have twice as many features in the first four
blocks, 540,488 parameters in the place of 177,176, and the same field of view of 253 samples.

Both see every sample. Published: the velocity at every sample along two axes, from [gyro, accel].
Ours: the displacement over the last window at the end of every interval, from [accel, gyro], along
three axes unless two are asked for; a constant uncertainty; GNIO's bank and heads as options.
"""

from __future__ import annotations

import functools
from typing import Literal, NamedTuple

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count, Probability
from gnio_jax.models.heads import LinearHead
from gnio_jax.models.layers import linear
from gnio_jax.models.memory import NetworkWithMemory
from gnio_jax.models.recurrence import lstm_unit, scan_time, taps

LSTM_LAYERS = 3
MIXED = 24
"""Products of channels that the LSTM sees beside the six channels."""
TCN_CHANNELS = (16, 32, 64, 128, 72, 36)
"""Features of the residual blocks; the dilation of block i is 2^i."""
TCN_SIZE = 3
"""Samples of each kernel. The whole network sees 253 samples."""


class RoNINTemporal(NetworkWithMemory):
    """The common part of both: two or three axes, and a constant uncertainty."""

    uncertainty: Literal["head", "calibrated", "constant"] = "constant"
    output_dim: Literal[2, 3] = 3

    def __post_init__(self) -> None:
        if self.output_dim == 2 and self.head != "linear":
            raise ValueError(f"output_dim must be 3 with the head {self.head}, found 2")
        super().__post_init__()

    @nn.nowrap
    def displacement_head(self) -> nn.Module:
        if self.head != "linear":
            return super().displacement_head()
        return LinearHead(self.output_dim, name="head")


class LSTMState(NamedTuple):
    """The memory of each layer of an LSTM."""

    hidden: Float[Array, "b l d"]
    cell: Float[Array, "b l d"]


class RoNINLSTM(RoNINTemporal):
    """A bilinear layer (24 products of the six channels) beside the channels, three LSTM layers of
    `width` units, and two linear layers, the first of which also sees the input of the LSTM.

    With `output_dim = 2` and the default width of 100 it has 216,620 parameters, as PyTorch counts
    them (a gate has two biases).
    """

    width: Count = 100

    @property
    def features(self) -> int:
        return 5 * self.output_dim

    def begin(self, batch: int) -> LSTMState:
        return LSTMState(*jnp.zeros((2, batch, LSTM_LAYERS, self.width), jnp.float32))

    def encode(
        self, state: LSTMState, signals: Float[Array, "b t c"], train: bool
    ) -> tuple[LSTMState, Float[Array, "b t d"]]:
        uniform = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
        bilinear = self.param("bilinear_kernel", uniform, (self.inputs**2, MIXED), jnp.float32)
        bias = self.param("bilinear_bias", nn.initializers.zeros, (MIXED,), jnp.float32)
        pairs = (signals[..., :, None] * signals[..., None, :]).reshape(*signals.shape[:2], -1)
        x = mixed = jnp.concatenate([signals, pairs @ bilinear + bias[None, None]], axis=-1)
        hidden, cell = [], []
        for layer in range(LSTM_LAYERS):
            inputs = linear(4 * self.width, f"input{layer + 1}", kernel_init=uniform)(x)
            shape = (self.width, 4 * self.width)
            kernel = self.param(f"recurrent_kernel{layer + 1}", uniform, shape, jnp.float32)
            shift = self.param(
                f"recurrent_bias{layer + 1}", nn.initializers.zeros, shape[1:], jnp.float32
            )

            unit = functools.partial(lstm_unit, kernel=kernel, bias=shift)
            (h, c), x = scan_time(unit, (state.hidden[:, layer], state.cell[:, layer]), inputs)
            hidden.append(h)
            cell.append(c)
        features = linear(self.features, "linear")(jnp.concatenate([mixed, x], axis=-1))
        return LSTMState(jnp.stack(hidden, axis=1), jnp.stack(cell, axis=1)), features


class RoNINTCN(RoNINTemporal):
    """Six residual blocks of two causal, dilated, weight-normalised convolutions of three samples,
    each with PReLU and dropout, and a 1×1 convolution on their features.

    Ours, where the publication gives no details: one slope for each PReLU. `width` scales all
    features (16: as published). Training needs the random stream `dropout`.
    """

    width: Count = 16
    dropout: Probability = 0.2

    @property
    def features(self) -> int:
        return self._channels()[-1]

    def _channels(self) -> list[int]:
        return [max(1, self.width * channels // 16) for channels in TCN_CHANNELS]

    def begin(self, batch: int) -> list[tuple[Array, Array]]:
        channels = [self.inputs, *self._channels()]
        return [
            (
                jnp.zeros((batch, (TCN_SIZE - 1) * 2**i, channels[i]), jnp.float32),
                jnp.zeros((batch, (TCN_SIZE - 1) * 2**i, channels[i + 1]), jnp.float32),
            )
            for i in range(len(TCN_CHANNELS))
        ]

    def encode(
        self, state: list[tuple[Array, Array]], signals: Float[Array, "b t c"], train: bool
    ) -> tuple[list[tuple[Array, Array]], Float[Array, "b t d"]]:
        x, after = signals, []
        for i, (features, past) in enumerate(zip(self._channels(), state, strict=True)):
            block = TemporalBlock(features, 2**i, self.dropout, name=f"block{i + 1}")
            memory, x = block(past, x, train)
            after.append(memory)
        return after, nn.Dropout(self.dropout, deterministic=not train)(x)


class TemporalBlock(nn.Module):
    """PReLU(x + f(x)), where f has two causal convolutions and x is projected if the number of
    features changes."""

    features: int
    dilation: int
    dropout: float

    @nn.compact
    def __call__(
        self, past: tuple[Array, Array], x: Float[Array, "b t c"], train: bool
    ) -> tuple[tuple[Array, Array], Float[Array, "b t d"]]:
        y, after = x, []
        for name, before in zip(("conv1", "conv2"), past, strict=True):
            y = jnp.concatenate([before, y], axis=1)
            after.append(y[:, y.shape[1] - before.shape[1] :])
            kernel = self.param(
                f"{name}_direction",
                nn.initializers.normal(0.01),
                (TCN_SIZE * before.shape[2], self.features),
                jnp.float32,
            )
            length = jnp.sqrt(jnp.sum(kernel**2, axis=0))
            scale = self.param(
                f"{name}_length",
                nn.initializers.constant(1.0),
                (self.features,),
                jnp.float32,
            )
            bias = self.param(f"{name}_bias", nn.initializers.zeros, (self.features,), jnp.float32)
            normed = kernel * (scale / length)[None]
            y = taps(y, TCN_SIZE, self.dilation) @ normed + bias[None, None]
            y = nn.PReLU(negative_slope_init=0.25, name=f"{name}_slope")(y)
            y = nn.Dropout(self.dropout, deterministic=not train)(y)
        if x.shape[-1] != self.features:
            x = linear(self.features, "shortcut", kernel_init=nn.initializers.normal(0.01))(x)
        return (after[0], after[1]), nn.PReLU(negative_slope_init=0.25, name="slope")(x + y)
