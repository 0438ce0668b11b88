"""Your own recordings: a folder of CSV files or of the package's HDF5 files.

A CSV has a header that names, in any order, `time` s, `gyro_x..z` rad/s, `accel_x..z` m/s²
(specific force), and optionally a reference: `qw..qz` (body→world), `px..pz` m, `vx..vz` m/s in a
z-up world; other columns are ignored. Any rate is allowed. Without a reference the sequence has NaN
there and `valid` is False; velocities that are not given are those of the smoothed positions. The
reference may be empty in some rows: gaps up to 0.1 s, or 2.5 usual intervals between poses if that
is longer, are bridged, and longer ones are not valid.

`gnio data import` brings the files of a phone's logger into this form.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.hdf5 import read_hdf5
from gnio_jax.data.labels import ACCEL, GYRO, REFERENCE, guess_label
from gnio_jax.data.parsing.stamps import check_seconds, rounded_rate
from gnio_jax.data.parsing.tables import Table, read_text, shorten
from gnio_jax.data.resampling import resample
from gnio_jax.data.splits import read_list
from gnio_jax.data.validation import check_gaps, check_increasing
from gnio_jax.errors import InputError
from gnio_jax.files import HDF5, file_in
from gnio_jax.numerics import finite_rows, quaternions
from gnio_jax.types import Sequence

SPLITS = ("train", "val", "test")
_FILES = (".csv", *HDF5)


# --- which recordings there are


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The recordings of a split, in the order of their names: those that <root>/<split>.txt lists,
    or all as `test` if there is no list.

    Raises `InputError` if two files would have the same name.
    """
    if split not in SPLITS and not _is_list(file_in(root, f"{split}.txt")):
        remedy = f"known splits: {', '.join(SPLITS)}, or that of a list {split}.txt there"
        raise InputError(root, f"unknown split '{split}'", remedy)
    layout = f"expected layout: {DATASET.layout}"
    if split not in SPLITS or any(file_in(root, f"{name}.txt").is_file() for name in SPLITS):
        paths = read_list(root / f"{split}.txt", partial(_find, root), root, DATASET.layout)
    else:
        paths = files_of(root)
        if paths and split != "test":
            remedy = f"without lists every recording is in split 'test'; {layout}"
            raise InputError(root, f"has no list {split}.txt", remedy)
    named: dict[str, Path] = {}
    for path in paths:
        if (other := named.setdefault(path.stem, path)) != path:
            raise InputError(path, f"has the name of {other}", "rename or remove one of them")
    return [
        RecordingSource(name, partial(read, path), (path,)) for name, path in sorted(named.items())
    ]


def files_of(root: Path) -> list[Path]:
    """The recordings in a folder without lists."""
    files = (path for path in root.glob("[!.]*") if path.suffix.lower() in _FILES)
    return sorted(path for path in files if path.is_file())


def list_splits(root: Path) -> tuple[str, ...]:
    """The splits that the lists <root>/<split>.txt define; only `test` if there is none. A text
    file with another name that lists no existing recording is not a list."""
    texts = (path for path in root.iterdir() if path.suffix.lower() == ".txt")
    lists = {path.stem.lower() for path in texts if _is_list(path)}
    usual = [split for split in SPLITS if split in lists]
    return (*usual, *sorted(lists - set(SPLITS))) or ("test",)


def _is_list(path: Path) -> bool:
    name = path.stem.lower()
    if name in SPLITS or not re.fullmatch("[a-z][a-z0-9_]*", name):
        return name in SPLITS
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        return any(_find(path.parent, line.strip()) for line in lines if line.strip())
    except (OSError, UnicodeDecodeError):
        return False


def _find(root: Path, entry: str) -> Path | None:
    """The file of a list's entry, which may be without the suffix."""
    candidates = [file_in(root, f"{entry}{suffix}") for suffix in ("", *_FILES)]
    files = (path for path in candidates if path.suffix.lower() in _FILES and path.is_file())
    return next(files, None)


# --- how one is read


def read(path: Path) -> list[Sequence]:
    """Read a recording, on a uniform clock of its own rate, named after its file. Raises
    `InputError` naming file and field."""
    if path.suffix.lower() not in HDF5:
        return assemble(_streams(read_text(path)), whole=True)
    sequence = read_hdf5(path)._replace(name=path.stem)
    check_seconds(sequence.time, path)
    check_gaps(sequence.time, path)
    return [resample(sequence, rounded_rate(sequence.time))]


def _streams(table: Table) -> Streams:
    path, attitude = table.path, REFERENCE["orientation"]
    expected = {name: name for name in ("time", *GYRO, *ACCEL)}
    remedy = f"name them: gnio data import {path.name} --out own/{path.stem}.h5 --columns"
    check_columns(path, table.columns, expected, remedy)
    time = table.take("time")
    check_increasing(time, path, table.row)
    poses, device = reference(table, time), None
    if poses is None and attitude[0] in table.columns:
        present = finite_rows(table.take(*attitude, gaps=True))
        if present.any():  # an attitude alone is no reference: it is the device's own
            quaternion = quaternions(table.rotations(*attitude, rows=present))
            device = Samples(time[present], quaternion, str(path))
    attributes = {"group": path.stem, "truth": "given" if poses else "none"}
    streams = Streams.of_imu(path.stem, path, time, table.take(*GYRO), table.take(*ACCEL))
    return streams._replace(attributes=attributes, poses=poses, device=device)


def reference(table: Table, time: Float[np.ndarray, " n"]) -> Poses | None:
    """The poses in a table's columns `REFERENCE`, at the stamps `time` (s) of its rows; None if it
    has none. A field of the reference must have all its columns, or none."""
    fields = {}
    for field, columns in REFERENCE.items():
        named = [name for name in columns if name in table.columns]
        if named:
            for name in columns:
                if name not in table.columns:
                    problem = f"column '{name}' is missing while '{named[0]}' is there"
                    remedy = f"the {field} of a reference has {', '.join(columns)}"
                    raise InputError(table.path, problem, remedy)
            fields[field] = table.take(*columns, gaps=True)
    present = np.all([finite_rows(values) for values in fields.values()] or [[False]], axis=0)
    if not {"orientation", "position"} <= fields.keys() or not present.any():
        return None
    return Poses(
        time[present],
        table.rotations(*REFERENCE["orientation"], rows=present),
        fields["position"][present],
        fields["velocity"][present] if "velocity" in fields else None,
        source=str(table.path),
    )


def check_columns(
    path: Path, columns: Iterable[object], expected: Mapping[str, str], remedy: str
) -> None:
    """Raise `InputError` if a file lacks columns; `expected` has our names and the file's. The
    message has all missing columns, and after `remedy` the words that name them."""
    names = [str(name) for name in columns]
    missing = [field for field, column in expected.items() if column not in names]
    if missing:
        lacking = ", ".join(f"'{expected[field]}'" for field in missing)
        are = "columns {} are" if len(missing) > 1 else "column {} is"
        words = " ".join(f"{field}={guess_label(field, names)}" for field in missing)
        problem = f"{are.format(lacking)} missing; found: {shorten(', '.join(names), 600)}"
        raise InputError(path, problem, f"{remedy} {words}")


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
