"""The parts of which networks with memory are made. Each continues from what it remembers, so that
a signal may be cut anywhere, with the same results to rounding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gnio_jax.models.layers import unpadded_conv


def causal_conv(
    past: Float[Array, "b p c"],
    x: Float[Array, "b t c"],
    features: int,
    size: int,
    stride: int,
    train: bool,
    name: str,
) -> tuple[Float[Array, "b p c"], Float[Array, "b m d"]]:
    """The p = size − stride inputs that the next call needs, and the outputs of a causal
    convolution with bias: the last input of each output is the newest one. t is a multiple of the
    stride. Call it within a module."""
    x = jnp.concatenate([past, x], axis=1)
    conv = unpadded_conv(features, size, stride, train, name)
    return x[:, x.shape[1] - past.shape[1] :], conv(x)


def lstm_unit(
    state: tuple[Float[Array, "b u"], Float[Array, "b u"]],
    inputs: Float[Array, "b 4*u"],
    kernel: Float[Array, "u 4*u"],
    bias: Float[Array, "4*u"],
) -> tuple[tuple[Array, Array], Float[Array, "b u"]]:
    """A step of an LSTM (Hochreiter and Schmidhuber 1997, with PyTorch's order of the gates), from
    its hidden state and its cell, and what the inputs add to the gates."""
    hidden, cell = state
    values = jnp.split(inputs + hidden @ kernel + bias[None], 4, axis=-1)
    entry, forget, exit_ = (jax.nn.sigmoid(values[i]) for i in (0, 1, 3))
    cell = forget * cell + entry * jnp.tanh(values[2])
    hidden = exit_ * jnp.tanh(cell)
    return (hidden, cell), hidden


def gru_unit(
    hidden: Float[Array, "b u"],
    inputs: Float[Array, "b 3*u"],
    kernel: Float[Array, "u 3*u"],
    bias: Float[Array, "3*u"],
) -> tuple[Float[Array, "b u"], Float[Array, "b u"]]:
    """A step of a GRU (Cho et al. 2014, in PyTorch's form), from its hidden state and what the
    inputs add to the gates."""
    of_inputs = jnp.split(inputs, 3, axis=-1)
    of_hidden = jnp.split(hidden @ kernel + bias[None], 3, axis=-1)
    reset, share = (jax.nn.sigmoid(of_inputs[i] + of_hidden[i]) for i in (0, 1))
    candidate = jnp.tanh(of_inputs[2] + reset * of_hidden[2])
    hidden = (1 - share) * candidate + share * hidden
    return hidden, hidden


def scan_time(
    unit: Callable[[Any, Array], tuple[Any, Array]], state: Any, inputs: Float[Array, "b m d"]
) -> tuple[Any, Float[Array, "b m k"]]:
    """`lax.scan` along the second axis; a single step is not a loop."""
    if inputs.shape[1] == 1:
        state, output = unit(state, inputs[:, 0])
        return state, output[:, None]
    state, outputs = jax.lax.scan(unit, state, jnp.moveaxis(inputs, 1, 0))
    return state, jnp.moveaxis(outputs, 0, 1)


def taps(x: Float[Array, "b t c"], size: int, dilation: int) -> Float[Array, "b m sc"]:
    """The `size` inputs, `dilation` apart, that an output of a causal convolution sees, the oldest
    first; the first (size − 1) · dilation inputs have no output."""
    count = x.shape[1] - (size - 1) * dilation
    parts = [x[:, i * dilation : i * dilation + count] for i in range(size)]
    return jnp.concatenate(parts, axis=-1)
