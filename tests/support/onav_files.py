"""Writes the known walk as onavdata's native files: zipped CSV with tabs in their header, rows
without a stamp and rows of an INS that is not aligned."""

import zipfile

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import known_walk

DRIVE = "2021-04-27C-car-hill-drive"
RADIUS = 6378137.0
HOME = np.radians([45.2, -93.4])
TO_CASE = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
FLIP = np.diag([1.0, -1.0, -1.0])
"""Ahead, right, down ← ahead, left, up; the known walk's body is the latter."""
START = 20.0
MODE = "\t\t\tInsGnssBIT.InsMode"


def zipped(folder, name, columns, time, values):
    """With two rows of stamp −1 and three of mode 1 in front."""
    before = np.zeros((5, values.shape[1]))
    values = np.concatenate([before, values])
    stamps = np.concatenate([[-1.0, -1.0], START - 0.05 + 0.01 * np.arange(3), START + time])
    mode = np.where(np.arange(len(values)) < 5, 1, 4)
    # Another column of many, which is not read.
    header = ",".join(["SystemTov", "GpsTov", *columns, MODE])
    rows = np.column_stack([stamps, 2 * stamps, values, mode])
    lines = [header, *(",".join(f"{x:.12f}" for x in row) for row in rows)]
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(folder / f"n380-{name}.csv.zip", "w") as archive:
        archive.writestr(f"n380-{name}.csv", "\n".join(lines) + "\n")


def write(root, seconds=known_walk.SECONDS):
    """The folder of a drive."""
    folder, time = root / DRIVE, np.arange(0, seconds, 0.01)
    middle = time - 0.005  # of the time before the stamp, to which the increments belong
    signals = known_walk.rate(middle) @ FLIP, known_walk.force(middle) @ FLIP
    increments = np.concatenate([0.01 * signal @ TO_CASE for signal in signals], axis=1)
    names = [f"Delta{part}[{axis}]" for part in ("Theta", "Velocity") for axis in range(3)]
    zipped(folder, "imu-nav", names, time, increments)
    east, north, up = known_walk.position(time).T
    coordinates = [
        HOME[0] + north / RADIUS,
        HOME[1] + east / (RADIUS * np.cos(HOME[0])),
        250.0 + up,
    ]
    names = ["Latitude", "Longitude", "AltitudeAboveEllipsoid"]
    zipped(folder, "position", names, time, np.stack(coordinates, axis=1))
    down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    names = [f"VelocityNED[{axis}]" for axis in range(3)]
    zipped(folder, "velocity", names, time, known_walk.velocity(time) @ down)
    # The attitude has fewer rows than the others.
    turns = Rotation.from_matrix(down @ known_walk.attitude(time).as_matrix() @ FLIP)
    names = [f"EulerAttitude[{axis}]" for axis in range(3)]
    angles = turns.as_euler("ZYX")[:, ::-1]
    zipped(folder, "attitude", names, np.delete(time, 7), np.delete(angles, 7, axis=0))
    return folder
