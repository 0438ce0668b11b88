"""What the recordings of a split hold: digests of their files, by which figures can be seen to be
of these recordings and not of others in the same place."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gnio_jax.data.dataset import RecordingSource
from gnio_jax.data.loading import find_split
from gnio_jax.data.registry import names
from gnio_jax.errors import InputError

STATE, CONTENT = "files", "sha256"
"""Names of the digests of a recording: of the names, sizes and modification times of its files,
and of their names and bytes."""


def describe_contents(
    name: str, root: str | os.PathLike[str] | None, split: str
) -> dict[str, dict[str, str]]:
    """Recording → its digests `STATE` and `CONTENT`, for every recording of the split, whether it
    can be used or not. It is empty for a dataset that is computed."""
    folder, sources = _find_sources(name, root, split)
    return {
        source.name: {STATE: _state(source, folder), CONTENT: _content(source, folder)}
        for source in sources
    }


def find_change(
    name: str, root: str | os.PathLike[str] | None, split: str, contents: Mapping[str, Any]
) -> str:
    """The reason why the recordings of a split are not those of `contents`, which
    `describe_contents` gave; empty if they are, and if that cannot be seen, because their folder or
    the reader of the dataset is not here.

    Bytes are only read where a size or a time has changed.
    """
    if not contents or root is None or not Path(root).is_dir() or name not in names():
        return ""
    try:
        folder, sources = _find_sources(name, root, split)
    except InputError as error:
        return f"its recordings are gone ({error})"
    present = {source.name for source in sources}
    for other in sorted(present ^ contents.keys()):
        return f"recording {other} is {'new' if other in present else 'gone'} in {folder}"
    for source in sources:
        digests = contents[source.name]
        if digests[STATE] != _state(source, folder) and digests[CONTENT] != _content(
            source, folder
        ):
            return f"recording {source.name} in {folder} has changed since"
    return ""


def _find_sources(
    name: str, root: str | os.PathLike[str] | None, split: str
) -> tuple[Path, list[RecordingSource]]:
    dataset, folder, whole = find_split(name, root, split)
    if not dataset.needs_root:
        return folder, []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the loader gives them
        return folder, dataset.recordings(folder, whole)


def _files(source: RecordingSource) -> list[Path]:
    """The files of all forms of a recording; a folder stands for all that is in it."""
    files: list[Path] = []
    form: RecordingSource | None = source
    while form is not None:
        for path in form.files:
            inside = path.rglob("*") if path.is_dir() else [path]
            files += [file for file in inside if file.is_file()]
        form = form.fallback
    return sorted(set(files))


def _state(source: RecordingSource, folder: Path) -> str:
    states = [(path, path.stat()) for path in _files(source)]
    rows = [
        f"{os.path.relpath(path, folder)}\0{stat.st_size}\0{stat.st_mtime_ns}"
        for path, stat in states
    ]
    return _digest("\n".join(rows).encode("utf-8", "surrogateescape"))


def _content(source: RecordingSource, folder: Path) -> str:
    rows = []
    for path in _files(source):
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        rows.append(f"{os.path.relpath(path, folder)}\0{digest}")
    return _digest("\n".join(rows).encode("utf-8", "surrogateescape"))


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]
