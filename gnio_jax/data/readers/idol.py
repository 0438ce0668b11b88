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

import json
import os
import warnings
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset, Recording, Refusal
from gnio_jax.data.gaps import divide_at_gaps
from gnio_jax.data.readers.phones import held_out, poses_at, with_velocity
from gnio_jax.data.readers.text import numbers, shortened
from gnio_jax.data.resampling import LONGEST_BRIDGE, resample
from gnio_jax.data.validation import (
    WINDOW_SECONDS,
    check_finite,
    check_rate,
    check_unit_norm,
    validate,
)
from gnio_jax.numerics import quaternions, rotations
from gnio_jax.types import STANDARD_G, InputError, Sequence

RATE = 100.0
VERSION = "idol 2"
"""Changes whenever other sequences would come of the same files: it is part of the cache's key."""

PHONE_TO_RIG = Rotation.from_rotvec([-0.01853, 0.02801, 3.12916])
"""How the phone is bolted on, from gyro and reference of the whole set; the authors' own words are
x → −x, y → −y."""
MAX_TILT = 20.0
"""Degrees by which the map may be tilted; beyond, the attitude is not what it should be."""
MAX_LAG = 0.4
"""s, to either side."""

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
_FILTER_SECONDS = 0.05


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
                f"split '{split}' would be empty: {len(held)} recordings are held out for validation",
                "complete the data, or choose another split",
            )
    return [_recording(walk, note) for walk in chosen]


class Walk(NamedTuple):
    """One recording, before it is read."""

    path: Path
    subject: str
    """From metadata.json; the recording's own name where that does not say."""
    calibration: str
    """When the rig was turned about its axes: start, end, ..."""

    @property
    def name(self) -> str:
        return _name(self.path)


def _recording(walk: Walk, note: dict[str, Any]) -> Recording:
    person = {"subject": walk.subject, "group": walk.subject, "calibration": walk.calibration}
    return Recording(
        walk.name,
        partial(read_pieces, walk.path),
        files=(walk.path,),
        version=VERSION,
        attributes=person | note,
    )


def find_walks(root: Path, folder: str) -> list[Walk]:
    """The recordings in `folder` ("train", "known", "unknown") of every building; the buildings may
    lie a folder or two deeper."""
    walks, nameless = [], []
    for building in _BUILDINGS:
        places = next(
            (
                found
                for depth in ("", "*/", "*/*/")
                if (found := sorted(root.glob(f"{depth}{building}/{folder}")))
            ),
            [],
        )
        for place in places[:1]:
            about = _metadata(place / "metadata.json")
            for path in sorted(
                place.glob("*.feather"), key=lambda path: (len(path.stem), path.stem)
            ):
                entry = about.get(path.stem)
                entry = entry if isinstance(entry, dict) else {}
                if entry.get("subjectID") is None:
                    nameless.append(path)
                subject = (
                    _name(path)
                    if entry.get("subjectID") is None
                    else shortened(f"subject{entry['subjectID']}")
                )
                walks.append(Walk(path, subject, shortened(entry.get("calibration", "unknown"))))
    if not walks:
        raise InputError(
            root,
            f"holds no recording in building*/{folder}",
            f"get it from {DATASET.source}; expected layout: {DATASET.layout}",
        )
    if nameless:
        warnings.warn(
            f"{root}: metadata.json does not name the subject of {len(nameless)} recordings, e.g. {nameless[0]}; each counts as "
            "a person of its own",
            stacklevel=3,
        )
    return walks


def read_pieces(path: str | os.PathLike[str]) -> list[Sequence]:
    """One walk at 100 Hz: levelled, the reference turned to the phone and shifted onto its clock.

    Level and lag are those of the whole walk; where a gap is longer than a window it is divided
    (`divide_at_gaps`). Raises `InputError` naming file and column, and `Refusal` when its reference cannot
    be that of the phone.
    """
    path = Path(path)
    table = _table(path)
    stamps = numbers(table, ["timestamp"], path)[:, 0]
    check_finite(stamps, "timestamp", path)
    stamps, order = np.unique(stamps, return_index=True)  # sorted, repeated rows dropped
    if len(stamps) < max(10 * RATE, 0.5 * len(table)):
        raise Refusal(
            path,
            f"column 'timestamp' holds only {len(stamps)} different stamps in {len(table)} rows",
            "leave it out",
        )
    names = {
        "iphoneAcc": "XYZ",
        "iphoneGyro": "XYZ",
        "stencilAcc": "XYZ",
        "orient": "WXYZ",
        "processedPos": "XYZ",
    }
    columns = {
        name: numbers(table, [name + axis for axis in axes], path)[order]
        for name, axes in names.items()
    }
    start = float(stamps[0])
    time = stamps - start
    check_rate(time, RATE, path)
    for name in ("iphoneAcc", "iphoneGyro"):
        check_finite(columns[name], name, path)
    pull = float(np.median(np.linalg.norm(columns["iphoneAcc"], axis=1)))
    if not 0.5 < pull < 2.0:
        raise InputError(
            path,
            f"columns 'iphoneAcc' have a median length of {pull:.3g}, expected about 1 (G)",
            "copy it again",
        )

    gyro, accel = columns["iphoneGyro"], -STANDARD_G * columns["iphoneAcc"]
    # A quaternion of zeros is no attitude, as little as NaN is.
    known = (
        columns["orient"].any(axis=1)
        & np.isfinite(columns["orient"]).all(axis=1)
        & np.isfinite(columns["processedPos"]).all(axis=1)
    )
    if known.sum() < max(10 * RATE, 0.5 * len(time)):
        raise Refusal(
            path,
            f"columns 'orient', 'processedPos' hold a pose in only {known.sum()} of {len(time)} rows",
            "leave it out",
        )
    rig = rotations(check_unit_norm(columns["orient"], known, "orient", path)[known])
    level, tilt = _leveling(rig, columns["stencilAcc"][known], path)
    attitude = level * rig * PHONE_TO_RIG
    # A gap tells nothing of the lag, however long it is: here it lasts as long as a window.
    closed = np.concatenate([[0.0], np.cumsum(np.minimum(np.diff(time), WINDOW_SECONDS))])
    fit = pose_lag(closed, gyro, closed[known], attitude)
    if not fit.correlation >= 0.5:  # NaN when the poses do not turn at all
        raise Refusal(
            path,
            f"columns 'orient' do not turn as 'iphoneGyro' does (they correlate by {fit.correlation:.2f})",
            "leave it out",
        )
    position, attitude, valid = poses_at(
        time[known] - fit.lag,
        level.apply(columns["processedPos"][known]),
        attitude,
        time,
        LONGEST_BRIDGE,
    )

    inside = slice(int(np.argmax(valid)), len(valid) - int(np.argmax(valid[::-1])))
    device = _device(table, order, path)
    sequence = Sequence(
        name=_name(path),
        time=time[inside] - time[inside.start],
        gyro=gyro[inside],
        accel=accel[inside],
        orientation=quaternions(attitude[inside]),
        position=position[inside],
        velocity=np.zeros_like(position[inside]),
        valid=valid[inside],
        device_orientation=None if device is None else device[inside],
        attributes={
            "dataset": "idol",
            "group": _name(path),
            "subject": "unknown",
            "building": path.parent.parent.name,
            "device": "iPhone 8",
            "placement": "handheld rig",
            "truth": "lidar-visual-inertial odometry (Kaarta Stencil)",
            "imu_compensated": "no",
            "licence": DATASET.licence,
            "start_time": start + float(time[inside.start]),
            "lag": fit.lag,
            "rate_correlation": fit.correlation,
            "tilt_degrees": tilt,
        },
    )
    pieces = divide_at_gaps(validate(sequence, path), path)
    return [validate(with_velocity(resample(piece, RATE)), path) for piece in pieces]


class Lag(NamedTuple):
    """What `pose_lag` estimates."""

    lag: float
    """By how much a pose is stamped later than the IMU's sample of the same event, s."""
    correlation: float
    """Of the angular rates once the lag is taken out, all axes together; 1 where nothing turns and
    nothing can be told."""


def pose_lag(
    time: Float[np.ndarray, "n"],
    gyro: Float[np.ndarray, "n 3"],
    stamps: Float[np.ndarray, "m"],
    attitude: Rotation,
) -> Lag:
    """By how much the poses are late, from the angular rates of both in the same body.

    `time`, `stamps` s; `gyro` rad/s; `attitude` m rotations body→world. The lag that lets gyro(t) −
    bias and rate(t + lag) differ least, in a robust sense, both smoothed over 0.05 s (σ); among
    multiples of 10 ms first, then by Gauss-Newton.
    """
    steps = np.diff(stamps)
    turning = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / steps[:, None]
    middle = 0.5 * (stamps[:-1] + stamps[1:])
    near = steps <= 2.5 / RATE
    clock = np.arange(max(time[0], middle[0]), min(time[-1], middle[-1]), 1.0 / RATE)
    sigma = _FILTER_SECONDS * RATE
    felt = gaussian_filter1d(
        np.stack([np.interp(clock, time, column) for column in gyro.T], axis=1), sigma, axis=0
    )
    seen = gaussian_filter1d(
        np.stack([np.interp(clock, middle[near], column) for column in turning[near].T], axis=1),
        sigma,
        axis=0,
    )
    spline = CubicSpline(clock, seen, axis=0)
    slope = spline.derivative()
    inner = clock[(clock > clock[0] + MAX_LAG + 0.1) & (clock < clock[-1] - MAX_LAG - 0.1)]
    felt = np.stack([np.interp(inner, clock, column) for column in felt.T], axis=1)
    if (
        len(inner) < 5 * RATE
        or np.median(np.linalg.norm(felt - np.median(felt, axis=0), axis=1)) < 0.02
    ):
        return Lag(0.0, 1.0)

    def difference(lag: float) -> np.ndarray:
        error = felt - spline(inner + lag)
        return error - np.median(error, axis=0)

    candidates = np.arange(-round(MAX_LAG * 100), round(MAX_LAG * 100) + 1) / 100.0
    lag = float(min(candidates, key=lambda lag: np.abs(difference(lag)).mean()))
    for _ in range(8):
        error, gradient = difference(lag), slope(inner + lag)
        scale = max(3.0 * 1.4826 * float(np.median(np.abs(error))), 1e-6)
        weight = 1.0 / (1.0 + (error / scale) ** 2)
        change = float((weight * gradient * error).sum() / max((weight * gradient**2).sum(), 1e-12))
        lag = float(np.clip(lag + np.clip(change, -0.02, 0.02), -MAX_LAG - 0.05, MAX_LAG + 0.05))
    there, felt = spline(inner + lag), felt - felt.mean(axis=0)
    there = there - there.mean(axis=0)
    return Lag(lag, float((there * felt).sum() / np.sqrt((there**2).sum() * (felt**2).sum())))


def _leveling(rig: Rotation, accel: np.ndarray, path: Path) -> tuple[Rotation, float]:
    """The smallest rotation that turns the mean of R·accel upright, and its angle in degrees."""
    measured = np.isfinite(accel).all(axis=1)
    if measured.sum() < 10 * RATE:
        raise Refusal(
            path, f"columns 'stencilAcc' hold numbers in only {measured.sum()} rows", "leave it out"
        )
    up = rig[measured].apply(accel[measured]).mean(axis=0)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, up[2]))
    if np.degrees(angle) > MAX_TILT:
        raise Refusal(
            path,
            f"gravity by 'orient' and 'stencilAcc' is {np.degrees(angle):.0f}° off the vertical",
            "leave it out",
        )
    return Rotation.from_rotvec(axis / sine * angle if sine > 0 else np.zeros(3)), float(
        np.degrees(angle)
    )


def _device(table: pd.DataFrame, order: np.ndarray, path: Path) -> Float[np.ndarray, "n 4"] | None:
    """CoreMotion's attitude, where the table gives it in every row."""
    names = ["iphoneOrient" + axis for axis in "WXYZ"]
    if not set(names) <= set(table.columns):
        return None
    values = numbers(table, names, path)[order]
    if not np.isfinite(values).all():
        return None
    everywhere: Bool[np.ndarray, "n"] = np.ones(len(values), dtype=bool)
    return check_unit_norm(values, everywhere, "iphoneOrient", path)


def _table(path: Path) -> pd.DataFrame:
    try:
        from pyarrow import feather
    except ImportError:
        raise InputError(
            path,
            "feather files need pyarrow, which is not installed",
            "pip install 'gnio-jax[idol]'",
        ) from None
    try:
        # What pandas noted of its own index when it wrote the file is of no use here.
        return feather.read_table(str(path)).to_pandas(ignore_metadata=True)
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    except Exception as error:  # a damaged file makes the parser fail in any way
        raise InputError(
            path,
            f"cannot be read as feather, it may be cut short ({shortened(error, 200)})",
            "copy it again",
        ) from None


def _metadata(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, f"is no JSON ({error})", "copy it again") from None
    if not isinstance(about, dict):
        raise InputError(path, "is no JSON object", "copy it again")
    return about


def _name(path: Path) -> str:
    return f"{path.parent.parent.name}_{path.parent.name}_{path.stem}"


DATASET = Dataset(
    name="idol",
    recordings=recordings,
    splits=tuple(_SPLITS),
    rate=RATE,
    source="https://zenodo.org/records/4484093",
    layout="<root>/building{1,2,3}/{train,known,unknown}/<k>.feather with metadata.json beside them",
    licence="CC BY 4.0",
    min_correlation=None,  # the authors' positions are smoothed: no gait is left in them
)
