"""An imported recording as HDF5, with what the import said of it."""

from __future__ import annotations

import os
from typing import NamedTuple

from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.types import Sequence

_NOTES, _WARNINGS = "import_notes", "import_warnings"
"""Attributes of the file: one note or warning a line."""


class Imported(NamedTuple):
    """What `import_recording` made of a recording."""

    sequence: Sequence
    """On a uniform clock, with a reference where the recording has one."""
    notes: tuple[str, ...]
    """What was detected, assumed or repaired, one sentence each, to be shown to the user."""
    warnings: tuple[str, ...] = ()
    """What may make everything wrong that is computed from it, one sentence each."""


def write_imported(path: str | os.PathLike[str], recording: Imported) -> None:
    """Write the sequence and its notes as `write_hdf5` does."""
    sequence = recording.sequence
    said = {_NOTES: recording.notes, _WARNINGS: recording.warnings}
    kept = {
        name: "\n".join(" ".join(line.split()) for line in lines)
        for name, lines in said.items()
        if lines
    }
    write_hdf5(path, sequence._replace(attributes=sequence.attributes | kept))


def read_imported(path: str | os.PathLike[str]) -> Imported:
    """A sequence, its notes and warnings; a file that no import wrote has neither. Raises
    `InputError` as `read_hdf5` does."""
    sequence = read_hdf5(path)
    attributes = dict(sequence.attributes)
    notes, warnings = (
        tuple(str(attributes.pop(name, "")).splitlines()) for name in (_NOTES, _WARNINGS)
    )
    return Imported(sequence._replace(attributes=attributes), notes, warnings)
