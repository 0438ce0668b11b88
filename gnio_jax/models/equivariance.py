"""Yaw equivariance around any network: a window that is turned about the vertical gives a
displacement that is turned by the same angle.

A heading is (cos, sin) of an angle about z. The parameters of the wrapped network keep their names,
so weights of the network alone fit `FourHeadings`.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Tilt
from gnio_jax.geometry import direction
from gnio_jax.models.bins import mean_of_quarter_turns, mirror
from gnio_jax.models.heads import root_mean_square, to_axes
from gnio_jax.models.layers import checked_windows, conv_norm, linear
from gnio_jax.models.memory import NetworkWithMemory
from gnio_jax.types import GRAVITY, Prediction

QUARTER_TURNS = np.float32([[1, 0], [0, 1], [-1, 0], [0, -1]])
"""Headings 0, 90, 180 and 270°."""
FRAME_FEATURES = 16
"""Features of the frame network's convolutions (ours)."""
FRAME_SPAN = 7
"""Samples that each of these convolutions sees (ours)."""


class Equivariant(nn.Module):
    """A network whose parts are on the same level as those that make it equivariant."""

    network: nn.Module

    def setup(self) -> None:
        nn.share_scope(self, self.network)

    @nn.nowrap
    def constants(self, variables: Any) -> dict[str, Any]:
        """Arguments of `apply` that depend on the variables alone: those of the network."""
        constants = getattr(self.network, "constants", None)
        return constants(variables) if constants else {}


class FourHeadings(Equivariant):
    """At inference, the mean over the window turned by 0, 90, 180 and 270°, with each displacement
    turned back. This is exact for quarter turns.

    The variance is the mean of the four variances, also turned back. Diagnostics are those of the
    window without a turn, except CTIN's velocities and the distributions over bins, which are
    averaged too. Training applies the network once, because augmentation draws the heading.
    """

    averages_headings = True

    def __call__(
        self, windows: Float[Array, "b n 6"], train: bool = False, **constants: Any
    ) -> Prediction:
        if train:
            return self.network(windows, train, **constants)
        batch, turns = windows.shape[0], len(QUARTER_TURNS)
        heading = jnp.repeat(jnp.asarray(QUARTER_TURNS), batch, axis=0)
        turned_windows = turn_windows(jnp.tile(checked_windows(windows), (turns, 1, 1)), heading)
        prediction = self.network(turned_windows, train, **constants)
        turned_back = turn_prediction(prediction, opposite(heading))

        def by_heading(axes: Array) -> Array:
            return jnp.moveaxis(axes.reshape(turns, batch, *axes.shape[1:]), 0, -2)

        diagnostics = {name: value[:batch] for name, value in prediction.diagnostics.items()}
        if "velocity" in diagnostics:  # CTIN's loss learns from these
            velocities = by_heading(turned_back.diagnostics["velocity"])
            log_stds = by_heading(turned_back.diagnostics["velocity_log_std"])
            diagnostics["velocity"] = velocities.mean(axis=-2)
            diagnostics["velocity_log_std"] = root_mean_square(log_stds)
        if "bin_logits" in diagnostics:  # so do networks with these
            logits = prediction.diagnostics["bin_logits"]
            logits = logits.reshape(turns, batch, *logits.shape[1:])
            diagnostics["bin_logits"] = mean_of_quarter_turns(logits)
        return Prediction(
            by_heading(turned_back.displacement).mean(axis=-2),
            root_mean_square(by_heading(turn_log_std(prediction.log_std, opposite(heading)))),
            diagnostics,
        )


class FourHeadingsWithMemory(NetworkWithMemory):
    """At inference, four memories of a network side by side, which see the samples turned by 0, 90,
    180 and 270°, and the mean of their displacements, turned back (ours).

    A network with memory turns with the world whatever it is. But a horizontal error that is
    constant in the frame of its memory, whose yaw is that of the walk's start, adds up along the
    walk. The frame of a window turns with its carrier, so there it does not. What is the same at
    all four headings cancels in the mean. Variances and diagnostics are as in `FourHeadings`.
    Training on segments has one memory; validation and training through the filter have four.
    """

    network: Any = None
    """A `NetworkWithMemory`, whose own options hold."""

    averages_headings = True

    def setup(self) -> None:
        nn.share_scope(self, self.network)

    @property
    def features(self) -> int:
        return self.network.features

    @property
    def multiple(self) -> int:
        return self.network.multiple

    @nn.nowrap
    def constants(self, variables: Any) -> dict[str, Any]:
        return self.network.constants(variables)

    def begin(self, batch: int) -> Any:
        turns = len(QUARTER_TURNS)
        states = self.network.begin(turns * batch)
        return jax.tree.map(lambda leaf: leaf.reshape(batch, turns, *leaf.shape[1:]), states)

    def advance(
        self,
        state: Any,
        signals: Float[Array, "b t c"],
        every: int,
        train: bool = False,
        **constants: Any,
    ) -> tuple[Any, Prediction]:
        signals, turns = checked_windows(signals, self.network.inputs), len(QUARTER_TURNS)
        if train:
            first = jax.tree.map(lambda leaf: leaf[:, 0], state)
            first, prediction = self.network.advance(first, signals, every, train, **constants)
            return jax.tree.map(lambda leaf, row: leaf.at[:, 0].set(row), state, first), prediction
        batch = signals.shape[0]
        heading = jnp.tile(jnp.asarray(QUARTER_TURNS), (batch, 1))
        turned = turn_windows(jnp.repeat(signals, turns, axis=0), heading)
        rows = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), state)
        rows, prediction = self.network.advance(rows, turned, every, train, **constants)

        def by_heading(axes: Array) -> Array:
            return jnp.moveaxis(axes.reshape(batch, turns, *axes.shape[1:]), 1, -2)

        displacement = turn(prediction.displacement, opposite(heading))
        log_std = turn_log_std(prediction.log_std, opposite(heading))
        state = jax.tree.map(lambda leaf: leaf.reshape(batch, turns, *leaf.shape[1:]), rows)
        diagnostics = {name: value[::turns] for name, value in prediction.diagnostics.items()}
        if "bin_logits" in diagnostics:
            logits = prediction.diagnostics["bin_logits"]
            logits = jnp.moveaxis(logits.reshape(batch, turns, *logits.shape[1:]), 1, 0)
            diagnostics["bin_logits"] = mean_of_quarter_turns(logits)
        return state, Prediction(
            by_heading(displacement).mean(axis=-2),
            root_mean_square(by_heading(log_std)),
            diagnostics,
        )


class SeesDevice(nn.Module):
    """What the networks that see the heading of the device have in common: windows with the axes of
    the body, which may be hidden, and the limit within which its screen faces up."""

    largest_tilt: Tilt = 60.0
    channels = 12
    hides_axes = True

    @property
    def least_up(self) -> float:
        """The vertical component of the screen's normal above which it faces up."""
        return math.cos(math.radians(self.largest_tilt))


class DeviceHeading(SeesDevice, Equivariant):
    """The network sees a device whose screen faces up in the frame of its own heading, and its
    displacement is turned back (ours). Exact for every angle.

    People hold a screen that they can read ahead of them. Seen in the frame of the device, their
    direction hardly varies, and need not be inferred from the gait. Nothing follows from the
    heading of any other device, e.g. in a pocket: its window keeps its frame, whose heading is
    drawn in training. A learnt constant, which is added to the samples of the first kind, tells the
    network which one it sees.

    The x axis of the frame is the horizontal direction of the device's x axis, from the left of its
    screen to its right, in the mean over the window. Windows have the axes of the body. Where these
    are zero (`augment.hidden_axes_share`, `filter.window_rotation: hidden_axes`), the heading is
    not known. A screen faces up if its normal is within `largest_tilt` degrees of the vertical.
    """

    @nn.compact
    def __call__(
        self, windows: Float[Array, "b n 12"], train: bool = False, **constants: Any
    ) -> Prediction:
        windows = checked_windows(windows, self.channels)
        x_axis, y_axis = windows[..., 6:9], windows[..., 9:12]
        up = vertical_of_normal(x_axis, y_axis)
        faces_up = (up.mean(axis=1) > jnp.float32(self.least_up))[:, None]
        mean = jnp.where(faces_up, x_axis.mean(axis=1)[:, :2], jnp.float32([[1, 0]]))
        heading = jnp.stack(direction(mean[:, 0], mean[:, 1]), axis=-1)
        constant = self.param("facing_up", nn.initializers.zeros, (6,), jnp.float32)
        samples = turn_windows(windows[..., :6], opposite(heading))
        samples = samples + jnp.where(faces_up, constant[None], 0.0)[:, None]
        return turn_prediction(self.network(samples, train, **constants), heading)


class DeviceHeadingWithMemory(SeesDevice, FourHeadingsWithMemory):
    """Four memories that see the heading of a device whose screen faces up beside its samples
    (ours; why it helps: `DeviceHeading`).

    Three channels come after acceleration and angular rate: the direction of the device's x axis
    along the ground, from the left of its screen to its right, as a vector (cos, sin) in the frame
    of the memory, and 1. All are 0 at samples whose screen does not face up, and where the axes are
    hidden (`augment.hidden_axes_share`, `filter.window_rotation: hidden_axes`). The vector turns
    with the samples in each of the four memories. `show_device_heading` makes it, with a network
    that has room for the three channels.
    """

    def advance(
        self,
        state: Any,
        signals: Float[Array, "b t 12"],
        every: int,
        train: bool = False,
        **constants: Any,
    ) -> tuple[Any, Prediction]:
        signals = checked_windows(signals, self.channels)
        x_axis, y_axis = signals[..., 6:9], signals[..., 9:12]
        faces_up = vertical_of_normal(x_axis, y_axis) > jnp.float32(self.least_up)
        cosine, sine = direction(x_axis[..., 0], x_axis[..., 1])
        heading = jnp.stack([cosine, sine, jnp.ones_like(sine)], axis=-1)
        heading = jnp.where(faces_up[..., None], heading, 0.0)
        signals = jnp.concatenate([signals[..., :6], heading], axis=-1)
        return super().advance(state, signals, every, train, **constants)


def show_device_heading(network: NetworkWithMemory, **options: Any) -> DeviceHeadingWithMemory:
    """Four memories of the network, which see the heading of the device."""
    return DeviceHeadingWithMemory(network=network.clone(inputs=9), **options)


def vertical_of_normal(
    x_axis: Float[Array, "*k 3"], y_axis: Float[Array, "*k 3"]
) -> Float[Array, "*k"]:
    """The vertical component of the normal of a screen with these axes; 0 if they are hidden."""
    return x_axis[..., 0] * y_axis[..., 1] - x_axis[..., 1] * y_axis[..., 0]


class CanonicalFrame(Equivariant):
    """The network sees the window in a frame that turns with it, and its displacement is turned
    back (EqNIO: Jayanth et al., "EqNIO: Subequivariant Neural Inertial Odometry", 2024; its SO(2)
    part, details ours). Exact for every angle.

    The network's variances are along the axes of the frame (`Prediction.axes`), so the covariance
    is full in the plane. Diagnostics are expressed in the frame, except CTIN's
    velocities, which its loss needs: they are turned back.
    """

    def setup(self) -> None:
        super().setup()
        self.frame = FrameNetwork()

    def __call__(
        self, windows: Float[Array, "b n 6"], train: bool = False, **constants: Any
    ) -> Prediction:
        windows = checked_windows(windows)
        heading = self.frame(windows, train)
        prediction = self.network(turn_windows(windows, opposite(heading)), train, **constants)
        return turn_prediction(prediction, heading)


class FrameNetwork(nn.Module):
    """The heading of a window, which turns with it: the direction of a weighted sum of the
    horizontal vectors of its samples.

    The vectors are acceleration, angular rate and the quarter turns of both. A small convolutional
    network finds the weights from invariant quantities. The sum can have any direction in the
    plane. If it is 0, as in a window without horizontal vectors, the heading is (1, 0), without
    gradient.
    """

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 6"], train: bool) -> Float[Array, "b 2"]:
        x = invariants(windows)
        for layer in ("1", "2"):
            x = nn.relu(conv_norm(x, FRAME_FEATURES, FRAME_SPAN, 1, train, f"conv{layer}"))
        accel, gyro = windows[..., 0:2], windows[..., 3:5]
        vectors = jnp.stack([accel, quarter_turn(accel), gyro, quarter_turn(gyro)], axis=2)
        weights = linear(vectors.shape[2], "weights")(x)
        mean = jnp.einsum("bnk,bnkd->bd", weights, vectors) / windows.shape[1]
        return jnp.stack(direction(mean[:, 0], mean[:, 1]), axis=-1)


def invariants(windows: Float[Array, "b n 6"]) -> Float[Array, "b n 6"]:
    """The invariants of every sample under a turn about z: |a|, |ω|, a · ω and a × ω of the
    horizontal parts, the vertical acceleration without gravity and the vertical rate."""
    accel, gyro = windows[..., 0:2], windows[..., 3:5]
    values = (
        length(accel),
        length(gyro),
        jnp.sum(accel * gyro, axis=-1),
        jnp.sum(quarter_turn(accel) * gyro, axis=-1),
        windows[..., 2] - GRAVITY,
        windows[..., 5],
    )
    return jnp.stack(values, axis=-1)


def length(vectors: Float[Array, "*k d"]) -> Float[Array, "*k"]:
    """Lengths, with zero derivative at 0."""
    squared = jnp.sum(vectors**2, axis=-1)
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)


def quarter_turn(vectors: Float[Array, "*k 2"]) -> Float[Array, "*k 2"]:
    """Horizontal vectors turned by 90°."""
    return jnp.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)


def opposite(heading: Float[Array, "b 2"]) -> Float[Array, "b 2"]:
    """The headings of the same angles with the opposite sign."""
    return heading * jnp.array([[1, -1]], heading.dtype)


def turn(vectors: Float[Array, "b *n 3"], heading: Float[Array, "b 2"]) -> Float[Array, "b *n 3"]:
    """Vectors turned about z by the heading of their row."""
    cosine, sine = _components(heading, vectors.ndim - 2)
    x, y, z = jnp.moveaxis(vectors, -1, 0)
    return jnp.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)


def turn_windows(
    windows: Float[Array, "b n c"], heading: Float[Array, "b 2"]
) -> Float[Array, "b n c"]:
    """Windows turned about z: acceleration, angular rate and axes of the body are all vectors."""
    batch, samples, channels = windows.shape
    return turn(windows.reshape(batch, samples, channels // 3, 3), heading).reshape(windows.shape)


def turn_log_std(
    log_std: Float[Array, "b *n 3"], heading: Float[Array, "b 2"]
) -> Float[Array, "b *n 3"]:
    """The diagonal of the covariance diag(exp 2u) turned about z, as log standard deviations.

    It is computed in logarithms, where nothing overflows. The squares of cosine and sine are kept
    above 0, so that the derivative is finite.
    """
    squared = jnp.maximum(heading**2, jnp.float32(1e-30))
    log_cosine, log_sine = _components(jnp.log(squared), log_std.ndim - 2)
    x, y, z = jnp.moveaxis(2 * log_std, -1, 0)
    turned = (
        jnp.logaddexp(x + log_cosine, y + log_sine),
        jnp.logaddexp(x + log_sine, y + log_cosine),
        z,
    )
    return 0.5 * jnp.stack(turned, axis=-1)


def turn_prediction(prediction: Prediction, heading: Float[Array, "b 2"]) -> Prediction:
    """The prediction turned about z: the displacement, the axes of its uncertainty, and the
    velocities among its diagnostics, of which the diagonal of the covariance is kept. A
    distribution over bins stays along the axes of the uncertainty."""
    diagnostics = dict(prediction.diagnostics)
    for name, turned in (("velocity", turn), ("velocity_log_std", turn_log_std)):
        if name in diagnostics:
            diagnostics[name] = turned(diagnostics[name], heading)
    axes = heading
    if prediction.axes is not None:
        axes = turn(to_axes(prediction.axes), heading)[:, :2]
    displacement = turn(prediction.displacement, heading)
    return Prediction(displacement, prediction.log_std, diagnostics, axes)


def reflect_prediction(prediction: Prediction, sign: Float[Array, "b"]) -> Prediction:
    """The prediction with y reflected where the sign is negative, with the velocities and the
    distribution over bins among its diagnostics. A diagonal covariance does not change."""
    signs = jnp.stack([jnp.ones_like(sign), sign, jnp.ones_like(sign)], axis=-1)
    diagnostics = dict(prediction.diagnostics)
    if "velocity" in diagnostics:
        diagnostics["velocity"] = diagnostics["velocity"] * signs[:, None]
    if "bin_logits" in diagnostics:
        logits = diagnostics["bin_logits"]
        mirrored = (signs < 0)[..., None]
        diagnostics["bin_logits"] = jnp.where(mirrored, mirror(logits), logits)
    displacement = prediction.displacement * signs
    return prediction._replace(displacement=displacement, diagnostics=diagnostics)


def _components(
    heading: Float[Array, "b 2"], axes: int
) -> tuple[Float[Array, "b *n"], Float[Array, "b *n"]]:
    """Cosine and sine of every row, with `axes` axes of length 1 after the batch."""
    columns = heading.reshape(-1, *[1] * axes, 2)
    return columns[..., 0], columns[..., 1]
