"""Import of recordings as a `Sequence`: a phone logger's export, a robot's bag, a folder of EuRoC's
layout, or any CSV.

The format is recognised by the content. The reader of the format gives a `recording.Recording`: the
samples of each sensor, the known units, the reference. `recording.as_sequence` does the rest.
"""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pandas as pd

from gnio_jax.apps.importing import loggers, ros, units
from gnio_jax.apps.importing.recording import GAPS as GAPS
from gnio_jax.apps.importing.recording import Imported as Imported
from gnio_jax.apps.importing.recording import (
    Recording,
    Sensor,
    Track,
    Units,
    as_sequence,
    read_table,
    sensor_of,
    table_layout,
)
from gnio_jax.config import ImportOptions
from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.data.parsing.stamps import PER_SECOND, RATES, seconds, time_unit
from gnio_jax.data.parsing.tables import Table
from gnio_jax.data.readers import euroc
from gnio_jax.data.readers.csv_files import ACCEL, GYRO, check_columns, reference
from gnio_jax.data.reference import SHORTEST_RUN
from gnio_jax.errors import InputError
from gnio_jax.files import HDF5
from gnio_jax.types import Sequence

NOTHING_STATED = ImportOptions()
_CHOICES = {
    "time_unit": PER_SECOND,
    "gyro_unit": units.TO_RAD_PER_SECOND,
    "accel_unit": units.TO_METRES_PER_SECOND_SQUARED,
    "accel_sign": units.SIGNS,
}
_MAGIC = {
    b"#ROSBAG V2.0": "rosbag1",  # wiki.ros.org/Bags/Format/2.0
    b"SQLite format 3\x00": "rosbag2",  # sqlite.org/fileformat.html
    ros.MCAP_MAGIC: "mcap",
    loggers.XLS_MAGIC: "logger",
    b"PK": "logger",  # a zip: an export of CSVs, or an .xlsx
    b"\x89HDF\r\n\x1a\n": "hdf5",
}
_NOTES, _WARNINGS = "import_notes", "import_warnings"
"""Attributes of an HDF5 file, with one note or warning per line."""


def import_recording(
    path: str | os.PathLike[str],
    options: ImportOptions = NOTHING_STATED,
    *,
    rate: float | None = None,
    name: str | None = None,
) -> Imported:
    """A recording as a `Sequence` on a uniform clock.

    `path`
        A zip, folder or workbook of Sensor Logger or phyphox, a bag or MCAP, a folder of EuRoC's
        layout, or a CSV: the gyro's file, and the accelerometer's unless `options.accel_path` is
        given; lines that begin with # are comments.
    `options`
        Properties that the recording does not state. Columns that `options.columns` leaves out are
        found by our names. Rows out of order are sorted, and of rows with the same stamp the first
        is used. A CSV's separator is the most frequent of comma, semicolon and tab, or blanks.
    `rate`
        Rate of the result, Hz; None keeps that of the faster sensor.
    `name`
        Name of the sequence; None takes that of the file.

    Two sensors with stamps of their own are put on one clock over the time that both cover, by
    cubic splines. Raises `InputError` naming file, field and remedy.
    """
    for option, known in _CHOICES.items():
        value = getattr(options, option)
        if value is not None and value not in known:
            raise InputError(option, f"unknown value '{value}'", f"known: {', '.join(known)}")
    if rate is not None and not 1.0 <= rate <= RATES[1]:
        raise InputError(
            "rate", f"{rate:g} Hz is out of range", f"give a rate of 1 to {RATES[1]:g} Hz"
        )
    path = Path(path)
    for file in (path, options.accel_path):
        if file is not None and file.exists() and not (file.is_file() or file.is_dir()):
            raise InputError(
                file, "can be read only once, as a pipe can", "save the recording as a file"
            )
    stated = Units(options.time_unit, options.gyro_unit, options.accel_unit, options.accel_sign)
    return as_sequence(_read(path, options), stated, rate, name or path.stem)


def _read(path: Path, options: ImportOptions) -> Recording:
    kind = "csv" if options.columns or options.accel_path is not None else _recognised(path)
    topics = ros.Topics(options.imu_topic, options.accel_topic, options.reference_topic)
    if kind in ros.KINDS:
        return ros.read_bag(path, kind, topics)
    if any(topics):
        raise InputError(
            path, "has no topics", "--imu-topic and the like are for ROS bags and MCAP"
        )
    if kind == "csv":
        return _read_csv(path, options)
    return _read_euroc(path) if kind == "euroc" else loggers.read_logger(path)


def _recognised(path: Path) -> str:
    """csv, logger, euroc or one of `ros.KINDS`, by the content of a file or folder, because names
    may be wrong. A text of no known logger is a CSV, whose columns the user may name."""
    if path.is_dir():
        if any((folder / "imu0" / "data.csv").is_file() for folder in (path, path / "mav0")):
            return "euroc"
        return "rosbag2" if (path / "metadata.yaml").is_file() else "logger"
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from None
    found = next((name for magic, name in _MAGIC.items() if head.startswith(magic)), None)
    if found == "hdf5":
        remedy = "check it with gnio data check csv --data-root FOLDER"
        raise InputError(path, "is HDF5 already", remedy)
    return found or ("logger" if loggers.is_phyphox(table_layout(path).labels) else "csv")


# --- a CSV, and a folder of EuRoC's layout


def _read_csv(path: Path, options: ImportOptions) -> Recording:
    """Read one file, or one of each sensor, with the columns that the user names."""
    named = {name: name for name in ("time", *GYRO, *ACCEL)}
    for word in options.columns:
        ours, _, theirs = word.partition("=")
        if not theirs:
            raise InputError("columns", f"'{word}' names no column", "write gyro_x=NAME")
        if ours not in (*named, "accel_time"):
            known = ", ".join(("time", "accel_time", *GYRO, *ACCEL))
            raise InputError("columns", f"unknown name '{ours}'", f"known names: {known}")
        named[ours] = theirs
    clock = "accel_time" if "accel_time" in named else "time"
    of_gyro = {name: named[name] for name in ("time", *GYRO)}
    of_accel = {name: named[name] for name in (clock, *ACCEL)}
    if options.accel_path is None:
        table = other = _table(path, of_gyro | of_accel)
    else:
        table, other = _table(path, of_gyro), _table(options.accel_path, of_accel)
    gyro = sensor_of("gyro", table, *of_gyro.values())
    accel = sensor_of("accel", other, *of_accel.values())
    known = Units(
        gyro=units.common_unit((named[axis] for axis in GYRO), units.TO_RAD_PER_SECOND),
        accel=units.common_unit(
            (named[axis] for axis in ACCEL), units.TO_METRES_PER_SECOND_SQUARED
        ),
        sign="android",
        sign_is_assumed=True,
    )
    pairs = ((gyro, known.gyro), (accel, known.accel))
    notes = [f"{one.file.name}: {one.name} in {unit}, by its header" for one, unit in pairs if unit]
    track = None
    try:
        track = _csv_reference(table, gyro, options.time_unit)
    except InputError as error:
        notes.append(f"no reference is taken: {error}")
    return Recording(path, gyro, accel, known, track, tuple(notes))


def _table(path: Path, named: dict[str, str]) -> Table:
    """The table of a file with these columns: our name → the file's name."""
    table = read_table(path, tuple(named.values()))
    labels = pd.Series([str(label) for label in table.columns])
    single = {ours: theirs for ours, theirs in named.items() if "+" not in theirs}
    numbers = np.asarray(pd.to_numeric(labels, errors="coerce"), float)
    if np.isfinite(numbers).all() and not labels.isin(single.values()).any():
        places = " ".join(f"{ours}={place}" for place, ours in enumerate(named))
        remedy = f"count its columns from 0, as in --columns {places}"
        raise InputError(path, f"has {len(labels)} columns of numbers and no header", remedy)
    check_columns(path, labels, single, "name them: --columns")
    return table


def _csv_reference(table: Table, gyro: Sensor, unit: str | None) -> Track | None:
    """The reference in the package's own columns, on the gyro's stamps."""
    if not np.isfinite(gyro.stamps).all() or len(gyro.stamps) < 2:
        return None  # the gyro is refused for the same reason
    first = gyro.stamps.min().item()
    unit = unit or time_unit(gyro.stamps - first)[0]
    poses = reference(table, seconds(gyro.stamps, first, unit)) if unit else None
    if unit is None or poses is None:
        return None
    if len(poses.time) < SHORTEST_RUN:
        problem = f"holds {len(poses.time)} poses"
        raise InputError(table.path, problem, f"{SHORTEST_RUN} are the fewest")
    return Track("given", poses, Fraction(first) / int(PER_SECOND[unit]))


def _read_euroc(path: Path) -> Recording:
    """Read the folder `mav0`, or the one that contains it, at any rate, with or without a
    reference."""
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    table = euroc.read_table(mav / "imu0" / "data.csv")
    gyro = sensor_of("gyro", table, euroc.STAMP, *euroc.GYRO)
    accel = sensor_of("accel", table, euroc.STAMP, *euroc.ACCEL)
    first = gyro.stamps.min().item()
    track, poses = None, euroc.read_reference(mav, first)
    if poses is not None:
        track = Track(Path(poses.source).parent.name, poses, Fraction(first, 10**9))
    found = f"reference {track.name}" if track else "no reference"
    notes = (f"{path.name}: EuRoC's layout (ns, rad/s, m/s2), {found}",)
    known = Units("ns", "rad/s", "m/s2", "android")
    return Recording(path, gyro, accel, known, track, notes)


# --- a recording that is kept


def write_imported(path: str | os.PathLike[str], recording: Imported) -> None:
    """Write the sequence as `write_hdf5` does, with its notes and warnings."""
    sequence = recording.sequence
    lines = {_NOTES: recording.notes, _WARNINGS: recording.warnings}
    texts = {
        name: "\n".join(" ".join(line.split()) for line in each)
        for name, each in lines.items()
        if each
    }
    write_hdf5(path, sequence._replace(attributes=sequence.attributes | texts))


def read_imported(path: Path, options: ImportOptions = NOTHING_STATED) -> Imported:
    """Read a recording in the package's HDF5 format, which has notes and warnings if an import
    wrote it. A file of any other format is imported. Raises `InputError`."""
    if path.suffix.lower() not in HDF5:
        return import_recording(path, options)
    sequence = read_hdf5(path)
    attributes = dict(sequence.attributes)
    notes, warnings = (
        tuple(str(attributes.pop(name, "")).splitlines()) for name in (_NOTES, _WARNINGS)
    )
    return Imported(sequence._replace(attributes=attributes), notes, warnings)


def impressions(sequence: Sequence) -> list[str]:
    """Lines that a person can compare with the recording: length, magnitudes, rest."""
    time = sequence.time
    step = float(np.median(np.diff(time)))
    accel, gyro = (np.linalg.norm(field, axis=1) for field in (sequence.accel, sequence.gyro))
    lines = [
        f"{time[-1] - time[0]:.1f} s at {1.0 / step:.4g} Hz",
        f"|accel| {np.median(accel):.2f} m/s² in the median, {accel.min():.2f} to "
        f"{accel.max():.2f}",
        f"|gyro| {np.median(gyro):.2f} rad/s in the median, up to {gyro.max():.2f}",
    ]
    span = max(round(0.5 / step), 1)
    if count := len(accel) // span:
        accel, gyro = (norm[: count * span].reshape(count, span) for norm in (accel, gyro))
        still = (accel.std(axis=1) < 0.2) & (gyro.mean(axis=1) < 0.1)
        lines.append(f"it rests {still.mean():.0%} of the time")
    return lines
