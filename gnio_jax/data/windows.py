"""Training windows: an index over recordings that lie on the device once, gathered and rotated
inside the jitted step.

Overlapping windows are never copied: a second of IMU belongs to ten windows and is stored once.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.spatial.transform import Rotation

from gnio_jax.config import DataConfig
from gnio_jax.types import Array, InputError, Sequence, Windows


class WindowSource(NamedTuple):
    """All recordings of a split, end to end, and where windows may start in them. float32.

    What does not depend on the augmentation is done here, once: with `window_rotation="per_sample"`
    the samples are stored in the world frame and a window needs only its start's yaw removed; with
    `"single"` they stay in the body frame and a window is rotated by its start's attitude without
    yaw. Either way it is one rotation per window.
    """

    imu: Float[Array, "t 6"]
    """[accel m/s², gyro rad/s]."""
    start: Int[Array, "m"]
    """Row of `imu` at which each window begins."""
    rotation: Float[Array, "m 3 3"]
    """From the frame of `imu` to the gravity-aligned frame in which the window's start has zero
    yaw."""
    displacement: Float[Array, "m 3"]
    """Target in that frame, m: from the stamp of the first sample to one interval after the last
    (paper eq. 1)."""
    step: Float[Array, "t 3"]
    """Displacement from each sample's stamp to the next in the world, m; NaN where the reference
    has none."""
    unyaw: Float[Array, "m 2"]
    """Cosine and sine of each window start's yaw: from the world to the window's frame."""
    visited: Int[Array, "v"]
    """Numbers of the windows an epoch visits: all of them, unless they are to be shifted (see
    `shifted`)."""


def index(
    sequences: Iterable[Sequence], config: DataConfig, stride: int, shift: int = 0
) -> WindowSource:
    """Cut `sequences` (all at `config.rate`) into windows every `stride` samples; with `shift`, at
    every sample, for those to shift to.

    A window of N samples from i needs the reference at i … i+N, all of it valid. Attitude and
    biases come from the reference (biases zero). Differences of positions are taken in float64,
    before they are stored in float32. Raises `InputError` when not a single window fits.
    """
    length = config.window
    parts: list[WindowSource] = []
    offset = count = 0
    for sequence in sequences:
        start = np.arange(0, len(sequence.time) - length, 1 if shift else stride)
        bad = np.concatenate([[0], np.cumsum(~sequence.valid)])
        start = start[bad[start + length + 1] == bad[start]]
        if start.size == 0:
            continue
        # An invalid row may hold NaN; no window touches it, so any rotation will do there.
        body = Rotation.from_quat(
            np.where(sequence.valid[:, None], sequence.orientation, [1.0, 0, 0, 0]),
            scalar_first=True,
        )
        first = body[start].as_matrix()
        yaw = np.arctan2(first[:, 1, 0], first[:, 0, 0])
        unyaw = Rotation.from_rotvec(np.outer(yaw, [0, 0, -1])).as_matrix()
        imu = np.hstack([sequence.accel, sequence.gyro])
        if config.window_rotation == "per_sample":
            imu = np.hstack([body.apply(sequence.accel), body.apply(sequence.gyro)])
        moved = sequence.position[start + length] - sequence.position[start]
        parts.append(
            WindowSource(
                imu=imu.astype(np.float32),
                start=(start + offset).astype(np.int32),
                rotation=(
                    unyaw if config.window_rotation == "per_sample" else unyaw @ first
                ).astype(np.float32),
                displacement=np.einsum("mij,mj->mi", unyaw, moved).astype(np.float32),
                step=np.diff(sequence.position, axis=0, append=np.nan).astype(np.float32),
                unyaw=np.column_stack([np.cos(yaw), np.sin(yaw)]).astype(np.float32),
                visited=(np.flatnonzero(start % stride == 0) + count).astype(np.int32),
            )
        )
        offset += len(sequence.time)
        count += start.size
    if not parts:
        raise InputError(
            "data",
            f"no window of {config.window_seconds:g} s with a valid reference in any sequence",
        )
    return WindowSource(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def gather(source: WindowSource, which: Int[jax.Array, "b"], length: int) -> Windows:
    """The windows number `which` of `source`, each `length` samples, rotated to their own frames.
    Jittable."""
    rows = source.start[which][:, None] + jnp.arange(length, dtype=jnp.int32)[None, :]
    imu = source.imu[rows].reshape(which.shape[0], length, 2, 3)
    imu = rotate(source.rotation[which], imu).reshape(which.shape[0], length, 6)
    cosine, sine = source.unyaw[which][:, :, None].swapaxes(0, 1)
    x, y, z = jnp.moveaxis(
        source.step[rows], -1, 0
    )  # dropped by the compiler where nobody looks at it
    return Windows(
        imu,
        source.displacement[which],
        jnp.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1),
    )


def shifted(
    key: PRNGKeyArray, source: WindowSource, which: Int[jax.Array, "b"], samples: int
) -> Int[jax.Array, "b"]:
    """The numbers of windows up to `samples` later or earlier than `which`, which stay where the
    recording has none there."""
    if samples == 0:
        return which
    shift = jax.random.randint(key, which.shape, -samples, samples + 1, jnp.int32)
    there = jnp.clip(which + shift, 0, source.start.shape[0] - 1)
    return jnp.where(source.start[there] - source.start[which] == shift, there, which)


def rotate(
    rotation: Float[jax.Array, "b 3 3"], vectors: Float[jax.Array, "b n k 3"]
) -> Float[jax.Array, "b n k 3"]:
    """Rotate the vectors of each window, in full float32 on every kind of device."""
    return jnp.einsum("bij,bnkj->bnki", rotation, vectors, precision=jax.lax.Precision.HIGHEST)
