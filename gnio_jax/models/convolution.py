"""Convolutions of the networks that are fast on CPUs: the results are those of
`lax.conv_general_dilated`, to rounding.

Each `convolve...` takes the place of that function in `flax.linen.Conv` and has its arguments. On
CPUs XLA computes the gradients of strided, depthwise and grouped convolutions in a generic loop;
the gradients of products are products again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

LONG_BLOCK = 8
"""Outputs of a long kernel that are computed by one product. For a kernel of 32 samples, 5 to 10
outputs take the same time, and more take longer."""
WINOGRAD_CHANNELS = 64
"""Number of channels below which the products that Winograd's algorithm saves cost less than its
sums."""


def convolve(
    x: Float[Array, "b n c"],
    kernel: Float[Array, "k c d"],
    window_strides: tuple[int],
    padding: list[tuple[int, int]],
    **_: object,
) -> Float[Array, "b m d"]:
    """A 1-D convolution written as one matrix product of the k shifted inputs with the kernel."""
    size, channels, features = kernel.shape
    shifted = jnp.concatenate(_shift(x, size, window_strides[0], padding[0]), axis=-1)
    columns = shifted.reshape(-1, size * channels)
    product = columns @ kernel.reshape(size * channels, features)
    return product.reshape(-1, shifted.shape[1], features)


def convolve_long(
    x: Float[Array, "b n c"],
    kernel: Float[Array, "k c d"],
    window_strides: tuple[int],
    padding: list[tuple[int, int]],
    **_: object,
) -> Float[Array, "b m d"]:
    """A 1-D convolution of stride 1 with a long kernel, written as a product for each block of
    `LONG_BLOCK` outputs: the inputs that a block needs times the kernel at every place in it. It
    copies each input a few times, and `convolve` copies it once for every sample of the kernel. The
    padded input is at least as long as the kernel."""
    chex.assert_equal(tuple(window_strides), (1,))
    size, channels, features = kernel.shape
    x = jnp.pad(x, ((0, 0), padding[0], (0, 0)))
    outputs = x.shape[1] - size + 1
    blocks, inputs = -(-outputs // LONG_BLOCK), LONG_BLOCK + size - 1
    parts = -(-inputs // LONG_BLOCK)
    missing = (blocks + parts - 1) * LONG_BLOCK - x.shape[1]
    x = jnp.pad(x, ((0, 0), (0, missing), (0, 0)))
    x = x.reshape(x.shape[0], blocks + parts - 1, LONG_BLOCK * channels)
    columns = jnp.concatenate([x[:, i : i + blocks] for i in range(parts)], axis=-1)
    places = [jnp.pad(kernel, ((i, LONG_BLOCK - 1 - i), (0, 0), (0, 0))) for i in range(LONG_BLOCK)]
    matrix = jnp.stack(places, axis=2).reshape(inputs * channels, LONG_BLOCK * features)
    product = columns[..., : inputs * channels].reshape(-1, inputs * channels) @ matrix
    return product.reshape(-1, blocks * LONG_BLOCK, features)[:, :outputs]


def convolve_forward(
    x: Float[Array, "b n c"],
    kernel: Float[Array, "k c d"],
    window_strides: tuple[int],
    padding: list[tuple[int, int]],
    **_: object,
) -> Float[Array, "b m d"]:
    """The same convolution by XLA's own implementation, which takes half the time for a single
    window. Its derivatives, of any order and mode, are those of the product."""

    @jax.custom_jvp
    def native(x: Any, kernel: Any) -> Array:
        return jax.lax.conv_general_dilated(
            x, kernel, window_strides, padding, dimension_numbers=("NWC", "WIO", "NWC")
        )

    @native.defjvp
    def derivative(primals: tuple, tangents: tuple) -> tuple:
        return native(*primals), jax.jvp(
            lambda x, kernel: convolve(x, kernel, window_strides, padding), primals, tangents
        )[1]

    return native(x, kernel)


def convolve_depthwise(
    x: Float[Array, "b n c"],
    kernel: Float[Array, "k 1 c"],
    window_strides: tuple[int],
    padding: list[tuple[int, int]],
    **_: object,
) -> Float[Array, "b m c"]:
    """A convolution of every channel by itself, as a sum of k shifted products."""
    inputs = _shift(x, kernel.shape[0], window_strides[0], padding[0])
    terms = [part * kernel[None, i] for i, part in enumerate(inputs)]
    return sum(terms[1:], terms[0])


def convolve_groups(
    x: Float[Array, "b n c"],
    kernel: Float[Array, "k g d"],
    *_: object,
    feature_group_count: int = 1,
    **__: object,
) -> Float[Array, "b n d"]:
    """A convolution of groups of channels that keeps the length (stride 1, symmetric padding), as
    one product for each group."""
    size, channels, features = kernel.shape
    batch, samples, _channels = x.shape
    inputs = neighbours(x, size).reshape(batch, samples, size, feature_group_count, channels)
    kernel = kernel.reshape(size, channels, feature_group_count, features // feature_group_count)
    return jnp.einsum("bnkgc,kcgd->bngd", inputs, kernel).reshape(batch, samples, features)


def neighbours(x: Float[Array, "b n c"], span: int) -> Float[Array, "b n s c"]:
    """The `span` samples around every sample, with zeros beyond the ends."""
    return jnp.stack(_shift(x, span, 1, (span // 2, span // 2)), axis=2)


def _shift(
    x: Float[Array, "b n c"], size: int, stride: int, padding: tuple[int, int]
) -> list[Float[Array, "b m c"]]:
    """The inputs, padded by zeros, that each of the `size` samples of a kernel multiplies."""
    x = jnp.pad(x, ((0, 0), padding, (0, 0)))
    length = (x.shape[1] - size) // stride + 1
    return [x[:, i : i + stride * (length - 1) + 1 : stride] for i in range(size)]


def max_pool(x: Float[Array, "b n c"]) -> Float[Array, "b m c"]:
    """Maximum over 3 samples, stride 2, padded by one −∞ on both sides.

    Three shifted maxima instead of `lax.reduce_window`, whose gradient (a scatter) is slow on CPUs.
    """
    length = (x.shape[1] - 1) // 2 + 1
    x = jnp.pad(x, ((0, 0), (1, 2), (0, 0)), constant_values=-jnp.inf)
    return jnp.maximum(
        jnp.maximum(x[:, 0 : 2 * length : 2], x[:, 1 : 2 * length + 1 : 2]),
        x[:, 2 : 2 * length + 2 : 2],
    )


# Winograd's F(4, 3): a convolution of three samples with half the multiplications.
#
# Four outputs y of one channel are yᵀ = Aᵀ (G g ⊙ Bᵀ d), with the kernel g of three samples and the
# six inputs d that it covers: 6 multiplications where the definition has 12 (Winograd 1980; the
# matrices are those of Lavin and Gray 2016, §4.3). Over channels each of the six is a matrix
# product. The sums before and after lose at most a digit of float32: results differ from the
# definition by about 2e-6 of the largest of the six inputs. An input that is not finite makes all
# outputs that share a sum with it not finite.

TILE = 4
"""Number of outputs that are computed together."""
POINTS = 6
"""Number of products for them, and of inputs on which they depend."""

_INPUT = np.array(
    [
        [4, 0, -5, 0, 1, 0],
        [0, -4, -4, 1, 1, 0],
        [0, 4, -4, -1, 1, 0],
        [0, -2, -1, 2, 1, 0],
        [0, 2, -1, -2, 1, 0],
        [0, 4, 0, -5, 0, 1],
    ]
)
"""Bᵀ."""
_KERNEL = np.array([[6, 0, 0], [-4, -4, -4], [-4, 4, -4], [1, 2, 4], [1, -2, 4], [0, 0, 24]]) / 24
"""G."""
_OUTPUT = np.array(
    [[1, 1, 1, 1, 1, 0], [0, 1, -1, 2, -2, 0], [0, 1, 1, 4, 4, 0], [0, 1, -1, 8, -8, 1]]
)
"""Aᵀ."""


def winograd_pays() -> bool:
    """Whether a network should train by Winograd's algorithm on this machine: on a CPU, in one
    process.

    Other devices may round products to fewer digits (TF32), and Winograd's sums would enlarge this
    error. Processes that share a batch would exchange six matrices, but three for the product's
    gradient.
    """
    return jax.default_backend() == "cpu" and jax.process_count() == 1


def convolve_winograd(
    x: Float[Array, "b n c"],
    kernel: Float[Array, "k c d"],
    window_strides: tuple[int],
    padding: list[tuple[int, int]],
    **_: object,
) -> Float[Array, "b m d"]:
    """The same convolution as `convolve`, with half the multiplications where that is quicker: for
    three samples at stride 1 and many channels. For inputs of one or two samples most of a tile is
    padding."""
    fits = kernel.shape[0] == 3 and window_strides[0] == 1 and padding[0] == (1, 1)
    if fits and kernel.shape[1] >= WINOGRAD_CHANNELS and x.shape[1] > 2:
        return convolve_three(x, kernel)
    return convolve(x, kernel, window_strides, padding)


@jax.custom_vjp
def convolve_three(
    x: Float[Array, "b n c"], kernel: Float[Array, "3 c d"]
) -> Float[Array, "b n d"]:
    """The correlation of `x`, padded by a zero on both sides, with `kernel`, at every sample, in
    the type of `x`.

    It has a gradient, but no derivative in forward mode. The gradient is written out, because that
    of the strided slices below would be sums of six padded arrays.
    """
    return _three_forward(x, kernel)[0]


def _three_forward(x: Array, kernel: Array) -> tuple[Array, tuple]:
    batch, length, channels = x.shape
    tiles = -(-length // TILE)
    # Row t of `tiled` has the first four inputs of tile t; the other two are those of tile t + 1.
    trailing = TILE * (tiles + 1) - length - 1
    tiled = jnp.pad(x, ((0, 0), (1, trailing), (0, 0))).reshape(batch, tiles + 1, TILE, channels)
    rows = batch * tiles
    inputs = [tiled[:, :-1, j].reshape(rows, channels) for j in range(TILE)]
    inputs += [tiled[:, 1:, j].reshape(rows, channels) for j in range(POINTS - TILE)]
    inputs = [_combine(row, inputs) for row in _INPUT]
    kernels = [_combine(row, list(kernel)) for row in _KERNEL]
    products = [a @ b for a, b in zip(inputs, kernels, strict=True)]
    features = kernel.shape[-1]
    outputs = [_combine(row, products).reshape(batch, tiles, features) for row in _OUTPUT]
    output = jnp.stack(outputs, axis=2).reshape(batch, tiles * TILE, features)[:, :length]
    return output, (inputs, kernels)


def _three_backward(saved: tuple, cotangent: Array) -> tuple[Array, Array]:
    """Every step of `_three_forward` transposed, in reverse order."""
    inputs, kernels = saved
    batch, length, features = cotangent.shape
    tiles, channels = -(-length // TILE), inputs[0].shape[-1]
    padded = jnp.pad(cotangent, ((0, 0), (0, TILE * tiles - length), (0, 0)))
    tiled = padded.reshape(batch, tiles, TILE, features)
    outputs = [tiled[:, :, j].reshape(batch * tiles, features) for j in range(TILE)]
    products = [_combine(column, outputs) for column in _OUTPUT.T]
    to_kernels = [a.T @ product for a, product in zip(inputs, products, strict=True)]
    to_kernel = jnp.stack([_combine(column, to_kernels) for column in _KERNEL.T])
    to_inputs = [product @ b.T for product, b in zip(products, kernels, strict=True)]
    parts = [_combine(column, to_inputs) for column in _INPUT.T]
    parts = [part.reshape(batch, tiles, channels) for part in parts]
    ends = [jnp.pad(part, ((0, 0), (0, 1), (0, 0))) for part in parts[:TILE]]
    for j, part in enumerate(parts[TILE:]):
        ends[j] += jnp.pad(part, ((0, 0), (1, 0), (0, 0)))
    whole = jnp.stack(ends, axis=2).reshape(batch, TILE * (tiles + 1), channels)
    return whole[:, 1 : length + 1], to_kernel


convolve_three.defvjp(_three_forward, _three_backward)


def _combine(factors: Sequence[float] | np.ndarray, parts: Sequence[Array]) -> Array:
    """The sum of the parts, each times its factor."""
    terms = [
        part if factor == 1 else part.dtype.type(factor) * part
        for factor, part in zip(factors, parts, strict=True)
        if factor != 0
    ]
    return sum(terms[1:], terms[0])
