"""A gated recurrent unit over a strided causal stem (ours): the smallest network with memory."""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count
from gnio_jax.models.layers import linear
from gnio_jax.models.memory import NetworkWithMemory
from gnio_jax.models.recurrence import causal_conv, gru_unit, scan_time

STEM = (9, 5), (5, 2)
"""Size and stride of each convolution of the stem; a step of the unit takes 10 samples, 0.1 s at
100 Hz."""


class GRUState(NamedTuple):
    """The memory of a `GRUNetwork`."""

    samples: Float[Array, "b 4 c"]
    """The samples that the first convolution needs again."""
    maps: Float[Array, "b 3 w"]
    """The features that the second convolution needs again."""
    hidden: Float[Array, "b d"]
    """The state of the unit."""


class GRUNetwork(NetworkWithMemory):
    """Two causal convolutions with ReLU (9 samples at stride 5, `width` features; 5 at stride 2,
    1.5 `width`) and a GRU of 3 `width` features (Cho et al. 2014, in PyTorch's form).

    With the default width of 64 and a linear head it has 0.21 million parameters.
    """

    width: Count = 64

    @property
    def features(self) -> int:
        return 3 * self.width

    @property
    def multiple(self) -> int:
        return STEM[0][1] * STEM[1][1]

    def begin(self, batch: int) -> GRUState:
        past = [size - stride for size, stride in STEM]
        shapes = (past[0], self.inputs), (past[1], self.width), (self.features,)
        return GRUState(*(jnp.zeros((batch, *shape), jnp.float32) for shape in shapes))

    def encode(
        self, state: GRUState, signals: Float[Array, "b t c"], train: bool
    ) -> tuple[GRUState, Float[Array, "b m d"]]:
        samples, x = causal_conv(state.samples, signals, self.width, *STEM[0], train, "conv1")
        wide = 3 * self.width // 2
        maps, x = causal_conv(state.maps, nn.relu(x), wide, *STEM[1], train, "conv2")
        inputs = linear(3 * self.features, "input")(nn.relu(x))
        kernel = self.param(
            "recurrent_kernel",
            nn.initializers.orthogonal(),
            (self.features, 3 * self.features),
            jnp.float32,
        )
        bias = self.param(
            "recurrent_bias", nn.initializers.zeros, (3 * self.features,), jnp.float32
        )

        unit = functools.partial(gru_unit, kernel=kernel, bias=bias)
        hidden, features = scan_time(unit, state.hidden, inputs)
        return GRUState(samples, maps, hidden), features
