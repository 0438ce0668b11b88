"""Writes known walks as OxIOD's native files, with the traps of the real ones.

The conventions (iOS's sign, G, Vicon's quaternion order, where the marker body sits) are written
down here a second time, independently of the loader.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support.known_walk import KNOWN, Term, Walk

G = 9.80665
EPOCH = 1_495_463_250.0
FIELD = Rotation.from_euler("z", -1.1).apply([20.0, 0.0, -40.0])
"""The earth's field in the world of the walk, µT."""


def eight(period: float) -> Walk:
    """A figure of eight: after half of its period (s) one turns as fast, to the other side."""
    sway, bounce = (0.02, 0.9, 0.0), (0.02, 1.8, 1.0)
    coordinates = (
        Term(0.0, 0.0, ((1.2, 2 / period, 0.0), sway)),
        Term(0.0, 0.0, ((2.0, 1 / period, 0.0), bounce)),
        Term(1.2, 0.0, ((0.025, 1.8, 0.0),)),
    )
    yaw = Term(0.0, 0.0, ((2.2, 1 / period, 0.0), (0.06, 0.9, 0.0)))
    return Walk(
        coordinates, (yaw, Term(0.5, 0.0, ((0.05, 1.8, 0.0),)), Term(0, 0, ((0.05, 0.9, 0.4),)))
    )


class Truth(NamedTuple):
    """What the loader has to find out again."""

    walk: Walk = KNOWN
    """Of the phone, in a level world."""
    extrinsic: Rotation = Rotation.from_euler("ZXY", [-175.0, 1.0, 1.5], degrees=True)
    lever: np.ndarray = np.array([-0.02, 0.08, 0.005])
    up: np.ndarray = np.array([-0.0126, 0.002, 1.0]) / np.linalg.norm([-0.0126, 0.002, 1.0])
    gyro_bias: np.ndarray = np.array([-0.007, 0.003, -0.012])
    accel_delay: float = 0.02
    """s; the phone's accelerometer tells what was."""
    offset: float = 0.15
    """s, Vicon's clock minus the phone's, at the start."""
    skew: float = 0.0
    """By which Vicon's clock runs fast."""
    lag_rows: float = -7.0
    """In syn files Vicon's row i is the phone's row i + lag."""


def iphone_columns(time, truth):
    """The 15 columns after the time. The phone's yaw is its own; gravity and acceleration are in G
    with iOS's sign."""
    phone = Rotation.from_euler("z", 1.1) * truth.walk.attitude(time)
    gravity = -phone.inv().apply([0.0, 0.0, 1.0])
    user = -truth.walk.force(time - truth.accel_delay) / G - gravity
    magnet = truth.walk.attitude(time).inv().apply(FIELD)
    angles, gyro = phone.as_euler("ZXY")[:, [2, 1, 0]], truth.walk.rate(time) + truth.gyro_bias
    return np.concatenate([angles, gyro, gravity, user, magnet], axis=1)


def vicon_columns(time, truth, seed=0):
    """Position and quaternion xyzw of the marker body in Vicon's tilted world, noisy, with one flip
    and one jump of 3 rows."""
    noise = np.random.default_rng(seed)
    axis = np.cross(truth.up, [0.0, 0.0, 1.0])
    level = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arccos(truth.up[2]))
    marker = level.inv() * truth.walk.attitude(time) * truth.extrinsic.inv()
    position = level.inv().apply(truth.walk.position(time)) - marker.apply(truth.lever)
    marker = marker * Rotation.from_rotvec(noise.normal(0, np.radians(0.03), (len(time), 3)))
    position = position + noise.normal(0, 1e-4, position.shape)
    quaternion, row = marker.as_quat(), len(time) // 3
    flipped = marker[row : row + 3] * Rotation.from_euler("y", 150, degrees=True)
    quaternion[row : row + 3] = flipped.as_quat()
    position[2 * row : 2 * row + 3] += [0.4, 0.2, 0.0]
    return np.concatenate([position, quaternion], axis=1)


def write_rows(path, time, columns, style):
    path.parent.mkdir(parents=True, exist_ok=True)
    styles = ",".join([style] * columns.shape[1])
    values = columns.tolist()
    rows = [f"{stamp}," + styles % tuple(row) for stamp, row in zip(time, values, strict=True)]
    path.write_text("\n".join(rows) + "\n")


def write_vicon(path, stamps, columns, style="%.9f"):
    """With the number of the frame in front."""
    frames = np.arange(len(columns))[:, None] + 54908.0
    write_rows(path, stamps, np.concatenate([frames, columns], axis=1), style)


def nanoseconds(time, truth):
    """Vicon's stamps: unix ns of whole milliseconds."""
    unix = EPOCH + time * (1 + truth.skew) + truth.offset
    return [f"{round(stamp)}000000" for stamp in unix * 1e3]


def write_raw(folder, number, truth, seconds):
    """`raw/imuK.csv` in unix seconds of two decimals, `raw/viK.csv` in unix ns that begins 3 s
    earlier and lacks 15 rows."""
    time = np.arange(int(seconds * 99.92)) / 99.92 + 0.003
    order = np.arange(len(time))
    for row in range(500, len(time) - 5, 900):  # two rows changed places
        order[[row, row + 1]] = order[[row + 1, row]]
    stamps = [f"{stamp:.2f}" for stamp in EPOCH + time[order]]
    columns = iphone_columns(time[order], truth)
    write_rows(folder / "raw" / f"imu{number}.csv", stamps, columns, "%.6f")
    vicon_time = np.arange(-3.0, seconds + 2.0, 0.01)
    vicon_time = np.delete(vicon_time, slice(len(vicon_time) // 2, len(vicon_time) // 2 + 15))
    path = folder / "raw" / f"vi{number}.csv"
    write_vicon(path, nanoseconds(vicon_time, truth), vicon_columns(vicon_time, truth))


def write_syn(folder, number, truth, seconds):
    """`syn` files: no time left, the phone's rows repeated onto 100 Hz, Vicon late by `lag_rows`
    and held now and then."""
    sampled, grid = np.arange(int(seconds * 99.92) + 200) / 99.92, np.arange(seconds * 100) / 100
    columns = iphone_columns(sampled[np.round(grid * 99.92).astype(int)], truth)
    stamps = ["1.50E+11"] * len(grid)
    write_rows(folder / "syn" / f"imu{number}.csv", stamps, columns, "%.5g")
    vicon = vicon_columns(grid + truth.lag_rows / 100, truth, seed=1)
    for row in range(300, len(grid) - 10, 700):
        vicon[row : row + 4] = vicon[row - 1]
    write_vicon(folder / "syn" / f"vi{number}.csv", stamps, vicon, "%.5g")


def write_nexus_raw(folder, number, truth, seconds):
    """Rows `t_ms, type, x, y, z`: 1 accelerometer (m/s², Android's sign), 2 magnetometer, 4 gyro;
    Vicon at 200 Hz."""
    time = np.arange(int(seconds * 99.297)) / 99.297
    rows = []
    for kind, first, values in (
        (1, 0, truth.walk.force(time)),
        (2, 0, truth.walk.attitude(time).inv().apply(FIELD)),
        (4, 12, truth.walk.rate(time) + truth.gyro_bias),
    ):
        stamps = np.round((EPOCH + time) * 1e3)
        rows.append(np.column_stack([stamps, np.full(len(time), kind), values])[first:])
    table = np.concatenate(rows)
    table = table[np.lexsort([table[:, 1], table[:, 0]])]
    stamps = [f"{stamp:.0f}" for stamp in table[:, 0]]
    write_rows(folder / "raw" / f"imu{number}.csv", stamps, table[:, 1:], "%.9g")
    vicon_time = np.arange(-1.0, seconds + 1.0, 0.005)
    path = folder / "raw" / f"vi{number}.csv"
    write_vicon(path, nanoseconds(vicon_time, truth), vicon_columns(vicon_time, truth))


def write_large_scale(folder, number, truth, seconds, broken=False):
    """`syn/imuK.csv` with true unix seconds, `syn/tangoK.csv` with a dozen more rows, another yaw
    and a useless attitude, 0.2 s late."""
    time = np.arange(int(seconds * 99.92)) / 99.92
    stamps = [f"{stamp:.2f}" for stamp in EPOCH + time]
    columns = iphone_columns(time, truth)
    write_rows(folder / "syn" / f"imu{number}.csv", stamps, columns, "%.6f")
    tango_time = np.arange(len(time) + 12) / 100 - 0.2
    walked = (truth.walk.paced(0.83) if broken else truth.walk).position(tango_time)
    position = Rotation.from_euler("z", 40, degrees=True).apply(walked)
    position = position + np.random.default_rng(3).normal(0, 5e-4, position.shape)
    quaternion = Rotation.random(len(tango_time), random_state=0).as_quat()
    columns = np.concatenate([position, quaternion], axis=1)
    columns[7::17] = columns[6::17][: len(columns[7::17])]  # held rows
    stamps = [f"{59601 + t:.0f}" for t in tango_time]
    write_vicon(folder / "syn" / f"tango{number}.csv", stamps, columns, "%.5g")
