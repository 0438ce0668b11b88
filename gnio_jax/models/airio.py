"""AirIO (Qiu et al., "AirIO: Learning Inertial Odometry with Enhanced IMU Feature Observability",
IEEE RA-L 2025), and the encoder that it shares with AirIMU.

The network sees the samples in the body's frame, with gravity, and the attitude as an input of its
own. It predicts the velocity in the body, which the filter may measure (`filter.measures`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Int

from gnio_jax.config.schema import Count, Probability
from gnio_jax.models.bidirectional import Bidirectional
from gnio_jax.models.convolution import convolve, convolve_forward
from gnio_jax.models.layers import EPSILON, FLOAT32, MOMENTUM, checked_windows, linear
from gnio_jax.numerics import midpoints
from gnio_jax.types import Prediction, Velocity

STRIDE = 9
"""Samples from one output to the next: two convolutions of stride 3."""
FIRST_LABEL = 14
"""Sample of the window at whose stamp the velocity is the target of the first output."""
LOG_VARIANCE_SHIFT = 5.0
"""A variance is exp(x − 5) of the decoder's output x."""


class AirIO(nn.Module):
    """Windows of 12 channels (`data.window_rotation: body_axes`) to the velocity in the body and
    its uncertainty at every ninth sample, and to the displacement to which they add up.

    Two encoders, of [accel, gyro] in the body and of the attitude as a rotation vector, a
    projection, two layers of GRU in both directions, and two decoders: 354,278 parameters.

    Published: the velocity in m/s at each sample 14 + 9k, and at the window's end for the outputs
    after it, from windows of 5 s, with the attitude in the world. Ours: velocities in metres per
    window, which are m/s for windows of 1 s; the attitude in the frame in which the window's start
    has zero yaw, so that a turned world turns the displacement; a displacement with the variance
    that the outputs have if their errors are the same in the whole window.

    `width` scales all layers. Training needs the random stream `dropout`.
    """

    width: Count = 64
    dropout: Probability = 0.5
    channels = 12
    takes_context = False
    quantities = ("displacement", "velocity")

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 12"], train: bool = False) -> Prediction:
        windows = checked_windows(windows, self.channels)
        rotation = body_axes(windows)
        imu = windows[..., :6].reshape(*windows.shape[:2], 2, 3)
        body = jnp.einsum("bnij,bnki->bnkj", rotation, imu).reshape(*windows.shape[:2], 6)
        parts = {"imu": body, "attitude": rotation_vector(rotation)}
        features = [
            StridedEncoder(self.width, self.dropout, name=name)(signal, train)
            for name, signal in parts.items()
        ]
        x = nn.Dropout(self.dropout, deterministic=not train)(jnp.concatenate(features, axis=-1))
        x = norm("projection_norm", train)(linear(self.width, "projection")(x))
        x = nn.gelu(x, approximate=False)
        for layer, units in (("gru1", self.width), ("gru2", 2 * self.width)):
            x, _ = Bidirectional(units, "gru", name=layer)(x)
        velocity = Decoder(2 * self.width, name="displacement")(x)
        log_std = 0.5 * (Decoder(2 * self.width, name="log_std")(x) - LOG_VARIANCE_SHIFT)
        rows = label_rows(windows.shape[1])
        to_window, shares = with_end(rotation)[:, rows], label_shares(windows.shape[1])
        displacement = jnp.einsum("n,bnij,bnj->bi", shares, to_window, velocity)
        variance = jnp.einsum("n,bnij,bnj->bi", shares, to_window**2, jnp.exp(2 * log_std))
        diagnostics = {"body_velocity": velocity, "body_velocity_log_std": log_std}
        last = Velocity(velocity[:, -1], log_std[:, -1])
        return Prediction(displacement, 0.5 * jnp.log(variance), diagnostics, velocity=last)


class StridedEncoder(nn.Module):
    """Two convolutions of 7 samples and stride 3, each with normalisation and GELU: (b, n, c) to
    (b, ⌈⌈n/3⌉/3⌉, width). Dropout is within (AirIMU), or is left to the caller (AirIO)."""

    width: int
    dropout: float
    within: bool = False

    @nn.compact
    def __call__(
        self, x: Float[Array, "b n c"], train: bool, output: Int[Array, ""] | None = None
    ) -> Float[Array, "b m d"]:
        """With the number of an `output`, x has only the 25 samples on which it depends, and the
        result is this output alone."""
        padding = (0, 0) if output is not None else (3, 3)
        for layer, features in (("1", max(self.width // 2, 1)), ("2", self.width)):
            x = nn.Conv(
                features,
                (7,),
                (3,),
                [padding],
                conv_general_dilated=convolve if train else convolve_forward,
                name=f"filter{layer}",
                **FLOAT32,
            )(x)
            x = nn.gelu(norm(f"norm{layer}", train)(x), approximate=False)
            if output is not None and layer == "1":  # the second convolution's padding at the start
                rows = STRIDE // 3 * output - 3 + jnp.arange(x.shape[1])
                x = jnp.where((rows >= 0)[None, :, None], x, 0.0)
            if self.within:
                x = nn.Dropout(self.dropout, deterministic=not train)(x)
        return x


class Decoder(nn.Module):
    """Linear, GELU, linear to three axes."""

    width: int

    @nn.compact
    def __call__(self, x: Float[Array, "b n d"]) -> Float[Array, "b n 3"]:
        return linear(3, "fc2")(nn.gelu(linear(self.width, "fc1")(x), approximate=False))


def norm(name: str, train: bool) -> nn.BatchNorm:
    """A batch normalisation that inference does not fold: after a layer with a bias, or before
    one."""
    options = {"momentum": MOMENTUM, "epsilon": EPSILON, "name": name, **FLOAT32}
    return nn.BatchNorm(use_running_average=not train, **options)


def label_rows(samples: int) -> Int[np.ndarray, "m"]:
    """The time for which each output of the encoder predicts the velocity, in samples since the
    first stamp of a window: the window's end, one sample after its last stamp, for those that would
    be later."""
    outputs = -(-samples // STRIDE)
    return np.minimum(FIRST_LABEL + STRIDE * np.arange(outputs), samples)


def label_shares(samples: int) -> Float[np.ndarray, "m"]:
    """Shares of the window in which the velocity of each of `label_rows` is the nearest one in
    time. They add up to 1."""
    edges = np.concatenate([[0.0], midpoints(label_rows(samples).astype(float)), [samples]])
    return (np.diff(edges) / samples).astype(np.float32)


def with_end(rotation: Float[Array, "b n 3 3"]) -> Float[Array, "b m 3 3"]:
    """The attitudes at the n stamps of a window and at its end, m = n + 1. The last turn is taken
    as the one before it (ours): an error of α dt² for an angular acceleration α."""
    before, last = rotation[:, -2], rotation[:, -1]
    end = jnp.einsum("bij,bkj,bkl->bil", last, before, last)
    return jnp.concatenate([rotation, end[:, None]], axis=1)


def velocities(steps: Float[Array, "b n 3"]) -> Float[Array, "b m 3"]:
    """Velocities at the n stamps of a window and at its end, m = n + 1, in metres per sample, of
    the displacements from each stamp to the next: means of both neighbours, and at the two ends on
    the straight line through the two nearest."""
    inner = 0.5 * (steps[:, 1:] + steps[:, :-1])
    first = 1.5 * steps[:, :1] - 0.5 * steps[:, 1:2]
    end = 1.5 * steps[:, -1:] - 0.5 * steps[:, -2:-1]
    return jnp.concatenate([first, inner, end], axis=1)


def body_axes(windows: Float[Array, "b n 12"]) -> Float[Array, "b n 3 3"]:
    """Attitude body → window of every sample: its columns are the body's axes."""
    x, y = windows[..., 6:9], windows[..., 9:12]
    return jnp.stack([x, y, jnp.cross(x, y)], axis=-1)


def rotation_vector(rotation: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """Rotation vectors, rad, of angles up to π, with finite derivatives everywhere.

    It is computed from the quaternion, whose largest component is computed first. At π the sign of
    the axis jumps, as in every rotation vector.
    """
    diagonal = jnp.stack([rotation[..., i, i] for i in range(3)], axis=-1)
    trace = diagonal.sum(axis=-1, keepdims=True)
    squares = jnp.concatenate([1 + trace, 1 + 2 * diagonal - trace], axis=-1)
    pairs = [(2, 1), (0, 2), (1, 0)]
    skew = [rotation[..., i, j] - rotation[..., j, i] for i, j in pairs]
    even = [rotation[..., i, j] + rotation[..., j, i] for i, j in pairs]
    table = jnp.stack(
        [
            jnp.stack([squares[..., 0], *skew], axis=-1),
            jnp.stack([skew[0], squares[..., 1], even[2], even[1]], axis=-1),
            jnp.stack([skew[1], even[2], squares[..., 2], even[0]], axis=-1),
            jnp.stack([skew[2], even[1], even[0], squares[..., 3]], axis=-1),
        ],
        axis=-2,
    )
    largest = jax.lax.stop_gradient(jnp.argmax(squares, axis=-1))
    row = jnp.take_along_axis(table, largest[..., None, None], axis=-2)[..., 0, :]
    row = row / jnp.sqrt(jnp.sum(row**2, axis=-1, keepdims=True))
    row = jnp.where(row[..., :1] < 0, -row, row)
    squared = jnp.sum(row[..., 1:] ** 2, axis=-1, keepdims=True)
    small = squared < 1e-8
    sine = jnp.sqrt(jnp.where(small, 1.0, squared))
    factor = jnp.where(
        small, 2 / row[..., :1].clip(0.5), 2 * jnp.arctan2(sine, row[..., :1]) / sine
    )
    return factor * row[..., 1:]
