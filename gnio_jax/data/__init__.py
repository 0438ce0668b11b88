"""Every dataset as a list of `Sequence`: `load(name, root, split)`, `names()`, `register`."""

from gnio_jax.data.contents import describe_contents, find_change
from gnio_jax.data.dataset import Dataset
from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.data.loading import DamagedRecording, load, load_each
from gnio_jax.data.registry import find_root, get, names, register
from gnio_jax.data.resampling import resample
from gnio_jax.data.self_check import SelfCheck, self_check
from gnio_jax.data.splits import Fold, folds, group, parse_fold
from gnio_jax.data.validation import validate
from gnio_jax.data.waypoints import with_poses
from gnio_jax.types import Sequence

__all__ = [
    "DamagedRecording",
    "Dataset",
    "Fold",
    "SelfCheck",
    "Sequence",
    "describe_contents",
    "find_change",
    "find_root",
    "folds",
    "get",
    "group",
    "load",
    "load_each",
    "names",
    "parse_fold",
    "read_hdf5",
    "register",
    "resample",
    "self_check",
    "validate",
    "with_poses",
    "write_hdf5",
]
