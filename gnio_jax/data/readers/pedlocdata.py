"""PedLocData: 98.6 hours of 27 people with phones, cut into slices (Zenodo 18149105, CC BY 4.0).

Layout: HDF5 files (`*.h5`, `*.hdf5`) with groups {train,valid,test}/<slice>/{ts,acc,gyr,pos,qua}:
stamps, specific force (m/s²), angular rate (rad/s), position (m), and the quaternion device → world
(wxyz). The unit of the stamps is the one with which they have the rate of an IMU.

The authors' groups put slices of one recording into several splits, so a network would be tested
on walks that it has seen. Here a slice belongs to the recording that its name begins with: the name
without its last number. Whole recordings are drawn for validation and test by a hash of this name,
so the splits are the same in every copy. A tenth of the slices have a reference that contradicts
their gyro; the self-check leaves them out.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import h5py
import numpy as np

from gnio_jax.data.assembly import Poses, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.parsing.stamps import seconds_of, time_unit
from gnio_jax.data.parsing.tables import (
    damage_error,
    hdf5_node,
    parsing_as,
    read_hdf5_fields,
    shorten,
)
from gnio_jax.data.splits import draw_share
from gnio_jax.data.validation import FASTEST_WALKER
from gnio_jax.errors import InputError
from gnio_jax.types import Sequence

GROUPS = ("train", "valid", "test")
"""The authors' groups, whose slices of one recording are mixed."""
STAMP, ACCEL, GYRO, POSITION, ATTITUDE = FIELDS = ("ts", "acc", "gyr", "pos", "qua")
SEED, SHARES = "pedlocdata", {"test": 0.15, "val": 0.3, "train": 1.0}
"""Seed of the draw of recordings, and where each split ends (ours)."""
WEIGHT_RANGE = (5.0, 20.0)
"""Plausible median length of the specific force of a carried phone, m/s²."""


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The slices of the recordings that are drawn for a split. Raises `InputError` if the files
    have slices, but none of this split."""
    paths = [
        path
        for depth in ("", "*/", "*/*/")
        for path in sorted(root.glob(f"{depth}*"))
        if path.suffix.lower() in (".h5", ".hdf5")
    ]
    slices = [slice_ for path in paths for slice_ in find_slices(path)]
    chosen = [slice_ for slice_ in slices if split_of(slice_.attributes["group"]) == split]
    if slices and not chosen:
        names = {slice_.attributes["group"] for slice_ in slices}
        problem = f"none of its {len(names)} recordings is drawn for the split '{split}'"
        raise InputError(root, problem, "complete the data, or choose another split")
    return chosen


def find_slices(path: Path) -> list[RecordingSource]:
    """The slices of a file, in the order of their names."""
    slices = []
    with parsing_as(path, "HDF5"), h5py.File(path, "r") as file:
        for group in GROUPS:
            node = hdf5_node(file, group, path)
            if node is not None and not isinstance(node, h5py.Group):
                raise damage_error(path, f"'{group}' is no group of slices")
            for name in sorted(map(_text, node or ())):
                recording = recording_of(name)
                attributes = {"group": recording, "subject": recording}
                where = f"{group}/{name}"
                slices.append(
                    RecordingSource(
                        shorten(f"{group}_{name}"),
                        partial(read, path, where),
                        (path,),
                        attributes=attributes,
                    )
                )
    return slices


def _text(name: str | bytes) -> str:
    """The name of a slice as text; one that is not UTF-8 has bytes as \\xNN."""
    return name if isinstance(name, str) else name.decode(errors="backslashreplace")


def recording_of(name: str) -> str:
    """The recording of a slice: its name without the last number and what joins them."""
    return re.sub(r"[\W_]*\d+$", "", name) or name


def split_of(recording: str) -> str:
    """The split for which a recording is drawn."""
    share = draw_share(SEED, recording)
    return next(split for split, end in SHARES.items() if share < end)


def read(path: Path, where: str) -> list[Sequence]:
    """Read the slice of the group `where` ("train/<name>"), in pieces between gaps longer than a
    window. Raises `InputError` naming file and field."""
    table = read_hdf5_fields(path, [f"{where}/{field}" for field in FIELDS])
    unit, rate = time_unit(table.stamps(f"{where}/{STAMP}"))
    if unit is None:
        problem = f"field '{where}/{STAMP}' runs at {rate:.4g} samples per unit"
        raise damage_error(path, f"{problem}, which is no rate of an IMU in s, ms, us or ns")
    time, start, _ = table.clock(f"{where}/{STAMP}", unit)
    gyro, accel, position = (
        table.take(f"{where}/{field}", width=3) for field in (GYRO, ACCEL, POSITION)
    )
    weight = float(np.median(np.linalg.norm(accel, axis=1)))
    if not WEIGHT_RANGE[0] <= weight <= WEIGHT_RANGE[1]:
        problem = f"field '{where}/{ACCEL}' has a median length of {weight:.3g}"
        raise damage_error(path, f"{problem}, expected about 9.81 (m/s²)")
    attitude = table.rotations(f"{where}/{ATTITUDE}", width=4)
    name = where.replace("/", "_")
    streams = Streams.of_imu(shorten(name), path, time, gyro, accel)._replace(
        attributes={"device": "phone", "placement": "free", "imu_compensated": "unknown"},
        start=float(start * seconds_of(unit)),
        poses=Poses(time, attitude, position, source=f"{path}: {where}"),
    )
    return assemble(streams, divide=True, max_speed=FASTEST_WALKER)


DATASET = Dataset(
    name="pedlocdata",
    recordings=recordings,
    splits=("train", "val", "test"),
    rate=100.0,
    source="https://zenodo.org/records/18149105",
    layout="<root>/*.h5 with {train,valid,test}/<slice>/{ts,acc,gyr,pos,qua}",
    licence="CC BY 4.0",
)
