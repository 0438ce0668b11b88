"""Known walks for the writers of native files: every quantity in closed form, at any time.

The functions are of the one walk that nearly all of them use: loops of some metres with the bounce
and sway of a gait, and a body that turns about all its axes. The world is z-up and level, the body
an IMU's: `rate` and `force` are what it measures without any error. `SECONDS` is how long a
recording of it should be; the formulas hold for any time, also before 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

GRAVITY = 9.81
SECONDS = 36.0


class Term(NamedTuple):
    """offset + slope t + Σ amplitude sin(2π frequency t + phase), m or rad."""

    offset: float
    slope: float
    waves: tuple[tuple[float, float, float], ...]

    def derivative(self, order: int, time: np.ndarray) -> np.ndarray:
        line = (self.offset + self.slope * time, self.slope, 0.0)[order]
        return line + sum(
            (2 * np.pi * f) ** order * a * np.sin(2 * np.pi * f * time + p + order * np.pi / 2)
            for a, f, p in self.waves
        )


class Walk(NamedTuple):
    """A place of three terms in the world, and an attitude Rz(yaw) Rx(pitch) Ry(roll)."""

    coordinates: tuple[Term, Term, Term]
    angles: tuple[Term, Term, Term]

    def paced(self, pace: float) -> Walk:
        """The same walk, so many times as fast."""

        def faster(term: Term) -> Term:
            waves = tuple((a, pace * f, p) for a, f, p in term.waves)
            return Term(term.offset, pace * term.slope, waves)

        return Walk(*(tuple(map(faster, terms)) for terms in self))

    def _at(self, terms: tuple[Term, ...], order: int, time: np.ndarray) -> np.ndarray:
        time = np.asarray(time, dtype=np.float64)
        return np.stack([term.derivative(order, time) for term in terms], axis=-1)

    def position(self, time: np.ndarray) -> np.ndarray:
        """(n, 3) m in the world."""
        return self._at(self.coordinates, 0, time)

    def velocity(self, time: np.ndarray) -> np.ndarray:
        """(n, 3) m/s in the world."""
        return self._at(self.coordinates, 1, time)

    def attitude(self, time: np.ndarray) -> Rotation:
        """n rotations body → world."""
        return Rotation.from_euler("ZXY", self._at(self.angles, 0, time))

    def rate(self, time: np.ndarray) -> np.ndarray:
        """(n, 3) angular rate in the body, rad/s: what a perfect gyro reads."""
        _, pitch, roll = np.moveaxis(self._at(self.angles, 0, time), -1, 0)
        yaw_rate, pitch_rate, roll_rate = np.moveaxis(self._at(self.angles, 1, time), -1, 0)
        # The axes of yaw and pitch, seen from the body: Ryᵀ Rxᵀ z and Ryᵀ x.
        return np.stack(
            [
                -np.cos(pitch) * np.sin(roll) * yaw_rate + np.cos(roll) * pitch_rate,
                np.sin(pitch) * yaw_rate + roll_rate,
                np.cos(pitch) * np.cos(roll) * yaw_rate + np.sin(roll) * pitch_rate,
            ],
            axis=-1,
        )

    def force(self, time: np.ndarray) -> np.ndarray:
        """(n, 3) specific force in the body, m/s²: what a perfect accelerometer reads, level at
        rest (0, 0, 9.81)."""
        acceleration = self._at(self.coordinates, 2, time)
        return self.attitude(time).inv().apply(acceleration + np.array([0.0, 0.0, GRAVITY]))


KNOWN = Walk(
    (
        Term(0.4, 0.05, ((2.2, 1 / 14.0, 0.0), (0.02, 0.9, 0.5))),
        Term(-0.7, 0.02, ((1.3, 1 / 7.0, 0.3), (0.03, 0.9, 2.0), (0.01, 1.8, 1.0))),
        Term(1.2, 0.0, ((0.10, 1 / 9.0, 0.2), (0.025, 1.8, 0.0))),
    ),
    (
        Term(0.8, 2 * np.pi / 14.0, ((0.5, 1 / 6.1, 0.0), (0.06, 0.9, 0.0))),
        Term(0.35, 0.0, ((0.35, 1 / 5.3, 0.7), (0.05, 1.8, 0.3))),
        Term(-0.1, 0.0, ((0.40, 1 / 7.9, 0.4), (0.05, 0.9, 1.4))),
    ),
)
position, velocity, attitude = KNOWN.position, KNOWN.velocity, KNOWN.attitude
rate, force = KNOWN.rate, KNOWN.force


def compare(
    sequence, time, metres=1e-3, degrees=0.1, speed=0.02, imu=1e-3, bias=0.0, edge=0, origin=0.0
):
    """`sequence` tells of the walk at `time` (s), its positions from `origin`: the reference where
    it is valid, IMU and velocity but for `edge` samples at either end, where splines err more."""
    inner, valid = slice(edge, len(time) - edge), sequence.valid
    np.testing.assert_allclose((sequence.gyro - bias)[inner], rate(time)[inner], atol=imu)
    np.testing.assert_allclose(sequence.accel[inner], force(time)[inner], atol=imu)
    off = np.linalg.norm(sequence.position - (position(time) - origin), axis=1)
    assert (off < metres)[valid].all()
    wxyz = sequence.orientation[valid]
    turned = Rotation.from_quat(wxyz, scalar_first=True) * attitude(time[valid]).inv()
    assert np.degrees(turned.magnitude()).max() < degrees
    assert np.abs(sequence.velocity - velocity(time))[inner][valid[inner]].max() < speed
    for field in (sequence.position, sequence.orientation):
        assert np.isnan(field[~valid]).all()
