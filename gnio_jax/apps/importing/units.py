"""Units and signs of the sensors: from an option or a header, or detected from the data. What is
ambiguous is refused."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gnio_jax.data.physics import DEGREE, ImuSamples, agreement, is_supported
from gnio_jax.errors import InputError
from gnio_jax.types import GRAVITY, STANDARD_G

TO_RAD_PER_SECOND = {"rad/s": 1.0, "deg/s": DEGREE}
TO_METRES_PER_SECOND_SQUARED = {"m/s2": 1.0, "g": STANDARD_G, "mg": STANDARD_G * 1e-3}
"""Units that `gnio live` takes too."""
GYRO_UNITS = TO_RAD_PER_SECOND | {"mdps": DEGREE * 1e-3, "mrad/s": 1e-3}
ACCEL_UNITS = TO_METRES_PER_SECOND_SQUARED | {"cm/s2": 1e-2, "mm/s2": 1e-3}
SIGNS = ("android", "ios", "detect")

_SPELLINGS = {
    "rad/s": "rad/s rads-1 rad/sec radian/s radians/s radps rps rads radpersec",
    "deg/s": "deg/s degs-1 deg/sec degree/s degrees/s °/s º/s dps degs degpersec",
    "mdps": "mdps mdeg/s millidps",
    "mrad/s": "mrad/s",
    "m/s2": "m/s2 m/s/s ms-2 ms2 mps2 m/sec2 m/(s2) m/(sec2)",
    "cm/s2": "cm/s2 cms2",
    "mm/s2": "mm/s2 mms2",
    "g": "g gs g's",
    "mg": "mg milli-g millig",
    "s": "s sec secs second seconds",
    "ms": "ms msec msecs millis millisec milliseconds msecond",
    "us": "us µs μs usec usecs micros microsec microseconds",
    "ns": "ns nsec nsecs nanosecs nanos nanosec nanoseconds",
}
"""Our names of units, and their names in headers as `_spelling` writes them."""
_NAMED = {name: unit for unit, names in _SPELLINGS.items() for name in names.split()}
_BRACKETS = re.compile(r"\s*[(\[]([^\[\]]*)[)\]]\s*$")
_TAIL = re.compile(
    r"(?<=[xyz])[_ .]?((rad|deg)[/_]?(s|sec|per_?sec)|[cm]?m[/_]?(s|sec)\^?2|m?dps|mps2|m?g)$",
    re.IGNORECASE,
)
"""A unit behind the axis, as in gyro_x_dps."""

GRAVITY_RANGES = {"m/s2": (7.0, 13.0), "g": (0.7, 1.3), "mg": (700.0, 1300.0)}
"""Ranges of the accelerometer's median magnitude, by which its unit is recognised."""
COUNTS_OF_G = {16384: 2, 8192: 4, 4096: 8, 2048: 16, 256: 16}
"""Counts of usual 16-bit accelerometers in 1 g, and their range, g."""
GYRO_RANGE = 35.0
"""Largest rate of a phone's gyro, rad/s: none measures more than 2000 deg/s."""
WIDEST_RANGE = 4000.0
"""Largest rate of any gyro, deg/s."""
CARRIED_TURN = 10.0
"""A phone that somebody carries sometimes turns faster than this, deg/s."""
STEPS = 1.0
"""Standard deviation of the magnitude of the specific force, m/s², which steps exceed."""


def _spelling(text: str) -> str:
    """A unit in small letters, without blanks and signs of products and powers."""
    text = re.sub(r"^[(\[](.*)[)\]]$", r"\1", text.strip()).translate(str.maketrans("²⁻¹", "2-1"))
    return re.sub(r"[\s*·^_]", "", text).lower()


def unit_text(label: str) -> str | None:
    """The text in round or square brackets at the end of a column's header, or a known unit behind
    the axis; None if there is none."""
    match = _BRACKETS.search(label) or _TAIL.search(label)
    return match[1].strip() if match else None


def without_unit(label: str) -> str:
    """A column's header without its `unit_text`."""
    return _TAIL.sub("", _BRACKETS.sub("", label))


def unit_of(text: str | None) -> str | None:
    """Our name of a unit, such as "rad/s" for "rad s^-1"; None if it is no known unit."""
    return _NAMED.get(_spelling(text or ""))


def are_units(cells: Iterable[str]) -> bool:
    """Whether a line of a header names units: two of its cells do."""
    return sum(unit_of(cell) is not None for cell in cells) > 1


def common_unit(
    texts: Mapping[str, str | None], known: Mapping[str, float], path: Path
) -> str | None:
    """The unit, one of `known`, that the columns name; `texts`: column → the unit it names or None.
    None if none names one. Raises `InputError` for a unit that is not known, or several."""
    names = {c: t for c, t in texts.items() if t and not re.fullmatch(r"[xyz]|\d+", t.lower())}
    units = {unit_of(text) for text in names.values()}
    for column, text in names.items():
        if unit_of(text) not in known or len(units) > 1:
            problem = f"column '{column}' is in '{text}', unlike others or no known unit"
            remedy = f"state one of {', '.join(known)}, or raw counts as in 131/deg/s or 16384/g"
            raise InputError(path, problem, remedy)
    return units.pop() if units else None


def scale_of(stated: str, known: Mapping[str, float], option: str) -> float:
    """Value of 1 in SI units of a unit: a name of `known`, "131/deg/s" (counts in one deg/s) or
    "0.061*mg" (the unit of one count). Raises `InputError`."""
    match = re.fullmatch(r"(?:(\d[0-9.e+-]*|\.\d+)([/*]))?(.+)", stated.strip())
    number, mark, name = match.groups() if match else ("0", "", "")
    unit = name if name in known else unit_of(name)
    try:
        size = known[unit or ""] * float(number or 1) ** (-1 if mark == "/" else 1)
    except (KeyError, ValueError, ZeroDivisionError):
        size = 0.0
    if not 0.0 < size < np.inf:
        remedy = f"known: {', '.join(known)}, counts in one as 16384/g, or their size as 0.061*mg"
        raise InputError(option, f"unknown value '{stated}'", remedy)
    return size


def accel_scale(
    accel: Float[np.ndarray, "n 3"],
    unit: str | None,
    path: Path,
    notes: list[str],
    warnings: list[str],
) -> float:
    """Value of one unit in m/s²; the unit None is detected. Raises `InputError` if it is
    ambiguous."""
    if unit is not None:
        return scale_of(unit, ACCEL_UNITS, "accel_unit")
    size = float(np.median(np.linalg.norm(accel, axis=1)))
    fitting = [name for name, (low, high) in GRAVITY_RANGES.items() if low <= size <= high]
    if not fitting:
        problem = f"the unit of field 'accel' is ambiguous (median magnitude {size:.3g})"
        remedy = "state it, and give the specific force, gravity included"
        for count, reach in COUNTS_OF_G.items():
            if 0.8 < size / count < 1.25:
                remedy = f"raw counts? {count} per g is the scale of ±{reach} g: --accel-unit "
                remedy += f"{count}/g"
        raise InputError(path, problem, remedy)
    notes.append(f"{path.name}: accel taken as {fitting[0]} (median magnitude {size:.3g})")
    if fitting == ["mg"]:
        problem = f"unit: {size:.0f} is gravity in mg (1000) as well as in cm/s² (981), which is"
        warnings.append(f"{problem} ambiguous: state --accel-unit mg or cm/s2")
    return ACCEL_UNITS[fitting[0]]


def gyro_scale(
    imu: ImuSamples, unit: str | None, path: Path, notes: list[str], warnings: list[str]
) -> float:
    """Value of one unit in rad/s; the unit None is detected. `imu.accel` is in m/s².

    Beyond `GYRO_RANGE` it is deg/s. Otherwise the turning of gravity decides, if it supports a
    unit. Otherwise, if the recording has steps and never exceeds `CARRIED_TURN`, it is rad/s.
    Raises `InputError` if it is ambiguous.
    """
    peak = float(np.percentile(np.linalg.norm(imu.gyro, axis=1), 99.9))
    is_shaken = float(np.linalg.norm(imu.accel, axis=1).std()) > STEPS
    if unit is not None:
        scale = scale_of(unit, GYRO_UNITS, "gyro_unit")
        if is_shaken and peak * scale < CARRIED_TURN * DEGREE:
            problem = f"the gyro never exceeds {peak * scale / DEGREE:.2g} deg/s, and a carried"
            warnings.append(f"sensors: {problem} phone does: check its unit, {unit}")
        return scale
    agreements = {name: agreement(imu, scale) for name, scale in TO_RAD_PER_SECOND.items()}
    contrasts = {name: one[1] for name, one in agreements.items() if is_supported(*one)}
    if peak > WIDEST_RANGE:
        problem = f"field 'gyro' reaches {peak:.3g}, beyond any gyro's range in rad/s and deg/s"
        raise InputError(path, problem, "state its unit: mdps, or raw counts as 131/deg/s")
    if peak > GYRO_RANGE:
        unit, reason = "deg/s", f"it reaches {peak:.3g}, beyond any phone's range in rad/s"
    elif contrasts:
        unit = max(contrasts, key=lambda name: contrasts[name])
        reason = f"gravity turns by it, and {contrasts[unit]:.2g} times less against it"
    elif peak <= CARRIED_TURN and is_shaken:
        reason = f"a carried phone turns faster than {CARRIED_TURN:g} deg/s"
        unit, reason = "rad/s", f"it reaches {peak:.3g}, and {reason}"
    else:
        problem = f"the unit of field 'gyro' is ambiguous (it reaches {peak:.3g})"
        raise InputError(path, problem, "state it: rad/s or deg/s")
    notes.append(f"{path.name}: gyro taken as {unit} ({reason})")
    return TO_RAD_PER_SECOND[unit]


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
