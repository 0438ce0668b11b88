"""Segments of walks for networks with memory: samples in the world by the attitude of the
reference, and their random changes.

The recordings are on the device once, end to end. Segments are cut, changed and turned inside the
jitted step, in float32.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from gnio_jax import geometry
from gnio_jax.config import AugmentConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.numerics import finite_rows, matrix_from_quaternion, spans
from gnio_jax.training.segments import join_segments, segment_shares
from gnio_jax.training.walkway import Pace, SlowMotion, change_pace, draw_pace, slow_motion
from gnio_jax.training.windows import (
    hide_axes,
    low_pass_margin,
    mirror_channels,
    on_samples,
    random_low_pass,
    random_mirror,
    random_rocking,
    signals_at_rest,
)
from gnio_jax.types import GRAVITY, Array, Sequence
from gnio_jax.windows import WINDOW_CUTS, rotate_channels, rotate_vectors


class WalkSource(NamedTuple):
    """All recordings of a split, end to end, and where segments may begin in them. float32."""

    imu: Float[Array, "t 6"]
    """[accel m/s², gyro rad/s] in the world."""
    rotation: Float[Array, "t 3 3"]
    """Reference, body → world. It has arbitrary values where it cannot be trusted."""
    position: Float[Array, "t 3"]
    """Reference, from the first position of its stretch, m; zero where it cannot be trusted."""
    slow: SlowMotion
    earliest: Int[Array, "p"]
    """Earliest first row of each segment of an epoch."""
    latest: Int[Array, "p"]
    """Latest first row of each segment of an epoch."""


class WalkSegments(NamedTuple):
    """A batch of segments of k clone intervals of n samples, s = k n, in a frame with gravity on
    z."""

    signals: Float[Array, "b s c"]
    """[accel m/s², gyro rad/s], and the x and y axes of the body after them if the network sees
    these."""
    displacement: Float[Array, "b m 3"]
    """Displacement over the window that ends with interval W − 1, W, ..., k − 1, m."""
    moved: Float[Array, "b m"]
    """Length of the slow horizontal path of each such window, m."""


def walk_source(sequences: Iterable[Sequence], config: TrainConfig, training: bool) -> WalkSource:
    """The source for recordings at one rate. Training may stretch the time of a segment, so it
    needs more samples. Raises `InputError` if no segment fits."""
    samples = round(config.segments.seconds * config.data.rate)
    if training:
        margin = low_pass_margin(config.augment, config.data.rate)
        samples = math.ceil((samples + 2 * margin) * config.augment.time_stretch[1]) + 1
    parts = [_source_of(sequence, samples, config.data.rate) for sequence in sequences]
    parts = [part for part in parts if part.earliest.size]
    if not parts:
        problem = f"no segment of {config.segments.seconds:g} s has a valid reference"
        raise InputError("data", f"{problem} in any sequence", "lower segments.seconds")
    return join_segments(parts)


def _source_of(sequence: Sequence, samples: int, rate: float) -> WalkSource:
    """One recording's segments, rows counted from 0."""
    usable = sequence.valid & finite_rows(sequence.position)
    if sequence.imu_valid is not None:  # not from samples that are interpolated across a gap
        usable = usable & sequence.imu_valid
    position, stretches = np.zeros_like(sequence.position), spans(usable)
    for first, end in stretches:
        position[first:end] = sequence.position[first:end] - sequence.position[first]
    earliest, latest = segment_shares(stretches, samples)
    orientation = np.where(usable[:, None], sequence.orientation, [1.0, 0.0, 0.0, 0.0])
    rotation = matrix_from_quaternion(orientation)
    vectors = rotation @ np.stack([sequence.accel, sequence.gyro], axis=2)
    imu = vectors.transpose(0, 2, 1).reshape(-1, 6)
    slow = slow_motion(position, usable, rate)
    rows = (np.where(usable[:, None], imu, 0.0), rotation, position)
    return WalkSource(
        *(array.astype(np.float32) for array in rows),
        slow=SlowMotion(*(array.astype(np.float32) for array in slow)),
        earliest=earliest,
        latest=latest,
    )


class SegmentGrid(NamedTuple):
    """How a segment is divided."""

    stride: int
    """Samples n in a clone interval."""
    intervals: int
    """Clone intervals in the segment."""
    window: int
    """Clone intervals W in a window."""
    rate: float
    """Hz"""
    window_rotation: str = "per_sample"
    """With "body_axes" the signals have the x and y axes of the body after them, with "hidden_axes"
    zeros (`data.window_rotation`)."""

    @property
    def samples(self) -> int:
        """Samples in the segment."""
        return self.stride * self.intervals

    @property
    def predictions(self) -> int:
        """Windows that end with a clone interval of the segment."""
        return self.intervals - self.window + 1


def grid_of(config: TrainConfig) -> SegmentGrid:
    """The grid of an experiment."""
    data = config.data
    intervals = round(config.segments.seconds / data.stride_seconds)
    return SegmentGrid(
        data.stride, intervals, data.window // data.stride, data.rate, data.window_rotation
    )


def cut_walks(
    source: WalkSource,
    rows: Int[jax.Array, "b"],
    pace: Pace,
    grid: SegmentGrid,
    config: AugmentConfig | None = None,
    key: PRNGKeyArray | None = None,
) -> WalkSegments:
    """The segments that begin at these rows, at this pace. Without `config` their frame has the yaw
    of their first attitude; with it the sensors' errors and the frame's yaw are drawn from `key`.
    Jittable."""
    margin = 0 if config is None else low_pass_margin(config, grid.rate)
    samples = grid.samples
    # Sample j of a segment and its margins is the recording at row + τ j, between two samples.
    count = samples + 2 * margin + 1
    row_offset = pace.stretch[:, None] * jnp.arange(count, dtype=jnp.float32)[None, :]
    before = jnp.floor(row_offset).astype(jnp.int32)
    # A segment may end at the last row of all, which has none after it.
    index = jnp.clip(rows[:, None] + before, 0, len(source.imu) - 2)
    share = (row_offset - (index - rows[:, None]))[:, :, None]

    def interpolate(signal: Array) -> jax.Array:
        signal = jnp.asarray(signal)
        return signal[index] + share * (signal[index + 1] - signal[index])

    tau = pace.stretch[:, None, None]
    imu = interpolate(source.imu)
    slow = SlowMotion(interpolate(source.slow.position), tau**2 * interpolate(source.slow.accel))
    gravity = jnp.array([[[0, 0, GRAVITY]]], jnp.float32)
    accel = gravity + tau**2 * (imu[..., :3] - gravity)
    accel, position = change_pace(accel, interpolate(source.position), slow, pace)
    imu = jnp.concatenate([accel, tau * imu[..., 3:]], axis=2)
    rotation = jnp.asarray(source.rotation)[index]
    cut = WINDOW_CUTS[grid.window_rotation]
    if cut.body_axes:
        axes = rotation[:, :, :, :2].swapaxes(2, 3).reshape(*imu.shape)
        imu = jnp.concatenate([imu, jnp.zeros_like(axes) if cut.hidden else axes], axis=2)
        if config is not None and config.hidden_axes_share:
            imu = hide_axes(jax.random.fold_in(key, 6), imu, config.hidden_axes_share)
    inner = slice(margin, margin + samples)
    ends = slice(margin, margin + samples + 1, grid.stride)
    drift = jnp.zeros((len(rows), grid.intervals + 1), jnp.float32)
    mirror = jnp.ones((len(rows), 3), jnp.float32)
    if config is None:
        x, y = jax.vmap(geometry.yaw_direction)(rotation[:, margin])
        turn = jax.vmap(lambda x, y: geometry.heading_rotation(x, -y))(x, y)
    else:
        assert key is not None
        keys = jax.random.split(key, 6)
        pass_key, error_key, yaw_key, rest_key, rocking_key, mirror_key = keys
        if margin:
            imu = random_low_pass(pass_key, imu, config, grid.rate)
        imu = random_rocking(rocking_key, imu, config.rocking_share)
        if config.mirror_share:
            mirror = random_mirror(mirror_key, len(rows), config.mirror_share)
            imu = mirror_channels(mirror, imu)
            rotation = mirror[:, None, :, None] * rotation * mirror[:, None, None, :]
        imu, rates = with_errors(error_key, imu, rotation, config)
        drift = jnp.cumsum(rates[:, inner], axis=1)[:, grid.stride - 1 :: grid.stride] / grid.rate
        drift = jnp.pad(drift, ((0, 0), (1, 0)))
        angle = jnp.zeros(len(rows), jnp.float32)
        if config.yaw:
            bounds = jnp.float32(0), jnp.float32(2 * math.pi)
            angle = jax.random.uniform(yaw_key, (len(rows),), jnp.float32, *bounds)
        turn = jax.vmap(geometry.rotation_z)(angle)
    position, path = position[:, ends], slow.position[:, ends, :2] * pace.walkway[:, None, None]
    steps = jnp.sqrt(jnp.sum(jnp.diff(path, axis=1) ** 2, axis=2))
    length = jnp.pad(jnp.cumsum(steps, axis=1), ((0, 0), (1, 0)))
    moved = length[:, grid.window :] - length[:, : -grid.window]
    displacement = position[:, grid.window :] - position[:, : -grid.window]
    displacement = displacement * mirror[:, None]
    displacement = rotate_vectors(turn, displacement[:, :, None])[:, :, 0]
    displacement = turn_rows(displacement, drift[:, : -grid.window])
    signals = rotate_channels(turn, imu[:, inner])
    if config is not None:
        # The frame drifts with what the gyro shows too much (`models.memory`).
        angle = jnp.repeat(drift[:, :-1], grid.stride, axis=1)[:, :, None]
        vectors = turn_rows(signals.reshape(*signals.shape[:2], -1, 3), angle)
        signals = vectors.reshape(signals.shape)
    segments = WalkSegments(signals, displacement, moved)
    if config is not None and config.rest_share:
        segments = at_rest(rest_key, segments, config.rest_share)
    return segments


def with_errors(
    key: PRNGKeyArray,
    imu: Float[jax.Array, "b s c"],
    rotation: Float[jax.Array, "b s 3 3"],
    config: AugmentConfig,
) -> tuple[Float[jax.Array, "b s c"], Float[jax.Array, "b s"]]:
    """Samples in the world, with errors of the sensors that are constant in the body over a segment
    (scale and bias), white noise, and an error of gravity's direction, which the body's axes have,
    too; and the rate at which a heading that is integrated from these samples drifts, rad/s.
    Half-widths are those of `windows.augment`."""
    bias_key, scale_key, noise_key, axis_key, angle_key = jax.random.split(key, 5)
    count, true_rate = len(imu), imu[..., 5]

    def uniform(key: PRNGKeyArray, shape: tuple[int, ...]) -> jax.Array:
        return jax.random.uniform(key, shape, jnp.float32, jnp.float32(-1), jnp.float32(1))

    if any(config.scale):
        error = uniform(scale_key, (count, 1, 2)) * jnp.array([[config.scale[::-1]]], jnp.float32)
        imu = on_samples(imu, lambda x: x * (1 + jnp.repeat(error, 3, axis=2)))
    if config.gyro_bias or config.accel_bias:
        width = jnp.array([[config.accel_bias], [config.gyro_bias]], jnp.float32)
        bias = uniform(bias_key, (count, 2, 3)) * width[None]
        in_world = jnp.einsum("bsij,bkj->bski", rotation, bias)
        imu = on_samples(imu, lambda x: x + in_world.reshape(count, -1, 6))
    drift = imu[..., 5] - true_rate
    if config.tilt_degrees:
        heading = jnp.pi * uniform(axis_key, (count,))
        angle = math.radians(config.tilt_degrees) * uniform(angle_key, (count,))
        axis = jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)], axis=1)
        imu = rotate_channels(jax.vmap(geometry.exp)(angle[:, None] * axis), imu)
    if any(config.noise):
        std = jnp.repeat(jnp.array(config.noise[::-1], jnp.float32), 3)[None, None]
        noise = jax.random.normal(noise_key, (*imu.shape[:2], 6), jnp.float32)
        imu = on_samples(imu, lambda x: x + std * noise)
    return imu, drift


def turn_rows(
    vectors: Float[jax.Array, "b m *k 3"], angle: Float[jax.Array, "b m *l"]
) -> Float[jax.Array, "b m *k 3"]:
    """Vectors turned about z, each by its own angle, rad. The angles may have length 1 where the
    vectors have k."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    x, y, z = jnp.moveaxis(vectors, -1, 0)
    return jnp.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)


def at_rest(key: PRNGKeyArray, segments: WalkSegments, share: float) -> WalkSegments:
    """The segments, a random share of them replaced by those of a phone at rest."""
    signals, displacement, moved = segments
    lies = jax.random.bernoulli(key, jnp.float32(share), (len(signals), 1, 1))
    return WalkSegments(
        jnp.where(lies, signals_at_rest(signals), signals),
        jnp.where(lies, 0, displacement),
        jnp.where(lies[..., 0], 0, moved),
    )


def draw_walks(
    key: PRNGKeyArray,
    source: WalkSource,
    rows: Int[jax.Array, "b"],
    grid: SegmentGrid,
    config: AugmentConfig,
) -> WalkSegments:
    """The segments that begin at these rows, with all random changes that `config` switches on."""
    pace_key, other_key = jax.random.split(key)
    pace = draw_pace(pace_key, len(rows), config)
    return cut_walks(source, rows, pace, grid, config, other_key)
