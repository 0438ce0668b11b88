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


def _names(*blocks: tuple[str, str, str]) -> list[str]:
    return [f" {name}_{axis} [{unit}]" for name, axes, unit in blocks for axis in axes]


IMU_HEADER = [
    "#timestamp [ns]",
    *_names(("w_RS_S", "xyz", "rad s^-1"), ("a_RS_S", "xyz", "m s^-2")),
]
IMU_HEADER = [name.strip() for name in IMU_HEADER]
POSE_HEADER = ["#timestamp", *_names(("p_RS_R", "xyz", "m"), ("q_RS", "wxyz", ""))]
LONG_HEADER = [*POSE_HEADER, *_names(("v_RS_R", "xyz", "m s^-1"), ("b_w_RS_S", "xyz", "rad s^-1"))]
LONG_HEADER += _names(("b_a_RS_S", "xyz", "m s^-2"))
SHORT_HEADER = "#time(ns) px py pz qw qx qy qz vx vy vz bwx bwy bwz bax bay baz".split()


class Mount(NamedTuple):
    """T_BS."""

    rotation: Rotation = Rotation.identity()
    translation: np.ndarray = np.zeros(3)


def mount(axes: str, degrees: list[float], translation: list[float]) -> Mount:
    return Mount(Rotation.from_euler(axes, degrees, degrees=True), np.array(translation))


def write_table(
    path: Path,
    header: list[str],
    time: np.ndarray,
    values: np.ndarray,
    style: str = "%.9f",
    shuffle: bool = False,
    spoil=None,
) -> None:
    """`spoil(stamps, values) -> (stamps, values)` may damage the rows."""
    stamps = EPOCH + np.round(time * 1e9).astype(np.int64)
    if spoil:
        stamps, values = spoil(stamps, values)
    columns = np.arange(len(header))
    if shuffle:
        columns = np.random.default_rng(3).permutation(len(header))
        header = [header[i].strip().lstrip("#") for i in columns]
        header[0] = "#" + header[0]
    styles = ",".join("%s" if i == 0 else style for i in columns)
    cells = zip(stamps.tolist(), *values.T.tolist(), strict=True)
    text = [",".join(header), *(styles % tuple(row[i] for i in columns) for row in cells)]
    path.parent.mkdir(parents=True, exist_ok=True)
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
    mav: Path, seconds: float = 12.0, step: float = 0.005, bias: float = 0.0, shuffle: bool = False
) -> None:
    time = np.arange(round(seconds / step)) * step
    values = np.concatenate([known_walk.rate(time) + bias, known_walk.force(time)], axis=1)
    write_table(mav / "imu0" / "data.csv", IMU_HEADER, time, values, shuffle=shuffle)


def poses(
    time: np.ndarray, mount: Mount, imu_mount: Mount
) -> tuple[np.ndarray, Rotation, np.ndarray]:
    """(position, attitude, velocity) of the reference's sensor: world ← IMU ← body ← sensor."""
    attitude = known_walk.attitude(time)
    turn = imu_mount.rotation.inv() * mount.rotation
    lever = imu_mount.rotation.inv().apply(mount.translation - imu_mount.translation)
    swing = attitude.apply(np.cross(known_walk.rate(time), lever))
    place = known_walk.position(time) + attitude.apply(lever)
    return place, attitude * turn, known_walk.velocity(time) + swing


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
    biases = np.full((len(time), 6), 0.07)
    values = np.concatenate([place, attitude.as_quat(scalar_first=True), speed, biases], axis=1)
    folder = mav / "state_groundtruth_estimate0"
    write_table(folder / "data.csv", header, time, values, shuffle=shuffle, spoil=spoil)
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
    shaken = noise * random.normal(0, np.radians(0.1), (len(time), 3))
    attitude = attitude * Rotation.from_rotvec(shaken)
    place = place + noise * random.normal(0, 4e-4, place.shape)
    for when in flips:
        row = int(np.argmin(np.abs(time - when)))
        attitude[row] = attitude[row] * Rotation.from_euler("x", 120, degrees=True)
        place[row] += 0.3
    sign = np.where(np.arange(len(time)) % 50 < 25, 1.0, -1.0)[:, None]  # q and −q are one rotation
    values = np.concatenate([place, attitude.as_quat(scalar_first=True) * sign], axis=1)
    keep = np.all([(time <= start) | (time >= end) for start, end in ((0, 0), *gaps)], axis=0)
    path = mav / "mocap0" / "data.csv"
    write_table(path, POSE_HEADER, time[keep], values[keep], "%.10f", spoil=spoil)
    if mount is not None:
        write_yaml(mav / "mocap0" / "sensor.yaml", mount, opencv=True)
