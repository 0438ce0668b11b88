"""A phone laid on a Vicon track: one walk of the Vicon room."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gnio_jax.data.alignment import (
    Alignment,
    TooLittle,
    Track,
    align,
)
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.readers.oxiod.assembly import (
    Samples,
    WalkReference,
    on_clock,
    samples_at,
    sequence_of,
)
from gnio_jax.data.readers.oxiod.phone import SHORTEST, PhoneSamples
from gnio_jax.data.readers.oxiod.trackers import read_vicon
from gnio_jax.data.readers.oxiod.walks import RATE, Walk
from gnio_jax.data.reference import fuse_attitude, smooth_positions
from gnio_jax.numerics import integrate_gyro, interpolate, neighbours, outer_span, slerp, within
from gnio_jax.types import Sequence

# What a fit of phone and Vicon may say. In brackets: the largest figure of the 57 real pairs, raw
# and syn, that were at hand.
MOST_TURNING_UNEXPLAINED = 0.1
"""Share of the turning's power that a fit may leave (0.010). Another walk's Vicon leaves 0.6 and
more."""
MOST_ACCELERATION_UNEXPLAINED = 0.5
"""The same of the acceleration (0.17, on a trolley, which shakes more than it accelerates)."""
CLOSEST_RUNNER_UP = 0.5
"""What the best fit leaves unexplained over what the best fit with another lag does (0.13); 1 where
both are as good."""
LONGEST_LAG = {"raw": 5.0, "syn": 1.0}
"""s. The clocks of raw files were set apart (0.29 here, 1.7 in others of the set, and as far as the
search goes); the rows of syn files were matched by the authors (0.29)."""
LONGEST_DRIFT = 1.0
"""s between the smallest and the largest lag of a walk: clocks drift by 1 ms in some seconds
(0.26)."""
LONGEST_ACCEL_DELAY = 0.15
"""s: phones filter the accelerometer over some samples (0.052)."""
LONGEST_LEVER = 0.3
"""m between the IMU and the marker body's origin, which is the phone with markers on it (0.12)."""
LARGEST_TILT = 5.0
"""Degrees by which the world of a calibrated tracker leans (0.8)."""
LARGEST_GYRO_BIAS = 0.1
"""rad/s: a phone's gyro that nothing has calibrated (0.02)."""
LARGEST_ACCEL_BIAS = 0.6
"""m/s²: 60 mG, a bad accelerometer (0.17)."""

LAG_KNOTS = {"raw": 30.0, "syn": 5.0}
"""s between the knots of the lag. Clocks of raw files run straight; in syn files rows were lost and
filled in, and the lag steps by 10 to 20 ms."""


def build_with_vicon(walk: Walk, kind: str, imu: PhoneSamples, path: Path) -> Sequence:
    """One walk at 100 Hz. Raises `Refusal` when the track or the fit is of no use."""
    samples = on_clock(imu)
    track = read_vicon(path, kind, imu.epoch)
    try:
        fit = align(samples.time, samples.gyro, samples.accel, track, knot_seconds=LAG_KNOTS[kind])
    except TooLittle as error:
        raise Refusal(path, f"cannot be aligned with the phone ({error})", "leave it out") from None
    _check_fit(fit, kind, path)
    samples = _without_delay(samples, imu, fit.accel_delay)
    at = fit.track_time(samples.time)
    covered = (at >= track.time[0]) & (at <= track.time[-1])
    if covered.sum() < SHORTEST * RATE:
        raise Refusal(
            path, f"overlaps the phone's recording by less than {SHORTEST:g} s", "leave it out"
        )
    span = outer_span(covered)
    samples = samples.cut(span)
    reference = _reference(samples, track, fit, np.clip(at[span], track.time[0], track.time[-1]))
    return sequence_of(walk, kind, samples, reference, imu.epoch, path, _fit_attributes(fit))


def _without_delay(samples: Samples, imu: PhoneSamples, delay: float) -> Samples:
    """The accelerometer tells of an event later than the gyro: read it later, from the phone's
    rows."""
    accel, measured = samples_at(imu.time, imu.accel, samples.time + delay)
    return samples._replace(accel=accel, measured=samples.measured & measured)


def _reference(samples: Samples, track: Track, fit: Alignment, at: np.ndarray) -> WalkReference:
    """The phone's poses from the track's at its times `at`.

    Orientation: integrated gyro, corrected towards Vicon. Position: Vicon's plus the lever arm,
    levelled and smoothed.
    """
    good = track.good & np.logical_not(within(fit.mismatch, 10))
    left, right = neighbours(track.time, at)
    level = fit.levelling()
    pose = level * slerp(at, track.time, track.attitude) * fit.extrinsic
    integrated = integrate_gyro(samples.gyro - fit.gyro_bias, 1.0 / RATE)
    # A marker body that has flipped is not where it says, either.
    orientation, believed = fuse_attitude(integrated, pose, good[left] & good[right], 1.0 / RATE)
    marker = level.apply(interpolate(at, track.time, track.position))
    lever = orientation.apply(fit.extrinsic.inv().apply(fit.lever))
    position, velocity, kept = smooth_positions(marker + lever, believed, 1.0 / RATE)
    return WalkReference(orientation, position, velocity, kept)


def _check_fit(fit: Alignment, kind: str, path: Path) -> None:
    """Raise `Refusal` where the best fit does not explain the motion, or says what cannot be of a
    phone on a marker body."""
    remedy = "check that both files are of one walk"
    shares = (
        ("turning", fit.gyro_unexplained, MOST_TURNING_UNEXPLAINED),
        ("acceleration", fit.accel_unexplained, MOST_ACCELERATION_UNEXPLAINED),
    )
    for what, share, most in shares:
        if not share <= most:
            raise Refusal(
                path,
                f"does not move as the phone does: {share:.0%} of the power of its "
                f"{what} stays unexplained, at most {most:.0%} is plausible",
                remedy,
            )
    if not fit.runner_up <= CLOSEST_RUNNER_UP:
        raise Refusal(
            path,
            "fits the phone at two lags alike, for the walk repeats itself (one leaves "
            f"{fit.runner_up:.0%} of what the other leaves unexplained)",
            "leave it out",
        )
    bounds = (
        ("lag", float(np.abs(fit.lag).max()), LONGEST_LAG[kind], "s"),
        ("lag's drift", float(np.ptp(fit.lag)), LONGEST_DRIFT, "s"),
        ("accel's delay", abs(fit.accel_delay), LONGEST_ACCEL_DELAY, "s"),
        ("lever arm", float(np.linalg.norm(fit.lever)), LONGEST_LEVER, "m"),
        ("world's tilt", _degrees_off(fit.up[2]), LARGEST_TILT, "°"),
        ("gyro's bias", float(np.linalg.norm(fit.gyro_bias)), LARGEST_GYRO_BIAS, "rad/s"),
        ("accel's bias", float(np.linalg.norm(fit.accel_bias)), LARGEST_ACCEL_BIAS, "m/s²"),
    )
    for what, value, most, unit in bounds:
        if not value <= most:
            raise Refusal(
                path,
                f"fits the phone only with what cannot be: the {what} would be "
                f"{value:.3g} {unit}, at most {most:g} {unit} is plausible",
                remedy,
            )


def _degrees_off(cosine: float) -> float:
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _fit_attributes(fit: Alignment) -> dict[str, str | float]:
    attributes: dict[str, str | float] = {
        "truth": "vicon",
        "lag": float(np.mean(fit.lag)),
        "lag_drift": float(np.ptp(fit.lag)),
        "accel_delay_removed": fit.accel_delay,
        "gyro_unexplained": fit.gyro_unexplained,
        "accel_unexplained": fit.accel_unexplained,
        "runner_up": fit.runner_up,
        "extrinsic_yaw_degrees": float(fit.extrinsic.as_euler("ZXY", degrees=True)[0]),
        "extrinsic_tilt_degrees": _degrees_off(fit.extrinsic.as_matrix()[2, 2]),
        "tilt_x": float(fit.up[0] / fit.up[2]),
        "tilt_y": float(fit.up[1] / fit.up[2]),
        "gyro_residual": fit.gyro_residual,
        "accel_residual": fit.accel_residual,
    }
    for axis, name in enumerate("xyz"):
        attributes[f"lever_{name}"] = float(fit.lever[axis])
        attributes[f"gyro_bias_{name}"] = float(fit.gyro_bias[axis])
        attributes[f"accel_bias_{name}"] = float(fit.accel_bias[axis])
    return attributes
