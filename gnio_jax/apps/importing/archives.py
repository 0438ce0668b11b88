"""The CSV files of a logger's export, a zip or a folder, read in memory.

Nothing is ever unpacked to the disk. What a file announces and what it gives are both limited, and
an archive whose members climb out of their folder is refused: no logger writes one.
"""

from __future__ import annotations

import zipfile
from collections import defaultdict
from pathlib import Path, PurePosixPath

from gnio_jax.apps.importing.recording import table_layout
from gnio_jax.data.parsing.tables import parsed_as
from gnio_jax.errors import InputError

LARGEST = 512 * 2**20
"""Bytes of one file: six hours of a sensor at 200 Hz are less (ours)."""
MOST_TABLES = 200
"""CSV files; a logger writes one for each sensor (ours)."""
HEAD = 4096
"""Bytes that hold the first line of a table."""


def csv_names(path: Path) -> dict[str, list[str]]:
    """The names of the CSV files of a zip or folder, by the folder in it that holds them.

    Raises `InputError` for a zip that is damaged or whose members climb out of their folder.
    """
    found: dict[str, list[str]] = defaultdict(list)
    for name in _names(path):
        place = PurePosixPath(name)
        # macOS adds a file "._Gyroscope.csv" to each Gyroscope.csv.
        if place.suffix.lower() == ".csv" and not place.name.startswith("."):
            found[str(place.parent)].append(name)
    if (count := sum(map(len, found.values()))) > MOST_TABLES:
        raise InputError(path, f"holds {count} CSV files", "give one recording of a logger")
    return dict(found)


def _names(path: Path) -> list[str]:
    if path.is_dir():
        return sorted(entry.name for entry in path.iterdir() if entry.is_file())
    with parsed_as(path, "a zip"), zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    check_members(path, names)
    return names


def check_members(path: Path, names: list[str]) -> None:
    """Raise `InputError` where an archive is none of a logger's."""
    for name in names:
        parts = name.replace("\\", "/").split("/")
        if ".." in parts or name.startswith(("/", "\\")) or ":" in parts[0]:
            raise InputError(
                path, f"its member '{name}' climbs out of the folder", "give a logger's own export"
            )


def labels(path: Path, name: str) -> tuple[str, ...]:
    """The columns of a CSV of a zip or folder, by its first line; none where it is no text."""
    line = content(path, name, HEAD).splitlines()[:1]
    try:
        return table_layout(path / name, content=b"".join(line)).labels
    except InputError:
        return ()


def content(path: Path, name: str, most: int | None = None) -> bytes:
    """What a file of a zip or folder holds, or its first `most` bytes. Raises `InputError` where it
    announces or gives more than `LARGEST`."""
    place = path / name
    limit = LARGEST + 1 if most is None else most
    if path.is_dir():
        with parsed_as(place, "a file"), place.open("rb") as file:
            return _limited(file.read(limit), place)
    with parsed_as(path, "a zip"), zipfile.ZipFile(path) as archive:
        check_announced(archive.getinfo(name).file_size, place)
        with archive.open(name) as file:
            return _limited(file.read(limit), place)


def check_announced(size: int, place: Path) -> None:
    """Raise `InputError` for what says that it unpacks to more than `LARGEST` bytes."""
    if size > LARGEST:
        raise _too_large(place, f"unpacks to {size / 2**20:.0f} MiB")


def _limited(data: bytes, place: Path) -> bytes:
    if len(data) > LARGEST:
        raise _too_large(place, f"holds more than {LARGEST / 2**20:.0f} MiB")
    return data


def _too_large(place: Path, problem: str) -> InputError:
    return InputError(place, problem, f"no table may exceed {LARGEST / 2**20:.0f} MiB")
