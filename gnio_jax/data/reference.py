"""Tracked poses on the clock of an IMU.

Trackers stamp their poses on a clock of their own, at 4 to 200 Hz, with gaps and jumps. Poses that
come with a velocity follow splines, and so do smooth poses without one, whose velocity is that of
their smoothed positions. Of noisy poses the gyro carries the attitude, and a smoother the position.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from gnio_jax.data.resampling import known_at, runs_within, slerped, splined
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
"""s between two poses up to which the reference between them can be trusted."""
LOST_POSES = 2.5
"""Poses up to this many intervals apart (one is lost) are interpolated, however slow they come;
further apart gyro and smoother bridge those of a noisy tracker."""
SHORTEST_RUN = 8
"""Poses in a row below which a stretch between gaps is not believed."""
LARGEST_JUMP = 0.02
"""m by which a step of the position may contradict the reference's own velocity, and smoothed
positions the seen ones."""
JUMP_MARGIN = 0.1
"""s around a jump of the position that are not believed."""
COURSE_SECONDS, FLIP_DEGREES = 3.0, 15.0
"""Filter (standard deviation, s) of the correction's median course, and how far off it a sample
is a flip of the tracker."""


class Poses(NamedTuple):
    """Tracked poses in a z-up world, on increasing stamps of their own."""

    time: Float[np.ndarray, " n"]
    """s."""
    attitude: Rotation
    """n rotations, IMU body → world."""
    position: Float[np.ndarray, "n 3"]
    """Of the tracked point, m."""
    velocity: Float[np.ndarray, "n 3"] | None = None
    """Of the tracked point, m/s; None: the tracker gives none."""
    lever: Float[np.ndarray, "3"] = np.zeros(3)
    """From the tracked point to the IMU, in the IMU's body, m."""
    noisy: bool = False
    """A raw tracker: flips, single jumps, and noise that differences would amplify."""
    ends_pieces: bool = False
    """Odometry that may return in another world after a loss: such a loss divides a recording."""
    source: str = ""
    """File, for messages."""


class Reference(NamedTuple):
    """The reference of a sequence, at its stamps; anything where not `valid`."""

    orientation: Float[np.ndarray, "m 4"]
    position: Float[np.ndarray, "m 3"]
    velocity: Float[np.ndarray, "m 3"]
    valid: Bool[np.ndarray, " m"]


def reference_at(
    clock: Float[np.ndarray, " m"],
    gyro: Float[np.ndarray, "m 3"],
    poses: Poses,
    max_speed: float = np.inf,
    max_drift: float = np.inf,
) -> Reference:
    """The poses of the IMU at the uniform stamps `clock` (s), `gyro` (rad/s) being its samples.

    Not valid across gaps, where poses without a velocity step faster than `max_speed` (m/s), and
    where the velocity, integrated over a second, is off the position by more than `max_drift` (m).
    """
    if poses.velocity is not None:
        return _with_velocity(clock, poses, max_drift)
    return _fused(clock, gyro, poses) if poses.noisy else _smooth(clock, poses, max_speed)


def _with_velocity(clock: Float[np.ndarray, " m"], poses: Poses, max_drift: float) -> Reference:
    """Splines within unbroken runs. A run ends where the position contradicts the velocity, since
    nothing is known between two such poses."""
    stamps, speed = poses.time, poses.velocity
    assert speed is not None
    steps, same = np.diff(stamps), _same(stamps, clock)
    broken = steps > _longest(stamps)
    if not same:
        moved = midpoints(speed) * steps[:, None]
        contradiction = np.linalg.norm(np.diff(poses.position, axis=0) - moved, axis=1)
        # Over long steps the trapezium is only a rough integral of the velocity.
        broken |= contradiction > LARGEST_JUMP + 2.0 * steps**2
    orientation, position, velocity = (np.full((len(clock), w), np.nan) for w in (4, 3, 3))
    valid = np.zeros(len(clock), dtype=bool)
    for run, rows in runs_within(stamps, broken, clock, SHORTEST_RUN):
        valid[rows] = True
        if same:
            continue
        own = stamps[run] - stamps[run.start]
        at = np.clip(clock[rows] - stamps[run.start], 0.0, own[-1])
        orientation[rows] = quaternions(RotationSpline(own, poses.attitude[run])(at))
        position[rows] = CubicSpline(own, poses.position[run], axis=0)(at)
        velocity[rows] = CubicSpline(own, speed[run], axis=0)(at)
    if same:
        orientation, position, velocity = quaternions(poses.attitude), poses.position, speed
    if np.isfinite(max_drift):
        near = ~_drifts(stamps, poses.position, speed, max_drift)
        valid &= known_at(stamps, near, clock, _longest(stamps))
    if poses.lever.any():
        arm, longest = poses.attitude.apply(poses.lever), _longest(stamps)
        turning = CubicSpline(stamps - stamps[0], arm, axis=0)(stamps - stamps[0], 1)
        position = position + splined(stamps, arm, clock, longest)
        velocity = velocity + splined(stamps, turning, clock, longest)
    return Reference(orientation, position, velocity, valid)


def _smooth(clock: Float[np.ndarray, " m"], poses: Poses, max_speed: float) -> Reference:
    """Splines, of attitudes too: at 30 Hz the shorter arc between two of them errs by half a degree
    in a walker's hand. The velocity is that of the smoothed positions."""
    stamps, longest = poses.time, _longest(poses.time)
    broken, wxyz = np.diff(stamps) > longest, quaternions(poses.attitude)
    if _same(stamps, clock):
        orientation = wxyz.copy()
    else:
        orientation = slerped(stamps, wxyz, clock)
        for run, rows in runs_within(stamps, broken, clock):
            own = stamps[run] - stamps[run.start]
            at = np.clip(clock[rows] - stamps[run.start], 0.0, own[-1])
            orientation[rows] = quaternions(RotationSpline(own, poses.attitude[run])(at))
    position = splined(stamps, poses.position, clock, longest)
    if poses.lever.any():
        position = position + rotations(orientation).apply(poses.lever)
    step = float(np.median(np.diff(clock)))
    fast = np.linalg.norm(np.diff(position, axis=0), axis=1) > max_speed * step
    jumps = np.concatenate([fast, [False]]) | np.concatenate([[False], fast])
    seen = known_at(stamps, np.ones(len(stamps), dtype=bool), clock, longest)
    good = seen & ~within(jumps, max(round(JUMP_MARGIN / step), 1))
    _, velocity, _ = smooth_positions(position, good, step)
    return Reference(orientation, position, velocity, good)


def _fused(
    clock: Float[np.ndarray, " m"], gyro: Float[np.ndarray, "m 3"], poses: Poses
) -> Reference:
    """The gyro carries the attitude between the tracker's, and a smoother the position."""
    usual, step = LOST_POSES * float(np.median(np.diff(poses.time))), float(clock[1] - clock[0])
    stamps, attitude, position = _in_runs(poses, usual)
    everywhere = np.ones(len(stamps), dtype=bool)
    measured = known_at(stamps, everywhere, clock, usual)
    if measured.sum() < SHORTEST_RUN:
        nothing = np.full((len(clock), 3), np.nan)
        return Reference(
            np.full((len(clock), 4), np.nan), nothing, nothing, np.zeros(len(clock), dtype=bool)
        )
    bridged = known_at(stamps, everywhere, clock, _longest(poses.time))
    turned = slerp(clock, stamps, attitude)
    # The gyro's constant bias would bend the correction at its ends.
    rate = gyro - _gyro_bias(gyro, turned, measured, step)
    fused, believed = fuse_attitude(integrate_gyro(rate, step), turned, measured, step)
    arm = fused.apply(poses.lever)
    smoothed, velocity, kept = smooth_positions(
        splined(stamps, position, clock, usual) + arm, measured & believed, step
    )
    # Where few poses are left between gaps the smoother may swing; it must stay with what was seen.
    straight = interpolate(clock, stamps, position) + arm
    close = np.linalg.norm(smoothed - straight, axis=1) < LARGEST_JUMP
    valid = np.asarray(bridged & close & (believed & kept | ~measured))
    return Reference(quaternions(fused), smoothed, velocity, valid)


def _same(stamps: Float[np.ndarray, " n"], clock: Float[np.ndarray, " m"]) -> bool:
    """True where the clock is that of the poses, to 1 µs: a spline would give the poses again."""
    return len(clock) == len(stamps) and bool(np.abs(clock - stamps).max() <= 1e-6)


def _longest(stamps: Float[np.ndarray, " n"]) -> float:
    """s between two poses up to which what lies between them can be trusted."""
    return max(LONGEST_BRIDGE, LOST_POSES * float(np.median(np.diff(stamps))))


def _drifts(
    stamps: Float[np.ndarray, " n"],
    position: Float[np.ndarray, "n 3"],
    velocity: Float[np.ndarray, "n 3"],
    most: float,
) -> Bool[np.ndarray, " n"]:
    """True in every second in which position and integrated velocity disagree by more than `most`
    (m), as where a satellite receiver corrects itself by jumps."""
    steps = np.diff(stamps)
    second = round(1.0 / float(np.median(steps)))
    middle = np.zeros(len(stamps), dtype=bool)
    if len(stamps) <= second:
        return middle
    moved = np.diff(position, axis=0) - midpoints(velocity) * steps[:, None]
    error = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    far = np.linalg.norm(error[second:] - error[:-second], axis=1) > most
    middle[second // 2 : second // 2 + len(far)] = far
    return within(middle, second // 2)


def _in_runs(poses: Poses, usual: float) -> tuple[np.ndarray, Rotation, np.ndarray]:
    """(stamps, attitudes, positions) of the poses that follow each other within `usual` (s): single
    poses between gaps are those that the tracker hardly saw."""
    runs = [
        np.arange(run.start, run.stop)
        for run in stretches(np.diff(poses.time) > usual)
        if run.stop - run.start >= SHORTEST_RUN
    ]
    rows = np.concatenate(runs) if runs else np.arange(len(poses.time))
    return poses.time[rows], poses.attitude[rows], poses.position[rows]


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


# --- attitude from a gyro whose slow drift a tracker corrects


def fuse_attitude(
    integrated: Rotation,
    measured: Rotation,
    good: Bool[np.ndarray, " n"],
    step: float,
    seconds: float = 0.3,
) -> tuple[Rotation, Bool[np.ndarray, " n"]]:
    """Integrated attitude times a smooth correction towards the measured one, and where the
    measured one was believed.

    The correction measured · integrated⁻¹ moves as slowly as the gyro's bias does. Samples more
    than 15° off its median course (σ 3 s) are flips of the tracker; the rest is smoothed over
    `seconds` (σ), with weights that fall with the residual. Where nothing was measured the
    correction is interpolated, so that the gyro bridges the gap.
    """
    correction = quaternions(measured * integrated.inv())
    correction[good] = _one_sign(correction[good])
    believed = good
    course = _filled(correction, good)
    for _ in range(4):
        correction, angle = _against(correction, course)
        believed = _enough(good & (angle < np.radians(FLIP_DEGREES)), good)
        course = _course(correction, angle, believed, np.radians(1.0), COURSE_SECONDS / step)
    for _ in range(3):
        correction, angle = _against(correction, course)
        believed = _enough(believed & (angle < np.pi), good)
        course = _course(correction, angle, believed, np.radians(0.3), seconds / step)
    return rotations(course) * integrated, believed


def _one_sign(wxyz: Float[np.ndarray, "m 4"]) -> Float[np.ndarray, "m 4"]:
    """The same rotations; q and −q are one, and neighbours get the same sign."""
    opposite = (wxyz[1:] * wxyz[:-1]).sum(axis=1) < 0
    return wxyz * np.cumprod(np.concatenate([[1.0], np.where(opposite, -1.0, 1.0)]))[:, None]


def _against(
    wxyz: Float[np.ndarray, "n 4"], course: Float[np.ndarray, "n 4"]
) -> tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, " n"]]:
    """The same rotations with the course's sign, and by what angle (rad) they are off it."""
    wxyz = wxyz * np.where((wxyz * course).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    return wxyz, 2.0 * np.arccos(np.clip((wxyz * course).sum(axis=1), -1.0, 1.0))


def _enough(near: Bool[np.ndarray, " n"], good: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """The samples near the course; all good ones if it has lost more than four fifths of them."""
    return near if near.sum() > 0.2 * good.sum() else good


def _course(
    correction: Float[np.ndarray, "n 4"],
    angle: Float[np.ndarray, " n"],
    believed: Bool[np.ndarray, " n"],
    least_scale: float,
    sigma: float,
) -> Float[np.ndarray, "n 4"]:
    """Quaternions of the correction filtered over `sigma` samples, those far off the last course
    (`angle`, rad) counting less."""
    scale = max(3.0 * float(np.median(angle[believed])), least_scale)
    weight = np.where(believed, 1.0 / (1.0 + (angle / scale) ** 2) ** 2, 1.0)
    course = gaussian_filter1d(
        weight[:, None] * _filled(correction, believed), sigma, axis=0, mode="nearest"
    )
    return course / np.linalg.norm(course, axis=1, keepdims=True)


def _filled(values: Float[np.ndarray, "n w"], good: Bool[np.ndarray, " n"]) -> np.ndarray:
    """Rows that are not good, interpolated between those that are."""
    rows = np.flatnonzero(good)
    return interpolate(np.arange(len(good)), rows, values[rows])


# --- positions and velocities of a noisy tracker


def smooth_positions(
    position: Float[np.ndarray, "n 3"],
    good: Bool[np.ndarray, " n"],
    step: float,
    cutoff: float = 12.0,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Positions (m), velocities (m/s) and which measurements were believed.

    The positions minimise Σ w |p − z|² + λ Σ |Δ³p|² (Whittaker's smoother): the response falls to
    one half at `cutoff` Hz, a quarter of the rate at most, and stays 1 to 0.1 % below a third of
    it. Weights fall with the residual, which removes single jumps; where nothing was measured the
    smoother bridges with the smoothest acceleration.
    """
    cutoff = min(cutoff, 0.25 / step)
    smoothness = (2.0 * np.sin(np.pi * cutoff * step)) ** -6 * _third_difference_bands(
        len(position)
    )
    filled = np.where(good[:, None], position, 0.0)
    weight = good.astype(float)
    smoothed = filled
    for _ in range(5):
        system = smoothness.copy()
        system[-1] += weight + 1e-9  # the diagonal
        smoothed = solveh_banded(system, weight[:, None] * filled)
        distance = np.linalg.norm(filled - smoothed, axis=1)
        scale = max(4.0 * float(np.median(distance[good])), 2e-3) if good.any() else 1.0
        weight = good / (1.0 + (distance / scale) ** 2) ** 2
    velocity = np.gradient(smoothed, step, axis=0, edge_order=2)
    return smoothed, velocity, good & (weight > 0.1)


def _third_difference_bands(n: int) -> Float[np.ndarray, "4 n"]:
    """Δ³ᵀΔ³ in SciPy's upper banded form: bands[3 − d, j] couples j and j − d."""
    stencil = np.array([-1.0, 3.0, -3.0, 1.0])
    bands = np.zeros((4, n))
    for a in range(4):
        for b in range(a, 4):
            bands[3 - (b - a), b : n - 3 + b] += stencil[a] * stencil[b]
    return bands
