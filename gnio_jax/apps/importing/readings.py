"""The sensors beside the IMU in a log: which columns they have, their units, and their stamps on
the clock of the IMU.

A sensor that cannot be used is left out with a warning that names file, field and remedy, because
the IMU alone is a recording. All limits are ours.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Num

from gnio_jax.apps.importing.clocks import Sensor
from gnio_jax.data.labels import plain_name, unit_text
from gnio_jax.data.parsing import stamps as parsing
from gnio_jax.data.parsing.tables import Table
from gnio_jax.data.sensors import (
    BAROMETER,
    GNSS,
    MAGNETOMETER,
    MARGIN,
    SENSOR_KINDS,
    check_readings,
    usual_size,
)
from gnio_jax.errors import InputError
from gnio_jax.numerics import finite_rows
from gnio_jax.types import Readings

ACCURACY = ("horizontal accuracy", "vertical accuracy")
"""Names of the columns of a receiver's accuracy, m."""
_UNITS = {
    "µT": "µt μt ut microtesla microteslas",
    "gauss": "gauss",
    "T": "t tesla",
    "mT": "mt",
    "nT": "nt nanotesla",
    "Pa": "pa pascal",
    "hPa": "hpa mbar mb millibar millibars",
    "kPa": "kpa",
    "bar": "bar",
}
_UNIT_OF = {spelling: unit for unit, texts in _UNITS.items() for spelling in texts.split()}
_AXIS = r"(.*_)?(mag|magn|magnetometer|magnetic_field|magnetic|mag_field|m)_?{axis}"
_AXIS += r"(_?(cal|uncal|ut|gauss|t))?"
_NOT_ACCURACY = r"(?!.*(acc|std|err|vel|speed))"
_NAMES = {
    MAGNETOMETER: {axis: (_AXIS.format(axis=axis),) for axis in "xyz"},
    BAROMETER: {
        "pressure": (r"(?!.*(sea|qnh|alt|height))(.*_)?(pressure|baro|barometer|pres)(_.*)?",)
    },
    GNSS: {
        "latitude": (_NOT_ACCURACY + r"(.*_)?(latitude|lat)(_.*)?",),
        "longitude": (_NOT_ACCURACY + r"(.*_)?(longitude|lon|lng|long)(_.*)?",),
        "altitude": (
            r"altitude|alt",
            _NOT_ACCURACY + r"(?!.*(rel|baro|press))(.*_)?(altitude|alt|height|elevation)(_.*)?",
        ),
        ACCURACY[0]: (
            r"(?!.*(vert|speed|bear|head))(.*_)?(horizontal|h|hor|pos|position|location|gps)_?"
            r"(acc|accuracy)(_.*)?",
            r"accuracy|acc",
        ),
        ACCURACY[1]: (r"(.*_)?(vertical|v|ver|vert|alt|altitude)_?(acc|accuracy)(_.*)?",),
    },
}
"""Names of the columns of a sensor, as `labels.plain_name` writes them, the surest first."""


class RawReadings(NamedTuple):
    """The readings of a sensor as in its file: rows in any order, in the file's units."""

    sensor: str
    """A name of `data.sensors.SENSOR_KINDS`."""
    file: Path
    """File, or file and topic, for messages."""
    stamps: Num[np.ndarray, " f"]
    values: Float[np.ndarray, "f w"]
    """Columns of the sensor. One that the file does not have is NaN."""
    std: Float[np.ndarray, "f w"]
    second: str | None = None
    """Unit of the stamps; None: that of the gyro's."""
    unit: str | None = None
    """Unit of the values; None: it is detected."""


def columns_of(labels: Iterable[str]) -> dict[str, dict[str, str]]:
    """Sensor → its columns by our names → labels, of the sensors whose required columns are there
    once."""
    plain = {str(label): plain_name(str(label)) for label in labels}
    sensors = {}
    for sensor, names in _NAMES.items():
        columns = {}
        for name, patterns in names.items():
            for pattern in patterns:
                fitting = [label for label, text in plain.items() if re.fullmatch(pattern, text)]
                if len(fitting) == 1:
                    columns.setdefault(name, fitting[0])
        required = SENSOR_KINDS[sensor].columns[: SENSOR_KINDS[sensor].required]
        if set(required) <= columns.keys():
            sensors[sensor] = columns
    return sensors


def readings_of(
    sensor: str,
    table: Table,
    stamps: Num[np.ndarray, " f"],
    columns: Mapping[str, str],
    second: str | None = None,
    unit: str | None = None,
) -> RawReadings:
    """The readings in some columns (our name → label) of a table. Without a stated `unit`, the
    header's is taken. Raises `InputError` for a column of no numbers."""
    blank = np.full(len(stamps), np.nan)

    def column(name: str) -> Float[np.ndarray, " f"]:
        return table.take(columns[name], gaps=True) if name in columns else blank

    values = np.stack([column(name) for name in SENSOR_KINDS[sensor].columns], axis=1)
    std = np.full_like(values, np.nan)
    if sensor == GNSS:
        horizontal, vertical = (column(name) for name in ACCURACY)
        std = np.stack([horizontal, horizontal, vertical], axis=1)
    else:
        text = unit_text(columns[SENSOR_KINDS[sensor].columns[0]])
        unit = unit or _UNIT_OF.get((text or "").lower())
    return RawReadings(sensor, table.path, stamps, values, std, second, unit)


def readings_on_clock(
    others: Iterable[RawReadings],
    gyro: Sensor,
    time_unit: str | None,
    start: Fraction,
    clock: Float[np.ndarray, " n"],
    notes: list[str],
    warnings: list[str],
) -> dict[str, Readings]:
    """The readings by sensor, in the units of `SENSOR_KINDS`, on the clock of the IMU in s since
    `start`. `clock` has the IMU's stamps. A sensor that cannot be used is left out with a
    warning."""
    readings = {}
    for raw in others:
        try:
            second = time_unit or raw.second or gyro.second
            if second is None:
                second, _ = parsing.time_unit(gyro.stamps - gyro.stamps.min())
            readings[raw.sensor] = _converted(raw, second or "s", start, clock, notes)
        except InputError as error:
            warnings.append(f"{raw.sensor}: it is left out: {error}")
    return readings


def _converted(
    raw: RawReadings,
    second: str,
    start: Fraction,
    clock: Float[np.ndarray, " n"],
    notes: list[str],
) -> Readings:
    """One sensor's readings, sorted, without damaged and repeated rows. Raises `InputError`."""
    kind, remarks = SENSOR_KINDS[raw.sensor], list[str]()
    values, std = raw.values.copy(), np.where(raw.std > 0, raw.std, np.nan)
    blank = np.isnan(values).all(axis=1)  # rows of other sensors
    if raw.sensor == GNSS:
        # A receiver without a fix writes zeros, or a negative accuracy.
        blank |= (values[:, :2] == 0).all(axis=1) | (raw.std[:, 0] < 0)
        values[raw.std[:, 2] < 0, 2] = np.nan
    valid = finite_rows(values[:, : kind.required]) & np.isfinite(raw.stamps) & ~blank
    if lost := int((~valid & ~blank).sum()):
        remarks.append(f"{lost} rows of {raw.sensor} are damaged and left out")
    if not valid.any():
        problem = f"no row of field '{raw.sensor}' has a reading"
        raise InputError(raw.file, problem, "switch the sensor on, or record for longer")
    stamps, values, std = raw.stamps[valid], values[valid], std[valid]
    first = parsing.first_stamp(stamps, second, raw.file)
    shift = float(Fraction(first) * parsing.seconds_of(second) - start)
    time = parsing.seconds(stamps, first, second) + shift
    order = np.unique(time, return_index=True)[1]
    if raw.sensor == GNSS:  # loggers that run faster than the receiver repeat its last fix
        moved = (np.diff(values[order, :2], axis=0) != 0).any(axis=1)
        order = order[np.concatenate([[True], moved])]
    if repeats := len(time) - len(order):
        remarks.append(f"{repeats} rows of {raw.sensor} repeat the one before and are left out")
    time, values, std = time[order], values[order], std[order]
    inside = (time >= clock[0] - MARGIN) & (time <= clock[-1] + MARGIN)
    if inside.any() and not inside.all():
        text = f"{(~inside).sum()} rows of {raw.sensor} are before or after the IMU's and left out"
        remarks.append(text)
        time, values, std = time[inside], values[inside], std[inside]
    scale = 1.0 if raw.unit in (None, kind.unit) else dict(kind.other_units)[raw.unit]
    if raw.sensor != GNSS and raw.unit is None:
        name, scale = _detected_unit(raw.sensor, values)
        remarks.append(
            f"{raw.sensor} taken as {name} (median {usual_size(raw.sensor, values):.5g})"
        )
    readings = Readings(time, values * scale, std)
    check_readings(raw.sensor, readings, clock, raw.file)
    rate = (len(time) - 1) / max(time[-1] - time[0], 1e-9)
    remarks.insert(0, f"{raw.sensor} with {len(time)} rows ({rate:.3g} a second)")
    notes += [f"{raw.file.name}: {remark}" for remark in remarks]
    return readings


def _detected_unit(sensor: str, values: Float[np.ndarray, "f w"]) -> tuple[str, float]:
    """The unit with which the median has a usual size, and its size; that of the package if none
    has."""
    kind, size = SENSOR_KINDS[sensor], usual_size(sensor, values)
    units = ((kind.unit, 1.0), *kind.other_units)
    fitting = (unit for unit in units if kind.usual[0] <= unit[1] * size <= kind.usual[1])
    return next(fitting, units[0])
