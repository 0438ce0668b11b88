"""A table of any logger or board: which columns are the time, the gyro and the accelerometer, and
which unit their names state."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable
from fractions import Fraction
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, Num

from gnio_jax.apps.importing import units
from gnio_jax.apps.importing.clocks import Sensor
from gnio_jax.apps.importing.files import LogFile, files_of, log_file, spell_names
from gnio_jax.apps.importing.readings import (
    ACCURACY,
    RawReadings,
    columns_of,
    leaving_out,
    readings_of,
)
from gnio_jax.apps.importing.recording import RawRecording, Track
from gnio_jax.config import ImportOptions
from gnio_jax.data import labels
from gnio_jax.data.labels import ACCEL, AXES, GYRO, NAMES, POSES, REFERENCE
from gnio_jax.data.parsing import stamps as parsing
from gnio_jax.data.parsing.tables import Table, shorten
from gnio_jax.data.parsing.text import FIRST_LINES, cells_of, rows_of, without_mark
from gnio_jax.data.readers.csv_files import check_columns, reference
from gnio_jax.data.reference import SHORTEST_RUN
from gnio_jax.data.sensors import BAROMETER, GNSS, MAGNETOMETER
from gnio_jax.errors import InputError

FIRST_ROWS, MOST_IMUS = 1000, 8
"""Rows in which sensors that take turns are searched, and their largest number (ours)."""
_ANDROID = {"1": "accelerometer", "2": "magnetometer", "4": "gyroscope", "6": "pressure"}
"""Types of sensors in a column of that name (developer.android.com, Sensor)."""
_OTHER_TAGS = {
    MAGNETOMETER: r"(.*_)?magn?(et.*)?(_.*)?",
    BAROMETER: r"(.*_)?(pres|pressure|baro|barometer)(_.*)?",
    GNSS: r"(.*_)?(gnss|gps|location)(_.*)?",
}
"""Tags of rows, and names of files, of a sensor beside the IMU, as `labels.plain_name` writes
them."""
_PLAIN_HEADERS = {
    MAGNETOMETER: ("mag_x", "mag_y", "mag_z"),
    BAROMETER: ("pressure",),
    GNSS: ("latitude", "longitude"),
}
"""Known names of its columns, for messages."""


def named_by(words: Iterable[str]) -> dict[str, str]:
    """Our name → the file's, of words OURS=THEIRS. Raises `InputError`."""
    names = {word.partition("=")[0]: word.partition("=")[2] for word in words}
    for name, column in names.items():
        if name not in NAMES:
            remedy = f"known names: {', '.join(NAMES)}"
            raise InputError("columns", f"unknown name '{name}'", remedy)
        if not column:
            raise InputError("columns", f"'{name}=' names no column", "write gyro_x=NAME")
    return names


# --- tables


class _Log(NamedTuple):
    """A table with the units that its header and preamble state. Times of day are datetime64."""

    table: Table
    texts: dict[str, str | None]
    """Column → text of its unit."""
    scales: dict[str, str]
    """Units that the preamble states, of time, gyro and accel."""

    def numbers(self, column: str) -> Float[np.ndarray, " n"]:
        """A column, or the sum "a+b" or the opposite "-a" of some."""
        columns = self.table.columns
        parts = [column] if column in columns else [part.strip() for part in column.split("+")]
        names = [part if part in columns else part.removeprefix("-") for part in parts]
        signs = [1 if part == name else -1 for part, name in zip(parts, names, strict=True)]
        return np.dot(signs, [self.table.take(name, gaps=True) for name in names])

    def stamps(self, column: str, notes: list[str]) -> tuple[Num[np.ndarray, " n"], str | None]:
        """The stamps of the rows, and the unit that their name or header states. Two columns are
        one stamp: s + ns, or date + time. Raises `InputError` for a column without dates."""
        columns = self.table.columns
        kinds = {label: series.dtype.kind for label, series in columns.items()}
        whole, _, part = column.partition("+") if column not in kinds else (column, "", "")
        if "M" in (kinds.get(column), kinds.get(part)):
            stamps = columns[part or column].astype(np.int64).to_numpy()
            if part:
                dates, remark = parsing.parse_dates(columns[whole])
                if dates.isna().any():
                    cell = shorten(columns[whole][dates.isna()].iloc[0])
                    problem = f"column '{whole}' holds '{cell}', no date"
                    raise InputError(self.table.path, problem, "write dates as 2024-05-03")
                remark = f"{self.table.path.name}: {remark}"
                notes += [remark] * (remark not in notes)
                days = (dates - pd.Timestamp(0)).dt.days.to_numpy()
                stamps = stamps % parsing.DAY + days * parsing.DAY
            return stamps, "ns"
        unit = labels.clock_unit(part)
        if unit in parsing.PER_SECOND and kinds.get(part) in ("i", "u"):
            stamps = self.table.stamps(whole).astype(np.int64) * int(parsing.PER_SECOND[unit])
            return stamps + self.table.stamps(part), unit
        # Columns that are shorter than others end with NaN, which is no sample.
        is_whole = kinds.get(column) in ("i", "u")
        stamps = self.table.stamps(column) if is_whole else self.numbers(column)
        unit = self.scales.get("time") or labels.unit_of(self.texts.get(column))
        if unit is None and (unit := labels.clock_unit(column)):
            step = parsing.usual_step(stamps[np.isfinite(stamps)])
            rate = 1 / (step * float(parsing.seconds_of(unit)))
            unit = unit if parsing.is_rate(rate) else None
        return stamps, unit


def _open_log(file: LogFile, names: dict[str, str], where: str | None, notes: list[str]) -> _Log:
    """A table, of which `where` "COLUMN=VALUE" may take some rows. Columns have their places as
    names if `names` has nothing but places."""
    (table, remarks), layout = file.read(), file.layout
    frame, rows = pd.DataFrame(table.columns), table.rows
    parts = [part.strip(" -") for name in names.values() for part in name.split("+")]
    is_numbered = parts and all(map(str.isdigit, parts))
    frame = frame.set_axis(map(str, range(table.width()) if is_numbered else frame), axis=1)
    repeated = frame.columns.duplicated()
    if repeated.any() and len(frame.T.drop_duplicates()) == (~repeated).sum():
        frame = frame.loc[:, ~repeated]  # a column that is written twice
    if where:
        label, _, value = where.partition("=")
        texts = frame[label].astype(str) if label in frame else frame.columns
        chosen = np.flatnonzero(texts.isin([value, f"{value}.0"])) if label in frame else []
        if not len(chosen):
            values = shorten(", ".join(texts.unique()[:20]), 200)
            raise InputError(file.path, f"has no row with {where}", f"there are: {values}")
        frame = frame.iloc[chosen].reset_index(drop=True)
        rows = chosen if rows is None else rows[chosen]
    subheaders = (dict(zip(layout.labels, cells, strict=True)) for cells in layout.subheaders)
    of_units = next((cells for cells in subheaders if labels.are_units(cells.values())), {})
    texts = {label: of_units.get(label) or labels.unit_text(label) for label in frame.columns}
    scales = {}
    if layout.preamble and layout.preamble[0].startswith("GYROFLOW"):
        # docs.gyroflow.xyz/app/technical-details/gcsv-format: scales to s, rad/s and g
        lines = (cells_of(line, layout.separator) for line in layout.preamble)
        sizes = {cells[0]: cells[1] for cells in lines if len(cells) > 1}
        gyro, accel = f"{sizes.get('gscale', '1')}*rad/s", f"{sizes.get('ascale', '1')}*g"
        scales = {"time": sizes.get("tscale", "1e-3"), "gyro": gyro, "accel": accel}
        remarks = [f"{file.path.name}: gcsv with the units {', '.join(scales.values())}"]
    notes += remarks
    return _Log(table._replace(columns=frame, rows=rows), texts, scales)


def rows_by_sensor(file: LogFile) -> list[LogFile]:
    """A table for each sensor, of a log in which a word in one column says to which sensor a row
    belongs; none if it is no such log. A comment that begins with the word is the header of its
    rows."""
    layout, content = file.layout, file.content()
    head = [cells for _, cells in islice(rows_of(file.path, layout, content), FIRST_LINES)]
    for index in range(layout.width):
        name = labels.plain_name(layout.labels[index] if layout.labels else "")
        tags = _ANDROID if re.fullmatch("sensor(_?(type|id))?|type", name) else {}
        words = {cells[index] for cells in head if len(cells) > index}
        if set(AXES) <= {labels.sensor_named(tags.get(word, word)) for word in words}:
            break
    else:
        return []
    is_shared = layout.labels and not (labels.sensor_named(name) or _other_sensor(name))
    header = [layout.separator.join(layout.labels)] if is_shared else []
    groups: dict[str, list[str]] = {}
    comments = (cells_of(without_mark(line), layout.separator) for line in layout.preamble)
    for cells in (layout.labels, *layout.subheaders, *comments):
        tag = cells[index] if len(cells) > index else ""
        if _other_sensor(tag) or (tag in words and labels.sensor_named(tag)):
            groups[tag] = [layout.separator.join(cells)]
    for _, cells in rows_of(file.path, layout, content):
        tag = tags.get(cells[index], cells[index]) if len(cells) > index else ""
        if labels.sensor_named(tag) or _other_sensor(tag):
            groups.setdefault(tag, [*header]).append(layout.separator.join(cells))
    texts = {tag: "\n".join(rows).encode() for tag, rows in groups.items()}
    return [
        log_file(tag, file.path / tag, partial(bytes, text))
        for tag, text in texts.items()
        if labels.sensor_named(tag) or len(groups[tag]) > 1  # a header alone is no sensor
    ]


@functools.cache
def _other_sensor(tag: str) -> str | None:
    """The sensor beside the IMU that a tag of rows means."""
    name = labels.plain_name(tag)
    return next((sensor for sensor, tags in _OTHER_TAGS.items() if re.fullmatch(tags, name)), None)


# --- the recording


def read_columns(path: Path, files: list[LogFile], options: ImportOptions) -> RawRecording:
    """The recording in the only table, in the only one with both sensors, or in one of each sensor.
    Raises `InputError` naming what is missing, with the words that name it."""
    names = named_by(options.columns)
    if len(files) == 1 and not (names or options.accel_path or options.where):
        files = rows_by_sensor(files[0]) or files
    by_sensor = {s: [f for f in files if labels.sensor_named(f.location.name) == s] for s in AXES}
    whole = [file for file in files if _has_both(file, dict.fromkeys(file.layout.labels))]
    if not (whole or all(by_sensor.values())):  # units say less than names
        whole = [file for file in files if _has_both(file)]
    if options.accel_path is not None:
        groups = {("gyro",): files, ("accel",): files_of(options.accel_path)}
    elif len(files) == 1 or len(whole) == 1:
        groups = {("gyro", "accel"): whole or files}
    else:
        groups = {(sensor,): tables for sensor, tables in by_sensor.items()}
        for group, tables in groups.items():  # without the uncalibrated one if there is another
            groups[group] = [f for f in tables if "uncal" not in f.name.lower()] or tables
    if any(len(tables) != 1 for tables in groups.values()):
        problem = f"has the layout of no known recording (found: {spell_names(files)})"
        remedy = "known: CSV, Sensor Logger, phyphox, ROS bags, MCAP and EuRoC folders"
        raise InputError(path, problem, f"{remedy}; a CSV of other columns needs --columns")
    notes, warnings, sensors, track = list[str](), list[str](), dict[str, Sensor](), None
    is_turned = False
    others = dict[str, RawReadings]()
    for group, (file,) in groups.items():
        log = _open_log(file, names, options.where, notes)
        columns = _columns(log, group, names, options, notes)
        for sensor in group:
            axes, unit = [columns[axis] for axis in AXES[sensor]], log.scales.get(sensor)
            if not (unit or (options.gyro_unit if sensor == "gyro" else options.accel_unit)):
                texts = {axis: log.texts.get(axis) for axis in axes}
                if unit := units.common_unit(texts, sensor, file.path):
                    notes.append(f"{file.path.name}: {sensor} in {unit}, by its header")
            values = np.stack([log.numbers(axis) for axis in axes], axis=1)
            clock = columns.get("accel_time" if sensor == "accel" else "time", columns.get("time"))
            if clock is None or options.sample_rate is not None:
                second = str(1 / Fraction(str(options.sample_rate)))
                stamps = np.arange(len(values))
            else:
                stamps, second = log.stamps(clock, notes)
            row = log.table.row
            sensors[sensor] = Sensor(sensor, file.path, stamps, values, row, second, unit)
        for sensor, labeled in columns_of(log.table.columns).items():
            if set(labeled.values()) & set(columns.values()):
                continue
            with leaving_out(sensor, warnings):
                if (label := labeled.get(ACCURACY[0], "")).lower() in ("accuracy", "acc"):
                    if np.isin(log.table.columns[label], range(-1, 4)).all():
                        problem = f"column '{label}' is Android's status of a sensor, not in metres"
                        notes.append(f"{file.path.name}: {problem}")
                        labeled = {n: column for n, column in labeled.items() if n != ACCURACY[0]}
                new = readings_of(sensor, log.table, stamps, labeled, texts=log.texts)
                others.setdefault(sensor, new._replace(table_of=group[0]))
        if "gyro" in group:
            is_turned = bool(set(GYRO) & set(names)) and _are_exchanged([columns[x] for x in GYRO])
            try:
                track = _reference(log.table, names, sensors["gyro"], options.time_unit)
            except InputError as error:
                notes.append(f"no reference is taken: {error}")
    recording = RawRecording(
        path, sensors["gyro"], sensors["accel"], notes, warnings, "android", True
    )
    used = {file.name for tables in groups.values() for file in tables}
    for file in files:
        if file.name not in used:
            others = _others_of(file, notes, warnings) | others
    if is_turned and MAGNETOMETER in others:
        with leaving_out(MAGNETOMETER, warnings):
            problem = "--columns gives the gyro other axes, and no option those of the magnetometer"
            remedy = "exchange the columns of both in the file"
            raise InputError(others.pop(MAGNETOMETER).file, problem, remedy)
    return recording._replace(track=track, others=tuple(others.values()))


def _are_exchanged(columns: list[str]) -> bool:
    """Whether columns that are taken as x, y and z are negated, or have names in another order."""
    places = zip(*map(labels.plain_name, columns), strict=False)
    axes = [letters for letters in places if len(set(letters)) > 1]
    is_in_order = len(axes) != 1 or sorted(axes[0]) == list(axes[0])
    return any(column.startswith("-") for column in columns) or not is_in_order


def _has_both(file: LogFile, units: dict[str, None] | None = None) -> bool:
    """Whether a table has columns of both sensors, by their names or by `units` (None: those of the
    header)."""
    return {*GYRO, *ACCEL} <= set(labels.resolve_labels(file.layout.labels, units=units))


def _others_of(file: LogFile, notes: list[str], warnings: list[str]) -> dict[str, RawReadings]:
    """The sensors beside the IMU in a table of their own; none if it has no stamps. A sensor that
    cannot be read is left out with a warning."""
    columns, tagged = columns_of(file.layout.labels), _other_sensor(file.location.name)
    if tagged and tagged not in columns:
        with leaving_out(tagged, warnings):
            problem = "has no header with known names of its columns"
            names = f"time, {', '.join(_PLAIN_HEADERS[tagged])}"
            remedy = (
                f"write one, as {names}; for rows with tags it is a comment, # {file.name}, ..."
            )
            raise InputError(file.path, problem, remedy)
    time = labels.resolve_labels(file.layout.labels).get("time")
    readings = dict[str, RawReadings]()
    for sensor, names in columns.items():
        with leaving_out(sensor, warnings):
            log = _open_log(file, {}, None, notes)
            stamps, second = log.stamps(time or "time", notes)
            new = readings_of(sensor, log.table, stamps, names, second, texts=log.texts)
            readings[sensor] = new
    return readings


def _columns(
    log: _Log, sensors: tuple[str, ...], names: dict[str, str], options: ImportOptions, notes: list
) -> dict[str, str]:
    """Our name → the file's of the time and the axes of some sensors. Raises `InputError`."""
    frame, path = pd.DataFrame(log.table.columns), log.table.path
    headings, alone = list(frame.columns), sensors[0] if len(sensors) == 1 else None
    times = ["accel_time"] * ("accel" in sensors and "accel_time" in names)
    times += ["time"] * ("gyro" in sensors or not times)
    needed = [] if options.sample_rate is not None else [*times]
    needed += [axis for sensor in sensors for axis in AXES[sensor]]
    is_numbered = headings == [str(index) for index in range(len(headings))]
    dated = [label for label, dtype in frame.dtypes.items() if dtype.kind == "M"]
    if is_numbered:
        guesses = _by_place(frame, alone)
    else:
        clocks = [] if dated else [str(label) for label, column in frame.items() if _rises(column)]
        guesses = labels.resolve_labels(headings, alone, log.texts, clocks)
    names_of = ({"time": dated[0]} if len(dated) == 1 else {}) | guesses | names
    columns = {name: names_of.get(name, name) for name in needed}
    _check_one_imu(frame, columns, path)
    single = {n: c for n, c in columns.items() if c in headings or not set("+-") & set(c)}
    single |= {name: column for name, column in names.items() if name in POSES}
    if is_numbered and not names and not set(columns.values()) <= set(headings):
        order = ("time", *GYRO, *ACCEL)[len(headings) < 7 :]
        places = " ".join(f"{name}={index}" for index, name in enumerate(order))
        problem = f"has {len(headings)} columns of numbers and no header"
        remedy = f"count its columns from 0, as in --columns {places}"
        raise InputError(path, problem, remedy + " --sample-rate HZ" * (len(headings) < 7))
    remedy = "name them: --columns"
    if any(single.get(clock, headings[0]) not in headings for clock in times):
        remedy = f"if it has no column of time, give --sample-rate HZ; {remedy}"
    check_columns(path, headings, single, remedy)
    if words := [f"{n}={c}" for n, c in columns.items() if c != names.get(n, n)]:
        key = "places" if is_numbered else "names"
        notes.append(f"{path.name}: columns taken by their {key}: {' '.join(words)}")
    return columns


def _rises(column: pd.Series) -> bool:
    """Whether the values may be stamps: they increase, which a duration or a latency does not."""
    values = column.dropna()
    rises = values.dtype.kind in "iuf" and values.is_monotonic_increasing
    return bool(rises and len(values) and values.iloc[0] < values.iloc[-1])


def _by_place(frame: pd.DataFrame, sensor: str | None) -> dict[str, str]:
    """The columns of a table of one sensor without a header: stamps that increase, and the first
    three that do not."""
    numbers = {str(column): frame[column] for column in frame if frame[column].dtype.kind in "iufM"}
    stamps = [name for name, column in numbers.items() if column.is_monotonic_increasing]
    axes = [name for name in numbers if name not in stamps][:3]
    stamps = [name for name in stamps if numbers[name].iloc[0] < numbers[name].iloc[-1]]
    if sensor is None or not stamps or len(axes) < 3:
        return {}
    return {"time": stamps[-1], **dict(zip(AXES[sensor], axes, strict=True))}


def _check_one_imu(frame: pd.DataFrame, columns: dict[str, str], path: Path) -> None:
    """Raise `InputError` if the rows of several sensors take turns or follow each other: a column
    of a few values that is not used changes with most rows, or whenever the stamps go back."""
    frame = frame.loc[:, ~frame.columns.duplicated()]
    stamps = frame.get(columns.get("time", ""))
    back = np.zeros(len(frame), bool) if stamps is None else (stamps < stamps.shift()).to_numpy()
    for label in frame.columns.difference(list(columns.values())):
        values = frame[label] if back.any() else frame[label].iloc[:FIRST_ROWS]
        changes = np.asarray(values != values.shift())[1:] & bool(values.notna().all())
        in_turn = bool(changes[:FIRST_ROWS].mean() > 0.5) and len(values) > 10 * MOST_IMUS
        follow = bool(back.any() and changes[back[1:]].all() and changes.any())
        if (in_turn or follow) and 2 <= len(values.unique()) <= MOST_IMUS:
            words = ", ".join(map(str, values.unique()))
            problem = f"has rows of several sensors: column '{label}' holds {words} in turn"
            raise InputError(path, problem, f"choose one: --where {label}={values.iloc[0]}")


def _reference(table: Table, names: dict[str, str], gyro: Sensor, unit: str | None) -> Track | None:
    """The reference in the package's own columns, on the gyro's stamps."""
    ours = {label: name for name, label in names.items()}
    table = table.rename(ours.get(label, label) for label in map(str, table.columns))
    if not {*POSES} & set(table.columns) or not np.isfinite(gyro.stamps).all():
        return None  # without stamps the gyro is refused
    first = gyro.stamps.min().item()
    unit = unit or gyro.second or parsing.time_unit(gyro.stamps - first)[0]
    poses = reference(table, parsing.seconds(gyro.stamps, first, unit)) if unit else None
    if unit is None or poses is None:
        remedy = f"a reference has {', '.join((*REFERENCE['orientation'], *REFERENCE['position']))}"
        raise InputError(table.path, "has no orientation, or no position", remedy)
    if len(poses.time) < SHORTEST_RUN:
        problem = f"holds {len(poses.time)} poses"
        raise InputError(table.path, problem, f"{SHORTEST_RUN} are the fewest")
    return Track("given", poses, Fraction(first) * parsing.seconds_of(unit))
