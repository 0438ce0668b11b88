"""Files in RIDI's two layouts."""

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import known_walk as walk

BOOT = 177_001_880_550_403  # ns

GAME_YAW = Rotation.from_euler("z", -1.3)
"""The phone's own filter has a north of its own."""


def table(time):
    """The table's columns by name, without its index."""
    attitude = walk.attitude(time)
    blocks = {
        "gyro": walk.rate(time),
        "acce": walk.force(time),
        "magnet": np.full((len(time), 3), 30.0),
        "pos": walk.position(time),
        "ori": attitude.as_quat(scalar_first=True),
        "rv": (GAME_YAW * attitude).as_quat(scalar_first=True),
    }
    columns = {"time": np.round(BOOT + time * 1e9)}
    for name, values in blocks.items():
        axes = "xyz" if values.shape[1] == 3 else "wxyz"
        columns |= {f"{name}_{axis}": row for axis, row in zip(axes, values.T, strict=True)}
    return columns


def write_table(root, name, time, order=None, rows=None, spoil=None):
    """`<name>/processed/data.csv` as pandas writes it: an index without a name first. `rows` picks
    (and reorders) rows."""
    columns = table(time)
    if spoil:
        spoil(columns)
    names = list(columns) if order is None else order
    values = np.stack([columns[name] for name in names], axis=1)
    rows = np.arange(len(time)) if rows is None else rows
    path = root / name / "processed" / "data.csv"
    path.parent.mkdir(parents=True)
    lines = [",".join(["", *names])]
    lines += [f"{i}," + ",".join(map(repr, row)) for i, row in enumerate(values[rows].tolist())]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_text(root, name, poses="pose.txt", pose_time=None, seconds=walk.SECONDS, without=()):
    """The recorder's files: every sensor on its own clock, quaternions xyzw, two rows late and one
    there twice. `without` names files that are not there."""
    gyro_time, own_time = np.arange(-0.3, seconds, 1 / 388.0), np.arange(-0.25, seconds, 1 / 194.0)
    force_time = np.arange(-0.2, seconds, 1 / 388.0) + 5.3e-4
    pose_time = np.arange(0.0, seconds - 0.4, 1 / 30.0) if pose_time is None else pose_time
    position, attitude = walk.position(pose_time), walk.attitude(pose_time)
    if poses == "android_sensor_pose.txt":
        # ARCore's world is y-up: z of the level world is its y, y its −z.
        turn = Rotation.from_euler("x", -90, degrees=True)
        position, attitude = turn.apply(position), turn * attitude
    files = {
        "gyro.txt": (gyro_time, walk.rate(gyro_time)),
        "acce.txt": (force_time, walk.force(force_time)),
        "orientation.txt": (own_time, (GAME_YAW * walk.attitude(own_time)).as_quat()),
        poses: (pose_time, np.concatenate([position, attitude.as_quat()], axis=1)),
    }
    if poses != "pose.txt":  # the camera's, looking elsewhere
        camera = (attitude * Rotation.from_euler("z", 90, degrees=True)).as_quat()
        files["pose.txt"] = (pose_time, np.concatenate([position, camera], axis=1))
    folder = root / name
    folder.mkdir(parents=True)
    for file, (time, values) in files.items():
        rows = np.arange(len(time))
        rows[[40, 41]] = rows[[41, 40]]
        rows = np.insert(rows, 70, rows[70])
        style = " ".join(["%.9f"] * values.shape[1])
        lines = ["# Created at Wed Dec 27 22:30:22 GMT+09:00 2023"]
        for stamp, row in zip(time[rows].tolist(), values[rows].tolist(), strict=True):
            lines.append(f"{BOOT + round(stamp * 1e9)} " + style % tuple(row))
        if file not in without:
            (folder / file).write_text("\n".join(lines) + "\n")
    return folder
