"""Sensor Logger (Kelvin Choi; Android and iOS): a zip, or the folder unpacked from it.

It holds a CSV of each sensor, with the columns `time,seconds_elapsed,z,y,x`.

Facts, from the app's documentation (github.com/tszheichoi/awesome-sensor-logger):

- `time` is in ns since 1970, `seconds_elapsed` in s since the start (UNITS.md).
- `Gyroscope` and `GyroscopeUncalibrated` are in rad/s, with the same axes on both systems
  (UNITS.md, COORDINATES.md).
- `Accelerometer` is in m/s² without gravity, `Gravity` in m/s²; their sum is the accelerometer's
  reading. Android adds `TotalAcceleration`, gravity included, m/s² (UNITS.md).
- `AccelerometerUncalibrated` includes gravity, in m/s² on Android; on iOS in g unless "Standardise
  Units & Frames" is on (UNITS.md). Its magnitude tells.
- All accelerations of iOS have the other sign, unless that setting is on (CROSSPLATFORM.md).

`Metadata.csv` says `platform`, ios or android (seen in exports of releases 1.10 and 1.28), and
since 1.29 `standardisation`, false where that setting is off (seen), true where it is on (assumed).
Where the file is missing, `TotalAcceleration` tells Android. Otherwise the sign must be stated.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from gnio_jax.apps.importing import archives
from gnio_jax.apps.importing.recording import (
    Recording,
    Sensor,
    Units,
    added,
    read_table,
    sensor_of,
)
from gnio_jax.data.parsing.tables import Table
from gnio_jax.errors import InputError

_AXES = ("x", "y", "z")
_GYROS = ("Gyroscope", "GyroscopeUncalibrated")


class _Export(NamedTuple):
    """The tables of one recording, not yet read."""

    path: Path
    names: dict[str, str]
    """Sensor, which is the file's name without suffix -> file."""

    def table(self, sensor: str) -> Table:
        place = self.path / self.names[sensor]
        return read_table(place, (), content=archives.content(self.path, self.names[sensor]))

    def sensor(self, name: str, kind: str) -> Sensor:
        table = self.table(name)
        return sensor_of(kind, table, _clock(table), _AXES)


class _Device(NamedTuple):
    """What Metadata.csv says; None where it says nothing that is known."""

    platform: str | None
    standardised: bool | None

    @property
    def sign(self) -> str | None:
        """Of its accelerations."""
        if self.platform == "ios":
            return {True: "android", False: "ios", None: None}[self.standardised]
        return self.platform


def is_sensor_logger(tables: Iterable[Sequence[str]]) -> bool:
    """By the columns of the tables of a zip or folder."""
    return any("seconds_elapsed" in labels for labels in tables)


def _clock(table: Table) -> str:
    return "time" if "time" in table.columns else "seconds_elapsed"


def read_sensor_logger(path: Path) -> Recording:
    """A recording of its zip or folder. Raises `InputError` where a sensor is missing."""
    export = _export(path)
    gyro = next((sensor for sensor in _GYROS if sensor in export.names), None)
    if gyro is None:
        raise _missing("gyro", export)
    device = _device(export)
    accel, unit, how = _accelerometer(export)
    shown = {"ios": "iOS", "android": "Android"}.get(device.platform or "", "unknown system")
    unit_of_time = "ns" if _clock(export.table(gyro)) == "time" else "s"
    found = f"time in {unit_of_time}, {gyro} in rad/s, {how}"
    return Recording(
        path,
        export.sensor(gyro, "gyro"),
        accel,
        Units(unit_of_time, "rad/s", unit, device.sign),
        notes=(f"{path.name}: Sensor Logger ({shown}); {found}",),
    )


def _export(path: Path) -> _Export:
    groups = {
        folder: {PurePosixPath(name).stem: name for name in names}
        for folder, names in archives.csv_names(path).items()
    }
    recordings = {
        folder: names
        for folder, names in groups.items()
        if set(names) & {*_GYROS, "Accelerometer", "TotalAcceleration"}
    }
    if len(recordings) > 1:
        raise InputError(
            path, f"holds {len(recordings)} recordings: {', '.join(sorted(recordings))}", "give one"
        )
    return _Export(path, next(iter((recordings or groups).values())))


def _accelerometer(export: _Export) -> tuple[Sensor, str | None, str]:
    """The specific force (with the system's sign), its unit if that is known, and what it is."""
    if "TotalAcceleration" in export.names:
        total = export.sensor("TotalAcceleration", "accel")
        return total, "m/s2", "TotalAcceleration in m/s2"
    if {"Accelerometer", "Gravity"} <= export.names.keys():
        # iOS gives both of one sample; on Android their stamps differ.
        motion, gravity = (export.sensor(name, "accel") for name in ("Accelerometer", "Gravity"))
        return added(motion, gravity), "m/s2", "Accelerometer + Gravity in m/s2"
    if "AccelerometerUncalibrated" in export.names:
        raw = export.sensor("AccelerometerUncalibrated", "accel")
        return raw, None, "AccelerometerUncalibrated"
    if "Accelerometer" in export.names:
        raise InputError(
            export.path / export.names["Accelerometer"],
            "is without gravity, and there is no Gravity.csv",
            "switch on Gravity (or Total Acceleration) in the app and record again",
        )
    raise _missing("accelerometer", export)


def _device(export: _Export) -> _Device:
    if "Metadata" not in export.names:
        return _Device("android" if "TotalAcceleration" in export.names else None, None)
    text = archives.content(export.path, export.names["Metadata"]).decode("utf-8-sig", "replace")
    row = next(csv.DictReader(io.StringIO(text)), {})
    platform = str(row.get("platform")).strip().lower()
    setting = str(row.get("standardisation", "false")).strip().lower()
    return _Device(
        platform if platform in ("ios", "android") else None,
        {"true": True, "false": False}.get(setting),
    )


def _missing(sensor: str, export: _Export) -> InputError:
    found = ", ".join(sorted(export.names)) or "nothing"
    return InputError(
        export.path,
        f"has no {sensor} (found: {found})",
        "switch on Accelerometer, Gravity and Gyroscope in the app and record again",
    )
