"""Attitude from a gyro whose slow drift a tracker corrects."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment.signals import (
    cauchy_weights,
    hat_functions,
    second_difference,
    smooth,
    uniform_knots,
)
from gnio_jax.numerics import (
    hat,
    interpolate,
    quaternions,
    robust_std,
    rotations,
    slerp,
    within,
)
from gnio_jax.types import GRAVITY

COURSE_SECONDS, FLIP_DEGREES = 3.0, 15.0
"""Filter (standard deviation, s) of the correction's median course, and how far off it a sample
is a flip of the tracker."""

TILT_DRIFT_STD, YAW_DRIFT_STD = 0.05, 0.02
"""rad by which the gyro's drift may change from one interval of 10 s to the next: 0.005 rad/s in
tilt and 0.002 rad/s in yaw."""


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
    course = smooth(weight[:, None] * _filled(correction, believed), sigma)
    return course / np.linalg.norm(course, axis=1, keepdims=True)


def _filled(values: Float[np.ndarray, "n w"], good: Bool[np.ndarray, " n"]) -> np.ndarray:
    """Rows that are not good, interpolated between those that are."""
    rows = np.flatnonzero(good)
    return interpolate(np.arange(len(good)), rows, values[rows])


def attitude_from_acceleration(
    integrated: Rotation,
    guess: Rotation,
    accel: Float[np.ndarray, "n 3"],
    position: Float[np.ndarray, "n 3"],
    good: Bool[np.ndarray, " n"],
    step: float,
    knot_seconds: float = 10.0,
    filter_seconds: float = 0.25,
) -> Rotation:
    """Attitude whose accelerations agree with those of tracked positions: integrated gyro times a
    slow correction.

    `integrated` are n rotations from the gyro alone, `guess` what the correction starts from, all
    body→world, `accel` m/s² specific force, `position` m in a level world, `good` where it can be
    trusted, on one clock of `step` s. The correction is a rotation per knot, with the shorter arc
    between; it leads R·accel + g, filtered until no gait is left, onto the second difference of
    `position`. A prior lets the drift of the gyro change little between knots (`TILT_DRIFT_STD`).
    """
    time = np.arange(len(accel)) * step
    knots = uniform_knots(time, knot_seconds)
    hats = hat_functions(time, knots)
    near = np.clip(np.round(knots / step).astype(int), 0, len(accel) - 1)
    correction = _means(guess * integrated.inv(), near, round(1.0 / step))
    sigma = filter_seconds / step
    upward = np.array([0.0, 0.0, GRAVITY])
    tracked = smooth(second_difference(position, step), sigma) + upward
    usable = ~within(~good, int(np.ceil(3 * sigma)))
    rows = np.flatnonzero(usable)[:: max(round(sigma), 1)]
    for _ in range(8):
        attitude = slerp(time, knots, correction) * integrated
        felt = smooth(attitude.apply(accel), sigma)[rows]
        of_force = _force_equations(felt, tracked[rows], hats[rows])
        of_drift = _drift_prior(correction)
        normal, gradient = (sum(parts) for parts in zip(of_force, of_drift, strict=True))
        change = -np.linalg.lstsq(normal, gradient, rcond=1e-10)[0].reshape(-1, 3)
        change *= min(1.0, 0.3 / max(float(np.abs(change).max()), 1e-12))
        correction = Rotation.from_rotvec(change) * correction
    return slerp(time, knots, correction) * integrated


def _means(attitude: Rotation, centres: np.ndarray, half: int) -> Rotation:
    """Mean rotations over `half` samples to either side of each centre."""
    return Rotation.concatenate([attitude[max(i - half, 0) : i + half].mean() for i in centres])


def _force_equations(
    felt: Float[np.ndarray, "r 3"], tracked: Float[np.ndarray, "r 3"], hats: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Robust normal equations of the accelerations' differences, by a small rotation per knot."""
    error = tracked - felt
    weight = cauchy_weights(error, max(robust_std(error), 1e-3)) / 2.5
    jacobian = hat(felt)[:, :, None, :] * hats[:, None, :, None]
    jacobian = jacobian.reshape(len(felt), 3, -1)
    normal = np.einsum("nai,n,naj->ij", jacobian, weight, jacobian, optimize=True)
    return normal, np.einsum("nai,n,na->i", jacobian, weight, error, optimize=True)


def _drift_prior(correction: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of the prior on what changes between one turn from knot to knot and the
    next."""
    count = len(correction)
    spread = np.tile([TILT_DRIFT_STD, TILT_DRIFT_STD, YAW_DRIFT_STD], max(count - 2, 0))
    differences = np.kron(np.diff(np.eye(count), 2, axis=0), np.eye(3)) / spread[:, None]
    turns = (correction[1:] * correction[:-1].inv()).as_rotvec()
    drift = np.diff(turns, axis=0).reshape(-1) / spread
    return differences.T @ differences, differences.T @ drift
