"""Indoor Location Competition 2.0 (Microsoft Research and XYZ10, 2021): walks through the floors of
malls with a phone held flat before the body. There are no poses, but waypoints that were tapped on
a map.

Layout: `<site>/<floor>/path_data_files/<id>.txt`. Lines that begin with '#' name device, sensors,
start and end; every other is `unix ms, type, values` between tabs: TYPE_ACCELEROMETER (m/s²,
Android's sign), TYPE_GYROSCOPE (rad/s) and TYPE_MAGNETIC_FIELD (µT, without what the system
believes to be the phone's own), each xyz and an accuracy, and TYPE_WAYPOINT, x and y in m of the
floor's map. Other lines are ignored, and a walk may have no field. If a newline is missing, two
lines are joined; they are divided before the second stamp.

Both sensors of the phone share their stamps, whole ms at about 50 Hz, and sequences have 50 Hz.
Walkers are not named; a floor is a `group`.

A sequence has `waypoints` and no poses (`data.waypoints` makes some). Surveyors walk straight from
tap to tap, and a tap is up to a second early or late; the first tap comes 0.1 to 0.4 s before the
first sample. A tap up to a second before the first sample or after the last one is moved to that
sample.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from gnio_jax.data.assembly import Samples, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource, Refusal
from gnio_jax.data.parsing.tables import Table, damage_error, shorten, text_of
from gnio_jax.data.sensors import MAGNETOMETER
from gnio_jax.data.validation import FARTHEST, FEWEST_WAYPOINTS
from gnio_jax.errors import InputError
from gnio_jax.types import Readings, Sequence

RATE = 50.0
"""Hz."""
FLOORS = {"B1": "train", "F1": "train", "F2": "train", "F3": "val", "F4": "test"}
"""Floor -> split. Other floors are only in `all`."""
TAP_SECONDS = 1.0
"""Largest time before or after the IMU's samples at which a tap is accepted, s."""

_GYRO, _ACCEL, _WAYPOINT = "TYPE_GYROSCOPE", "TYPE_ACCELEROMETER", "TYPE_WAYPOINT"
_FIELD = "TYPE_MAGNETIC_FIELD"
_VALUES = {_GYRO: 3, _ACCEL: 3, _WAYPOINT: 2, _FIELD: 3}
"""Number of values of a line that are read."""
_MERGED = re.compile(r"(?<!^)(?=\d{13}\tTYPE_)")
"""Pattern of the beginning of a line inside another one; stamps of unix ms have 13 digits until the
year 2286."""


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The recordings of a split: whole floors. `all` is every walk below the root."""
    paths = [path for path in root.glob("**/path_data_files/*") if path.suffix.lower() == ".txt"]
    paths.sort(key=lambda path: path.parts[-3:])
    chosen = [path for path in paths if split in ("all", FLOORS.get(_floor(path)))]
    if paths and not chosen:
        floors = ", ".join(floor for floor, part in FLOORS.items() if part == split)
        problem = f"holds no walk of split '{split}'"
        raise InputError(root, problem, f"it consists of the floors {floors}; complete the data")
    return [
        RecordingSource(_name(path), partial(read, path), files=(path,), slow=True)
        for path in chosen
    ]


def _floor(path: Path) -> str:
    return path.parent.parent.name


def _name(path: Path) -> str:
    return f"{path.parent.parent.parent.name}_{_floor(path)}_{path.stem}"


# --- one walk


def read(path: Path) -> list[Sequence]:
    """Read a walk from its file, at 50 Hz, with waypoints instead of poses.

    Raises `InputError` naming file and field, and `Refusal` for a walk with too few waypoints.
    """
    header, tables = read_lines(path)
    for kind, table in tables.items():
        fewest = {_WAYPOINT: FEWEST_WAYPOINTS, _FIELD: 0}.get(kind, 2)
        if (count := len(table.stamps(kind))) < fewest:
            problem = f"field '{kind}' holds {count}, at least {fewest} are needed"
            raise Refusal(path, problem) if kind == _WAYPOINT else damage_error(path, problem)
    start = tables[_GYRO].clock(_GYRO, "ms", repeats="kept")[1]

    def samples(kind: str) -> Samples:
        time, _, rows = tables[kind].clock(kind, "ms", start, "dropped")
        return Samples(time, tables[kind].take("values", width=_VALUES[kind])[rows], str(path))

    gyro, accel, readings = samples(_GYRO), samples(_ACCEL), dict[str, Readings]()
    if len(tables[_FIELD].stamps(_FIELD)):
        time, field, _ = samples(_FIELD)
        readings[MAGNETOMETER] = Readings(time, field, np.full_like(field, np.nan))
    device = re.search(r"Brand:(\S+)\s+Model:(\S+)", header)
    attributes = {
        "group": f"{path.parent.parent.parent.name}_{_floor(path)}",
        "subject": "unknown",
        "device": " ".join(device.groups()) if device else "Android phone",
        "placement": "handheld",
        "truth": "waypoints",
        "imu_compensated": "Android's gyro bias",
    }
    streams = Streams(
        _name(path),
        str(path),
        gyro,
        accel,
        attributes,
        start * 1e-3,
        waypoints=_taps(samples(_WAYPOINT), gyro, accel),
        readings=readings,
    )
    return assemble(streams, RATE)


def _taps(taps: Samples, gyro: Samples, accel: Samples) -> Samples:
    """The waypoints on the IMU's clock."""
    time, position, path = taps
    first, last = max(gyro.time[0], accel.time[0]), min(gyro.time[-1], accel.time[-1])
    excess = np.maximum(first - time, time - last)
    if (excess > TAP_SECONDS).any():
        problem = f"field '{_WAYPOINT}' has {np.sum(excess > TAP_SECONDS)} of {len(time)} stamps"
        problem += f" beyond the IMU's, by up to {excess.max():.1f} s"
        raise InputError(path, problem, "check that all lines are of one phone and one walk")
    time, rows = np.unique(np.clip(time, first, last), return_index=True)
    if len(time) < FEWEST_WAYPOINTS:
        problem = f"field '{_WAYPOINT}' holds {len(time)}, at least {FEWEST_WAYPOINTS} are needed"
        raise Refusal(path, problem)
    return Samples(time, position[rows], path)


def read_lines(path: Path) -> tuple[str, dict[str, Table]]:
    """The lines that begin with '#', and kind of line -> table of its stamps (unix ms), under the
    name of the kind, and its `values`.

    Raises `InputError` if a line is cut short, or if the file has two recordings.
    """
    lines = [*_lines(text_of(path))]
    header = "\n".join(line for _, line in lines if line.startswith("#"))
    starts = header.count("startTime:")
    if starts > 1:
        problem = f"field 'startTime' is there {starts} times: it holds several recordings"
        raise InputError(path, problem, "divide it")
    columns: dict[str, tuple[list[int], list[list[float]]]] = {kind: ([], []) for kind in _VALUES}
    for number, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        cells = line.split("\t")
        kind = cells[1] if len(cells) > 1 else ""
        if not kind.startswith("TYPE_"):
            problem = f"line {number} is '{shorten(line, 40)}', expected time, type and values"
            raise damage_error(path, problem)
        if kind not in _VALUES:
            continue
        stamps, values = columns[kind]
        numbers = cells[2 : 2 + _VALUES[kind]]
        try:
            stamp, row = int(cells[0]), [float(cell) for cell in numbers]
            if len(row) < _VALUES[kind] or not 0 <= stamp < 10**13:
                raise ValueError
        except ValueError:
            problem = f"field '{kind}' is cut short or damaged in line {number}"
            raise damage_error(path, f"{problem} ('{shorten(line, 60)}')") from None
        stamps.append(stamp)
        values.append(row)
    tables = {}
    for kind, (stamps, rows) in columns.items():
        values = np.array(rows).reshape(-1, _VALUES[kind])
        if not (np.abs(values) < FARTHEST).all():
            raise damage_error(path, f"field '{kind}' holds NaN, Inf or impossible values")
        fields = {kind: np.array(stamps, dtype=np.int64), "values": values}
        tables[kind] = Table(path, fields, "field")
    return header, tables


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """(number from 1, line) of all lines; joined lines are divided."""
    for number, line in enumerate(text.split("\n"), 1):
        parts = _MERGED.split(line) if line.count("TYPE_") > 1 else (line,)
        yield from ((number, part) for part in parts)


DATASET = Dataset(
    name="indoor_location",
    recordings=recordings,
    splits=("train", "val", "test", "all"),
    rate=RATE,
    source="https://github.com/location-competition/indoor-location-competition-20",
    layout="<root>/**/<site>/<floor>/path_data_files/<id>.txt",
    licence="MIT",
)
