"""RIDI: a Tango phone in the hand, the bag, the leg pocket or on the body, whose own VIO is the
truth (Yan, Shan, Furukawa, ECCV 2018).

Layout: folders <name>/ with processed/data.csv (one table on the pose's clock, about 202.3 Hz, ns,
quaternions wxyz, an index column without a name), or with the recorder's text files alone:
acce.txt, gyro.txt (`t x y z`), pose.txt (`t px py pz qx qy qz qw`) and orientation.txt (`t qx qy qz
qw`, the game rotation vector), each on its own clock, ns, quaternions xyzw. The table is taken
where there is one. IMU and pose are of one rigid body; nothing is calibrated, and the accelerometer
reads 1–3 % high.

Recorders that followed use ARCore, whose world is y-up, and whose pose.txt is the camera's: their
android_sensor_pose.txt is the IMU's, and it is taken, turned to z-up, where it is there.

Everything comes back at 200 Hz. The lists name train and test; for validation whole people are held
out of train (`held_out_of_train`).
"""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from gnio_jax.data.dataset import Dataset, Recording
from gnio_jax.data.gaps import divide_at_gaps
from gnio_jax.data.readers.parsing import unit_rotations
from gnio_jax.data.readers.phones import find_folders, find_list, held_out, with_velocity
from gnio_jax.data.readers.recorder import FILES, TANGO, Native, read_recorder, sorted_stamps
from gnio_jax.data.readers.text import listed, numbers, read_csv
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import (
    check_finite,
    check_rate,
    validate,
)
from gnio_jax.errors import InputError
from gnio_jax.numerics import quaternions
from gnio_jax.types import Sequence

RATE = 200.0
VERSION = "ridi 3"
"""Changes whenever other sequences would come of the same files: it is part of the cache's key."""
NATIVE_RATE = 202.3
"""Hz, of data.csv."""

_TABLE = Path("processed") / "data.csv"
_LISTS = {
    "train": "list_train_publish_v2.txt",
    "val": "list_train_publish_v2.txt",
    "test": "list_test_publish_v2.txt",
    "seen": "list_test_publish_v2.txt",
    "unseen": "list_crosssubject.txt",
}
SPLITS = (*_LISTS, "all")
_PLACEMENTS = {"handheld": "handheld", "leg": "pocket", "bag": "bag", "body": "body"}


def recordings(root: Path, split: str) -> list[Recording]:
    """The recordings of a split that are present, wherever below the root; `seen` is `test`.

    `unseen` is the authors' cross-subject list. Recordings that are in no list are in no split but
    `all`, every recording below the root, which needs no list.
    """
    root = Path(root)
    folders = find_folders(root, _is_recording)
    if split == "all":
        if not folders:
            raise InputError(
                root, "holds no recording of RIDI", f"expected layout: {DATASET.layout}"
            )
        return [_recording(folder, {}) for _, folder in sorted(folders.items())]
    path = find_list(root, _LISTS[split])
    chosen = listed(path, lambda entry: folders.get(_name(entry)), root, DATASET.layout)
    if split not in ("train", "val"):
        return [_recording(folder, {}) for folder in chosen]
    held = held_out_of_train(path)
    chosen = [folder for folder in chosen if (folder.name in held) == (split == "val")]
    if not chosen:
        raise InputError(
            path,
            f"split '{split}' would be empty: {len(held)} sequences of this list are held out "
            "for validation",
            "complete the data, or choose another split",
        )
    subjects = ", ".join(sorted({_subject(name) for name in held}))
    return [_recording(folder, {"held_out": subjects}) for folder in chosen]


def _recording(folder: Path, attributes: dict[str, str]) -> Recording:
    table = folder / _TABLE
    files = [table] if table.is_file() else [folder / name for name in FILES]
    return Recording(
        folder.name,
        partial(read_pieces, folder),
        files=tuple(path for path in files if path.is_file()),
        version=VERSION,
        attributes=attributes,
    )


def held_out_of_train(path: str | os.PathLike[str]) -> set[str]:
    """Names in the training list that validate: whole people, about a tenth of the list, the same
    in every copy of the data."""
    names = [
        folder.name
        for folder in listed(
            path, lambda entry: Path(_name(entry)), Path(path).parent, DATASET.layout
        )
    ]
    return held_out({name: _subject(name) for name in names})


def read_pieces(folder: str | os.PathLike[str]) -> list[Sequence]:
    """One recording of its folder, at 200 Hz, from its table or else from the recorder's text
    files.

    Rows out of order are sorted and repeated ones dropped. The recording is divided where its IMU
    or odometry has a gap longer than a window (`divide_at_gaps`). `device_orientation` is the game
    rotation vector, turned to begin at the reference's attitude. Raises `InputError` naming file
    and field.
    """
    folder = Path(folder)
    table = folder / _TABLE
    if table.is_file():
        native, source, place = _from_table(table), table, table
    else:
        native, source = read_recorder(folder), f"{folder / 'gyro.txt'}, acce.txt, pose.txt"
        place = folder
    if not native.valid.any():
        raise InputError(source, "no IMU sample has a pose", "leave it out")
    device = native.device
    if device is not None:
        device = quaternions(native.attitude[0] * device[0].inv() * device)
    sequence = Sequence(
        name=folder.name,
        time=native.time - native.time[0],
        gyro=native.gyro,
        accel=native.accel,
        orientation=quaternions(native.attitude),
        position=native.position,
        velocity=np.zeros_like(native.position),
        valid=native.valid,
        device_orientation=device,
        attributes=_attributes(folder.name, native),
    )
    pieces = divide_at_gaps(validate(sequence, source), place)
    return [validate(with_velocity(resample(piece, RATE)), source) for piece in pieces]


def _attributes(name: str, native: Native) -> dict[str, Any]:
    words = re.findall("|".join(_PLACEMENTS), name)
    return {
        "dataset": "ridi",
        "group": _subject(name),
        "subject": _subject(name),
        "device": "Tango phone" if native.truth == TANGO else "Android phone",
        "placement": _PLACEMENTS[words[0]] if words else "unknown",
        "truth": native.truth,
        "imu_compensated": "no",
        "licence": DATASET.licence,
        "start_time": native.start + float(native.time[0]),
    }


# --- the table


def _from_table(path: Path) -> Native:
    table = read_csv(path)
    stamps, order = sorted_stamps(numbers(table, ["time"], path)[:, 0], path)

    def columns(name: str, axes: str) -> Float[np.ndarray, "n w"]:
        return numbers(table, [f"{name}_{axis}" for axis in axes], path)[order]

    vectors = {name: columns(name, "xyz") for name in ("gyro", "acce", "pos")}
    quaternion = {name: columns(name, "wxyz") for name in ("ori", "rv")}
    for name, values in (vectors | quaternion).items():
        check_finite(values, name, path)
    time = (stamps - stamps[0]) * 1e-9
    check_rate(time, NATIVE_RATE, path)
    return Native(
        time=time,
        start=float(stamps[0] * 1e-9),
        gyro=vectors["gyro"],
        accel=vectors["acce"],
        position=vectors["pos"],
        attitude=unit_rotations(quaternion["ori"], "ori", path),
        device=unit_rotations(quaternion["rv"], "rv", path),
        valid=np.ones(len(time), dtype=bool),
        truth=TANGO,
    )


def _is_recording(folder: Path) -> bool:
    return (folder / _TABLE).is_file() or (
        (folder / "acce.txt").is_file() and (folder / "gyro.txt").is_file()
    )


def _name(entry: str) -> str:
    """Lines of the lists are `name,placement` or `name`."""
    return entry.partition(",")[0].strip()


def _subject(name: str) -> str:
    return name.partition("_")[0]


DATASET = Dataset(
    name="ridi",
    recordings=recordings,
    splits=SPLITS,
    rate=RATE,
    source="https://github.com/higerra/ridi_imu "
    "(its README links the data, ridi_data_publish_v2.zip)",
    layout="<root>/**/<sequence>/"
    "{processed/data.csv or acce.txt,gyro.txt,pose.txt,orientation.txt} and "
    "<root>/**/{list_train_publish_v2,list_test_publish_v2,list_crosssubject}.txt",
    licence="not stated by the authors; cite Yan, Shan, Furukawa, RIDI, ECCV 2018",
)
