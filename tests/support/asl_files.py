"""Writes the known walk in the ASL layout of EuRoC and TUM-VI, with the traps of the published
files.

`T_BS` places a sensor in a body: the IMU is at the known walk's place, the reference may be another
point of the same body.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import known_walk

EPOCH = 1_520_530_308_181_901_469
IMU_HEADER = [
    "#timestamp [ns]",
    *(f"w_RS_S_{a} [rad s^-1]" for a in "xyz"),
    *(f"a_RS_S_{a} [m s^-2]" for a in "xyz"),
]
LONG_HEADER = [
    "#timestamp",
    *(f" p_RS_R_{a} [m]" for a in "xyz"),
    *(f" q_RS_{a} []" for a in "wxyz"),
    *(f" v_RS_R_{a} [m s^-1]" for a in "xyz"),
    *(f" b_w_RS_S_{a} [rad s^-1]" for a in "xyz"),
    *(f" b_a_RS_S_{a} [m s^-2]" for a in "xyz"),
]
SHORT_HEADER = [
    "#time(ns)",
    "px",
    "py",
    "pz",
    "qw",
    "qx",
    "qy",
    "qz",
    "vx",
    "vy",
    "vz",
    "bwx",
    "bwy",
    "bwz",
    "bax",
    "bay",
    "baz",
]


class Mount(NamedTuple):
    """T_BS."""

    rotation: Rotation = Rotation.identity()
    translation: np.ndarray = np.zeros(3)


def write_table(
    path: Path,
    header: list[str],
    stamps: np.ndarray,
    values: np.ndarray,
    style: str = "%.9f",
    shuffle: bool = False,
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = (
        np.random.default_rng(3).permutation(len(header)) if shuffle else np.arange(len(header))
    )
    styles = ",".join("%s" if i == 0 else style for i in columns)
    cells = zip(stamps.tolist(), *values.T.tolist(), strict=True)
    names = [header[i].strip().lstrip("#") for i in columns] if shuffle else header
    text = [
        ("#" if shuffle else "") + ",".join(names),
        *(styles % tuple(row[i] for i in columns) for row in cells),
    ]
    path.write_text("\n".join(text) + "\n")


def write_yaml(path: Path, mount: Mount, opencv: bool = False) -> None:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = mount.rotation.as_matrix(), mount.translation
    data = ", ".join(repr(float(value)) for value in matrix.ravel())
    head = "%YAML:1.0\n---\n" if opencv else "#Default imu sensor yaml file\n"
    tag = " !!opencv-matrix" if opencv else ""
    path.write_text(
        f"{head}sensor_type: imu\ncomment: VI-Sensor IMU\n\n"
        f"T_BS:{tag}\n  cols: 4\n  rows: 4\n  data: [{data}]\nrate_hz: 200\n"
    )


def write_imu(
    mav: Path,
    seconds: float = 12.0,
    step: float = 0.005,
    bias: float = 0.0,
    spoil=None,
    shuffle: bool = False,
) -> None:
    """`spoil(stamps, values) -> (stamps, values)` may damage the rows."""
    time = np.arange(round(seconds / step)) * step
    stamps = EPOCH + np.round(time * 1e9).astype(np.int64)
    values = np.concatenate([known_walk.rate(time) + bias, known_walk.force(time)], axis=1)
    if spoil:
        stamps, values = spoil(stamps, values)
    write_table(mav / "imu0" / "data.csv", IMU_HEADER, stamps, values, shuffle=shuffle)


def poses(
    time: np.ndarray, mount: Mount, imu_mount: Mount
) -> tuple[np.ndarray, Rotation, np.ndarray]:
    """(position, attitude, velocity) of the reference's sensor: world ← IMU ← body ← sensor."""
    attitude, h = known_walk.attitude, 1e-5
    turn = imu_mount.rotation.inv() * mount.rotation
    lever = imu_mount.rotation.inv().apply(mount.translation - imu_mount.translation)
    speed = known_walk.velocity(time) + (
        attitude(time + h).apply(lever) - attitude(time - h).apply(lever)
    ) / (2 * h)
    return known_walk.position(time) + attitude(time).apply(lever), attitude(time) * turn, speed


def write_estimate(
    mav: Path,
    first: float = 1.0,
    last: float = 11.0,
    step: float = 0.005,
    header: list[str] = LONG_HEADER,
    mount: Mount | None = None,
    imu_mount: Mount | None = None,
    spoil=None,
    shuffle: bool = False,
) -> None:
    """state_groundtruth_estimate0, at stamps of its own."""
    time = np.arange(first + 0.0013, last, step)
    place, attitude, speed = poses(time, mount or Mount(), imu_mount or Mount())
    x, y, z, w = attitude.as_quat().T
    values = np.concatenate(
        [place, np.stack([w, x, y, z], axis=1), speed, np.full((len(time), 6), 0.07)], axis=1
    )
    stamps = EPOCH + np.round(time * 1e9).astype(np.int64)
    if spoil:
        stamps, values = spoil(stamps, values)
    folder = mav / "state_groundtruth_estimate0"
    write_table(folder / "data.csv", header, stamps, values, shuffle=shuffle)
    if mount is not None:
        write_yaml(folder / "sensor.yaml", mount)


def write_mocap(
    mav: Path,
    first: float = 1.0,
    last: float = 11.0,
    gaps: tuple[tuple[float, float], ...] = (),
    noise: float = 0.0,
    flips: tuple[float, ...] = (),
    mount: Mount | None = None,
    spoil=None,
) -> None:
    """mocap0 at 120 Hz: nothing within `gaps` (s), flips of single poses; `noise` 1 is 0.1° and 0.4
    mm."""
    random = np.random.default_rng(11)
    time = np.arange(first, last, 1 / 120.0)
    place, attitude, _ = poses(time, mount or Mount(), Mount())
    attitude = attitude * Rotation.from_rotvec(
        random.normal(0, np.radians(0.1), (len(time), 3)) * noise
    )
    place = place + random.normal(0, 4e-4, place.shape) * noise
    x, y, z, w = attitude.as_quat().T
    sign = np.where(np.arange(len(time)) % 50 < 25, 1.0, -1.0)[:, None]  # q and −q are one rotation
    values = np.concatenate([place, np.stack([w, x, y, z], axis=1) * sign], axis=1)
    for when in flips:
        row = int(np.argmin(np.abs(time - when)))
        values[row, 3:] = (attitude[row] * Rotation.from_euler("x", 120, degrees=True)).as_quat()[
            [3, 0, 1, 2]
        ]
        values[row, :3] += 0.3
    keep = (
        ~np.any([(time > start) & (time < end) for start, end in gaps], axis=0)
        if gaps
        else np.ones(len(time), dtype=bool)
    )
    stamps, values = (EPOCH + np.round(time * 1e9).astype(np.int64))[keep], values[keep]
    if spoil:
        stamps, values = spoil(stamps, values)
    write_table(mav / "mocap0" / "data.csv", LONG_HEADER[:8], stamps, values, "%.10f")
    if mount is not None:
        write_yaml(mav / "mocap0" / "sensor.yaml", mount, opencv=True)
