"""`import_recording` with what the recording does not say given by name."""

from typing import NamedTuple

from gnio_jax.apps import importing
from gnio_jax.config import ImportOptions
from gnio_jax.types import Sequence


class Found(NamedTuple):
    """An `Imported` but for its warnings."""

    sequence: Sequence
    notes: tuple[str, ...]


def import_recording(path, columns=None, rate=None, name=None, **stated):
    """`columns`: from our names to the file's; `stated`: the other fields of `ImportOptions`."""
    return Found(*imported(path, columns, rate, name, **stated)[:2])


def imported(path, columns=None, rate=None, name=None, **stated):
    """With its warnings."""
    words = tuple(f"{ours}={theirs}" for ours, theirs in (columns or {}).items())
    options = ImportOptions(columns=words, **stated)
    return importing.import_recording(path, options, rate=rate, name=name)
