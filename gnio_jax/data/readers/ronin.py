"""RoNIN: phones carried in any way, with positions from a Tango device on the chest (Herath, Yan,
Furukawa, ICRA 2020).

Layout: folders <name>/{data.hdf5,info.json}, anywhere below the root (the published archives do not
follow the lists), and the lists list_{train,val,test_seen,test_unseen}.txt of the authors'
repository. All quaternions are wxyz, body→world, 200 Hz.

The chest device moves independently of the phone: its attitude (`pose/tango_ori`) is not the
phone's. As in the authors' code, the reference orientation is that of the phone's own filter,
aligned with the Tango world at the first row, when the phone's pose on the chest is known:
tango_ori[0] ⊗ start_calibration ⊗ conj(src[0]) ⊗ src(t). In training and validation src is the
phone's game rotation vector if it ends less than 20° from the truth, else the best of integrated
gyro, game rotation vector and the authors' EKF. This choice uses the truth, so in the tests src is
always the game rotation vector. The position is that of the chest.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.parsing.tables import damage_error, json_object, read_hdf5_fields, shorten
from gnio_jax.data.splits import find_folders, find_list, read_list
from gnio_jax.data.validation import FASTEST_WALKER, UNIT_NORM_TOLERANCE
from gnio_jax.files import file_in
from gnio_jax.numerics import integrate_gyro, quaternions, rotations
from gnio_jax.types import Sequence

RATE = 200.0
MAX_GAME_ERROR = 20.0
"""Largest final error with which the game rotation vector is preferred in training, degrees, as in
the authors' code."""

_TABLE, _INFO = "data.hdf5", "info.json"
_LISTS = {
    "train": "list_train.txt",
    "val": "list_val.txt",
    "seen": "list_test_seen.txt",
    "unseen": "list_test_unseen.txt",
    "test": "list_test_seen.txt",
}
_GYRO, _ACCEL, _GAME = "synced/gyro_uncalib", "synced/acce", "synced/game_rv"
_TIME, _POSITION, _CHEST = "synced/time", "pose/tango_pos", "pose/tango_ori"
_EKF = "pose/ekf_ori"
"""Attitudes of the authors' filter, which not every recording has."""
_ERRORS = {
    "gyro_integration": "gyro_integration_error",
    "game_rv": "grv_ori_error",
    "ekf": "ekf_ori_error",
}


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The recordings of a split's list that are present, anywhere below the root; `test` is
    `seen`."""
    folders = find_folders(root, lambda folder: file_in(folder, _TABLE).is_file())
    chosen = read_list(find_list(root, _LISTS[split]), folders.get, root, DATASET.layout)
    choose = split in ("train", "val")
    return [
        RecordingSource(
            folder.name,
            partial(read, folder, choose),
            (file_in(folder, _TABLE), file_in(folder, _INFO)),
        )
        for folder in chosen
    ]


def read(folder: Path, choose: bool = False) -> list[Sequence]:
    """Read the recording of a folder, from its `start_frame` on.

    With `choose` the source of the orientation is chosen by its errors against the truth, as in
    training; without it the source is the game rotation vector. `device_orientation` is the game
    rotation vector of the phone. Raises `InputError` naming file and field.
    """
    path, info_path = file_in(folder, _TABLE), file_in(folder, _INFO)
    info = json_object(info_path, f"it belongs beside {_TABLE}")
    table = read_hdf5_fields(path, (_TIME, _GYRO, _ACCEL, _GAME, _POSITION, _CHEST, _EKF))
    time, start, _ = table.clock(_TIME, "s")
    game, chest = table.rotations(_GAME, width=4), table.rotations(_CHEST, width=4, rows=slice(1))
    gyro, accel, position = (table.take(name, width=3) for name in (_GYRO, _ACCEL, _POSITION))
    gyro = gyro - _vector(info, "imu_init_gyro_bias", 3, info_path)
    accel = accel - _vector(info, "imu_acce_bias", 3, info_path)
    accel = accel * _vector(info, "imu_acce_scale", 3, info_path)
    on_chest = _vector(info, "start_calibration", 4, info_path)
    if abs(np.linalg.norm(on_chest) - 1.0) > UNIT_NORM_TOLERANCE:
        raise damage_error(info_path, "field 'start_calibration' is not a unit quaternion")

    source, error = "game_rv", info.get(_ERRORS["game_rv"])
    if choose:
        source, error = _choose_orientation(info, _EKF in table.columns, info_path)
    attitude = game
    if source == "ekf":
        attitude = table.rotations(_EKF, width=4)
    elif source == "gyro_integration":
        attitude = game[0] * integrate_gyro(gyro, np.diff(time))
    orientation = chest[0] * rotations(on_chest) * attitude[0].inv() * attitude

    attributes = {
        "group": folder.name.partition("_")[0],
        "subject": folder.name.partition("_")[0],
        "device": shorten(info.get("device", "unknown")),
        "placement": "free",
        "truth": "tango on the chest (positions)",
        "position_of": "chest",
        "orientation_source": source,
        "imu_compensated": "calibration of the recording's start",
    }
    if isinstance(error, int | float) and abs(error) <= 360.0:
        attributes["orientation_error_degrees"] = float(error)
    rows = slice(_start_frame(info, len(time), info_path), None)
    time = time[rows]
    streams = Streams.of_imu(folder.name, path, time, gyro[rows], accel[rows])._replace(
        attributes=attributes,
        start=start,
        poses=Poses(time, orientation[rows], position[rows], source=str(path)),
        device=Samples(time, quaternions(game[rows]), str(path)),
    )
    return assemble(streams, RATE, max_speed=FASTEST_WALKER)


# --- info.json


def _choose_orientation(info: dict[str, Any], has_ekf: bool, path: Path) -> tuple[str, float]:
    """The source for training, and its final error against the truth, degrees."""
    errors = {
        name: float(_vector(info, field, 1, path)[0])
        for name, field in _ERRORS.items()
        if name != "ekf" or has_ekf
    }
    best = min(errors, key=lambda name: errors[name])
    if errors["game_rv"] < MAX_GAME_ERROR:
        best = "game_rv"
    return best, errors[best]


def _start_frame(info: dict[str, Any], rows: int, path: Path) -> int:
    start = _vector(info, "start_frame", 1, path)[0] if "start_frame" in info else 0.0
    if not 0 <= start < rows - 1 or start != int(start):
        raise damage_error(path, f"field 'start_frame' is {start:g}, the recording has {rows} rows")
    return int(start)


def _vector(info: dict[str, Any], name: str, length: int, path: Path) -> Float[np.ndarray, "d"]:
    """A field of `length` finite numbers, or of a single one."""
    if info.get(name) is None:
        raise damage_error(path, f"field '{name}' is missing")
    entries = [info[name]] if length == 1 else info[name]
    values = np.empty(0)
    numbers = isinstance(entries, list) and all(type(number) in (int, float) for number in entries)
    if numbers and len(entries) == length:
        # JSON's integers may be of any size.
        values = np.array([float(number) if abs(number) < 1e300 else np.inf for number in entries])
    if values.shape != (length,) or not np.isfinite(values).all():
        what = "is not a number" if length == 1 else f"does not hold {length} numbers"
        raise damage_error(path, f"field '{name}' {what}")
    return values


DATASET = Dataset(
    name="ronin",
    recordings=recordings,
    splits=tuple(_LISTS),
    rate=RATE,
    source="https://ronin.cs.sfu.ca (half of it is public; the lists are in https://github.com/Sachini/ronin)",
    layout="<root>/**/<sequence>/{data.hdf5,info.json} and "
    "<root>/lists/list_{train,val,test_seen,test_unseen}.txt",
    licence="RoNIN data licence: non-commercial research only",
    correlates=False,  # the chest's accelerations are not the phone's
)
