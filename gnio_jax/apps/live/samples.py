"""Samples, what else comes from a source, and samples as lines of text."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from gnio_jax.apps.importing import units
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE

LONGEST_LINE = 4096
"""Largest number of characters of a sample."""
MISSING = (math.nan, math.nan, math.nan)
"""Values of a sensor that was not read."""
NO_SAMPLE = "is not a sample: time,gyro x,y,z,accel x,y,z or JSON is expected"
Vector = tuple[float, float, float]


class Sample(NamedTuple):
    """A sample, raw, in the body frame. A missing value is NaN."""

    time: float
    """s."""
    gyro: Vector
    """rad/s."""
    accel: Vector
    """m/s², +9.81 upwards at rest."""

    @property
    def whole(self) -> bool:
        """Whether both sensors were read."""
        return is_finite(self.gyro) and is_finite(self.accel)


class Arrival(NamedTuple):
    """Something that came from a source. One without a sample and without a text says only that
    time has passed."""

    clock: float
    """Time at which it came by the clock of this machine (`time.monotonic`), s."""
    sample: Sample | None = None
    refusal: str = ""
    """Why a line, or a row of a message, is not a sample."""
    notice: str = ""
    """A message for the user."""
    waiting: str = ""
    """What is needed before there can be a pose."""


class Units(NamedTuple):
    """Units of the sensors, by the names that an import knows."""

    gyro: str = "rad/s"
    accel: str = "m/s2"


SI = Units()


def parse_line(line: str, stated: Units = SI) -> Sample | None:
    """The sample of a line with the units `stated`, or None if it is not a sample.

    There are two forms. One is seven numbers `time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z`,
    separated by commas, semicolons, tabs or blanks; an empty cell is a missing value. The other is
    a JSON object with `time`, `gyro` and `accel`, or with one sensor alone; null is a missing
    value. A line without a time, with too many numbers, or with rates or accelerations beyond the
    range of a phone is no sample.
    """
    line = line.strip()
    if not line or len(line) > LONGEST_LINE:
        return None
    try:
        if line.startswith("{"):
            fields = json.loads(line)
            if not {"gyro", "accel"} & fields.keys():
                return None
            cells = [fields.get(name, [None] * 3) for name in ("gyro", "accel")]
            stamp, (gyro, accel) = number(fields["time"]), (list(map(number, c)) for c in cells)
        else:
            separator = next((mark for mark in ",;\t" if mark in line), None)
            numbers = [_cell(cell) for cell in line.split(separator)]
            stamp, gyro, accel = numbers[0], numbers[1:4], numbers[4:]
        if len(gyro) != 3 or len(accel) != 3:
            return None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
        return None
    return sample_of(stamp, gyro, accel, stated)


def sample_of(
    stamp: float, gyro: Iterable[float], accel: Iterable[float], stated: Units = SI
) -> Sample | None:
    """The sample of three numbers of each sensor, or None for a stamp that is not finite, or for
    values beyond the range of an IMU."""
    x, y, z = (units.UNITS["gyro"][stated.gyro] * rate for rate in gyro)
    a, b, c = (units.UNITS["accel"][stated.accel] * force for force in accel)
    beyond = any(abs(rate) > FASTEST_TURN for rate in (x, y, z))
    beyond = beyond or any(abs(axis) > STRONGEST_FORCE for axis in (a, b, c))
    return None if beyond or not math.isfinite(stamp) else Sample(stamp, (x, y, z), (a, b, c))


def parse_lines(message: bytes, stated: Units = SI) -> Iterator[Sample | str]:
    """The samples of the lines of a message, or why a line is none. Empty lines do not count."""
    for line in message.decode("utf-8", "replace").splitlines():
        if line.strip():
            yield parse_line(line, stated) or NO_SAMPLE


def number(value: Any) -> float:
    """The number, NaN for null. Raises `TypeError` for other values."""
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    return float(value)


def _cell(text: str) -> float:
    """The number in a cell, NaN if it is empty. Python also reads `1_0` and the digits of other
    scripts, which no logger writes. Raises `ValueError`."""
    text = text.strip()
    if not text.isascii() or "_" in text:
        raise ValueError
    return float(text) if text else math.nan


def is_finite(values: Iterable[float]) -> bool:
    """Whether a sensor was read on all axes."""
    return all(map(math.isfinite, values))


def is_missing(values: Iterable[float]) -> bool:
    """Whether a sensor was not read."""
    return all(map(math.isnan, values))
