"""The CSV of a phone's logger as a `Sequence`: columns of other names, other units, one file per
sensor.

The steps: the columns of each sensor in order (`streams`), both on one clock (`streams.join`),
units and signs (`units`), one uniform clock.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gnio_jax.data.importing import units
from gnio_jax.data.importing.streams import (
    Joined,
    SensorFile,
    Stream,
    join,
    read_stream,
    read_table,
)
from gnio_jax.data.readers.csv_files import ACCEL, GYRO
from gnio_jax.data.readers.stamps import PER_SECOND, RATES, rounded_rate
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import validate
from gnio_jax.errors import InputError
from gnio_jax.types import Sequence

_COLUMNS = ("time", "accel_time", *GYRO, *ACCEL)


class Imported(NamedTuple):
    """What `import_recording` made of a recording."""

    sequence: Sequence
    """On a uniform clock, without a reference."""
    notes: tuple[str, ...]
    """What was detected, assumed or repaired, one sentence each, to be shown to the user."""


def import_recording(
    path: str | os.PathLike[str],
    columns: Mapping[str, str] | None = None,
    *,
    accel_path: str | os.PathLike[str] | None = None,
    time_unit: str | None = None,
    gyro_unit: str | None = None,
    accel_unit: str | None = None,
    accel_sign: str = "android",
    order: str = "sort",
    rate: float | None = None,
    separator: str | None = None,
    name: str | None = None,
) -> Imported:
    """A phone logger's CSV as a `Sequence` without a reference, on a uniform clock.

    `path`
        The gyro's file, and the accelerometer's unless `accel_path` is given; lines that begin with
        # are comments.
    `columns`
        From our names to the file's: `time`, `gyro_x..z`, `accel_x..z`, and `accel_time` if the
        accelerometer's time is another column. What is not mapped is looked up by our name. "a+b"
        is the sum of two columns (gravity and user acceleration). In a file whose header names
        nothing, or that has none, all are places counted from "0".
    `time_unit`, `gyro_unit`, `accel_unit`
        None detects it: s, ms, us or ns by the rate of an IMU, 10 to 2000 Hz; rad/s or deg/s by
        `units.gyro_scale`; m/s2, g or mg by the magnitude of gravity. What is ambiguous is refused.
    `accel_sign`
        "android": at rest, level, the up axis reads +1 g; "ios": it reads −1 g and everything is
        negated; "detect" assumes that the screen (+z) points up more than down over the recording.
        Nothing in the data alone tells the sign.
    `order`
        Rows out of order are sorted and rows that are there twice dropped ("sort"), or refused.
    `rate`
        Hz of the result; None keeps the faster sensor's own.
    `separator`
        Of the columns; None takes the most frequent of comma, semicolon and tab, or blanks where
        there is none of them.
    `name`
        Of the sequence; None takes that of the file.

    Two sensors with stamps of their own are put on the faster one's over the time that both cover,
    by cubic splines. Raises `InputError` naming file, field and remedy.
    """
    _check_choice("time_unit", time_unit, PER_SECOND)
    _check_choice("gyro_unit", gyro_unit, units.TO_RAD_PER_SECOND)
    _check_choice("accel_unit", accel_unit, units.TO_METRES_PER_SECOND_SQUARED)
    _check_choice("accel_sign", accel_sign, units.SIGNS)
    _check_choice("order", order, ("sort", "refuse"))
    if rate is not None and not 1.0 <= rate <= RATES[1]:
        raise InputError(
            "rate", f"{rate:g} Hz is no rate to resample to", f"give 1 to {RATES[1]:g} Hz"
        )
    notes: list[str] = []
    gyro_file, accel_file = _sensor_files(path, accel_path, dict(columns or {}), separator)
    gyro = read_stream(gyro_file, time_unit, order, notes)
    accel = read_stream(accel_file, time_unit, order, notes)
    scale = units.accel_scale(accel.values, accel_unit, accel_file.path, notes)
    imu = join(gyro, _scaled(accel, scale), gyro_file.path, accel_file.path, notes)
    scale = units.gyro_scale(imu, gyro_unit, gyro_file.path, notes)
    force = units.signed(imu.accel, accel_sign, accel_file.path, notes)
    imu = imu._replace(gyro=imu.gyro * scale, accel=force)
    units.note_gravity(imu, accel_file.path, notes)
    sequence = _without_reference(imu, name or gyro_file.path.stem, gyro_file.path)
    target = rate or rounded_rate(imu.time)
    notes.append(f"put on a uniform clock of {target:g} Hz")
    return Imported(resample(sequence, target), tuple(notes))


def _check_choice(option: str, value: str | None, choices: Mapping[str, float] | tuple) -> None:
    if value is not None and value not in choices:
        raise InputError(option, f"unknown value '{value}'", f"known: {', '.join(choices)}")


def _sensor_files(
    path: str | os.PathLike[str],
    accel_path: str | os.PathLike[str] | None,
    columns: dict[str, str],
    separator: str | None,
) -> tuple[SensorFile, SensorFile]:
    """Where the gyro's and the accelerometer's samples are; the tables are read."""
    if unknown := sorted(set(columns) - set(_COLUMNS)):
        known = ", ".join(sorted(_COLUMNS))
        raise InputError("columns", f"unknown name '{unknown[0]}'", f"known names: {known}")
    time = columns.get("time", "time")
    gyro_axes, accel_axes = (
        tuple(columns.get(axis, axis) for axis in axes) for axes in (GYRO, ACCEL)
    )
    gyro_path = Path(path)
    table = read_table(gyro_path, separator, (time, *gyro_axes))
    gyro = SensorFile("gyro", gyro_path, table, time, gyro_axes)
    accel = SensorFile("accel", gyro_path, table, columns.get("accel_time", time), accel_axes)
    if accel_path is not None:
        own = Path(accel_path)
        accel_table = read_table(own, separator, (accel.time, *accel_axes))
        accel = accel._replace(path=own, table=accel_table)
    return gyro, accel


def _scaled(stream: Stream, scale: float) -> Stream:
    return stream._replace(values=stream.values * scale)


def _without_reference(imu: Joined, name: str, source: Path) -> Sequence:
    count = len(imu.time)
    nothing = np.full((count, 3), np.nan)
    sequence = Sequence(
        name=name,
        time=imu.time,
        gyro=imu.gyro,
        accel=imu.accel,
        orientation=np.full((count, 4), np.nan),
        position=nothing,
        velocity=nothing,
        valid=np.zeros(count, dtype=bool),
        attributes={"dataset": "csv", "group": name, "truth": "none", "start_time": imu.start},
    )
    return validate(sequence, source)
