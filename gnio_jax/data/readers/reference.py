"""Tracked poses on the clock of an IMU.

Trackers stamp their poses on a clock of their own, at 20 to 120 Hz, with gaps. `poses_at` and
`interpolated` take smooth poses as they are, by splines within unbroken runs. `fused` takes noisy
ones: the gyro carries the attitude, and a smoother the position.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from gnio_jax.data.reference import LONGEST_BRIDGE, fuse_attitude, smooth_positions
from gnio_jax.numerics import (
    integrate_gyro,
    interpolate,
    midpoints,
    neighbours,
    quaternions,
    slerp,
    stretches,
    turns_between,
)
from gnio_jax.types import Sequence

LOST_POSES = 2.5
"""Of a noisy tracker, poses up to this many intervals apart (one is lost) are interpolated; further
apart gyro and smoother bridge."""
LARGEST_JUMP = 0.02
"""m by which a step of the position may contradict the reference's own velocity, and smoothed
positions the seen ones."""
SHORTEST_RUN = 8
"""Poses in a row below which a stretch between gaps is not believed."""
SHORTEST_SPLINE = 4
"""Poses in a row below which straight lines stand in for a spline."""


class Poses(NamedTuple):
    """What a tracker saw, on increasing stamps."""

    time: Float[np.ndarray, " n"]
    """s."""
    attitude: Rotation
    """n rotations, body→world."""
    position: Float[np.ndarray, "n 3"]
    """m."""
    velocity: Float[np.ndarray, "n 3"] | None = None
    """m/s, where the tracker gives one."""


class Reference(NamedTuple):
    """The reference of a sequence, at its stamps; anything where not `valid`."""

    orientation: Float[np.ndarray, "m 4"]
    position: Float[np.ndarray, "m 3"]
    velocity: Float[np.ndarray, "m 3"]
    valid: Bool[np.ndarray, " m"]


def poses_at(
    time: Float[np.ndarray, " m"], poses: Poses, max_gap: float
) -> tuple[Float[np.ndarray, "m 3"], Rotation, Bool[np.ndarray, " m"]]:
    """Positions (m) and attitudes at the increasing stamps `time` (s), and where they can be
    trusted.

    Cubic splines, of attitudes too: at 30 Hz the shorter arc between two of them errs by half a
    degree in a walker's hand. Across gaps longer than `max_gap` (s) and beyond the ends the
    straight line, or the last pose, stands in and is not to be trusted.
    """
    stamps = poses.time
    left, right = neighbours(stamps, time)
    covered = (time >= stamps[0]) & (time <= stamps[-1])
    turned = slerp(time, stamps, poses.attitude).as_quat()
    for run, rows in _runs(time, stamps, np.diff(stamps) > max_gap, SHORTEST_SPLINE):
        # Splines start at 0, or large stamps would cost their coefficients digits.
        own, wanted = stamps[run] - stamps[run.start], time[rows] - stamps[run.start]
        turned[rows] = RotationSpline(own, poses.attitude[run])(wanted).as_quat()
    return (
        splined(time, stamps, poses.position, max_gap),
        Rotation.from_quat(turned),
        (stamps[right] - stamps[left] <= max_gap) & covered,
    )


def splined(
    time: Float[np.ndarray, " m"],
    stamps: Float[np.ndarray, " n"],
    values: Float[np.ndarray, "n w"],
    max_gap: float,
) -> Float[np.ndarray, "m w"]:
    """Cubic splines within runs whose stamps are at most `max_gap` (s) apart. Elsewhere straight
    lines, since a spline would swing, and beyond the ends the outermost values."""
    there = interpolate(time, stamps, values)
    for run, rows in _runs(time, stamps, np.diff(stamps) > max_gap, SHORTEST_SPLINE):
        own, wanted = stamps[run] - stamps[run.start], time[rows] - stamps[run.start]
        there[rows] = CubicSpline(own, values[run], axis=0)(wanted)
    return there


def _runs(
    time: Float[np.ndarray, " m"],
    stamps: Float[np.ndarray, " n"],
    broken: Bool[np.ndarray, " i"],
    shortest: int,
    tolerance: float = 0.0,
) -> Iterator[tuple[slice, slice]]:
    """(rows of `stamps`, rows of `time` within them) of each unbroken run of at least `shortest`
    stamps; `tolerance` (s) widens what counts as within."""
    for run in stretches(broken):
        if run.stop - run.start >= shortest:
            start = np.searchsorted(time, stamps[run.start] - tolerance)
            stop = np.searchsorted(time, stamps[run.stop - 1] + tolerance, side="right")
            if stop > start:
                yield run, slice(int(start), int(stop))


def interpolated(clock: Float[np.ndarray, " m"], poses: Poses, shifted: bool) -> Reference:
    """Smooth poses with velocities at the stamps `clock` (s), by splines within unbroken runs.

    A run ends where the position contradicts the velocity. `shifted`: the poses were moved along a
    lever, so the velocity is another point's and the position's derivative takes its place.
    """
    assert poses.velocity is not None
    stamps, count = poses.time, len(clock)
    orientation, position, velocity = (np.full((count, width), np.nan) for width in (4, 3, 3))
    reference = Reference(orientation, position, velocity, np.zeros(count, dtype=bool))
    steps = np.diff(stamps)
    broken = steps > LONGEST_BRIDGE
    if not shifted:
        moved = midpoints(poses.velocity) * steps[:, None]
        contradiction = np.linalg.norm(np.diff(poses.position, axis=0) - moved, axis=1)
        # Over long steps the trapezium is only a rough integral of the velocity.
        broken |= contradiction > LARGEST_JUMP + 2.0 * steps**2
    for run, rows in _runs(clock, stamps, broken, SHORTEST_RUN, tolerance=1e-6):
        own = stamps[run]
        at = np.clip(clock[rows], own[0], own[-1])
        path = CubicSpline(own, poses.position[run], axis=0)
        turned = RotationSpline(own, poses.attitude[run])
        speed = path.derivative() if shifted else CubicSpline(own, poses.velocity[run], axis=0)
        reference.orientation[rows] = quaternions(turned(at))
        reference.position[rows] = path(at)
        reference.velocity[rows] = speed(at)
        reference.valid[rows] = True
    return reference


def fused(imu: Sequence, step: float, poses: Poses) -> Reference:
    """Noisy poses without velocities at the stamps of `imu`, which are `step` (s) apart: the gyro
    carries the attitude."""
    clock = imu.time
    usual = LOST_POSES * float(np.median(np.diff(poses.time)))
    stamps, attitude, position, _ = _in_runs(poses, usual)
    left, right = neighbours(stamps, clock)
    interval = stamps[right] - stamps[left]
    covered = (clock >= stamps[0] - 1e-6) & (clock <= stamps[-1] + 1e-6)
    measured, bridged = covered & (interval <= usual), covered & (interval <= LONGEST_BRIDGE)

    turned = slerp(clock, stamps, attitude)
    # The gyro's constant bias would bend the correction at its ends.
    gyro = imu.gyro - _gyro_bias(imu.gyro, turned, measured, step)
    orientation, believed = fuse_attitude(integrate_gyro(gyro, step), turned, measured, step)
    inside = np.clip(clock, stamps[0], stamps[-1])
    place, velocity, kept = smooth_positions(
        splined(inside, stamps, position, usual), measured, step
    )
    # Where few poses are left between gaps the smoother may swing; it must stay with what was seen.
    straight = interpolate(clock, stamps, position)
    close = np.linalg.norm(place - straight, axis=1) < LARGEST_JUMP
    valid = np.asarray(bridged & close & (believed & kept | ~measured))
    return Reference(quaternions(orientation), place, velocity, valid)


def _in_runs(poses: Poses, usual: float) -> Poses:
    """The poses that follow each other within `usual` (s): single poses between gaps are those that
    the tracker hardly saw."""
    runs = [
        np.arange(run.start, run.stop)
        for run in stretches(np.diff(poses.time) > usual)
        if run.stop - run.start >= SHORTEST_RUN
    ]
    rows = np.concatenate(runs) if runs else np.arange(len(poses.time))
    return Poses(poses.time[rows], poses.attitude[rows], poses.position[rows])


def _gyro_bias(
    gyro: Float[np.ndarray, "m 3"],
    attitude: Rotation,
    measured: Bool[np.ndarray, " m"],
    step: float,
) -> Float[np.ndarray, "3"]:
    """Median difference of the gyro and the attitude's rate where both ends of an interval were
    measured, rad/s."""
    both = measured[:-1] & measured[1:]
    if not both.any():
        return np.zeros(3)
    return np.median((midpoints(gyro) - turns_between(attitude) / step)[both], axis=0)
