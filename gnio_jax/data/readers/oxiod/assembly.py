"""The phone's samples on a uniform clock, and the sequence that they and a reference make."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Refusal
from gnio_jax.data.readers.oxiod.phone import SHORTEST, PhoneSamples
from gnio_jax.data.readers.oxiod.walks import RATE, SINGLE_USER, Walk
from gnio_jax.data.validation import validate
from gnio_jax.numerics import neighbours, outer_span, quaternions, slerp
from gnio_jax.types import Sequence

LICENCE = "for research, as stated by the authors (deepio.cs.ox.ac.uk)"
LONGEST_BRIDGE = 0.2
"""Stretches without a pose up to here (s) are bridged to better than a centimetre; longer ones are
not valid."""
LONGEST_SPLINE = 0.03
"""s between samples, beyond which a spline swings: a line is drawn."""
LONGEST_MEASURED = 0.1
"""s between samples, beyond which nothing was measured in between."""


class Samples(NamedTuple):
    """A phone's samples on a uniform 100 Hz clock."""

    time: Float[np.ndarray, " n"]
    """s, on the phone's clock."""
    gyro: Float[np.ndarray, "n 3"]
    """rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """m/s²."""
    attitude: Rotation | None
    """The phone's own."""
    measured: Bool[np.ndarray, " n"]
    """False in gaps of more than `LONGEST_MEASURED`."""

    def cut(self, span: slice) -> Samples:
        """The samples of a span."""
        attitude = None if self.attitude is None else self.attitude[span]
        return Samples(
            self.time[span], self.gyro[span], self.accel[span], attitude, self.measured[span]
        )


class WalkReference(NamedTuple):
    """Where the phone was, at its samples."""

    orientation: Rotation
    """Body→world."""
    position: Float[np.ndarray, "n 3"]
    """m."""
    velocity: Float[np.ndarray, "n 3"]
    """m/s."""
    seen: Bool[np.ndarray, " n"]
    """False where the tracker does not vouch for it."""


def on_clock(imu: PhoneSamples) -> Samples:
    """The samples on a uniform 100 Hz clock from the phone's first."""
    time = imu.time[0] + np.arange(int((imu.time[-1] - imu.time[0]) * RATE + 1e-6)) / RATE
    imu_rows = np.concatenate([imu.gyro, imu.accel], axis=1)
    values, measured = samples_at(imu.time, imu_rows, time)
    attitude = None if imu.attitude is None else slerp(time, imu.time, imu.attitude)
    return Samples(time, values[:, :3], values[:, 3:], attitude, measured)


def samples_at(
    stamps: Float[np.ndarray, " n"],
    values: Float[np.ndarray, "n w"],
    time: Float[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, "m w"], Bool[np.ndarray, " m"]]:
    """A sensor's rows at other times by a cubic spline, and whether it measured there.

    It did not beyond its ends, where the first and last row stand in, nor in gaps of more than
    `LONGEST_MEASURED`.
    """
    inside = np.clip(time, stamps[0], stamps[-1])
    left, right = neighbours(stamps, inside)
    interval = stamps[right] - stamps[left]
    share = ((inside - stamps[left]) / interval)[:, None]
    line = (1.0 - share) * values[left] + share * values[right]
    curve = CubicSpline(stamps, values, axis=0)(inside)
    there = np.where((interval > LONGEST_SPLINE)[:, None], line, curve)
    return there, (interval <= LONGEST_MEASURED) & (np.abs(time - inside) < 1e-9)


def sequence_of(
    walk: Walk,
    kind: str,
    samples: Samples,
    reference: WalkReference,
    epoch: float,
    truth: Path,
    attributes: dict[str, str | float],
) -> Sequence:
    """The stretch from the first to the last valid sample, starting at 0 s; `start_time` is that
    moment on the phone's clock. Raises `Refusal` where little is valid."""
    valid = _bridged(reference.seen, LONGEST_BRIDGE) & samples.measured
    if valid.sum() < SHORTEST * RATE:
        raise Refusal(
            truth, f"only {valid.sum() / RATE:.1f} s have a usable reference", "leave it out"
        )
    span = outer_span(valid)
    samples = samples.cut(span)
    start = {"start_time": epoch + float(samples.time[0])}
    return validate(
        Sequence(
            name=walk.name,
            time=np.arange(len(samples.time)) / RATE,
            gyro=samples.gyro,
            accel=samples.accel,
            orientation=quaternions(reference.orientation[span]),
            position=reference.position[span],
            velocity=reference.velocity[span],
            valid=valid[span],
            device_orientation=None if samples.attitude is None else quaternions(samples.attitude),
            attributes=_attributes(walk, kind) | attributes | start,
        ),
        truth,
    )


def _bridged(good: Bool[np.ndarray, " n"], seconds: float) -> Bool[np.ndarray, " n"]:
    """`good`, with holes of up to `seconds` counted in."""
    reach = max(round(seconds * RATE / 2), 1)
    padded = np.pad(good, reach)
    closed = binary_erosion(binary_dilation(padded, iterations=reach), iterations=reach)
    return (closed | padded)[reach:-reach]


def _attributes(walk: Walk, kind: str) -> dict[str, str | float]:
    subject = "user1" if walk.scene in SINGLE_USER else "unknown"
    return {
        "dataset": "oxiod",
        "scene": walk.scene,
        "session": walk.session,
        "group": walk.session,
        "kind": kind,
        "subject": walk.folder if walk.scene == "multi users" else subject,
        "device": walk.folder if walk.scene == "multi devices" else "iPhone 7 Plus",
        "placement": walk.placement,
        "licence": LICENCE,
    }
