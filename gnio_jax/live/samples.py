"""One IMU sample as a line of text."""

from __future__ import annotations

import json
import math
from typing import Any, NamedTuple

from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE

LONGEST_LINE = 4096
"""Characters; what is longer is no sample."""

MISSING = (math.nan, math.nan, math.nan)
"""Of a sensor that was not read."""


class Scale(NamedTuple):
    """What one unit of a stream is."""

    gyro: float = 1.0
    """rad/s."""
    accel: float = 1.0
    """m/s²."""


SI = Scale()


class Sample(NamedTuple):
    """Raw, in the body frame. A value that is missing is NaN."""

    time: float
    """s."""
    gyro: tuple[float, float, float]
    """rad/s."""
    accel: tuple[float, float, float]
    """m/s², +9.81 upwards at rest."""


def parse_line(line: str, scale: Scale = SI) -> Sample | None:
    """The sample of a line, whose units are `scale`, or None where it is no sample.

    Two forms: seven numbers `time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z`, separated by
    commas, semicolons, tabs or blanks, an empty one missing; or a JSON object with `time`, `gyro`
    and `accel`, a null missing, or one sensor alone. A line without a time, with too many numbers,
    or with rates or accelerations that no phone measures is no sample.
    """
    line = line.strip()
    if not line or len(line) > LONGEST_LINE:
        return None
    return _of_json(line, scale) if line.startswith("{") else _of_columns(line, scale)


def _of_columns(line: str, scale: Scale) -> Sample | None:
    separator = next((mark for mark in ",;\t" if mark in line), None)
    cells = [cell.strip() for cell in line.split(separator)]
    if len(cells) != 7:
        return None
    try:
        numbers = [float(cell) if cell else math.nan for cell in cells]
    except ValueError:
        return None
    return _checked(numbers[0], numbers[1:4], numbers[4:7], scale)


def _of_json(line: str, scale: Scale) -> Sample | None:
    try:
        found = json.loads(line)
        if "gyro" not in found and "accel" not in found:
            return None
        sensors = (found.get(name, [None] * 3) for name in ("gyro", "accel"))
        gyro, accel = ([_number(value) for value in values] for values in sensors)
        return _checked(_number(found["time"]), gyro, accel, scale)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError):
        return None


def _number(value: Any) -> float:
    """Raises `TypeError` for what is neither a number nor null."""
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    return float(value)


def _checked(time: float, gyro: list[float], accel: list[float], scale: Scale) -> Sample | None:
    if not math.isfinite(time) or len(gyro) != 3 or len(accel) != 3:
        return None
    gyro = [scale.gyro * value for value in gyro]
    accel = [scale.accel * value for value in accel]
    for values, largest in zip((gyro, accel), (FASTEST_TURN, STRONGEST_FORCE), strict=True):
        if any(abs(value) > largest for value in values):
            return None
    return Sample(time, (gyro[0], gyro[1], gyro[2]), (accel[0], accel[1], accel[2]))
