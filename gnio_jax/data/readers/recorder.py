"""Text files of the Android recorder of RIDI and of those that followed it.

`acce.txt`, `gyro.txt` (`t x y z`), the poses (`t px py pz qx qy qz qw`) and `orientation.txt`
(`t qx qy qz qw`, the game rotation vector) are each on a clock of their own, ns, quaternions
xyzw.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from gnio_jax.data.readers.parsing import unit_rotations
from gnio_jax.data.readers.reference import Poses, poses_at
from gnio_jax.data.readers.text import numbers, read_csv
from gnio_jax.data.resampling import LONGEST_BRIDGE
from gnio_jax.data.validation import WINDOW_SECONDS, check_finite, check_increasing
from gnio_jax.errors import InputError
from gnio_jax.numerics import neighbours, wxyz_from_xyzw

RATES = (90.0, 1100.0)
"""Hz: 200 in RIDI itself, more in what newer phones wrote."""

MOST_DAYS = 30.0
"""Longer recordings are mistaken stamps; in float64, ns lose nothing of theirs up to there."""

TANGO, ARCORE = "Tango VIO of the phone itself", "ARCore VIO of the phone itself"

_Y_UP = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_POSES = (("android_sensor_pose.txt", _Y_UP), ("pose.txt", Rotation.identity()))
FILES = ("gyro.txt", "acce.txt", "orientation.txt", *(name for name, _ in _POSES))


class Native(NamedTuple):
    """A recording on one clock of its own."""

    time: Float[np.ndarray, " n"]
    """s since `start`, increasing, gaps and all."""
    start: float
    """s on the phone's clock."""
    gyro: Float[np.ndarray, "n 3"]
    """rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """m/s²."""
    position: Float[np.ndarray, "n 3"]
    """m."""
    attitude: Rotation
    """Body → world."""
    device: Rotation | None
    """The phone's game rotation vector."""
    valid: Bool[np.ndarray, " n"]
    truth: str


def read_recorder(folder: Path) -> Native:
    """The text files on the gyro's clock, from the first pose to the last."""
    pose_path, upright = _pose_file(folder)
    gyro_path, force_path = folder / "gyro.txt", folder / "acce.txt"
    gyro_stamps, gyro = _text(gyro_path, 3)
    force_stamps, force = _text(force_path, 3)
    pose_stamps, pose = _text(pose_path, 7)
    # First: where the gyro's first stamp is nonsense, those of the other files would look wrong.
    _check_clock(gyro_stamps, gyro_path)
    _check_clock(force_stamps, force_path)
    start = gyro_stamps[0]
    gyro_time, force_time, pose_time = (
        (stamps - start) * 1e-9 for stamps in (gyro_stamps, force_stamps, pose_stamps)
    )
    check_increasing(pose_time, pose_path)  # stamps of another unit may fall together
    rows = _shared(gyro_time, force_time, pose_time, force_path, pose_path)
    time = gyro_time[rows]
    attitude = unit_rotations(wxyz_from_xyzw(pose[:, 3:]), "qx qy qz qw", pose_path)
    place, turned, valid = poses_at(time, Poses(pose_time, attitude, pose[:, :3]), LONGEST_BRIDGE)
    return Native(
        time=time,
        start=float(start * 1e-9),
        gyro=gyro[rows],
        accel=CubicSpline(force_time, force, axis=0)(time),
        position=upright.apply(place),
        attitude=upright * turned,
        device=_game_rotation(folder / "orientation.txt", start, time),
        valid=valid,
        truth=TANGO if pose_path.name == "pose.txt" else ARCORE,
    )


def _pose_file(folder: Path) -> tuple[Path, Rotation]:
    """The file of the IMU's poses, and what turns their world to z-up."""
    for name, upright in _POSES:
        if (folder / name).is_file():
            return folder / name, upright
    return folder / "pose.txt", Rotation.identity()


def _check_clock(stamps: Float[np.ndarray, " n"], path: Path) -> None:
    rate = 1e9 / float(np.median(np.diff(stamps)))
    slowest, fastest = RATES
    if not slowest <= rate <= fastest:
        raise InputError(
            path,
            f"field 'time' runs at {rate:.4g} Hz, expected {slowest:g} to {fastest:g} Hz",
            "check the unit of the stamps: they are ns",
        )
    days = (stamps[-1] - stamps[0]) * 1e-9 / 86400
    if days > MOST_DAYS:
        problem = f"field 'time' goes over {days:.3g} days"
        raise InputError(path, problem, "repair or cut the rows of other times")


def _shared(
    gyro_time: Float[np.ndarray, " n"],
    force_time: Float[np.ndarray, " m"],
    pose_time: Float[np.ndarray, " k"],
    force_path: Path,
    pose_path: Path,
) -> Bool[np.ndarray, " n"]:
    """Which rows of the gyro the accelerometer and the odometry cover.

    Where the accelerometer is silent there is no IMU sample, whatever the gyro says. An odometry
    that was lost for long comes back in a world of its own (23° turned, in one recording): such a
    gap ends a piece as one of the IMU does.
    """
    remedy = "check that the files are of one recording"
    if not (force_time[0] < gyro_time[-1] and gyro_time[0] < force_time[-1]):
        raise InputError(
            force_path,
            f"field 'time' ({force_time[0]:.1f} to {force_time[-1]:.1f} s after the gyro's first "
            f"stamp) shares nothing with that of gyro.txt (0.0 to {gyro_time[-1]:.1f} s)",
            remedy,
        )
    first, last = max(force_time[0], pose_time[0]), min(force_time[-1], pose_time[-1])
    rows = (gyro_time >= first) & (gyro_time <= last)
    for stamps, longest in ((force_time, LONGEST_BRIDGE), (pose_time, WINDOW_SECONDS)):
        left, right = neighbours(stamps, gyro_time)
        rows &= stamps[right] - stamps[left] <= longest
    if rows.sum() < 2:
        raise InputError(
            pose_path,
            f"its stamps ({pose_time[0]:.1f} to {pose_time[-1]:.1f} s after the gyro's first) "
            f"share nothing with the IMU's in gyro.txt and acce.txt "
            f"({gyro_time[0]:.1f} to {gyro_time[-1]:.1f} s)",
            remedy,
        )
    return rows


def _game_rotation(path: Path, start: float, time: Float[np.ndarray, " n"]) -> Rotation | None:
    """The game rotation vector at times (s) after the stamp `start` (ns), if the recorder wrote
    it."""
    if not path.is_file():
        return None
    stamps, xyzw = _text(path, 4)
    own_time = (stamps - start) * 1e-9
    check_increasing(own_time, path)
    known = unit_rotations(wxyz_from_xyzw(xyzw), "qx qy qz qw", path)
    _, device, _ = poses_at(time, Poses(own_time, known, np.zeros((len(known), 3))), LONGEST_BRIDGE)
    return device


def _text(path: Path, width: int) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n w"]]:
    """Stamps (ns) and values of a text file, in order."""
    table = read_csv(path, separator=" ", header=False)
    if table.shape[1] < width + 1:
        raise InputError(
            path,
            f"has {table.shape[1]} columns, expected the time and {width} values",
            "copy it again",
        )
    stamps, order = sorted_stamps(numbers(table, [0], path)[:, 0], path)
    values = numbers(table, range(1, width + 1), path)[order]
    check_finite(values, "values", path)
    return stamps, values


def sorted_stamps(
    stamps: Float[np.ndarray, "n"], path: Path
) -> tuple[Float[np.ndarray, "m"], np.ndarray]:
    """Increasing stamps, and the rows they are of: the recorder writes some late and some twice."""
    check_finite(stamps, "time", path)
    increasing, order = np.unique(stamps, return_index=True)
    if len(increasing) < max(100, 0.5 * len(stamps)):
        raise InputError(
            path,
            f"field 'time' holds only {len(increasing)} different stamps in {len(stamps)} rows",
            "copy it again",
        )
    return increasing, order
