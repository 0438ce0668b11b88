"""One known walk for the writers of native files: every quantity in closed form, at any time.

Loops of some metres with the bounce and sway of a gait, and a body that turns about all its axes.
The world is z-up and level, the body an IMU's: `rate` and `force` are what it measures without any
error. `SECONDS` is how long a recording of it should be; the formulas hold for any time, also
before 0.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

GRAVITY = 9.81
SECONDS = 36.0

# value(t) = offset + slope t + Σ amplitude sin(2π frequency t + phase), m and rad.
_PLACE = (
    (0.4, 0.05, ((2.2, 1 / 14.0, 0.0), (0.02, 0.9, 0.5))),
    (-0.7, 0.02, ((1.3, 1 / 7.0, 0.3), (0.03, 0.9, 2.0), (0.01, 1.8, 1.0))),
    (1.2, 0.0, ((0.10, 1 / 9.0, 0.2), (0.025, 1.8, 0.0))),
)
_YAW = (0.8, 2 * np.pi / 14.0, ((0.5, 1 / 6.1, 0.0), (0.06, 0.9, 0.0)))
_PITCH = (0.35, 0.0, ((0.35, 1 / 5.3, 0.7), (0.05, 1.8, 0.3)))
_ROLL = (-0.1, 0.0, ((0.40, 1 / 7.9, 0.4), (0.05, 0.9, 1.4)))


def _value(term: tuple, time: np.ndarray) -> np.ndarray:
    offset, slope, waves = term
    return offset + slope * time + sum(a * np.sin(2 * np.pi * f * time + p) for a, f, p in waves)


def _first(term: tuple, time: np.ndarray) -> np.ndarray:
    _, slope, waves = term
    return slope + sum(2 * np.pi * f * a * np.cos(2 * np.pi * f * time + p) for a, f, p in waves)


def _second(term: tuple, time: np.ndarray) -> np.ndarray:
    return sum(
        -((2 * np.pi * f) ** 2) * a * np.sin(2 * np.pi * f * time + p) for a, f, p in term[2]
    )


def position(time: np.ndarray) -> np.ndarray:
    """(n, 3) m in the world."""
    time = np.asarray(time, dtype=np.float64)
    return np.stack([_value(term, time) for term in _PLACE], axis=-1)


def velocity(time: np.ndarray) -> np.ndarray:
    """(n, 3) m/s in the world."""
    time = np.asarray(time, dtype=np.float64)
    return np.stack([_first(term, time) for term in _PLACE], axis=-1)


def acceleration(time: np.ndarray) -> np.ndarray:
    """(n, 3) m/s² in the world, without gravity."""
    time = np.asarray(time, dtype=np.float64)
    return np.stack([_second(term, time) for term in _PLACE], axis=-1)


def attitude(time: np.ndarray) -> Rotation:
    """n rotations body → world: Rz(yaw) Rx(pitch) Ry(roll)."""
    time = np.asarray(time, dtype=np.float64)
    return Rotation.from_euler(
        "ZXY", np.stack([_value(term, time) for term in (_YAW, _PITCH, _ROLL)], axis=-1)
    )


def rate(time: np.ndarray) -> np.ndarray:
    """(n, 3) angular rate in the body, rad/s: what a perfect gyro reads."""
    time = np.asarray(time, dtype=np.float64)
    pitch, roll = _value(_PITCH, time), _value(_ROLL, time)
    yaw_rate, pitch_rate, roll_rate = (_first(term, time) for term in (_YAW, _PITCH, _ROLL))
    # The axes of yaw and pitch, seen from the body: Ryᵀ Rxᵀ z and Ryᵀ x.
    return np.stack(
        [
            -np.cos(pitch) * np.sin(roll) * yaw_rate + np.cos(roll) * pitch_rate,
            np.sin(pitch) * yaw_rate + roll_rate,
            np.cos(pitch) * np.cos(roll) * yaw_rate + np.sin(roll) * pitch_rate,
        ],
        axis=-1,
    )


def force(time: np.ndarray) -> np.ndarray:
    """(n, 3) specific force in the body, m/s²: what a perfect accelerometer reads, level at rest
    (0, 0, 9.81)."""
    return attitude(time).inv().apply(acceleration(time) + np.array([0.0, 0.0, GRAVITY]))


def walked(time: np.ndarray) -> float:
    """Length of the path over the stamps `time`, m."""
    return float(np.linalg.norm(np.diff(position(time), axis=0), axis=1).sum())


def compare(
    sequence, time, metres=1e-3, degrees=0.1, speed=0.02, imu=1e-3, bias=0.0, edge=0, origin=0.0
):
    """`sequence` tells of the walk at `time` (s), its positions from `origin`: the reference where
    it is valid, IMU and velocity but for `edge` samples at either end, where splines err more."""
    inner, valid = slice(edge, len(time) - edge), sequence.valid
    np.testing.assert_allclose((sequence.gyro - bias)[inner], rate(time)[inner], atol=imu)
    np.testing.assert_allclose(sequence.accel[inner], force(time)[inner], atol=imu)
    off = np.linalg.norm(sequence.position - (position(time) - origin), axis=1)
    assert off[valid].max() < metres
    wxyz = sequence.orientation[valid]
    turned = Rotation.from_quat(wxyz, scalar_first=True) * attitude(time[valid]).inv()
    assert np.degrees(turned.magnitude()).max() < degrees
    assert np.abs(sequence.velocity - velocity(time))[inner][valid[inner]].max() < speed
    assert (
        np.isnan(sequence.position[~valid]).all() and np.isnan(sequence.orientation[~valid]).all()
    )
