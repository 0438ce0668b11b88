"""RIDI: a Tango phone in the hand, the bag, the leg pocket or on the body, whose own VIO is the
truth (Yan, Shan, Furukawa, ECCV 2018).

Layout: folders <name>/ with processed/data.csv (one table on the pose's clock, about 202.3 Hz, ns,
quaternions wxyz, an index column without a name), or with the recorder's text files alone:
acce.txt, gyro.txt (`t x y z`), pose.txt (`t px py pz qx qy qz qw`) and orientation.txt (`t qx qy qz
qw`, the game rotation vector), each on its own clock, ns, quaternions xyzw. The table is used if it
exists. IMU and pose belong to one rigid body; nothing is calibrated, and the accelerometer reads
1–3 % too much.

Later recorders use ARCore, whose world is y-up, and whose pose.txt is that of the camera. Their
android_sensor_pose.txt has the poses of the IMU; it is used if it exists, turned to z-up. Their
rates depend on the phone.

Sequences have 200 Hz. The lists name train and test; for validation whole people are held out of
train (`hold_out_of_train`).
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.parsing.tables import Table, read_text
from gnio_jax.data.splits import find_folders, find_list, hold_out, read_list
from gnio_jax.data.validation import FASTEST_WALKER
from gnio_jax.errors import InputError
from gnio_jax.files import file_in
from gnio_jax.numerics import quaternions, rotations
from gnio_jax.types import Sequence

RATE = 200.0

_TABLE = Path("processed") / "data.csv"
_ARCORE = "android_sensor_pose.txt"
_TEXT_FILES = ("gyro.txt", "acce.txt", "orientation.txt", "pose.txt", _ARCORE)
_LISTS = {
    "train": "list_train_publish_v2.txt",
    "val": "list_train_publish_v2.txt",
    "test": "list_test_publish_v2.txt",
    "seen": "list_test_publish_v2.txt",
    "unseen": "list_crosssubject.txt",
}
_PLACEMENTS = {"handheld": "handheld", "leg": "pocket", "bag": "bag", "body": "body"}


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The recordings of a split that are present, anywhere below the root; `seen` is `test`.

    `unseen` is the authors' cross-subject list. Recordings in no list are only in `all`, which is
    every recording below the root and needs no list.
    """
    folders = find_folders(root, _is_recording)
    if split == "all":
        return [_recording(folder, {}) for _, folder in sorted(folders.items())]
    path = find_list(root, _LISTS[split])
    chosen = read_list(path, lambda entry: folders.get(_name(entry)), root, DATASET.layout)
    if split not in ("train", "val"):
        return [_recording(folder, {}) for folder in chosen]
    held = hold_out_of_train(path)
    chosen = [folder for folder in chosen if (folder.name in held) == (split == "val")]
    if not chosen:
        problem = f"split '{split}' would be empty: {len(held)} sequences of this list are held out"
        raise InputError(path, problem, "complete the data, or choose another split")
    subjects = ", ".join(sorted({_subject(name) for name in held}))
    return [_recording(folder, {"held_out": subjects}) for folder in chosen]


def _recording(folder: Path, attributes: dict[str, str]) -> RecordingSource:
    files = tuple(file_in(folder, name) for name in (_TABLE, *_TEXT_FILES))
    return RecordingSource(folder.name, partial(read, folder), files, True, attributes)


def hold_out_of_train(path: Path) -> set[str]:
    """Names in the training list for validation: whole people, about a tenth of the list, the same
    in every copy of the data."""
    folders = read_list(path, lambda entry: Path(_name(entry)), path.parent, DATASET.layout)
    return hold_out({folder.name: _subject(folder.name) for folder in folders})


def _is_recording(folder: Path) -> bool:
    if file_in(folder, _TABLE).is_file():
        return True
    return all(file_in(folder, name).is_file() for name in ("acce.txt", "gyro.txt"))


def _name(entry: str) -> str:
    """The name in a line of the lists, `name,placement` or `name`."""
    return entry.partition(",")[0].strip()


def _subject(name: str) -> str:
    return name.partition("_")[0]


# --- one recording


def read(folder: Path) -> list[Sequence]:
    """Read a recording from its folder, at 200 Hz, from its table or else from the recorder's text
    files, divided at gaps of IMU or odometry that are longer than a window.

    `device_orientation` is the game rotation vector, turned to begin at the reference's attitude,
    because its yaw is arbitrary. Raises `InputError` naming file and field.
    """
    table, arcore = (file_in(folder, name).is_file() for name in (_TABLE, _ARCORE))
    streams = _from_table(folder) if table else _from_text_files(folder, arcore)
    words = re.findall("|".join(_PLACEMENTS), folder.name)
    attributes = {
        "group": _subject(folder.name),
        "subject": _subject(folder.name),
        "device": "Android phone" if arcore and not table else "Tango phone",
        "placement": _PLACEMENTS[words[0]] if words else "unknown",
        "truth": f"{'ARCore' if arcore and not table else 'Tango'} VIO of the phone itself",
        "imu_compensated": "Android's gyro bias" if arcore and not table else "no",
    }
    streams = streams._replace(attributes=attributes)
    pieces = assemble(streams, RATE, divide=True, max_speed=FASTEST_WALKER)
    for number, piece in enumerate(pieces):
        if piece.device_orientation is not None:
            device, first = rotations(piece.device_orientation), int(np.argmax(piece.valid))
            turned = rotations(piece.orientation[first]) * device[first].inv() * device
            pieces[number] = piece._replace(device_orientation=quaternions(turned))
    return pieces


def _from_table(folder: Path) -> Streams:
    path = file_in(folder, _TABLE)
    table = read_text(path)
    time, start, rows = table.clock("time", "ns", repeats="dropped")
    gyro, accel, position = (table.axes(name)[rows] for name in ("gyro_", "acce_", "pos_"))
    attitude, device = (
        table.rotations(*(name + axis for axis in "wxyz"))[rows] for name in ("ori_", "rv_")
    )
    return Streams.of_imu(folder.name, path, time, gyro, accel)._replace(
        start=start * 1e-9,
        poses=Poses(time, attitude, position, source=str(path)),
        device=Samples(time, quaternions(device), str(path)),
    )


def _from_text_files(folder: Path, arcore: bool) -> Streams:
    """Each file has a clock of its own; time 0 is the gyro's first stamp."""

    def text(name: str) -> Table:
        return read_text(file_in(folder, name), separator=" ", header=False)

    gyro, accel = text("gyro.txt"), text("acce.txt")
    pose = text(_ARCORE if arcore else "pose.txt")
    start = gyro.clock(0, "ns", repeats="kept")[1]

    def samples(table: Table) -> Samples:
        time, _, rows = table.clock(0, "ns", start, "dropped")
        return Samples(time, table.take(1, 2, 3)[rows], str(table.path))

    upright = Rotation.from_euler("x", 90.0 if arcore else 0.0, degrees=True)  # of a y-up world
    time, _, rows = pose.clock(0, "ns", start, "dropped")
    poses = Poses(
        time,
        upright * pose.rotations(4, 5, 6, 7, scalar_first=False)[rows],
        upright.apply(pose.take(1, 2, 3)[rows]),
        ends_pieces=True,
        source=str(pose.path),
    )
    device = None
    if file_in(folder, "orientation.txt").is_file():
        game = text("orientation.txt")
        time, _, rows = game.clock(0, "ns", start, "dropped")
        attitude = game.rotations(1, 2, 3, 4, scalar_first=False)[rows]
        device = Samples(time, quaternions(attitude), str(game.path))
    streams = Streams(folder.name, str(folder), samples(gyro), samples(accel))
    return streams._replace(start=start * 1e-9, poses=poses, device=device)


DATASET = Dataset(
    name="ridi",
    recordings=recordings,
    splits=(*_LISTS, "all"),
    rate=RATE,
    source="https://github.com/higerra/ridi_imu "
    "(its README links the data, ridi_data_publish_v2.zip)",
    layout="<root>/**/<sequence>/"
    "{processed/data.csv or acce.txt,gyro.txt,pose.txt,orientation.txt} and "
    "<root>/**/{list_train_publish_v2,list_test_publish_v2,list_crosssubject}.txt",
    licence="not stated by the authors; cite Yan, Shan, Furukawa, RIDI, ECCV 2018",
)
