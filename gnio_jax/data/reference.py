"""Tracked poses on the clock of an IMU.

Trackers stamp their poses on a clock of their own, at 4 to 200 Hz, with gaps and jumps. Smooth
poses are interpolated by splines; if they have no velocity, it is that of the smoothed positions.
For noisy poses the attitude is carried by the gyro, and the position is smoothed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gnio_jax.data.resampling import covered_at, interpolate_splines, runs_within
from gnio_jax.numerics import (
    integrate_gyro,
    interpolate,
    midpoints,
    quaternions,
    rotations,
    slerp,
    stretches,
    turns_between,
    within,
)

LONGEST_BRIDGE = 0.1
"""Largest time between two poses for which the reference between them can be trusted, s."""
LOST_POSES = 2.5
"""Poses up to this many intervals apart (one is lost) are interpolated, at any rate. Longer gaps of
a noisy tracker are bridged by gyro and smoother."""
SHORTEST_RUN = 8
"""Smallest number of successive poses for which a stretch between gaps is used."""
LARGEST_JUMP = 0.02
"""Largest difference of a step of the position from the reference's own velocity, and of smoothed
positions from the measured ones, m."""
JUMP_MARGIN = 0.1
"""Time around a jump of the position that is not used, s."""
COURSE_SECONDS, FLIP_DEGREES, CORRECTION_SECONDS = 3.0, 15.0, 0.3
"""Filter (standard deviation, s) of the correction's median, distance from it beyond which a sample
is a flip of the tracker, and filter of the other samples."""


class Poses(NamedTuple):
    """Tracked poses in a z-up world, on increasing stamps of their own."""

    time: Float[np.ndarray, " n"]
    """s."""
    attitude: Rotation
    """n rotations, IMU body → world, as `numerics.rotations` makes them of quaternions wxyz."""
    position: Float[np.ndarray, "n 3"]
    """Position of the tracked point, m."""
    velocity: Float[np.ndarray, "n 3"] | None = None
    """Velocity of the tracked point, m/s; None: the tracker gives none."""
    lever: Float[np.ndarray, "3"] = np.zeros(3)
    """Vector from the tracked point to the IMU, in the IMU's body, m."""
    noisy: bool = False
    """True for a raw tracker with flips, single jumps, and noise that differences would amplify."""
    ends_pieces: bool = False
    """True for odometry that may continue in another world after a loss, so that a loss divides a
    recording."""
    source: str = ""
    """File, for messages."""

    def rows(self, rows: np.ndarray | slice) -> Poses:
        """The poses in some rows."""
        velocity = None if self.velocity is None else self.velocity[rows]
        position, attitude = self.position[rows], self.attitude[rows]
        return self._replace(
            time=self.time[rows], attitude=attitude, position=position, velocity=velocity
        )


class Reference(NamedTuple):
    """The reference of a sequence, at its stamps; its values are arbitrary where it is not
    `valid`."""

    orientation: Float[np.ndarray, "m 4"]
    position: Float[np.ndarray, "m 3"]
    velocity: Float[np.ndarray, "m 3"]
    valid: Bool[np.ndarray, " m"]

    @classmethod
    def none(cls, count: int) -> Reference:
        """The reference of `count` stamps without poses."""
        nothing = np.full((count, 4), np.nan)
        return cls(nothing, nothing[:, 1:], nothing[:, 1:], np.zeros(count, dtype=bool))


def reference_at(
    clock: Float[np.ndarray, " m"],
    gyro: Float[np.ndarray, "m 3"],
    poses: Poses,
    max_speed: float = np.inf,
    max_drift: float = np.inf,
) -> Reference:
    """The poses of the IMU at the uniform stamps `clock` (s); `gyro` (rad/s) has its samples.

    They are not valid across gaps, where poses without a velocity have steps faster than
    `max_speed` (m/s), and where the velocity, integrated over a second, differs from the position
    by more than `max_drift` (m).
    """
    return (
        _fuse_reference(clock, gyro, poses)
        if poses.noisy
        else _spline_reference(clock, poses, max_speed, max_drift)
    )


def _spline_reference(
    clock: Float[np.ndarray, " m"], poses: Poses, max_speed: float, max_drift: float
) -> Reference:
    """Splines within unbroken runs. A run also ends where the position contradicts the velocity,
    because the motion between two such poses is not known."""
    stamps, step = poses.time, float(np.median(np.diff(clock)))
    steps = np.diff(stamps)
    broken = steps > longest_trusted(stamps)
    parts = [one_sign(quaternions(poses.attitude)), poses.position]
    if poses.velocity is not None:
        parts.append(poses.velocity)
        integrated = midpoints(poses.velocity) * steps[:, None]
        contradiction = np.linalg.norm(np.diff(poses.position, axis=0) - integrated, axis=1)
        # Over long steps the trapezoidal rule is only a rough integral of the velocity.
        broken |= contradiction > LARGEST_JUMP + 2.0 * steps**2
    # Attitudes are interpolated by splines too: at 30 Hz the shorter arc between two of them has an
    # error of half a degree in a walker's hand. There a spline of quaternions is as accurate as one
    # of rotations.
    values = interpolate_splines(stamps, np.concatenate(parts, axis=1), clock, broken)
    orientation, position, velocity = np.split(values, [4, 7], axis=1)
    orientation = orientation / np.linalg.norm(orientation, axis=1, keepdims=True)
    valid = np.zeros(len(clock), dtype=bool)
    for _, rows in runs_within(stamps, broken, clock, SHORTEST_RUN):
        valid[rows] = True
    if poses.lever.any():
        arm = rotations(orientation).apply(poses.lever)
        position = position + arm
        if poses.velocity is not None:
            velocity = velocity + np.gradient(arm, step, axis=0, edge_order=2)
    if poses.velocity is None:
        fast = np.linalg.norm(np.diff(position, axis=0), axis=1) > max_speed * step
        jumps = np.concatenate([fast, [False]]) | np.concatenate([[False], fast])
        valid &= ~within(jumps, max(round(JUMP_MARGIN / step), 1))
        _, velocity, _ = smooth_positions(position, valid, step)
    elif np.isfinite(max_drift):
        valid &= ~_drifts(position, velocity, step, max_drift)
    return Reference(orientation, position, velocity, valid)


def _drifts(
    position: Float[np.ndarray, "m 3"], velocity: Float[np.ndarray, "m 3"], step: float, most: float
) -> Bool[np.ndarray, " m"]:
    """True in every second in which position and integrated velocity differ by more than `most`
    (m), for example where a satellite receiver corrects itself by jumps."""
    second = round(1.0 / step)
    integrated = np.cumsum(midpoints(velocity) * step, axis=0)
    error = position - np.concatenate([np.zeros((1, 3)), integrated])
    drifting = np.linalg.norm(error[second:] - error[:-second], axis=1) > most
    middle = np.zeros(len(position), dtype=bool)
    middle[second // 2 : second // 2 + len(drifting)] = drifting
    return within(middle, second // 2)


def _fuse_reference(
    clock: Float[np.ndarray, " m"], gyro: Float[np.ndarray, "m 3"], poses: Poses
) -> Reference:
    """The reference with the attitude carried by the gyro between the tracker's, and with smoothed
    positions."""
    usual, step = LOST_POSES * float(np.median(np.diff(poses.time))), float(clock[1] - clock[0])
    bridge = longest_trusted(poses.time)
    # Single poses between gaps are unreliable.
    runs = stretches(np.diff(poses.time) > usual)
    rows = [np.arange(run.start, run.stop) for run in runs if run.stop - run.start >= SHORTEST_RUN]
    poses = poses.rows(np.concatenate(rows)) if rows else poses
    stamps, unknown = poses.time, Reference.none(len(clock))
    measured = covered_at(stamps, clock, usual)
    if measured.sum() < SHORTEST_RUN:
        return unknown
    tracked = slerp(clock, stamps, poses.attitude)
    # The gyro's constant bias would distort the correction at its ends.
    adjacent = measured[:-1] & measured[1:]
    drift = (midpoints(gyro) - turns_between(tracked) / step)[adjacent]
    rate = gyro - np.median(drift, axis=0) if len(drift) else gyro
    fused, trusted = fuse_attitude(integrate_gyro(rate, step), tracked, measured, step)
    arm = fused.apply(poses.lever)
    position = interpolate_splines(stamps, poses.position, clock, np.diff(stamps) > usual) + arm
    smoothed, velocity, used = smooth_positions(position, measured & trusted, step)
    # A pose that the smoother rejects is bridged like a lost one. If few poses are left between
    # gaps, the smoother may oscillate; its result must stay near the measured poses.
    rows = np.flatnonzero(used)
    if len(rows) < SHORTEST_RUN:
        return unknown
    close = np.linalg.norm(smoothed - interpolate(clock, clock[rows], position[rows]), axis=1)
    gap = bridge + 2.0 * step  # between rows of the clock that are beside the poses
    bridged = covered_at(clock[rows], clock, gap) & covered_at(stamps, clock, bridge)
    return Reference(quaternions(fused), smoothed, velocity, bridged & (close < LARGEST_JUMP))


def longest_trusted(stamps: Float[np.ndarray, " n"]) -> float:
    """Largest time between two poses for which the poses between them can be trusted, s."""
    return max(LONGEST_BRIDGE, LOST_POSES * float(np.median(np.diff(stamps))))


# --- attitude from a gyro whose slow drift a tracker corrects


def fuse_attitude(
    integrated: Rotation,
    measured: Rotation,
    usable: Bool[np.ndarray, " n"],
    step: float,
) -> tuple[Rotation, Bool[np.ndarray, " n"]]:
    """Integrated attitude times a smooth correction towards the measured one, and where the
    measured one was used.

    The correction measured · integrated⁻¹ changes as slowly as the gyro's bias. Samples more than
    15° from its median (σ 3 s) are flips of the tracker. The others are smoothed over 0.3 s (σ),
    with weights that decrease with the residual. Where nothing was measured the correction is
    interpolated, so that the gyro bridges the gap.
    """
    correction = quaternions(measured * integrated.inv())
    correction[usable] = one_sign(correction[usable])
    rows = np.arange(len(usable))

    def interpolate_over(trusted: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "n 4"]:
        return interpolate(rows, np.flatnonzero(trusted), correction[trusted])

    course, trusted = interpolate_over(usable), usable
    for flip, sigma, least in [
        *[(np.radians(FLIP_DEGREES), COURSE_SECONDS / step, np.radians(1.0))] * 4,
        *[(np.pi, CORRECTION_SECONDS / step, np.radians(0.3))] * 3,
    ]:
        correction *= np.where((correction * course).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        angle = 2.0 * np.arccos(np.clip((correction * course).sum(axis=1), -1.0, 1.0))
        # Flips remain flips in later rounds; a median that rejects four fifths of all samples is
        # not used.
        near = (usable if flip < np.pi else trusted) & (angle < flip)
        trusted = near if near.sum() > 0.2 * usable.sum() else usable
        scale = max(3.0 * float(np.median(angle[trusted])), least)
        weight = np.where(trusted, 1.0 / (1.0 + (angle / scale) ** 2) ** 2, 1.0)[:, None]
        course = gaussian_filter1d(
            weight * interpolate_over(trusted), sigma, axis=0, mode="nearest"
        )
        course /= np.linalg.norm(course, axis=1, keepdims=True)
    return rotations(course) * integrated, trusted


def one_sign(wxyz: Float[np.ndarray, "m 4"]) -> Float[np.ndarray, "m 4"]:
    """The same rotations, with signs such that neighbours are near each other: q and −q are the
    same rotation."""
    opposite = (wxyz[1:] * wxyz[:-1]).sum(axis=1) < 0
    return wxyz * np.cumprod(np.concatenate([[1.0], np.where(opposite, -1.0, 1.0)]))[:, None]


# --- positions and velocities of a noisy tracker


def smooth_positions(
    position: Float[np.ndarray, "n 3"],
    usable: Bool[np.ndarray, " n"],
    step: float,
    cutoff: float = 12.0,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Positions (m), velocities (m/s) and which measurements were used.

    The positions minimise Σ w |p − z|² + λ Σ |Δ³p|² (Whittaker's smoother). The response is one
    half at `cutoff` Hz, which is at most a quarter of the rate, and it is 1 to 0.1 % below a third
    of `cutoff`. Weights decrease with the residual, which removes single jumps. Where nothing was
    measured the smoother bridges with the smoothest acceleration.
    """
    if not usable.any():
        return np.zeros_like(position), np.zeros_like(position), usable
    cutoff = min(cutoff, 0.25 / step)
    # Δ³ᵀΔ³ in SciPy's upper banded form: bands[3 − d, j] couples j and j − d.
    stencil, count = np.array([-1.0, 3.0, -3.0, 1.0]), len(position)
    smoothness = np.zeros((4, count))
    for a in range(4):
        for b in range(a, 4):
            smoothness[3 - (b - a), b : count - 3 + b] += stencil[a] * stencil[b]
    stiffness = (2.0 * np.sin(np.pi * cutoff * step)) ** -6
    smoothness *= stiffness
    # The rounding errors of the solution grow with the distance from the origin: with 1000 km and
    # 500 Hz they would be hundreds of metres.
    origin = position[usable].mean(axis=0)
    filled = np.where(usable[:, None], position - origin, 0.0)
    # Where nothing was measured a straight line counts a little, so that the system can be solved
    # in double precision at any rate. Its largest eigenvalue is 64 times the stiffness.
    little = max(1e-9, 100 * np.finfo(float).eps * 64 * stiffness)
    rows = np.arange(count)
    line = interpolate(rows, rows[usable], filled[usable])
    weight = usable.astype(float)
    smoothed = filled
    for _ in range(5):
        system = smoothness.copy()
        system[-1] += weight + little  # the diagonal
        smoothed = solveh_banded(system, weight[:, None] * filled + little * line)
        distance = np.linalg.norm(filled - smoothed, axis=1)
        scale = max(4.0 * float(np.median(distance[usable])), 2e-3)
        weight = usable / (1.0 + (distance / scale) ** 2) ** 2
    velocity = np.gradient(smoothed, step, axis=0, edge_order=2)
    return smoothed + origin, velocity, usable & (weight > 0.1)
