"""Training windows: recordings that are stored once, and an index of where windows start.

Overlapping windows are never copied: a second of IMU belongs to ten windows and is stored once.
Windows are cut and rotated inside the jitted step (`gnio_jax.windows.cut_windows`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from gnio_jax.config import DataConfig
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations, yaw
from gnio_jax.types import Array, Sequence, Windows
from gnio_jax.windows import (
    Starts,
    align_recording,
    cut_windows,
    true_displacement,
    window_rows,
    window_starts,
    without_any,
)


class WindowSource(NamedTuple):
    """All recordings of a split, end to end, and where windows may start in them. float32."""

    imu: Float[Array, "t 6"]
    """[accel m/s², gyro rad/s], as `gnio_jax.windows.AlignedRecording` has it."""
    start: Int[Array, "m"]
    """Row of `imu` at which each window begins, with its context."""
    rotation: Float[Array, "m 3 3"]
    """From the frame of `imu` to the gravity-aligned frame in which the window's start, after the
    context, has zero yaw."""
    displacement: Float[Array, "m 3"]
    """Target in that frame, m: from the stamp of the first sample after the context to one interval
    after the last (paper eq. 1)."""
    step: Float[Array, "t 3"]
    """Displacement from each sample's stamp to the next in the world, m; NaN where the reference
    has none."""
    unyaw: Float[Array, "m 2"]
    """Cosine and sine of the yaw that `rotation` removes: from the world to the window's frame."""
    visited: Int[Array, "v"]
    """Numbers of the windows an epoch visits: all of them, unless they are to be shifted (see
    `shift_windows`)."""


def window_source(
    sequences: Iterable[Sequence], config: DataConfig, stride: int, shift: int = 0
) -> WindowSource:
    """Cut `sequences` (all at `config.rate`) into windows every `stride` samples.

    With `shift` there is a window at every sample, for those of an epoch to be shifted to. A window
    of C + N samples from i, context included, needs the reference at i … i+C+N, all of it
    valid, and no sample across a gap of the IMU. Attitude and biases come from the reference
    (biases zero). Differences of positions are taken in float64, before they are stored in float32.
    Raises `InputError` when not a single window fits.
    """
    found: list[WindowSource] = []
    rows = windows = 0
    for sequence in sequences:
        if sequence.waypoints is not None:
            raise InputError(
                sequence.name, "has waypoints, no poses", "windows need a pose at every sample"
            )
        start = _valid_starts(sequence, config.seen, 1 if shift else stride)
        if start.size:
            part = _source_of(sequence, start, config, stride)
            moved = part.start + np.int32(rows), part.visited + np.int32(windows)
            found.append(part._replace(start=moved[0], visited=moved[1]))
            rows += len(part.imu)
            windows += len(part.start)
    if not found:
        length = f"{config.context_seconds + config.window_seconds:g} s"
        raise InputError("data", f"no window of {length} with a valid reference in any sequence")
    return WindowSource(*(np.concatenate(field) for field in zip(*found, strict=True)))


def _valid_starts(sequence: Sequence, length: int, stride: int) -> Starts:
    """Starts of the windows whose reference is valid throughout and at the sample after them, and
    whose IMU was measured throughout."""
    start = window_starts(len(sequence.time), length, stride)
    start = start[without_any(~sequence.valid, start, length + 1)]
    mask = sequence.imu_valid
    return start if mask is None else start[without_any(~mask, start, length)]


def _source_of(sequence: Sequence, start: Starts, config: DataConfig, stride: int) -> WindowSource:
    """One recording's windows, rows and numbers counted from 0."""
    # An invalid row may hold NaN; no window touches it, so any rotation will do there.
    orientation = np.where(sequence.valid[:, None], sequence.orientation, [1.0, 0.0, 0.0, 0.0])
    attitude = rotations(orientation).as_matrix()
    after_context = start + config.context
    imu, rotation = align_recording(
        sequence.accel, sequence.gyro, attitude, after_context, config.window_rotation
    )
    displacement = true_displacement(orientation, sequence.position, after_context, config.window)
    heading = yaw(attitude[after_context])
    return WindowSource(
        imu=imu,
        start=start.astype(np.int32),
        rotation=rotation,
        displacement=displacement.astype(np.float32),
        step=np.diff(sequence.position, axis=0, append=np.nan).astype(np.float32),
        unyaw=np.column_stack([np.cos(heading), np.sin(heading)]).astype(np.float32),
        visited=np.flatnonzero(start % stride == 0).astype(np.int32),
    )


def gather(source: WindowSource, which: Int[jax.Array, "b"], length: int) -> Windows:
    """Windows number `which` of `source`, each `length` samples, in their own frames. Jittable."""
    start = source.start[which]
    cosine, sine = source.unyaw[which][:, :, None].swapaxes(0, 1)
    # The compiler drops the steps where nobody looks at them.
    x, y, z = jnp.moveaxis(source.step[window_rows(start, length)], -1, 0)
    return Windows(
        imu=cut_windows(source.imu, start, source.rotation[which], length),
        displacement=source.displacement[which],
        steps=jnp.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1),
    )


def shift_windows(
    key: PRNGKeyArray, source: WindowSource, which: Int[jax.Array, "b"], samples: int
) -> Int[jax.Array, "b"]:
    """Numbers of the windows up to `samples` later or earlier than `which`.

    A window stays where the recording has none at the drawn distance.
    """
    if samples == 0:
        return which
    shift = jax.random.randint(key, which.shape, -samples, samples + 1, jnp.int32)
    candidate = jnp.clip(which + shift, 0, source.start.shape[0] - 1)
    in_recording = source.start[candidate] - source.start[which] == shift
    return jnp.where(in_recording, candidate, which)
