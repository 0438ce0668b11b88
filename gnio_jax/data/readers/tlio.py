"""TLIO's "golden" set: head-mounted IMU with visual-inertial truth (Liu et al., RA-L 2020).

Layout: <root>/{train,val,test}_list.txt with one folder name per line;
<root>/<name>/imu0_resampled.npy, float64 (N, 17) at 200 Hz, whose columns
imu0_resampled_description.json names. Its gyro and accel are expressed in the world, and Rᵀ rotates
them into the body frame. They were compensated with the biases of the reference system, so the task
is easier than in the field; the attribute `imu_compensated` says so.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from gnio_jax.data.assembly import Poses, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.parsing.tables import json_object, read_npy, shorten
from gnio_jax.data.splits import read_list
from gnio_jax.errors import InputError
from gnio_jax.files import file_in
from gnio_jax.types import Sequence

RATE = 200.0
_TABLE = "imu0_resampled.npy"
_DESCRIPTION = "imu0_resampled_description.json"
_STAMPS, _ATTITUDE = "ts_us", "qxyzw_World_Device"
_GYRO, _ACCEL = "gyr_compensated_rotated_in_World", "acc_compensated_rotated_in_World"
_POSITION, _VELOCITY = "pos_World_Device", "vel_World"
_WIDTHS = {_STAMPS: 1, _GYRO: 3, _ACCEL: 3, _ATTITUDE: 4, _POSITION: 3, _VELOCITY: 3}
"""Width of each column that is read."""
_LISTS = {"train": "train_list.txt", "val": "val_list.txt", "test": "test_list.txt"}


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The recordings of a split's list that are present."""
    folders = read_list(
        root / _LISTS[split],
        lambda entry: root / entry if file_in(root / entry, _TABLE).is_file() else None,
        root,
        DATASET.layout,
    )
    return [
        RecordingSource(
            folder.name,
            partial(read, folder),
            (file_in(folder, _TABLE), file_in(folder, _DESCRIPTION)),
        )
        for folder in folders
    ]


def read(folder: Path) -> list[Sequence]:
    """Read the sequence of a folder. Raises `InputError` naming file and field."""
    path = file_in(folder, _TABLE)
    table = read_npy(path, *_columns(file_in(folder, _DESCRIPTION)))
    time, start, _ = table.clock(_STAMPS, "us")
    attitude = table.rotations(_ATTITUDE, width=4, scalar_first=False)
    gyro, accel, position, velocity = (
        table.take(name, width=3) for name in (_GYRO, _ACCEL, _POSITION, _VELOCITY)
    )
    gyro, accel = (attitude.inv().apply(values) for values in (gyro, accel))
    attributes = {
        "group": folder.name,
        "placement": "head",
        "truth": "visual-inertial (VIO or motion capture)",
        "imu_compensated": "reference",
    }
    poses = Poses(time, attitude, position, velocity, source=str(path))
    streams = Streams.of_imu(folder.name, path, time, gyro, accel)
    streams = streams._replace(attributes=attributes, start=start * 1e-6, poses=poses)
    return assemble(streams, RATE)


def _columns(path: Path) -> tuple[dict[str, slice], int]:
    """Columns of the table by name, and its width: the description lists them in their order."""
    field, like = "columns_name(width)", 'it lists entries like "ts_us(1)"'
    entries = json_object(path, "it names the columns of the table beside it").get(field)
    if not isinstance(entries, list):
        raise InputError(path, f"field '{field}' is no list", like)
    columns, start = {}, 0
    for entry in entries:
        match = re.fullmatch(r"\s*(.+?)\s*\((\d{1,4})\)\s*", str(entry))
        if match is None:
            raise InputError(path, f"field '{field}' has the entry '{shorten(entry)}'", like)
        columns[match[1]] = slice(start, start + int(match[2]))
        start += int(match[2])
    for name, expected in _WIDTHS.items():
        if name not in columns:
            names = shorten(", ".join(columns), 600)
            raise InputError(path, f"column '{name}' is missing", f"found: {names}")
        width = columns[name].stop - columns[name].start
        if width != expected:
            raise InputError(path, f"column '{name}' has width {width}, expected {expected}")
    return columns, start


DATASET = Dataset(
    name="tlio",
    recordings=recordings,
    splits=tuple(_LISTS),
    rate=RATE,
    # Rewritten recordings are in a folder of another name, so that they are not confused with
    # TLIO's.
    folders=("tlio", "tlio_layout"),
    source="https://github.com/CathIAS/TLIO (its README links the data)",
    layout="<root>/{train,val,test}_list.txt and "
    "<root>/<sequence>/{imu0_resampled.npy,imu0_resampled_description.json}",
    licence="CC BY-NC 4.0",
)
