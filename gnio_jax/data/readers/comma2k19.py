"""comma2k19: a phone-class IMU behind the windscreen of two cars on California's Highway 280
(Schafer et al. 2018, MIT).

Layout: `<root>/.../<dongle>|<date>/<minute>/` (some copies: `_` for `|`) with

- `processed_log/IMU/{gyro,accelerometer}/{t,value}`: NumPy arrays without a suffix, 104 Hz, stamps
  in s since boot, rad/s (the device's estimate of the bias is subtracted) and m/s²;
- `global_pose/frame_{times,positions,orientations,velocities}`: 20 Hz, on the same clock; positions
  (m) and velocities (m/s) in the earth's frame (ECEF), from satellites and the camera; quaternions
  wxyz, body → ECEF, although the authors' description has the inverse.

The body's axes point ahead, right and down of the *device*, which is mounted a few degrees off the
car's axes. The world is east, north, up at the first pose of a minute, on the ellipsoid WGS 84.

Every minute is a recording of its own. No split is published; a drive is assigned by a hash of its
name (70/10/20 %), with all of its minutes.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.parsing.tables import damage_error, parsing_as
from gnio_jax.data.splits import draw_share
from gnio_jax.errors import InputError
from gnio_jax.files import file_in
from gnio_jax.types import Sequence

RATE = 104.0
"""Hz."""
SPLITS = ("train", "val", "test")
SEED = "comma2k19"
POLAR_RADIUS, EQUATORIAL_RADIUS = 6356752.3142, 6378137.0
"""WGS 84, m."""
RADII = 6.3e6, 6.4e6
"""Distances from the earth's centre between which a car drives, m."""
LARGEST_JUMP = 0.5
"""Largest difference of position and integrated velocity within a second, m."""

_DRIVE = re.compile(r"[0-9a-f]{16}[|_]\d{4}-\d\d-\d\d--\d\d-\d\d-\d\d")


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The minutes of the drives of a split."""
    minutes = find_minutes(root)
    chosen = [path for path in minutes if split_of(path.parent.name) == split]
    if minutes and not chosen:
        problem = f"none of its drives falls into split '{split}'"
        raise InputError(root, problem, "take another split or more drives")
    return [
        RecordingSource(_name(path), partial(read, path), (path,), slow=True) for path in chosen
    ]


def split_of(drive: str) -> str:
    """The split of a drive, which depends only on its name."""
    share = draw_share(SEED, drive.replace("_", "|"))
    return "train" if share < 0.7 else "val" if share < 0.8 else "test"


def find_minutes(root: Path) -> list[Path]:
    """The folders of the minutes below `root`, in the order of drives and minutes."""
    folders = [
        path.parents[1]
        for depth in ("", "*/", "*/*/", "*/*/*/")
        for path in root.glob(f"{depth}processed_log/IMU")
    ]
    minutes = [path for path in folders if _DRIVE.fullmatch(path.parent.name)]
    return sorted(minutes, key=lambda path: (path.parent.name, len(path.name), path.name))


def _name(minute: Path) -> str:
    return f"{minute.parent.name.replace('|', '_')}_{minute.name}"


def read(minute: Path) -> list[Sequence]:
    """The sequence of a minute. Raises `InputError` naming file and field."""
    sensors = []
    for name in ("gyro", "accelerometer"):
        folder = minute / "processed_log" / "IMU" / name
        time, values = _array(folder / "t"), _array(folder / "value", 3)
        _check_rows(folder / "value", values, time)
        sensors.append((time, values, str(folder / "t")))
    pose = minute / "global_pose"
    time = _array(pose / "frame_times")
    position, velocity = (_array(pose / f"frame_{x}", 3) for x in ("positions", "velocities"))
    quaternion = _array(pose / "frame_orientations", 4)
    for name, values in (("positions", position), ("velocities", velocity)):
        _check_rows(pose / f"frame_{name}", values, time)
    _check_rows(pose / "frame_orientations", quaternion, time)
    radius = np.linalg.norm(position, axis=1)
    if not ((radius > RADII[0]) & (radius < RADII[1])).all():
        problem = "field 'positions' is not near the earth's surface"
        raise damage_error(pose / "frame_positions", problem)
    size = np.linalg.norm(quaternion, axis=1)
    if not (np.abs(size - 1) < 0.01).all():
        raise damage_error(
            pose / "frame_orientations", "holds quaternions that are not of length 1"
        )
    level = level_axes(position[0])
    start = min(sensors[0][0][0], sensors[1][0][0])
    poses = Poses(
        time - start,
        Rotation.from_matrix(level) * Rotation.from_quat(quaternion, scalar_first=True),
        (position - position[0]) @ level.T,
        velocity @ level.T,
        source=str(pose),
    )
    gyro, accel = (Samples(stamps - start, *values) for stamps, *values in sensors)
    attributes = {
        "group": minute.parent.name,
        "device": minute.parent.name[:16],
        "placement": "windscreen",
        "truth": "GNSS, camera and IMU",
        "imu_compensated": "Android's gyro bias",
    }
    streams = Streams(_name(minute), str(minute), gyro, accel, attributes, float(start), poses)
    return assemble(streams, RATE, max_drift=LARGEST_JUMP)


def level_axes(position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """East, north and up of the ellipsoid at a position (m, ECEF) near its surface: rows in ECEF.

    The vertical is the ellipsoid's gradient there, which at a height of 1 km errs by 1e-6 rad.
    """
    axes = np.array([EQUATORIAL_RADIUS, EQUATORIAL_RADIUS, POLAR_RADIUS])
    up = position / axes**2
    up /= np.linalg.norm(up)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


def _array(path: Path, width: int | None = None) -> np.ndarray:
    """The numbers of a NumPy file without a suffix: (n,), or (n, width)."""
    path = file_in(path.parent, path.name)
    if not path.is_file():
        raise InputError(path, "no such file", f"expected layout: {DATASET.layout}")
    with parsing_as(path, "a NumPy array"):
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    shape = values.shape[:1] if width is None else (*values.shape[:1], width)
    if values.dtype.kind != "f" or values.shape != shape or len(values) < 2:
        expected = "(n,)" if width is None else f"(n, {width})"
        raise damage_error(
            path, f"holds {values.dtype} of shape {values.shape}, expected {expected}"
        )
    values = np.asarray(values, np.float64)
    if not np.isfinite(values).all():
        row = int(np.argwhere(~np.isfinite(values))[0][0])
        raise damage_error(path, f"row {row} is not finite")
    return values


def _check_rows(path: Path, values: np.ndarray, time: np.ndarray) -> None:
    if len(values) != len(time):
        raise damage_error(path, f"holds {len(values)} rows, but there are {len(time)} stamps")


DATASET = Dataset(
    name="comma2k19",
    recordings=recordings,
    splits=SPLITS,
    rate=RATE,
    source="https://github.com/commaai/comma2k19",
    layout="<root>/<dongle>|<date>/<minute>/{processed_log/IMU,global_pose}",
    licence="MIT",
    pedestrian=False,
)
