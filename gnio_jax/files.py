"""Files and folders that are written whole or not at all, and names of recordings in them."""

from __future__ import annotations

import contextlib
import csv
import errno
import fcntl
import hashlib
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from gnio_jax.errors import InputError

HDF5 = (".h5", ".hdf5")
"""Endings of the package's own files of recordings."""
PART = ".gnio-"
"""Part of the name of a file or folder that is not whole yet: .walk.gnio-1a2b3c4d.h5."""


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which it replaces on success. On failure it is removed.

    The folder is created if it is missing. A reader sees the old file or the whole new one, which
    is on the disk before it replaces the old one. A link stays, and the file that it names is
    replaced. Temporary files of processes that were killed are removed. Raises `InputError` if
    `path` exists and is neither a file nor a folder: a pipe or a device would become a file.
    """
    path = _target(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)

    def create() -> tuple[str, int]:
        handle, name = tempfile.mkstemp(path.suffix, f".{path.stem}{PART}", path.parent)
        return name, handle

    temporary, handle = _create_locked(create)
    try:
        yield temporary
        os.fsync(handle)  # some file systems report an error only here
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
        os.close(handle)


def _target(path: str | os.PathLike[str]) -> Path:
    """The file that is written for `path`: the one that a link names."""
    path = Path(path)
    if path.is_symlink():
        path = Path(os.path.realpath(path))
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(path, "is a pipe or a device, not a file", "name a file")
    return path


def _create_locked(create: Callable[[], tuple[str, int]]) -> tuple[Path, int]:
    """A new temporary file or folder with its open handle. Its lock shows other processes that it
    is being written; the system removes it when this process ends, in whatever way."""
    while True:
        name, handle = create()
        with contextlib.suppress(OSError):  # some file systems have no locks
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Another process may have taken it for a leftover before it was locked.
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(handle), os.stat(name)):
                return Path(name), handle
        os.close(handle)


_LEFTOVER = re.compile(rf"\.(.+){re.escape(PART)}[a-z0-9_]{{8}}(\..*)?")


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files and folders of killed processes in a folder. Those that a process
    still writes are locked, and they stay. A folder that was moved away to be replaced is moved
    back."""
    with contextlib.suppress(OSError):
        for path in list(folder.iterdir()):
            if match := _LEFTOVER.fullmatch(path.name):
                with contextlib.suppress(OSError):
                    _remove_leftover(path, folder / match[1])


def _remove_leftover(path: Path, target: Path) -> None:
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not stat.S_ISDIR(os.fstat(handle).st_mode):
            path.unlink()
            return
        if (path / _OLD).exists() and not target.exists():
            (path / _OLD).rename(target)
        if (path / _CONTENTS).exists():
            for child in (path / _CONTENTS).iterdir():
                if not (path.parent / child.name).exists():
                    child.rename(path.parent / child.name)
        shutil.rmtree(path, ignore_errors=True)
    finally:
        os.close(handle)


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise `OSError` or `InputError` now if no file could be written at `path` later."""
    path = _target(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    # The name is that of `replacing`, because a name can be too long.
    _check_writable_folder(path.parent, f".{path.stem}{PART}", path.suffix)


def check_other_file(out: str | os.PathLike[str], recording: str | os.PathLike[str]) -> None:
    """Raise `InputError` if a result would be written over the recording that it comes from."""
    if os.path.exists(recording) and os.path.exists(out) and os.path.samefile(out, recording):
        raise InputError("--out", f"'{out}' is the recording", "name another file")


def check_writable_folder(path: Path) -> None:
    """Raise `OSError` now if no folder could be written at `path` later by `replacing_folder`."""
    path = Path(os.path.realpath(path))
    parent = path if _is_fixed(path) else path.parent
    _check_writable_folder(parent, f".{path.name}{PART}", "")


def _check_writable_folder(folder: Path, prefix: str, suffix: str) -> None:
    """Write and remove a file. A missing folder is not created: its nearest parent is tried."""
    parents = (folder.absolute(), *folder.absolute().parents)
    existing = next(parent for parent in parents if parent.exists())
    try:
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=existing)
    except FileNotFoundError:  # /proc, or a disk that was unplugged
        raise InputError(existing, "takes no files", "name another folder") from None
    except OSError as error:
        error.filename = str(existing)  # the user does not know the temporary file
        raise
    os.close(handle)
    Path(name).unlink()


def file_in(folder: Path, name: str | Path) -> Path:
    """The file `name` in a folder, or the only one there whose name differs from it in case alone,
    as systems that do not tell cases apart may have written it. If there is neither, it is the path
    of that name."""
    path = folder / name
    if path.exists():
        return path
    alike: list[str] = []
    with contextlib.suppress(OSError):
        alike = [other for other in os.listdir(path.parent) if other.lower() == path.name.lower()]
    return path.with_name(alike[0]) if len(alike) == 1 else path


def with_ending(path: Path, ending: str) -> Path:
    """`path` with one more ending. `Path.with_suffix` would cut a name that contains a point."""
    return path.with_name(path.name + ending)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file whole or not at all."""
    with replacing(path) as temporary:
        write_part(temporary, text)


def write_part(path: Path, text: str) -> None:
    """Write a text file of a folder that is not whole yet. A name in the text may have bytes that
    are no text; they are written by their escapes, which JSON reads back."""
    path.write_text(text, encoding="utf-8", errors="backslashreplace")


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


_OLD, _CONTENTS = "old", "contents"
"""Names in a temporary folder: of the folder that is replaced, and of one for its contents if it
cannot be renamed."""


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder beside `path`. On success it replaces `path`; on failure it is removed
    and `path` stays.

    The working folder and one that is mounted cannot be renamed, so their contents are replaced. If
    `path` is a link, the folder that it names is replaced. Raises `InputError` if `path` is a file.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_dir():
        raise InputError(path, "is a file", "name a folder")
    is_fixed = _is_fixed(path)
    parent = path if is_fixed else path.parent
    parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(parent)

    def create() -> tuple[str, int]:
        while True:
            name = tempfile.mkdtemp(prefix=f".{path.name}{PART}", dir=parent)
            with contextlib.suppress(FileNotFoundError):  # another process took it for a leftover
                return name, os.open(name, os.O_RDONLY)

    temporary, handle = _create_locked(create)
    try:
        new, old = temporary / "new", temporary / _OLD
        new.mkdir()
        yield new
        if is_fixed:
            _replace_contents(path, new, temporary)
            return
        _take_place(path, new, old)
    except OSError as error:
        # The user does not know the temporary folder.
        if error.errno is not None:
            error.filename = str(error.filename or path).replace(str(temporary / "new"), str(path))
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        os.close(handle)


def _take_place(path: Path, new: Path, old: Path) -> None:
    """Rename `new` to `path`, whose earlier folder becomes `old`. On failure that returns. If
    another process writes the same folder, the last one stays."""
    while True:
        if path.exists():
            shutil.rmtree(old, ignore_errors=True)
            with contextlib.suppress(FileNotFoundError):  # another process has just moved it away
                path.rename(old)
        try:
            new.rename(path)
            return
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                continue  # that of another process, which has come meanwhile
            if old.exists():
                old.rename(path)
            raise


def _is_fixed(path: Path) -> bool:
    """Whether a folder cannot be renamed, because it is mounted or contains the working folder."""
    return path.is_dir() and (os.path.ismount(path) or Path.cwd().is_relative_to(path))


def _replace_contents(path: Path, new: Path, temporary: Path) -> None:
    """Replace the contents of the folder `path` by those of `new`. On failure they are restored."""
    contents = temporary / _CONTENTS
    contents.mkdir()
    moves: list[tuple[Path, Path]] = []
    try:
        for source, target in ((path, contents), (new, path)):
            for child in [child for child in source.iterdir() if child != temporary]:
                child.rename(target / child.name)
                moves.append((child, target / child.name))
    except OSError:
        for origin, target in reversed(moves):
            target.rename(origin)
        raise
