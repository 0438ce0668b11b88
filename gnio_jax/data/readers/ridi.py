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
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset, Recording
from gnio_jax.data.gaps import divide_at_gaps
from gnio_jax.data.readers.parsing import unit_rotations
from gnio_jax.data.readers.phones import find_folders, find_list, held_out, with_velocity
from gnio_jax.data.readers.reference import Poses, poses_at
from gnio_jax.data.readers.text import listed, numbers, read_csv
from gnio_jax.data.resampling import LONGEST_BRIDGE, resample
from gnio_jax.data.validation import (
    WINDOW_SECONDS,
    check_finite,
    check_increasing,
    check_rate,
    validate,
)
from gnio_jax.numerics import neighbours, quaternions, wxyz_from_xyzw
from gnio_jax.types import InputError, Sequence

RATE = 200.0
VERSION = "ridi 2"
"""Changes whenever other sequences would come of the same files: it is part of the cache's key."""
NATIVE_RATE = 202.3
"""Hz, of data.csv."""
RAW_RATES = (90.0, 1100.0)
"""Hz, of the text files: 200 in the set itself, more in what newer phones wrote."""

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
_Y_UP = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
TANGO, ARCORE = "Tango VIO of the phone itself", "ARCore VIO of the phone itself"
_POSES = (("android_sensor_pose.txt", _Y_UP), ("pose.txt", Rotation.identity()))


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
    texts = ("gyro.txt", "acce.txt", "orientation.txt", *(name for name, _ in _POSES))
    files = [table] if table.is_file() else [folder / name for name in texts]
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

    Rows out of order are sorted and repeated ones dropped. Where its IMU or odometry has a gap
    longer than a window it is divided (`divide_at_gaps`). `device_orientation` is the game rotation
    vector, turned to begin at the reference's attitude. Raises `InputError` naming file and field.
    """
    folder = Path(folder)
    table = folder / _TABLE
    if table.is_file():
        native, source, place = _from_table(table), table, table
    else:
        native, source = _from_text(folder), f"{folder / 'gyro.txt'}, acce.txt, pose.txt"
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


def _attributes(name: str, native: _Native) -> dict[str, Any]:
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


class _Native(NamedTuple):
    """A recording on one clock of its own."""

    time: Float[np.ndarray, " n"]
    """s since `start`, increasing, gaps and all."""
    start: float
    """s on the phone's clock."""
    gyro: Float[np.ndarray, "n 3"]
    """rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """m/s²."""
    position: Float[np.ndarray, "n 3"]
    """m."""
    attitude: Rotation
    """Body → world."""
    device: Rotation | None
    """The phone's game rotation vector."""
    valid: Bool[np.ndarray, " n"]
    truth: str


# --- the table


def _from_table(path: Path) -> _Native:
    table = read_csv(path)
    stamps, order = _in_order(numbers(table, ["time"], path)[:, 0], path)

    def columns(name: str, axes: str) -> Float[np.ndarray, "n w"]:
        return numbers(table, [f"{name}_{axis}" for axis in axes], path)[order]

    vectors = {name: columns(name, "xyz") for name in ("gyro", "acce", "pos")}
    quaternion = {name: columns(name, "wxyz") for name in ("ori", "rv")}
    for name, values in (vectors | quaternion).items():
        check_finite(values, name, path)
    time = (stamps - stamps[0]) * 1e-9
    check_rate(time, NATIVE_RATE, path)
    return _Native(
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


# --- the recorder's text files


def _from_text(folder: Path) -> _Native:
    """The text files on the gyro's clock, from the first pose to the last."""
    pose_path, upright = _pose_file(folder)
    gyro_path, force_path = folder / "gyro.txt", folder / "acce.txt"
    gyro_stamps, gyro = _text(gyro_path, 3)
    force_stamps, force = _text(force_path, 3)
    pose_stamps, pose = _text(pose_path, 7)
    start = gyro_stamps[0]
    gyro_time, force_time, pose_time = (
        (stamps - start) * 1e-9 for stamps in (gyro_stamps, force_stamps, pose_stamps)
    )
    check_increasing(pose_time, pose_path)  # stamps of another unit may fall together
    _check_raw_rate(gyro_stamps, gyro_path)
    _check_raw_rate(force_stamps, force_path)
    rows = _shared(gyro_time, force_time, pose_time, force_path, pose_path)
    time = gyro_time[rows]
    attitude = unit_rotations(wxyz_from_xyzw(pose[:, 3:]), "qx qy qz qw", pose_path)
    place, turned, valid = poses_at(time, Poses(pose_time, attitude, pose[:, :3]), LONGEST_BRIDGE)
    return _Native(
        time=time,
        start=float(start * 1e-9),
        gyro=gyro[rows],
        accel=CubicSpline(force_time, force, axis=0)(time),
        position=upright.apply(place),
        attitude=upright * turned,
        device=_game_rotation(folder / "orientation.txt", start, time),
        valid=valid,
        truth=TANGO if pose_path.name == "pose.txt" else ARCORE,
    )


def _pose_file(folder: Path) -> tuple[Path, Rotation]:
    """The file of the IMU's poses, and what turns their world to z-up."""
    for name, upright in _POSES:
        if (folder / name).is_file():
            return folder / name, upright
    return folder / "pose.txt", Rotation.identity()


def _check_raw_rate(stamps: Float[np.ndarray, " n"], path: Path) -> None:
    rate = 1e9 / float(np.median(np.diff(stamps)))
    slowest, fastest = RAW_RATES
    if not slowest <= rate <= fastest:
        raise InputError(
            path,
            f"field 'time' runs at {rate:.4g} Hz, expected {slowest:g} to {fastest:g} Hz",
            "check the unit of the stamps: they are ns",
        )


def _shared(
    gyro_time: Float[np.ndarray, " n"],
    force_time: Float[np.ndarray, " m"],
    pose_time: Float[np.ndarray, " k"],
    force_path: Path,
    pose_path: Path,
) -> Bool[np.ndarray, " n"]:
    """Which rows of the gyro the accelerometer and the odometry cover.

    Where the accelerometer is silent there is no IMU sample, whatever the gyro says. An odometry
    that was lost for long comes back in a world of its own (23° turned, in one recording): such a
    gap ends a piece as one of the IMU does.
    """
    remedy = "check that the files are of one recording"
    if not (force_time[0] < gyro_time[-1] and gyro_time[0] < force_time[-1]):
        raise InputError(
            force_path,
            f"field 'time' ({force_time[0]:.1f} to {force_time[-1]:.1f} s after the gyro's first "
            f"stamp) shares nothing with that of gyro.txt (0.0 to {gyro_time[-1]:.1f} s)",
            remedy,
        )
    first, last = max(force_time[0], pose_time[0]), min(force_time[-1], pose_time[-1])
    rows = (gyro_time >= first) & (gyro_time <= last)
    for stamps, longest in ((force_time, LONGEST_BRIDGE), (pose_time, WINDOW_SECONDS)):
        left, right = neighbours(stamps, gyro_time)
        rows &= stamps[right] - stamps[left] <= longest
    if rows.sum() < 2:
        raise InputError(
            pose_path,
            f"its stamps ({pose_time[0]:.1f} to {pose_time[-1]:.1f} s after the gyro's first) "
            f"share nothing with the IMU's ({gyro_time[0]:.1f} to {gyro_time[-1]:.1f} s)",
            remedy,
        )
    return rows


def _game_rotation(path: Path, start: float, time: Float[np.ndarray, " n"]) -> Rotation | None:
    """The game rotation vector at times (s) after the stamp `start` (ns), if the recorder wrote
    it."""
    if not path.is_file():
        return None
    stamps, xyzw = _text(path, 4)
    own_time = (stamps - start) * 1e-9
    check_increasing(own_time, path)
    known = unit_rotations(wxyz_from_xyzw(xyzw), "qx qy qz qw", path)
    _, device, _ = poses_at(time, Poses(own_time, known, np.zeros((len(known), 3))), LONGEST_BRIDGE)
    return device


def _text(path: Path, width: int) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n w"]]:
    """Stamps (ns) and values of a text file, in order."""
    table = read_csv(path, separator=" ", header=False)
    if table.shape[1] < width + 1:
        raise InputError(
            path,
            f"has {table.shape[1]} columns, expected the time and {width} values",
            "copy it again",
        )
    stamps, order = _in_order(numbers(table, [0], path)[:, 0], path)
    values = numbers(table, range(1, width + 1), path)[order]
    check_finite(values, "values", path)
    return stamps, values


def _in_order(
    stamps: Float[np.ndarray, "n"], path: Path
) -> tuple[Float[np.ndarray, "m"], np.ndarray]:
    """Increasing stamps, and the rows they are of: the recorder writes some late and some twice."""
    check_finite(stamps, "time", path)
    increasing, order = np.unique(stamps, return_index=True)
    if len(increasing) < max(100, 0.5 * len(stamps)):
        raise InputError(
            path,
            f"field 'time' holds only {len(increasing)} different stamps in {len(stamps)} rows",
            "copy it again",
        )
    return increasing, order


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
    source="https://github.com/higerra/ridi_imu (its README links the data, ridi_data_publish_v2.zip)",
    layout="<root>/**/<sequence>/{processed/data.csv or acce.txt,gyro.txt,pose.txt,orientation.txt} and "
    "<root>/**/{list_train_publish_v2,list_test_publish_v2,list_crosssubject}.txt",
    licence="not stated by the authors; cite Yan, Shan, Furukawa, RIDI, ECCV 2018",
)
