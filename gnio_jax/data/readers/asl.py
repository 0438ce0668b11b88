"""Files of the ASL layout (EuRoC, TUM-VI): `data.csv` and `sensor.yaml` of a sensor."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import yaml
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.parsing.stamps import in_order
from gnio_jax.data.parsing.tables import shortened
from gnio_jax.data.readers.parsing import unit_rotations
from gnio_jax.data.readers.reference import SHORTEST_RUN, Poses
from gnio_jax.data.readers.text import numbers, read_csv
from gnio_jax.data.reference import LONGEST_BRIDGE
from gnio_jax.data.validation import check_finite, check_gaps, check_rate
from gnio_jax.errors import InputError
from gnio_jax.numerics import finite_rows

LONGEST_LEVER = 100.0
"""m; no sensor is further away from its body."""

GYRO, ACCEL = ("wx", "wy", "wz"), ("ax", "ay", "az")
_POSITION, _QUATERNION = ("px", "py", "pz"), ("qw", "qx", "qy", "qz")
_VELOCITY = ("vx", "vy", "vz")
_COLUMNS = {
    "stamp": ("timestamp", "time"),
    **{f"w{axis}": (f"w_rs_s_{axis}",) for axis in "xyz"},
    **{f"a{axis}": (f"a_rs_s_{axis}",) for axis in "xyz"},
    **{f"p{axis}": (f"p_rs_r_{axis}", f"p{axis}") for axis in "xyz"},
    **{f"q{axis}": (f"q_rs_{axis}", f"q{axis}") for axis in "wxyz"},
    **{f"v{axis}": (f"v_rs_r_{axis}", f"v{axis}") for axis in "xyz"},
}
"""Our names of the columns, and the authors' without unit, in small letters."""


class ImuFile(NamedTuple):
    """Rows of an IMU's data.csv, in order."""

    start: int
    """First stamp, ns."""
    time: Float[np.ndarray, " n"]
    """s since `start`."""
    samples: Float[np.ndarray, "n 6"]
    """gyro rad/s, accel m/s²."""
    repairs: dict[str, float]
    """How many rows were sorted, and how many repeated ones dropped."""


def read_imu(path: Path, rate: float) -> ImuFile:
    """The IMU's data.csv, complete, at about `rate` Hz and without gaps."""
    table, stamps = read_table(path)
    start = int(stamps.min())
    samples = _values(table, [*GYRO, *ACCEL], path)
    check_finite(samples, "gyro and accel", path)
    time = (stamps - start) * 1e-9
    rows, repairs = in_order(time, samples, path)
    time, samples = time[rows], samples[rows]
    check_rate(time, rate, path)
    check_gaps(time, path)
    return ImuFile(start, time, samples, repairs)


def read_poses(path: Path, start: int) -> Poses:
    """A reference's data.csv, in s after `start` (ns); rows without a pose are left out."""
    table, stamps = read_table(path)
    velocity = _VELOCITY if _VELOCITY[0] in table.columns else ()
    values = _values(table, [*_POSITION, *_QUATERNION, *velocity], path)
    seen = finite_rows(values)
    if seen.sum() < SHORTEST_RUN:
        raise InputError(path, f"holds {seen.sum()} poses", "copy it again")
    time, values = (stamps[seen] - start) * 1e-9, values[seen]
    rows, _ = in_order(time, values, path)
    time, values = time[rows], values[rows]
    if (slowest := float(np.median(np.diff(time)))) > LONGEST_BRIDGE:
        raise InputError(
            path,
            f"field 'time' runs at {1 / slowest:.3g} Hz, too slow for a reference",
            f"give at least {1 / LONGEST_BRIDGE:g} Hz",
        )
    position, quaternion, speed = np.split(values, [3, 7], axis=1)
    return Poses(
        time, unit_rotations(quaternion, "q_rs", path), position, speed if velocity else None
    )


def read_table(path: Path) -> tuple[pd.DataFrame, np.ndarray]:
    """A data.csv with our names for the columns it has (`stamp`, `wx`, `ax`, ...), and its stamps
    in ns as integers (a float has too few digits)."""
    table = read_csv(path)
    plain = [re.sub(r"[\[(].*", "", str(name)).strip().lower() for name in table.columns]
    ours = {name: ours for ours, names in _COLUMNS.items() for name in names}
    table.columns = [
        ours.get(short, str(name)) for short, name in zip(plain, table.columns, strict=True)
    ]
    stamps = numbers(table, ["stamp"], path)[:, 0]
    check_finite(stamps, "stamp", path)
    column = table["stamp"]
    return table, column.to_numpy() if column.dtype.kind == "i" else stamps.astype(np.int64)


def _values(table: pd.DataFrame, names: list[str], path: Path) -> Float[np.ndarray, "n w"]:
    check_columns(table, names, path)
    return numbers(table, names, path)


def check_columns(table: pd.DataFrame, names: Iterable[str], path: Path) -> None:
    """Raise `InputError` for a column that is missing, named as the authors name it."""
    for name in names:
        if name not in table.columns:
            raise InputError(
                path,
                f"column '{_COLUMNS[name][0]}' is missing",
                f"found: {', '.join(str(column) for column in table.columns)}",
            )


class SensorPose(NamedTuple):
    """T_BS of a sensor."""

    rotation: Rotation = Rotation.identity()
    """Sensor → body."""
    translation: np.ndarray = np.zeros(3)
    """Of the sensor in the body, m."""

    def seen_from(self, other: SensorPose) -> SensorPose:
        """This sensor in the frame of another one."""
        inverse = other.rotation.inv()
        lever = inverse.apply(self.translation - other.translation)
        return SensorPose(inverse * self.rotation, lever)


def sensor_pose(path: Path) -> SensorPose:
    """T_BS of a sensor.yaml; the identity where there is no file or it names none."""
    content = _yaml(path) if path.is_file() else None
    entry = content.get("T_BS") if isinstance(content, dict) else None
    if entry is None:
        return SensorPose()
    try:
        rows = entry["data"] if isinstance(entry, dict) else entry
        # One by one, since aliases can make a few lines of YAML a list of billions.
        values = [float(x) for row in rows for x in (row if isinstance(row, list) else [row])]
        matrix = np.array(values).reshape(4, 4)
        turn, translation = matrix[:3, :3], matrix[:3, 3]
        orthogonal = np.abs(turn @ turn.T - np.eye(3)).max() <= 1e-3
        if not (orthogonal and np.isfinite(turn).all() and np.linalg.det(turn) >= 0):
            raise ValueError("its rotation is none")
        if not np.linalg.norm(translation) < LONGEST_LEVER:
            raise ValueError(f"its translation is beyond {LONGEST_LEVER:g} m")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            path,
            f"field 'T_BS' is no pose ({error})",
            "it holds cols, rows and data of a 4 × 4 matrix",
        ) from None
    return SensorPose(Rotation.from_matrix(turn), translation)


def moved_to(imu: SensorPose, poses: Poses) -> Poses:
    """Poses of the IMU, which sits at `imu` in the tracked sensor's frame. The velocity stays that
    of the sensor."""
    return poses._replace(
        position=poses.position + poses.attitude.apply(imu.translation),
        attitude=poses.attitude * imu.rotation,
    )


def _yaml(path: Path) -> Any:
    try:
        # Some exports carry OpenCV's header and tag, which are no YAML.
        text = re.sub(
            r"^%YAML.*$|!!opencv-matrix", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE
        )
        return yaml.safe_load(text)
    except (  # tags fail in any way
        OSError,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        RecursionError,
        yaml.YAMLError,
    ) as error:
        raise InputError(
            path, f"cannot be read as YAML ({shortened(error, 200)})", "copy it again"
        ) from None
