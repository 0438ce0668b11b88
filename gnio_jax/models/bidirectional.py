"""LSTM and GRU layers over a whole window, in one direction or both, with PyTorch's gates and its
two biases per gate."""

from __future__ import annotations

import functools
import math
from typing import Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.models.layers import linear
from gnio_jax.models.recurrence import gru_unit, lstm_unit, scan_time


class Recurrence(nn.Module):
    """One direction. Returns the output at every sample, and the last one that it computes: with
    `reverse` that is the output at the first sample."""

    units: int
    cell: Literal["gru", "lstm"]
    reverse: bool = False

    @nn.compact
    def __call__(
        self, x: Float[Array, "b n c"], start: Float[Array, "b u"] | None = None
    ) -> tuple[Float[Array, "b n u"], Float[Array, "b u"]]:
        """A GRU may continue from the output `start`."""
        gates = {"gru": 3, "lstm": 4}[self.cell] * self.units
        draw = _uniform(self.units)
        inputs = linear(gates, "input", kernel_init=draw, bias_init=draw)(x)
        kernel = self.param("recurrent_kernel", draw, (self.units, gates), jnp.float32)
        bias = self.param("recurrent_bias", draw, (gates,), jnp.float32)

        zeros = jnp.zeros((x.shape[0], self.units), jnp.float32)
        zeros = zeros if start is None else start
        step, state = (gru_unit, zeros) if self.cell == "gru" else (lstm_unit, (zeros, zeros))
        unit = functools.partial(step, kernel=kernel, bias=bias)
        inputs = inputs[:, ::-1] if self.reverse else inputs
        _, outputs = scan_time(unit, state, inputs)
        last = outputs[:, -1]
        return (outputs[:, ::-1] if self.reverse else outputs), last


class Bidirectional(nn.Module):
    """Both directions side by side: (b, n, 2u), and the final outputs of both (b, 2u).

    The last sample of the backward direction is not its final output: that one is at the first
    sample.
    """

    units: int
    cell: Literal["gru", "lstm"]

    @nn.compact
    def __call__(
        self, x: Float[Array, "b n c"]
    ) -> tuple[Float[Array, "b n d"], Float[Array, "b d"]]:
        forward, of_forward = Recurrence(self.units, self.cell, name="forward")(x)
        backward, of_backward = Recurrence(self.units, self.cell, True, name="backward")(x)
        return (
            jnp.concatenate([forward, backward], axis=-1),
            jnp.concatenate([of_forward, of_backward], axis=-1),
        )


def _uniform(units: int) -> nn.initializers.Initializer:
    """PyTorch's start of recurrent layers: uniform within 1/√units."""
    bound = jnp.float32(1 / math.sqrt(units))
    return lambda key, shape, dtype=jnp.float32: jax.random.uniform(
        key, shape, jnp.float32, -bound, bound
    )
