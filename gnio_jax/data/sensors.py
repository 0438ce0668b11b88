"""Sensors beside the IMU: their names, the columns of their readings, and what a reading may be.

Readings keep the stamps of their sensor, because a fix of position every second cannot be resampled
to the rate of an IMU. All limits are ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.errors import InputError
from gnio_jax.types import Readings

MAGNETOMETER, BAROMETER, GNSS = "magnetometer", "barometer", "gnss"
MARGIN = 1.0
"""Time before the first and after the last sample of the IMU from which readings are kept, s."""


class SensorKind(NamedTuple):
    """What a sensor reads."""

    columns: tuple[str, ...]
    """Names of the values of a reading."""
    unit: str
    required: int
    """Number of columns, the first ones, that a reading must have; the others may be NaN."""
    usual: tuple[float, float]
    """Smallest and largest median of the size of a reading, which is the norm of the required
    columns."""
    limits: tuple[float, ...] = ()
    """Largest absolute value of the first columns."""
    other_units: tuple[tuple[str, float], ...] = ()
    """Units in which the sensor is also written, and their size."""


SENSOR_KINDS = {
    MAGNETOMETER: SensorKind(
        ("x", "y", "z"),
        "µT",
        3,
        # The earth's field has 22 to 67 µT, and the phone's own may be as large.
        (15.0, 150.0),
        other_units=(("gauss", 100.0), ("T", 1e6), ("nT", 1e-3), ("mT", 1e3)),
    ),
    BAROMETER: SensorKind(
        ("pressure",),
        "Pa",
        1,
        (3.0e4, 1.1e5),  # on the earth's surface
        other_units=(("hPa", 100.0), ("kPa", 1e3), ("bar", 1e5)),
    ),
    GNSS: SensorKind(
        ("latitude", "longitude", "altitude"), "°, °, m", 2, (0.0, np.inf), (90.0, 180.0)
    ),
}
"""The sensors that the filter knows, and their readings: the field in the axes of the IMU, the
pressure, and a place on the earth (WGS 84), whose standard deviations are in m east, north and
up."""


def check_readings(
    sensor: str, readings: Readings, clock: Float[np.ndarray, " n"], source: object
) -> None:
    """Raise `InputError` if the readings of a sensor are not what `SENSOR_KINDS` says, or none of
    them is on the clock (s) of the IMU."""
    time, values, std = readings
    field = f"field '{sensor}'"
    kind = SENSOR_KINDS.get(sensor)
    if kind is None:
        raise InputError(source, f"{field} is no known sensor", f"known: {', '.join(SENSOR_KINDS)}")
    shape = (len(time), len(kind.columns))
    if time.ndim != 1 or not len(time) or values.shape != shape or std.shape != shape:
        shapes = f"time {time.shape}, values {values.shape} and std {std.shape}"
        problem = f"{field} has {shapes}, expected (f,), (f, {shape[1]}) and (f, {shape[1]})"
        raise InputError(source, problem, "give each stamp one row")
    if not np.isfinite(time).all() or not (np.diff(time) > 0).all():
        problem = f"the stamps of {field} do not increase, or are not finite"
        raise InputError(source, problem, "sort its rows and drop repeated ones")
    if time[-1] < clock[0] - MARGIN or time[0] > clock[-1] + MARGIN:
        problem = f"the stamps of {field} ({time[0]:.2f} to {time[-1]:.2f} s) share nothing with"
        problem += f" the IMU's ({clock[0]:.2f} to {clock[-1]:.2f} s)"
        raise InputError(source, problem, "give its stamps by the clock of the IMU")
    required = values[:, : kind.required]
    if np.isinf(values).any() or not np.isfinite(required).all():
        row = int(np.argmin(np.isfinite(required).all(axis=1) & ~np.isinf(values).any(axis=1)))
        problem = f"{field} is NaN or Inf in row {row + 1}"
        raise InputError(source, problem, "leave these rows out")
    if not ((std > 0) | np.isnan(std)).all() or np.isinf(std).any():
        raise InputError(source, f"a std of {field} is not above 0", "NaN says that none is stated")
    for column, limit, numbers in zip(kind.columns, kind.limits, values.T, strict=False):
        if (size := np.abs(numbers).max()) > limit:
            problem = f"column '{column}' of {field} reaches {size:.6g}, beyond ±{limit:g}"
            raise InputError(source, problem, f"give it in degrees ({kind.unit} of WGS 84)")
    check_unit(sensor, values, source)


def check_unit(sensor: str, values: Float[np.ndarray, "f w"], source: object) -> None:
    """Raise `InputError` if readings have a size that shows another unit."""
    kind = SENSOR_KINDS[sensor]
    least, most = kind.usual
    size = usual_size(sensor, values)
    if not least <= size <= most:
        sizes = (number for _, number in kind.other_units if least <= number * size <= most)
        factor = next(sizes, None)
        problem = f"field '{sensor}' has a median of {size:.5g}, expected {least:g} to {most:g}"
        problem += f" {kind.unit}"
        raise InputError(source, problem, f"multiply by {factor:g}" if factor else "leave it out")


def usual_size(sensor: str, values: Float[np.ndarray, "f w"]) -> float:
    """Median of the norm of the columns that a reading must have."""
    required = values[:, : SENSOR_KINDS[sensor].required]
    return float(np.median(np.linalg.norm(required, axis=1)))


def readings_within(
    readings: dict[str, Readings], first: float, last: float
) -> dict[str, Readings]:
    """The readings from `MARGIN` before `first` to `MARGIN` after `last` (s), with `first` as time
    0. A sensor without any of them is left out."""
    parts = {}
    for sensor, (time, values, std) in readings.items():
        rows = (time >= first - MARGIN) & (time <= last + MARGIN)
        if rows.any():
            parts[sensor] = Readings(time[rows] - first, values[rows], std[rows])
    return parts
