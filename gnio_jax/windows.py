"""The network's window: samples cut from an IMU stream, rotated to the gravity-aligned frame.

Sample j of the window that starts at sample i is (paper eq. 1)

    x_j = R_γ(R_i)ᵀ R_j [accel_j − b_a, gyro_j − b_g],

where R_j is the attitude at sample j (body → world) and R_γ(R_i) the rotation about z by the yaw of
R_i. So gravity is on z, the start has zero yaw, and the channels are [accel, gyro]. The network
predicts the displacement over the window, expressed in the same frame. It may also see a context:
samples before i, in the same frame (ours).

The attitudes R_j have two sources:

- A recording has one for every sample. `align_recording` rotates it once, on the host, and
  `cut_windows` then cuts any number of windows on the device: training and batch inference.
- The filter has one only for the start and integrates the gyro from there: `cut_window`.

`true_displacement` is the displacement of the reference.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gnio_jax import geometry
from gnio_jax.numerics import about_z, finite_rows, rotations, yaw
from gnio_jax.types import Array

Rotations = Float[np.ndarray, "m 3 3"]
Starts = Int[np.ndarray, "m"]


# Recordings: an attitude for every sample
# ------------------------------------------------------------------------------------------------


class AlignedRecording(NamedTuple):
    """A recording from which each window needs one rotation. float32, host or device arrays."""

    imu: Float[Array, "t c"]
    """[accel m/s², gyro rad/s]: in the body for `single`, else in the world; for `body_axes` with
    the x and y axes of the body after them (12 channels)."""
    rotation: Float[Array, "m 3 3"]
    """Rotation from the frame of `imu` to the gravity-aligned frame of each window."""


def window_starts(samples: int, length: int, stride: int) -> Starts:
    """First samples of all windows of `length` samples in a recording, `stride` samples apart.

    There is one sample after the last window, at whose stamp its displacement ends. With a context,
    `length` includes it, and a window starts with its context.
    """
    return np.arange(0, samples - length, stride)


def without_any(bad: Bool[np.ndarray, "t"], start: Starts, length: int) -> Bool[np.ndarray, "m"]:
    """Which of the windows of `length` samples from `start` on touch no sample that is `bad`."""
    invalid_before = np.concatenate([[0], np.cumsum(bad)])
    return invalid_before[start + length] == invalid_before[start]


def align_recording(
    accel: Float[np.ndarray, "t 3"],
    gyro: Float[np.ndarray, "t 3"],
    attitude: Float[np.ndarray, "t 3 3"],
    start: Starts,
    window_rotation: str,
) -> AlignedRecording:
    """The computation that all windows of a recording have in common, in float64.

    Args:
        accel: (t, 3) specific force without its bias, body frame, m/s².
        gyro: (t, 3) angular rate without its bias, body frame, rad/s.
        attitude: (t, 3, 3) body → world.
        start: (m,) samples whose yaw the windows remove: their first ones after the context.
        window_rotation: With "per_sample" every sample is rotated to the world by its own attitude,
            and a window needs only its start's yaw removed. With "single" the samples stay in the
            body, and a window is rotated by its start's attitude without yaw. "body_axes" is
            "per_sample" with the x and y axes of the body as six more channels, "hidden_axes" with
            zeros there.
    """
    signals = np.stack([accel, gyro], axis=2)
    rotation = remove_yaw(attitude[start])
    if window_rotation == "single":
        rotation = rotation @ attitude[start]
    else:
        signals = attitude @ signals
    if window_rotation in ("body_axes", "hidden_axes"):
        shown = float(window_rotation == "body_axes")
        signals = np.concatenate([signals, shown * attitude[:, :, :2]], axis=2)
    imu = signals.transpose(0, 2, 1).reshape(len(signals), -1)
    return AlignedRecording(imu.astype(np.float32), rotation.astype(np.float32))


def window_rows(start: Int[Array, "b"], length: int) -> Int[Array, "b n"]:
    """Rows of a recording in each window of `length` samples. Jittable."""
    return start[:, None] + jnp.arange(length, dtype=jnp.int32)[None, :]


def cut_windows(
    imu: Float[Array, "t c"],
    start: Int[Array, "b"],
    rotation: Float[Array, "b 3 3"],
    length: int,
) -> Float[jax.Array, "b n c"]:
    """The windows of `length` samples that start at rows `start` of an aligned recording. Jittable.

    imu and rotation as in `AlignedRecording`, one rotation per window.
    """
    return rotate_channels(rotation, imu[window_rows(start, length)])


def rotate_channels(
    rotation: Float[jax.Array, "b 3 3"], imu: Float[jax.Array, "b n c"]
) -> Float[jax.Array, "b n c"]:
    """Rotate accel and gyro of every sample of each window, and the body's axes if it has them."""
    windows, length, channels = imu.shape
    vectors = imu.reshape(windows, length, channels // 3, 3)
    return rotate_vectors(rotation, vectors).reshape(windows, length, channels)


def rotate_vectors(
    rotation: Float[jax.Array, "b 3 3"], vectors: Float[jax.Array, "b n k 3"]
) -> Float[jax.Array, "b n k 3"]:
    """Rotate the vectors of each window, in full float32 on every kind of device.

    This is a sum over the columns of the rotation, which on CPUs is ten times as fast as a product
    of such small matrices.
    """
    x, y, z = (rotation[:, None, None, :, j] * vectors[..., j, None] for j in range(3))
    return x + y + z


# The filter: an attitude only for the start
# ------------------------------------------------------------------------------------------------


class WindowCut(NamedTuple):
    """How the filter cuts the network's window, between clone i and clone j, out of the IMU stream.

    The window's first sample gets the attitude of clone i.
    """

    lead: int
    """Number of samples by which the window begins before the first one after clone i."""
    subtract_biases: bool
    """Whether the network sees the samples without the filter's biases."""
    propagating: slice
    """Slice of the window's bias-corrected rates that propagate attitude between its samples."""
    body_axes: bool = False
    """Whether the window has the x and y axes of the body as six more channels."""
    hidden: bool = False
    """Whether these axes are zero."""


WINDOW_CUTS = {
    "per_sample": WindowCut(0, True, slice(-1)),
    "body_axes": WindowCut(0, True, slice(-1), body_axes=True),
    "hidden_axes": WindowCut(0, True, slice(-1), body_axes=True, hidden=True),
    # No rate is integrated: all samples have the attitude of the first.
    "single": WindowCut(0, True, slice(0)),
    # In TLIO's tracker a sample with stamp t drives the filter from t − dt to t, and its own rate
    # leads to its own attitude. The network sees the IMU without bias correction.
    "tlio": WindowCut(1, False, slice(1, None)),
}
"""The values of `FilterConfig.window_rotation`."""


def cut_window(
    rotation: Float[Array, "3 3"],
    gyro: Float[Array, "n 3"],
    accel: Float[Array, "n 3"],
    gyro_bias: Float[Array, "3"],
    accel_bias: Float[Array, "3"],
    cut: WindowCut,
    dt: float,
    context: int = 0,
) -> Float[jax.Array, "n c"]:
    """A window of n raw samples in the gravity-aligned frame of its start. Jittable and
    differentiable.

    Attitudes are propagated by R_{j+1} = R_j exp(φ_j), where φ is the bias-corrected rate times dt,
    as `cut` specifies: forwards from the first sample after the context, and backwards through the
    context.

    Args:
        rotation: (3, 3) body → world, attitude of the first sample after the context.
        gyro: (n, 3) body frame, rad/s.
        accel: (n, 3) body frame, m/s².
        gyro_bias: (3,) body frame, rad/s.
        accel_bias: (3,) body frame, m/s².
        cut: How the window is cut (`WINDOW_CUTS`).
        dt: Time between samples, s.
        context: Number of samples before the window's start.

    Returns:
        (n, 6): [accel m/s², gyro rad/s], or (n, 12) with the body's x and y axes.
    """
    rates = gyro - gyro_bias[None]
    if cut.subtract_biases:
        gyro, accel = rates, accel - accel_bias[None]
    turns = jax.vmap(geometry.exp, out_axes=2)(rates[cut.propagating] * dt)
    first = geometry.yaw_rotation(rotation).T @ rotation
    if context:
        context_turns = geometry.cumulative_rotation(
            jnp.eye(3, dtype=first.dtype), turns[:, :, :context]
        )
        first = first @ context_turns[:, :, -1].T
    attitudes = geometry.cumulative_rotation(first, turns)
    # Samples are along the last axis, so that XLA fuses sums over three, as everywhere in the
    # filter.
    attitudes = jnp.broadcast_to(attitudes, (3, 3, len(gyro)))
    signals = geometry.matmul(attitudes, jnp.stack([accel.T, gyro.T], axis=1))
    if cut.body_axes:
        axes = jnp.zeros_like(attitudes[:, :2]) if cut.hidden else attitudes[:, :2]
        signals = jnp.concatenate([signals, axes], axis=1)
    return signals.transpose(2, 1, 0).reshape(len(gyro), -1)


# The reference's displacement
# ------------------------------------------------------------------------------------------------


def true_displacement(
    orientation: Float[np.ndarray, "t 4"],
    position: Float[np.ndarray, "t 3"],
    start: Starts,
    length: int,
) -> Float[np.ndarray, "m 3"]:
    """Displacement R_γ(R_i)ᵀ (p[i + length] − p[i]) of windows that start at i, m.

    orientation quaternions wxyz, body → world; position m, in the world. NaN where either is NaN.
    """
    displacement = position[start + length] - position[start]
    finite = finite_rows(orientation[start])
    attitude = rotations(np.where(finite[:, None], orientation[start], [1.0, 0.0, 0.0, 0.0]))
    local = np.einsum("mij,mj->mi", remove_yaw(attitude.as_matrix()), displacement)
    return np.where(finite[:, None], local, np.nan)


def remove_yaw(rotation: Rotations) -> Rotations:
    """R_γ(R)ᵀ: from the world to the frame in which `rotation` has zero yaw."""
    return about_z(-yaw(rotation)).as_matrix()
