"""phyphox (RWTH Aachen; Android and iOS): a zip of CSV files, one CSV, or a workbook (xls, xlsx).

Facts, from the app's sources (github.com/phyphox):

- A table for each set of an experiment's export: `Accelerometer`, `Gyroscope`, `Linear
  Acceleration`, ..., of a single sensor `Raw Data` (phyphox-android, SimpleExperimentCreator.java,
  accelerometer.phyphox). A zip has `meta/` beside them, a workbook the sheets `Metadata ...`
  (DataExport.java).
- Columns `Time (s)`, `Acceleration x (m/s^2)`, `Linear Acceleration x (m/s^2)`, `Gyroscope x
  (rad/s)`. Earlier releases wrote `X (m/s^2)` and `X (rad/s)` (seen in exports). The app translates
  names, so that the units and the axes tell here, and of the names only Linear and Gravity.
- Separators are comma, semicolon or tab, the decimal is a point or a comma; short columns are
  filled with NaN (DataExport.java).
- All sensors share one clock, s since the start. It stands while the experiment is paused
  (ExperimentTimeReference.java); `meta/time.csv`, or the sheet `Metadata Time`, has the times of
  START and PAUSE by the phone's clock too.
- "Acceleration" includes gravity, "Linear Acceleration" does not. iOS's readings are multiplied by
  −9.81, so that both systems have Android's sign (phyphox-ios, ExperimentSensorInput.swift: kG).
"""

from __future__ import annotations

import io
import itertools
import re
import warnings
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from gnio_jax.apps.importing import archives
from gnio_jax.apps.importing.recording import (
    Recording,
    Sensor,
    Units,
    added,
    read_table,
    sensor_of,
)
from gnio_jax.data.parsing.tables import Table, parsed_as
from gnio_jax.data.parsing.units import named_unit
from gnio_jax.errors import InputError, require_packages

EVENTS = "meta/time.csv"
"""When the experiment was started and paused."""
_AXIS = re.compile(r"\b([xyz])\b", re.IGNORECASE)


class _Set(NamedTuple):
    """One sensor's columns of a table."""

    kind: str
    """gyro, accel, linear (without gravity) or gravity."""
    unit: str
    table: Table
    time: str
    axes: tuple[str, ...]

    def sensor(self, name: str) -> Sensor:
        return sensor_of(name, self.table, self.time, self.axes)


def is_phyphox(tables: Iterable[Sequence[str]]) -> bool:
    """By the columns of the tables of a zip, folder or file."""
    return any(_is_time(label) for labels in tables for label in labels) and any(
        _sets(labels) for labels in tables
    )


def read_phyphox(path: Path) -> Recording:
    """A recording of its zip, folder, CSV or workbook. Raises `InputError` where a sensor is
    missing or there is only acceleration without gravity."""
    tables = _tables(path)
    found = [one for table in tables for one in _columns(table)]
    if not (gyros := [one for one in found if one.kind == "gyro"]):
        raise _missing("gyro", path, tables)
    gyro, (accel, unit) = _only(gyros, path), _accelerometer(found, path, tables)
    names = f"{gyro.table.path.name} in {gyro.unit}, {accel.file.name} in {unit}"
    return Recording(
        path,
        gyro.sensor("gyro"),
        accel,
        Units("s", gyro.unit, unit, "android"),
        notes=(f"{path.name}: phyphox; time in s, {names}, by their headers",),
    )


# --- tables


def _tables(path: Path) -> list[Table]:
    if path.is_dir():
        return _of_archive(path)
    with path.open("rb") as file:
        magic = file.read(4)
    if magic.startswith(b"\xd0\xcf\x11\xe0"):
        return _of_workbook(path, "xlrd")
    if magic.startswith(b"PK"):
        with parsed_as(path, "a zip"), zipfile.ZipFile(path) as archive:
            members = archive.infolist()
        if any(member.filename == "xl/workbook.xml" for member in members):
            archives.check_members(path, [member.filename for member in members])
            archives.check_announced(sum(member.file_size for member in members), path)
            return _of_workbook(path, "openpyxl")
        return _of_archive(path)
    return [read_table(path, ())]


def _of_archive(path: Path) -> list[Table]:
    _check_pauses(_events(path), path)
    tables = []
    for names in archives.csv_names(path).values():
        for name in names:
            if _sets(archives.labels(path, name)):
                content = archives.content(path, name)
                tables.append(read_table(path / name, (), content))
    return tables


def _of_workbook(path: Path, engine: str) -> list[Table]:
    require_packages(path, "excel", engine)
    with parsed_as(path, "a workbook"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of styles
        options: dict[str, Any] = {"engine": engine}
        if engine == "xlrd":  # it writes what it thinks of a damaged file to the standard output
            options["engine_kwargs"] = {"logfile": io.StringIO()}
        sheets: dict[Any, pd.DataFrame] = pd.read_excel(path, sheet_name=None, **options)
    for values in sheets.values():
        _check_pauses(values, path)
    return [
        Table(path / str(name), values)
        for name, values in sheets.items()
        if _sets([str(label) for label in values.columns])
    ]


def _events(path: Path) -> pd.DataFrame:
    """The table of starts and pauses of a zip or folder; empty where there is none, or no row."""
    named = [name for names in archives.csv_names(path).values() for name in names]
    if path.is_dir() and (path / EVENTS).is_file():
        named.append(EVENTS)
    for name in named:
        if name == EVENTS or name.endswith(f"/{EVENTS}"):
            try:
                return read_table(path / name, (), archives.content(path, name)).columns
            except InputError:
                return pd.DataFrame()
    return pd.DataFrame()


def _check_pauses(events: pd.DataFrame, path: Path) -> None:
    """Raise `InputError` where a table of events tells of a pause: the clock stood, so that nothing
    in the samples tells that some are missing."""
    if not {"event", "system time"} <= set(events.columns):
        return
    kinds = [str(kind).strip().upper() for kind in events["event"]]
    clock = np.asarray(pd.to_numeric(events["system time"], errors="coerce"), np.float64).tolist()
    pauses = [
        after - before
        for (kind, following), (before, after) in zip(
            itertools.pairwise(kinds), itertools.pairwise(clock), strict=True
        )
        if (kind, following) == ("PAUSE", "START")
    ]
    if pauses:
        raise InputError(
            path,
            f"was paused {len(pauses)} times, for up to {max(pauses):.1f} s, "
            "and the stamps do not show where",
            "record without a pause",
        )


# --- columns


def _is_time(label: str) -> bool:
    return named_unit(label) == "s"


def _sets(labels: Sequence[str]) -> list[tuple[str, str, tuple[str, ...]]]:
    """(kind, unit, columns x, y, z) of each sensor in a table."""
    found: dict[tuple[str, str], dict[str, str]] = {}
    for label in labels:
        unit, axis = named_unit(label), _AXIS.search(label)
        if unit in ("rad/s", "deg/s", "m/s2", "g") and axis:
            name = label[: axis.start()].strip().lower()
            found.setdefault((name, unit), {}).setdefault(axis[1].lower(), label)
    return [
        (_kind(name, unit), unit, tuple(axes[axis] for axis in "xyz"))
        for (name, unit), axes in found.items()
        if len(axes) == 3
    ]


def _kind(name: str, unit: str) -> str:
    if unit in ("rad/s", "deg/s"):
        return "gyro"
    return next((kind for kind in ("linear", "gravity") if name.startswith(kind)), "accel")


def _columns(table: Table) -> list[_Set]:
    labels = [str(label) for label in table.columns]
    time = next((label for label in labels if _is_time(label)), None)
    if time is None:
        raise InputError(table.path, "has no column of time in s", "export it again")
    # Earlier releases name the sensor by the file alone.
    own = _kind(PurePosixPath(table.path.name).stem.lower(), "m/s2")
    return [
        _Set(own if kind == "accel" else kind, unit, table, time, axes)
        for kind, unit, axes in _sets(labels)
    ]


def _only(sets: list[_Set], path: Path) -> _Set:
    if len(sets) > 1:
        names = ", ".join(f"{one.table.path.name} ({one.axes[0]})" for one in sets)
        table = sets[0].table.path
        in_tables = "leave the table of one of them in it, or export that one alone"
        raise InputError(
            path,
            f"holds {len(sets)} sets of a sensor: {names}",
            "name the columns of one by --columns" if table == path else in_tables,
        )
    return sets[0]


def _accelerometer(found: list[_Set], path: Path, tables: list[Table]) -> tuple[Sensor, str]:
    """The set with gravity in it, or the sum of the two without; and its unit."""
    by_kind = {
        kind: [one for one in found if one.kind == kind] for kind in ("accel", "linear", "gravity")
    }
    if by_kind["accel"]:
        one = _only(by_kind["accel"], path)
        return one.sensor("accel"), one.unit
    if by_kind["linear"] and by_kind["gravity"]:
        linear, gravity = (_only(by_kind[kind], path) for kind in ("linear", "gravity"))
        return added(linear.sensor("accel"), gravity.sensor("gravity")), linear.unit
    if by_kind["linear"]:
        raise InputError(
            by_kind["linear"][0].table.path,
            "holds acceleration without gravity",
            "add the accelerometer with g to the experiment and record again",
        )
    raise _missing("accelerometer", path, tables)


def _missing(sensor: str, path: Path, tables: list[Table]) -> InputError:
    names = ", ".join(table.path.name for table in tables) or "no table of a sensor"
    return InputError(
        path,
        f"has no {sensor} (found: {names})",
        "record accelerometer (with g) and gyroscope in one experiment",
    )
