"""Sequences as HDF5, the package's own file format."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gnio_jax.data.validation import validate
from gnio_jax.errors import InputError
from gnio_jax.files import replacing
from gnio_jax.types import Sequence

_FORMAT = "gnio-jax sequence 1"
_OPTIONAL_FIELDS = ("device_orientation", "imu_valid")
_FIELDS = ("time", "gyro", "accel", "orientation", "position", "velocity", "valid")
_ATTRIBUTE_TYPES = (str, bool, int, float, np.bool_, np.integer, np.floating)


def write_hdf5(path: str | os.PathLike[str], sequence: Sequence) -> None:
    """Write `sequence` as HDF5, whole or not at all.

    One dataset per field (contiguous, so that it can be memory-mapped), `name` and `format` as
    attributes of the file, its attributes on the group `attributes`. Raises `InputError` for an
    attribute that is no text, number or boolean.
    """
    with replacing(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["format"] = _FORMAT
        file.attrs["name"] = sequence.name
        for field in _FIELDS:
            file.create_dataset(field, data=getattr(sequence, field))
        for field in _OPTIONAL_FIELDS:
            if getattr(sequence, field) is not None:
                file.create_dataset(field, data=getattr(sequence, field))
        group = file.create_group("attributes")
        for key, value in sequence.attributes.items():
            if not isinstance(value, _ATTRIBUTE_TYPES):
                raise InputError(
                    path,
                    f"attribute '{key}' is {type(value).__name__}",
                    "attributes are text, numbers or booleans",
                )
            group.attrs[key] = value


def read_hdf5(path: str | os.PathLike[str]) -> Sequence:
    """Read and validate what `write_hdf5` wrote. Raises `InputError` on a missing, cut-short or
    foreign file."""
    path = Path(path)
    try:
        with h5py.File(path, "r") as file:
            sequence = _sequence_of(file, path)
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    except InputError:
        raise
    except Exception as error:  # a damaged file makes the parser fail in any way
        raise InputError(
            path,
            f"cannot be read as HDF5, it may be cut short ({error})",
            "convert or copy it again",
        ) from None
    return validate(sequence, path)


def _sequence_of(file: h5py.File, path: Path) -> Sequence:
    if file.attrs.get("format") != _FORMAT:
        raise InputError(
            path,
            f"is not a '{_FORMAT}' file (format: {file.attrs.get('format')!r})",
            "convert the recording with gnio data convert",
        )
    values: dict[str, Any] = {}
    for field in _FIELDS:
        if field not in file:
            raise InputError(path, f"field '{field}' is missing", "convert the recording again")
        values[field] = _array(file, field, path)
    for field in _OPTIONAL_FIELDS:
        if field in file:
            values[field] = _array(file, field, path)
    stored = file["attributes"].attrs if "attributes" in file else {}
    attributes = {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in stored.items()
    }
    return Sequence(name=str(file.attrs.get("name", path.stem)), attributes=attributes, **values)


def _array(file: h5py.File, field: str, path: Path) -> np.ndarray:
    """Booleans of what is valid, float64 of every other field."""
    value: Any = file[field][()]  # pyright: ignore[reportIndexIssue]
    kind, content = ("b", "booleans") if field.endswith("valid") else ("f", "numbers")
    if not isinstance(value, np.ndarray) or value.dtype.kind != kind:
        raise InputError(
            path, f"field '{field}' is not an array of {content}", "convert the recording again"
        )
    return value if kind == "b" else value.astype(np.float64, copy=False)
