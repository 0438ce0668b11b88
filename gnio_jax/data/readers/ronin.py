"""RoNIN: phones carried as people please, positions from a Tango device strapped to the chest
(Herath, Yan, Furukawa, ICRA 2020).

Layout: folders <name>/{data.hdf5,info.json}, anywhere below the root (the published archives do not
follow the lists), and the lists list_{train,val,test_seen,test_unseen}.txt of the authors'
repository. All quaternions are wxyz, body→world, 200 Hz.

The chest device moves apart from the phone: its attitude (`pose/tango_ori`) is not the phone's. As
the authors do, the reference orientation is that of the phone's own filter, laid onto the Tango
world at the first row, when the phone's place on the chest is known: tango_ori[0] ⊗
start_calibration ⊗ conj(src[0]) ⊗ src(t). In training and validation src is the phone's game
rotation vector if it ends less than 20° from the truth, else the best of integrated gyro, game
rotation vector and the authors' EKF; that choice looks at the truth, so in the tests src is always
the game rotation vector. The position is the chest's.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.parsing.tables import shortened
from gnio_jax.data.readers.parsing import json_object, parsed_as, unit_rotations
from gnio_jax.data.readers.phones import with_velocity
from gnio_jax.data.resampling import resample
from gnio_jax.data.splits import find_folders, find_list, listed
from gnio_jax.data.validation import (
    check_finite,
    check_gaps,
    check_increasing,
    check_rate,
    validate,
)
from gnio_jax.errors import InputError
from gnio_jax.numerics import integrate_gyro, quaternions
from gnio_jax.types import Sequence

RATE = 200.0
MAX_GAME_ERROR = 20.0
"""Degrees by which the game rotation vector may end off the truth and still be preferred in
training, as the authors have it."""

_TABLE, _INFO = "data.hdf5", "info.json"
_LISTS = {
    "train": "list_train.txt",
    "val": "list_val.txt",
    "seen": "list_test_seen.txt",
    "unseen": "list_test_unseen.txt",
    "test": "list_test_seen.txt",
}
_FIELDS = {
    "synced/gyro_uncalib": 3,
    "synced/acce": 3,
    "synced/game_rv": 4,
    "pose/tango_pos": 3,
    "pose/tango_ori": 4,
}
_EKF = "pose/ekf_ori"
"""Attitudes of the authors' filter, which not every recording has."""
_ERRORS = {
    "gyro_integration": "gyro_integration_error",
    "game_rv": "grv_ori_error",
    "ekf": "ekf_ori_error",
}


def recordings(root: Path, split: str) -> list[Recording]:
    """The recordings of a split's list that are present, wherever below the root; `test` is
    `seen`."""
    root = Path(root)
    folders = find_folders(root, lambda folder: (folder / _TABLE).is_file())
    chosen = listed(find_list(root, _LISTS[split]), folders.get, root, DATASET.layout)
    return [
        single(folder.name, read_sequence, folder, choose=split in ("train", "val"))
        for folder in chosen
    ]


def read_sequence(folder: str | os.PathLike[str], choose: bool = False) -> Sequence:
    """One recording of its folder, from its `start_frame` on.

    `choose` lets the errors against the truth decide which source the orientation follows, as in
    training; without it that is the game rotation vector. `device_orientation` is the game rotation
    vector as the phone gave it. Raises `InputError` naming file and field.
    """
    folder = Path(folder)
    path = folder / _TABLE
    info = json_object(folder / _INFO, f"it belongs beside {_TABLE}")
    calibration = _calibration(info, folder)
    time, fields = _fields(path)
    start = _start_frame(info, len(time), folder)
    gyro = fields["synced/gyro_uncalib"] - calibration.gyro_bias
    accel = calibration.accel_scale * (fields["synced/acce"] - calibration.accel_bias)
    game = unit_rotations(fields["synced/game_rv"], "synced/game_rv", path)
    source, error = "game_rv", info.get(_ERRORS["game_rv"])
    if choose:
        source, error = _choice(info, _EKF in fields, folder)
    followed = _followed(source, time, gyro, game, fields, path)
    chest = unit_rotations(fields["pose/tango_ori"][:1], "pose/tango_ori", path)
    orientation = chest[0] * calibration.start * followed[0].inv() * followed

    kept = slice(start, None)
    position = fields["pose/tango_pos"][kept]
    sequence = Sequence(
        name=folder.name,
        time=time[kept] - time[start],
        gyro=gyro[kept],
        accel=accel[kept],
        orientation=quaternions(orientation[kept]),
        position=position,
        velocity=np.zeros_like(position),
        valid=np.ones(len(position), dtype=bool),
        device_orientation=quaternions(game[kept]),
        attributes=_attributes(folder.name, info, source, error, float(time[start])),
    )
    return validate(with_velocity(resample(validate(sequence, path), RATE)), path)


def _attributes(
    name: str, info: dict[str, Any], source: str, error: Any, start_time: float
) -> dict[str, Any]:
    attributes = {
        "dataset": "ronin",
        "group": name.partition("_")[0],
        "subject": name.partition("_")[0],
        "device": shortened(info.get("device", "unknown")),
        "placement": "free",
        "truth": "tango on the chest (positions)",
        "position_of": "chest",
        "orientation_source": source,
        "imu_compensated": "calibration of the recording's start",
        "licence": DATASET.licence,
        "start_time": start_time,
    }
    if isinstance(error, int | float) and abs(error) <= 360.0:
        attributes["orientation_error_degrees"] = float(error)
    return attributes


# --- orientation


def _choice(info: dict[str, Any], has_ekf: bool, folder: Path) -> tuple[str, float]:
    """The source to train on, and by how much it ends off the truth, degrees."""
    errors = {
        name: _number(info, field, folder)
        for name, field in _ERRORS.items()
        if name != "ekf" or has_ekf
    }
    best = min(errors, key=lambda name: errors[name])
    if errors["game_rv"] < MAX_GAME_ERROR:
        best = "game_rv"
    return best, errors[best]


def _followed(
    source: str,
    time: Float[np.ndarray, " n"],
    gyro: Float[np.ndarray, "n 3"],
    game: Rotation,
    fields: dict[str, Float[np.ndarray, "n _"]],
    path: Path,
) -> Rotation:
    """n attitudes of the phone by one of the sources of `_ERRORS`, each in a world of its own."""
    if source == "ekf":
        return unit_rotations(fields[_EKF], _EKF, path)
    if source == "gyro_integration":
        return game[0] * integrate_gyro(gyro, np.diff(time))
    return game


# --- data.hdf5


def _fields(path: Path) -> tuple[Float[np.ndarray, " n"], dict[str, Float[np.ndarray, "n _"]]]:
    """The stamps and the columns that are needed, complete and each as long as the stamps."""
    fields: dict[str, np.ndarray] = {}
    with parsed_as(path, "HDF5"), h5py.File(path, "r") as file:
        for name in ("synced/time", *_FIELDS):
            fields[name] = _numbers(file, name, path)
        if isinstance(file.get(_EKF), h5py.Dataset):
            fields[_EKF] = _numbers(file, _EKF, path)
    time = fields.pop("synced/time")
    if time.ndim != 1 or len(time) < 2:
        raise InputError(
            path,
            f"field 'synced/time' has shape {time.shape}, expected at least two stamps",
            "copy it again",
        )
    for name, values in fields.items():
        expected = (len(time), _FIELDS.get(name, 4))
        if values.shape != expected:
            raise InputError(
                path,
                f"field '{name}' has shape {values.shape}, expected {expected}",
                "copy it again",
            )
    check_finite(time, "synced/time", path)
    check_increasing(time, path)
    check_rate(time, RATE, path)
    check_gaps(time, path)
    for name, values in fields.items():
        check_finite(values, name, path)
    return time, fields


def _numbers(file: h5py.File, name: str, path: Path) -> Float[np.ndarray, "..."]:
    node = file.get(name)
    if not isinstance(node, h5py.Dataset):
        group = name.partition("/")[0]
        parent = file.get(group)
        known = ", ".join(parent) if isinstance(parent, h5py.Group) else "nothing"
        raise InputError(path, f"field '{name}' is missing", f"found in '{group}': {known}")
    if node.dtype.kind not in "fiu":
        raise InputError(
            path, f"field '{name}' holds {node.dtype}, expected numbers", "copy it again"
        )
    return np.asarray(node, dtype=np.float64)


# --- info.json


class _Calibration(NamedTuple):
    """What info.json says of the phone's sensors and of its place on the chest."""

    gyro_bias: Float[np.ndarray, "3"]
    """rad/s."""
    accel_bias: Float[np.ndarray, "3"]
    """m/s²."""
    accel_scale: Float[np.ndarray, "3"]
    start: Rotation
    """Phone → chest device at the first row."""


def _calibration(info: dict[str, Any], folder: Path) -> _Calibration:
    gyro_bias, accel_bias, accel_scale = (
        _vector(info, name, 3, folder)
        for name in ("imu_init_gyro_bias", "imu_acce_bias", "imu_acce_scale")
    )
    quaternion = _vector(info, "start_calibration", 4, folder)[None]
    start = unit_rotations(quaternion, "start_calibration", folder / _INFO)[0]
    return _Calibration(gyro_bias, accel_bias, accel_scale, start)


def _start_frame(info: dict[str, Any], rows: int, folder: Path) -> int:
    start = _number(info, "start_frame", folder) if "start_frame" in info else 0.0
    if not 0 <= start < rows - 1 or start != int(start):
        raise InputError(
            folder / _INFO,
            f"field 'start_frame' is {start:g}, the recording has {rows} rows",
            "copy it again",
        )
    return int(start)


def _vector(info: dict[str, Any], name: str, length: int, folder: Path) -> Float[np.ndarray, "d"]:
    try:
        values = np.asarray(info[name], dtype=np.float64)
    except KeyError:
        raise InputError(folder / _INFO, f"field '{name}' is missing", "copy it again") from None
    except (ValueError, TypeError, OverflowError):
        values = np.empty(0)
    if values.shape != (length,) or not np.isfinite(values).all():
        raise InputError(
            folder / _INFO, f"field '{name}' does not hold {length} numbers", "copy it again"
        )
    return values


def _number(info: dict[str, Any], name: str, folder: Path) -> float:
    value, number = info.get(name), np.nan
    # JSON's integers have no end.
    with suppress(OverflowError):
        if isinstance(value, int | float) and not isinstance(value, bool):
            number = float(value)
    if not np.isfinite(number):
        raise InputError(
            folder / _INFO,
            f"field '{name}' is {'missing' if value is None else 'no number'}",
            "copy it again",
        )
    return number


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
