"""Files and folders that are written whole or not at all, and names of recordings in them."""

from __future__ import annotations

import csv
import errno
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

HDF5 = (".h5", ".hdf5")
"""Endings of the package's own files of recordings."""


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which it replaces on success. On failure it is removed.

    The folder is created if it is missing. A reader sees the old file or the whole new one.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        # mkstemp makes it private: give it the mode of any other new file.
        temporary.chmod(0o666 & ~umask)
        os.replace(temporary, path)
    except OSError as error:
        error.filename = error.filename or str(path)  # the error of a full disk has no name
        raise
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise `OSError` now if no file could be written at `path` later."""
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    # The name is that of `replacing`, because a name can be too long.
    _check_writable_folder(path.parent, f".{path.stem}.", path.suffix)


def check_writable_folder(folder: Path) -> None:
    """Raise `OSError` now if nothing could be written into `folder` later."""
    _check_writable_folder(folder, ".probe.", "")


def _check_writable_folder(folder: Path, prefix: str, suffix: str) -> None:
    """Write and remove a file. A missing folder is not created: its nearest parent is tried."""
    parents = (folder.absolute(), *folder.absolute().parents)
    existing = next(parent for parent in parents if parent.exists())
    try:
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=existing)
    except OSError as error:
        error.filename = str(existing)  # the user does not know the temporary file
        raise
    os.close(handle)
    Path(name).unlink()


def with_ending(path: Path, ending: str) -> Path:
    """`path` with one more ending. `Path.with_suffix` would cut a name that contains a point."""
    return path.with_name(path.name + ending)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_csv(path: str | os.PathLike[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a CSV whole or not at all."""
    with (
        replacing(path) as temporary,
        open(temporary, "w", newline="", encoding="utf-8", errors="backslashreplace") as file,
    ):
        csv.writer(file).writerows(rows)


def fingerprint(content: bytes) -> dict[str, int | str]:
    """Size and SHA-256 of a file, as manifests have them."""
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def file_stem(name: str) -> str:
    """The name of a sequence, changed to a valid name of a file."""
    return re.sub(r"[^\w.+-]+", "_", name).lstrip(".") or "_"


def file_stems(names: Iterable[str]) -> list[str]:
    """The distinct name of a file for each sequence: `file_stem`, with `_` where two are the
    same."""
    stems: list[str] = []
    for name in names:
        stem = file_stem(name)
        while stem in stems:
            stem += "_"
        stems.append(stem)
    return stems


def shown_name(name: str, length: int = 60) -> str:
    """The name of a file or a recording as text of a picture.

    Of a long name only the end is kept. A $ is escaped, because Matplotlib would read it as
    mathematics.
    """
    text = name.encode("utf-8", "backslashreplace").decode()  # a name may have any bytes
    text = text if len(text) <= length else f"…{text[1 - length :]}"
    return text.replace("$", r"\$")


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder beside `path`. On success it replaces `path`; on failure it is removed
    and `path` stays."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        new = temporary / "new"
        new.mkdir()
        yield new
        old = temporary / "old"
        if path.exists():
            path.rename(old)
        try:
            new.rename(path)
        except OSError:
            if old.exists():
                old.rename(path)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
