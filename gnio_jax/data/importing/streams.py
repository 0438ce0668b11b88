"""One sensor's samples from a logger's file, and both sensors on one clock."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Num
from scipy.interpolate import CubicSpline

from gnio_jax.data.parsing.stamps import PER_SECOND, RATES, in_order, time_unit
from gnio_jax.data.parsing.tables import Table, open_text, read_text
from gnio_jax.data.resampling import longest_bridge
from gnio_jax.data.validation import check_finite, check_gaps
from gnio_jax.errors import InputError
from gnio_jax.numerics import interpolate, neighbours

MOST_REPEATED = 0.01
"""Share of the rows that may repeat a stamp: stamps rounded to a coarse unit fall together now and
then."""
SHORTEST_OVERLAP = 1.0
"""s that both sensors must cover."""
DECIMAL_ROWS = 20
"""Rows by which a decimal comma is told: in some all numbers may be whole."""
MOST_APART = 10
"""Neighbours in time that are none in the file, for each step back in time, above which samples of
two clocks lie among each other (ours). A block of rows in the wrong place has three."""

GAPS = "lacks samples"
"""What a note of holes in a recording says."""


class SensorFile(NamedTuple):
    """Where a sensor's samples are."""

    sensor: str
    """gyro or accel, for messages."""
    path: Path
    table: pd.DataFrame
    time: str
    """Column of the stamps."""
    axes: tuple[str, ...]
    """Columns of x, y and z."""


class Stream(NamedTuple):
    """One sensor's samples."""

    time: Float[np.ndarray, " n"]
    """s from `epoch`, increasing."""
    values: Float[np.ndarray, "n 3"]
    epoch: float
    """The first stamp, s: unix time in a float is good to a quarter of a microsecond, so stamps are
    counted from it."""


class Joined(NamedTuple):
    """Both sensors on the stamps of the faster one."""

    start: float
    """The first stamp, s."""
    time: Float[np.ndarray, " n"]
    """s from `start`."""
    gyro: Float[np.ndarray, "n 3"]
    accel: Float[np.ndarray, "n 3"]
    valid: Bool[np.ndarray, " n"] | None = None
    """False where the slower sensor lacks samples; None: it lacks none."""


# --- columns


class Layout(NamedTuple):
    """How the rows of a text table are written."""

    separator: str
    """" " stands for any run of blanks."""
    decimal: str
    """A point, or the comma of loggers set to it."""
    labels: tuple[str, ...]
    """The cells of the first row, without quotes."""


def read_table(path: Path, columns: tuple[str, ...], content: bytes | None = None) -> pd.DataFrame:
    """A logger's table; without a header where all `columns` are places.

    `content` is what the file holds where it is part of an archive.
    """
    layout = table_layout(path, content)
    header = not (columns and all(name.isdigit() for name in columns))
    table = read_text(path, layout.separator, header, content, layout.decimal)
    return pd.DataFrame(table.columns).rename(columns=_label)


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


def _column(table: pd.DataFrame, name: str, path: Path) -> Float[np.ndarray, " n"]:
    """A column, or the sum of columns of "a+b"."""
    if name not in table.columns and "+" in name:
        parts = (_column(table, part.strip(), path) for part in name.split("+"))
        return sum(parts, np.zeros(len(table)))
    return Table(path, table).take(name, gaps=True)


def _stamps(table: pd.DataFrame, name: str, path: Path) -> Num[np.ndarray, " n"]:
    """A column of stamps, whose integers stay: nanoseconds of unix time have more digits than a
    float."""
    column = table.get(name)
    if column is not None and column.ndim == 1 and column.dtype.kind in "iu":
        return column.to_numpy()
    return _column(table, name, path)


# --- one sensor


def read_stream(source: SensorFile, unit: str | None, notes: list[str]) -> Stream:
    """A sensor's samples in order.

    `unit` of the stamps, None detects it. What was detected or repaired is added to `notes`. Raises
    `InputError`.
    """
    sensor, path = source.sensor, source.path
    stamps = _stamps(source.table, source.time, path)
    axes = [_column(source.table, axis, path) for axis in source.axes]
    stamps, values = _own_rows(stamps, np.stack(axes, axis=1), source, notes)
    check_finite(stamps.astype(np.float64), "time", path)
    check_finite(values, sensor, path)
    first = stamps.min()
    stamps = stamps - first
    unit = unit or _detected_unit(stamps, source, notes)
    time = stamps / PER_SECOND[unit]
    time, values = _sorted(time, values, source, notes)
    rate = 1.0 / float(np.median(np.diff(time)))
    if not RATES[0] * 0.99 <= rate <= RATES[1] * 1.01:
        raise InputError(
            path,
            f"field 'time' makes {sensor} run at {rate:.3g} Hz with the unit {unit}",
            f"an IMU runs at {RATES[0]:g} to {RATES[1]:g} Hz",
        )
    check_gaps(time, path)
    steps = np.diff(time)
    holes = steps[steps > longest_bridge(rate)]
    if holes.size:
        notes.append(
            f"{path.name}: {sensor} {GAPS} {holes.size} times, "
            f"for up to {holes.max():.2f} s; bridged linearly"
        )
    return Stream(time - time[0], values, float(first) / PER_SECOND[unit])


def _own_rows(
    stamps: np.ndarray, values: np.ndarray, source: SensorFile, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Loggers that write every sensor into one table leave the others' columns empty."""
    empty = np.isnan(values).all(axis=1)
    if empty.any() and not empty.all():
        notes.append(
            f"{source.path.name}: {empty.sum()} of {len(empty)} rows have no {source.sensor} "
            "and are not its samples"
        )
        stamps, values = stamps[~empty], values[~empty]
    _check_count(stamps, source)
    return stamps, values


def _check_count(stamps: np.ndarray, source: SensorFile) -> None:
    if len(stamps) < 2:
        raise InputError(
            source.path,
            f"holds {len(stamps)} samples of field '{source.sensor}'",
            "record for longer",
        )


def _detected_unit(stamps: np.ndarray, source: SensorFile, notes: list[str]) -> str:
    unit, rate = time_unit(stamps)
    if unit is None:
        raise InputError(
            source.path,
            "the unit of field 'time' is ambiguous "
            f"(in seconds {source.sensor} would run at {rate:.3g} Hz)",
            "state it: s, ms, us or ns",
        )
    notes.append(
        f"{source.path.name}: time of {source.sensor} taken as {unit}, "
        f"by which it runs at {rate * PER_SECOND[unit]:.4g} Hz"
    )
    return unit


def _sorted(
    time: np.ndarray, values: np.ndarray, source: SensorFile, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Rows in the order of their stamps, of those that share one the first."""
    sensor, path, rows = source.sensor, source.path, len(time)
    _check_one_clock(time, source)
    order, repairs = in_order(time, values, path)
    time, values = time[order], values[order]
    if backward := repairs.get("rows_sorted"):
        notes.append(
            f"{path.name}: {sensor} had {backward:.0f} steps back in time; its rows were sorted"
        )
    repeated = int(repairs.get("rows_repeated", 0))
    if repeated > MOST_REPEATED * rows:
        raise InputError(
            path,
            f"field 'time' repeats in {repeated} of {rows} rows of {sensor}",
            "give stamps fine enough to tell the samples apart",
        )
    if repeated:
        notes.append(f"{path.name}: {repeated} rows of {sensor} repeat a stamp and were dropped")
    _check_count(time, source)
    return time, values


def _check_one_clock(time: np.ndarray, source: SensorFile) -> None:
    """Raise `InputError` where the clock was set back: sorted, the samples before and after it
    would lie among each other."""
    steps = np.diff(time)
    backward = int((steps < 0).sum())
    if not backward:
        return
    _, order = np.unique(time, return_index=True)
    apart = int((np.abs(np.diff(order)) > 1).sum())
    if apart > MOST_APART * backward:
        row = int(np.argmin(steps)) + 1
        raise InputError(
            source.path,
            f"field 'time' of {source.sensor} jumps back by {-steps[row - 1]:.2f} s in row {row}, "
            "and what follows overlaps what was before",
            "its clock was set: cut the recording there",
        )


# --- both sensors


def join(
    gyro: Stream, accel: Stream, gyro_path: Path, accel_path: Path, notes: list[str]
) -> Joined:
    """Both sensors over what both cover; the slower one follows cubic splines.

    Raises `InputError` where they hardly overlap.
    """
    if gyro.epoch == accel.epoch and np.array_equal(gyro.time, accel.time):
        return Joined(gyro.epoch, gyro.time, gyro.values, accel.values)
    accel = accel._replace(time=accel.time + (accel.epoch - gyro.epoch))
    first, last = max(gyro.time[0], accel.time[0]), min(gyro.time[-1], accel.time[-1])
    if last - first < SHORTEST_OVERLAP:
        raise InputError(
            accel_path,
            f"field 'time' overlaps by {max(last - first, 0.0):.3g} s "
            f"with that of gyro in {gyro_path.name}",
            "the files must be of one recording and one clock",
        )
    gyro_is_faster = np.median(np.diff(gyro.time)) <= np.median(np.diff(accel.time))
    faster, slower = (gyro, accel) if gyro_is_faster else (accel, gyro)
    inside = (faster.time >= first) & (faster.time <= last)
    time, measured = faster.time[inside], faster.values[inside]
    interpolated, in_gap = _values_at(slower, time)
    cut = max(gyro.time[-1], accel.time[-1]) - min(gyro.time[0], accel.time[0]) - (last - first)
    moved = "accel" if gyro_is_faster else "gyro"
    notes.append(
        f"gyro and accel have stamps of their own: {moved} interpolated, "
        f"{cut:.2f} s cut that only one of them covers"
    )
    rates, forces = (measured, interpolated) if gyro_is_faster else (interpolated, measured)
    valid = ~in_gap if in_gap.any() else None
    return Joined(gyro.epoch + float(time[0]), time - time[0], rates, forces, valid)


def _values_at(
    stream: Stream, time: np.ndarray
) -> tuple[Float[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """By a cubic spline, and by lines across gaps; and what lies in a gap."""
    values = CubicSpline(stream.time, stream.values, axis=0)(time)
    left, right = neighbours(stream.time, time)
    longest = longest_bridge(1.0 / float(np.median(np.diff(stream.time))))
    gap = stream.time[right] - stream.time[left] > longest
    values[gap] = interpolate(time[gap], stream.time, stream.values)
    return values, gap & (time != stream.time[left]) & (time != stream.time[right])
