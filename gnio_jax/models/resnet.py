"""The encoder: a 1-D ResNet-18 over a window of IMU samples (paper §III-B; the shape TLIO and RoNIN
share)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Float

from gnio_jax.models.precision import Dtype, matmul
from gnio_jax.models.winograd import convolve_three

BLOCKS_PER_GROUP = 2
GROUP_STRIDES = (1, 2, 2, 2)

MOMENTUM = 0.9
"""Share of batch normalisation's running statistics that a training step keeps (PyTorch's momentum
0.1 is its complement)."""

WINOGRAD_CHANNELS = 64
"""From so many channels on the products that Winograd's algorithm saves cost more than its sums."""

he_normal_fan_out = nn.initializers.variance_scaling(2.0, "fan_out", "normal")


def convolve(
    x: Float[jax.Array, "b n c"],
    kernel: Float[jax.Array, "k c d"],
    window_strides: tuple[int],
    padding: list[tuple[int, int]],
    *,
    dtype: Dtype = "float32",
    **_: object,
) -> Float[jax.Array, "b m d"]:
    """A 1-D convolution written as one matrix product of the k shifted inputs with the kernel.

    Same numbers as `lax.conv_general_dilated`, whose place in `flax.linen.Conv` it takes: on CPUs
    XLA runs the gradients of strided convolutions through a generic loop, while both gradients of a
    product are products again.
    """
    size, channels, features = kernel.shape
    stride, (before, after) = window_strides[0], padding[0]
    x = jnp.pad(x, ((0, 0), (before, after), (0, 0)))
    length = (x.shape[1] - size) // stride + 1
    shifted = [x[:, i : i + stride * (length - 1) + 1 : stride] for i in range(size)]
    columns = jnp.concatenate(shifted, axis=-1).reshape(-1, size * channels)
    product = matmul(columns, kernel.reshape(size * channels, features), dtype)
    return product.reshape(-1, length, features)


def convolve_training(
    x: Float[jax.Array, "b n c"],
    kernel: Float[jax.Array, "k c d"],
    window_strides: tuple[int],
    padding: list[tuple[int, int]],
    **_: object,
) -> Float[jax.Array, "b m d"]:
    """The same convolution where a CPU trains in float32: with half the multiplications where that
    is quicker.

    Elsewhere products may be rounded to fewer digits (TF32), which Winograd's sums would magnify.
    Of one or two samples most of a tile is padding. Processes that share a batch would send six
    matrices to each other where the product's gradient has three.
    """
    wide = kernel.shape[1] >= WINOGRAD_CHANNELS and x.shape[1] > 2 and jax.process_count() == 1
    if wide and kernel.shape[0] == 3 and window_strides[0] == 1 and padding[0] == (1, 1):
        return convolve_three(x, kernel)
    return convolve(x, kernel, window_strides, padding)


def convolve_forward(
    x: Float[jax.Array, "b n c"],
    kernel: Float[jax.Array, "k c d"],
    window_strides: tuple[int],
    padding: list[tuple[int, int]],
    **_: object,
) -> Float[jax.Array, "b m d"]:
    """The same convolution where nothing is trained: XLA's own, which takes half the time for a
    single window.

    Its derivatives, where somebody wants them, are those of the product.
    """

    @jax.custom_jvp
    def native(x: Any, kernel: Any) -> jax.Array:
        return jax.lax.conv_general_dilated(
            x, kernel, window_strides, padding, dimension_numbers=("NWC", "WIO", "NWC")
        )

    @native.defjvp
    def derivative(primals: tuple, tangents: tuple) -> tuple:
        return native(*primals), jax.jvp(
            lambda x, kernel: convolve(x, kernel, window_strides, padding), primals, tangents
        )[1]

    return native(x, kernel)


def max_pool(x: Float[jax.Array, "b n c"]) -> Float[jax.Array, "b m c"]:
    """Maximum over 3 samples, stride 2, padded by one −∞ on both sides.

    Three shifted maxima instead of `lax.reduce_window`, whose gradient (a scatter) is slow on CPUs.
    """
    length = (x.shape[1] - 1) // 2 + 1
    x = jnp.pad(x, ((0, 0), (1, 2), (0, 0)), constant_values=-jnp.inf)
    return jnp.maximum(
        jnp.maximum(x[:, 0 : 2 * length : 2], x[:, 1 : 2 * length + 1 : 2]),
        x[:, 2 : 2 * length + 2 : 2],
    )


def conv(features: int, size: int, stride: int, train: bool, name: str, dtype: Dtype) -> nn.Conv:
    """A convolution without bias and with explicit symmetric padding ("SAME" pads differently at
    stride 2); `dtype` is that of its product's factors."""
    if dtype != "float32":
        convolution = partial(convolve, dtype=dtype)
    elif not train:
        convolution = convolve_forward
    else:
        convolution = convolve_training if jax.default_backend() == "cpu" else convolve
    return nn.Conv(
        features,
        kernel_size=(size,),
        strides=(stride,),
        padding=[((size - 1) // 2, (size - 1) // 2)],
        use_bias=False,
        kernel_init=he_normal_fan_out,
        dtype=jnp.float32,
        param_dtype=jnp.float32,
        conv_general_dilated=convolution,
        name=name,
    )


def batch_norm(train: bool, name: str) -> nn.BatchNorm:
    """Batch normalisation with PyTorch's constants."""
    return nn.BatchNorm(
        use_running_average=not train,
        momentum=MOMENTUM,
        epsilon=1e-5,
        dtype=jnp.float32,
        param_dtype=jnp.float32,
        name=name,
    )


class BasicBlock(nn.Module):
    """Two 3-sample convolutions and a shortcut, projected by a 1×1 convolution where the shape
    changes."""

    features: int
    stride: int
    dtype: Dtype = "float32"

    @nn.compact
    def __call__(self, x: Float[jax.Array, "b n c"], train: bool) -> Float[jax.Array, "b m d"]:
        y = conv(self.features, 3, self.stride, train, "conv1", self.dtype)(x)
        y = nn.relu(batch_norm(train, "bn1")(y))
        y = conv(self.features, 3, 1, train, "conv2", self.dtype)(y)
        y = batch_norm(train, "bn2")(y)
        if self.stride != 1 or x.shape[-1] != self.features:
            x = conv(self.features, 1, self.stride, train, "shortcut_conv", self.dtype)(x)
            x = batch_norm(train, "shortcut_bn")(x)
        return nn.relu(x + y)


class ResNet18(nn.Module):
    """Windows (b, n, 6) to feature maps (b, ⌈n/32⌉, 8·width): stem, max-pool, four groups of two
    basic blocks."""

    width: int = 64
    dtype: Dtype = "float32"

    @nn.compact
    def __call__(
        self, windows: Float[jax.Array, "b n 6"], train: bool = False
    ) -> Float[jax.Array, "b m d"]:
        x = conv(self.width, 7, 2, train, "stem_conv", self.dtype)(windows)
        x = max_pool(nn.relu(batch_norm(train, "stem_bn")(x)))
        return residual_groups(partial(BasicBlock, dtype=self.dtype), self.width, x, train)


def residual_groups(
    block: Callable[..., nn.Module], width: int, x: Float[jax.Array, "b n c"], train: bool
) -> Float[jax.Array, "b m d"]:
    """Four groups of two blocks. Each group has twice the features of the one before it, and all
    but the first halve the length. To be called from within a module."""
    for group, stride in enumerate(GROUP_STRIDES):
        for number in range(BLOCKS_PER_GROUP):
            name = f"group{group + 1}_block{number + 1}"
            x = block(width * 2**group, stride if number == 0 else 1, name=name)(x, train)
    return x
