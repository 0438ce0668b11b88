"""One's own recordings: a folder of CSV files or of the package's HDF5.

A CSV has a header that names, in any order, `time` s, `gyro_x..z` rad/s, `accel_x..z` m/s²
(specific force), and optionally a reference: `qw..qz` (body→world), `px..pz` m, `vx..vz` m/s in a
z-up world; other columns are ignored. Any rate. Without a reference the sequence holds NaN there
and `valid` is False; velocities that are not given are differenced from the positions. Rows with an
empty reference are not valid.

`gnio_jax.data.importing` brings the files of a phone's logger into this form.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.hdf5 import read_hdf5
from gnio_jax.data.parsing.stamps import check_seconds, rounded_rate
from gnio_jax.data.readers.text import numbers, read_csv
from gnio_jax.data.resampling import resample
from gnio_jax.data.splits import listed
from gnio_jax.data.validation import (
    check_finite,
    check_gaps,
    check_increasing,
    check_motion,
    validate,
)
from gnio_jax.errors import InputError
from gnio_jax.numerics import finite_rows, spans
from gnio_jax.types import Sequence

SPLITS = ("train", "val", "test")
GYRO = ("gyro_x", "gyro_y", "gyro_z")
ACCEL = ("accel_x", "accel_y", "accel_z")
REFERENCE = {
    "orientation": ("qw", "qx", "qy", "qz"),
    "position": ("px", "py", "pz"),
    "velocity": ("vx", "vy", "vz"),
}
_HDF5 = (".h5", ".hdf5")
_FILES = (".csv", *_HDF5)


# --- which recordings there are


def recordings(root: Path, split: str) -> list[Recording]:
    """The recordings of a split, in the order of their names: those that <root>/<split>.txt lists,
    or all as `test` where there is no list.

    Raises `InputError` where two files would go by the same name.
    """
    named: dict[str, Path] = {}
    for path in _files(Path(root), split):
        if named.setdefault(path.stem, path) != path:
            raise InputError(
                path, f"has the name of {named[path.stem]}", "rename or remove one of them"
            )
    return [single(name, read_recording, path) for name, path in sorted(named.items())]


def list_splits(root: Path) -> tuple[str, ...]:
    """The splits that the lists <root>/<split>.txt name; `test` alone where there is none."""
    lists = {path.stem for path in root.glob("*.txt") if re.fullmatch("[a-z][a-z0-9_]*", path.stem)}
    usual = [split for split in SPLITS if split in lists]
    return (*usual, *sorted(lists - set(SPLITS))) or ("test",)


def _files(root: Path, split: str) -> list[Path]:
    if split not in SPLITS and not (root / f"{split}.txt").is_file():
        raise InputError(
            root,
            f"unknown split '{split}'",
            f"known splits: {', '.join(SPLITS)}, or that of a list {split}.txt there",
        )
    if split not in SPLITS or any((root / f"{name}.txt").is_file() for name in SPLITS):
        return listed(root / f"{split}.txt", lambda entry: _find(root, entry), root, DATASET.layout)
    paths = sorted(
        path for path in root.glob("[!.]*") if path.suffix.lower() in _FILES and path.is_file()
    )
    if not paths:
        raise InputError(
            root, "holds no recording (*.csv, *.h5, *.hdf5)", f"expected layout: {DATASET.layout}"
        )
    if split != "test":
        raise InputError(
            root,
            f"has no list {split}.txt",
            f"without lists every recording is in split 'test'; expected layout: {DATASET.layout}",
        )
    return paths


def _find(root: Path, entry: str) -> Path | None:
    """The file of a list's entry, which may lack the suffix."""
    candidates = [root / entry, *(root / f"{entry}{suffix}" for suffix in _FILES)]
    return next(
        (path for path in candidates if path.is_file() and path.suffix.lower() in _FILES), None
    )


# --- how one is read


def read_recording(path: str | os.PathLike[str]) -> Sequence:
    """One recording, on a uniform clock of its own rate. Raises `InputError` naming file and
    field."""
    path = Path(path)
    if path.suffix.lower() in _HDF5:
        sequence = read_hdf5(path)
        check_seconds(sequence.time, path)
        check_gaps(sequence.time, path)
    else:
        sequence = validate(_read_csv(path), path)
    check_motion(sequence, path)
    return resample(sequence, rounded_rate(sequence.time))


def _read_csv(path: Path) -> Sequence:
    table = read_csv(path)
    _check_columns(table, path)
    time = numbers(table, ["time"], path)[:, 0]
    gyro, accel = numbers(table, GYRO, path), numbers(table, ACCEL, path)
    for field, values in (("time", time), ("gyro", gyro), ("accel", accel)):
        check_finite(values, field, path)
    check_increasing(time, path)
    check_seconds(time, path)
    check_gaps(time, path)
    reference = {
        field: numbers(table, columns, path)
        if columns[0] in table.columns
        else np.full((len(time), len(columns)), np.nan)
        for field, columns in REFERENCE.items()
    }
    valid = finite_rows(reference["orientation"]) & finite_rows(reference["position"])
    if "vx" not in table.columns:
        reference["velocity"] = _differenced(time, reference["position"], valid)
    valid = valid & finite_rows(reference["velocity"])
    truth = "given" if valid.any() else "none"
    return Sequence(
        name=path.stem,
        time=time,
        gyro=gyro,
        accel=accel,
        valid=valid,
        attributes={"dataset": "csv", "group": path.stem, "truth": truth},
        **reference,
    )


def _check_columns(table: pd.DataFrame, path: Path) -> None:
    """A field of the reference has all its columns, or none."""
    for field, columns in REFERENCE.items():
        present = [name for name in columns if name in table.columns]
        if present and len(present) < len(columns):
            missing = next(name for name in columns if name not in table.columns)
            raise InputError(
                path,
                f"column '{missing}' is missing while '{present[0]}' is there",
                f"the {field} of a reference has {', '.join(columns)}",
            )


def _differenced(
    time: Float[np.ndarray, " n"], position: Float[np.ndarray, "n 3"], known: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Velocities within stretches of known positions, NaN where fewer than two are in a row."""
    velocity = np.full_like(position, np.nan)
    for start, stop in spans(known):
        own, place = time[start:stop], position[start:stop]
        if len(own) >= 4:
            velocity[start:stop] = CubicSpline(own, place, axis=0)(own, 1)
        elif len(own) >= 2:
            velocity[start:stop] = np.gradient(place, own, axis=0)
    return velocity


DATASET = Dataset(
    name="csv",
    recordings=recordings,
    splits=SPLITS,
    rate=100.0,
    source="your own recordings (gnio data import brings a logger's CSV into this form)",
    layout="<root>/*.csv (time, gyro_x..z, accel_x..z[, qw..qz][, px..pz][, vx..vz]) or *.h5; "
    "optionally <root>/{train,val,test}.txt",
    licence="yours",
    pedestrian=False,
    needs_reference=False,
    list_splits=list_splits,
)
