"""Blackbird: an aggressive quadrotor in a motion-capture room (Antonini et al., IJRR 2020), as
learned inertial odometry uses it.

Layout: <root>/{train,val,test}.txt name folders, one a line, lines with '#' being comments;
<folder>/data.hdf5 holds at 100 Hz `ts` s (unix), `gyro_calib` rad/s and `accel_calib` m/s² (the raw
ones minus one bias each) and `traj_target`, position m and quaternion xyzw of the IMU;
`stamped_groundtruth_imu.txt` beside it repeats the poses (stamp, position, quaternion xyzw) and
adds the velocity, whose three columns its header does not name.

The body is front, right, *down*: level at rest the accelerometer reads −9.81 on z. It stays so,
since the orientation tells. Which way the world's z points is read off the data, by the mean
specific force in it: a world whose z points down is turned by a half turn about x.
"""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.readers.parsing import float_columns, parsed_as, unit_rotations
from gnio_jax.data.readers.text import numbers, read_csv
from gnio_jax.data.resampling import resample
from gnio_jax.data.splits import listed
from gnio_jax.data.validation import (
    FASTEST,
    check_finite,
    check_gaps,
    check_increasing,
    check_motion,
    check_rate,
    validate,
)
from gnio_jax.errors import InputError
from gnio_jax.numerics import quaternions, wxyz_from_xyzw
from gnio_jax.types import Sequence

RATE = 100.0
SPLITS = ("train", "val", "test")
_TABLE = "data.hdf5"
_TRUTH = "stamped_groundtruth_imu.txt"
_FIELDS = {"ts": None, "gyro_calib": 3, "accel_calib": 3, "traj_target": 7}


def recordings(root: Path, split: str) -> list[Recording]:
    """The recordings of a split's list that are present."""
    root = Path(root)
    folders = listed(
        root / f"{split}.txt",
        lambda entry: root / entry if (root / entry / _TABLE).is_file() else None,
        root,
        DATASET.layout,
    )
    names = ["_".join(folder.relative_to(root).parts) for folder in folders]
    return [
        single(name, read_sequence, folder, name)
        for name, folder in zip(names, folders, strict=True)
    ]


def read_sequence(folder: str | os.PathLike[str], name: str | None = None) -> Sequence:
    """One sequence of its folder, in a z-up world. Raises `InputError` naming file and field."""
    folder = Path(folder)
    path = folder / _TABLE
    with parsed_as(path, "HDF5"), h5py.File(path, "r") as file:
        fields = float_columns(file, _FIELDS, path)
    for field, values in fields.items():
        check_finite(values, field, path)
    stamps, gyro, accel, pose = (fields[field] for field in _FIELDS)
    check_increasing(stamps, path)
    check_rate(stamps, RATE, path)
    check_gaps(stamps, path)
    time, position = stamps - stamps[0], pose[:, :3]
    attitude = unit_rotations(wxyz_from_xyzw(pose[:, 3:]), "traj_target", path)
    velocity = _velocity(folder / _TRUTH, stamps)
    if velocity is None:
        velocity = CubicSpline(time, position, axis=0)(time, 1)

    upside_down = attitude.apply(accel).mean(axis=0)[2] < 0
    turn = Rotation.from_rotvec([np.pi if upside_down else 0.0, 0.0, 0.0])
    sequence = Sequence(
        name=name or folder.name,
        time=time,
        gyro=gyro,
        accel=accel,
        orientation=quaternions(turn * attitude),
        position=turn.apply(position),
        velocity=turn.apply(velocity),
        valid=np.ones(len(stamps), dtype=bool),
        attributes={
            "dataset": "blackbird",
            "group": folder.parent.name,
            "session": "/".join(folder.parts[-4:-1]),
            "placement": "quadrotor",
            "body": "front-right-down",
            "native_world": "z-down, turned" if upside_down else "z-up",
            "truth": "motion capture",
            "imu_compensated": "constant bias",
            "start_time": float(stamps[0]),
            "licence": DATASET.licence,
        },
    )
    sequence = validate(sequence, path)
    check_motion(sequence, path)
    return resample(sequence, RATE)


def _velocity(path: Path, stamps: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"] | None:
    """The velocities of the text beside the table; None where there is no text or it has none."""
    if not path.is_file():
        return None
    table = read_csv(path, separator=" ", header=False)
    if table.shape[1] not in (8, 11):
        raise InputError(
            path,
            f"has {table.shape[1]} columns, expected 8 (stamp, position, quaternion) or 11 "
            "(and velocity)",
            "copy it again",
        )
    if table.shape[1] == 8:
        return None
    values = numbers(table, range(11), path)
    if len(values) != len(stamps) or np.abs(values[:, 0] - stamps).max() > 1e-3:
        raise InputError(
            path,
            f"field 'ts' is not that of {_TABLE} beside it ({len(values)} and {len(stamps)} rows)",
            "copy both again",
        )
    check_finite(values[:, 8:], "velocity", path)
    if np.abs(values[:, 8:]).max() > FASTEST:
        raise InputError(path, f"field 'velocity' is beyond {FASTEST:g} m/s", "copy it again")
    return values[:, 8:]


DATASET = Dataset(
    name="blackbird",
    recordings=recordings,
    splits=SPLITS,
    rate=RATE,
    source="https://github.com/mit-aera/Blackbird-Dataset",
    layout="<root>/{train,val,test}.txt and "
    "<root>/<trajectory>/<yaw>/<speed>/<split>/{data.hdf5,stamped_groundtruth_imu.txt}",
    licence="as stated by the authors (github.com/mit-aera/Blackbird-Dataset)",
    pedestrian=False,
)
