"""Writes the known walk as comma2k19's native files: NumPy arrays without a suffix, in the frame of
the earth."""

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import known_walk

DRIVE, MINUTE = "b0c9d2329ad1606b|2018-08-02--08-34-47", "40"
LATITUDE, LONGITUDE, HEIGHT = np.radians(37.6), np.radians(-122.4), 30.0
BOOT = 46408.58
"""Stamp of the first sample, s."""


def home():
    """The origin of the walk in ECEF (m), and east, north, up there: by the geodetic formulas."""
    squared = 0.00669437999014
    radius = 6378137.0 / np.sqrt(1 - squared * np.sin(LATITUDE) ** 2)
    level = (radius + HEIGHT) * np.cos(LATITUDE)
    origin = np.array(
        [
            level * np.cos(LONGITUDE),
            level * np.sin(LONGITUDE),
            (radius * (1 - squared) + HEIGHT) * np.sin(LATITUDE),
        ]
    )
    to_level = Rotation.from_euler("ZX", [LONGITUDE + np.pi / 2, np.pi / 2 - LATITUDE])
    return origin, to_level.as_matrix()


def write(root, seconds=known_walk.SECONDS, drive=DRIVE, minute=MINUTE):
    """The folder of a minute. The sensors have stamps of their own."""
    folder = root / drive / minute
    origin, columns = home()

    def save(name, values):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            np.save(file, values)

    for name, delay, signal in (
        ("gyro", 0.0, known_walk.rate),
        ("accelerometer", 0.003, known_walk.force),
    ):
        time = np.arange(0, seconds, 1 / 104.35) + delay
        save(f"processed_log/IMU/{name}/t", BOOT + time)
        save(f"processed_log/IMU/{name}/value", signal(time))
    time = np.arange(-0.1, seconds + 0.1, 0.05)
    attitude = Rotation.from_matrix(columns) * known_walk.attitude(time)
    save("global_pose/frame_times", BOOT + time)
    save("global_pose/frame_positions", origin + known_walk.position(time) @ columns.T)
    save("global_pose/frame_velocities", known_walk.velocity(time) @ columns.T)
    save("global_pose/frame_orientations", attitude.as_quat(scalar_first=True))
    return folder
