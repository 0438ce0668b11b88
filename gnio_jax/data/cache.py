"""Sequences that are slow to make (parsing text, aligning clocks) are kept as HDF5 beside the
user's other caches.

The folder is $GNIO_CACHE, else $XDG_CACHE_HOME/gnio-jax, else ~/.cache/gnio-jax; it may be deleted
at any time.
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

_NOTES, _COUNT = "warnings of the loader", "number of sequences"
"""Attributes in the cache alone."""


class Refusal(InputError):
    """A recording that a loader has looked at and cannot use (ruined clock, implausible reference):
    worth remembering."""

    def __init__(self, where: object, problem: str, remedy: str = ""):
        super().__init__(where, problem, remedy)
        self.parts = (str(where), problem, remedy)


def folder() -> Path:
    """Where the cache lies; it need not exist."""
    if chosen := os.environ.get("GNIO_CACHE"):
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "gnio-jax"


def cached(
    sources: Iterable[str | os.PathLike[str]], version: str, build: Callable[[], Sequence]
) -> Sequence:
    """`cached_pieces` of a recording that is one sequence."""
    return cached_pieces(sources, version, lambda: [build()])[0]


def cached_pieces(
    sources: Iterable[str | os.PathLike[str]], version: str, build: Callable[[], list[Sequence]]
) -> list[Sequence]:
    """The sequences that `build` makes of the files `sources`, made only once per state of these
    files: one or more.

    The key is each file's absolute path, size and modification time, and `version`, which the
    loader changes whenever it would make other sequences of the same files (name it after the
    loader and its options: "oxiod 3"). What `build` warns of is kept and said again. A `Refusal`
    that `build` raises is kept, too, and raised again; any other exception is not. A damaged entry
    is made anew, and where nothing can be written the sequences are just made every time. Raises
    `InputError` when a source is missing.
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
    refused = folder() / f"{key}.refused.json"

    try:
        if _entry(key, 0).is_file():
            first = read_hdf5(_entry(key, 0))
            rest = range(1, int(first.attributes[_COUNT]))
            return _said_again([first, *(read_hdf5(_entry(key, piece)) for piece in rest)])
        if refused.is_file():
            where, problem, remedy = json.loads(refused.read_text(encoding="utf-8"))
            raise Refusal(where, problem, remedy)
    except Refusal:
        raise
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
    ):  # InputError is a ValueError: a damaged entry
        pass

    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            sequences = build()
    except Refusal as refusal:
        try:
            with replacing(refused) as temporary:
                temporary.write_text(json.dumps(refusal.parts), encoding="utf-8")
        except OSError:
            pass
        raise
    finally:
        for warning in caught:
            warnings.warn_explicit(
                warning.message, warning.category, warning.filename, warning.lineno
            )
    notes = [str(warning.message) for warning in caught if warning.category is UserWarning]
    about = {_COUNT: len(sequences), _NOTES: json.dumps(notes)}
    try:
        # The first is written last: while it is absent there is no entry.
        for piece, sequence in reversed(list(enumerate(sequences))):
            write_hdf5(
                _entry(key, piece), sequence._replace(attributes=sequence.attributes | about)
            )
    except OSError:
        pass
    return sequences


def _entry(key: str, piece: int) -> Path:
    return folder() / f"{key}.{piece}.h5"


def _said_again(sequences: list[Sequence]) -> list[Sequence]:
    """Without the attributes that are the cache's own; the warnings among them are given."""
    for note in json.loads(sequences[0].attributes[_NOTES]):
        warnings.warn(note, stacklevel=4)
    return [
        sequence._replace(
            attributes={
                name: value
                for name, value in sequence.attributes.items()
                if name not in (_NOTES, _COUNT)
            }
        )
        for sequence in sequences
    ]
