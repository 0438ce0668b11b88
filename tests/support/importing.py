"""`import_recording` with what the recording does not say given by name."""

from gnio_jax.config import ImportOptions
from gnio_jax.data import importing


def import_recording(path, columns=None, rate=None, name=None, **stated):
    """`columns`: from our names to the file's; `stated`: the other fields of `ImportOptions`."""
    words = tuple(f"{ours}={theirs}" for ours, theirs in (columns or {}).items())
    options = ImportOptions(columns=words, **stated)
    return importing.import_recording(path, options, rate=rate, name=name)
