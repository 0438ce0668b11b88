"""Every dataset as a list of `Sequence`: `load(name, root, split)`, `names()`."""

from gnio_jax.data.registry import find_root, get, load, names
from gnio_jax.data.sequence import (
    Dataset,
    SelfCheck,
    read_hdf5,
    resample,
    self_check,
    validate,
    write_hdf5,
)
from gnio_jax.types import Sequence

__all__ = [
    "Dataset",
    "SelfCheck",
    "Sequence",
    "find_root",
    "get",
    "load",
    "names",
    "read_hdf5",
    "resample",
    "self_check",
    "validate",
    "write_hdf5",
]
