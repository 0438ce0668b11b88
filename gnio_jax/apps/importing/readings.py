"""The sensors beside the IMU in a log: which columns they have, their units, and their stamps on
the clock of the IMU.

A sensor that cannot be used is left out with a warning that names file, field and remedy, because
the IMU alone is a recording. All limits are ours.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Num

from gnio_jax.apps.importing.clocks import Clocked, Sensor, find_mixed
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
_MAP = ("latitude", "longitude"), ("altitude", *ACCURACY)
"""Columns of a receiver that are angles, and those that are lengths."""
_UNITS = {
    MAGNETOMETER: {
        "µt μt ut microtesla microteslas": 1.0,
        "gauss g": 100.0,
        "mgauss milligauss mg": 0.1,
        "t tesla": 1e6,
        "mt millitesla": 1e3,
        "nt nanotesla": 1e-3,
    },
    BAROMETER: {
        "pa pascal": 1.0,
        "hpa mbar mb millibar millibars": 100.0,
        "kpa": 1e3,
        "bar": 1e5,
        "mmhg torr": 133.322,
        "inhg": 3386.39,
        "psi": 6894.76,
    },
    _MAP[0]: {
        "° º deg degree degrees decimaldegrees dd n e °n °e wgs84": 1.0,
        "rad radian radians": math.degrees(1.0),
        "dege7 1e7deg 1e7°": 1e-7,
    },
    _MAP[1]: {
        "m metre metres meter meters msl amsl asl hae abovesealevel wgs84": 1.0,
        "km": 1e3,
        "cm": 1e-2,
        "mm": 1e-3,
        "ft foot feet": 0.3048,
    },
}
"""Spellings of units, without blanks and in small letters, and their sizes in the unit of
`SENSOR_KINDS`; of a receiver by its columns."""
_SIZES = {
    quantity: {text: size for texts, size in units.items() for text in texts.split()}
    for quantity, units in _UNITS.items()
}
LEAST_SPAN, LEAST_SHARED, LEAST_SHARED_UNSTAMPED = 0.1, 0.5, 0.9
"""Shares by which stamps fit the IMU's time: the time that they cover, of the IMU's; and the time
that both cover, of the shorter one, with stamps of the IMU or without."""
_AXIS = r"(.*_)?(mag|magn|magnetometer|magnetic_field|magnetic|mag_field|m)_?{axis}"
_AXIS += r"(_?(cal|uncal|ut|gauss|t))?"
_NOT_ACCURACY = r"(?!.*(acc|std|err|vel|speed))"
_NAMES = {
    MAGNETOMETER: {axis: (_AXIS.format(axis=axis),) for axis in "xyz"},
    BAROMETER: {
        "pressure": (
            r"(?!.*(sea|qnh|alt|height|temp|acc|std|err))(.*_)?(pressure|baro|barometer|pres)(_.*)?",
        )
    },
    GNSS: {
        "latitude": (_NOT_ACCURACY + r"(.*_)?(latitude|latit|lat)(_.*)?",),
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
    """Unit of the stamps; None: the one with which they fit the IMU's."""
    has_unit: bool = False
    """Whether the values are in the unit of `SENSOR_KINDS`; otherwise it is detected."""
    table_of: str | None = None
    """gyro or accel, if the rows are those of its table: they then have its clock."""


@contextlib.contextmanager
def leaving_out(sensor: str, warnings: list[str]) -> Iterator[None]:
    """Convert an `InputError` about a sensor to a warning that it is left out."""
    try:
        yield
    except InputError as error:
        warnings.append(f"{sensor}: it is left out: {error}")


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
    texts: Mapping[str, str | None] | None = None,
) -> RawReadings:
    """The readings in some columns (our name → label) of a table. Without a stated `unit`, each
    column has that of its header, whose `texts` are by label (None: those in the labels). Raises
    `InputError` for a column of no numbers, and for an unknown unit."""
    blank = np.full(len(stamps), np.nan)
    texts = {label: unit_text(label) for label in columns.values()} if texts is None else texts
    sizes = {
        name: _SIZES[sensor][unit.lower()] if unit else _size_of(label, texts[label], name, table)
        for name, label in columns.items()
    }
    stated = [size for size in sizes.values() if size is not None]

    def column(name: str) -> Float[np.ndarray, " f"]:
        if name not in columns:
            return blank
        size = sizes[name] or (stated[0] if stated and sensor != GNSS else 1.0)
        return size * table.take(columns[name], gaps=True)

    values = np.stack([column(name) for name in SENSOR_KINDS[sensor].columns], axis=1)
    std = np.full_like(values, np.nan)
    if sensor == GNSS:
        horizontal, vertical = (column(name) for name in ACCURACY)
        std = np.stack([horizontal, horizontal, vertical], axis=1)
    has_unit = sensor == GNSS or bool(stated)
    return RawReadings(sensor, table.path, stamps, values, std, second, has_unit)


def _size_of(label: str, text: str | None, name: str, table: Table) -> float | None:
    """Size of the unit that the header of our column `name` states, as a `text` or as its last
    word; None if it states none. Raises `InputError` for an unknown one."""
    of_axes = {"x": MAGNETOMETER, "y": MAGNETOMETER, "z": MAGNETOMETER, "pressure": BAROMETER}
    sizes = _SIZES[of_axes.get(name) or next(names for names in _MAP if name in names)]
    unit = re.sub(r"[\s._^*-]", "", text or "").lower()
    if not unit or re.fullmatch(r"[xyz]|\d+", unit):
        return sizes.get(plain_name(label).rpartition("_")[2])
    if unit not in sizes:
        remedy = f"convert it, and write a known unit into its header: {', '.join(sizes)}"
        raise InputError(table.path, f"column '{label}' is in '{text}', no known unit", remedy)
    return sizes[unit]


def readings_on_clock(
    others: Iterable[RawReadings],
    gyro: Clocked,
    accel: Clocked,
    by_stamps: bool,
    notes: list[str],
    warnings: list[str],
) -> dict[str, Readings]:
    """The readings by sensor, in the units of `SENSOR_KINDS`, on the clock of the IMU in s since
    the start of the gyro. `by_stamps` says whether the IMU has stamps. A sensor that cannot be used
    is left out with a warning."""
    readings = {}
    for raw in others:
        with leaving_out(raw.sensor, warnings):
            readings[raw.sensor] = _convert(raw, gyro, accel, by_stamps, notes)
    return readings


def _convert(
    raw: RawReadings, gyro: Clocked, accel: Clocked, by_stamps: bool, notes: list[str]
) -> Readings:
    """One sensor's readings, sorted, without damaged and repeated rows. Raises `InputError`."""
    kind, remarks, clock = SENSOR_KINDS[raw.sensor], list[str](), gyro.time
    values, std = raw.values.copy(), np.where(raw.std > 0, raw.std, np.nan)
    row_time = {"gyro": gyro.row_time, "accel": accel.row_time}.get(raw.table_of or "")
    stamps = raw.stamps if row_time is None else row_time
    blank = np.isnan(values).all(axis=1)  # rows of other sensors
    if raw.sensor == GNSS:
        # A receiver without a fix writes zeros, or a negative accuracy.
        blank |= (values[:, :2] == 0).all(axis=1) | (raw.std[:, 0] < 0)
        values[raw.std[:, 2] < 0, 2] = np.nan
    has_values = finite_rows(values[:, : kind.required]) & ~blank
    valid = has_values & np.isfinite(stamps)
    if lost := int((~has_values & ~blank).sum()):
        remarks.append(f"{lost} rows of {raw.sensor} are damaged and left out")
    if lost := int((has_values & ~valid).sum()):
        remarks.append(f"{lost} rows of {raw.sensor} have no time on this clock and are left out")
    if not valid.any():
        problem = f"no row of field '{raw.sensor}' has a reading"
        raise InputError(raw.file, problem, "switch the sensor on, or record for longer")
    if row_time is None:
        rows = np.flatnonzero(valid)
        mixed = find_mixed(
            Sensor(raw.sensor, raw.file, stamps[rows], values[rows, : kind.required])
        )
        if (lost := int(mixed.sum())) > parsing.most_damaged_rows(len(mixed)):
            problem = f"the clock of {raw.sensor} wraps, starts again or was set back: {lost} rows"
            raise InputError(raw.file, f"{problem} overlap others", "cut the recording there")
        if lost:
            remarks.append(f"{lost} rows of {raw.sensor} overlap others and are left out")
        valid[rows[mixed]] = False
    stamps, values, std = stamps[valid], values[valid], std[valid]
    time = stamps
    if row_time is None:
        second = _unit_of_stamps(raw, stamps, gyro, by_stamps)
        first = parsing.first_stamp(stamps, second, raw.file)
        shift = float(Fraction(first) * parsing.seconds_of(second) - gyro.start)
        time = parsing.seconds(stamps, first, second) + shift
        if not by_stamps:
            remarks.append(f"{raw.sensor} is stamped in {second} after the first sample of the IMU")
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
    scale = 1.0
    if not raw.has_unit:
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


def _unit_of_stamps(
    raw: RawReadings, stamps: Num[np.ndarray, " f"], gyro: Clocked, by_stamps: bool
) -> str:
    """The unit of the stamps of a table of its own: the stated one, else the one with which they
    cover most of the IMU's time. Raises `InputError` if they do not fit it; without stamps of the
    IMU, a stated unit must fit it, too, as if both had begun at 0."""
    first, last = gyro.time[[0, -1]].tolist()
    if raw.second is not None and by_stamps:
        return raw.second
    least, shares = LEAST_SHARED if by_stamps else LEAST_SHARED_UNSTAMPED, dict[str, float]()
    for unit in [raw.second] if raw.second else dict.fromkeys([gyro.second, *parsing.PER_SECOND]):
        start, end = (
            float(Fraction(stamp.item()) * parsing.seconds_of(unit) - gyro.start)
            for stamp in (stamps.min(), stamps.max())
        )
        shared, spans = min(end, last) - max(start, first), (end - start, last - first)
        if spans[0] >= LEAST_SPAN * spans[1] and shared >= least * min(spans):
            shares[unit] = shared / max(spans)
    if not shares:
        problem = f"the stamps of field '{raw.sensor}' ({stamps.min():.6g} to {stamps.max():.6g})"
        problem += f" do not fit the {last - first:.4g} s of the IMU in any unit"
        remedy = (
            "give the stamps of both by one clock, with their unit in the header, as 'time (s)'"
        )
        raise InputError(raw.file, problem, remedy)
    return max(shares, key=lambda unit: shares[unit])


def _detected_unit(sensor: str, values: Float[np.ndarray, "f w"]) -> tuple[str, float]:
    """The unit with which the median has a usual size, and its size; that of the package if none
    has."""
    kind, size = SENSOR_KINDS[sensor], usual_size(sensor, values)
    units = ((kind.unit, 1.0), *kind.other_units)
    fitting = (unit for unit in units if kind.usual[0] <= unit[1] * size <= kind.usual[1])
    return next(fitting, units[0])
