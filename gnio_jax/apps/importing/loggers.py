"""The exports of phone loggers: tables in a zip or folder, one table, or a workbook.

Facts of Sensor Logger (Kelvin Choi; Android and iOS), from its documentation
(github.com/tszheichoi/awesome-sensor-logger):

- There is a CSV of each sensor with the columns `time,seconds_elapsed,z,y,x`: ns since 1970, s
  since the start (UNITS.md). Exports of 2021 lack the second one (seen).
- `Gyroscope` and `GyroscopeUncalibrated` are in rad/s, with the same axes on both systems
  (UNITS.md, COORDINATES.md). `Accelerometer` is in m/s² without gravity, `Gravity` in m/s²; their
  sum is the accelerometer's reading. Android adds `TotalAcceleration`, gravity included (UNITS.md).
- `AccelerometerUncalibrated` includes gravity, in m/s² on Android; on iOS in g unless "Standardise
  Units & Frames" is on (UNITS.md). Its magnitude shows the unit.
- All accelerations of iOS have the other sign, unless that setting is on (CROSSPLATFORM.md).
- `Magnetometer` and `MagnetometerUncalibrated` are in µT, `pressure` of `Barometer` is in mbar, and
  `Location` has `latitude`, `longitude` (°), `altitude` (m above the ellipsoid) and accuracies of
  about one standard deviation (m), negative if there is no fix (UNITS.md).
- `Metadata.csv` says `platform`, ios or android (seen in exports of releases 1.10 and 1.28), and
  since 1.29 `standardisation`, false where that setting is off (seen), true where it is on
  (assumed). Without the file, `TotalAcceleration` means Android; else the sign must be stated.

Facts of phyphox (RWTH Aachen; Android and iOS), from its sources (github.com/phyphox):

- There is a table for each set of an experiment's export: `Accelerometer`, `Gyroscope`, `Linear
  Acceleration`, ...; for a single sensor it is `Raw Data` (phyphox-android,
  SimpleExperimentCreator.java, accelerometer.phyphox). A zip also has `meta/`, and a workbook the
  sheets `Metadata ...` (DataExport.java). Short columns are filled with NaN.
- Columns `Time (s)`, `Acceleration x (m/s^2)`, `Linear Acceleration x (m/s^2)`, `Gyroscope x
  (rad/s)`. Earlier releases wrote `X (m/s^2)` and `X (rad/s)` (seen in exports). The app translates
  names, so sensors are recognised by units and axes, and only Linear and Gravity by their names.
- `Magnetic field x (µT)`, `Pressure (hPa)`; the columns of a place are latitude and longitude (°),
  height (m), velocity, direction (°), horizontal and vertical accuracy (m) in this order (seen).
- All sensors share one clock, s since the start. It stops while the experiment is paused
  (ExperimentTimeReference.java); `meta/time.csv`, or the sheet `Metadata Time`, has the times of
  START and PAUSE by the phone's clock too.
- "Acceleration" includes gravity, "Linear Acceleration" does not. iOS's readings are multiplied by
  −9.81, so that both systems have Android's sign (phyphox-ios, ExperimentSensorInput.swift: kG).
"""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from gnio_jax.apps.importing.clocks import Sensor, sensor_of
from gnio_jax.apps.importing.files import LogFile, spell_names
from gnio_jax.apps.importing.readings import ACCURACY, RawReadings, leaving_out, readings_of
from gnio_jax.apps.importing.recording import RawRecording
from gnio_jax.data.labels import unit_of, unit_text
from gnio_jax.data.parsing.text import NO_ROW, open_text
from gnio_jax.data.sensors import BAROMETER, GNSS, MAGNETOMETER, SENSOR_KINDS
from gnio_jax.errors import InputError
from gnio_jax.numerics import interpolate

_AXIS = re.compile(r"\b([xyz])\b", re.IGNORECASE)
_TURNS = ("rad/s", "deg/s")
SENSORS = {
    "Gyroscope": ("gyro", "rad/s"),
    "GyroscopeUncalibrated": ("gyro", "rad/s"),
    "TotalAcceleration": ("accel", "m/s2"),
    "Accelerometer": ("linear", "m/s2"),
    "Gravity": ("gravity", "m/s2"),
    "AccelerometerUncalibrated": ("raw", None),
}
"""Sensor Logger's files: the kind and the unit of each."""
OTHERS = {
    "Magnetometer": (MAGNETOMETER, "µT"),
    "MagnetometerUncalibrated": (MAGNETOMETER, "µT"),
    "Barometer": (BAROMETER, "hPa"),
    "Location": (GNSS, None),
}
"""Sensor Logger's files of sensors beside the IMU: the sensor and its unit. Of two files of one
sensor the first one is taken."""
REMEDIES = {
    "Sensor Logger": "switch on Gyroscope, Accelerometer and Gravity",
    "phyphox": "record the gyroscope and the acceleration with g in one experiment (+ adds one)",
}
"""What each app's user does if a sensor is missing, by the first words of the app's name."""


class _Set(NamedTuple):
    """One sensor's columns of a table."""

    kind: str
    """gyro; accel (with gravity), linear (without) or gravity; raw: accel in an unknown unit."""
    unit: str | None
    file: LogFile
    time: str
    axes: tuple[str, ...]

    def sensor(self, name: str) -> Sensor:
        second = "ns" if self.time == "time" else "s"
        return sensor_of(name, self.file.read()[0], second, self.unit, self.time, *self.axes)


def read_logger(path: Path, files: list[LogFile]) -> RawRecording | None:
    """Read a recording exported by either app; None if it is from neither. Raises `InputError` if a
    sensor is missing, or if there is only acceleration without gravity."""
    gyros = [file.layout.labels for file in files if file.location.stem == "Gyroscope"]
    headers = [file.layout.labels for file in files]
    if any({"time", "x", "y", "z"} <= set(labels) for labels in gyros) or any(
        "seconds_elapsed" in labels for labels in headers
    ):
        return _sensor_logger(path, files)
    # A time in s, and three axes in units of an IMU.
    if any(any(map(_is_time, labels)) and _axes_of(labels) for labels in headers):
        return _phyphox(path, files)
    return None


# --- Sensor Logger


def _sensor_logger(path: Path, files: list[LogFile]) -> RawRecording:
    parts = [file for file in files if file.location.stem in (*SENSORS, "Metadata")]
    sensors = [part for part in parts if part.location.stem in SENSORS]
    folders = sorted({str(part.location.parent) for part in sensors})
    if len(folders) > 1:
        raise InputError(path, f"holds {len(folders)} recordings: {', '.join(folders)}", "give one")
    parts = [part for part in parts if str(part.location.parent) in folders]
    tables = {part.location.stem: part for part in parts}
    if len(tables) < len(parts):
        raise InputError(path, f"holds a sensor twice ({spell_names(parts)})", "leave one of them")
    if "Gyroscope" in tables:
        tables.pop("GyroscopeUncalibrated", None)
    sets = []
    for name in [name for name in SENSORS if name in tables]:
        clock = "time" if "time" in tables[name].layout.labels else "seconds_elapsed"
        kind, unit = SENSORS[name]
        sets.append(_Set(kind, unit, tables[name], clock, ("x", "y", "z")))
    row = {"platform": "android"} if "TotalAcceleration" in tables else {}
    if "Metadata" in tables:
        file = tables["Metadata"]
        with open_text(file.path, file.content()) as text:
            row = next(csv.DictReader(text), {})
    setting = str(row.get("standardisation", "false")).strip().lower()
    standard = {"true": "android", "false": "ios"}.get(setting)
    systems = {"android": ("Android", "android"), "ios": ("iOS", standard)}
    platform = str(row.get("platform")).strip().lower()
    system, sign = systems.get(platform, ("unknown system", None))
    recording = _recording(path, f"Sensor Logger ({system})", files, sets, sign)
    return _with_others(recording, _logger_columns(files, folders))


def _logger_columns(files: list[LogFile], folders: list[str]) -> Iterator[_OtherTable]:
    """The tables of other sensors of Sensor Logger."""
    tables = {file.location.stem: file for file in files if str(file.location.parent) in folders}
    for name, (sensor, unit) in OTHERS.items():
        labels = tables[name].layout.labels if name in tables else ()
        names = {axis: axis for axis in SENSOR_KINDS[sensor].columns if axis in labels}
        accuracy = dict(zip(ACCURACY, ("horizontalAccuracy", "verticalAccuracy"), strict=True))
        names |= {ours: theirs for ours, theirs in accuracy.items() if theirs in labels}
        clock, second = ("time", "ns") if "time" in labels else ("seconds_elapsed", "s")
        if name in tables:
            yield _OtherTable(sensor, tables[name], clock, second, names, unit)


# --- phyphox


def _phyphox(path: Path, files: list[LogFile]) -> RawRecording:
    sets = []
    for file in files:
        if {"event", "system time"} <= set(file.layout.labels):
            _check_pauses(file, path)
        sensors = _axes_of(file.layout.labels)
        time = next(filter(_is_time, file.layout.labels), None)
        if sensors and time is None:
            problem = f"has no column of time in s in its table {file.name}"
            raise InputError(path, problem, "export it again")
        for name, unit, axes in sensors:
            # Earlier releases name the sensor by the file alone.
            match = re.search(r"(?:^|\n)(linear|gravity)", f"{name}\n{file.location.stem.lower()}")
            kind = "gyro" if unit in _TURNS else match[1] if match else "accel"
            sets.append(_Set(kind, unit, file, str(time), axes))
    recording = _recording(path, "phyphox", files, sets, "android")
    return _with_others(recording, _phyphox_columns(files))


def _phyphox_columns(files: list[LogFile]) -> Iterator[_OtherTable]:
    """The tables of other sensors of phyphox, by the units and the order of their columns."""
    for file in files:
        labels = file.layout.labels
        time = next(filter(_is_time, labels), "Time (s)")
        units = {label: (unit_text(label) or "").lower() for label in labels}
        degrees, metres = ([x for x in labels if units[x] == unit] for unit in ("°", "m"))
        pressures = [label for label in labels if units[label] in ("hpa", "mbar")]
        fields = {
            match[1].lower(): label
            for label in labels
            if units[label] in ("µt", "μt", "ut") and (match := _AXIS.search(label))
        }
        clock = file, time, "s"
        if set("xyz") == fields.keys():
            yield _OtherTable(MAGNETOMETER, *clock, fields, "µT")
        if len(pressures) == 1:
            yield _OtherTable(BAROMETER, *clock, {"pressure": pressures[0]}, "hPa")
        if len(degrees) >= 2:
            names = ("altitude", *ACCURACY)
            columns = dict(zip(("latitude", "longitude"), degrees, strict=False))
            yield _OtherTable(GNSS, *clock, columns | dict(zip(names, metres, strict=False)))


def _is_time(label: str) -> bool:
    return unit_of(unit_text(label)) == "s"


def _axes_of(labels: Iterable[str]) -> list[tuple[str, str, tuple[str, ...]]]:
    """(name, unit, columns x, y, z) of each sensor in a table."""
    sensors: dict[tuple[str, str], dict[str, str]] = {}
    for label in labels:
        unit, axis = unit_of(unit_text(label)), _AXIS.search(label)
        if unit in (*_TURNS, "m/s2", "g") and axis:
            name = label[: axis.start()].strip().lower()
            sensors.setdefault((name, unit), {}).setdefault(axis[1].lower(), label)
    whole = {sensor: axes for sensor, axes in sensors.items() if len(axes) == 3}
    return [(*sensor, tuple(axes[axis] for axis in "xyz")) for sensor, axes in whole.items()]


def _check_pauses(file: LogFile, path: Path) -> None:
    """Raise `InputError` if a table of events has a pause: the clock stopped, so the samples do not
    show that some are missing."""
    try:
        events = file.read()[0].columns
    except InputError:
        return  # it has no row
    kinds = [str(kind).strip().upper() for kind in events["event"]]
    clock = np.asarray(pd.to_numeric(events["system time"], errors="coerce"), np.float64)
    pairs = zip(itertools.pairwise(kinds), itertools.pairwise(clock), strict=True)
    pauses = [stop - start for pair, (start, stop) in pairs if pair == ("PAUSE", "START")]
    if pauses:
        problem = f"was paused {len(pauses)} times, for up to {max(pauses):.1f} s, and the stamps"
        raise InputError(path, f"{problem} do not show where", "record without a pause")


# --- both


class _OtherTable(NamedTuple):
    """The table of a sensor beside the IMU."""

    sensor: str
    file: LogFile
    clock: str
    """Column of the stamps."""
    second: str
    """Unit of the stamps."""
    columns: dict[str, str]
    """Our name of a column → the file's."""
    unit: str | None = None


def _with_others(recording: RawRecording, tables: Iterable[_OtherTable]) -> RawRecording:
    """The recording with the readings of these tables. Those of a sensor that was not recorded are
    left out with a note, and those without its columns with a warning."""
    readings = dict[str, RawReadings]()
    for sensor, file, clock, second, columns, unit in tables:
        with leaving_out(sensor, recording.warnings):
            try:
                table, _ = file.read()
            except InputError as error:
                if error.parts[1] != NO_ROW:
                    raise
                recording.notes.append(f"{sensor} is left out: {error}")
                continue
            is_whole = clock in table.columns and table.columns[clock].dtype.kind in "iu"
            stamps = table.stamps(clock) if is_whole else table.take(clock, gaps=True)
            kind = SENSOR_KINDS[sensor]
            if missing := set(kind.columns[: kind.required]) - columns.keys():
                problem = f"column '{min(missing)}' is missing"
                raise InputError(file.path, problem, "export it again")
            new = readings_of(sensor, table, stamps, columns, second, unit)
            readings.setdefault(sensor, new)
    return recording._replace(others=tuple(readings.values()))


def _recording(
    path: Path, app: str, files: list[LogFile], sets: list[_Set], sign: str | None
) -> RawRecording:
    """The gyro, and the accelerometer with gravity: from a set of its own, or as the sum of the set
    without gravity and that of gravity."""
    kinds = {one.kind for one in sets}
    remedy = next(remedy for name, remedy in REMEDIES.items() if app.startswith(name))
    for sensor, needed in (("gyro", {"gyro"}), ("accelerometer", {"accel", "linear", "raw"})):
        if not kinds & needed:
            raise InputError(path, f"has no {sensor} (found: {spell_names(files)})", remedy)
    gyro = _require_one("gyro", sets, path)
    if "accel" in kinds:
        parts = [_require_one("accel", sets, path)]
    elif {"linear", "gravity"} <= kinds:
        parts = [_require_one(kind, sets, path) for kind in ("linear", "gravity")]
    elif "raw" in kinds:
        parts = [_require_one("raw", sets, path)]
    else:
        name = next(one.file.name for one in sets if one.kind == "linear")
        raise InputError(path, f"holds acceleration without gravity ({name})", remedy)
    accel = parts[0].sensor("accel")
    if len(parts) > 1:
        accel = _add_gravity(accel, parts[1].sensor("accel"))
    clock, unit = "ns" if gyro.time == "time" else "s", parts[0].unit
    of_accel = " + ".join(part.file.name for part in parts) + (f" in {unit}" if unit else "")
    note = f"{path.name}: {app}; time in {clock}, {gyro.file.name} in {gyro.unit}, {of_accel}"
    remarks = [remark for one in (gyro, *parts) for remark in one.file.read()[1]]
    notes = [note, *dict.fromkeys(remarks)]
    is_raw = gyro.file.location.stem == "GyroscopeUncalibrated"
    return RawRecording(path, gyro.sensor("gyro"), accel, notes, [], sign, raw_gyro=is_raw)


def _require_one(kind: str, sets: list[_Set], path: Path) -> _Set:
    """The only set of a kind. Raises `InputError` if there are several."""
    sets = [one for one in sets if one.kind == kind]
    if len(sets) > 1:
        names = ", ".join(f"{one.file.name} ({one.axes[0]})" for one in sets)
        remedy = "leave the table of one of them in it, or export that one alone"
        if path.name == sets[0].file.name:
            remedy = "name the columns of one by --columns"
        raise InputError(path, f"holds {len(sets)} sets of a sensor: {names}", remedy)
    return sets[0]


def _add_gravity(motion: Sensor, gravity: Sensor) -> Sensor:
    """The accelerometer's reading on the stamps of `motion`: the sum of the acceleration without
    gravity and of gravity, which turns slowly and is interpolated linearly (ours)."""
    valid = np.isfinite(gravity.values).all(axis=1) & np.isfinite(gravity.stamps)
    if valid.sum() < 2:
        raise InputError(gravity.file, f"holds {valid.sum()} samples", "record for longer")
    first = np.nanmin(motion.stamps)  # unix time in ns has more digits than a float
    time, stamps = ((s - first).astype(np.float64) for s in (motion.stamps, gravity.stamps))
    order = np.flatnonzero(valid)[np.argsort(stamps[valid], kind="stable")]
    inside = (time >= stamps[order[0]]) & (time <= stamps[order[-1]])
    down = interpolate(time[inside], stamps[order], gravity.values[order])
    motion = motion.select_rows(inside)
    return motion._replace(values=motion.values + down)
