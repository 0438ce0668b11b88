"""The parts of which networks with memory are made. Each continues from what it remembers, so that
a signal may be cut anywhere, with the same results to rounding."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.models.convolution import convolve, convolve_forward
from gnio_jax.models.layers import FLOAT32


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
    conv = nn.Conv(
        features,
        (size,),
        (stride,),
        [(0, 0)],
        conv_general_dilated=convolve if train else convolve_forward,
        name=name,
        **FLOAT32,
    )
    return x[:, x.shape[1] - past.shape[1] :], conv(x)


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
