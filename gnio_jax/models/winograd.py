"""A convolution of three samples with half the multiplications: Winograd's F(4, 3).

Four outputs y of one channel are yᵀ = Aᵀ (G g ⊙ Bᵀ d), with the kernel g of three samples and the
six inputs d that it meets: 6 multiplications where the definition has 12 (Winograd 1980; the
matrices are those of Lavin and Gray 2016, §4.3). Over channels each of the six is a matrix product.
The sums before and after cost a digit of float32 at most: results differ from the definition by
some 2e-6 of the largest among the six inputs. What is not finite makes all outputs that share a sum
with it not finite.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

TILE = 4
"""Outputs that are computed together."""
POINTS = 6
"""Products for them, and inputs that they depend on."""

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


@jax.custom_vjp
def convolve_three(
    x: Float[jax.Array, "b n c"], kernel: Float[jax.Array, "3 c d"]
) -> Float[jax.Array, "b n d"]:
    """The correlation of `x`, padded by a zero on both sides, with `kernel`, at every sample, in
    the type of `x`.

    It has a gradient, and no derivative in forward mode. The gradient is written out: that of the
    strided slices below would be sums of six padded arrays.
    """
    return _forward(x, kernel)[0]


def _forward(x: jax.Array, kernel: jax.Array) -> tuple[jax.Array, tuple]:
    batch, length, channels = x.shape
    tiles = -(-length // TILE)
    # Row t of `tiled` has the first four inputs of tile t; the other two are those of tile t + 1.
    after = TILE * (tiles + 1) - length - 1
    tiled = jnp.pad(x, ((0, 0), (1, after), (0, 0))).reshape(batch, tiles + 1, TILE, channels)
    rows = batch * tiles
    inputs = [tiled[:, :-1, j].reshape(rows, channels) for j in range(TILE)]
    inputs += [tiled[:, 1:, j].reshape(rows, channels) for j in range(POINTS - TILE)]
    inputs = [_combined(row, inputs) for row in _INPUT]
    kernels = [_combined(row, list(kernel)) for row in _KERNEL]
    products = [a @ b for a, b in zip(inputs, kernels, strict=True)]
    features = kernel.shape[-1]
    outputs = [_combined(row, products).reshape(batch, tiles, features) for row in _OUTPUT]
    found = jnp.stack(outputs, axis=2).reshape(batch, tiles * TILE, features)[:, :length]
    return found, (inputs, kernels)


def _backward(saved: tuple, cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Every step of `_forward` transposed, in reverse order."""
    inputs, kernels = saved
    batch, length, features = cotangent.shape
    tiles, channels = -(-length // TILE), inputs[0].shape[-1]
    padded = jnp.pad(cotangent, ((0, 0), (0, TILE * tiles - length), (0, 0)))
    tiled = padded.reshape(batch, tiles, TILE, features)
    outputs = [tiled[:, :, j].reshape(batch * tiles, features) for j in range(TILE)]
    products = [_combined(column, outputs) for column in _OUTPUT.T]
    to_kernels = [a.T @ product for a, product in zip(inputs, products, strict=True)]
    to_kernel = jnp.stack([_combined(column, to_kernels) for column in _KERNEL.T])
    to_inputs = [product @ b.T for product, b in zip(products, kernels, strict=True)]
    parts = [_combined(column, to_inputs) for column in _INPUT.T]
    parts = [part.reshape(batch, tiles, channels) for part in parts]
    ends = [jnp.pad(part, ((0, 0), (0, 1), (0, 0))) for part in parts[:TILE]]
    for j, part in enumerate(parts[TILE:]):
        ends[j] += jnp.pad(part, ((0, 0), (1, 0), (0, 0)))
    whole = jnp.stack(ends, axis=2).reshape(batch, TILE * (tiles + 1), channels)
    return whole[:, 1 : length + 1], to_kernel


convolve_three.defvjp(_forward, _backward)


def _combined(factors: Sequence[float] | np.ndarray, parts: Sequence[jax.Array]) -> jax.Array:
    """The sum of the parts, each times its factor."""
    terms = [
        part if factor == 1 else part.dtype.type(factor) * part
        for factor, part in zip(factors, parts, strict=True)
        if factor != 0
    ]
    return sum(terms[1:], terms[0])
