"""Blackbird: an aggressive quadrotor in a motion-capture room (Antonini et al., IJRR 2020), as
learned inertial odometry uses it.

Layout: <root>/{train,val,test}.txt name folders, one a line, lines with '#' being comments: pieces
of a flight, as <trajectory>/<yaw>/<speed>/<piece>, or <trajectory>/<yaw>/<speed>/imo/<piece> where
the authors' program wrote them. What comes before the piece names the flight, which is the `group`:
flights of several trajectories have the same speed. <folder>/data.hdf5 holds at 100 Hz `ts` s
(unix), `gyro_calib` rad/s and `accel_calib` m/s² (the raw ones minus one bias each) and
`traj_target`, position m and quaternion xyzw of the IMU; `stamped_groundtruth_imu.txt` beside it
repeats the poses (stamp, position, quaternion xyzw) and adds the velocity, whose three columns its
header does not name.

The body is front, right, *down*: level at rest the accelerometer reads −9.81 on z. This is not
changed, because the orientation describes it. The direction of the world's z axis is found from the
mean specific force in the world: a world with z down is turned by a half turn about x.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.assembly import Poses, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.parsing.tables import damage_error, read_hdf5_fields, read_text
from gnio_jax.data.splits import read_list
from gnio_jax.data.validation import FASTEST, check_unit_norm
from gnio_jax.files import file_in
from gnio_jax.numerics import rotations, wxyz_from_xyzw
from gnio_jax.types import Sequence

RATE = 100.0
SPLITS = ("train", "val", "test")
_TABLE = "data.hdf5"
_TRUTH = "stamped_groundtruth_imu.txt"


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The recordings of a split's list that are present."""
    folders = read_list(
        root / f"{split}.txt",
        lambda entry: root / entry if file_in(root / entry, _TABLE).is_file() else None,
        root,
        DATASET.layout,
    )
    return [
        RecordingSource(
            "_".join(folder.relative_to(root).parts),
            partial(read, folder, folder.relative_to(root)),
            (file_in(folder, _TABLE), file_in(folder, _TRUTH)),
        )
        for folder in folders
    ]


def read(folder: Path, piece: Path | None = None) -> list[Sequence]:
    """Read the sequence of a folder, in a z-up world. `piece` is its path in the dataset. Raises
    `InputError` naming file and field."""
    path = file_in(folder, _TABLE)
    table = read_hdf5_fields(path, ("ts", "gyro_calib", "accel_calib", "traj_target"))
    time, start, _ = table.clock("ts", "s")
    gyro, accel = table.take("gyro_calib", width=3), table.take("accel_calib", width=3)
    pose = table.take("traj_target", width=7)
    wxyz = check_unit_norm(wxyz_from_xyzw(pose[:, 3:]), True, "traj_target", path)
    attitude, velocity = rotations(wxyz), _velocity(file_in(folder, _TRUTH), time, start)

    upside_down = attitude.apply(accel).mean(axis=0)[2] < 0
    turn = Rotation.from_rotvec([np.pi if upside_down else 0.0, 0.0, 0.0])
    piece = piece or Path(folder.name)
    flight = "/".join(piece.parts[:-1]) or folder.name
    attributes = {
        "group": flight,
        "session": flight,
        "placement": "quadrotor",
        "body": "front-right-down",
        "native_world": "z-down, turned" if upside_down else "z-up",
        "truth": "motion capture",
        "imu_compensated": "constant bias",
    }
    velocity = velocity if velocity is None else turn.apply(velocity)
    poses = Poses(time, turn * attitude, turn.apply(pose[:, :3]), velocity, source=str(path))
    streams = Streams.of_imu("_".join(piece.parts), path, time, gyro, accel)
    streams = streams._replace(attributes=attributes, start=start, poses=poses)
    return assemble(streams, RATE)


def _velocity(
    path: Path, time: Float[np.ndarray, " n"], start: float
) -> Float[np.ndarray, "n 3"] | None:
    """The velocities in the text file beside the table, whose stamps are `time` (s) since `start`;
    None if there is no text file or it has none."""
    if not path.is_file():
        return None
    # Stamp, position, quaternion and, in some, velocity.
    table = read_text(path, separator=" ", header=False, widths=(8, 11))
    if table.width() == 8:
        return None
    stamps, velocity = table.take(0), table.take(8, 9, 10)
    if len(stamps) != len(time) or np.abs(stamps - start - time).max() > 1e-3:
        rows = f"{len(stamps)} and {len(time)} rows"
        raise damage_error(path, f"field 'ts' is not that of {_TABLE} beside it ({rows})")
    if np.abs(velocity).max() > FASTEST:
        raise damage_error(path, f"field 'velocity' is beyond {FASTEST:g} m/s")
    return velocity


DATASET = Dataset(
    name="blackbird",
    recordings=recordings,
    splits=SPLITS,
    rate=RATE,
    source="https://github.com/mit-aera/Blackbird-Dataset",
    layout="<root>/{train,val,test}.txt and "
    "<root>/<trajectory>/<yaw>/<speed>/[imo/]<split>/{data.hdf5,stamped_groundtruth_imu.txt}",
    licence="as stated by the authors (github.com/mit-aera/Blackbird-Dataset)",
    pedestrian=False,
)
