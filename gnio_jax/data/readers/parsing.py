"""Parts of published files that are no text tables: JSON, HDF5, NumPy's formats, quaternions."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.parsing.tables import shortened
from gnio_jax.data.validation import check_unit_norm
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations


@contextmanager
def parsed_as(path: Path, kind: str) -> Iterator[None]:
    """Whatever a parser raises within is an `InputError`: a damaged file makes it fail in any
    way."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            path,
            f"cannot be read as {kind}, it may be cut short ({shortened(error, 200)})",
            "copy it again",
        ) from None


def json_object(path: Path, remedy: str = "copy it again") -> dict[str, Any]:
    """The object that a JSON file holds; `remedy` is what to do where it cannot be opened."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", remedy) from None
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is no JSON ({error})", "copy it again") from None
    if not isinstance(content, dict):
        raise InputError(path, "is no JSON object", "copy it again")
    return content


def float_columns(
    file: Mapping[str, Any], widths: Mapping[str, int | None], path: Path
) -> dict[str, Float[np.ndarray, "n ..."]]:
    """The arrays of an open file that `widths` names, in float64.

    The first has the width None: it holds the stamps. All have its number of rows, at least two.
    """
    fields: dict[str, np.ndarray] = {}
    for name, width in widths.items():
        if name not in file:
            raise InputError(path, f"field '{name}' is missing", f"found: {', '.join(file)}")
        value = np.asarray(file[name])
        rows = len(next(iter(fields.values()))) if fields else value.size
        wanted = (rows,) if width is None else (rows, width)
        if value.dtype.kind != "f" or value.shape != wanted or rows < 2:
            raise InputError(
                path,
                f"field '{name}' is {value.dtype} of shape {value.shape}, expected floats {wanted}",
            )
        fields[name] = value.astype(np.float64)
    return fields


def unit_rotations(wxyz: Float[np.ndarray, "n 4"], field: str, path: Path) -> Rotation:
    """Rotations of quaternions all of which must have unit length (`check_unit_norm`)."""
    return rotations(check_unit_norm(wxyz, np.ones(len(wxyz), dtype=bool), field, path))
