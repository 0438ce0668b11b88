"""Units and signs of the sensors: from an option or a header, or detected from the data. What is
ambiguous is refused."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gnio_jax.data.labels import unit_of
from gnio_jax.data.physics import DEGREE, ImuSamples, agreement, contradiction, is_supported
from gnio_jax.errors import InputError
from gnio_jax.types import GRAVITY, STANDARD_G

TO_RAD_PER_SECOND = {"rad/s": 1.0, "deg/s": DEGREE}
TO_METRES_PER_SECOND_SQUARED = {"m/s2": 1.0, "g": STANDARD_G, "mg": STANDARD_G * 1e-3}
"""Units that `gnio live` takes too."""
UNITS = {
    "gyro": TO_RAD_PER_SECOND | {"mdps": DEGREE * 1e-3, "mrad/s": 1e-3},
    "accel": TO_METRES_PER_SECOND_SQUARED | {"cm/s2": 1e-2, "mm/s2": 1e-3},
}
COUNTS = {"gyro": "131/deg/s", "accel": "16384/g"}
COUNT_SIZES = {"gyro": "0.00875*deg/s", "accel": "0.061*mg"}
"""Examples of raw counts: how many are one unit, and the size of one."""
SIGNS = ("android", "ios", "detect")
GRAVITY_RANGES = {"m/s2": (7.0, 13.0), "g": (0.7, 1.3), "mg": (700.0, 1300.0)}
"""Ranges of the accelerometer's median magnitude, by which its unit is recognised."""
COUNTS_OF_G = {16384: 2, 8192: 4, 4096: 8, 2048: 16, 256: 16}
"""Counts of usual 16-bit accelerometers in 1 g, and their range, g."""
PHONE_RANGE, WIDEST_RANGE = 35.0, 4000.0
"""Largest rates of a phone's gyro, rad/s (2000 deg/s), and of any gyro, deg/s."""
CARRIED_TURN, STEPS = 10.0, 1.0
"""A phone that somebody carries sometimes turns faster, deg/s; steps exceed this standard deviation
of the magnitude of the specific force, m/s²."""


def common_unit(texts: Mapping[str, str | None], sensor: str, path: Path) -> str | None:
    """The unit of a sensor that its columns name, whose `texts` are; None if none names one. Raises
    `InputError` for a unit that is not known, or several."""
    names = {c: t for c, t in texts.items() if t and not re.fullmatch(r"[xyz]|\d+", t.lower())}
    common = {unit_of(text) for text in names.values()}
    for column, text in names.items():
        if unit_of(text) not in UNITS[sensor] or len(common) > 1:
            problem = f"column '{column}' is in '{text}', unlike others or no known unit"
            remedy = f"state one of {', '.join(UNITS[sensor])}, or raw counts: --{sensor}-unit"
            raise InputError(path, problem, f"{remedy} {COUNTS[sensor]}")
    return common.pop() if common else None


def scale_of(stated: str, sensor: str) -> float:
    """Value of 1 in SI units of a unit: a name of `UNITS`, "131/deg/s" (counts in one deg/s) or
    "0.061*mg" (the unit of one count). Raises `InputError`."""
    match = re.fullmatch(r"(?:(\d[0-9.e+-]*|\.\d+)([/*]))?(.+)", stated.strip())
    number, mark, name = match.groups() if match else ("0", "", "")
    sizes, unit = UNITS[sensor], name if name in UNITS[sensor] else unit_of(name)
    try:
        size = sizes[unit or ""] * float(number or 1) ** (-1 if mark == "/" else 1)
    except (KeyError, ValueError, ZeroDivisionError):
        size = 0.0
    if not 0.0 < size < np.inf:
        remedy = f"known: {', '.join(sizes)}, counts in one as {COUNTS[sensor]}, or their size as"
        remedy = f"{remedy} {COUNT_SIZES[sensor]}"
        raise InputError(f"{sensor}_unit", f"unknown value '{stated}'", remedy)
    return size


def accel_scale(
    accel: Float[np.ndarray, "n 3"], stated: str | None, path: Path, notes: list[str]
) -> tuple[float, list[str]]:
    """Value of one unit in m/s², and warnings; without a unit it is detected. Raises `InputError`
    if it is ambiguous."""
    if stated is not None:
        return scale_of(stated, "accel"), []
    size = float(np.median(np.linalg.norm(accel, axis=1)))
    fitting = [name for name, (low, high) in GRAVITY_RANGES.items() if low <= size <= high]
    if not fitting:
        problem = f"the unit of field 'accel' is ambiguous (median magnitude {size:.3g})"
        remedy = "state it, and give the specific force, gravity included"
        for count, reach in COUNTS_OF_G.items():
            if 0.8 < size / count < 1.25:
                remedy = f"raw counts? {count} per g is the scale of ±{reach} g: --accel-unit"
                remedy += f" {count}/g"
        raise InputError(path, problem, remedy)
    notes.append(f"{path.name}: accel taken as {fitting[0]} (median magnitude {size:.3g})")
    problem = f"unit: {size:.0f} is gravity in mg (1000) as well as in cm/s² (981), which is"
    warnings = [f"{problem} ambiguous: state --accel-unit mg or cm/s2"] * (fitting == ["mg"])
    return UNITS["accel"][fitting[0]], warnings


def gyro_scale(
    imu: ImuSamples, stated: str | None, path: Path, notes: list[str]
) -> tuple[float, list[str]]:
    """Value of one unit in rad/s, and warnings; without a unit it is detected, with accel in m/s².

    Beyond `PHONE_RANGE` it is deg/s. Otherwise the turning of gravity decides, if it supports a
    unit. Otherwise, if the recording has steps and never exceeds `CARRIED_TURN`, it is rad/s.
    Raises `InputError` if it is ambiguous.
    """
    peak = float(np.percentile(np.linalg.norm(imu.gyro, axis=1), 99.9))
    is_shaken = float(np.linalg.norm(imu.accel, axis=1).std()) > STEPS
    if stated is not None:
        scale = scale_of(stated, "gyro")
        problem = f"sensors: the gyro never exceeds {peak * scale / DEGREE:.2g} deg/s, and that of"
        is_slow = is_shaken and peak * scale < CARRIED_TURN * DEGREE
        return scale, [f"{problem} a carried phone does: check its unit, {stated}"] * is_slow
    if peak > WIDEST_RANGE:
        problem = f"field 'gyro' reaches {peak:.3g}, beyond any gyro's range in rad/s and deg/s"
        raise InputError(path, problem, "state its unit: mdps, or raw counts as 131/deg/s")
    agreements = {name: agreement(imu, scale) for name, scale in TO_RAD_PER_SECOND.items()}
    contrasts = {name: one[1] for name, one in agreements.items() if is_supported(*one)}
    if peak > PHONE_RANGE:
        unit, reason = "deg/s", f"it reaches {peak:.3g}, beyond any phone's range in rad/s"
    elif contrasts:
        unit = max(contrasts, key=lambda name: contrasts[name])
        reason = f"gravity turns by it, and {contrasts[unit]:.2g} times less against it"
    elif peak <= CARRIED_TURN and is_shaken:
        reason = f"a carried phone turns faster than {CARRIED_TURN:g} deg/s"
        unit, reason = "rad/s", f"it reaches {peak:.3g}, and {reason}"
    else:
        problem = f"the unit of field 'gyro' is ambiguous (it reaches {peak:.3g})"
        factor, doubt, _ = contradiction(imu) or (0.0, "", "")
        doubt = f"; in rad/s {doubt}" if factor else ""
        raise InputError(path, problem, f"state it: rad/s or deg/s{doubt}")
    notes.append(f"{path.name}: gyro taken as {unit} ({reason})")
    return TO_RAD_PER_SECOND[unit], []


def with_sign(
    accel: Float[np.ndarray, "n 3"], sign: str, path: Path, notes: list[str]
) -> Float[np.ndarray, "n 3"]:
    """`accel` with Android's sign: at rest, level, the up axis reads +1 g. `sign` "ios" negates it,
    and "detect" assumes that the screen (+z) points up more than down. Raises `InputError` if that
    is ambiguous."""
    if sign == "detect":
        up = float(np.median(accel[:, 2]) / np.median(np.linalg.norm(accel, axis=1)))
        if abs(up) < 0.5:
            problem = f"the sign of field 'accel' is ambiguous (its z axis carries {up:.2f} of"
            raise InputError(path, f"{problem} gravity)", "state it: android or ios")
        sign, name = ("android", "Android") if up > 0 else ("ios", "iOS")
        remark = f"accel taken with {name}'s sign, assuming that the screen points up"
        notes.append(f"{path.name}: {remark}")
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
    remark = f"in the quietest second accel reads {force:.2f} m/s², mostly on {upward}"
    if abs(force - GRAVITY) > 0.5:
        remark += f", off gravity by {force - GRAVITY:+.2f} m/s²: it may need calibration"
    notes.append(f"{path.name}: {remark}")
    return upward
