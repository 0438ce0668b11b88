"""A recording from the reader of its format, and its conversion to a `Sequence`: rows in order,
units and signs, the uniform clock of all recordings (`data.assembly`), the reference."""

from __future__ import annotations

import re
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Num

from gnio_jax.apps.importing import units
from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.parsing.stamps import (
    PER_SECOND,
    RATES,
    first_stamp,
    in_order,
    is_rate,
    rounded_rate,
    seconds,
    time_unit,
)
from gnio_jax.data.parsing.tables import Table, open_text, read_text
from gnio_jax.data.resampling import longest_bridge
from gnio_jax.data.self_check import self_check
from gnio_jax.data.validation import WINDOW_SECONDS, check_finite, from_one
from gnio_jax.errors import InputError
from gnio_jax.numerics import interpolate
from gnio_jax.types import Sequence

GAPS = "lacks samples"
"""Words in a note about holes in a recording."""
SLOW = 50.0
"""Rate below which the impacts of steps are lost, Hz; networks are trained on 100 Hz and more
(ours)."""
DECIMAL_ROWS = 20
"""Number of rows in which a decimal comma is searched, because some rows may have only whole
numbers."""


class Units(NamedTuple):
    """Units that a format or the user states. None: not stated, so it is detected from the data."""

    time: str | None = None
    """s, ms, us or ns."""
    gyro: str | None = None
    """rad/s or deg/s."""
    accel: str | None = None
    """m/s2, g or mg."""
    sign: str | None = None
    """Sign of the accelerometer: android, ios or detect (see `units.signed`)."""
    sign_is_assumed: bool = False
    """Whether the sign is only assumed."""


class Sensor(NamedTuple):
    """A sensor's samples as in its file: rows in any order, in the file's units."""

    name: str
    """gyro or accel, for messages."""
    file: Path
    stamps: Num[np.ndarray, " n"]
    values: Float[np.ndarray, "n 3"]
    row: Callable[[int], int] = from_one
    """A function from a sample to its row in the file, for messages."""

    def where(self, kept: Bool[np.ndarray, " n"]) -> Sensor:
        """The samples in these rows."""
        own, stamps, values = np.flatnonzero(kept), self.stamps[kept], self.values[kept]

        def row(index: int) -> int:
            return self.row(int(own[index]))

        return self._replace(stamps=stamps, values=values, row=row)


class Track(NamedTuple):
    """A reference trajectory on the clock of the IMU's stamps."""

    name: str
    """The file or topic, as in the sequence's attribute `truth`."""
    poses: Poses
    """Poses of the IMU in a z-up world, in s after `start`."""
    start: Fraction
    """s."""
    named: bool = False
    """Whether the user asked for it. A problem is then an error, and otherwise a note."""


class Recording(NamedTuple):
    """A recording from a reader, before the conversion of units, clocks and rates."""

    path: Path
    """Path, as the user named it."""
    gyro: Sensor
    accel: Sensor
    units: Units = Units()
    track: Track | None = None
    notes: tuple[str, ...] = ()
    """Notes about what was recognised, chosen or left out, one sentence each."""
    raw_gyro: bool = False
    """Whether it is known that the phone subtracts no bias from the gyro."""


class Imported(NamedTuple):
    """A recording on a uniform clock."""

    sequence: Sequence
    """The sequence, with a reference if the recording has one."""
    notes: tuple[str, ...]
    """Notes for the user about what was detected, assumed or repaired, one sentence each."""
    warnings: tuple[str, ...] = ()
    """Warnings about problems that may make all results wrong, one sentence each."""


# --- from a table to the samples of a sensor


class Layout(NamedTuple):
    """The format of the rows of a text table."""

    separator: str
    """Separator of cells; " " means any run of blanks."""
    decimal: str
    """Decimal mark: a point, or a comma, depending on the logger's settings."""
    labels: tuple[str, ...]
    """The cells of the first row, without quotes."""


def table_layout(path: Path, content: bytes | None = None) -> Layout:
    """The layout of a table, from its first rows. The separator is the most frequent of comma,
    semicolon and tab, or blanks if there is none of them. `content` is the content of a file that
    is part of an archive. Raises `InputError` if it is no text."""
    try:
        with open_text(path, content) as file:
            rows = (line for line in file if line.strip() and not line.startswith("#"))
            first, *others = [next(rows, "") for _ in range(1 + DECIMAL_ROWS)]
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from None
    except UnicodeDecodeError as error:
        raise InputError(path, f"is no text ({error})", "export the recording as CSV") from None
    separator = max((",", ";", "\t"), key=first.count)
    separator = separator if separator in first else " "
    comma = separator != "," and any(re.search(r"\d,\d", row) for row in others)
    labels = first.split(None if separator == " " else separator)
    return Layout(separator, "," if comma else ".", tuple(_label(label) for label in labels))


def read_table(path: Path, columns: tuple[str, ...] = (), content: bytes | None = None) -> Table:
    """A logger's table; without a header if all wanted `columns` are numbers."""
    layout = table_layout(path, content)
    parts = [part.strip() for name in columns for part in name.split("+")]
    header = not (parts and all(part.isdigit() for part in parts))
    table = read_text(path, layout.separator, header, content, layout.decimal)
    return table.renamed(_label(label) for label in table.columns)


def _label(text: object) -> str:
    """The name of a column, without a byte order mark or quotes."""
    return str(text).strip("\ufeff \"'\n\r")


def sensor_of(name: str, table: Table, time: str, *axes: str) -> Sensor:
    """The samples in the columns `time` and `axes` (x, y, z) of a table; each may be "a+b", the sum
    of two columns."""
    whole = time in table.columns and table.columns[time].dtype.kind in "iu"
    # Columns that are shorter than others end with NaN, which is no sample.
    stamps = table.stamps(time) if whole else _column(table, time)
    values = np.stack([_column(table, axis) for axis in axes], axis=1)
    return Sensor(name, table.path, stamps, values, table.row)


def _column(table: Table, name: str) -> Float[np.ndarray, " n"]:
    if name not in table.columns and "+" in name:
        return np.sum([_column(table, part.strip()) for part in name.split("+")], axis=0)
    return table.take(name, gaps=True)


# --- from the samples of both sensors to a sequence


def as_sequence(source: Recording, stated: Units, rate: float | None, name: str) -> Imported:
    """The sequence of a recording in any format; units in `stated` override those of the format.
    Raises `InputError`."""
    notes, warnings = list(source.notes), []
    unit = stated.time or source.units.time
    gyro, accel = (_clocked(sensor, unit, notes) for sensor in (source.gyro, source.accel))
    accel = accel._replace(time=accel.time + float(accel.start - gyro.start))
    first, last = max(gyro.time[0], accel.time[0]), min(gyro.time[-1], accel.time[-1])
    if last - first < WINDOW_SECONDS:
        raise InputError(
            source.path,
            f"both sensors were recorded for {max(last - first, 0.0):.2f} s, less than the "
            f"network's window of {WINDOW_SECONDS:g} s",
            "record for longer, both by one clock",
        )
    if not np.array_equal(gyro.time, accel.time):
        both = max(gyro.time[-1], accel.time[-1]) - min(gyro.time[0], accel.time[0])
        notes.append(
            "gyro and accel have different stamps: both are interpolated to one clock, and "
            f"{both - (last - first):.2f} s that only one of them covers are cut off"
        )
    rates, forces = _in_si(source, stated, gyro, accel, notes, warnings)
    own = max(rounded_rate(gyro.time), rounded_rate(accel.time))
    notes.append(f"put on a uniform clock of {rate or own:g} Hz")
    if own < SLOW:
        notes.append(
            f"it was recorded at {own:g} Hz, which is slow: steps need {SLOW:g} Hz, and the "
            "networks were trained on 100 Hz and more"
        )
    streams = Streams(
        name,
        str(source.path),
        Samples(gyro.time, rates, str(source.gyro.file)),
        Samples(accel.time, forces, str(source.accel.file)),
        {"dataset": "csv", "group": name, "truth": "none"}
        | ({"imu_compensated": "no"} if source.raw_gyro else {}),
        float(gyro.start),
    )
    sequence = None
    if source.track is not None:
        sequence = _with_track(streams, rate, source.track, gyro.start, notes)
    if sequence is None:
        (sequence,) = assemble(streams, rate, whole=True)
    return Imported(sequence, tuple(notes), tuple(warnings))


class _Clocked(NamedTuple):
    """One sensor's samples in order."""

    time: Float[np.ndarray, " n"]
    """s since `start`."""
    values: Float[np.ndarray, "n 3"]
    start: Fraction
    """The exact first stamp, s, because unix time in a float has an accuracy of a quarter of a
    microsecond."""


def _clocked(sensor: Sensor, unit: str | None, notes: list[str]) -> _Clocked:
    """The samples in order. `unit` is that of the stamps; None: it is detected. Notes about
    detection and repairs are added to `notes`."""
    name, file = sensor.name, sensor.file
    empty = np.isnan(sensor.values).all(axis=1)
    if empty.any() and not empty.all():
        # Loggers that write all sensors into one table leave the columns of the other sensors
        # empty.
        notes.append(
            f"{file.name}: {empty.sum()} of {len(empty)} rows have no value of {name} and "
            "are left out for it"
        )
        sensor = sensor.where(~empty)
    stamps, values = sensor.stamps, sensor.values
    if (count := len(np.unique(stamps))) < 2:
        problem = f"holds {count} stamps of field '{name}'"
        raise InputError(file, problem, "record for longer")
    check_finite(stamps.astype(np.float64), "time", file, sensor.row)
    check_finite(values, name, file, sensor.row)
    detected, rate = time_unit(stamps - stamps.min())
    if unit is None and detected is None:
        raise InputError(
            file,
            f"the unit of field 'time' is ambiguous (in seconds {name} would run at {rate:.3g} Hz)",
            "state it: s, ms, us or ns",
        )
    if unit is None:
        unit = detected
        notes.append(
            f"{file.name}: time of {name} taken as {unit}, "
            f"by which it runs at {rate * PER_SECOND[unit]:.4g} Hz"
        )
    rate *= PER_SECOND[unit]
    if not is_rate(rate):
        raise InputError(
            file,
            f"field 'time' makes {name} run at {rate:.3g} Hz with the unit {unit}",
            f"an IMU runs at {RATES[0]:g} to {RATES[1]:g} Hz",
        )
    first = first_stamp(stamps, unit, file)
    time = seconds(stamps, first, unit)
    rows, repairs = in_order(time, values, f"{file}: {name}")
    time, values = time[rows], values[rows]
    if backward := repairs.get("rows_sorted"):
        notes.append(
            f"{file.name}: {name} had {backward:.0f} steps back in time; its rows were sorted"
        )
    if repeated := repairs.get("rows_repeated"):
        notes.append(f"{file.name}: {repeated:.0f} rows of {name} repeat a stamp and were dropped")
    holes = np.diff(time)[np.diff(time) > longest_bridge(rate)]
    if holes.size:
        notes.append(
            f"{file.name}: {name} {GAPS} {holes.size} times, "
            f"for up to {holes.max():.2f} s; bridged linearly"
        )
    return _Clocked(time, values, Fraction(first) / int(PER_SECOND[unit]))


def _in_si(
    source: Recording,
    stated: Units,
    gyro: _Clocked,
    accel: _Clocked,
    notes: list[str],
    warnings: list[str],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]:
    """(gyro rad/s, accel m/s² with Android's sign), each on its own stamps."""
    known, gyro_file, accel_file = source.units, source.gyro.file, source.accel.file
    unit = stated.accel or known.accel
    force = accel.values * units.accel_scale(accel.values, unit, accel_file, notes)
    inside = (gyro.time >= accel.time[0]) & (gyro.time <= accel.time[-1])
    time = gyro.time[inside]
    motion = units.Motion(time, gyro.values[inside], interpolate(time, accel.time, force))
    scale = units.gyro_scale(motion, stated.gyro or known.gyro, gyro_file, notes)
    if stated.gyro is None and known.gyro is not None:
        units.check_rad_per_second(motion._replace(gyro=motion.gyro * scale), gyro_file)
    sign = stated.sign or known.sign
    if sign is None:
        raise InputError(
            accel_file,
            "the sign of field 'accel' depends on the phone's system, which is not known here",
            "state it: android, ios or detect",
        )
    force = units.signed(force, sign, accel_file, notes)
    upward = units.note_gravity(accel.time, force, accel_file, notes)
    if upward == "-z" and stated.sign is None and known.sign_is_assumed:
        warnings.append(
            f"sign: gravity reads on -z in {accel_file.name}: the screen points down, or this "
            "is iOS's sign and the track is wrong: compare with --accel-sign ios"
        )
    return gyro.values * scale, force


def _with_track(
    streams: Streams, rate: float | None, track: Track, start: Fraction, notes: list[str]
) -> Sequence | None:
    """The recording with the reference; None if that is no valid reference, or does not describe
    the motion of the IMU."""
    poses = track.poses._replace(time=track.poses.time + float(track.start - start))
    about = streams.attributes | {"truth": track.name}
    try:
        (result,) = assemble(streams._replace(poses=poses, attributes=about), rate, whole=True)
        # A reference that fails the self-check is not used.
        if failures := self_check(result, pedestrian=False).failures:
            raise InputError(
                poses.source,
                f"the reference {track.name} does not fit the IMU ({'; '.join(failures)})",
                "its frame must be the IMU's, its world z-up, its clock the same",
            )
    except InputError as error:
        if track.named:
            raise
        notes.append(f"no reference is taken: {error}")
        return None
    notes.append(f"reference from {track.name}, {result.valid.mean():.0%} of the time")
    return result
