"""onavdata: drives of a car with a Honeywell HGuide n380, from the Python package of that name (its
licence is not stated).

Layout: `<root>/.../<drive>/n380-{imu-nav,position,velocity,attitude}.csv.zip`, each with one CSV:

- `imu-nav`: increments of angle (rad) and velocity (m/s) over the 0.01 s before the stamp, in the
  sensor's axes. The turns between the published attitudes show when. A sample of a sequence drives
  the time after its stamp, so it has the stamp at which its increments begin. The case's axes,
  which are the sequence's body, point ahead, right and down: x, y, z of the case are −z, y, x of
  the sensor.
- `position`: latitude and longitude in rad, height in m; `velocity`: north, east, down;
  `attitude`: roll, pitch and heading of the case, rad.

Stamps (`SystemTov`) are s; −1 is none. Rows before the INS is aligned (`InsGnssBIT.InsMode` other
than 4) are left out. Some names of columns begin with tabs.

World: east, north, up from the first pose (`kitti.project`). Truth and IMU come from one INS, so
`imu_compensated` is `reference`. No split is published: all drives are `test`.
"""

from __future__ import annotations

import functools
import io
import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.assembly import Poses, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.parsing.tables import damage_error, parsing_as
from gnio_jax.data.readers.kitti import LARGEST_JUMP, project
from gnio_jax.errors import InputError
from gnio_jax.files import file_in
from gnio_jax.types import Sequence

RATE = 100.0
"""Hz."""
ALIGNED = 4.0
"""Mode of an INS that is aligned."""
MODE, STAMP = "InsGnssBIT.InsMode", "SystemTov"
TO_CASE = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
"""Case ← sensor."""
TO_EAST_NORTH_UP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""East, north, up ← north, east, down."""
LARGEST_ANGLES = np.radians([89.0, 360.0])
"""Of latitude and longitude, rad."""
LARGEST_TABLE = 2**30
"""Bytes of a CSV beyond which it is none of these."""
COLUMNS = {
    "imu-nav": [f"Delta{part}[{axis}]" for part in ("Theta", "Velocity") for axis in range(3)],
    "position": ["Latitude", "Longitude", "AltitudeAboveEllipsoid"],
    "velocity": [f"VelocityNED[{axis}]" for axis in range(3)],
    "attitude": [f"EulerAttitude[{axis}]" for axis in range(3)],
}
"""File → its columns besides stamp and mode."""


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """Every drive below `root`."""
    drives = sorted(
        {
            path.parent
            for depth in ("", "*/", "*/*/", "*/*/*/")
            for path in root.glob(f"{depth}*")
            if path.name.lower() == "n380-imu-nav.csv.zip"
        }
    )
    return [
        RecordingSource(
            drive.name,
            functools.partial(read, drive),
            tuple(file_in(drive, f"n380-{name}.csv.zip") for name in COLUMNS),
            slow=True,
        )
        for drive in drives
    ]


def read(drive: Path) -> list[Sequence]:
    """The pieces of a drive. Raises `InputError` naming file and field."""
    paths = {name: file_in(drive, f"n380-{name}.csv.zip") for name in COLUMNS}
    tables = {name: read_zipped(path, COLUMNS[name]) for name, path in paths.items()}
    stamps, increments = tables.pop("imu-nav")
    time = functools.reduce(np.intersect1d, [of_pose for of_pose, _ in tables.values()])
    if len(time) < 2:
        raise damage_error(drive, "has no stamps that position, velocity and attitude share")
    geodetic, velocity, angles = (
        values[np.searchsorted(of_pose, time)] for of_pose, values in tables.values()
    )
    if not (np.abs(geodetic[:, :2]) <= LARGEST_ANGLES).all():
        raise damage_error(
            paths["position"], "field 'Latitude' or 'Longitude' is not an angle in rad"
        )
    latitude, longitude = np.degrees(geodetic[:, 0]), np.degrees(geodetic[:, 1])
    position = project(latitude, longitude, geodetic[:, 2])
    to_world = TO_EAST_NORTH_UP @ Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix()
    beginnings = stamps - 1 / RATE
    start = float(beginnings[0])
    poses = Poses(
        time - start,
        Rotation.from_matrix(to_world),
        position,
        velocity @ TO_EAST_NORTH_UP.T,
        source=str(drive),
    )
    gyro, accel = (RATE * part @ TO_CASE.T for part in np.split(increments, 2, axis=1))
    attributes = {
        "group": drive.name,
        "placement": "car",
        "truth": "INS with GNSS (HGuide n380)",
        "imu_compensated": "reference",
    }
    streams = Streams.of_imu(drive.name, paths["imu-nav"], beginnings - start, gyro, accel)
    streams = streams._replace(poses=poses, attributes=attributes)
    return assemble(streams, RATE, divide=True, max_drift=LARGEST_JUMP)


def read_zipped(
    path: Path, fields: list[str]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n w"]]:
    """Stamps, which increase, and fields of the one CSV in an archive, where there is a stamp and
    the INS is aligned. Raises `InputError`."""
    names = [STAMP, MODE, *fields]
    if not path.is_file():
        raise InputError(path, "no such file", f"expected layout: {DATASET.layout}")
    with parsing_as(path, "a zip of one CSV"), zipfile.ZipFile(path) as archive:
        (member,) = archive.infolist()
        if member.file_size > LARGEST_TABLE:
            raise damage_error(path, f"holds a table of {member.file_size / 2**30:.1f} GiB")
        with io.TextIOWrapper(archive.open(member), encoding="utf-8") as text:
            header = [name.strip() for name in text.readline().split(",")]
            columns = {name: header.index(name) for name in names if name in header}
            if missing := [name for name in names if name not in columns]:
                raise InputError(path, f"field '{missing[0]}' is missing", "get the published file")
            table = np.loadtxt(text, delimiter=",", usecols=list(columns.values()), ndmin=2)
    rows = (table[:, 0] >= 0) & (table[:, 1] == ALIGNED) & np.isfinite(table).all(axis=1)
    table = table[rows]
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    if len(table) < 2:
        raise damage_error(path, f"holds {len(table)} rows with a stamp and an INS that is aligned")
    return table[:, 0], table[:, 2:]


DATASET = Dataset(
    name="onavdata",
    recordings=recordings,
    splits=("test",),
    rate=RATE,
    source="https://pypi.org/project/onavdata/",
    layout="<root>/.../<drive>/n380-{imu-nav,position,velocity,attitude}.csv.zip",
    licence="not stated",
    pedestrian=False,
)
