"""What the reader of each format gives of a recording, and tables as loggers write them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Num

from gnio_jax.data.parsing.tables import Table, open_text, read_text
from gnio_jax.data.reference import Poses
from gnio_jax.errors import InputError
from gnio_jax.numerics import interpolate

DECIMAL_ROWS = 20
"""Rows by which a decimal comma is told: in some all numbers may be whole."""


class Units(NamedTuple):
    """What a format says of its numbers. None: it does not say, and the data must tell."""

    time: str | None = None
    """s, ms, us or ns."""
    gyro: str | None = None
    """rad/s or deg/s."""
    accel: str | None = None
    """m/s2, g or mg."""
    sign: str | None = None
    """Of the accelerometer: android or ios (see `units.signed`)."""
    sign_is_assumed: bool = False
    """Nothing says that the sign is this one."""


class Sensor(NamedTuple):
    """A sensor's samples as its file has them: rows in any order, in the file's units."""

    name: str
    """gyro or accel, for messages."""
    file: Path
    stamps: Num[np.ndarray, " n"]
    values: Float[np.ndarray, "n 3"]


class Track(NamedTuple):
    """A reference trajectory, on the clock of the IMU's stamps."""

    name: str
    """The file or topic, as the sequence's attribute `truth` has it."""
    poses: Poses
    """Of the IMU in a z-up world, in s after the stamp `first`."""
    first: float | int
    """In the unit of the gyro's stamps."""
    named: bool = False
    """The user asked for it: what is wrong with it is an error, and else a note."""


class Recording(NamedTuple):
    """A recording as a reader gives it, before units, clocks and rates."""

    path: Path
    """As the user named it."""
    gyro: Sensor
    accel: Sensor
    units: Units = Units()
    track: Track | None = None
    notes: tuple[str, ...] = ()
    """What was recognised, chosen or left out, one sentence each."""


class Layout(NamedTuple):
    """How the rows of a text table are written."""

    separator: str
    """" " stands for any run of blanks."""
    decimal: str
    """A point, or the comma of loggers set to it."""
    labels: tuple[str, ...]
    """The cells of the first row, without quotes."""


def read_table(path: Path, columns: tuple[str, ...], content: bytes | None = None) -> Table:
    """A logger's table; without a header where all `columns` are places.

    `content` is what the file holds where it is part of an archive.
    """
    layout = table_layout(path, content)
    header = not (columns and all(name.isdigit() for name in columns))
    table = read_text(path, layout.separator, header, content, layout.decimal)
    return table.renamed(_label(label) for label in table.columns)


def table_layout(path: Path, content: bytes | None = None) -> Layout:
    """The layout of a table, from its first rows: it is separated by the most frequent of comma,
    semicolon and tab, or by blanks where there is none of them. Raises `InputError` for what is no
    text."""
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
    decimal = "," if comma else "."
    labels = first.split(None if separator == " " else separator)
    return Layout(separator, decimal, tuple(_label(label) for label in labels))


def _label(text: object) -> str:
    """The name of a column: some begin with a byte order mark, some are quoted."""
    return str(text).strip("\ufeff \"'\n\r")


def sensor_of(name: str, table: Table, time: str, axes: tuple[str, ...]) -> Sensor:
    """The samples in the columns `time` and `axes` (x, y, z) of a table; a column of stamps or an
    axis may be "a+b", the sum of two columns."""
    whole = time in table.columns and table.columns[time].dtype.kind in "iu"
    # Columns that are shorter than others end in NaN, which is no sample.
    stamps = table.stamps(time) if whole else _column(table, time)
    values = np.stack([_column(table, axis) for axis in axes], axis=1)
    return Sensor(name, table.path, stamps, values)


def _column(table: Table, name: str) -> Float[np.ndarray, " n"]:
    if name not in table.columns and "+" in name:
        return np.sum([_column(table, part.strip()) for part in name.split("+")], axis=0)
    return table.take(name, gaps=True)


def added(motion: Sensor, gravity: Sensor) -> Sensor:
    """The accelerometer's reading of acceleration without gravity, on the stamps of `motion`, and
    of gravity, which turns slowly and is interpolated linearly (ours)."""
    seen = np.isfinite(gravity.values).all(axis=1) & np.isfinite(gravity.stamps)
    if seen.sum() < 2:
        raise InputError(gravity.file, f"holds {seen.sum()} samples", "record for longer")
    first = np.nanmin(motion.stamps)  # as integers ns of unix time have more digits than a float
    time, stamps = ((each - first).astype(np.float64) for each in (motion.stamps, gravity.stamps))
    order = np.flatnonzero(seen)[np.argsort(stamps[seen], kind="stable")]
    inside = (time >= stamps[order[0]]) & (time <= stamps[order[-1]])
    down = interpolate(time[inside], stamps[order], gravity.values[order])
    return motion._replace(
        name="accel", stamps=motion.stamps[inside], values=motion.values[inside] + down
    )
