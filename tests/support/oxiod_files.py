"""Writes known walks as OxIOD's native files, with the traps of the real ones.

The walk is analytic, so that every quantity is known at any time; the conventions (iOS's sign, G,
Vicon's quaternion order, where the marker body sits) are written down here a second time,
independently of the loader.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

G = 9.80665
GRAVITY = 9.81
EPOCH = 1_495_463_250.0


class Truth(NamedTuple):
    """What the loader has to find out again."""

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
    pace: float = 1.0
    eight: float = 0.0
    """s; where it is not 0 the walk is a figure of eight of this period: after half of it one turns
    as fast, to the other side."""


def position(time: np.ndarray, truth: Truth) -> np.ndarray:
    """The phone's, in a level world, m: rounds (and eights) in a room of 3 × 6 m, with the bounce
    and sway of a gait."""
    t = np.asarray(time) * truth.pace
    if truth.eight:
        x = 1.2 * np.sin(4 * np.pi * t / truth.eight) + 0.02 * np.sin(2 * np.pi * 0.9 * t)
        y = 2.0 * np.sin(2 * np.pi * t / truth.eight) + 0.02 * np.sin(2 * np.pi * 1.8 * t + 1.0)
        return np.stack([x, y, 1.2 + 0.025 * np.sin(2 * np.pi * 1.8 * t)], axis=-1)
    x = (
        1.2 * np.sin(2 * np.pi * t / 17.0)
        + 0.3 * np.sin(2 * np.pi * t / 6.1)
        + 0.02 * np.sin(2 * np.pi * 0.9 * t)
    )
    y = (
        2.0 * np.cos(2 * np.pi * t / 17.0)
        + 0.4 * np.sin(2 * np.pi * t / 9.3)
        + 0.02 * np.sin(2 * np.pi * 1.8 * t + 1.0)
    )
    z = 1.2 + 0.025 * np.sin(2 * np.pi * 1.8 * t)
    return np.stack([x, y, z], axis=-1)


def attitude(time: np.ndarray, truth: Truth) -> Rotation:
    """Phone → level world."""
    t = np.asarray(time) * truth.pace
    if truth.eight:
        yaw = 2.2 * np.sin(2 * np.pi * t / truth.eight) + 0.06 * np.sin(2 * np.pi * 0.9 * t)
        pitch = 0.5 + 0.05 * np.sin(2 * np.pi * 1.8 * t)
        roll = 0.05 * np.sin(2 * np.pi * 0.9 * t + 0.4)
        return Rotation.from_euler("ZXY", np.stack([yaw, pitch, roll], axis=-1))
    yaw = (
        2 * np.pi * t / 17.0
        + 0.5 * np.sin(2 * np.pi * t / 6.1)
        + 0.06 * np.sin(2 * np.pi * 0.9 * t)
    )
    pitch = 0.5 + 0.05 * np.sin(2 * np.pi * 1.8 * t) + 0.05 * np.sin(2 * np.pi * t / 7.7)
    roll = 0.05 * np.sin(2 * np.pi * 0.9 * t + 0.4) + 0.04 * np.sin(2 * np.pi * t / 5.3)
    return Rotation.from_euler("ZXY", np.stack([yaw, pitch, roll], axis=-1))


def velocity(time: np.ndarray, truth: Truth, h: float = 1e-4) -> np.ndarray:
    return (position(time + h, truth) - position(time - h, truth)) / (2 * h)


def rate(time: np.ndarray, truth: Truth, h: float = 1e-4) -> np.ndarray:
    """Angular rate in the phone, rad/s."""
    return (attitude(time - h, truth).inv() * attitude(time + h, truth)).as_rotvec() / (2 * h)


def force(time: np.ndarray, truth: Truth, h: float = 2e-3) -> np.ndarray:
    """Specific force in the phone, m/s²."""
    acceleration = (
        -position(time + 2 * h, truth)
        + 16 * position(time + h, truth)
        - 30 * position(time, truth)
        + 16 * position(time - h, truth)
        - position(time - 2 * h, truth)
    ) / (12 * h**2)
    return attitude(time, truth).inv().apply(acceleration + np.array([0.0, 0.0, GRAVITY]))


def iphone_columns(time: np.ndarray, truth: Truth) -> np.ndarray:
    """The 15 columns after the time. The phone's yaw is its own; gravity and acceleration are in G
    with iOS's sign."""
    own = Rotation.from_euler("z", 1.1) * attitude(time, truth)
    yaw, pitch, roll = own.as_euler("ZXY").T
    gravity = -own.inv().apply([0.0, 0.0, 1.0])
    user = -force(time - truth.accel_delay, truth) / G - gravity
    magnet = own.inv().apply([20.0, 0.0, -40.0])
    return np.concatenate(
        [
            np.stack([roll, pitch, yaw], axis=1),
            rate(time, truth) + truth.gyro_bias,
            gravity,
            user,
            magnet,
        ],
        axis=1,
    )


def vicon_columns(time: np.ndarray, truth: Truth, seed: int = 0, flips: bool = True) -> np.ndarray:
    """Position and quaternion xyzw of the marker body in Vicon's tilted world, noisy, with one flip
    and one jump of 3 rows."""
    noise = np.random.default_rng(seed)
    axis = np.cross(truth.up, [0.0, 0.0, 1.0])
    level = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.arccos(truth.up[2]))
    phone = level.inv() * attitude(time, truth)
    marker = phone * truth.extrinsic.inv()
    place = level.inv().apply(position(time, truth)) - marker.apply(truth.lever)
    marker = marker * Rotation.from_rotvec(noise.normal(0, np.radians(0.03), (len(time), 3)))
    place = place + noise.normal(0, 1e-4, place.shape)
    quaternion = marker.as_quat()
    if flips:
        row = len(time) // 3
        quaternion[row : row + 3] = (
            marker[row : row + 3] * Rotation.from_euler("y", 150, degrees=True)
        ).as_quat()
        place[2 * row : 2 * row + 3] += [0.4, 0.2, 0.0]
    return np.concatenate([place, quaternion], axis=1)


def write_rows(path: Path, time: list[str], columns: np.ndarray, style: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    styles = ",".join([style] * columns.shape[1])
    values = columns.tolist()
    rows = [f"{stamp}," + styles % tuple(row) for stamp, row in zip(time, values, strict=True)]
    path.write_text("\n".join(rows) + "\n")


def write_raw(
    folder: Path,
    number: int,
    truth: Truth,
    seconds: float = 60.0,
    rate_hz: float = 99.92,
    truth_name: str = "vi",
) -> None:
    """`raw/imuK.csv` in unix seconds of two decimals, `raw/viK.csv` in unix ns that begins 3 s
    earlier and lacks 15 rows."""
    time = np.arange(int(seconds * rate_hz)) / rate_hz + 0.003
    columns = iphone_columns(time, truth)
    stamps = np.round(EPOCH + time, 2)
    order = np.arange(len(time))
    for row in range(500, len(time) - 5, 900):  # two rows changed places
        order[[row, row + 1]] = order[[row + 1, row]]
    write_rows(
        folder / "raw" / f"imu{number}.csv",
        [f"{stamp:.2f}" for stamp in stamps[order]],
        columns[order],
        "%.6f",
    )

    seen = np.arange(-3.0, seconds + 2.0, 0.01)
    seen = np.delete(seen, slice(len(seen) // 2, len(seen) // 2 + 15))
    stamps_ns = (
        np.round((EPOCH + seen * (1 + truth.skew) + truth.offset) * 1e3).astype(np.int64)
        * 1_000_000
    )
    frames = np.arange(len(seen)) + 54908.0
    vicon = np.concatenate([frames[:, None], vicon_columns(seen, truth)], axis=1)
    write_rows(
        folder / "raw" / f"{truth_name}{number}.csv",
        [str(stamp) for stamp in stamps_ns],
        vicon,
        "%.9f",
    )


def write_syn(
    folder: Path, number: int, truth: Truth, seconds: float = 60.0, rate_hz: float = 99.92
) -> None:
    """`syn` files: no time left, the phone's rows repeated onto 100 Hz, Vicon late by `lag_rows`
    and held now and then."""
    sampled = np.arange(int(seconds * rate_hz) + 200) / rate_hz
    grid = np.arange(int(seconds * 100)) / 100
    nearest = np.clip(np.round(grid * rate_hz).astype(int), 0, len(sampled) - 1)
    stamps = ["1.50E+11"] * len(grid)
    write_rows(
        folder / "syn" / f"imu{number}.csv", stamps, iphone_columns(sampled[nearest], truth), "%.5g"
    )
    vicon = vicon_columns(grid + truth.lag_rows / 100, truth, seed=1)
    for row in range(300, len(grid) - 10, 700):
        vicon[row : row + 4] = vicon[row - 1]
    frames = np.full((len(grid), 1), 5.41e5)
    write_rows(
        folder / "syn" / f"vi{number}.csv", stamps, np.concatenate([frames, vicon], axis=1), "%.5g"
    )


def write_nexus_raw(
    folder: Path, number: int, truth: Truth, seconds: float = 60.0, rate_hz: float = 99.297
) -> None:
    """Rows `t_ms, type, x, y, z`: 1 accelerometer (m/s², Android's sign), 2 magnetometer, 4 gyro;
    Vicon at 200 Hz."""
    time = np.arange(int(seconds * rate_hz)) / rate_hz
    rows = []
    for kind, values in (
        (1, force(time, truth)),
        (2, np.full((len(time), 3), 20.0)),
        (4, rate(time, truth) + truth.gyro_bias),
    ):
        first = 12 if kind == 4 else 0
        rows += [
            (round((EPOCH + t) * 1e3), kind, *value)
            for t, value in zip(time[first:], values[first:], strict=True)
        ]
    rows.sort(key=lambda row: row[:2])
    path = folder / "raw" / f"imu{number}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        "\n".join(f"{row[0]},{row[1]},{row[2]:.7f},{row[3]:.7f},{row[4]:.7f}" for row in rows)
        + "\n"
    )
    seen = np.arange(-1.0, seconds + 1.0, 0.005)
    stamps = [str(round((EPOCH + t + truth.offset) * 1e3) * 1_000_000) for t in seen]
    vicon = np.concatenate([np.arange(len(seen))[:, None], vicon_columns(seen, truth)], axis=1)
    write_rows(folder / "raw" / f"vi{number}.csv", stamps, vicon, "%.9f")


def write_large_scale(
    folder: Path,
    number: int,
    truth: Truth,
    seconds: float = 90.0,
    offset: float = 0.2,
    broken: bool = False,
) -> None:
    """`syn/imuK.csv` with true unix seconds, `syn/tangoK.csv` with a dozen more rows, another yaw
    and a useless attitude."""
    time = np.arange(int(seconds * 99.92)) / 99.92
    stamps = [f"{stamp:.2f}" for stamp in EPOCH + time]
    write_rows(folder / "syn" / f"imu{number}.csv", stamps, iphone_columns(time, truth), "%.6f")
    seen = np.arange(len(time) + 12) / 100 - offset
    turned = Rotation.from_euler("z", 40, degrees=True).apply(
        position(seen, truth._replace(pace=0.83) if broken else truth)
    )
    turned[7::17] = turned[6::17][: len(turned[7::17])]  # held rows
    noise = np.random.default_rng(3).normal(0, 5e-4, turned.shape)
    quaternion = Rotation.random(len(seen), random_state=0).as_quat()
    columns = np.concatenate(
        [np.full((len(seen), 1), 1.5043e11), turned + noise, quaternion], axis=1
    )
    columns[7::17] = columns[6::17][: len(columns[7::17])]
    write_rows(
        folder / "syn" / f"tango{number}.csv", [f"{59601 + t:.0f}" for t in seen], columns, "%.5g"
    )
