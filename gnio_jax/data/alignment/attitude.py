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
    robust_std,
    slerp,
    within,
)
from gnio_jax.types import GRAVITY

TILT_DRIFT_STD, YAW_DRIFT_STD = 0.05, 0.02
"""rad by which the gyro's drift may change from one interval of 10 s to the next: 0.005 rad/s in
tilt and 0.002 rad/s in yaw."""


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
