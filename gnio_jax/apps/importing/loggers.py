"""The exports of phone loggers: a zip or folder of CSV files, one CSV, or a workbook.

Zips are read in memory: nothing is unpacked to the disk.

Facts of Sensor Logger (Kelvin Choi; Android and iOS), from its documentation
(github.com/tszheichoi/awesome-sensor-logger):

- There is a CSV of each sensor with the columns `time,seconds_elapsed,z,y,x`: ns since 1970, s
  since the start (UNITS.md).
- `Gyroscope` and `GyroscopeUncalibrated` are in rad/s, with the same axes on both systems
  (UNITS.md, COORDINATES.md).
- `Accelerometer` is in m/s² without gravity, `Gravity` in m/s²; their sum is the accelerometer's
  reading. Android adds `TotalAcceleration`, gravity included, m/s² (UNITS.md).
- `AccelerometerUncalibrated` includes gravity, in m/s² on Android; on iOS in g unless "Standardise
  Units & Frames" is on (UNITS.md). Its magnitude shows the unit.
- All accelerations of iOS have the other sign, unless that setting is on (CROSSPLATFORM.md).
- `Metadata.csv` says `platform`, ios or android (seen in exports of releases 1.10 and 1.28), and
  since 1.29 `standardisation`, false where that setting is off (seen), true where it is on
  (assumed). If the file is missing, `TotalAcceleration` shows that it is Android. Otherwise the
  sign must be stated.

Facts of phyphox (RWTH Aachen; Android and iOS), from its sources (github.com/phyphox):

- There is a table for each set of an experiment's export: `Accelerometer`, `Gyroscope`, `Linear
  Acceleration`, ...; for a single sensor it is `Raw Data` (phyphox-android,
  SimpleExperimentCreator.java, accelerometer.phyphox). A zip also has `meta/`, and a workbook the
  sheets `Metadata ...` (DataExport.java).
- Columns `Time (s)`, `Acceleration x (m/s^2)`, `Linear Acceleration x (m/s^2)`, `Gyroscope x
  (rad/s)`. Earlier releases wrote `X (m/s^2)` and `X (rad/s)` (seen in exports). The app translates
  names, so sensors are recognised by units and axes, and only Linear and Gravity by their names.
- Separators are comma, semicolon or tab, the decimal is a point or a comma; short columns are
  filled with NaN (DataExport.java).
- All sensors share one clock, s since the start. It stops while the experiment is paused
  (ExperimentTimeReference.java); `meta/time.csv`, or the sheet `Metadata Time`, has the times of
  START and PAUSE by the phone's clock too.
- "Acceleration" includes gravity, "Linear Acceleration" does not. iOS's readings are multiplied by
  −9.81, so that both systems have Android's sign (phyphox-ios, ExperimentSensorInput.swift: kG).
"""

from __future__ import annotations

import csv
import io
import itertools
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from gnio_jax.apps.importing.recording import (
    Recording,
    Sensor,
    Units,
    read_table,
    sensor_of,
    table_layout,
)
from gnio_jax.apps.importing.units import named_unit
from gnio_jax.data.parsing.tables import Table, parsed_as, shortened
from gnio_jax.errors import InputError, require_packages
from gnio_jax.numerics import interpolate

XLS_MAGIC = b"\xd0\xcf\x11\xe0"
"""First bytes of an OLE file (.xls)."""
LARGEST = 512 * 2**20
"""Largest unpacked size of a table, bytes: six hours of a sensor at 200 Hz are less (ours)."""
MOST_TABLES = 200
"""Largest number of CSV files; a logger writes one for each sensor (ours)."""
_HEAD = 4096
"""Number of bytes that contain the first line of a table."""
_AXIS = re.compile(r"\b([xyz])\b", re.IGNORECASE)
_KINDS = ("gyro", "accel", "linear", "gravity", "raw")
_TURNS = ("rad/s", "deg/s")
_SENSORS = {
    "Gyroscope": ("gyro", "rad/s"),
    "GyroscopeUncalibrated": ("gyro", "rad/s"),
    "TotalAcceleration": ("accel", "m/s2"),
    "Accelerometer": ("linear", "m/s2"),
    "Gravity": ("gravity", "m/s2"),
    "AccelerometerUncalibrated": ("raw", None),
}
"""Sensor Logger's files: the kind and the unit of each."""
_REMEDY = (
    "record the gyroscope and the accelerometer with gravity "
    "(Sensor Logger: switch on Accelerometer and Gravity)"
)


class _File(NamedTuple):
    """A table of an export, not yet read."""

    name: str
    """Name within a zip, folder or workbook, such as "meta/time.csv"."""
    labels: tuple[str, ...]
    """Names of its columns."""
    read: Callable[[], Table]

    @property
    def place(self) -> PurePosixPath:
        return PurePosixPath(self.name)


class _Set(NamedTuple):
    """One sensor's columns of a table."""

    kind: str
    """gyro; accel (with gravity), linear (without) or gravity; raw: accel in an unknown unit."""
    unit: str | None
    file: _File
    time: str
    axes: tuple[str, ...]

    def sensor(self, name: str) -> Sensor:
        return sensor_of(name, self.file.read(), self.time, *self.axes)


def is_phyphox(labels: Iterable[str]) -> bool:
    """Whether the columns of a table are phyphox's: a time in s, and three axes in units of an
    IMU."""
    labels = list(labels)
    return any(map(_is_time, labels)) and bool(_axes_of(labels))


def read_logger(path: Path) -> Recording:
    """Read a recording exported by either app. Raises `InputError` if it is from neither, if a
    sensor is missing, or if there is only acceleration without gravity."""
    files = _files(path)
    if any("seconds_elapsed" in file.labels for file in files):
        return _sensor_logger(path, files)
    if any(is_phyphox(file.labels) for file in files):
        return _phyphox(path, files)
    raise InputError(
        path,
        f"has the layout of no known recording (found: {_names(files)})",
        "known: CSV, Sensor Logger, phyphox, ROS bags, MCAP and EuRoC folders; "
        "a CSV of other columns needs --columns",
    )


def _names(files: list[_File]) -> str:
    return shortened(", ".join(file.name for file in files) or "no CSV file", 200)


# --- the tables of an export


def _files(path: Path) -> list[_File]:
    """The tables of a zip, of a folder with its subfolders, of a workbook, or the single CSV.
    Raises `InputError` for a damaged file or one that unpacks to more than a logger writes."""
    if path.is_dir():
        found = sorted(each for each in (*path.glob("*"), *path.glob("*/*")) if each.is_file())
        return _of_csvs(path, [each.relative_to(path).as_posix() for each in found])
    with path.open("rb") as file:
        magic = file.read(4)
    if magic == XLS_MAGIC:
        return _of_workbook(path, "xlrd")
    if not magic.startswith(b"PK"):
        return [_File(path.name, table_layout(path).labels, partial(read_table, path))]
    with parsed_as(path, "a zip"), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    if any(member.filename == "xl/workbook.xml" for member in members):  # ECMA-376, part 2
        _check_size(sum(member.file_size for member in members), path)
        return _of_workbook(path, "openpyxl")
    return _of_csvs(path, [member.filename for member in members])


def _of_csvs(path: Path, names: list[str]) -> list[_File]:
    """The CSV files among the files of a zip or folder."""
    tables = [
        name
        for name in names
        # macOS adds a file "._Gyroscope.csv" to each Gyroscope.csv.
        if name.lower().endswith(".csv") and not PurePosixPath(name).name.startswith(".")
    ]
    if len(tables) > MOST_TABLES:
        raise InputError(path, f"holds {len(tables)} CSV files", "give one recording of a logger")
    found = []
    for name in tables:
        first_line = b"".join(_content(path, name, _HEAD).splitlines()[:1])
        try:
            labels = table_layout(path / name, first_line).labels
        except InputError:
            labels = ()  # not a text
        found.append(_File(name, labels, partial(_read_member, path, name)))
    return found


def _read_member(path: Path, name: str) -> Table:
    return read_table(path / name, content=_content(path, name))


def _content(path: Path, name: str, most: int = -1) -> bytes:
    """The content of a file of a zip or folder, or its first `most` bytes."""
    if path.is_dir():
        with parsed_as(path / name, "a file"), (path / name).open("rb") as file:
            return file.read(most)
    with parsed_as(path, "a zip"), zipfile.ZipFile(path) as archive:
        _check_size(archive.getinfo(name).file_size, path / name)
        with archive.open(name) as file:  # it gives at most the announced size
            return file.read(most)


def _check_size(size: int, place: Path) -> None:
    if size > LARGEST:
        problem = f"unpacks to {size / 2**20:.0f} MiB"
        raise InputError(place, problem, f"no table may exceed {LARGEST / 2**20:.0f} MiB")


def _of_workbook(path: Path, engine: str) -> list[_File]:
    require_packages(path, "excel", engine)
    options: dict[str, Any] = {"engine": engine}
    if engine == "xlrd":  # it writes remarks about a damaged file to the standard output
        options["engine_kwargs"] = {"logfile": io.StringIO()}
    with parsed_as(path, "a workbook"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings about styles
        sheets: dict[Any, pd.DataFrame] = pd.read_excel(path, sheet_name=None, **options)
    return [
        _File(str(name), tuple(map(str, sheet.columns)), partial(Table, path / str(name), sheet))
        for name, sheet in sheets.items()
    ]


# --- Sensor Logger


def _sensor_logger(path: Path, files: list[_File]) -> Recording:
    folders = sorted({str(each.place.parent) for each in files if each.place.stem in _SENSORS})
    if len(folders) > 1:
        raise InputError(path, f"holds {len(folders)} recordings: {', '.join(folders)}", "give one")
    own = {each.place.stem: each for each in files if str(each.place.parent) in folders}
    if "Gyroscope" in own:
        own.pop("GyroscopeUncalibrated", None)
    sets = [
        _Set(kind, unit, own[name], _clock(own[name]), ("x", "y", "z"))
        for name, (kind, unit) in _SENSORS.items()
        if name in own
    ]
    platform, standard = None, None
    if "Metadata" in own:
        text = _content(path, own["Metadata"].name).decode("utf-8-sig", "replace")
        row = next(csv.DictReader(io.StringIO(text)), {})
        platform = str(row.get("platform")).strip().lower()
        setting = str(row.get("standardisation", "false")).strip().lower()
        standard = {"true": "android", "false": "ios"}.get(setting)
    elif "TotalAcceleration" in own:
        platform = "android"
    system, sign = {"android": ("Android", "android"), "ios": ("iOS", standard)}.get(
        platform or "", ("unknown system", None)
    )
    return _recording(path, f"Sensor Logger ({system})", files, sets, sign)


def _clock(file: _File) -> str:
    return "time" if "time" in file.labels else "seconds_elapsed"


# --- phyphox


def _phyphox(path: Path, files: list[_File]) -> Recording:
    sets = []
    for file in files:
        if {"event", "system time"} <= set(file.labels):
            _check_pauses(file, path)
        found = _axes_of(file.labels)
        time = next(filter(_is_time, file.labels), None)
        if found and time is None:
            problem = f"has no column of time in s in its table {file.name}"
            raise InputError(path, problem, "export it again")
        for name, unit, axes in found:
            # Earlier releases name the sensor by the file alone.
            names = (name, file.place.stem.lower())
            kind = next(
                (k for k in ("linear", "gravity") for n in names if n.startswith(k)), "accel"
            )
            sets.append(_Set("gyro" if unit in _TURNS else kind, unit, file, str(time), axes))
    return _recording(path, "phyphox", files, sets, "android")


def _is_time(label: str) -> bool:
    return named_unit(label) == "s"


def _axes_of(labels: Iterable[str]) -> list[tuple[str, str, tuple[str, ...]]]:
    """(name, unit, columns x, y, z) of each sensor in a table."""
    found: dict[tuple[str, str], dict[str, str]] = {}
    for label in labels:
        unit, axis = named_unit(label), _AXIS.search(label)
        if unit in (*_TURNS, "m/s2", "g") and axis:
            name = label[: axis.start()].strip().lower()
            found.setdefault((name, unit), {}).setdefault(axis[1].lower(), label)
    return [
        (name, unit, tuple(axes[axis] for axis in "xyz"))
        for (name, unit), axes in found.items()
        if len(axes) == 3
    ]


def _check_pauses(file: _File, path: Path) -> None:
    """Raise `InputError` if a table of events has a pause: the clock stopped, so the samples do not
    show that some are missing."""
    try:
        events = file.read().columns
    except InputError:
        return  # it has no row
    kinds = [str(kind).strip().upper() for kind in events["event"]]
    clock = np.asarray(pd.to_numeric(events["system time"], errors="coerce"), np.float64)
    pauses = [
        after - before
        for pair, (before, after) in zip(
            itertools.pairwise(kinds), itertools.pairwise(clock), strict=True
        )
        if pair == ("PAUSE", "START")
    ]
    if pauses:
        raise InputError(
            path,
            f"was paused {len(pauses)} times, for up to {max(pauses):.1f} s, "
            "and the stamps do not show where",
            "record without a pause",
        )


# --- both


def _recording(
    path: Path, app: str, files: list[_File], sets: list[_Set], sign: str | None
) -> Recording:
    """The gyro, and the accelerometer with gravity: from a set of its own, or as the sum of the set
    without gravity and that of gravity."""
    kinds = {kind: [each for each in sets if each.kind == kind] for kind in _KINDS}
    for sensor, needed in (("gyro", ("gyro",)), ("accelerometer", ("accel", "linear", "raw"))):
        if not any(kinds[kind] for kind in needed):
            raise InputError(path, f"has no {sensor} (found: {_names(files)})", _REMEDY)
    (gyro,) = _only("gyro", kinds, path)
    if kinds["accel"]:
        parts = _only("accel", kinds, path)
    elif kinds["linear"] and kinds["gravity"]:
        parts = _only("linear", kinds, path) + _only("gravity", kinds, path)
    elif kinds["raw"]:
        parts = kinds["raw"]
    else:
        found = kinds["linear"][0].file.name
        raise InputError(path, f"holds acceleration without gravity ({found})", _REMEDY)
    accel = parts[0].sensor("accel")
    if len(parts) > 1:
        accel = _added(accel, parts[1].sensor("accel"))
    clock, unit = "ns" if gyro.time == "time" else "s", parts[0].unit
    of_accel = " + ".join(part.file.name for part in parts) + (f" in {unit}" if unit else "")
    note = f"{path.name}: {app}; time in {clock}, {gyro.file.name} in {gyro.unit}, {of_accel}"
    known = Units(clock, gyro.unit, unit, sign)
    raw = gyro.file.place.stem == "GyroscopeUncalibrated"
    return Recording(path, gyro.sensor("gyro"), accel, known, notes=(note,), raw_gyro=raw)


def _only(kind: str, kinds: dict[str, list[_Set]], path: Path) -> list[_Set]:
    """The only set of a kind. Raises `InputError` if there are several."""
    sets = kinds[kind]
    if len(sets) > 1:
        names = ", ".join(f"{one.file.name} ({one.axes[0]})" for one in sets)
        in_tables = "leave the table of one of them in it, or export that one alone"
        one_table = path.name == sets[0].file.name
        remedy = "name the columns of one by --columns" if one_table else in_tables
        raise InputError(path, f"holds {len(sets)} sets of a sensor: {names}", remedy)
    return sets


def _added(motion: Sensor, gravity: Sensor) -> Sensor:
    """The accelerometer's reading on the stamps of `motion`: the sum of the acceleration without
    gravity and of gravity, which turns slowly and is interpolated linearly (ours)."""
    seen = np.isfinite(gravity.values).all(axis=1) & np.isfinite(gravity.stamps)
    if seen.sum() < 2:
        raise InputError(gravity.file, f"holds {seen.sum()} samples", "record for longer")
    first = np.nanmin(motion.stamps)  # unix time in ns has more digits than a float
    time, stamps = ((each - first).astype(np.float64) for each in (motion.stamps, gravity.stamps))
    order = np.flatnonzero(seen)[np.argsort(stamps[seen], kind="stable")]
    inside = (time >= stamps[order[0]]) & (time <= stamps[order[-1]])
    down = interpolate(time[inside], stamps[order], gravity.values[order])
    both = motion.where(inside)
    return both._replace(values=both.values + down)
