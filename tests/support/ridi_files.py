"""Files in RIDI's two layouts."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import known_walk as walk

BOOT = 177_001_880_550_403  # ns

GAME_YAW = Rotation.from_euler("z", -1.3)
"""The phone's own filter has a north of its own."""

HEADER = (
    "",
    "time",
    "gyro_x",
    "gyro_y",
    "gyro_z",
    "acce_x",
    "acce_y",
    "acce_z",
    "linacce_x",
    "linacce_y",
    "linacce_z",
    "grav_x",
    "grav_y",
    "grav_z",
    "magnet_x",
    "magnet_y",
    "magnet_z",
    "pos_x",
    "pos_y",
    "pos_z",
    "ori_w",
    "ori_x",
    "ori_y",
    "ori_z",
    "rv_w",
    "rv_x",
    "rv_y",
    "rv_z",
)


def wxyz(rotation):
    return rotation.as_quat()[:, [3, 0, 1, 2]]


def table(time):
    """The table's columns by name, without its index."""
    gravity = walk.attitude(time).inv().apply([0, 0, 9.81])
    blocks = [
        np.round(BOOT + time * 1e9)[:, None],
        walk.rate(time),
        walk.force(time),
        walk.force(time) - gravity,
        gravity,
        np.full((len(time), 3), 30.0),
        walk.position(time),
        wxyz(walk.attitude(time)),
        wxyz(GAME_YAW * walk.attitude(time)),
    ]
    return dict(zip(HEADER[1:], np.concatenate(blocks, axis=1).T, strict=True))


def write_table(root, name, time=None, order=None, rows=None, spoil=None):
    """`<name>/processed/data.csv` as pandas writes it: an index without a name first. `rows` picks
    (and reorders) rows."""
    time = np.arange(int(walk.SECONDS * 202.3)) / 202.3 if time is None else time
    columns = table(time)
    if spoil:
        spoil(columns)
    names = [name for name in HEADER[1:] if name in columns] if order is None else order
    values = np.stack([columns[name] for name in names], axis=1)
    rows = np.arange(len(time)) if rows is None else rows
    path = root / name / "processed" / "data.csv"
    path.parent.mkdir(parents=True)
    lines = [",".join(["", *names])]
    lines += [f"{i}," + ",".join(map(repr, row)) for i, row in enumerate(values[rows].tolist())]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_text(root, name, poses="pose.txt", pose_time=None, gyro_time=None, spoil=None):
    """The recorder's files: every sensor on its own clock, quaternions xyzw, two rows late and one
    there twice."""
    gyro_time = np.arange(-0.3, walk.SECONDS, 1 / 388.0) if gyro_time is None else gyro_time
    pose_time = np.arange(0.0, walk.SECONDS - 0.4, 1 / 30.0) if pose_time is None else pose_time
    force_time, own_time = (
        np.arange(-0.2, walk.SECONDS, 1 / 388.0) + 5.3e-4,
        np.arange(-0.25, walk.SECONDS, 1 / 194.0),
    )
    place, attitude = walk.position(pose_time), walk.attitude(pose_time)
    if poses == "android_sensor_pose.txt":
        # ARCore's world is y-up: z of the level world is its y, y its −z.
        turn = Rotation.from_euler("x", -90, degrees=True)
        place, attitude = turn.apply(place), turn * attitude
    files = {
        "gyro.txt": [gyro_time, walk.rate(gyro_time)],
        "acce.txt": [force_time, walk.force(force_time)],
        "orientation.txt": [own_time, (GAME_YAW * walk.attitude(own_time)).as_quat()],
        poses: [pose_time, np.concatenate([place, attitude.as_quat()], axis=1)],
    }
    if poses != "pose.txt":  # the camera's, looking elsewhere
        camera = (attitude * Rotation.from_euler("z", 90, degrees=True)).as_quat()
        files["pose.txt"] = [pose_time, np.concatenate([place, camera], axis=1)]
    if spoil:
        spoil(files)
    folder = root / name
    folder.mkdir(parents=True)
    for file, (time, values) in files.items():
        rows = np.arange(len(time))
        rows[[40, 41]] = rows[[41, 40]]
        rows = np.insert(rows, 70, rows[70])
        style = " ".join(["%.9f"] * values.shape[1])
        lines = [
            f"{BOOT + round(stamp * 1e9)} " + style % tuple(row)
            for stamp, row in zip(time[rows].tolist(), values[rows].tolist(), strict=True)
        ]
        (folder / file).write_text(
            "# Created at Wed Dec 27 22:30:22 GMT+09:00 2023\n" + "\n".join(lines) + "\n"
        )
    return folder


def names(sequences):
    return {sequence.name for sequence in sequences}
