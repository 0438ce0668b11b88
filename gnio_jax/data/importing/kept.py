"""An imported recording as HDF5, with what the import said of it."""

from __future__ import annotations

import os
from typing import NamedTuple

from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.types import Sequence

_NOTES = "import_notes"
"""Attribute of the file: one note a line."""


class Imported(NamedTuple):
    """What `import_recording` made of a recording."""

    sequence: Sequence
    """On a uniform clock, with a reference where the recording has one."""
    notes: tuple[str, ...]
    """What was detected, assumed or repaired, one sentence each, to be shown to the user."""


def write_imported(path: str | os.PathLike[str], recording: Imported) -> None:
    """Write the sequence and its notes as `write_hdf5` does."""
    sequence = recording.sequence
    notes = "\n".join(" ".join(note.split()) for note in recording.notes)
    attributes = {**sequence.attributes, _NOTES: notes} if notes else sequence.attributes
    write_hdf5(path, sequence._replace(attributes=attributes))


def read_imported(path: str | os.PathLike[str]) -> Imported:
    """A sequence and its notes, of which a file that no import wrote has none. Raises `InputError`
    as `read_hdf5` does."""
    sequence = read_hdf5(path)
    attributes = dict(sequence.attributes)
    notes = str(attributes.pop(_NOTES, "")).splitlines()
    return Imported(sequence._replace(attributes=attributes), tuple(notes))
