"""The files of a package: a manifest with the size and SHA-256 of each, in a folder or a zip.

Reading checks all of it before anything is used. Nothing is unpacked to the disk.
"""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax.errors import InputError
from gnio_jax.files import replacing, replacing_folder

FORMAT, VERSION = "gnio-package", 1
MANIFEST = "manifest.json"
WEIGHTS = "weights.safetensors"
CONFIG = "config.yaml"
CARD = "README.md"
FIGURES = "evaluations.json"
NEEDED = (WEIGHTS, CONFIG, CARD)
LARGEST_MANIFEST = 2**20
"""Bytes."""
LARGEST_FILE = 2**32
"""Bytes: a zip of some megabytes may say that it unpacks to any size (ours)."""
_KINDS = {
    "name": str,
    "network": str,
    "data": str,
    "license": str,
    "storage": str,
    "bytes": int,
    "metric": dict | None,
}
"""What the manifest says of a package, and how."""
_REMEDY = "the package is damaged: fetch or publish it again"


class Metric(NamedTuple):
    """The figure by which a network is listed."""

    name: str
    """As metrics.json has it, e.g. `ate_2d`."""
    value: float
    low: float | None
    """95 % interval, where there is one."""
    high: float | None
    of: str
    """The evaluation, e.g. `oxiod_test_ekf`."""


class About(NamedTuple):
    """What the manifest says of a package besides its files."""

    name: str
    network: str
    """In the registry of `gnio_jax.models`."""
    data: str
    """What the network was trained on, in its publisher's words."""
    license: str
    storage: str
    """`float32` or `float16`."""
    epoch: int
    step: int
    metric: Metric | None
    made_by: str
    """The program that published it, with its version."""
    bytes: int = 0
    """Of all files, without the manifest."""


class Package(NamedTuple):
    """A package as it was read: every file is as its manifest says."""

    place: Path
    about: About
    files: dict[str, bytes]


def is_package(place: Path) -> bool:
    """Whether a folder or file is meant to be a package; its content is not looked at."""
    return (place.is_file() and place.suffix == ".zip") or (place / MANIFEST).is_file()


def write(place: Path, about: About, files: Mapping[str, bytes]) -> None:
    """Write a package, whole or not at all: a zip if `place` ends in .zip, else a folder.

    An older package at this place is replaced. Raises `InputError` where something else is there.
    """
    if place.exists() and not (place.is_dir() and not any(place.iterdir())):
        _check_replaced(place)
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        **about._replace(bytes=sum(map(len, files.values())))._asdict(),
        "metric": about.metric and about.metric._asdict(),
        "files": {name: _entry(content) for name, content in files.items()},
    }
    text = json.dumps(manifest, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    contents = {MANIFEST: text.encode(), **files}
    if place.suffix == ".zip":
        with replacing(place) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for name, content in contents.items():
                # A date of its own would make other bytes of the same package.
                member = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
                archive.writestr(member, content, zipfile.ZIP_DEFLATED)
        return
    with replacing_folder(place) as folder:
        for name, content in contents.items():
            (folder / name).write_bytes(content)


def _check_replaced(place: Path) -> None:
    """Raise `InputError` unless a package may take the place of what is there."""
    try:
        _manifest(place)
    except InputError:
        problem = "is there already and is no package"
        raise InputError(place, problem, "name another --out") from None


def read(place: Path) -> Package:
    """Read a package and check it against its manifest.

    Raises `InputError` for a manifest that is missing, damaged or of an unknown version, a file
    that is missing, and one of another size or with a changed byte.
    """
    manifest = _manifest(place)
    files = {}
    for name, entry in manifest["files"].items():
        content = _content(place, name, entry["bytes"])
        if _entry(content) != entry:
            problem = f"'{name}' is not the file that the manifest describes (SHA-256 differs)"
            raise InputError(place, problem, _REMEDY)
        files[name] = content
    return Package(place, _about(place, manifest), files)


def about(place: Path) -> About:
    """What a package says of itself; only its manifest is read. Raises `InputError`."""
    return _about(place, _manifest(place))


def _entry(content: bytes) -> dict[str, Any]:
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _manifest(place: Path) -> dict[str, Any]:
    """The manifest, of a version and with the fields that are known."""
    try:
        found = json.loads(_content(place, MANIFEST, LARGEST_MANIFEST))
    except (ValueError, RecursionError) as error:  # InputError, too, is a ValueError
        if isinstance(error, InputError):
            raise
        raise InputError(place, f"'{MANIFEST}' is no JSON ({error})", _REMEDY) from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InputError(place, f"'{MANIFEST}' is not that of a package", _REMEDY)
    if found.get("version") != VERSION:
        problem = f"has format version {found.get('version')!r}; this program reads {VERSION}"
        raise InputError(place, problem, "install a newer gnio-jax")
    files = found.get("files")
    if not isinstance(files, dict) or not all(map(_is_entry, files, files.values())):
        raise InputError(place, f"'{MANIFEST}' lists its files wrongly", _REMEDY)
    for name in NEEDED:
        if name not in files:
            raise InputError(place, f"'{MANIFEST}' lacks '{name}'", _REMEDY)
    return found


def _is_entry(name: str, entry: Any) -> bool:
    """Whether the manifest's entry is a plain name of a file with its size and digest."""
    plain = name == Path(name).name and "\\" not in name
    return (
        plain
        and isinstance(entry, dict)
        and isinstance(entry.get("bytes"), int)
        and 0 <= entry["bytes"] <= LARGEST_FILE
        and isinstance(entry.get("sha256"), str)
    )


def _about(place: Path, manifest: dict[str, Any]) -> About:
    try:
        known = {name: manifest[name] for name in About._fields}
        for name, kind in _KINDS.items():
            if not isinstance(known[name], kind):
                raise TypeError(f"'{name}' is {known[name]!r}")
        metric = Metric(**known["metric"]) if known["metric"] else None
        if metric is not None:
            _check_metric(metric)
        return About(**known | {"metric": metric})
    except (KeyError, TypeError) as error:
        raise InputError(place, f"'{MANIFEST}' lacks a field ({error})", _REMEDY) from None


def _check_metric(metric: Metric) -> None:
    """Raise `TypeError` for values that are no figures."""
    interval = [metric.low, metric.high]
    figures = [metric.value, *interval] if interval != [None, None] else [metric.value]
    if not all(isinstance(each, int | float) for each in figures):
        raise TypeError(f"'metric' is {metric!r}")


def _content(place: Path, name: str, most: int) -> bytes:
    """The bytes of a file, which must not be more than `most`."""
    try:
        if place.is_dir():
            with (place / name).open("rb") as file:
                content = file.read(most + 1)
        else:
            with zipfile.ZipFile(place) as archive, archive.open(name) as file:
                content = file.read(most + 1)
    except (FileNotFoundError, KeyError):
        raise InputError(place, f"'{name}' is missing", _REMEDY) from None
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise InputError(place, f"'{name}' cannot be read ({error})", _REMEDY) from None
    if len(content) > most:
        raise InputError(place, f"'{name}' is larger than its manifest says", _REMEDY)
    return content
