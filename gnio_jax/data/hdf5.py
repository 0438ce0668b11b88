"""Sequences as HDF5, the package's own file format, and the cache, whose entries are such files.

The cache keeps results that are slow to make: parsed text, aligned clocks. Its folder is
$GNIO_CACHE, else $XDG_CACHE_HOME/gnio-jax, else ~/.cache/gnio-jax; it may be deleted at any time.
It has one entry for each recording and form: a new entry replaces outdated ones.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from gnio_jax.data.parsing.tables import hdf5_field, hdf5_node, parsing_as, shorten
from gnio_jax.data.resampling import check_count
from gnio_jax.data.validation import validate
from gnio_jax.errors import InputError
from gnio_jax.files import replacing
from gnio_jax.types import Readings, Sequence, Waypoints

_FORMAT = "gnio-jax sequence 1"
_OPTIONAL_FIELDS = ("device_orientation", "imu_valid")
_FIELDS = ("time", "gyro", "accel", "orientation", "position", "velocity", "valid")
_WAYPOINTS = tuple(f"waypoints/{field}" for field in Waypoints._fields)
_READINGS = "readings"
"""Group with a group for each sensor beside the IMU."""
_BLOCK = 1 << 20
"""Bytes by which a file in memory grows."""
_NUMBERS = {"start_time": -math.inf, "recorded_rate": 0.0, "accel_clipped": -1e-9}
"""Attributes with which is computed, and the values above which they must be."""
_ATTRIBUTE_TYPES = (str, bool, int, float, np.bool_, np.integer, np.floating)


# --- a file of one sequence


def write_hdf5(path: str | os.PathLike[str], sequence: Sequence) -> None:
    """Write `sequence` as HDF5, whole or not at all.

    The file holds one dataset for each field (contiguous, so that it can be memory-mapped), `name`
    and `format` as attributes, and the sequence's attributes on the group `attributes`. Waypoints
    are the group `waypoints`, and the readings of a sensor the group `readings/SENSOR`. Raises
    `InputError` for an attribute that is not a text, number or boolean, and for a sequence of less
    than two samples, which `read_hdf5` refuses.
    """
    check_count(sequence)
    with _in_memory() as file:
        _write(file, sequence, path)
        content = _image(file)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_hdf5(path: str | os.PathLike[str]) -> Sequence:
    """Read and validate what `write_hdf5` wrote. Raises `InputError` on a missing, cut-short or
    foreign file."""
    path = Path(path)
    if not path.exists():
        raise InputError(path, "no such file")
    with parsing_as(path, "HDF5"), h5py.File(path, "r") as file:
        stored = _read_group(file, path)
    return _stored_sequence(stored, path)


def _in_memory() -> h5py.File:
    """A new HDF5 file in memory. On a full disk the library would leave data out without an
    error, and may end the process."""
    return h5py.File("memory", "w", driver="core", backing_store=False, block_size=_BLOCK)


def _image(file: h5py.File) -> bytes:
    """The bytes of a file in memory."""
    file.flush()
    return file.id.get_file_image()


def _write(group: h5py.Group, sequence: Sequence, path: object) -> None:
    group.attrs["format"] = _FORMAT
    try:
        group.attrs["name"] = sequence.name
    except ValueError:  # bytes of a file's name that are no text, or a zero
        raise InputError(path, f"the name {sequence.name!a} is no text", "rename it") from None
    for field in (*_FIELDS, *_OPTIONAL_FIELDS):
        if getattr(sequence, field) is not None:
            group.create_dataset(field, data=getattr(sequence, field))
    if sequence.waypoints is not None:
        for field, values in sequence.waypoints._asdict().items():
            group.create_dataset(f"waypoints/{field}", data=values)
    for sensor, readings in sequence.readings.items():
        for field, values in readings._asdict().items():
            group.create_dataset(f"{_READINGS}/{sensor}/{field}", data=values)
    attributes = group.create_group("attributes").attrs
    for key, value in sequence.attributes.items():
        remedy = "attributes are text, numbers or booleans"
        if not isinstance(value, _ATTRIBUTE_TYPES):
            raise InputError(path, f"attribute '{key}' is {type(value).__name__}", remedy)
        try:
            attributes[key] = value
        except (ValueError, TypeError):
            problem = f"attribute '{key}' is {shorten(ascii(value))}"
            raise InputError(path, problem, remedy) from None


_StoredGroup = tuple[dict[str, Any], dict[str, np.ndarray | None], dict[str, Any]]
"""Attributes of a group, its fields (None for what is missing), attributes of the sequence."""


def _read_group(group: h5py.Group, path: Path) -> _StoredGroup:
    """Read a group, and check only its size: a failure here is due to the file."""
    sensors = hdf5_node(group, _READINGS, path)
    sensors = sorted(sensors) if isinstance(sensors, h5py.Group) else []
    of_sensors = [name for sensor in sensors for name in _fields_of(sensor)]
    header, names = dict(group.attrs), (*_FIELDS, *_OPTIONAL_FIELDS, *_WAYPOINTS, *of_sensors)
    is_ours = header.get("format") == _FORMAT
    fields = {name: hdf5_field(group, name, path) for name in names if is_ours}
    inner = hdf5_node(group, "attributes", path)
    return header, fields, {} if inner is None else dict(inner.attrs)


def _fields_of(sensor: str) -> list[str]:
    """The datasets of a sensor's readings."""
    return [f"{_READINGS}/{sensor}/{field}" for field in Readings._fields]


def _stored_sequence(stored: _StoredGroup, path: Path) -> Sequence:
    """The sequence of a group, validated. Raises `InputError`."""
    header, fields, attributes = stored
    if (format_name := header.get("format")) != _FORMAT:
        problem = f"is not a '{_FORMAT}' file (format: {format_name!r})"
        raise InputError(path, problem, "convert the recording with gnio data convert")

    def field_values(field: str) -> np.ndarray:
        """A field: booleans if it is a mask, else float64."""
        kind, content = ("b", "booleans") if field.endswith("valid") else ("f", "numbers")
        array = fields[field]
        if array is not None and array.dtype.kind == kind and array.shape:
            return array if kind == "b" else array.astype(np.float64, copy=False)
        problem = "is missing" if array is None else f"is not an array of {content}"
        raise InputError(path, f"field '{field}' {problem}", "convert the recording again")

    present = {name for name, array in fields.items() if array is not None}
    optional: dict[str, Any] = {
        field: field_values(field) for field in _OPTIONAL_FIELDS if field in present
    }
    if present.intersection(_WAYPOINTS):
        optional["waypoints"] = Waypoints(*map(field_values, _WAYPOINTS))
    sensors = dict.fromkeys(f.split("/")[1] for f in fields if f.startswith(f"{_READINGS}/"))
    if sensors:
        optional[_READINGS] = {s: Readings(*map(field_values, _fields_of(s))) for s in sensors}
    name = str(header.get("name", path.stem))
    plain = {key: _plain(key, value, path) for key, value in attributes.items()}
    required = map(field_values, _FIELDS)
    return validate(Sequence(name, *required, **optional, attributes=plain), path)


def _plain(key: str, value: object, path: Path) -> str | bool | int | float:
    """An attribute as a text, number or boolean. Raises `InputError` for anything else, and for one
    of `_NUMBERS` that is not a number."""
    plain = value.item() if isinstance(value, np.generic) else value
    problem = f"attribute '{key}' is {shorten(ascii(plain))}"
    if not isinstance(plain, str | bool | int | float):
        raise InputError(path, f"{problem}, no text or number", "convert the recording again")
    least = _NUMBERS.get(key)
    if least is None or (isinstance(plain, int | float) and least < plain < math.inf):
        return plain
    remedy = "convert the recording again, or remove the attribute"
    raise InputError(path, f"{problem}, no possible number", remedy)


# --- the cache


class Reading(NamedTuple):
    """The result of reading a recording. Problems and warnings are values, because they may come
    from another process or from the cache."""

    sequences: list[Sequence]
    """The sequences; empty if the recording cannot be used."""
    notes: tuple[str, ...] = ()
    """The reader's warnings, and reasons why another form was used."""
    refusals: tuple[str, ...] = ()
    """Reasons why the recording cannot be used, one for each of its forms; empty if it can be
    used."""
    damage: InputError | None = None
    """The error of damaged files; None if there is none."""


def cache_folder() -> Path:
    """Folder of the cache, which need not exist."""
    if chosen := os.environ.get("GNIO_CACHE"):
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "gnio-jax"


def cache_entry(name: str, files: Iterable[str | os.PathLike[str]]) -> Path:
    """The file that keeps the reading of the recording `name` (with its form) from these files.

    Its name changes if a file has another path, size or modification time, is added or removed, or
    if a source file of the package on which reading depends has changed. A folder stands for all
    files in it. The part before the "-" identifies the recording by its name and its first file.
    """
    states: list[list[str | int]] = []
    for path in (Path(file).absolute() for file in files):
        inside = sorted(path.rglob("*")) if path.is_dir() else []
        states.append([str(path)])
        for file in inside or [path]:
            with contextlib.suppress(OSError):  # a file that is absent
                states[-1] += [str(file), file.stat().st_size, file.stat().st_mtime_ns]
    recording, state = (
        hashlib.sha256(json.dumps(key).encode()).hexdigest()[:32]
        for key in ([name, [path for path, *_ in states[:1]]], [_sources(), states])
    )
    return cache_folder() / f"{recording}-{state}.h5"


@functools.cache
def _sources() -> str:
    """A digest of the source files on which the reading of a recording depends."""
    package = Path(__file__).parents[1]
    base = [package / f"{name}.py" for name in ("decimation", "numerics", "types")]
    digest = hashlib.sha256()
    for path in [*base, *sorted((package / "data").rglob("*.py"))]:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def write_reading(entry: Path, reading: Reading) -> None:
    """Keep a reading without damage, whole or not at all, in the place of earlier ones of the same
    recording. If nothing can be written, recordings are read every time."""
    # HDF5 refuses some texts by ValueError, and an image larger than the memory by RuntimeError.
    with contextlib.suppress(OSError, ValueError, RuntimeError, MemoryError):
        with _in_memory() as file:
            file.attrs["notes"] = json.dumps(reading.notes)
            file.attrs["refusals"] = json.dumps(reading.refusals)
            for number, sequence in enumerate(reading.sequences):
                _write(file.create_group(f"{number:04}"), sequence, entry)
            content = _image(file)
        with replacing(entry) as temporary:
            temporary.write_bytes(content)
    recording, _, _ = entry.name.partition("-")
    for other in entry.parent.glob(f"{recording}-*.h5"):
        if other != entry:  # a process that reads it now finishes; others read anew
            with contextlib.suppress(OSError):
                other.unlink()


def read_reading(entry: Path) -> Reading | None:
    """A reading from the cache; None if there is no intact one."""
    try:
        with parsing_as(entry, "HDF5"), h5py.File(entry, "r") as file:
            groups = [_read_group(file[number], entry) for number in sorted(file)]
            notes, refusals = (
                tuple(json.loads(file.attrs[name])) for name in ("notes", "refusals")
            )
        sequences = [_stored_sequence(group, entry) for group in groups]
    except InputError:
        return None
    return Reading(sequences, notes, refusals) if sequences or refusals else None
