"""Import of recordings as a `Sequence`: a phone logger's export, a robot's bag, a folder of EuRoC's
layout, or any CSV.

The format is recognised by the content. The reader of the format gives a `RawRecording`: the
samples of each sensor, the known units, the reference. `recording.as_sequence` does the rest.
"""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path

from gnio_jax.apps.importing import bags, loggers, ros, units
from gnio_jax.apps.importing.clocks import sensor_of
from gnio_jax.apps.importing.columns import read_columns
from gnio_jax.apps.importing.files import files_of
from gnio_jax.apps.importing.recording import GAPS as GAPS
from gnio_jax.apps.importing.recording import Imported as Imported
from gnio_jax.apps.importing.recording import RawRecording, Track, as_sequence
from gnio_jax.config import ImportOptions
from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.data.labels import ACCEL, GYRO, resolve_labels, sensor_named
from gnio_jax.data.parsing.stamps import RATES, seconds_of
from gnio_jax.data.parsing.text import head_of
from gnio_jax.data.readers import euroc
from gnio_jax.errors import InputError
from gnio_jax.files import HDF5

NOTHING_STATED = ImportOptions()
_MAGIC = {
    b"#ROSBAG V2.0": "rosbag1",  # wiki.ros.org/Bags/Format/2.0
    b"SQLite format 3\x00": "rosbag2",  # sqlite.org/fileformat.html
    bags.MCAP_MAGIC: "mcap",
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

    `path` is a zip, folder or workbook of Sensor Logger or phyphox, a bag or MCAP, a folder of
    EuRoC's layout, or a table of text, packed or not, with any preamble, separator and encoding.
    `options` say what the recording does not state; columns that they leave out are found by their
    names. The result has the `rate`, Hz, or that of the faster sensor, and the `name`, or that of
    the file. Damaged rows are left out and named if they are few. Two sensors with stamps of their
    own are put on one clock over the time that both cover, by cubic splines. Raises `InputError`
    naming file, field and remedy.
    """
    seconds_of(options.time_unit or "s")
    units.scale_of(options.gyro_unit or "rad/s", "gyro")
    units.scale_of(options.accel_unit or "g", "accel")
    if options.accel_sign not in (None, *units.SIGNS):
        remedy = f"known: {', '.join(units.SIGNS)}"
        raise InputError("accel_sign", f"unknown value '{options.accel_sign}'", remedy)
    for option, value in (("rate", rate), ("sample_rate", options.sample_rate)):
        if value is not None and not 1.0 <= float(value) <= RATES[1]:
            problem, remedy = f"{float(value):g} Hz is out of range", f"give 1 to {RATES[1]:g} Hz"
            raise InputError(option, problem, remedy)
    path = Path(path)
    for file in (path, options.accel_path):
        if file is not None and file.exists() and not (file.is_file() or file.is_dir()):
            remedy = "save the recording as a file"
            raise InputError(file, "can be read only once, as a pipe can", remedy)
    return as_sequence(_read(path, options), options, rate, name or path.stem)


def _read(path: Path, options: ImportOptions) -> RawRecording:
    is_named = any((options.columns, options.accel_path, options.where, options.sample_rate))
    path = path if is_named else _whole(path)
    kind = _recognise(path)
    if kind in bags.KINDS:
        if is_named:
            problem = f"is {bags.KINDS[kind]}, no table with columns and rows"
            remedy = "leave out --columns, --accel-path, --where and --sample-rate"
            raise InputError(path, problem, remedy)
        return ros.read_bag(path, kind, options)
    if any((options.imu_topic, options.accel_topic, options.reference_topic)):
        remedy = "--imu-topic and the like are for ROS bags and MCAP"
        raise InputError(path, "has no topics", remedy)
    if kind == "euroc" and not is_named:
        return _euroc(path)
    files = files_of(path)
    recording = None if is_named else loggers.read_logger(path, files)
    return recording or read_columns(path, files, options)


def _whole(path: Path) -> Path:
    """The folder of which a file is only a part: data.csv of EuRoC's layout, metadata.yaml of a
    bag, the gyro or the accelerometer of a logger that writes a file for each sensor."""
    folder = path.resolve().parent
    if path.name == "data.csv" and folder.name == "imu0":
        return folder.parent
    if path.name == "metadata.yaml" or path.suffix.lower() not in (".csv", ".txt"):
        return folder if path.name == "metadata.yaml" else path
    if not path.is_file() or sensor_named(path.name) is None:
        return path
    sensors = {sensor_named(file.name) for file in folder.glob(f"*{path.suffix}")}
    holds_one = not {*GYRO, *ACCEL} <= set(resolve_labels(files_of(path)[0].layout.labels))
    return folder if holds_one and {"gyro", "accel"} <= sensors else path


def _recognise(path: Path) -> str:
    """The kind of a file or folder, tables, euroc or one of `bags.KINDS`, by its content, because
    names may be wrong."""
    if path.is_dir():
        if any((folder / "imu0" / "data.csv").is_file() for folder in (path, path / "mav0")):
            return "euroc"
        return "rosbag2" if (path / "metadata.yaml").is_file() else "tables"
    head = head_of(path)
    kind = next((name for magic, name in _MAGIC.items() if head.startswith(magic)), "tables")
    if kind == "hdf5":
        remedy = "check it with gnio data check csv --data-root FOLDER"
        raise InputError(path, "is HDF5 already", remedy)
    return kind


def _euroc(path: Path) -> RawRecording:
    """The folder `mav0`, or the one that contains it, at any rate, with or without a reference."""
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    table = euroc.read_table(mav / "imu0" / "data.csv")
    gyro = sensor_of("gyro", table, "ns", "rad/s", euroc.STAMP, *euroc.GYRO)
    accel = sensor_of("accel", table, "ns", "m/s2", euroc.STAMP, *euroc.ACCEL)
    first = gyro.stamps.min().item()
    track, poses = None, euroc.read_reference(mav, first)
    if poses is not None:
        track = Track(Path(poses.source).parent.name, poses, Fraction(first, 10**9))
    source = f"reference {track.name}" if track else "no reference"
    notes = [f"{path.name}: EuRoC's layout (ns, rad/s, m/s2), {source}"]
    return RawRecording(path, gyro, accel, notes, [], "android", track=track)


def write_imported(path: str | os.PathLike[str], recording: Imported) -> None:
    """Write the sequence as `write_hdf5` does, with its notes and warnings, in which a file's name
    may have bytes that are no text."""
    sequence = recording.sequence
    lines = {_NOTES: recording.notes, _WARNINGS: recording.warnings}
    texts = {n: "\n".join(" ".join(line.split()) for line in ls) for n, ls in lines.items() if ls}
    texts = {n: text.encode("utf-8", "backslashreplace").decode() for n, text in texts.items()}
    write_hdf5(path, sequence._replace(attributes=sequence.attributes | texts))


def read_imported(path: Path, options: ImportOptions = NOTHING_STATED) -> Imported:
    """Read a recording in the package's HDF5 format, which has notes and warnings if an import
    wrote it. A file of any other format is imported. Raises `InputError`."""
    if path.suffix.lower() not in HDF5:
        return import_recording(path, options)
    sequence = read_hdf5(path)
    attributes = dict(sequence.attributes)
    lines = (tuple(str(attributes.pop(k, "")).splitlines()) for k in (_NOTES, _WARNINGS))
    return Imported(sequence._replace(attributes=attributes), *lines)
