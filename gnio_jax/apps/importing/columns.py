"""A table of any logger or board: which columns are the time, the gyro and the accelerometer, and
which unit their names state.

Known names are those of Arduino and ESP32 sketches, rostopic, bagpy, EuRoC, AndroSensor, Physics
Toolbox, SensorLog, GetSensorData, GnssLogger, MARS logger, RoNIN's recorder, Shimmer, Xsens and
ArduPilot, as seen in their files; only what fits once is taken.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from fractions import Fraction
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, Num

from gnio_jax.apps.importing import units
from gnio_jax.apps.importing.clocks import Sensor
from gnio_jax.apps.importing.files import LogFile, files_of, listed, log_file
from gnio_jax.apps.importing.recording import RawRecording, Track
from gnio_jax.config import ImportOptions
from gnio_jax.data.parsing import stamps as clocks
from gnio_jax.data.parsing.tables import Table, shortened
from gnio_jax.data.parsing.text import FIRST_LINES, cells_of, open_text, rows_of, without_mark
from gnio_jax.data.readers.csv_files import ACCEL, GYRO, REFERENCE, check_columns, reference
from gnio_jax.data.reference import SHORTEST_RUN
from gnio_jax.errors import InputError

AXES = {"gyro": GYRO, "accel": ACCEL}
POSES = tuple(chain.from_iterable(REFERENCE.values()))
NAMES = ("time", "accel_time", *GYRO, *ACCEL, *POSES)
"""Our names, which a user may give to columns."""
FIRST_ROWS, MOST_IMUS = 1000, 8
"""Rows in which sensors that take turns are searched, and their largest number (ours)."""
_AXIS = r"_?{axis}(_?(axis|cal|value|uncal|data))?"
_ALIASES = {
    "gyro": (
        r"(gyro|gyr|gyroscope)_?{axis}",
        r"(.*_)?(gyro|gyr|gyroscope)(_.*)?" + _AXIS,
        r"(w|g|omega|rot|w_rs_s)_?{axis}",
        r"(.*_)?(angular_velocity|angular_rate|ang_?vel|rotation_?rate)" + _AXIS,
        r"{axis}_?(gyro|gyr|gyroscope)",
    ),
    "accel": (
        r"(accel|acc|acce|accelerometer|acceleration)_?{axis}",
        r"(.*_)?accelerometer(_.*)?" + _AXIS,
        r"(g_?f(orce)?|a_rs_s|specific_force|total_acceleration)_?{axis}",
        r"[af]_?{axis}",
        r"(.*_)?linear_acceleration_{axis}",  # with gravity, as ROS means it
        r"(?!.*(user|linear|gravity|bias|offset))(.*_)?(accel|acc|acce|acceleration)(_.*)?" + _AXIS,
        r"{axis}_?(accel|acc|accelerometer)",
    ),
}
"""Names of the columns of a sensor, as `plain_name` writes them, the surest first."""
_ALONE = r"(measurement|value|raw|data)?" + _AXIS
"""Names of the axes in a table of one sensor."""
_SECOND = r"(s|sec|secs|seconds|ms|msec|millis|us|usec|micros|ns|nsec|nanos|unix)"
_TIMES = (
    r"(field_)?header_stamp",
    r"sensor_?time(_?stamp)?|elapsed_realtime_nanos|sample_time_fine",
    r"time|time_?stamp|stamp|t",
    r"(unix|epoch|utc|sys|system|host|device|log|logging|local)?_?(time|time_?stamp|stamp|t|epoch)"
    rf"(_?{_SECOND}|_txt)?",
    r"seconds_elapsed|elapsed(_time)?(_?s|_?ms)?|millis|micros|nanos|date_?time|ms|us|epoc",
    r"(?!.*(gps|frame|zone)).*time.*",
)
_TAGS = {"gyro": r".*(gyr|rotation_?rate)", "accel": r"(?!.*(lin|user|gravity)).*acc(?!u)"}
"""Names of files, or tags of rows, of one sensor."""
_ANDROID = {"1": "accelerometer", "4": "gyroscope"}
"""Types of sensors in a column of that name (developer.android.com, Sensor)."""
_TICKS = {"sample_time_fine": "1e-4"}
"""Units of clocks that are known by their name."""


def plain_name(label: str) -> str:
    """The name of a column without unit, in small letters, with words joined by _."""
    name = units.without_unit(label)
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def sensor_named(name: str) -> str | None:
    """gyro or accel, if the name of a file or a tag of rows means one of them."""
    sensors = [sensor for sensor, pattern in _TAGS.items() if re.match(pattern, plain_name(name))]
    return sensors[0] if len(sensors) == 1 else None


def resolved(labels: Iterable[str], alone: str | None = None) -> dict[str, str]:
    """Our name → label of the columns whose names are known. `alone` is the sensor of a table of
    one."""
    plain = {str(label): plain_name(str(label)) for label in labels}

    def fitting(pattern: str) -> list[str]:
        return [label for label, name in plain.items() if re.fullmatch(pattern, name)]

    names: dict[str, str] = {name: name for name in NAMES if name in plain}
    for sensor, axes in AXES.items():
        patterns = (*_ALIASES[sensor], _ALONE) if alone == sensor else _ALIASES[sensor]
        for pattern in () if alone not in (None, sensor) or set(axes) <= set(names) else patterns:
            columns = [fitting(pattern.format(axis=axis)) for axis in "xyz"]
            if all(len(column) == 1 for column in columns):
                names |= {axis: column[0] for axis, column in zip(axes, columns, strict=True)}
            if any(columns):
                break
    if "time" not in names or fitting(_TIMES[0]):
        pairs = [
            f"{label}+{fraction}"
            for label in fitting(r"(.*_)?secs?")
            for fraction in fitting(r"(.*_)?(nsecs?|nanosecs?|nanoseconds|usecs?)")
            if plain[label].rpartition("_")[0] == plain[fraction].rpartition("_")[0]
        ]
        stamps = next((columns for columns in map(fitting, _TIMES) if columns), [])
        stamps = pairs if pairs and not fitting(_TIMES[0]) else stamps
        names |= {"time": stamps[0]} if len(stamps) == 1 else {}
    return names


def named_by(words: Iterable[str]) -> dict[str, str]:
    """Our name → the file's, of words OURS=THEIRS. Raises `InputError`."""
    names: dict[str, str] = {}
    for word in words:
        name, _, column = word.partition("=")
        if not column:
            raise InputError("columns", f"'{word}' names no column", "write gyro_x=NAME")
        if name not in NAMES:
            problem = f"unknown name '{name}'"
            raise InputError("columns", problem, f"known names: {', '.join(NAMES)}")
        names[name] = column
    return names


# --- tables


class _Opened(NamedTuple):
    """A table of a log with what its header and preamble state."""

    table: Table
    frame: pd.DataFrame
    """Its columns; times of day are stamps."""
    texts: dict[str, str | None]
    """Column → text of its unit."""
    scales: dict[str, str]
    """Units that the preamble states, of time, gyro and accel."""

    def numbers(self, column: str) -> Float[np.ndarray, " n"]:
        """A column, or the sum "a+b" or the opposite "-a" of some."""
        parts = [column] if column in self.frame else [part.strip() for part in column.split("+")]
        columns = [part if part in self.frame else part.removeprefix("-") for part in parts]
        values = [self.table.take(name, gaps=True) for name in columns]
        signs = [1 if part == name else -1 for part, name in zip(parts, columns, strict=True)]
        return np.dot(signs, values)

    def stamps(self, column: str) -> tuple[Num[np.ndarray, " n"], str | None]:
        """The stamps of the rows, and the unit that their name or header states. Two columns are
        one stamp: s + ns, or date + time."""
        kinds = {label: self.frame[label].dtype.kind for label in self.frame}
        whole, _, part = column.partition("+")
        if column not in kinds and kinds.get(part) == "M":
            dates = pd.to_datetime(self.frame[whole], format="mixed", errors="coerce")
            days = (dates - pd.Timestamp(0)).dt.days.to_numpy()
            of_day = self.frame[part].astype(np.int64).to_numpy() % clocks.DAY
            return of_day + days * clocks.DAY, "ns"
        unit = units.unit_of(plain_name(part).rpartition("_")[2])
        if column not in kinds and unit in clocks.PER_SECOND and kinds.get(part) in ("i", "u"):
            stamps = self.table.stamps(whole).astype(np.int64) * int(clocks.PER_SECOND[unit])
            return stamps + self.table.stamps(part), unit
        kind = kinds.get(column, "f")
        if kind == "M":
            return self.frame[column].astype(np.int64).to_numpy(), "ns"
        # Columns that are shorter than others end with NaN, which is no sample.
        stamps = self.table.stamps(column) if kind in "iu" else self.numbers(column)
        unit = self.scales.get("time") or units.unit_of(self.texts.get(column))
        name = plain_name(column)
        match = re.fullmatch(rf"(?:.*_)?{_SECOND}", name)  # a name such as timestamp_ms
        if unit is None and (unit := _TICKS.get(name, units.unit_of(match and match[1]))):
            step = clocks.usual_step(stamps[np.isfinite(stamps)])
            unit = unit if clocks.is_rate(1 / (step * float(clocks.seconds_of(unit)))) else None
        return stamps, unit


def _opened(file: LogFile, names: dict[str, str], where: str | None, notes: list[str]) -> _Opened:
    """A table, of which `where` "COLUMN=VALUE" may take some rows. Columns have their places as
    names if `names` has nothing but places."""
    (table, remarks), layout = file.read(), file.layout
    frame, rows = pd.DataFrame(table.columns), table.rows
    parts = [part.strip(" -") for name in names.values() for part in name.split("+")]
    is_numbered = parts and all(map(str.isdigit, parts))
    labels = range(frame.shape[1]) if is_numbered else frame.columns
    frame = frame.set_axis(map(str, labels), axis=1)
    repeated = frame.columns.duplicated()
    if repeated.any() and len(frame.T.drop_duplicates()) == (~repeated).sum():
        frame = frame.loc[:, ~repeated]  # a column that is written twice
    if where:
        label, _, value = where.partition("=")
        texts = frame[label].astype(str) if label in frame else frame.columns
        chosen = np.flatnonzero(texts.isin([value, f"{value}.0"])) if label in frame else []
        if not len(chosen):
            values = shortened(", ".join(texts.unique()[:20]), 200)
            raise InputError(file.path, f"has no row with {where}", f"there are: {values}")
        frame = frame.iloc[chosen].reset_index(drop=True)
        rows = chosen if rows is None else rows[chosen]
    subheaders = (dict(zip(layout.labels, cells, strict=True)) for cells in layout.subheaders)
    below = next((texts for texts in subheaders if units.are_units(texts.values())), {})
    texts = {label: below.get(label) or units.unit_text(label) for label in frame.columns}
    scales = {}
    if layout.preamble and layout.preamble[0].startswith("GYROFLOW"):
        # docs.gyroflow.xyz/app/technical-details/gcsv-format: scales to s, rad/s and g
        lines = (cells_of(line, layout.separator) for line in layout.preamble)
        stated = {cells[0]: cells[1] for cells in lines if len(cells) > 1}
        scales = {"time": stated.get("tscale", "1e-3")}
        scales |= {"gyro": f"{stated.get('gscale', '1')}*rad/s"}
        scales |= {"accel": f"{stated.get('ascale', '1')}*g"}
        remarks = [f"{file.path.name}: gcsv with the units {', '.join(scales.values())}"]
    notes += remarks
    numbers = frame.drop(columns=[label for label in frame if frame[label].dtype.kind == "M"])
    return _Opened(table._replace(columns=numbers, rows=rows), frame, texts, scales)


def rows_by_sensor(file: LogFile) -> list[LogFile]:
    """A table for each sensor, of a log in which a word in one column says to which sensor a row
    belongs; none if it is no such log. A comment that begins with the word is the header of its
    rows."""
    layout, content = file.layout, file.content()
    head = [cells for _, cells in islice(rows_of(file.path, layout, content), FIRST_LINES)]
    for place in range(layout.width):
        label = layout.labels[place] if layout.labels else ""
        tags = _ANDROID if re.fullmatch("sensor(_?(type|id))?|type", plain_name(label)) else {}
        words = {cells[place] for cells in head if len(cells) > place}
        if set(AXES) <= {sensor_named(tags.get(word, word)) for word in words}:
            break
    else:
        return []
    is_shared = layout.labels and sensor_named(label) is None
    header = [layout.separator.join(layout.labels)] if is_shared else []
    groups: dict[str, list[str]] = {}
    with open_text(file.path, content) as text:
        for line in islice(text, layout.before):
            cells = cells_of(without_mark(line), layout.separator)
            if len(cells) > place and sensor_named(cells[place]):
                groups[cells[place]] = [layout.separator.join(cells)]
    for _, cells in rows_of(file.path, layout, content):
        tag = tags.get(cells[place], cells[place]) if len(cells) > place else ""
        if sensor_named(tag):
            groups.setdefault(tag, [*header]).append(layout.separator.join(cells))
    texts = {tag: "\n".join(rows).encode() for tag, rows in groups.items()}
    return [log_file(tag, file.path / tag, partial(bytes, text)) for tag, text in texts.items()]


# --- the recording


def read_columns(path: Path, files: list[LogFile], options: ImportOptions) -> RawRecording:
    """The recording in the only table, in the only one with both sensors, or in one of each sensor.
    Raises `InputError` naming what is missing, with the words that name it."""
    names = named_by(options.columns)
    if len(files) == 1 and not (names or options.accel_path or options.where):
        files = rows_by_sensor(files[0]) or files
    whole = [file for file in files if {*GYRO, *ACCEL} <= set(resolved(file.layout.labels))]
    if options.accel_path is not None:
        groups = {("gyro",): files, ("accel",): files_of(options.accel_path)}
    elif len(files) == 1 or len(whole) == 1:
        groups = {("gyro", "accel"): whole or files}
    else:
        groups = {(sensor,): _tables_of(sensor, files) for sensor in AXES}
    if any(len(tables) != 1 for tables in groups.values()):
        problem = f"has the layout of no known recording (found: {listed(files)})"
        remedy = "known: CSV, Sensor Logger, phyphox, ROS bags, MCAP and EuRoC folders"
        raise InputError(path, problem, f"{remedy}; a CSV of other columns needs --columns")
    notes: list[str] = []
    sensors: dict[str, Sensor] = {}
    track = None
    for group, (file,) in groups.items():
        opened = _opened(file, names, options.where, notes)
        columns = _columns(opened, group, names, options.sample_rate is not None, notes)
        for sensor in group:
            sensors[sensor] = _sensor(sensor, opened, columns, options, notes)
        if "gyro" in group:
            try:
                track = _reference(opened.table, names, sensors["gyro"], options.time_unit)
            except InputError as error:
                notes.append(f"no reference is taken: {error}")
    return RawRecording(path, sensors["gyro"], sensors["accel"], notes, [], "android", True, track)


def _tables_of(sensor: str, files: list[LogFile]) -> list[LogFile]:
    """The tables of a sensor by their names; without the uncalibrated ones if there are others."""
    tables = [file for file in files if sensor_named(file.place.name) == sensor]
    return [file for file in tables if "uncal" not in file.name.lower()] or tables


def _sensor(
    sensor: str, opened: _Opened, columns: dict[str, str], options: ImportOptions, notes: list[str]
) -> Sensor:
    """The samples of a sensor in these columns, with the units that the table states."""
    path, axes = opened.table.path, [columns[axis] for axis in AXES[sensor]]
    known = units.GYRO_UNITS if sensor == "gyro" else units.ACCEL_UNITS
    unit = opened.scales.get(sensor)
    if not (unit or (options.gyro_unit if sensor == "gyro" else options.accel_unit)):
        if unit := units.common_unit({axis: opened.texts.get(axis) for axis in axes}, known, path):
            notes.append(f"{path.name}: {sensor} in {unit}, by its header")
    values = np.stack([opened.numbers(axis) for axis in axes], axis=1)
    clock = columns.get("accel_time" if sensor == "accel" else "time", columns.get("time"))
    if clock is None or options.sample_rate is not None:
        stamps, second = np.arange(len(values)), str(1 / Fraction(str(options.sample_rate)))
    else:
        stamps, second = opened.stamps(clock)
    return Sensor(sensor, path, stamps, values, opened.table.row, second, unit)


def _columns(
    opened: _Opened,
    sensors: tuple[str, ...],
    names: dict[str, str],
    has_rate: bool,
    notes: list[str],
) -> dict[str, str]:
    """Our name → the file's of the time and the axes of some sensors. Raises `InputError`."""
    labels, path = list(opened.frame.columns), opened.table.path
    alone = sensors[0] if len(sensors) == 1 else None
    times = ["accel_time"] * ("accel" in sensors and "accel_time" in names)
    times += ["time"] * ("gyro" in sensors or not times)
    needed = [*([] if has_rate else times), *(axis for sensor in sensors for axis in AXES[sensor])]
    is_numbered = labels == [str(place) for place in range(len(labels))]
    guesses = _by_place(opened.frame, alone) if is_numbered else resolved(labels, alone)
    dated = [label for label in labels if opened.frame[label].dtype.kind == "M"]
    labels_of = ({"time": dated[0]} if len(dated) == 1 else {}) | guesses | names
    columns = {name: labels_of.get(name, name) for name in needed}
    _check_one_imu(opened.frame, columns, path)
    of_track = {name: column for name, column in names.items() if name in POSES}
    single = {n: c for n, c in columns.items() if c in labels or not set("+-") & set(c)} | of_track
    if is_numbered and not names and not set(columns.values()) <= set(labels):
        order = ("time", *GYRO, *ACCEL)[len(labels) < 7 :]
        places = " ".join(f"{name}={place}" for place, name in enumerate(order))
        problem = f"has {len(labels)} columns of numbers and no header"
        remedy = f"count its columns from 0, as in --columns {places}"
        raise InputError(path, problem, remedy + " --sample-rate HZ" * (len(labels) < 7))
    remedy = "name them: --columns"
    if any(single.get(clock, labels[0]) not in labels for clock in times):
        remedy = f"if it has no column of time, give --sample-rate HZ; {remedy}"
    check_columns(path, labels, single, remedy)
    if words := [f"{n}={c}" for n, c in columns.items() if c != names.get(n, n)]:
        notes.append(f"{path.name}: columns taken by their names: {' '.join(words)}")
    return columns


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
    clock = frame.get(columns.get("time", ""), pd.Series(0, frame.index))
    back = (clock < clock.shift()).to_numpy()
    for label in frame.columns.difference(list(columns.values())):
        values = frame[label] if back.any() else frame[label].iloc[:FIRST_ROWS]
        changes = (values != values.shift()).to_numpy()[1:] & values.notna().all()
        in_turn = changes[:FIRST_ROWS].mean() > 0.5 and len(values) > 10 * MOST_IMUS
        if in_turn or (back.any() and changes[back[1:]].all() and changes.any()):
            if 2 <= values.nunique() <= MOST_IMUS:
                words = ", ".join(map(str, values.unique()))
                problem = f"has rows of several sensors: column '{label}' holds {words} in turn"
                raise InputError(path, problem, f"choose one: --where {label}={values.iloc[0]}")


def _reference(table: Table, names: dict[str, str], gyro: Sensor, unit: str | None) -> Track | None:
    """The reference in the package's own columns, on the gyro's stamps."""
    ours = {label: name for name, label in names.items()}
    table = table.renamed(ours.get(label, label) for label in map(str, table.columns))
    if not {*POSES} & set(table.columns) or not np.isfinite(gyro.stamps).all():
        return None  # without stamps the gyro is refused
    first = gyro.stamps.min().item()
    unit = unit or gyro.second or clocks.time_unit(gyro.stamps - first)[0]
    poses = reference(table, clocks.seconds(gyro.stamps, first, unit)) if unit else None
    if unit is None or poses is None:
        remedy = f"a reference has {', '.join((*REFERENCE['orientation'], *REFERENCE['position']))}"
        raise InputError(table.path, "has no orientation, or no position", remedy)
    if len(poses.time) < SHORTEST_RUN:
        problem = f"holds {len(poses.time)} poses"
        raise InputError(table.path, problem, f"{SHORTEST_RUN} are the fewest")
    return Track("given", poses, Fraction(first) * clocks.seconds_of(unit))
