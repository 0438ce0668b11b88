"""Poses of a tracked marker body, and the motion that they tell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment.signals import second_difference, smooth
from gnio_jax.numerics import midpoints, turns_between, within

FILTER_SECONDS = 0.03
"""Standard deviation of the Gaussian that both sides of the fit pass: a pass band of 5 Hz holds the
motion of a gait."""


class Track(NamedTuple):
    """Poses of a marker body on a uniform clock."""

    time: Float[np.ndarray, " n"]
    """s, on the tracker's clock, uniform."""
    position: Float[np.ndarray, "n 3"]
    """m, in the tracker's world; anything finite where not `good`."""
    attitude: Rotation
    """n rotations, marker body → tracker's world."""
    good: Bool[np.ndarray, " n"]
    """False where the tracker had no pose, or one that cannot be."""


class TooLittle(ValueError):
    """Too little of the track overlaps the IMU's recording."""


class TrackMotion(NamedTuple):
    """Filtered motion of a `Track`: the side of the fit that does not depend on its unknowns."""

    time: Float[np.ndarray, " n"]
    """s, on the tracker's clock."""
    step: float
    """s between samples."""
    sigma: float
    """Standard deviation of the filter, samples."""
    attitude: Float[np.ndarray, "n 3 3"]
    """Marker body → tracker's world, not filtered."""
    rate: Float[np.ndarray, "n 3"]
    """Angular rate in the marker body, rad/s."""
    acceleration: Float[np.ndarray, "n 3"]
    """p̈ of the marker body's origin, in the tracker's world, m/s²."""
    lever_gain: Float[np.ndarray, "n 3 3"]
    """R̈, 1/s²: a point at l in the marker body has the acceleration p̈ + R̈ l."""
    unreliable: Bool[np.ndarray, " n"]
    """Within the filter's reach of a sample that is not good."""


def motion(track: Track) -> TrackMotion:
    """Angular rate and accelerations by differences of the poses, filtered."""
    step = float(np.median(np.diff(track.time)))
    sigma = FILTER_SECONDS / step
    attitude = track.attitude.as_matrix()
    turning = turns_between(track.attitude) / step  # at the middles of the intervals
    rate = np.concatenate([turning[:1], midpoints(turning), turning[-1:]])
    return TrackMotion(
        time=track.time,
        step=step,
        sigma=sigma,
        attitude=attitude,
        rate=smooth(rate, sigma),
        acceleration=smooth(second_difference(track.position, step), sigma),
        lever_gain=smooth(second_difference(attitude, step), sigma),
        unreliable=within(~track.good, int(np.ceil(3 * sigma))),
    )
