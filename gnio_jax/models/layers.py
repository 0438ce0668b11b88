"""Layers that several networks share, in float32 and with PyTorch's constants."""

from __future__ import annotations

import math
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from gnio_jax.models.convolution import convolve, convolve_forward, convolve_winograd

MOMENTUM = 0.9
"""Share of batch normalisation's running statistics that a training step keeps (PyTorch's momentum
0.1 is its complement)."""
EPSILON = 1e-5
"""Added to the variance in batch and layer normalisation."""

MOST_GROUPS = 32
"""Groups of channels in group normalisation; of fewer channels, the largest number that divides
both."""
Normalisation = Literal["batch", "group"]

FLOAT32: dict[str, Any] = {"dtype": jnp.float32, "param_dtype": jnp.float32}
he_normal_fan_out = nn.initializers.variance_scaling(2.0, "fan_out", "normal")


CONTENTS = {
    6: "this network sees samples alone, as window_rotation 'per_sample' gives them",
    12: "this network sees the axes of the body too, as window_rotation 'body_axes' gives them",
}
"""What the channels of a window are, by their number."""


def check_windows(windows: Array, channels: int = 6) -> None:
    """Raise `ValueError` for another shape than (b, n, c), which would otherwise fail deep inside a
    convolution."""
    if windows.ndim != 3 or windows.shape[2] != channels:
        problem = f"must be (b, n, {channels}), found {windows.shape}"
        remedy = f": {CONTENTS[channels]}" if channels in CONTENTS else ""
        raise ValueError(f"windows: {problem}{remedy}")


def checked_windows(windows: Array, channels: int = 6) -> Float[Array, "b n c"]:
    """The windows in float32. Raises `ValueError` as `check_windows` does."""
    check_windows(windows, channels)
    return windows.astype(jnp.float32)


def linear(features: int, name: str, **options: Any) -> nn.Dense:
    """A linear layer."""
    return nn.Dense(features, name=name, **FLOAT32, **options)


def conv_norm(
    x: Float[Array, "b n c"],
    features: int,
    size: int,
    stride: int,
    train: bool,
    name: str,
    normalisation: Normalisation = "batch",
    **options: Any,
) -> Float[Array, "b m d"]:
    """A convolution, called `name`, and its normalisation. Call it within a module.

    The name of a batch normalisation has "bn" in the place of "conv", by which `models.inference`
    finds them. That of a group normalisation has "norm": it has no statistics and is not folded.
    """
    x = conv(features, size, stride, train, name, **options)(x)
    if normalisation == "group":
        return nn.GroupNorm(
            num_groups=math.gcd(MOST_GROUPS, features),
            epsilon=EPSILON,
            use_fast_variance=False,  # a difference of squares loses digits
            name=name.replace("conv", "norm"),
            **FLOAT32,
        )(x)
    norm = nn.BatchNorm(
        use_running_average=not train,
        momentum=MOMENTUM,
        epsilon=EPSILON,
        name=name.replace("conv", "bn"),
        **FLOAT32,
    )
    return norm(x)


def conv(features: int, size: int, stride: int, train: bool, name: str, **options: Any) -> nn.Conv:
    """A convolution without bias and with explicit symmetric padding ("SAME" pads differently at
    stride 2). `options`: those of `nn.Conv`, and `winograd`, whether it trains by Winograd's
    algorithm where that is quicker."""
    in_training = convolve_winograd if options.pop("winograd", False) else convolve
    options.setdefault("kernel_init", he_normal_fan_out)
    options.setdefault("conv_general_dilated", in_training if train else convolve_forward)
    options |= {"use_bias": False, "name": name} | FLOAT32
    return nn.Conv(features, (size,), (stride,), [((size - 1) // 2, (size - 1) // 2)], **options)


def unpadded_conv(features: int, size: int, stride: int, train: bool, name: str) -> nn.Conv:
    """A convolution with bias and without padding."""
    in_training = convolve if train else convolve_forward
    options = {"conv_general_dilated": in_training, "name": name} | FLOAT32
    return nn.Conv(features, (size,), (stride,), [(0, 0)], **options)


def fourier_waves(length: int) -> tuple[Float[np.ndarray, "n f"], Float[np.ndarray, "n f"]]:
    """Cosines and sines of the frequencies of `length` real numbers: x @ cosines and −x @ sines are
    the real and the imaginary part of their spectrum. (The export cannot write JAX's transform.)"""
    turns = np.outer(np.arange(length), np.arange(length // 2 + 1)) % length / length
    angle = 2 * np.pi * turns
    return np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)


def layer_norm(name: str) -> nn.LayerNorm:
    """Layer normalisation."""
    return nn.LayerNorm(epsilon=EPSILON, name=name, **FLOAT32)


def repeat_ends(x: Float[Array, "*b"], before: int, after: int, axis: int) -> Float[Array, "*d"]:
    """`x` with its first entry along the axis `before` times more, and its last one `after` times.
    (The export loses the shapes of `jnp.pad` with "edge".)"""
    parts = [x]
    for count, index in ((before, 0), (after, -1)):
        if count:
            end = jax.lax.index_in_dim(x, index, axis)
            shape = list(x.shape)
            shape[axis] = count
            repeated = jnp.broadcast_to(end, shape)
            parts = [repeated, *parts] if index == 0 else [*parts, repeated]
    return jnp.concatenate(parts, axis=axis)


def attend(
    query: Float[Array, "b n h d"],
    key: Float[Array, "b m h d"],
    value: Float[Array, "b m h d"],
    mask: Bool[Array, "1 1 n m"] | None = None,
    **_: object,
) -> Float[Array, "b n h d"]:
    """Scaled dot-product attention in the place of Flax's, with fewer passes over the scores, which
    cost more than the products if a head has few features.

    The division by the softmax's sum comes after the product with the values, and heads are part of
    the batch axis.
    """
    batch, samples, heads, size = query.shape
    query, key, value = (
        x.swapaxes(1, 2).reshape(batch * heads, -1, size) for x in (query, key, value)
    )
    scores = jnp.einsum("bnd,bmd->bnm", query / jnp.sqrt(jnp.float32(size)), key)
    if mask is not None:
        scores = jnp.where(mask[0], scores, -jnp.inf)
    weights = jnp.exp(scores - jax.lax.stop_gradient(scores.max(axis=-1, keepdims=True)))
    context = jnp.einsum("bnm,bmd->bnd", weights, value) / weights.sum(axis=-1, keepdims=True)
    return context.reshape(batch, heads, samples, size).swapaxes(1, 2)


def attention(
    heads: int, name: str, features: int | None = None
) -> nn.MultiHeadDotProductAttention:
    """Multi-head attention by `attend`. Its inner width is that of the query. It has `features`
    outputs, by default as many as the query."""
    return nn.MultiHeadDotProductAttention(
        heads, out_features=features, attention_fn=attend, name=name, **FLOAT32
    )
