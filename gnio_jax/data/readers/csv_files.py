"""One's own recordings: a folder of CSV files or of the package's HDF5, and phone loggers' CSV
brought into that form.

A CSV has a header that names, in any order, `time` s, `gyro_x..z` rad/s, `accel_x..z` m/s²
(specific force), and optionally a reference: `qw..qz` (body→world), `px..pz` m, `vx..vz` m/s in a
z-up world; other columns are ignored. Any rate. Without a reference the sequence holds NaN there
and `valid` is False; velocities that are not given are differenced from the positions. Rows with an
empty reference are not valid.

`import_recording` takes the files of a phone's logger: columns of other names, other units, one
file per sensor.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.hdf5 import read_hdf5
from gnio_jax.data.readers.text import listed, numbers, read_csv
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import (
    check_finite,
    check_gaps,
    check_increasing,
    check_motion,
    validate,
)
from gnio_jax.types import GRAVITY, STANDARD_G, InputError, Sequence

SPLITS = ("train", "val", "test")
RATES = (10.0, 2000.0)
"""Hz; between these lies every IMU one walks with."""

_GYRO = ("gyro_x", "gyro_y", "gyro_z")
_ACCEL = ("accel_x", "accel_y", "accel_z")
_REFERENCE = {
    "orientation": ("qw", "qx", "qy", "qz"),
    "position": ("px", "py", "pz"),
    "velocity": ("vx", "vy", "vz"),
}
_FILES = (".csv", ".h5", ".hdf5")


def recordings(root: Path, split: str) -> list[Recording]:
    """The recordings of a split, in the order of their names: those that <root>/<split>.txt lists,
    or all as `test` where there is no list.

    Raises `InputError` where two files would go by the same name.
    """
    named: dict[str, Path] = {}
    for path in _files(Path(root), split):
        if named.setdefault(path.stem, path) != path:
            raise InputError(
                path, f"has the name of {named[path.stem]}", "rename or remove one of them"
            )
    return [single(name, read_recording, path) for name, path in sorted(named.items())]


def list_splits(root: Path) -> tuple[str, ...]:
    """The splits that the lists <root>/<split>.txt name; `test` alone where there is none."""
    lists = {path.stem for path in root.glob("*.txt") if re.fullmatch("[a-z][a-z0-9_]*", path.stem)}
    return (*(split for split in SPLITS if split in lists), *sorted(lists - set(SPLITS))) or (
        "test",
    )


def read_recording(path: str | os.PathLike[str]) -> Sequence:
    """One recording, on a uniform clock of its own rate. Raises `InputError` naming file and field."""
    path = Path(path)
    if path.suffix.lower() in (".h5", ".hdf5"):
        sequence = read_hdf5(path)
        _check_seconds(sequence.time, path)
        check_gaps(sequence.time, path)
        check_motion(sequence, path)
        return resample(sequence, _rate(sequence.time))
    table = read_csv(path)
    for field, columns in _REFERENCE.items():
        present = [name for name in columns if name in table.columns]
        if present and len(present) < len(columns):
            missing = next(name for name in columns if name not in table.columns)
            raise InputError(
                path,
                f"column '{missing}' is missing while '{present[0]}' is there",
                f"the {field} of a reference has {', '.join(columns)}",
            )
    time = numbers(table, ["time"], path)[:, 0]
    gyro, accel = numbers(table, _GYRO, path), numbers(table, _ACCEL, path)
    for field, values in (("time", time), ("gyro", gyro), ("accel", accel)):
        check_finite(values, field, path)
    check_increasing(time, path)
    _check_seconds(time, path)
    check_gaps(time, path)
    reference = {
        field: numbers(table, columns, path)
        if columns[0] in table.columns
        else np.full((len(time), len(columns)), np.nan)
        for field, columns in _REFERENCE.items()
    }
    valid = np.isfinite(reference["orientation"]).all(axis=1) & np.isfinite(
        reference["position"]
    ).all(axis=1)
    if "vx" not in table.columns:
        reference["velocity"] = _differenced(time, reference["position"], valid)
    valid &= np.isfinite(reference["velocity"]).all(axis=1)
    sequence = Sequence(
        name=path.stem,
        time=time,
        gyro=gyro,
        accel=accel,
        valid=valid,
        attributes={
            "dataset": "csv",
            "group": path.stem,
            "truth": "given" if valid.any() else "none",
        },
        **reference,
    )
    sequence = validate(sequence, path)
    check_motion(sequence, path)
    return resample(sequence, _rate(time))


def in_order(
    time: Float[np.ndarray, " n"],
    values: Float[np.ndarray, "n w"],
    source: object,
    repeats: Literal["first", "refuse"] = "refuse",
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m w"], dict[str, float]]:
    """Rows sorted by their stamps (s), repeated ones dropped, and the counts `rows_sorted` and
    `rows_repeated` where they are not zero.

    A row that repeats stamp and values is the same row twice. Of rows that share a stamp but not
    their values the first is kept, or all are refused by an `InputError`, as `repeats` says.
    """
    backward = int((np.diff(time) < 0).sum())
    order = np.argsort(time, kind="stable")
    time, values = time[order], values[order]
    again = np.concatenate([[False], np.diff(time) == 0])
    other = again & np.concatenate([[False], (np.diff(values, axis=0) != 0).any(axis=1)])
    if repeats == "refuse" and other.any():
        row = int(np.argmax(other))
        raise InputError(
            source,
            f"field 'time' gives {other.sum()} rows the stamp of another row with other values, first at "
            f"{time[row]:.6f} s",
            "give each sample a stamp of its own",
        )
    counts = {"rows_sorted": float(backward), "rows_repeated": float(again.sum())}
    return time[~again], values[~again], {name: count for name, count in counts.items() if count}


def _files(root: Path, split: str) -> list[Path]:
    if split not in SPLITS and not (root / f"{split}.txt").is_file():
        raise InputError(
            root,
            f"unknown split '{split}'",
            f"known splits: {', '.join(SPLITS)}, or that of a list {split}.txt there",
        )
    if split not in SPLITS or any((root / f"{name}.txt").is_file() for name in SPLITS):
        return listed(root / f"{split}.txt", lambda entry: _find(root, entry), root, DATASET.layout)
    paths = sorted(
        path for path in root.glob("[!.]*") if path.suffix.lower() in _FILES and path.is_file()
    )
    if not paths:
        raise InputError(
            root, "holds no recording (*.csv, *.h5, *.hdf5)", f"expected layout: {DATASET.layout}"
        )
    if split != "test":
        raise InputError(
            root,
            f"has no list {split}.txt",
            f"without lists every recording is in split 'test'; expected layout: {DATASET.layout}",
        )
    return paths


def _find(root: Path, entry: str) -> Path | None:
    """The file of a list's entry, which may lack the suffix."""
    candidates = [root / entry, *(root / f"{entry}{suffix}" for suffix in _FILES)]
    return next(
        (path for path in candidates if path.is_file() and path.suffix.lower() in _FILES), None
    )


def _rate(time: np.ndarray) -> float:
    """Hz, to four digits: stamps are never as exact as the clock they come from."""
    return float(f"{1.0 / float(np.median(np.diff(time))):.4g}")


def _check_seconds(time: np.ndarray, source: object) -> None:
    unit, rate = _time_unit(time)
    if unit != "s":
        hint = (
            f"it looks like {unit}: divide it by {_PER_SECOND[unit]:g}"
            if unit
            else f"an IMU runs at {RATES[0]:g} to {RATES[1]:g} Hz"
        )
        raise InputError(
            source,
            f"field 'time' is not in seconds (as such its rate would be {rate:.3g} Hz)",
            hint,
        )


def _differenced(time: np.ndarray, position: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Central differences within stretches of known positions, NaN where there are less than two in
    a row."""
    velocity = np.full_like(position, np.nan)
    rows = np.flatnonzero(good)
    for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        if run.size >= 4:
            velocity[run] = CubicSpline(time[run], position[run], axis=0)(time[run], 1)
        elif run.size >= 2:
            velocity[run] = np.gradient(position[run], time[run], axis=0)
    return velocity


# --- recordings of other loggers
# -------------------------------------------------------------------------------------

_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_TO_RAD = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
_TO_METRES = {"m/s2": 1.0, "g": STANDARD_G, "mg": STANDARD_G * 1e-3}

GYRO_RANGE = 35.0
"""rad/s: no phone's gyro measures beyond 2000 deg/s."""
CARRIED_TURN = 10.0
"""deg/s: what somebody carries turns faster than this at times."""
STEPS = 1.0
"""m/s²: steps make the magnitude of the specific force vary by more (standard deviation)."""


class Imported(NamedTuple):
    """What `import_recording` made of a recording."""

    sequence: Sequence
    """On a uniform clock, without a reference."""
    notes: tuple[str, ...]
    """What was detected, assumed or repaired, one sentence each, to be shown to the user."""


class _Stream(NamedTuple):
    """One sensor's samples."""

    time: np.ndarray
    """s from `epoch`."""
    values: np.ndarray
    epoch: float
    """The first stamp, s: unix time in a float is good to a quarter of a microsecond, so stamps are
    counted from it."""


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

    path        the gyro's file, and the accelerometer's unless `accel_path` is given; lines that
    begin with # are comments. columns     from our names to the file's: `time`, `gyro_x..z`,
    `accel_x..z`, and `accel_time` if the accelerometer's time is another
                column. What is not mapped is looked up by our name. "a+b" is the sum of two columns
                (gravity and user acceleration). In a file whose header names nothing, or that has
                none, all are places counted from "0".
    time_unit   None detects it: of s, ms, us and ns the one by which the IMU runs at 10 to 2000 Hz;
    the ranges do not overlap. gyro_unit   None detects it: above 35 (rad/s: 2000 deg/s) it is
    deg/s; else the turning of gravity in the accelerometer decides where
                there is enough of it; else, if steps shake the recording, what never exceeds 10 is
                rad/s; else it is ambiguous and refused.
    accel_unit  None detects it by the median magnitude: 7–13 m/s2, 0.7–1.3 g, 700–1300 mg; anything
    else is refused. accel_sign  "android": at rest, level, the up axis reads +1 g; "ios": it reads
    −1 g and everything is negated; "detect" assumes that the
                screen (+z) points up more than down over the recording. Nothing in the data alone
                tells the sign.
    order       rows out of order are sorted and rows that are there twice dropped, or refused. rate
    Hz of the result; None keeps the faster sensor's own. separator   of the columns; None takes the
    most frequent of comma, semicolon and tab, or blanks where there is none of them.

    Two sensors with stamps of their own are put on the faster one's over the time that both cover,
    by cubic splines. Raises `InputError` naming file, field and remedy.
    """
    path, other = Path(path), Path(accel_path) if accel_path is not None else None
    columns = dict(columns or {})
    known = {"time", "accel_time", *_GYRO, *_ACCEL}
    if unknown := sorted(set(columns) - known):
        raise InputError(
            "columns", f"unknown name '{unknown[0]}'", f"known names: {', '.join(sorted(known))}"
        )
    for option, value, choices in (
        ("time_unit", time_unit, _PER_SECOND),
        ("gyro_unit", gyro_unit, _TO_RAD),
        ("accel_unit", accel_unit, _TO_METRES),
        ("accel_sign", accel_sign, ("android", "ios", "detect")),
        ("order", order, ("sort", "refuse")),
    ):
        if value is not None and value not in choices:
            raise InputError(option, f"unknown value '{value}'", f"known: {', '.join(choices)}")
    if rate is not None and not 1.0 <= rate <= RATES[1]:
        raise InputError(
            "rate", f"{rate:g} Hz is no rate to resample to", f"give 1 to {RATES[1]:g} Hz"
        )

    notes: list[str] = []
    named = {name: columns.get(name, name) for name in known - {"accel_time"}}
    named["accel_time"] = columns.get("accel_time", named["time"])
    places = {
        sensor: all(named[field].isdigit() for field in fields)
        for sensor, fields in (("gyro", ("time", *_GYRO)), ("accel", ("accel_time", *_ACCEL)))
    }
    table = _read(path, separator, header=not places["gyro"])
    accel_table = _read(other, separator, header=not places["accel"]) if other else table
    gyro_file, accel_file = path, other or path
    stamps = _column(table, named["time"], gyro_file, exact=True)
    accel_stamps = _column(accel_table, named["accel_time"], accel_file, exact=True)
    rates = np.stack([_column(table, named[axis], gyro_file) for axis in _GYRO], axis=1)
    forces = np.stack([_column(accel_table, named[axis], accel_file) for axis in _ACCEL], axis=1)
    gyro = _stream(stamps, rates, "gyro", gyro_file, time_unit, order, notes)
    accel = _stream(accel_stamps, forces, "accel", accel_file, time_unit, order, notes)

    pull = _accel_scale(accel.values, accel_unit, accel_file, notes)
    start, time, rates, forces = _joined(
        gyro, accel._replace(values=accel.values * pull), gyro_file, accel_file, notes
    )
    rates = rates * _gyro_scale(time, rates, forces, gyro_unit, gyro_file, notes)
    forces = _signed(forces, accel_sign, accel_file, notes)
    _note_gravity(time, forces, accel_file, notes)

    count, nothing = len(time), np.full((len(time), 3), np.nan)
    sequence = validate(
        Sequence(
            name=name or path.stem,
            time=time,
            gyro=rates,
            accel=forces,
            orientation=np.full((count, 4), np.nan),
            position=nothing,
            velocity=nothing,
            valid=np.zeros(count, dtype=bool),
            attributes={
                "dataset": "csv",
                "group": name or path.stem,
                "truth": "none",
                "start_time": start,
            },
        ),
        path,
    )
    target = rate or _rate(time)
    notes.append(f"put on a uniform clock of {target:g} Hz")
    return Imported(resample(sequence, target), tuple(notes))


def _read(path: Path, separator: str | None, header: bool) -> pd.DataFrame:
    if separator is None:
        try:
            with path.open(encoding="utf-8") as file:
                first = next(
                    (line for line in file if line.strip() and not line.startswith("#")), ""
                )
        except OSError as error:
            raise InputError(path, f"cannot be read ({error.strerror})") from None
        except UnicodeDecodeError as error:
            raise InputError(path, f"is no text ({error})", "export the recording as CSV") from None
        separator = max((",", ";", "\t"), key=first.count)
        separator = separator if separator in first else " "
    table = read_csv(path, separator=separator, header=header)
    table.columns = [
        str(label).strip("\ufeff \"'") for label in table.columns
    ]  # a byte order mark, quoted names
    return table


def _column(table: pd.DataFrame, name: str, path: Path, exact: bool = False) -> np.ndarray:
    """A column, or the sum of columns of "a+b". `exact` keeps integers, since nanoseconds of unix
    time have more digits than a float."""
    if name not in table.columns and "+" in name:
        return sum(
            (_column(table, part.strip(), path) for part in name.split("+")), np.zeros(len(table))
        )
    if exact and name in table.columns and table[name].ndim == 1 and table[name].dtype.kind in "iu":
        return table[name].to_numpy()
    return numbers(table, [name], path)[:, 0]


def _time_unit(time: np.ndarray) -> tuple[str | None, float]:
    """The unit by which stamps are an IMU's, None if there is none, and the rate in Hz if they were
    seconds."""
    steps = np.diff(np.sort(time))
    steps = steps[steps > 0]
    step = float(np.median(steps)) if steps.size else np.inf
    # A rate at the very edge is inside, whatever the last digit of its stamps.
    units = [
        unit
        for unit, per_second in _PER_SECOND.items()
        if RATES[0] * (1 - 1e-6) <= per_second / step <= RATES[1] * (1 + 1e-6)
    ]
    return (units[0] if units else None), 1.0 / step


def _stream(
    stamps: np.ndarray,
    values: np.ndarray,
    sensor: str,
    path: Path,
    unit: str | None,
    order: str,
    notes: list[str],
) -> _Stream:
    # Loggers that write every sensor into one table leave the others' columns empty.
    empty = np.isnan(values).all(axis=1)
    if empty.any() and not empty.all():
        notes.append(
            f"{path.name}: {empty.sum()} of {len(empty)} rows have no {sensor} and are not its samples"
        )
        stamps, values = stamps[~empty], values[~empty]
    if len(stamps) < 2:
        raise InputError(
            path, f"holds {len(stamps)} samples of field '{sensor}'", "record for longer"
        )
    check_finite(stamps.astype(np.float64), "time", path)
    check_finite(values, sensor, path)
    first = stamps.min()
    stamps = stamps - first
    if unit is None:
        unit, rate = _time_unit(stamps)
        if unit is None:
            raise InputError(
                path,
                f"the unit of field 'time' is ambiguous (in seconds {sensor} would run at {rate:.3g} Hz)",
                "state it: s, ms, us or ns",
            )
        notes.append(
            f"{path.name}: time of {sensor} taken as {unit}, by which it runs at {rate * _PER_SECOND[unit]:.4g} Hz"
        )
    time = stamps / _PER_SECOND[unit]
    if order == "refuse":
        check_increasing(time, path)
    # Stamps rounded to a coarse unit fall together now and then; one in a hundred is none to worry
    # about.
    rows = len(time)
    time, values, repairs = in_order(time, values, path, repeats="first")
    if repairs.get("rows_sorted"):
        notes.append(
            f"{path.name}: {sensor} had {repairs['rows_sorted']:.0f} steps back in time; its rows were sorted"
        )
    if repeated := int(repairs.get("rows_repeated", 0)):
        if repeated > 0.01 * rows:
            raise InputError(
                path,
                f"field 'time' repeats in {repeated} of {rows} rows of {sensor}",
                "give stamps fine enough to tell the samples apart",
            )
        notes.append(f"{path.name}: {repeated} rows of {sensor} repeat a stamp and were dropped")
    if len(time) < 2:
        raise InputError(
            path, f"holds {len(time)} samples of field '{sensor}'", "record for longer"
        )
    rate = 1.0 / float(np.median(np.diff(time)))
    if not RATES[0] * 0.99 <= rate <= RATES[1] * 1.01:
        raise InputError(
            path,
            f"field 'time' makes {sensor} run at {rate:.3g} Hz with the unit {unit}",
            f"an IMU runs at {RATES[0]:g} to {RATES[1]:g} Hz",
        )
    check_gaps(time, path)
    holes = np.diff(time)[np.diff(time) > max(0.1, 3.0 / rate)]
    if holes.size:
        notes.append(
            f"{path.name}: {sensor} lacks samples {holes.size} times, for up to {holes.max():.2f} s; bridged linearly"
        )
    return _Stream(time - time[0], values, float(first) / _PER_SECOND[unit])


def _accel_scale(accel: np.ndarray, unit: str | None, path: Path, notes: list[str]) -> float:
    pull = float(np.median(np.linalg.norm(accel, axis=1)))
    if unit is None:
        ranges = {"m/s2": (7.0, 13.0), "g": (0.7, 1.3), "mg": (700.0, 1300.0)}
        unit = next((name for name, (low, high) in ranges.items() if low <= pull <= high), None)
        if unit is None:
            raise InputError(
                path,
                f"the unit of field 'accel' is ambiguous (median magnitude {pull:.3g})",
                "state it, and give the specific force, gravity included",
            )
        notes.append(f"{path.name}: accel taken as {unit} (median magnitude {pull:.3g})")
    return _TO_METRES[unit]


def _joined(
    gyro: _Stream, accel: _Stream, gyro_file: Path, accel_file: Path, notes: list[str]
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """(first stamp s, time, gyro, accel) on the stamps of the faster sensor, over what both cover,
    time from 0."""
    if (
        gyro.epoch == accel.epoch
        and len(gyro.time) == len(accel.time)
        and (gyro.time == accel.time).all()
    ):
        return gyro.epoch, gyro.time, gyro.values, accel.values
    accel = accel._replace(time=accel.time + (accel.epoch - gyro.epoch))
    first, last = max(gyro.time[0], accel.time[0]), min(gyro.time[-1], accel.time[-1])
    if last - first < 1.0:
        raise InputError(
            accel_file,
            f"field 'time' overlaps by {max(last - first, 0.0):.3g} s with that of gyro in {gyro_file.name}",
            "the files must be of one recording and one clock",
        )
    faster, slower = (
        (gyro, accel)
        if np.median(np.diff(gyro.time)) <= np.median(np.diff(accel.time))
        else (accel, gyro)
    )
    inside = (faster.time >= first) & (faster.time <= last)
    time = faster.time[inside]
    values = CubicSpline(slower.time, slower.values, axis=0)(time)
    # A spline swings through a gap; there a straight line does no harm.
    right = np.clip(np.searchsorted(slower.time, time), 1, len(slower.time) - 1)
    gap = slower.time[right] - slower.time[right - 1] > 0.1
    for axis in range(3):
        values[gap, axis] = np.interp(time[gap], slower.time, slower.values[:, axis])
    cut = max(gyro.time[-1], accel.time[-1]) - min(gyro.time[0], accel.time[0]) - (last - first)
    moved = "accel" if faster is gyro else "gyro"
    notes.append(
        f"gyro and accel have stamps of their own: {moved} interpolated, {cut:.2f} s cut that only one of them covers"
    )
    rates, forces = (
        (gyro.values[inside], values) if faster is gyro else (values, accel.values[inside])
    )
    return gyro.epoch + float(time[0]), time - time[0], rates, forces


def _gyro_scale(
    time: np.ndarray,
    gyro: np.ndarray,
    accel: np.ndarray,
    unit: str | None,
    path: Path,
    notes: list[str],
) -> float:
    if unit is not None:
        return _TO_RAD[unit]
    peak = float(np.percentile(np.linalg.norm(gyro, axis=1), 99.9))
    share, correlation = _turning_of_gravity(time, gyro, accel)
    if peak > GYRO_RANGE:
        unit, reason = "deg/s", f"it reaches {peak:.3g}, beyond any phone's range in rad/s"
    elif correlation > 0.5 and 0.5 < share < 2.0:
        unit, reason = "rad/s", f"gravity turns by {share:.2f} of it"
    elif correlation > 0.5 and 0.5 < share / _TO_RAD["deg/s"] < 2.0:
        unit, reason = "deg/s", f"gravity turns by {share:.3f} of it"
    elif peak <= CARRIED_TURN and float(np.linalg.norm(accel, axis=1).std()) > STEPS:
        unit, reason = (
            "rad/s",
            f"it reaches {peak:.3g}, and what is carried turns faster than {CARRIED_TURN:g} deg/s",
        )
    else:
        raise InputError(
            path,
            f"the unit of field 'gyro' is ambiguous (it reaches {peak:.3g})",
            "state it: rad/s or deg/s",
        )
    notes.append(f"{path.name}: gyro taken as {unit} ({reason})")
    return _TO_RAD[unit]


def _turning_of_gravity(
    time: np.ndarray, gyro: np.ndarray, accel: np.ndarray
) -> tuple[float, float]:
    """(slope, correlation) of the change of the smoothed specific force over a second against −∫ω ×
    f, which is 1 in rad/s."""
    step = float(np.median(np.diff(time)))
    clock = np.arange(time[0], time[-1], step)
    if len(clock) < 3.0 / step:
        return 0.0, 0.0
    force, rate = (
        np.stack([np.interp(clock, time, column) for column in values.T], axis=1)
        for values in (accel, gyro)
    )
    force = gaussian_filter1d(force, 0.5 / step, axis=0)
    rate = gaussian_filter1d(rate, 0.5 / step, axis=0)
    # A bias turns the same way all the time; what moves about its median is motion.
    rate = rate - np.median(rate, axis=0)
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(-np.cross(rate, force), axis=0) * step])[
        :-1
    ]
    span = max(round(1.0 / step), 1)
    change, expected = force[span:] - force[:-span], turned[span:] - turned[:-span]
    power, strength = float((expected**2).sum()), float((change**2).sum())
    if (
        power == 0.0 or strength / len(change) < 0.1**2
    ):  # gravity has not moved: noise and vibration
        return 0.0, 0.0
    both = float((change * expected).sum())
    return both / power, both / np.sqrt(power * strength)


def _signed(accel: np.ndarray, sign: str, path: Path, notes: list[str]) -> np.ndarray:
    if sign == "detect":
        up = float(np.median(accel[:, 2]) / np.median(np.linalg.norm(accel, axis=1)))
        if abs(up) < 0.5:
            raise InputError(
                path,
                f"the sign of field 'accel' is ambiguous (its z axis carries {up:.2f} of gravity)",
                "state it: android or ios",
            )
        sign = "android" if up > 0 else "ios"
        notes.append(
            f"{path.name}: accel taken with {'Android' if up > 0 else 'iOS'}'s sign, assuming that the screen points up"
        )
    if sign == "ios":
        notes.append(f"{path.name}: accel negated (iOS's sign)")
    return -accel if sign == "ios" else accel


def _note_gravity(time: np.ndarray, accel: np.ndarray, path: Path, notes: list[str]) -> None:
    """What the quietest second says of gravity."""
    span = min(max(round(1.0 / float(np.median(np.diff(time)))), 2), len(accel))
    spans = [
        slice(first, first + span) for first in range(0, len(accel) - span + 1, max(span // 2, 1))
    ]
    quiet = accel[min(spans, key=lambda rows: float(accel[rows].var(axis=0).sum()))].mean(axis=0)
    axis = int(np.argmax(np.abs(quiet)))
    pull = float(np.linalg.norm(quiet))
    upward = f"{'-' if quiet[axis] < 0 else '+'}{'xyz'[axis]}"
    notes.append(
        f"{path.name}: in the quietest second accel reads {pull:.2f} m/s², mostly on {upward}"
    )
    if abs(pull - GRAVITY) > 2.0:
        raise InputError(
            path,
            f"field 'accel' reads {pull:.2f} m/s² in its quietest second, far from gravity",
            "check its unit, and that gravity is in it",
        )
    if abs(pull - GRAVITY) > 0.5:
        notes.append(
            f"{path.name}: that is off gravity by {pull - GRAVITY:+.2f} m/s²: the accelerometer may need calibration"
        )


DATASET = Dataset(
    name="csv",
    recordings=recordings,
    splits=SPLITS,
    rate=100.0,
    source="your own recordings (python -m gnio_jax.data import brings a logger's CSV into this form)",
    layout="<root>/*.csv (time, gyro_x..z, accel_x..z[, qw..qz][, px..pz][, vx..vz]) or *.h5; optionally <root>/{train,val,test}.txt",
    licence="yours",
    pedestrian=False,
    needs_reference=False,
    list_splits=list_splits,
)
