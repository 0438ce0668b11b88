"""TLIO's "golden" set: head-mounted IMU with visual-inertial truth (Liu et al., RA-L 2020).

Layout: <root>/{train,val,test}_list.txt with one folder name per line;
<root>/<name>/imu0_resampled.npy, float64 (N, 17) at 200 Hz, whose columns
imu0_resampled_description.json names. Its gyro and accel are given in the world; the body frame is
Rᵀ of them. They were compensated with the biases of the reference system, which is kinder than any
filter will find it in the field: `imu_compensated` among the attributes says so.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.readers.parsing import parsed_as
from gnio_jax.data.readers.text import listed
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import (
    check_finite,
    check_gaps,
    check_increasing,
    check_motion,
    check_rate,
    check_unit_norm,
    validate,
)
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations, wxyz_from_xyzw
from gnio_jax.types import Sequence

RATE = 200.0
_TABLE = "imu0_resampled.npy"
_DESCRIPTION = "imu0_resampled_description.json"
_LISTS = {"train": "train_list.txt", "val": "val_list.txt", "test": "test_list.txt"}
_STAMPS, _ORIENTATION = "ts_us", "qxyzw_World_Device"
_GYRO, _ACCEL = "gyr_compensated_rotated_in_World", "acc_compensated_rotated_in_World"
_POSITION, _VELOCITY = "pos_World_Device", "vel_World"
_WIDTHS = {_STAMPS: 1, _GYRO: 3, _ACCEL: 3, _ORIENTATION: 4, _POSITION: 3, _VELOCITY: 3}
"""Width of each column that is read."""


def recordings(root: Path, split: str) -> list[Recording]:
    """The recordings of a split's list that are present."""
    return [single(folder.name, read_sequence, folder) for folder in _listed(Path(root), split)]


def read_sequence(folder: str | os.PathLike[str]) -> Sequence:
    """One sequence of its folder. Raises `InputError` naming file and field."""
    folder = Path(folder)
    path = folder / _TABLE
    columns, width = _columns(folder / _DESCRIPTION)
    table = _table(path, width)
    fields = {name: table[:, columns[name]] for name in _WIDTHS}
    time = fields[_STAMPS][:, 0] * 1e-6
    quaternion = wxyz_from_xyzw(fields[_ORIENTATION])
    rate, force = fields[_GYRO], fields[_ACCEL]
    # The table's own fields first: behind the rotation into the body a mistake would carry another
    # name.
    for name in (_STAMPS, _ORIENTATION, _GYRO, _ACCEL):
        check_finite(fields[name], name, path)
    check_increasing(time, path)
    check_rate(time, RATE, path)
    check_gaps(time, path)
    everywhere = np.ones(len(time), dtype=bool)
    quaternion = check_unit_norm(quaternion, everywhere, _ORIENTATION, path)
    body = rotations(quaternion).inv()
    sequence = Sequence(
        name=folder.name,
        time=time,
        gyro=body.apply(rate),
        accel=body.apply(force),
        orientation=quaternion,
        position=fields[_POSITION],
        velocity=fields[_VELOCITY],
        valid=everywhere,
        attributes={
            "dataset": "tlio",
            "group": folder.name,
            "placement": "head",
            "truth": "visual-inertial (VIO or motion capture)",
            "imu_compensated": "reference",
            "licence": DATASET.licence,
        },
    )
    sequence = validate(sequence, path)
    check_motion(sequence, path)
    return resample(sequence, RATE)  # changes nothing but where rows are missing


def _listed(root: Path, split: str) -> list[Path]:
    return listed(
        root / _LISTS[split],
        lambda entry: root / entry if (root / entry / _TABLE).is_file() else None,
        root,
        DATASET.layout,
    )


def _columns(path: Path) -> tuple[dict[str, slice], int]:
    """Columns of the table by name, and its width: the description lists them in their order."""
    columns, start = {}, 0
    for entry, name, width in _entries(path):
        if name is None:
            raise InputError(
                path,
                f"field 'columns_name(width)' has the entry {entry!r}",
                'entries look like "ts_us(1)"',
            )
        columns[name] = slice(start, start + width)
        start += width
    for name, expected in _WIDTHS.items():
        if name not in columns:
            raise InputError(path, f"column '{name}' is missing", f"found: {', '.join(columns)}")
        width = columns[name].stop - columns[name].start
        if width != expected:
            raise InputError(path, f"column '{name}' has width {width}, expected {expected}")
    return columns, start


def _entries(path: Path) -> list[tuple[str, str | None, int]]:
    """(entry, name, width) of each entry of the description, None and 0 where it is not of that
    form."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))["columns_name(width)"]
        parsed = [re.fullmatch(r"\s*(.+?)\s*\((\d+)\)\s*", entry) for entry in entries]
    except OSError as error:
        raise InputError(
            path,
            f"cannot be read ({error.strerror})",
            "it names the columns of the table beside it",
        ) from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            path,
            f"field 'columns_name(width)' cannot be read ({type(error).__name__}: {error})",
            'it lists entries like "ts_us(1)"',
        ) from None
    return [
        (entry, match[1], int(match[2])) if match else (entry, None, 0)
        for entry, match in zip(entries, parsed, strict=True)
    ]


def _table(path: Path, width: int) -> Float[np.ndarray, "n w"]:
    with parsed_as(path, "a NumPy array"):
        table = np.load(path, allow_pickle=False)
    if table.ndim != 2 or table.shape[1] != width or table.dtype.kind != "f" or len(table) < 2:
        raise InputError(
            path,
            f"holds {table.dtype} of shape {table.shape}, expected floats (N, {width})",
            f"see {_DESCRIPTION} beside it",
        )
    return table.astype(np.float64)


DATASET = Dataset(
    name="tlio",
    recordings=recordings,
    splits=tuple(_LISTS),
    rate=RATE,
    source="https://github.com/CathIAS/TLIO (its README links the data)",
    layout="<root>/{train,val,test}_list.txt and "
    "<root>/<sequence>/{imu0_resampled.npy,imu0_resampled_description.json}",
    licence="CC BY-NC 4.0",
)
