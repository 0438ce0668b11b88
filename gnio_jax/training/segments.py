"""Segments of recordings for training through the filter: their beginnings, their reference, and
the errors of the filter's start.

The recordings are on the device once, end to end, and segments are cut inside the jitted step.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from gnio_jax import geometry
from gnio_jax.config import AugmentConfig
from gnio_jax.errors import InputError
from gnio_jax.filtering import InitialStd
from gnio_jax.numerics import finite_rows, matrix_from_quaternion, spans
from gnio_jax.training.windows import low_pass_margin, random_low_pass
from gnio_jax.types import Array, Sequence

S = TypeVar("S", bound=Any)
"""A source of segments: a tuple of arrays with the fields `earliest` and `latest`."""


class SegmentSource(NamedTuple):
    """All recordings of a split, end to end, and where segments may begin in them. float64."""

    gyro: Float[Array, "t 3"]
    """rad/s, raw."""
    accel: Float[Array, "t 3"]
    """m/s², raw."""
    rotation: Float[Array, "t 3 3"]
    """Reference, body → world. It has arbitrary values where it cannot be trusted, and so have the
    next two fields."""
    velocity: Float[Array, "t 3"]
    """Reference, m/s."""
    position: Float[Array, "t 3"]
    """Reference, m."""
    waypoint: Float[Array, "t 2"]
    """Horizontal position of the waypoint at the nearest sample, m; NaN at all others."""
    tapped: Bool[Array, "t"]
    """Whether the recording has waypoints: its reference is then interpolated between them."""
    earliest: Int[Array, "p"]
    """Earliest first row of each segment of an epoch."""
    latest: Int[Array, "p"]
    """Latest first row of each segment of an epoch."""


class MotionPath(NamedTuple):
    """Motion at K + 1 times: at the start, and at the end of each clone interval."""

    rotation: Float[Array, "k+1 3 3"]
    """Body → world."""
    velocity: Float[Array, "k+1 3"]
    """m/s."""
    position: Float[Array, "k+1 3"]
    """m."""


class Segment(NamedTuple):
    """One segment of K clone intervals of n samples."""

    gyro: Float[Array, "s 3"]
    """rad/s, raw, s = K·n."""
    accel: Float[Array, "s 3"]
    """m/s², raw."""
    truth: MotionPath
    """The reference."""
    waypoint: Float[Array, "s 2"]
    """See `SegmentSource.waypoint`."""
    tapped: Bool[Array, ""]
    """See `SegmentSource.tapped`."""


StartEstimate = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]
"""The filter's first estimates: attitude body → world (3, 3), velocity m/s, position m, gyro bias
rad/s and accelerometer bias m/s² (3,)."""


def segment_source(sequences: Iterable[Sequence], samples: int) -> SegmentSource:
    """The source for recordings (all at one rate) and for segments of `samples` samples.

    A segment needs a trusted reference at each of its samples and at the one after them. A stretch
    of such samples has as many segments as fit in it side by side. They may overlap: segment j of m
    begins anywhere in the j-th of m equal shares of the rows at which a segment can begin. So an
    epoch leaves out a tenth to a sixth of a long stretch, and all epochs together visit it alike,
    but for a segment's length at its ends, which they visit less. Raises `InputError` if no segment
    fits.
    """
    parts = [_source_of(sequence, samples) for sequence in sequences]
    parts = [part for part in parts if part.earliest.size]
    if not parts:
        problem = f"no segment of {samples} samples has a valid reference in any sequence"
        raise InputError("data", problem, "lower through_filter.piece_seconds")
    return join_segments(parts)


def join_segments(sources: list[S]) -> S:
    """The recordings of all sources of segments, one source after the other, as host arrays. The
    first field of a source has a row for each sample."""
    parts: list[S] = []
    rows = 0
    for source in sources:
        earliest, latest = source.earliest + np.int32(rows), source.latest + np.int32(rows)
        parts.append(source._replace(earliest=earliest, latest=latest))
        rows += len(source[0])
    return jax.tree.map(lambda *fields: np.concatenate(fields), *parts)


def segment_shares(
    stretches: Int[np.ndarray, "n 2"], samples: int
) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    """Earliest and latest first row of each segment (`segment_source`) in stretches of rows, each
    from its first row up to its end."""
    shares = [np.zeros((2, 0), np.int64)]
    for first, end in stretches:
        count = (end - first - 1) // samples
        if count >= 1:
            bounds = first + (np.arange(count + 1) * (end - first - samples)) // count
            shares.append(np.stack([bounds[:-1], bounds[1:] - 1]))
    earliest, latest = np.concatenate(shares, axis=1).astype(np.int32)
    return earliest, latest


def _source_of(sequence: Sequence, samples: int) -> SegmentSource:
    """One recording's segments, rows counted from 0."""
    trusted = sequence.valid & finite_rows(sequence.velocity)
    if sequence.imu_valid is not None:  # not from samples that are interpolated across a gap
        trusted = trusted & sequence.imu_valid
    earliest, latest = segment_shares(spans(trusted), samples)
    orientation = np.where(trusted[:, None], sequence.orientation, [1.0, 0.0, 0.0, 0.0])
    waypoint = np.full((len(trusted), 2), np.nan)
    if sequence.waypoints is not None:
        step = sequence.time[1] - sequence.time[0]
        rows = np.rint((sequence.waypoints.time - sequence.time[0]) / step).astype(int)
        waypoint[np.clip(rows, 0, len(trusted) - 1)] = sequence.waypoints.position
    return SegmentSource(
        gyro=sequence.gyro,
        accel=sequence.accel,
        rotation=matrix_from_quaternion(orientation),
        velocity=sequence.velocity,
        position=sequence.position,
        waypoint=waypoint,
        tapped=np.full(len(trusted), sequence.waypoints is not None),
        earliest=earliest,
        latest=latest,
    )


def random_starts(key: PRNGKeyArray, source: SegmentSource) -> Int[jax.Array, "p"]:
    """First rows of the segments of an epoch, in random order; a function of `key` alone."""
    where_key, order_key = jax.random.split(key)
    earliest, latest = jnp.asarray(source.earliest), jnp.asarray(source.latest)
    starts = jax.random.randint(where_key, earliest.shape, earliest, latest + 1, jnp.int32)
    return jax.random.permutation(order_key, starts)


def cut_segment(
    source: SegmentSource, start: Int[jax.Array, ""], intervals: int, stride: int
) -> Segment:
    """The segment of `intervals` clone intervals of `stride` samples that begins at row `start`.
    Jittable."""
    samples = intervals * stride

    def at_clones(signal: Array) -> jax.Array:
        rows = jax.lax.dynamic_slice_in_dim(signal, start, samples + 1)
        return rows[::stride]

    gyro, accel, waypoint = (
        jax.lax.dynamic_slice_in_dim(signal, start, samples)
        for signal in (source.gyro, source.accel, source.waypoint)
    )
    truth = (at_clones(signal) for signal in (source.rotation, source.velocity, source.position))
    return Segment(gyro, accel, MotionPath(*truth), waypoint, jnp.asarray(source.tapped)[start])


def turn_segment(segment: Segment, angle: Float[jax.Array, ""]) -> Segment:
    """The segment as if it had been walked in a world turned by `angle` (rad) about the vertical.
    The IMU's samples are the same. Jittable."""
    turn = geometry.exp(jnp.stack([jnp.zeros_like(angle), jnp.zeros_like(angle), angle]))
    rotation, velocity, position = segment.truth
    truth = MotionPath(
        jnp.einsum("ij,kjl->kil", turn, rotation), velocity @ turn.T, position @ turn.T
    )
    return segment._replace(truth=truth, waypoint=segment.waypoint @ turn[:2, :2].T)


def low_pass_segments(
    key: PRNGKeyArray, segments: Segment, config: AugmentConfig, rate: float
) -> Segment:
    """A batch of segments of which a random share is low-passed (`windows.random_low_pass`).

    Network and filter see a slower sensor; the low-pass is in the body's frame. Beyond its ends a
    segment continues with its first and last sample. Jittable.
    """
    margin = low_pass_margin(config, rate)
    if not margin:
        return segments
    imu = jnp.concatenate([segments.accel, segments.gyro], axis=2)
    imu = jnp.pad(imu, ((0, 0), (margin, margin), (0, 0)), "edge")
    imu = random_low_pass(key, imu, config, rate)[:, margin:-margin]
    return segments._replace(accel=imu[:, :, :3], gyro=imu[:, :, 3:])


def draw_start(
    key: PRNGKeyArray, truth: MotionPath, std: InitialStd, spread: float
) -> StartEstimate:
    """First estimates with errors drawn from `spread` times `std`, from the truth and from zero
    biases. The attitude is exp(θ) R, with θ in the world frame. Jittable."""
    draws = spread * jax.random.normal(key, (5, 3), jnp.float64)
    tilt_tilt_yaw = jnp.stack([jnp.asarray(angle) for angle in (std.tilt, std.tilt, std.yaw)])
    return (
        geometry.matmul(geometry.exp(tilt_tilt_yaw * draws[0]), truth.rotation[0]),
        truth.velocity[0] + std.velocity * draws[1],
        truth.position[0] + std.position * draws[2],
        std.gyro_bias * draws[3],
        std.accel_bias * draws[4],
    )
