"""One robust Gauss-Newton fit of an IMU to a tracked body, from a first guess of the lag.

The errors are those of the two equations of the room's docstring, gyro and accelerometer, filtered
alike. The unknowns are `Unknowns`; its fields stand in the columns of the Jacobians as the slices
below say. IMU samples are interpolated at each guess of the lag, and filtered after they have been
turned into the same frame as the tracker's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment.signals import (
    bending,
    cauchy_weights,
    covered,
    hat_functions,
    smooth,
)
from gnio_jax.data.alignment.track import FILTER_SECONDS, TooLittle, TrackMotion
from gnio_jax.numerics import hat, interpolate, robust_std
from gnio_jax.types import GRAVITY

BLOCK_SECONDS = 2.0
"""Errors within this time share an offset."""

SHORTEST_OVERLAP = 10.0
"""s of usable poses below which nothing is fitted."""

ROTATION = slice(0, 3)
GYRO_BIAS = slice(3, 6)
ACCEL_BIAS = slice(6, 9)
LEVER = slice(9, 12)
TILT = slice(12, 14)
ACCEL_DELAY = slice(14, 15)
LAG = slice(15, None)
"""Columns of the Jacobians; the lag has one per knot."""
CLOCKS = slice(ACCEL_DELAY.start, None)
"""Accelerometer's delay and lag together."""

PRIOR_STD = ((GYRO_BIAS, 0.05), (ACCEL_BIAS, 0.15), (LEVER, 0.2), (TILT, 0.05), (ACCEL_DELAY, 0.05))
"""Weak priors around zero settle what a recording cannot tell: biases of a phone (rad/s, m/s²), a
lever on the hand (m), a world that is nearly level (rad), the accelerometer's delay (s)."""
LAG_BEND_STD = 0.02
"""s; clocks run straight: second difference of the lag from knot to knot."""

LARGEST_TURN_STEP, LARGEST_CLOCK_STEP = 0.2, 0.05
"""rad and s per iteration: linearisation holds for a tenth of a gait cycle and a tenth of a
radian or so."""


class ImuSamples(NamedTuple):
    """Samples of an IMU on a uniform clock of its own."""

    time: Float[np.ndarray, " m"]
    """s."""
    gyro: Float[np.ndarray, "m 3"]
    """rad/s."""
    accel: Float[np.ndarray, "m 3"]
    """Specific force, m/s²."""
    gyro_slope: Float[np.ndarray, "m 3"]
    """Time derivative of `gyro`, rad/s²."""
    accel_slope: Float[np.ndarray, "m 3"]
    """Time derivative of `accel`, m/s³."""


class Unknowns(NamedTuple):
    """What the fit estimates; SI units."""

    extrinsic: Rotation
    """IMU → marker body."""
    gyro_bias: Float[np.ndarray, "3"]
    accel_bias: Float[np.ndarray, "3"]
    lever: Float[np.ndarray, "3"]
    """From the marker body's origin to the IMU, in the marker body, m."""
    tilt: Float[np.ndarray, "2"]
    """Horizontal part of the upward direction in the tracker's world over its vertical part."""
    accel_delay: float
    """How much later than the gyro the accelerometer tells of the same event, s."""
    lag: Float[np.ndarray, " k"]
    """Time of the IMU minus time of the tracker for the same event, at the knots, s."""

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """Unit vector against gravity in the tracker's world."""
        return np.array([*self.tilt, 1.0]) / np.sqrt(1.0 + self.tilt @ self.tilt)


class Residuals(NamedTuple):
    """Errors of both equations at one guess of the unknowns, and what their derivatives need."""

    usable: Bool[np.ndarray, " n"]
    """Samples of the track that are reliable and that the IMU covers."""
    gyro: Float[np.ndarray, "n 3"]
    """Tracker's filtered angular rate minus the IMU's, in the marker body, rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """Tracker's filtered acceleration minus the IMU's, in the tracker's world, m/s²."""
    rate: Float[np.ndarray, "n 3"]
    """The IMU's filtered angular rate, bias taken off, in the IMU's frame, rad/s."""
    rate_slope: Float[np.ndarray, "n 3"]
    """Its time derivative, rad/s²."""
    force: Float[np.ndarray, "n 3"]
    """The IMU's specific force, bias taken off, in the IMU's frame, not filtered, m/s²."""
    force_slope: Float[np.ndarray, "n 3"]
    """Its time derivative, m/s³."""
    to_world: Float[np.ndarray, "n 3 3"]
    """IMU → tracker's world."""


class Fit(NamedTuple):
    """Unknowns after the last iteration, and the residuals that led to it."""

    unknowns: Unknowns
    residuals: Residuals
    accel_scale: float
    """Robust standard deviation by which the acceleration's errors were weighted, m/s²."""


def imu_samples(
    time: Float[np.ndarray, " m"], gyro: Float[np.ndarray, "m 3"], accel: Float[np.ndarray, "m 3"]
) -> ImuSamples:
    """Samples with their derivatives."""
    step = float(np.median(np.diff(time)))
    slopes = (np.gradient(values, step, axis=0) for values in (gyro, accel))
    return ImuSamples(time, gyro, accel, *slopes)


def fit(
    imu: ImuSamples,
    track: TrackMotion,
    knots: Float[np.ndarray, " k"],
    lag: Float[np.ndarray, " k"],
    iterations: int,
) -> Fit:
    """The fit that starts from `lag` (s) at `knots` (s, on the tracker's clock).

    Raises `TooLittle` where less than `SHORTEST_OVERLAP` of the track is usable at the start.
    """
    hats = hat_functions(track.time, knots)
    unknowns = _start(imu, track, hats, lag)
    # Neighbours are correlated by the filter: one row per standard deviation of it loses nothing.
    rows = np.arange(0, len(track.time), max(int(track.sigma), 1))
    gyro_scale, accel_scale = 0.3, 3.0
    residuals = _residuals(imu, track, hats, unknowns)
    for iteration in range(iterations):
        if iteration > 0:
            residuals = _residuals(imu, track, hats, unknowns)
            gyro_scale = max(robust_std(residuals.gyro[residuals.usable]), 1e-4)
            accel_scale = max(robust_std(residuals.accel[residuals.usable]), 1e-3)
        chosen = rows[residuals.usable[rows]]
        block = np.floor(track.time[chosen] / BLOCK_SECONDS).astype(int)
        turn, force = residuals.gyro[chosen], residuals.accel[chosen]
        of_gyro = _normal_equations(
            _gyro_jacobian(residuals, unknowns, hats, chosen),
            turn,
            cauchy_weights(turn, gyro_scale),
            block,
        )
        of_accel = _normal_equations(
            _accel_jacobian(residuals, track, hats, chosen),
            force,
            cauchy_weights(force, accel_scale),
            block,
        )
        of_prior = _prior(unknowns)
        normal, gradient = (sum(parts) for parts in zip(of_gyro, of_accel, of_prior, strict=True))
        change = _bounded(-np.linalg.lstsq(normal, gradient, rcond=1e-12)[0])
        unknowns = _changed(unknowns, change)
        still = np.linalg.norm(change[ROTATION]) < 1e-4 and np.abs(change[CLOCKS]).max() < 2e-4
        if iteration > 3 and still:
            break
    return Fit(unknowns, residuals, accel_scale)


def _start(
    imu: ImuSamples, track: TrackMotion, hats: np.ndarray, lag: Float[np.ndarray, " k"]
) -> Unknowns:
    """The rotation that lays the angular rates on each other best at the given lag, zero for the
    rest."""
    there = track.time + hats @ lag
    usable = ~track.unreliable & covered(there, imu.time, margin=4 * FILTER_SECONDS)
    seconds = usable.sum() * track.step
    if seconds < SHORTEST_OVERLAP:
        raise TooLittle(f"only {seconds:.1f} s of the track overlap the IMU's samples")
    rate = smooth(interpolate(there, imu.time, imu.gyro), track.sigma)
    return Unknowns(
        extrinsic=Rotation.align_vectors(track.rate[usable], rate[usable])[0],
        gyro_bias=np.zeros(3),
        accel_bias=np.zeros(3),
        lever=np.zeros(3),
        tilt=np.zeros(2),
        accel_delay=0.0,
        lag=lag,
    )


def _residuals(
    imu: ImuSamples, track: TrackMotion, hats: np.ndarray, unknowns: Unknowns
) -> Residuals:
    there = track.time + hats @ unknowns.lag
    late = there + unknowns.accel_delay
    margin = 4 * FILTER_SECONDS
    inside = covered(there, imu.time, margin) & covered(late, imu.time, margin)

    rate = interpolate(there, imu.time, imu.gyro)
    rate = smooth(rate, track.sigma) - unknowns.gyro_bias
    force = interpolate(late, imu.time, imu.accel) - unknowns.accel_bias
    to_marker = unknowns.extrinsic.as_matrix()
    to_world = track.attitude @ to_marker
    felt = smooth(np.einsum("nij,nj->ni", to_world, force), track.sigma)
    seen = track.acceleration + track.lever_gain @ unknowns.lever
    return Residuals(
        usable=~track.unreliable & inside,
        gyro=track.rate - rate @ to_marker.T,
        accel=seen - felt + GRAVITY * unknowns.up,
        rate=rate,
        rate_slope=smooth(interpolate(there, imu.time, imu.gyro_slope), track.sigma),
        force=force,
        force_slope=interpolate(late, imu.time, imu.accel_slope),
        to_world=to_world,
    )


def _gyro_jacobian(
    residuals: Residuals, unknowns: Unknowns, hats: np.ndarray, rows: np.ndarray
) -> Float[np.ndarray, "c 3 u"]:
    """Derivatives of the gyro's errors in `rows` by the unknowns."""
    to_marker = unknowns.extrinsic.as_matrix()
    slope = residuals.rate_slope[rows] @ to_marker.T
    jacobian = np.zeros((len(rows), 3, LAG.start + hats.shape[1]))
    jacobian[:, :, ROTATION] = to_marker @ hat(residuals.rate[rows])
    jacobian[:, :, GYRO_BIAS] = to_marker
    jacobian[:, :, LAG] = -slope[:, :, None] * hats[rows][:, None, :]
    return jacobian


def _accel_jacobian(
    residuals: Residuals, track: TrackMotion, hats: np.ndarray, rows: np.ndarray
) -> Float[np.ndarray, "c 3 u"]:
    """Derivatives of the accelerometer's errors in `rows` by the unknowns."""
    to_world, sigma = residuals.to_world, track.sigma
    slope = smooth(np.einsum("nij,nj->ni", to_world, residuals.force_slope), sigma)[rows]
    jacobian = np.zeros((len(rows), 3, LAG.start + hats.shape[1]))
    jacobian[:, :, ROTATION] = smooth(to_world @ hat(residuals.force), sigma)[rows]
    jacobian[:, :, ACCEL_BIAS] = smooth(to_world, sigma)[rows]
    jacobian[:, :, LEVER] = track.lever_gain[rows]
    jacobian[:, :2, TILT] = GRAVITY * np.eye(2)
    jacobian[:, :, ACCEL_DELAY] = -slope[:, :, None]
    jacobian[:, :, LAG] = -slope[:, :, None] * hats[rows][:, None, :]
    return jacobian


def _normal_equations(
    jacobian: Float[np.ndarray, "c 3 u"],
    error: Float[np.ndarray, "c 3"],
    weight: Float[np.ndarray, " c"],
    block: np.ndarray,
) -> tuple[Float[np.ndarray, "u u"], Float[np.ndarray, " u"]]:
    """(Jᵀ W J, Jᵀ W e) when the errors of a block share an unknown offset, whose variance is that
    of the blocks' means.

    A gyro's bias drifts and a tracker's attitude is off by some tenths of a degree that depend on
    the place; white noise would take a minute of standing for thousands of proofs of one direction.
    """
    first = np.diff(block, prepend=block[0] - 1) != 0
    starts, member = np.flatnonzero(first), np.cumsum(first) - 1
    total = np.add.reduceat(weight, starts)
    mean_jacobian = np.add.reduceat(weight[:, None, None] * jacobian, starts) / total[:, None, None]
    mean_error = np.add.reduceat(weight[:, None] * error, starts) / total[:, None]
    inner_jacobian, inner_error = jacobian - mean_jacobian[member], error - mean_error[member]
    mean_weight = 1.0 / (robust_std(mean_error) ** 2 + 1.0 / total)
    rows = np.concatenate([inner_jacobian, mean_jacobian]).reshape(-1, jacobian.shape[2])
    errors = np.concatenate([inner_error, mean_error]).reshape(-1)
    weighted = rows * np.repeat(np.concatenate([weight, mean_weight]), 3)[:, None]
    return weighted.T @ rows, weighted.T @ errors


def _prior(unknowns: Unknowns) -> tuple[Float[np.ndarray, "u u"], Float[np.ndarray, " u"]]:
    """Normal equations of `PRIOR_STD` and `LAG_BEND_STD`."""
    values = np.concatenate(
        [
            np.zeros(3),  # the rotation is free
            unknowns.gyro_bias,
            unknowns.accel_bias,
            unknowns.lever,
            unknowns.tilt,
            [unknowns.accel_delay],
            unknowns.lag,
        ]
    )
    precision = np.zeros((len(values), len(values)))
    for columns, std in PRIOR_STD:
        precision[columns, columns] = np.eye(columns.stop - columns.start) / std**2
    if len(unknowns.lag) > 2:
        precision[LAG, LAG] = bending(len(unknowns.lag), LAG_BEND_STD)
    return precision, precision @ values


def _bounded(change: Float[np.ndarray, " u"]) -> Float[np.ndarray, " u"]:
    """A step of the fit, cut to where the linearisation holds."""
    change = change.copy()
    change[CLOCKS] = np.clip(change[CLOCKS], -LARGEST_CLOCK_STEP, LARGEST_CLOCK_STEP)
    turn = max(float(np.linalg.norm(change[ROTATION])), 1e-12)
    change[ROTATION] *= min(1.0, LARGEST_TURN_STEP / turn)
    return change


def _changed(unknowns: Unknowns, change: Float[np.ndarray, " u"]) -> Unknowns:
    return Unknowns(
        extrinsic=unknowns.extrinsic * Rotation.from_rotvec(change[ROTATION]),
        gyro_bias=unknowns.gyro_bias + change[GYRO_BIAS],
        accel_bias=unknowns.accel_bias + change[ACCEL_BIAS],
        lever=unknowns.lever + change[LEVER],
        tilt=unknowns.tilt + change[TILT],
        accel_delay=unknowns.accel_delay + float(change[ACCEL_DELAY][0]),
        lag=unknowns.lag + change[LAG],
    )
