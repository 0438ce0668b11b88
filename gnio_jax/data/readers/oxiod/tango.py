"""A phone laid on the positions of a Tango tablet: one walk of the large scale."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment import (
    Heading,
    align_heading,
    attitude_from_acceleration,
)
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.readers.oxiod.assembly import Samples, WalkReference, on_clock, sequence_of
from gnio_jax.data.readers.oxiod.phone import PhoneSamples
from gnio_jax.data.readers.oxiod.trackers import read_tango
from gnio_jax.data.readers.oxiod.vicon import LONGEST_LAG
from gnio_jax.data.readers.oxiod.walks import RATE, Walk
from gnio_jax.data.reference import smooth_positions
from gnio_jax.numerics import (
    about_z,
    integrate_gyro,
    interpolate,
    midpoints,
    outer_span,
    turns_between,
)
from gnio_jax.types import Sequence

MIN_CORRELATION = 0.3
"""Of the accelerations of phone and tablet."""
CUTOFF = 4.0
"""Hz, half response of the smoother of Tango's positions."""


def build_with_tango(walk: Walk, kind: str, imu: PhoneSamples, path: Path) -> Sequence:
    """One walk at 100 Hz: positions from the tablet, whose attitude is unusable; orientation from
    integrated gyro, led by the accelerations of both. Raises `Refusal`."""
    stamps, position, good = read_tango(path)
    samples = on_clock(imu)
    device = samples.attitude
    if device is None:
        raise Refusal(path, "goes with a phone that gives no attitude", "leave it out")
    force = device.apply(samples.accel)[:, :2]
    try:
        fit = align_heading(samples.time, force, stamps, position, good)
    except ValueError as error:
        raise Refusal(path, f"cannot be aligned with the phone ({error})", "leave it out") from None
    _check_fit(fit, kind, path)

    at = np.interp(samples.time, fit.knots + fit.lag, fit.knots, left=-1.0, right=-1.0)
    span = outer_span((at >= 0.0) & (at <= stamps[-1]))
    samples, device, at = samples.cut(span), device[span], at[span]
    nearest = np.clip(np.round(at * RATE).astype(int), 0, len(stamps) - 1)
    position, velocity, kept = smooth_positions(
        interpolate(at, stamps, position), good[nearest], 1.0 / RATE, cutoff=CUTOFF
    )
    turned = about_z(np.interp(at, fit.knots, fit.yaw)) * device
    orientation = _orientation(samples, device, turned, position, kept)
    reference = WalkReference(orientation, position, velocity, kept)
    return sequence_of(walk, kind, samples, reference, imu.epoch, path, _fit_attributes(fit))


def _check_fit(fit: Heading, kind: str, path: Path) -> None:
    problem = ""
    if fit.correlation < MIN_CORRELATION:
        problem = f"accelerations correlate by {fit.correlation:.2f}"
    elif not np.abs(fit.lag).max() <= LONGEST_LAG[kind]:
        problem = f"by {np.abs(fit.lag).max():.2f} s, at most {LONGEST_LAG[kind]:g} s is plausible"
    if problem:
        raise Refusal(path, f"Tango is out of step with the phone ({problem})", "leave it out")


def _orientation(
    samples: Samples,
    device: Rotation,
    turned: Rotation,
    position: Float[np.ndarray, "n 3"],
    kept: Bool[np.ndarray, " n"],
) -> Rotation:
    """Integrated gyro, corrected slowly from the phone's own attitude `turned` to Tango's yaw.

    That attitude takes part of each stride's acceleration for gravity: up to 6° of tilt, and it
    drifts in yaw. Over minutes, though, gravity tells it the gyro's bias in tilt.
    """
    bias = (midpoints(samples.gyro) - turns_between(device) * RATE).mean(axis=0)
    integrated = integrate_gyro(samples.gyro - bias, 1.0 / RATE)
    return attitude_from_acceleration(integrated, turned, samples.accel, position, kept, 1.0 / RATE)


def _fit_attributes(fit: Heading) -> dict[str, str | float]:
    return {
        "truth": "tango",
        "lag": float(np.mean(fit.lag)),
        "lag_drift": float(np.ptp(fit.lag)),
        "yaw_drift_degrees": float(np.degrees(np.ptp(fit.yaw))),
        "heading_correlation": fit.correlation,
        "runner_up": fit.runner_up,
    }
