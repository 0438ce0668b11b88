"""A folder in the layout of EuRoC (`mav0/imu0/data.csv`), at any rate, with or without a reference.

The published sets are read by `data.readers.euroc`, at their own rate and with their splits.
"""

from __future__ import annotations

from pathlib import Path

from gnio_jax.apps.importing.recording import Recording, Track, Units, sensor_of
from gnio_jax.data.readers.euroc import ACCEL, GYRO, STAMP, read_reference, read_table


def read_asl(path: Path) -> Recording:
    """The folder `mav0`, or the one that holds it."""
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    table = read_table(mav / "imu0" / "data.csv")
    gyro, accel = (
        sensor_of(name, table, STAMP, axes) for name, axes in (("gyro", GYRO), ("accel", ACCEL))
    )
    first = gyro.stamps.min().item()
    track, poses = None, read_reference(mav, first)
    if poses is not None:
        track = Track(Path(poses.source).parent.name, poses, first)
    found = f"reference {track.name}" if track else "no reference"
    return Recording(
        path,
        gyro,
        accel,
        Units("ns", "rad/s", "m/s2", "android"),
        track,
        (f"{path.name}: EuRoC's layout (ns, rad/s, m/s2), {found}",),
    )
