"""Sequences that are slow to make (parsing text, aligning clocks) are kept as HDF5 beside the user's other caches.

The folder is $GNIO_CACHE, else $XDG_CACHE_HOME/gnio-jax, else ~/.cache/gnio-jax; it may be deleted at any time.
"""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path

from gnio_jax.data.sequence import read_hdf5, write_hdf5
from gnio_jax.files import replacing
from gnio_jax.types import InputError, Sequence

_NOTES = "warnings of the loader"
"""The attribute, in the cache alone."""


class Refusal(InputError):
    """A recording that a loader has looked at and cannot use (ruined clock, implausible reference): worth remembering."""

    def __init__(self, where: object, problem: str, remedy: str = ""):
        super().__init__(where, problem, remedy)
        self.parts = (str(where), problem, remedy)


def folder() -> Path:
    """Where the cache lies; it need not exist."""
    if chosen := os.environ.get("GNIO_CACHE"):
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "gnio-jax"


def cached(sources: Iterable[str | os.PathLike[str]], version: str, build: Callable[[], Sequence]) -> Sequence:
    """The sequence that `build` makes of the files `sources`, made only once per state of these files.

    The key is each file's absolute path, size and modification time, and `version`, which the loader changes whenever it
    would make another sequence of the same files (name it after the loader and its options: "oxiod 3"). What `build` warns of
    is kept and said again. A `Refusal` that `build` raises is kept, too, and raised again; any other exception is not. A damaged
    entry is made anew, and where nothing can be written the sequence is just made every time. Raises `InputError` when a source is
    missing.
    """
    states = []
    for source in sources:
        path = Path(source).absolute()
        try:
            status = path.stat()
        except OSError as error:
            raise InputError(path, f"cannot be read ({error.strerror})") from None
        states.append([str(path), status.st_size, status.st_mtime_ns])
    key = hashlib.sha256(json.dumps([version, states]).encode()).hexdigest()[:32]
    entry, refused = folder() / f"{key}.h5", folder() / f"{key}.refused.json"

    try:
        if entry.is_file():
            return _said_again(read_hdf5(entry))
        if refused.is_file():
            where, problem, remedy = json.loads(refused.read_text(encoding="utf-8"))
            raise Refusal(where, problem, remedy)
    except Refusal:
        raise
    except (OSError, ValueError, TypeError):  # InputError is a ValueError: a damaged entry
        pass

    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            sequence = build()
    except Refusal as refusal:
        try:
            with replacing(refused) as temporary:
                temporary.write_text(json.dumps(refusal.parts), encoding="utf-8")
        except OSError:
            pass
        raise
    finally:
        for warning in caught:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    notes = [str(warning.message) for warning in caught if warning.category is UserWarning]
    try:
        write_hdf5(entry, sequence._replace(attributes=sequence.attributes | ({_NOTES: json.dumps(notes)} if notes else {})))
    except OSError:
        pass
    return sequence


def _said_again(sequence: Sequence) -> Sequence:
    """Without the attribute that keeps the warnings, which are given."""
    for note in json.loads(sequence.attributes.get(_NOTES, "[]")):
        warnings.warn(note, stacklevel=3)
    return sequence._replace(attributes={name: value for name, value in sequence.attributes.items() if name != _NOTES})
