"""A folder in the layout of EuRoC (`mav0/imu0/data.csv`), at any rate, with or without a reference.

The published sets are read by `data.readers.euroc`, at their own rate and with their splits.
"""

from __future__ import annotations

from pathlib import Path

from gnio_jax.data.importing.source import Source, Track, Units
from gnio_jax.data.importing.streams import SensorFile
from gnio_jax.data.readers.euroc import ACCEL, GYRO, STAMP, read_reference, read_table


def read_asl(path: Path) -> Source:
    """The folder `mav0`, or the one that holds it."""
    mav = path / "mav0" if (path / "mav0").is_dir() else path
    file = mav / "imu0" / "data.csv"
    table = read_table(file)
    table.take(*GYRO, *ACCEL, gaps=True)
    gyro, accel = (
        SensorFile(name, file, table.columns, STAMP, axes)
        for name, axes in (("gyro", GYRO), ("accel", ACCEL))
    )
    start = int(table.stamps(STAMP).min())
    track, poses = None, read_reference(mav, start)
    if poses is not None:
        file = Path(poses.source)
        track = Track(file, file.parent.name, start / 1e9, poses)
    found = f"reference {track.name}" if track else "no reference"
    return Source(
        path,
        gyro,
        accel,
        Units("ns", "rad/s", "m/s2", "android"),
        track,
        (f"{path.name}: EuRoC's layout (ns, rad/s, m/s2), {found}",),
    )
