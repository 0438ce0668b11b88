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

import json
import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.readers.phones import find_folders, find_list, with_velocity
from gnio_jax.data.readers.text import listed, shortened
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import (
    check_finite,
    check_gaps,
    check_increasing,
    check_rate,
    check_unit_norm,
    validate,
)
from gnio_jax.numerics import integrate_gyro, quaternions, rotations
from gnio_jax.types import InputError, Sequence

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
    info = _info(folder / _INFO)
    bias, force_bias, scale = (
        _vector(info, name, 3, folder)
        for name in ("imu_init_gyro_bias", "imu_acce_bias", "imu_acce_scale")
    )
    start_calibration = _unit(
        _vector(info, "start_calibration", 4, folder)[None], "start_calibration", folder / _INFO
    )
    time, fields = _tables(path)
    check_finite(time, "synced/time", path)
    check_increasing(time, path)
    check_rate(time, RATE, path)
    check_gaps(time, path)
    for name, values in fields.items():
        check_finite(values, name, path)
    start = _number(info, "start_frame", folder) if "start_frame" in info else 0.0
    if not 0 <= start < len(time) - 1 or start != int(start):
        raise InputError(
            folder / _INFO,
            f"field 'start_frame' is {start:g}, the recording has {len(time)} rows",
            "copy it again",
        )

    gyro = fields["synced/gyro_uncalib"] - bias
    game = _unit(fields["synced/game_rv"], "synced/game_rv", path)
    source, error = (
        _choice(info, "pose/ekf_ori" in fields, folder)
        if choose
        else ("game_rv", info.get(_ERRORS["game_rv"]))
    )
    if source == "ekf":
        followed = _unit(fields["pose/ekf_ori"], "pose/ekf_ori", path)
    elif source == "gyro_integration":
        followed = game[0] * integrate_gyro(gyro, np.diff(time))
    else:
        followed = game
    chest = _unit(fields["pose/tango_ori"][:1], "pose/tango_ori", path)
    orientation = chest[0] * start_calibration[0] * followed[0].inv() * followed

    kept = slice(int(start), None)
    position = fields["pose/tango_pos"][kept]
    attributes: dict[str, Any] = {
        "dataset": "ronin",
        "group": folder.name.partition("_")[0],
        "subject": folder.name.partition("_")[0],
        "device": shortened(info.get("device", "unknown")),
        "placement": "free",
        "truth": "tango on the chest (positions)",
        "position_of": "chest",
        "orientation_source": source,
        "imu_compensated": "calibration of the recording's start",
        "licence": DATASET.licence,
        "start_time": float(time[int(start)]),
    }
    if isinstance(error, int | float) and abs(error) <= 360.0:
        attributes["orientation_error_degrees"] = float(error)
    sequence = Sequence(
        name=folder.name,
        time=time[kept] - time[int(start)],
        gyro=gyro[kept],
        accel=scale * (fields["synced/acce"][kept] - force_bias),
        orientation=quaternions(orientation[kept]),
        position=position,
        velocity=np.zeros_like(position),
        valid=np.ones(len(position), dtype=bool),
        device_orientation=quaternions(game[kept]),
        attributes=attributes,
    )
    return validate(with_velocity(resample(validate(sequence, path), RATE)), path)


def _choice(info: dict[str, Any], has_ekf: bool, folder: Path) -> tuple[str, float]:
    """The source to train on, and by how much it ends off the truth, degrees."""
    errors = {
        name: _number(info, field, folder)
        for name, field in _ERRORS.items()
        if name != "ekf" or has_ekf
    }
    best = (
        "game_rv"
        if errors["game_rv"] < MAX_GAME_ERROR
        else min(errors, key=lambda name: errors[name])
    )
    return best, errors[best]


def _tables(path: Path) -> tuple[Float[np.ndarray, "n"], dict[str, Float[np.ndarray, "n _"]]]:
    """The stamps and the columns that are needed, each as long as the stamps."""
    fields: dict[str, np.ndarray] = {}
    try:
        with h5py.File(path, "r") as file:
            for name in ("synced/time", *_FIELDS, "pose/ekf_ori"):
                if isinstance(node := file.get(name), h5py.Dataset):
                    if node.dtype.kind not in "fiu":
                        raise InputError(
                            path,
                            f"field '{name}' holds {node.dtype}, expected numbers",
                            "copy it again",
                        )
                    fields[name] = np.asarray(node, dtype=np.float64)
                elif name != "pose/ekf_ori":
                    parent = file.get(name.partition("/")[0])
                    known = ", ".join(parent) if isinstance(parent, h5py.Group) else "nothing"
                    raise InputError(
                        path,
                        f"field '{name}' is missing",
                        f"found in '{name.partition('/')[0]}': {known}",
                    )
    except InputError:
        raise
    except Exception as error:  # a damaged file makes the parser fail in any way
        raise InputError(
            path,
            f"cannot be read as HDF5, it may be cut short ({shortened(error, 200)})",
            "copy it again",
        ) from None
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
    return time, fields


def _unit(wxyz: np.ndarray, field: str, path: Path) -> Rotation:
    return rotations(check_unit_norm(wxyz, np.ones(len(wxyz), dtype=bool), field, path))


def _info(path: Path) -> dict[str, Any]:
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            path, f"cannot be read ({error.strerror})", f"it belongs beside {_TABLE}"
        ) from None
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"is no JSON ({error})", "copy it again") from None
    if not isinstance(info, dict):
        raise InputError(path, "is no JSON object", "copy it again")
    return info


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
    value = info.get(name)
    try:
        number = (
            float(value)
            if isinstance(value, int | float) and not isinstance(value, bool)
            else np.nan
        )
    except OverflowError:  # JSON's integers have no end
        number = np.nan
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
    layout="<root>/**/<sequence>/{data.hdf5,info.json} and <root>/lists/list_{train,val,test_seen,test_unseen}.txt",
    licence="RoNIN data licence: non-commercial research only",
    min_correlation=None,  # the chest's accelerations are not the phone's
)
