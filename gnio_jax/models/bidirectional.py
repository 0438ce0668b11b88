"""LSTM and GRU layers over a whole window, in one direction or both, with PyTorch's gates and its
two biases per gate."""

from __future__ import annotations

import math
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.models.layers import linear
from gnio_jax.models.recurrence import scan_time


class Recurrence(nn.Module):
    """One direction. Returns the output at every sample, and the last one that it computes: with
    `reverse` that is the output at the first sample."""

    units: int
    cell: Literal["gru", "lstm"]
    reverse: bool = False

    @nn.compact
    def __call__(
        self, x: Float[Array, "b n c"]
    ) -> tuple[Float[Array, "b n u"], Float[Array, "b u"]]:
        gates = {"gru": 3, "lstm": 4}[self.cell] * self.units
        start = _uniform(self.units)
        inputs = linear(gates, "input", kernel_init=start, bias_init=start)(x)
        kernel = self.param("recurrent_kernel", start, (self.units, gates), jnp.float32)
        bias = self.param("recurrent_bias", start, (gates,), jnp.float32)

        def lstm(state: Any, inputs: Array) -> tuple[Any, Array]:
            hidden, memory = state
            values = jnp.split(inputs + hidden @ kernel + bias[None], 4, axis=-1)
            entry, forget, exit_ = (jax.nn.sigmoid(values[i]) for i in (0, 1, 3))
            memory = forget * memory + entry * jnp.tanh(values[2])
            hidden = exit_ * jnp.tanh(memory)
            return (hidden, memory), hidden

        def gru(hidden: Any, inputs: Array) -> tuple[Any, Array]:
            from_input, from_hidden = (
                jnp.split(part, 3, axis=-1) for part in (inputs, hidden @ kernel + bias[None])
            )
            reset, keep = (jax.nn.sigmoid(from_input[i] + from_hidden[i]) for i in (0, 1))
            candidate = jnp.tanh(from_input[2] + reset * from_hidden[2])
            hidden = (1 - keep) * candidate + keep * hidden
            return hidden, hidden

        zeros = jnp.zeros((x.shape[0], self.units), jnp.float32)
        unit, state = (gru, zeros) if self.cell == "gru" else (lstm, (zeros, zeros))
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
