"""EqNIO's frames (Jayanth et al., "EqNIO: Subequivariant Neural Inertial Odometry", ICLR 2025): a
network that is equivariant to turns about the vertical, or to these and to reflections, finds a
frame in the window, and any network sees the window in this frame.

Under a reflection M of the plane an acceleration becomes M a, and an angular rate, which is a
pseudovector, −M ω. The network with reflections therefore sees two ordinary vectors in the place of
the rate: with w̃ = (−ω_y, ω_x, 0), v1 is along ω × w̃ and v2 along ω × v1, both as long as ω.

The layers compute in the type of their input, so that equivariance can be tested in float64. Layers
and normalisations have no biases. The order of v1 and v2 differs between paper and public code; the
code's is followed, so its weights fit (`gnio_jax.interop`). Ours: the gradient at vectors of length
0 is 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count
from gnio_jax.geometry import direction
from gnio_jax.models.convolution import convolve_forward, convolve_long
from gnio_jax.models.equivariance import (
    Equivariant,
    length,
    opposite,
    quarter_turn,
    reflect_prediction,
    turn_prediction,
    turn_windows,
)
from gnio_jax.models.layers import EPSILON, check_windows, repeat_ends
from gnio_jax.types import Prediction

SPAN = 32
"""Samples of the convolutions in time."""
REFLECTED = np.array([1, -1, 1, -1, 1, -1], np.float32)
"""Signs of [accel, gyro] under the reflection of y."""


class Signals(NamedTuple):
    """Horizontal vectors and invariant scalars, a row for each sample."""

    vectors: Float[Array, "b n 2 c"]
    scalars: Float[Array, "b n d"]


class Frame(NamedTuple):
    """Heading (cos, sin) of the frame's x axis, and the sign of its y axis: 1, or −1 for a
    left-handed frame."""

    heading: Float[Array, "b 2"]
    sign: Float[Array, "b"]


class EqNIO(Equivariant):
    """The network sees the window in the frame, and its displacement is turned back. `reflections`
    says whether the frame is that of O(2), in which windows may be reflected, or of SO(2).

    Its variances are along the axes of the frame, so the covariance is full in the plane. `depth`:
    convolutions in time; `frame_width`: vectors, and scalars, in a layer. Published: 64 of them for
    O(2) of depth 2 (595,584 parameters of the frame's network), 128 for SO(2) of depth 2
    (3,460,224) and of depth 1 (1,821,312).
    """

    reflections: bool = True
    depth: int = 2
    frame_width: Count = 64

    def setup(self) -> None:
        super().setup()
        self.frame = EquivariantFrame(self.frame_width, self.depth, self.reflections)

    def __call__(
        self, windows: Float[Array, "b n 6"], train: bool = False, **constants: Any
    ) -> Prediction:
        check_windows(windows)
        heading, sign = self.frame(windows, train)
        turned = turn_windows(windows, opposite(heading))
        reflected = jnp.asarray(np.asarray(REFLECTED)[None], windows.dtype)
        signs = jnp.where(sign[:, None] < 0, reflected, 1)
        if not self.reflections:  # the rate is turned as an ordinary vector
            signs = signs.at[:, 3:].set(signs[:, :3])
        prediction = self.network(turned * signs[:, None], train, **constants)
        return turn_prediction(reflect_prediction(prediction, sign), heading)


class EquivariantFrame(nn.Module):
    """The frame of a window by Gram and Schmidt from two vectors that turn, and for O(2) are
    reflected, with the window.

    If the first vector is 0, as in a window without horizontal vectors, the heading is (1, 0),
    without gradient. The second one only decides the sign, so it never has a gradient.
    """

    width: int
    depth: int
    reflections: bool

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 6"], train: bool = False) -> Frame:
        width, turns = self.width, not self.reflections
        signals = with_reflections(windows) if self.reflections else without_reflections(windows)
        vectors = mix(signals.vectors, width, turns, "vectors")
        scalars = _dense(width, "scalars")(signals.scalars)
        x = Gate(width, name="gate")(Signals(vectors, scalars))
        for number in range(self.depth):
            x = TimeMixing(width, turns, name=f"block{number + 1}")(x, train)
        mean = Signals(*(part.mean(axis=1, keepdims=True) for part in x))
        vectors = mix(mean.vectors, width, turns, "mean_vectors")
        scalars = _dense(width, "mean_scalars")(mean.scalars)
        x = Gate(width, False, name="mean_gate")(Signals(vectors, scalars))
        vectors = norm_vectors(mix(x.vectors, width, turns, "last_vectors"), "last_norm")
        first, second = jnp.moveaxis(mix(vectors, 2, turns, "frame")[:, 0], -1, 0)
        heading = jnp.stack(direction(first[:, 0], first[:, 1]), axis=-1)
        across = jnp.sum(quarter_turn(heading) * second, axis=-1)
        return Frame(heading, jnp.where(across < 0, -jnp.ones_like(across), 1))


class TimeMixing(nn.Module):
    """A convolution of 32 samples for vectors and one for scalars, the gate, and both
    normalisations."""

    width: int
    turns: bool

    @nn.compact
    def __call__(self, x: Signals, train: bool) -> Signals:
        batch, samples = x.vectors.shape[:2]
        vectors = with_turns(x.vectors) if self.turns else x.vectors
        planar = vectors.swapaxes(1, 2).reshape(2 * batch, samples, -1)
        planar = _conv(self.width, train, "vector_filter")(planar)
        vectors = planar.reshape(batch, 2, samples, self.width).swapaxes(1, 2)
        scalars = _conv(self.width, train, "scalar_filter")(x.scalars)
        x = Gate(self.width, name="gate")(Signals(vectors, scalars))
        return Signals(norm_vectors(x.vectors, "vector_norm"), _norm("scalar_norm")(x.scalars))


class Gate(nn.Module):
    """The equivariant nonlinearity: a layer of the lengths and the scalars gives the new lengths of
    the vectors and, unless they are not needed, the new scalars."""

    width: int
    scalars: bool = True

    @nn.compact
    def __call__(self, x: Signals) -> Signals:
        sizes = length(jnp.moveaxis(x.vectors, 2, -1))
        outputs = self.width * (2 if self.scalars else 1)
        y = _dense(outputs, "linear")(jnp.concatenate([sizes, x.scalars], axis=-1))
        y = _norm("norm")(nn.relu(y))
        unit = x.vectors / jnp.where(sizes > 0, sizes, 1)[:, :, None]
        return Signals(unit * y[:, :, None, : self.width], y[..., self.width :])


def with_reflections(windows: Float[Array, "b n 6"]) -> Signals:
    """Three ordinary vectors and nine scalars of every sample."""
    accel, gyro = windows[..., :3], windows[..., 3:]
    size = length(gyro)[..., None]
    across = jnp.concatenate([quarter_turn(gyro[..., :2]), jnp.zeros_like(size)], axis=-1)
    first = size * _unit(jnp.cross(gyro, across))
    second = size * _unit(jnp.cross(gyro, first))
    trio = jnp.stack([accel, first, second], axis=-1)
    vectors = trio[:, :, :2]
    pairs = [
        jnp.sum(vectors[..., i] * vectors[..., j], axis=2) for i, j in ((0, 1), (1, 2), (0, 2))
    ]
    sizes = length(jnp.moveaxis(vectors, 2, -1))
    return Signals(vectors, jnp.concatenate([trio[:, :, 2], sizes, jnp.stack(pairs, -1)], axis=-1))


def without_reflections(windows: Float[Array, "b n 6"]) -> Signals:
    """Acceleration and rate, and five scalars of every sample."""
    vectors = jnp.stack([windows[..., :2], windows[..., 3:5]], axis=-1)
    product = jnp.sum(vectors[..., 0] * vectors[..., 1], axis=2)
    sizes = length(jnp.moveaxis(vectors, 2, -1))
    parts = [windows[..., 2:3], windows[..., 5:6], sizes, product[..., None]]
    return Signals(vectors, jnp.concatenate(parts, axis=-1))


def mix(
    vectors: Float[Array, "b n 2 c"], features: int, turns: bool, name: str
) -> Float[Array, "b n 2 d"]:
    """A linear layer over the channels of vectors; `turns`: also over their quarter turns. Call it
    within a module."""
    return _dense(features, name)(with_turns(vectors) if turns else vectors)


def with_turns(vectors: Float[Array, "b n 2 c"]) -> Float[Array, "b n 2 d"]:
    """The vectors and their quarter turns side by side."""
    turned = jnp.stack([-vectors[:, :, 1], vectors[:, :, 0]], axis=2)
    return jnp.concatenate([vectors, turned], axis=-1)


def norm_vectors(vectors: Float[Array, "b n 2 c"], name: str) -> Float[Array, "b n 2 c"]:
    """The vectors with their lengths normalised over the channels; a length below the mean becomes
    negative. Call it within a module."""
    sizes = length(jnp.moveaxis(vectors, 2, -1))
    unit = vectors / jnp.where(sizes > 0, sizes, 1)[:, :, None]
    return unit * _norm(name)(sizes)[:, :, None]


def _unit(vectors: Float[Array, "*k 3"]) -> Float[Array, "*k 3"]:
    size = length(vectors)[..., None]
    return jnp.where(size > 0, vectors / jnp.where(size > 0, size, 1), 0)


def _dense(features: int, name: str) -> nn.Dense:
    return nn.Dense(features, use_bias=False, param_dtype=jnp.float32, name=name)


def _norm(name: str) -> nn.LayerNorm:
    options = {"epsilon": EPSILON, "use_bias": False, "param_dtype": jnp.float32, "name": name}
    return nn.LayerNorm(**options)


def _conv(features: int, train: bool, name: str) -> Any:
    """A convolution in time that keeps the length; the first and last sample are repeated."""
    layer = nn.Conv(
        features,
        (SPAN,),
        padding=[(0, 0)],
        use_bias=False,
        param_dtype=jnp.float32,
        conv_general_dilated=convolve_long if train else convolve_forward,
        name=name,
    )
    before = (SPAN - 1) // 2
    return lambda x: layer(repeat_ends(x, before, SPAN - 1 - before, axis=1))
