"""IDOL: an iPhone 8 on a rig with a lidar odometry, carried through three buildings (Sun, Melamed,
Kitani, AAAI 2021).

Layout: building{1,2,3}/{train,known,unknown}/<k>.feather (train in building1 alone) and
metadata.json beside them, {"<k>": {"subjectID": …, "calibration": …}}. One table a walk, 100 Hz,
whose columns are read by name, since their order varies.

The IMU stays the phone's: iOS reports −f in G. The table's attitude is the *rig's*; the phone is
bolted to it by about half a turn about z. The world of the lidar's map is tilted by up to 8°: it is
levelled with the mean of R·stencilAcc, the rig's own accelerometer. In some recordings the poses
are late by 0.03 to 0.19 s: the lag is estimated by laying the turning of the poses over the gyro.
The position is the rig's, less than a phone's length away, and the authors smoothed it: no gait is
left in it.

The folders are the splits: `known` (also `seen`, `test`) are people of `train`, `unknown` (also
`unseen`) are others. For validation people are held out of `train`.
"""

from __future__ import annotations

import os
import warnings
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment import PoseLag, pose_lag
from gnio_jax.data.dataset import Dataset, Recording, Refusal
from gnio_jax.data.gaps import divide_at_gaps
from gnio_jax.data.parsing.tables import shortened
from gnio_jax.data.readers.parsing import json_object, parsed_as
from gnio_jax.data.readers.phones import with_velocity
from gnio_jax.data.readers.reference import Poses, poses_at
from gnio_jax.data.readers.text import numbers
from gnio_jax.data.reference import LONGEST_BRIDGE
from gnio_jax.data.resampling import resample
from gnio_jax.data.splits import held_out
from gnio_jax.data.validation import (
    WINDOW_SECONDS,
    check_finite,
    check_rate,
    check_unit_norm,
    validate,
)
from gnio_jax.errors import InputError
from gnio_jax.numerics import finite_rows, levelling, outer_span, quaternions, rotations
from gnio_jax.types import STANDARD_G, Sequence

RATE = 100.0

PHONE_TO_RIG = Rotation.from_rotvec([-0.01853, 0.02801, 3.12916])
"""How the phone is bolted on, from gyro and reference of the whole set; the authors' own words are
x → −x, y → −y."""
MAX_TILT = 20.0
"""Degrees by which the map may be tilted; beyond, the attitude is not what it should be."""

_SPLITS = {
    "train": "train",
    "val": "train",
    "seen": "known",
    "known": "known",
    "test": "known",
    "unseen": "unknown",
    "unknown": "unknown",
}
_BUILDINGS = ("building1", "building2", "building3")


def recordings(root: Path, split: str) -> list[Recording]:
    """The walks of a split."""
    root = Path(root)
    chosen = find_walks(root, _SPLITS[split])
    note: dict[str, Any] = {}
    if split in ("train", "val"):
        held = held_out({walk.name: walk.subject for walk in chosen})
        note = {
            "held_out": ", ".join(sorted({walk.subject for walk in chosen if walk.name in held}))
        }
        chosen = [walk for walk in chosen if (walk.name in held) == (split == "val")]
        if not chosen:
            raise InputError(
                root,
                f"split '{split}' would be empty: {len(held)} recordings are held out for "
                "validation",
                "complete the data, or choose another split",
            )
    return [_recording(walk, note) for walk in chosen]


class PhoneWalk(NamedTuple):
    """One recording, before it is read."""

    path: Path
    subject: str
    """From metadata.json; the recording's own name where that does not say."""
    calibration: str
    """When the rig was turned about its axes: start, end, ..."""

    @property
    def name(self) -> str:
        return _name(self.path)


def _recording(walk: PhoneWalk, note: dict[str, Any]) -> Recording:
    person = {"subject": walk.subject, "group": walk.subject, "calibration": walk.calibration}
    return Recording(
        walk.name,
        partial(read_pieces, walk.path),
        files=(walk.path,),
        slow=True,
        attributes=person | note,
    )


def find_walks(root: Path, folder: str) -> list[PhoneWalk]:
    """The recordings in `folder` ("train", "known", "unknown") of every building; the buildings may
    lie a folder or two deeper."""
    walks: list[PhoneWalk] = []
    nameless: list[Path] = []
    for building in _BUILDINGS:
        places = (sorted(root.glob(f"{depth}{building}/{folder}")) for depth in ("", "*/", "*/*/"))
        place = next((found[0] for found in places if found), None)
        if place is None:
            continue
        metadata = place / "metadata.json"
        about = json_object(metadata) if metadata.is_file() else {}
        for path in sorted(place.glob("*.feather"), key=lambda path: (len(path.stem), path.stem)):
            entry = about.get(path.stem)
            entry = entry if isinstance(entry, dict) else {}
            subject = entry.get("subjectID")
            if subject is None:
                nameless.append(path)
            person = _name(path) if subject is None else shortened(f"subject{subject}")
            walks.append(PhoneWalk(path, person, shortened(entry.get("calibration", "unknown"))))
    if not walks:
        raise InputError(
            root,
            f"holds no recording in building*/{folder}",
            f"get it from {DATASET.source}; expected layout: {DATASET.layout}",
        )
    if nameless:
        warnings.warn(
            f"{root}: metadata.json does not name the subject of {len(nameless)} recordings, "
            f"e.g. {nameless[0]}; each counts as a person of its own",
            stacklevel=3,
        )
    return walks


def read_pieces(path: str | os.PathLike[str]) -> list[Sequence]:
    """One walk at 100 Hz: levelled, the reference turned to the phone and shifted onto its clock.

    Level and lag are those of the whole walk, which is divided where a gap is longer than a window
    (`divide_at_gaps`). Raises `InputError` naming file and column, and `Refusal` when its reference
    cannot be that of the phone.
    """
    path = Path(path)
    rows = _rows(path)
    level, attitude, position = _levelled_poses(rows, path)
    fit = _lag(rows, attitude, path)
    poses = Poses(rows.time[rows.known] - fit.lag, attitude, position)
    place, turned, valid = poses_at(rows.time, poses, LONGEST_BRIDGE)
    inside = outer_span(valid)
    name = _name(path)
    sequence = Sequence(
        name=name,
        time=rows.time[inside] - rows.time[inside.start],
        gyro=rows.gyro[inside],
        accel=rows.accel[inside],
        orientation=quaternions(turned[inside]),
        position=place[inside],
        velocity=np.zeros_like(place[inside]),
        valid=valid[inside],
        device_orientation=None if rows.device is None else rows.device[inside],
        attributes={
            "dataset": "idol",
            "group": name,
            "subject": "unknown",
            "building": path.parent.parent.name,
            "device": "iPhone 8",
            "placement": "handheld rig",
            "truth": "lidar-visual-inertial odometry (Kaarta Stencil)",
            "imu_compensated": "no",
            "licence": DATASET.licence,
            "start_time": rows.start + float(rows.time[inside.start]),
            "lag": fit.lag,
            "rate_correlation": fit.correlation,
            "tilt_degrees": float(np.degrees(level.magnitude())),
        },
    )
    pieces = divide_at_gaps(validate(sequence, path), path)
    return [validate(with_velocity(resample(piece, RATE)), path) for piece in pieces]


# --- one table


class _Rows(NamedTuple):
    """A walk's table: rows sorted by their stamps, repeated ones dropped."""

    start: float
    """First stamp, s."""
    time: Float[np.ndarray, " n"]
    """s since `start`, increasing."""
    gyro: Float[np.ndarray, "n 3"]
    """The phone's, rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """The phone's specific force, m/s²."""
    rig_accel: Float[np.ndarray, "n 3"]
    """The rig's own accelerometer, in the rig's frame, along the specific force."""
    orientation: Float[np.ndarray, "n 4"]
    """Rig → map."""
    position: Float[np.ndarray, "n 3"]
    """Of the rig in the map, m."""
    known: Bool[np.ndarray, " n"]
    """Rows that hold a pose."""
    device: Float[np.ndarray, "n 4"] | None
    """CoreMotion's attitude, where the table gives it in every row."""


def _rows(path: Path) -> _Rows:
    table = _table(path)
    stamps, order = _stamps(table, path)

    def columns(name: str, axes: str) -> Float[np.ndarray, "n w"]:
        return numbers(table, [name + axis for axis in axes], path)[order]

    accel, gyro = columns("iphoneAcc", "XYZ"), columns("iphoneGyro", "XYZ")
    rig_accel = columns("stencilAcc", "XYZ")
    orientation, position = columns("orient", "WXYZ"), columns("processedPos", "XYZ")
    check_rate(stamps - stamps[0], RATE, path)
    check_finite(accel, "iphoneAcc", path)
    check_finite(gyro, "iphoneGyro", path)
    pull = float(np.median(np.linalg.norm(accel, axis=1)))
    if not 0.5 < pull < 2.0:
        raise InputError(
            path,
            f"columns 'iphoneAcc' have a median length of {pull:.3g}, expected about 1 (G)",
            "copy it again",
        )
    # A quaternion of zeros is no attitude, as little as NaN is.
    known = orientation.any(axis=1) & finite_rows(orientation) & finite_rows(position)
    if known.sum() < max(10 * RATE, 0.5 * len(stamps)):
        raise Refusal(
            path,
            f"columns 'orient', 'processedPos' hold a pose in only {known.sum()} of "
            f"{len(stamps)} rows",
            "leave it out",
        )
    return _Rows(
        start=float(stamps[0]),
        time=stamps - stamps[0],
        gyro=gyro,
        accel=-STANDARD_G * accel,
        rig_accel=rig_accel,
        orientation=check_unit_norm(orientation, known, "orient", path),
        position=position,
        known=known,
        device=_device(table, order, path),
    )


def _stamps(table: pd.DataFrame, path: Path) -> tuple[Float[np.ndarray, " n"], np.ndarray]:
    """Increasing stamps (s), and the rows that they are of."""
    stamps = numbers(table, ["timestamp"], path)[:, 0]
    check_finite(stamps, "timestamp", path)
    increasing, order = np.unique(stamps, return_index=True)
    if len(increasing) < max(10 * RATE, 0.5 * len(stamps)):
        raise Refusal(
            path,
            f"column 'timestamp' holds only {len(increasing)} different stamps in "
            f"{len(stamps)} rows",
            "leave it out",
        )
    return increasing, order


def _device(table: pd.DataFrame, order: np.ndarray, path: Path) -> Float[np.ndarray, "n 4"] | None:
    """CoreMotion's attitude, where the table gives it in every row."""
    names = ["iphoneOrient" + axis for axis in "WXYZ"]
    if not set(names) <= set(table.columns):
        return None
    values = numbers(table, names, path)[order]
    if not np.isfinite(values).all():
        return None
    return check_unit_norm(values, np.ones(len(values), dtype=bool), "iphoneOrient", path)


def _levelled_poses(rows: _Rows, path: Path) -> tuple[Rotation, Rotation, Float[np.ndarray, "k 3"]]:
    """(levelling of the map, attitudes of the phone, positions of the rig) of the rows that hold a
    pose, in the levelled map."""
    rig = rotations(rows.orientation[rows.known])
    accel = rows.rig_accel[rows.known]
    measured = finite_rows(accel)
    if measured.sum() < 10 * RATE:
        raise Refusal(
            path, f"columns 'stencilAcc' hold numbers in only {measured.sum()} rows", "leave it out"
        )
    level = levelling(rig[measured].apply(accel[measured]).mean(axis=0))
    tilt = np.degrees(level.magnitude())
    if tilt > MAX_TILT:
        raise Refusal(
            path,
            f"gravity by 'orient' and 'stencilAcc' is {tilt:.0f}° off the vertical",
            "leave it out",
        )
    return level, level * rig * PHONE_TO_RIG, level.apply(rows.position[rows.known])


def _lag(rows: _Rows, attitude: Rotation, path: Path) -> PoseLag:
    # A gap tells nothing of the lag, however long it is: here it lasts as long as a window.
    steps = np.minimum(np.diff(rows.time), WINDOW_SECONDS)
    closed = np.concatenate([[0.0], np.cumsum(steps)])
    fit = pose_lag(closed, rows.gyro, closed[rows.known], attitude)
    if not fit.correlation >= 0.5:  # NaN when the poses do not turn at all
        raise Refusal(
            path,
            f"columns 'orient' do not turn as 'iphoneGyro' does (they correlate by "
            f"{fit.correlation:.2f})",
            "leave it out",
        )
    return fit


def _table(path: Path) -> pd.DataFrame:
    try:
        from pyarrow import feather
    except ImportError:
        raise InputError(
            path,
            "feather files need pyarrow, which is not installed",
            "pip install 'gnio-jax[idol]'",
        ) from None
    if not path.exists():
        raise InputError(path, "no such file")
    with parsed_as(path, "feather"):
        # What pandas noted of its own index when it wrote the file is of no use here.
        return feather.read_table(str(path)).to_pandas(ignore_metadata=True)


def _name(path: Path) -> str:
    return f"{path.parent.parent.name}_{path.parent.name}_{path.stem}"


DATASET = Dataset(
    name="idol",
    recordings=recordings,
    splits=tuple(_SPLITS),
    rate=RATE,
    source="https://zenodo.org/records/4484093",
    layout="<root>/building{1,2,3}/{train,known,unknown}/<k>.feather "
    "with metadata.json beside them",
    licence="CC BY 4.0",
    correlates=False,  # the authors' positions are smoothed: no gait is left in them
)
