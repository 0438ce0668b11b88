"""Sequences that are slow to make (parsing text, aligning clocks) are kept as HDF5 beside the
user's other caches.

The folder is $GNIO_CACHE, else $XDG_CACHE_HOME/gnio-jax, else ~/.cache/gnio-jax; it may be deleted
at any time.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path

from gnio_jax.data.dataset import Refusal
from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.errors import InputError
from gnio_jax.files import replacing
from gnio_jax.types import Sequence

_NOTES, _COUNT = "warnings of the loader", "number of sequences"
"""Attributes in the cache alone."""


def folder() -> Path:
    """Where the cache lies; it need not exist."""
    if chosen := os.environ.get("GNIO_CACHE"):
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "gnio-jax"


def cached(
    files: Iterable[str | os.PathLike[str]], version: str, build: Callable[[], list[Sequence]]
) -> list[Sequence]:
    """The sequences, one or more, that `build` makes of `files`: made once per state of the files.

    The key is each file's absolute path, size and modification time, and `version`, which the
    reader changes whenever it would make other sequences of the same files (name it after the
    reader and its options: "oxiod 3"). What `build` warns of is kept and said again. A `Refusal`
    that `build` raises is kept, too, and raised again; any other exception is not. A damaged entry
    is made anew, and where nothing can be written the sequences are just made every time. Raises
    `InputError` when a file is missing.
    """
    key = _key(files, version)
    if (kept := _read_sequences(key)) is not None:
        return kept
    if (refusal := _read_refusal(key)) is not None:
        raise refusal
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            sequences = build()
    except Refusal as found:
        _write_refusal(key, found)
        raise
    finally:
        for warning in caught:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    notes = [str(warning.message) for warning in caught if warning.category is UserWarning]
    _write_sequences(key, sequences, notes)
    return sequences


def is_cached(files: Iterable[str | os.PathLike[str]], version: str) -> bool:
    """True if `cached` would find sequences."""
    return _entry(_key(files, version), 0).is_file()


def is_refused(files: Iterable[str | os.PathLike[str]], version: str) -> bool:
    """True if `cached` would find a refusal."""
    return _refused(_key(files, version)).is_file()


def _key(files: Iterable[str | os.PathLike[str]], version: str) -> str:
    states = []
    for file in files:
        path = Path(file).absolute()
        try:
            status = path.stat()
        except OSError as error:
            raise InputError(path, f"cannot be read ({error.strerror})") from None
        states.append([str(path), status.st_size, status.st_mtime_ns])
    return hashlib.sha256(json.dumps([version, states]).encode()).hexdigest()[:32]


def _entry(key: str, piece: int) -> Path:
    return folder() / f"{key}.{piece}.h5"


def _refused(key: str) -> Path:
    return folder() / f"{key}.refused.json"


def _read_sequences(key: str) -> list[Sequence] | None:
    """The kept sequences, their warnings given again; None where there is no sound entry."""
    if not _entry(key, 0).is_file():
        return None
    try:
        first = read_hdf5(_entry(key, 0))
        rest = range(1, int(first.attributes[_COUNT]))
        sequences = [first, *(read_hdf5(_entry(key, piece)) for piece in rest)]
        notes = [str(note) for note in json.loads(first.attributes[_NOTES])]
    except (OSError, ValueError, TypeError, KeyError):  # InputError is a ValueError
        return None
    for note in notes:
        warnings.warn(note, stacklevel=3)
    return [_without_own_attributes(sequence) for sequence in sequences]


def _without_own_attributes(sequence: Sequence) -> Sequence:
    own = (_NOTES, _COUNT)
    kept = {name: value for name, value in sequence.attributes.items() if name not in own}
    return sequence._replace(attributes=kept)


def _read_refusal(key: str) -> Refusal | None:
    try:
        where, problem, remedy = json.loads(_refused(key).read_text(encoding="utf-8"))
        return Refusal(where, problem, remedy)
    except (OSError, ValueError, TypeError):
        return None


def _write_sequences(key: str, sequences: list[Sequence], notes: list[str]) -> None:
    about = {_COUNT: len(sequences), _NOTES: json.dumps(notes)}
    with contextlib.suppress(OSError):
        # The first is written last: while it is absent there is no entry.
        for piece, sequence in reversed(list(enumerate(sequences))):
            attributes = sequence.attributes | about
            write_hdf5(_entry(key, piece), sequence._replace(attributes=attributes))


def _write_refusal(key: str, refusal: Refusal) -> None:
    with contextlib.suppress(OSError), replacing(_refused(key)) as temporary:
        temporary.write_text(json.dumps(refusal.parts), encoding="utf-8")
