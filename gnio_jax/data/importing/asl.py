"""A folder in the layout of EuRoC (`mav0/imu0/data.csv`), at any rate, with or without a reference.

The published sets are read by `data.readers.euroc`, at their own rate and with their splits.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gnio_jax.data.importing.source import Source, Track, Units
from gnio_jax.data.importing.streams import SensorFile
from gnio_jax.data.readers.asl import (
    ACCEL,
    GYRO,
    check_columns,
    moved_to,
    read_poses,
    read_table,
    sensor_pose,
)
from gnio_jax.data.readers.euroc import REFERENCES


def read_asl(path: Path) -> Source:
    """The folder `mav0`, or the one that holds it."""
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    file = mav / "imu0" / "data.csv"
    table, stamps = read_table(file)
    check_columns(table, (*GYRO, *ACCEL), file)
    table["stamp"] = stamps
    gyro, accel = (
        SensorFile(name, file, table, "stamp", axes)
        for name, axes in (("gyro", GYRO), ("accel", ACCEL))
    )
    track = _track(mav, int(stamps.min()))
    found = f"reference {track.name}" if track else "no reference"
    return Source(
        path,
        gyro,
        accel,
        Units("ns", "rad/s", "m/s2", "android"),
        track,
        (f"{path.name}: EuRoC's layout (ns, rad/s, m/s2), {found}",),
    )


def _track(mav: Path, start: int) -> Track | None:
    """The first reference that is there, at the IMU's place."""
    for name in REFERENCES:
        file = mav / name / "data.csv"
        if file.is_file():
            sensor = sensor_pose(mav / name / "sensor.yaml")
            lever = sensor_pose(mav / "imu0" / "sensor.yaml").seen_from(sensor)
            poses = moved_to(lever, read_poses(file, start))
            shifted = float(np.linalg.norm(lever.translation)) > 1e-9
            return Track(file, name, start / 1e9, poses, shifted=shifted)
    return None
