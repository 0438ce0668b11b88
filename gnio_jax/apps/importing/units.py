"""Detection of units and signs from a header or from the data; ambiguous ones are refused."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from gnio_jax.errors import InputError
from gnio_jax.numerics import interpolate
from gnio_jax.types import GRAVITY, STANDARD_G

TO_RAD_PER_SECOND = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
TO_METRES_PER_SECOND_SQUARED = {"m/s2": 1.0, "g": STANDARD_G, "mg": STANDARD_G * 1e-3}
SIGNS = ("android", "ios", "detect")

_SPELLINGS = {
    "rad/s": ("rad/s", "rads^-1", "rads-1", "radian/s", "radians/s"),
    "deg/s": ("deg/s", "degs^-1", "degree/s", "degrees/s", "°/s", "dps"),
    "m/s2": ("m/s2", "m/s^2", "m/s²", "m/s/s", "ms^-2", "ms-2"),
    "g": ("g",),
    "mg": ("mg",),
    "s": ("s", "sec", "seconds"),
    "ms": ("ms",),
    "us": ("us", "µs", "μs"),
    "ns": ("ns",),
}
"""Our names of units, and their names in headers, without blanks and in small letters."""
_NAMED = {spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings}

GRAVITY_RANGES = {"m/s2": (7.0, 13.0), "g": (0.7, 1.3), "mg": (700.0, 1300.0)}
"""Ranges of the accelerometer's median magnitude, by which its unit is recognised."""
GYRO_RANGE = 35.0
"""Largest rate of a phone's gyro, rad/s: none measures more than 2000 deg/s."""
CARRIED_TURN = 10.0
"""A phone that somebody carries sometimes turns faster than this, deg/s."""
STEPS = 1.0
"""Standard deviation of the magnitude of the specific force, m/s², which steps exceed."""


class Motion(NamedTuple):
    """What both sensors of an IMU measured at the same stamps."""

    time: Float[np.ndarray, " n"]
    """s, increasing."""
    gyro: Float[np.ndarray, "n 3"]
    accel: Float[np.ndarray, "n 3"]


def named_unit(label: str) -> str | None:
    """The unit at the end of a column's header, in round or square brackets, such as "rad/s" in
    "Gyroscope x (rad/s)"; None if it names no known unit."""
    inside = re.search(r"[(\[]([^()\[\]]*)[)\]]\s*$", label)
    return _NAMED.get(re.sub(r"[\s*·]", "", inside[1]).lower()) if inside else None


def common_unit(labels: Iterable[str], known: Iterable[str]) -> str | None:
    """The unit, one of `known`, that all `labels` name."""
    found = {named_unit(label) for label in labels}
    return found.pop() if len(found) == 1 and found <= set(known) else None


def accel_scale(
    accel: Float[np.ndarray, "n 3"], unit: str | None, path: Path, notes: list[str]
) -> float:
    """Value of one unit in m/s²; the unit None is detected. Raises `InputError` if it is
    ambiguous."""
    if unit is not None:
        return TO_METRES_PER_SECOND_SQUARED[unit]
    size = float(np.median(np.linalg.norm(accel, axis=1)))
    fitting = [name for name, (low, high) in GRAVITY_RANGES.items() if low <= size <= high]
    if not fitting:
        problem = f"the unit of field 'accel' is ambiguous (median magnitude {size:.3g})"
        remedy = "state it, and give the specific force, gravity included"
        raise InputError(path, problem, remedy)
    notes.append(f"{path.name}: accel taken as {fitting[0]} (median magnitude {size:.3g})")
    return TO_METRES_PER_SECOND_SQUARED[fitting[0]]


def gyro_scale(imu: Motion, unit: str | None, path: Path, notes: list[str]) -> float:
    """Value of one unit in rad/s; the unit None is detected. `imu.accel` is in m/s².

    Beyond `GYRO_RANGE` it is deg/s. Otherwise the rotation of gravity in the accelerometer decides,
    if it is large enough. Otherwise, if the recording has steps and never exceeds `CARRIED_TURN`,
    it is rad/s. Raises `InputError` if it is ambiguous.
    """
    if unit is not None:
        return TO_RAD_PER_SECOND[unit]
    peak = float(np.percentile(np.linalg.norm(imu.gyro, axis=1), 99.9))
    slope, told = _turning_of_gravity(imu)
    found = {"rad/s": slope, "deg/s": slope / TO_RAD_PER_SECOND["deg/s"]}
    fitting = [name for name, share in found.items() if told and 0.5 < share < 2.0]
    shaken = float(np.linalg.norm(imu.accel, axis=1).std()) > STEPS
    if peak > GYRO_RANGE:
        unit, reason = "deg/s", f"it reaches {peak:.3g}, beyond any phone's range in rad/s"
    elif fitting:
        unit, reason = fitting[0], f"gravity turns by {slope:.2g} of it"
    elif peak <= CARRIED_TURN and shaken:
        reason = f"a carried phone turns faster than {CARRIED_TURN:g} deg/s"
        unit, reason = "rad/s", f"it reaches {peak:.3g}, and {reason}"
    else:
        problem = f"the unit of field 'gyro' is ambiguous (it reaches {peak:.3g})"
        raise InputError(path, problem, "state it: rad/s or deg/s")
    notes.append(f"{path.name}: gyro taken as {unit} ({reason})")
    return TO_RAD_PER_SECOND[unit]


def check_rad_per_second(imu: Motion, path: Path) -> None:
    """Raise `InputError` if a gyro whose unit a format or header states differs from the rotation
    of gravity by the factor between rad and deg. `imu` is in SI units according to that
    statement."""
    if contradiction := contradicting_unit(imu):
        problem = f"its gyro looks like {contradiction[0]}, which it does not say"
        problem += f" ({contradiction[1]})"
        raise InputError(path, problem, "state the unit of the gyro: rad/s or deg/s")


def contradicting_unit(imu: Motion) -> tuple[str, str] | None:
    """The unit that the rotation of gravity gives a gyro, and the reason, if it differs from the
    stated one by the factor between rad and deg; None if it does not, or shows nothing. `imu` is in
    SI units according to that statement."""
    (slope, told), factor = _turning_of_gravity(imu), TO_RAD_PER_SECOND["deg/s"]
    for share, unit in ((slope / factor, "deg/s"), (slope * factor, "rad/s")):
        if told and 0.5 < share < 2.0:
            return unit, f"gravity turns by {slope:.3g} of it"
    return None


def _turning_of_gravity(imu: Motion) -> tuple[float, bool]:
    """Slope of the change of the smoothed specific force over a second against −∫ω × f, which is 1
    if ω is in rad/s, and whether it shows the unit: if both correlate by more than 0.5."""
    step = float(np.median(np.diff(imu.time)))
    clock = np.arange(imu.time[0], imu.time[-1], step)
    if len(clock) < 3.0 / step:
        return 0.0, False
    force, rate = (
        gaussian_filter1d(interpolate(clock, imu.time, values), 0.5 / step, axis=0)
        for values in (imu.accel, imu.gyro)
    )
    # A bias is a constant rate; deviations from the median are motion.
    rate = rate - np.median(rate, axis=0)
    turned = np.cumsum(-np.cross(rate, force), axis=0) * step
    turned = np.concatenate([np.zeros((1, 3)), turned])[:-1]
    second = max(round(1.0 / step), 1)
    change, expected = force[second:] - force[:-second], turned[second:] - turned[:-second]
    power, strength = float((expected**2).sum()), float((change**2).sum())
    # If gravity has not moved, there is only noise and vibration.
    if power == 0.0 or strength / len(change) < 0.1**2:
        return 0.0, False
    both = float((change * expected).sum())
    return both / power, bool(both > 0.5 * np.sqrt(power * strength))


def signed(
    accel: Float[np.ndarray, "n 3"], sign: str, path: Path, notes: list[str]
) -> Float[np.ndarray, "n 3"]:
    """`accel` with Android's sign: at rest, level, the up axis reads +1 g.

    `sign` "ios" negates it, and "detect" assumes that the screen (+z) points up more than down.
    Raises `InputError` if that is ambiguous.
    """
    if sign == "detect":
        up = float(np.median(accel[:, 2]) / np.median(np.linalg.norm(accel, axis=1)))
        if abs(up) < 0.5:
            carried = f"its z axis carries {up:.2f} of gravity"
            problem = f"the sign of field 'accel' is ambiguous ({carried})"
            raise InputError(path, problem, "state it: android or ios")
        sign, name = ("android", "Android") if up > 0 else ("ios", "iOS")
        assumed = "assuming that the screen points up"
        notes.append(f"{path.name}: accel taken with {name}'s sign, {assumed}")
    if sign == "ios":
        notes.append(f"{path.name}: accel negated (iOS's sign)")
    return -accel if sign == "ios" else accel


def note_gravity(
    time: Float[np.ndarray, " n"], accel: Float[np.ndarray, "n 3"], path: Path, notes: list[str]
) -> str:
    """Add notes about gravity in the quietest second, and return the axis that reads most of it,
    such as "+z". Raises `InputError` if gravity is far off."""
    second = min(max(round(1.0 / float(np.median(np.diff(time)))), 2), len(accel))
    starts = range(0, len(accel) - second + 1, max(second // 2, 1))
    seconds = [accel[start : start + second] for start in starts]
    quietest = min(seconds, key=lambda rows: float(rows.var(axis=0).sum())).mean(axis=0)
    axis = int(np.argmax(np.abs(quietest)))
    force = float(np.linalg.norm(quietest))
    upward = f"{'-' if quietest[axis] < 0 else '+'}{'xyz'[axis]}"
    if abs(force - GRAVITY) > 2.0:
        problem = f"field 'accel' reads {force:.2f} m/s² in its quietest second, far from gravity"
        raise InputError(path, problem, "check its unit, and that gravity is in it")
    reads = f"accel reads {force:.2f} m/s², mostly on {upward}"
    notes.append(f"{path.name}: in the quietest second {reads}")
    if abs(force - GRAVITY) > 0.5:
        off = f"that is off gravity by {force - GRAVITY:+.2f} m/s²"
        notes.append(f"{path.name}: {off}: the accelerometer may need calibration")
    return upward
