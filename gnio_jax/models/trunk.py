"""One trunk with four kinds of block, for ideas that were published without their sizes: the star
product with two attentions, the re-parameterised block, the transform along the channels, and
shrinkage of wavelet coefficients that a classifier chooses.

The sizes are ours, so none of these is the published network (docs/networks_named.md says what is
missing to rebuild those), and none has its name.
"""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count, Positive
from gnio_jax.models.bins import BinHead
from gnio_jax.models.convolution import convolve_depthwise
from gnio_jax.models.deepils import ChannelAttention, TimeAttention
from gnio_jax.models.heads import ConstantUncertainty, GatedHead, LinearHead, UncertaintyHead
from gnio_jax.models.layers import checked_windows, conv, conv_norm, fourier_waves, linear
from gnio_jax.types import GRAVITY, Prediction

STAGES, BLOCKS = 3, 2
"""Stages, each of twice the channels and half the length of the one before it, and their blocks."""
LEVELS = 3
"""Scales of the wavelets."""


class Trunk(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement and uncertainty: a stem of
    stride 2, three stages of two blocks, the mean over time, GNIO's heads or that of bins.

    block:
        "star": σ(A x) ⊙ B x, and a channel and a time attention side by side.
        "rep": convolutions of three samples and of one, and a shortcut, which inference folds into
            one convolution.
        "fourier": a trainable filter of the spectrum along the channels.
        "wavelet": convolutions of three samples; the window is denoised before.
    reach: range of the bins, m. `width`: channels of the first stage.
    """

    width: Count = 64
    block: Literal["star", "rep", "fourier", "wavelet"] = "star"
    head: Literal["gated", "linear", "bins"] = "linear"
    uncertainty: Literal["head", "constant"] = "head"
    reach: Positive = 3.0

    @nn.compact
    def __call__(
        self, windows: Float[Array, "b n 6"], train: bool = False, folded: Any = None
    ) -> Prediction:
        x, diagnostics = checked_windows(windows), {}
        x = x - jnp.array([0, 0, GRAVITY, 0, 0, 0], jnp.float32)[None, None]
        if self.block == "wavelet":
            x, diagnostics["basis"] = Shrinkage(name="shrinkage")(x)
        x = nn.relu(conv_norm(x, self.width, 7, 2, train, "stem_conv"))
        for stage in range(STAGES):
            if stage:
                features = self.width * 2**stage
                x = nn.relu(conv_norm(x, features, 3, 2, train, f"down{stage}_conv"))
            for number in range(BLOCKS):
                name = f"stage{stage + 1}_block{number + 1}"
                match self.block:
                    case "star":
                        x = StarBlock(name=name)(x, train)
                    case "rep":
                        x = RepBlock(name=name)(x, train, folded and folded[name])
                    case "fourier":
                        x = FourierBlock(name=name)(x, train)
                    case _:
                        y = nn.relu(conv_norm(x, x.shape[-1], 3, 1, train, f"{name}_conv"))
                        x = x + y
        h = x.mean(axis=1)
        heads = {"gated": GatedHead, "linear": LinearHead}
        head = BinHead(reach=self.reach, name="head") if self.head == "bins" else None
        displacement, of_head = (head or heads[self.head](name="head"))(h)
        if "log_std" in of_head:
            return Prediction(displacement, of_head.pop("log_std"), diagnostics | of_head)
        kinds = {"head": UncertaintyHead, "constant": ConstantUncertainty}
        log_std = kinds[self.uncertainty](name="uncertainty")(h, train)
        return Prediction(displacement, log_std, diagnostics | of_head)

    @nn.nowrap
    def constants(self, variables: Any) -> dict[str, Any]:
        """Arguments of `apply` that depend on the variables alone: the blocks "rep", each folded
        into one convolution."""
        if self.block != "rep":
            return {}
        names = [name for name in variables["params"] if name.startswith("stage")]
        parts = (variables["params"], variables["batch_stats"])
        return {"folded": {name: fold(*(part[name] for part in parts)) for name in names}}


class StarBlock(nn.Module):
    """x + D(σ(A u) ⊙ B u) of u, a depthwise convolution of x, then the mean of both attentions.

    σ is ReLU6, as in the block of "Rewrite the Stars" (Ma et al., CVPR 2024). Without this bound
    every block squares what a window exceeds the usual by, and the output overflows."""

    @nn.compact
    def __call__(self, x: Float[Array, "b n c"], train: bool) -> Float[Array, "b n c"]:
        channels = x.shape[-1]
        u = conv(
            channels,
            7,
            1,
            train,
            "depthwise",
            feature_group_count=channels,
            conv_general_dilated=convolve_depthwise,
            kernel_init=nn.initializers.variance_scaling(2.0, "fan_in", "normal"),
        )(x)
        first, second = (linear(2 * channels, name)(u) for name in ("first", "second"))
        y = conv_norm(nn.relu6(first) * second, channels, 1, 1, train, "conv")
        wings = ChannelAttention(name="channels")(y), TimeAttention(name="time")(y, train)
        return x + 0.5 * (wings[0] + wings[1])


class RepBlock(nn.Module):
    """ReLU of the sum of a convolution of three samples, one of one sample, each with
    normalisation, and x; `folded`: kernel and bias of the one convolution that gives the same."""

    @nn.compact
    def __call__(
        self, x: Float[Array, "b n c"], train: bool, folded: Any = None
    ) -> Float[Array, "b n c"]:
        channels = x.shape[-1]
        if folded is not None:
            wide = jnp.pad(x, ((0, 0), (1, 1), (0, 0)))
            taps = (wide[:, i : i + x.shape[1]] @ folded["kernel"][i] for i in range(3))
            return nn.relu(sum(taps) + folded["bias"][None, None])
        wide = conv_norm(x, channels, 3, 1, train, "conv3")
        return nn.relu(wide + conv_norm(x, channels, 1, 1, train, "conv1") + x)


def fold(params: Any, statistics: Any) -> dict[str, Array]:
    """A block "rep" as one convolution. Its normalisations are already folded into shifts, or are
    taken with their statistics."""
    kernel, bias = jnp.zeros(()), jnp.zeros(())
    for size in (3, 1):
        norm, moments = params[f"bn{size}"], statistics[f"bn{size}"]
        factor = norm["scale"] / jnp.sqrt(moments["var"] + 1e-5)
        part = params[f"conv{size}"]["kernel"] * factor[None, None]
        kernel = kernel + (part if size == 3 else jnp.pad(part, ((1, 1), (0, 0), (0, 0))))
        bias = bias + norm["bias"] - factor * moments["mean"]
    channels = kernel.shape[1]
    return {"kernel": kernel.at[1].add(jnp.eye(channels, dtype=kernel.dtype)), "bias": bias}


class FourierBlock(nn.Module):
    """x + ReLU(norm(W y)), where y is x with its spectrum along the channels filtered."""

    @nn.compact
    def __call__(self, x: Float[Array, "b n c"], train: bool) -> Float[Array, "b n c"]:
        channels = x.shape[-1]
        cosines, sines = fourier_waves(channels)
        lines = cosines.shape[1]
        gain = self.param("gain", nn.initializers.normal(1.0), (lines,), jnp.float32)[None, None]
        phase = self.param("quadrature", nn.initializers.normal(1.0), (lines,), jnp.float32)
        phase = phase[None, None]
        real, imaginary = x @ cosines, -(x @ sines)
        # A line stands for its conjugate too, except the first, and the last of an even number.
        weight = np.where(2 * np.arange(lines) % channels, 2, 1).astype(np.float32) / channels
        cosines, sines = (weight[:, None] * waves.T for waves in (cosines, sines))
        y = (real * gain - imaginary * phase) @ cosines - (real * phase + imaginary * gain) @ sines
        return x + nn.relu(conv_norm(y, channels, 3, 1, train, "conv"))


class Shrinkage(nn.Module):
    """Soft thresholds of the wavelet coefficients of each channel, in three bases (Daubechies 1, 2
    and 3, undecimated, periodic); a classifier of the window weights the bases.

    Returns the denoised window, and the weights (b, 3).
    """

    @nn.compact
    def __call__(
        self, x: Float[Array, "b n c"]
    ) -> tuple[Float[Array, "b n c"], Float[Array, "b 3"]]:
        mean = x.mean(axis=1)
        level = jnp.log(jnp.mean((x - mean[:, None]) ** 2, axis=1) + 1e-4)
        rough = jnp.log(jnp.mean(jnp.diff(x, axis=1) ** 2, axis=1) + 1e-4)
        hidden = nn.relu(linear(16, "hidden")(jnp.concatenate([mean, level, rough], axis=-1)))
        shares = nn.softmax(linear(len(WAVELETS), "basis")(hidden), axis=-1)
        start = nn.initializers.constant(-3.0)
        shape = (len(WAVELETS), LEVELS, x.shape[-1])
        thresholds = nn.softplus(self.param("thresholds", start, shape, jnp.float32))
        denoised = [_shrink(x, w, t) for w, t in zip(WAVELETS, thresholds, strict=True)]
        return jnp.einsum("bk,kbnc->bnc", shares, jnp.stack(denoised)), shares


_ROOT = np.sqrt(np.array([3.0, 10.0]))
_OUTER = np.sqrt(5 + 2 * _ROOT[1])
_DAUBECHIES_3 = np.array(
    [
        1 + _ROOT[1] + _OUTER,
        5 + _ROOT[1] + 3 * _OUTER,
        10 - 2 * _ROOT[1] + 2 * _OUTER,
        10 - 2 * _ROOT[1] - 2 * _OUTER,
        5 + _ROOT[1] - 3 * _OUTER,
        1 + _ROOT[1] - _OUTER,
    ]
)
WAVELETS = (
    np.array([1.0, 1.0]) / 2,
    np.array([1 + _ROOT[0], 3 + _ROOT[0], 3 - _ROOT[0], 1 - _ROOT[0]]) / 8,
    _DAUBECHIES_3 / 32,
)
"""Low-pass filters of sum 1 (Daubechies 1992, table 6.1)."""


def _shrink(
    x: Float[Array, "b n c"], low: np.ndarray, thresholds: Float[Array, "l c"]
) -> Float[Array, "b n c"]:
    """The signal from its coefficients after the thresholds, level by level, finest first."""
    high = low[::-1] * (-1.0) ** np.arange(len(low))
    details, approximation = [], x
    for level in range(LEVELS):
        detail = _filter(approximation, high, 2**level)
        size = jnp.maximum(jnp.abs(detail) - thresholds[level][None, None], 0)
        details.append(jnp.sign(detail) * size)
        approximation = _filter(approximation, low, 2**level)
    for level in reversed(range(LEVELS)):
        parts = (approximation, low), (details[level], high)
        approximation = sum((_filter(y, taps, -(2**level)) for y, taps in parts), jnp.zeros_like(x))
    return approximation


def _filter(x: Float[Array, "b n c"], taps: np.ndarray, spacing: int) -> Float[Array, "b n c"]:
    """Σ h_k x[t + k · spacing], periodic."""
    terms = [jnp.float32(h) * jnp.roll(x, -k * spacing, axis=1) for k, h in enumerate(taps)]
    return jax.tree.reduce(jnp.add, terms)
