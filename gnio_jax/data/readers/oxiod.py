"""OxIOD, the Oxford Inertial Odometry Dataset: phones carried through a Vicon room, and two floors
of an office with Tango.

Chen et al., *OxIOD: The Dataset for Deep Inertial Odometry*, 2018, http://deepio.cs.ox.ac.uk. This
file reads top to bottom as the way from the published text files to `Sequence`s:

1. *Walks.* `<scene>/<dataN | userN | device>/{raw,syn}/imuK.csv` beside `viK.csv` (`handK.csv`,
`tangoK.csv`). A walk that is
   there as `raw` and as `syn` is one walk: `raw` is used, whose stamps place every row to 3 ms (in
   `syn` both streams were put on one 100 Hz grid by repeating rows), `syn` where `raw` is absent or
   refused.
2. *Native text.* iPhone: 16 columns, acceleration in G with iOS's sign, so that specific force =
−(gravity + user_acc)·9.80665.
   Nexus: rows of one sensor each (`raw`), or ten columns (`syn`), m/s² already. Vicon: unix ns
   (`raw`) or destroyed (`syn`).
3. *Clocks.* The phones sample uniformly (99.92 Hz; the iPhone 5 93.61 Hz) and only their stamps are
rounded: a line through the
   stamps restores the time of each row. In `syn` the same holds once the repeated rows are dropped.
4. *Alignment* of phone and Vicon (`gnio_jax.data.alignment`): extrinsic rotation, lever arm, level,
biases, lag.
   A fit that does not explain the motion, or finds what no phone on a marker body can be, is
   refused (`_check_fit`).
5. *Reference.* Orientation: integrated gyro times a robustly smoothed correction towards Vicon (σ
0.3 s). Position: Vicon's plus
   the lever arm, levelled, through Whittaker's smoother (half response at 12 Hz); velocity: its
   derivative. The accelerometer has no part in the positions. `gyro` and `accel` stay the phone's,
   biases included; they are only put on a uniform 100 Hz clock, and the accelerometer's delay
   against the gyro (6 to 22 ms on an iPhone 7 Plus, 44 to 52 ms on an iPhone 5, 2 to 3 ms on a
   Nexus 5) is taken out.
6. *Splits*, from the authors' lists or by seeded hold-out.

In `large scale` the truth is a Tango tablet whose attitude is unusable: positions are Tango's (half
response at 4 Hz), the orientation is integrated gyro, corrected slowly until R·accel + g agrees
with the second difference of the positions.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial.transform import Rotation, Slerp

from gnio_jax.data.alignment import (
    Alignment,
    TooLittle,
    Track,
    align,
    align_heading,
    attitude_from_acceleration,
    fuse_attitude,
    smooth_positions,
)
from gnio_jax.data.dataset import Dataset, Recording, Refusal, single
from gnio_jax.data.readers.text import shortened
from gnio_jax.data.validation import check_units, validate
from gnio_jax.numerics import integrate_gyro, quaternions
from gnio_jax.types import STANDARD_G, InputError, Sequence

RATE = 100.0
VERSION = "oxiod 8"
"""Changes whenever other sequences would come of the same files: it is part of the cache's key."""

SINGLE_USER = ("handheld", "pocket", "handbag", "trolley", "running", "slow walking")
UNSEEN = ("multi users", "multi devices")
LARGE_SCALE = "large scale"
SPLITS = (
    "train",
    "val",
    "test",
    "seen",
    "unseen",
    "large_scale",
    "sessions_train",
    "sessions_val",
    "sessions_test",
)
SEED = 20180923
"""Of every hold-out below."""

LICENCE = "for research, as stated by the authors (deepio.cs.ox.ac.uk)"
LAYOUT = "<scene>/<dataN|userN|device>/{raw,syn}/imuK.csv with viK.csv (or handK.csv, tangoK.csv); <scene>/{Train,Test}.txt"

LONGEST_BRIDGE = 0.2
"""Stretches without a Vicon pose up to here (s) are bridged to better than a centimetre; longer
ones are not valid."""

# What a fit of phone and Vicon may say. In brackets: the largest figure of the 57 real pairs, raw
# and syn, that were at hand.
MOST_TURNING_UNEXPLAINED = 0.1
"""Share of the turning's power that a fit may leave (0.010). Another walk's Vicon leaves
0.6 and more."""
MOST_ACCELERATION_UNEXPLAINED = 0.5
"""The same of the acceleration (0.17, on a trolley, which shakes more than it accelerates)."""
CLOSEST_RUNNER_UP = 0.5
"""What the best fit leaves unexplained over what the best fit with another lag does (0.13); 1 where
both are as good."""
LONGEST_LAG = {"raw": 5.0, "syn": 1.0}
"""s. The clocks of raw files were set apart (0.29 here, 1.7 in others of the set, and as far as the
search goes); the rows of syn files were matched by the authors (0.29)."""
LONGEST_DRIFT = 1.0
"""s between the smallest and the largest lag of a walk: clocks drift by 1 ms in some seconds
(0.26)."""
LONGEST_ACCEL_DELAY = 0.15
"""s: phones filter the accelerometer over some samples (0.052)."""
LONGEST_LEVER = 0.3
"""m between the IMU and the marker body's origin, which is the phone with markers on it (0.12)."""
LARGEST_TILT = 5.0
"""Degrees by which the world of a calibrated tracker leans (0.8)."""
LARGEST_GYRO_BIAS = 0.1
"""rad/s: a phone's gyro that nothing has calibrated (0.02)."""
LARGEST_ACCEL_BIAS = 0.6
"""m/s²: 60 mG, a bad accelerometer (0.17)."""


# --- 1. walks
# --------------------------------------------------------------------------------------------------------


class Walk(NamedTuple):
    """One walk: the files of one recording."""

    scene: str
    folder: str
    """dataN, userN or the device."""
    number: int
    files: dict[str, tuple[Path, Path]]
    """kind ("raw", "syn") -> (imu, truth)."""
    placement: str

    @property
    def session(self) -> str:
        return f"{self.scene}/{self.folder}"

    @property
    def name(self) -> str:
        return f"{self.scene}_{self.folder}_{self.number}".replace(" ", "-")

    @property
    def minutes(self) -> float:
        """Rough length by the size of the file, for sharing out walks without reading them."""
        imu = next(iter(self.files.values()))[0]
        return imu.stat().st_size / (140.0 * RATE * 60.0)


def find_walks(root: Path) -> list[Walk]:
    """Every walk below `root`, whose scenes may lie some folders deeper. Raises `InputError` when
    there is none."""
    if not root.is_dir():
        raise InputError(
            root, "no such folder", f"OxIOD is had from {DATASET.source}; expected layout: {LAYOUT}"
        )
    walks = []
    for scene in (*SINGLE_USER, *UNSEEN, LARGE_SCALE):
        for place in _scene_folders(root, scene):
            for folder in sorted(path for path in place.iterdir() if path.is_dir()):
                walks += _walks_of(scene, folder)
    if not walks:
        raise InputError(root, "holds no recording of OxIOD", f"expected layout: {LAYOUT}")
    return walks


def _scene_folders(root: Path, scene: str) -> list[Path]:
    for depth in ("", "*/", "*/*/"):
        found = sorted(path for path in root.glob(f"{depth}{scene}") if path.is_dir())
        if found:
            return found[:1]
    return []


def _walks_of(scene: str, folder: Path) -> list[Walk]:
    files: dict[int, dict[str, tuple[Path, Path]]] = {}
    for kind in (
        ("syn",) if scene == LARGE_SCALE else ("raw", "syn")
    ):  # raw of the large scale is another format, without Tango's pairs
        for imu in sorted((folder / kind).glob("imu*.csv")):
            match = re.fullmatch(r"imu(\d+)\.csv", imu.name)
            truth = (
                next(
                    (
                        imu.with_name(f"{name}{match[1]}.csv")
                        for name in ("vi", "hand", "tango")
                        if imu.with_name(f"{name}{match[1]}.csv").is_file()
                    ),
                    None,
                )
                if match
                else None
            )
            if match is None:
                continue
            if truth is None:
                warnings.warn(
                    f"{imu}: has no vi, hand or tango file beside it; left out", stacklevel=2
                )
                continue
            files.setdefault(int(match[1]), {})[kind] = (imu, truth)
    placements = _placements(scene, folder)
    return [
        Walk(scene, folder.name, number, kinds, placements(number))
        for number, kinds in sorted(files.items())
    ]


def _placements(scene: str, folder: Path) -> Callable[[int], str]:
    """Where the phone was: the scene says it, for other users a note of lines like "3-5: pocket"
    does, where there is one."""
    if scene in SINGLE_USER:
        return lambda number: {"running": "handheld", "slow walking": "handheld"}.get(scene, scene)
    if scene == LARGE_SCALE:
        return lambda number: "handheld"
    notes = [path for path in folder.glob("*/*.txt") if path.stem.lower() == "readme"]
    text = notes[0].read_text(encoding="utf-8", errors="replace") if notes else ""
    spans = [
        (int(first), int(last), name)
        for first, last, name in re.findall(r"(\d+)\s*-\s*(\d+)\s*:\s*(\w+)", text)
    ]
    return lambda number: next(
        (name for first, last, name in spans if first <= number <= last), "unknown"
    )


# --- 2. native text
# --------------------------------------------------------------------------------------------------


class Imu(NamedTuple):
    """A phone's samples on its own clock."""

    time: Float[np.ndarray, " n"]
    """s since `epoch`, as uniform as the phone samples."""
    gyro: Float[np.ndarray, "n 3"]
    """rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """m/s², specific force."""
    attitude: Rotation | None
    """The phone's own, body→world with an arbitrary yaw."""
    epoch: float
    """Unix time of time 0, or 0 where the file's time is destroyed."""


def _table(path: Path, columns: Iterable[int]) -> np.ndarray:
    """The numbers of a text file without a header; `Refusal` when it has another number of columns
    or what is no number."""
    try:
        table = pd.read_csv(path, header=None, dtype=str, keep_default_na=False, nrows=1)
        skip = (
            0 if re.match(r"\s*[-+.\d]", str(table.iloc[0, 0])) else 1
        )  # some exports carry a header
        table = pd.read_csv(path, header=None, skiprows=skip, low_memory=False)
    except (OSError, ValueError, IndexError, UnicodeDecodeError) as error:
        raise Refusal(
            path,
            f"cannot be read as comma-separated numbers ({shortened(str(error).strip(), 200)})",
            "copy it again",
        ) from None
    if table.shape[1] not in columns:
        raise Refusal(
            path,
            f"has {table.shape[1]} columns, expected {' or '.join(str(count) for count in columns)}",
            "copy it again",
        )
    try:
        return table.to_numpy(dtype=np.float64)
    except (ValueError, OverflowError) as error:
        raise Refusal(
            path, f"holds what is no number ({shortened(error, 200)})", "copy it again"
        ) from None


def _complete(table: np.ndarray, names: Iterable[str], path: Path) -> None:
    for column, name in zip(table.T, names, strict=False):
        bad = ~np.isfinite(column)
        if bad.any():
            raise Refusal(
                path,
                f"field '{name}' is NaN, Inf or cut short in {bad.sum()} rows, first in row {int(np.argmax(bad)) + 1}",
                "copy it again or cut it there",
            )


_IPHONE_COLUMNS = (
    "time",
    "roll",
    "pitch",
    "yaw",
    "rotation_rate_x",
    "rotation_rate_y",
    "rotation_rate_z",
    "gravity_x",
    "gravity_y",
    "gravity_z",
    "user_acc_x",
    "user_acc_y",
    "user_acc_z",
)


def read_imu(path: Path, kind: str) -> Imu:
    """A phone's file. `kind` "raw": its stamps are unix time; "syn": they are not, its rows are
    1/100 s apart."""
    table = _table(path, (16, 10, 5))
    if len(table) < 10 * RATE:
        raise Refusal(path, f"holds {len(table)} rows, less than 10 s", "copy it again")
    if table.shape[1] == 16:
        imu = _iphone(table, kind, path)
    elif table.shape[1] == 10:
        imu = _nexus_rows(table, path)
    else:
        imu = _nexus_events(table, path)
    try:
        check_units(imu.gyro, imu.accel, path)
    except InputError as error:
        raise Refusal(*_parts(error)) from None
    return imu


def _iphone(table: np.ndarray, kind: str, path: Path) -> Imu:
    _complete(table, _IPHONE_COLUMNS, path)
    values = table[:, 1:13]
    if kind == "raw":
        order = np.argsort(
            table[:, 0], kind="stable"
        )  # the stamps are right, the order of some rows is not
        stamps, values = table[order, 0], values[order]
    else:
        stamps = np.arange(len(table)) / RATE
    # A repeated row is filler, whatever its stamp; a repeated stamp with other values is a rounded
    # clock.
    fresh = np.concatenate([[True], (np.diff(values, axis=0) != 0).any(axis=1)])
    stamps, values = stamps[fresh], values[fresh]
    epoch = float(stamps[0]) if kind == "raw" else 0.0
    gravity = np.median(np.linalg.norm(values[:, 6:9], axis=1))
    if not 0.9 < gravity < 1.1:
        raise Refusal(
            path,
            f"field 'gravity' has length {gravity:.3g}, expected 1 G",
            "check the column order",
        )
    # Rz(yaw) Rx(pitch) Ry(roll)
    attitude = Rotation.from_euler("ZXY", values[:, [2, 1, 0]])
    accel = -(values[:, 6:9] + values[:, 9:12]) * STANDARD_G
    return Imu(_uniform(stamps - epoch, path), values[:, 3:6], accel, attitude, epoch)


def _nexus_rows(table: np.ndarray, path: Path) -> Imu:
    _complete(table, ("time", "acc_x", "acc_y", "acc_z", "gyro_x", "gyro_y", "gyro_z"), path)
    stamps, values = np.arange(len(table)) / RATE, table[:, 1:7]
    awake = values[:, 3:].any(axis=1)  # the gyro starts some rows after the accelerometer
    fresh = np.concatenate([[True], (np.diff(values, axis=0) != 0).any(axis=1)]) & awake
    stamps, values = stamps[fresh], values[fresh]
    return Imu(_uniform(stamps, path), values[:, 3:6], values[:, 0:3], None, 0.0)


def _nexus_events(table: np.ndarray, path: Path) -> Imu:
    _complete(table, ("time", "type", "x", "y", "z"), path)
    accel, gyro = table[table[:, 1] == 1], table[table[:, 1] == 4]
    if min(len(accel), len(gyro)) < 10 * RATE:
        raise Refusal(
            path,
            f"holds {len(accel)} rows of type 1 (acc) and {len(gyro)} of type 4 (gyro), less than 10 s",
            "copy it again",
        )
    epoch = float(table[:, 0].min()) / 1e3
    accel_time, gyro_time = (
        _uniform(np.sort(rows[:, 0]) / 1e3 - epoch, path) for rows in (accel, gyro)
    )
    accel, gyro = (rows[np.argsort(rows[:, 0], kind="stable"), 2:5] for rows in (accel, gyro))
    # The two sensors tick together; where one has lost rows the other's clock still holds.
    time = gyro_time[(gyro_time >= accel_time[0]) & (gyro_time <= accel_time[-1])]
    gyro = gyro[(gyro_time >= accel_time[0]) & (gyro_time <= accel_time[-1])]
    return Imu(time, gyro, CubicSpline(accel_time, accel, axis=0)(time), None, epoch)


def _parts(error: InputError) -> tuple[str, str, str]:
    where, _, problem = str(error).partition(": ")
    return where, problem, ""


# --- 3. clocks
# -------------------------------------------------------------------------------------------------------


def _uniform(stamps: Float[np.ndarray, " n"], path: Path) -> Float[np.ndarray, " n"]:
    """Times of uniformly taken samples from stamps rounded to 10 ms, s: a continuous line, with a
    knot per 30 s.

    Lost rows leave a step behind; each is counted by its length. Raises `Refusal` when the stamps
    cannot come from a uniform clock.
    """
    count = len(stamps)
    period = (stamps[-1] - stamps[0]) / (count - 1)
    steps = np.diff(stamps)
    typical = float(np.median(steps))
    if not 0.002 < typical < 0.05 or not 0.002 < period:
        raise Refusal(
            path,
            f"field 'time' is ruined (median step {typical:.3g} s, {period:.3g} s on average)",
            "use the syn files",
        )
    if steps.max() > 1.0:
        row = int(np.argmax(steps)) + 1
        raise Refusal(
            path,
            f"field 'time' has a gap of {steps.max():.2f} s before row {row}",
            "cut the recording there",
        )
    period = float(np.mean(steps[steps < 2.5 * typical]))
    lost = np.where(steps > 2.6 * period, np.round(steps / period) - 1.0, 0.0)
    index = np.arange(count) + np.concatenate([[0.0], np.cumsum(lost)])
    knots = np.linspace(index[0], index[-1], max(int((stamps[-1] - stamps[0]) / 30.0), 1) + 1)
    hats = np.clip(1.0 - np.abs((index[:, None] - knots) / (knots[1] - knots[0])), 0.0, 1.0)
    weight = np.ones(count)
    for _ in range(3):  # a few late stamps must not bend the line
        solution = np.linalg.lstsq(hats * weight[:, None], stamps * weight, rcond=None)[0]
        error = stamps - hats @ solution
        weight = 1.0 / np.sqrt(1.0 + (error / 0.01) ** 2)
    if error.std() > 0.02 or np.any(np.diff(solution) <= 0):
        raise Refusal(
            path,
            f"field 'time' is not that of a uniform clock (off by {error.std() * 1e3:.0f} ms rms)",
            "use the syn files",
        )
    return hats @ solution


def read_vicon(path: Path, kind: str, epoch: float) -> Track:
    """Vicon's poses on a uniform 100 Hz clock; time in s since `epoch` (`raw`) or since the first
    row (`syn`).

    Held rows, and everything within 0.1 s of a step faster than 600 °/s or 10 m/s, are not `good`.
    Raises `Refusal`.
    """
    table = _table(path, (9,))
    if len(table) < 10 * RATE:
        raise Refusal(path, f"holds {len(table)} rows, less than 10 s", "copy it again")
    if kind == "raw":
        _complete(table, ("time",), path)
        stamps = table[:, 0] / 1e9 - epoch
        if not abs(float(np.median(stamps))) < 3600.0 or np.ptp(stamps) < 10.0:
            raise Refusal(
                path,
                f"field 'time' is ruined or not of the phone's hour (median {np.median(table[:, 0]):.6g} ns)",
                "use the syn files",
            )
        table = table[np.argsort(stamps, kind="stable")]
        stamps = np.sort(stamps)
    else:
        stamps = np.arange(len(table)) / RATE
    norm = np.linalg.norm(table[:, 5:9], axis=1)
    known = np.isfinite(table).all(axis=1) & (np.abs(norm - 1.0) < 0.01)
    fresh = np.concatenate([[True], (np.diff(table[:, 2:9], axis=0) != 0).any(axis=1)])
    rows = np.flatnonzero(known & fresh & np.concatenate([[True], np.diff(stamps) > 0]))
    if len(rows) < 0.5 * len(table):
        raise Refusal(
            path,
            f"only {len(rows)} of {len(table)} rows hold a pose (fields 'translation', 'rotation')",
            "copy it again",
        )
    stamps, position, quaternion = stamps[rows], table[rows, 2:5], table[rows, 5:9]
    if np.ptp(position, axis=0).max() > 200.0:
        raise Refusal(
            path, "field 'translation' spans more than 200 m, it looks like mm", "convert it to m"
        )

    attitude = Rotation.from_quat(quaternion)
    steps = np.diff(stamps)
    angle = (attitude[:-1].inv() * attitude[1:]).magnitude()
    distance = np.linalg.norm(np.diff(position, axis=0), axis=1)
    wild = (angle > np.radians(600.0) * steps) | (distance > 10.0 * steps)
    good = np.ones(len(stamps), dtype=bool)
    for row in np.flatnonzero(wild):
        good[
            np.searchsorted(stamps, stamps[row] - 0.1) : np.searchsorted(
                stamps, stamps[row + 1] + 0.1
            )
        ] = False
    if good.sum() < 0.3 * len(table):
        raise Refusal(
            path, f"only {good.sum()} of {len(table)} poses are plausible", "copy it again"
        )

    time = np.arange(np.ceil(stamps[0] * RATE), np.floor(stamps[-1] * RATE) + 1) / RATE
    time = time[(time >= stamps[0]) & (time <= stamps[-1])]
    right = np.clip(np.searchsorted(stamps, time), 1, len(stamps) - 1)
    exact = (stamps[right] - time) < 1e-6
    reached = (good[right - 1] & good[right] & (stamps[right] - stamps[right - 1] < 0.025)) | (
        exact & good[right]
    )
    # What was not good must not stand in for what surrounds it: interpolate over it.
    keep = np.flatnonzero(good)
    inside = np.clip(time, stamps[keep[0]], stamps[keep[-1]])
    position = np.stack(
        [np.interp(inside, stamps[keep], column) for column in position[keep].T], axis=1
    )
    return Track(
        time, position, Slerp(stamps[keep], Rotation.from_quat(quaternion[keep]))(inside), reached
    )


# --- 4 and 5. alignment and reference
# ---------------------------------------------------------------------------------


def build(walk: Walk, kind: str) -> Sequence:
    """One walk as a Sequence at 100 Hz. Raises `Refusal` when its files or the fit of phone and
    truth are of no use."""
    imu_path, truth_path = walk.files[kind]
    # The phone's stamps survive in the syn files of the large scale.
    imu = read_imu(imu_path, "raw" if walk.scene == LARGE_SCALE else kind)
    if truth_path.name.startswith("tango"):
        return _with_tango(walk, kind, imu, truth_path)
    time, gyro, accel, device, measured = _resample(imu)
    track = read_vicon(truth_path, kind, imu.epoch)
    try:
        # Clocks of raw files run straight; in syn files rows were lost and filled in, and the lag
        # steps by 10 to 20 ms.
        fit = align(time, gyro, accel, track, knot_seconds=30.0 if kind == "raw" else 5.0)
    except TooLittle as error:
        raise Refusal(
            truth_path, f"cannot be aligned with the phone ({error})", "leave it out"
        ) from None
    _check_fit(fit, kind, truth_path)
    # The accelerometer tells of an event later than the gyro: read it later, from the phone's rows.
    accel, accel_measured = _samples_at(imu.time, imu.accel, time + fit.accel_delay)
    measured &= accel_measured

    # The track at the phone's stamps.
    at = fit.track_time(time)
    covered = (at >= track.time[0]) & (at <= track.time[-1])
    if covered.sum() < 10 * RATE:
        raise Refusal(
            truth_path, "overlaps the phone's recording by less than 10 s", "leave it out"
        )
    span = slice(int(np.argmax(covered)), len(covered) - int(np.argmax(covered[::-1])))
    time, gyro, accel, at, measured = time[span], gyro[span], accel[span], at[span], measured[span]
    device = None if device is None else device[span]
    inside = np.clip(at, track.time[0], track.time[-1])
    good = track.good & np.logical_not(binary_dilation(fit.mismatch, iterations=10))
    right = np.clip(np.searchsorted(track.time, inside), 1, len(track.time) - 1)
    seen = good[right] & good[right - 1]

    level = fit.levelling()
    pose = level * Slerp(track.time, track.attitude)(inside) * fit.extrinsic
    integrated = integrate_gyro(gyro - fit.gyro_bias, 1.0 / RATE)
    orientation, believed = fuse_attitude(integrated, pose, seen, 1.0 / RATE)
    lever = fit.extrinsic.inv().apply(fit.lever)
    marker = level.apply(
        np.stack([np.interp(inside, track.time, column) for column in track.position.T], axis=1)
    )
    # A marker body that has flipped is not where it says, either.
    position, velocity, kept = smooth_positions(
        marker + orientation.apply(lever), believed, 1.0 / RATE
    )
    valid = _bridged(kept, LONGEST_BRIDGE) & measured

    angles = fit.extrinsic.as_euler("ZXY", degrees=True)
    attributes = _attributes(walk, kind, "vicon") | {
        "lag": float(np.mean(fit.lag)),
        "lag_drift": float(np.ptp(fit.lag)),
        "accel_delay_removed": fit.accel_delay,
        "gyro_unexplained": fit.gyro_unexplained,
        "accel_unexplained": fit.accel_unexplained,
        "runner_up": fit.runner_up,
        "extrinsic_yaw_degrees": float(angles[0]),
        "extrinsic_tilt_degrees": float(
            np.degrees(np.arccos(np.clip(fit.extrinsic.as_matrix()[2, 2], -1.0, 1.0)))
        ),
        "tilt_x": float(fit.up[0] / fit.up[2]),
        "tilt_y": float(fit.up[1] / fit.up[2]),
        "gyro_residual": fit.gyro_residual,
        "accel_residual": fit.accel_residual,
    }
    for axis, name in enumerate("xyz"):
        attributes[f"lever_{name}"] = float(fit.lever[axis])
        attributes[f"gyro_bias_{name}"] = float(fit.gyro_bias[axis])
        attributes[f"accel_bias_{name}"] = float(fit.accel_bias[axis])
    return _sequence(
        walk,
        truth_path,
        imu.epoch,
        time,
        gyro,
        accel,
        orientation,
        position,
        velocity,
        valid,
        device,
        attributes,
    )


def _resample(imu: Imu) -> tuple[np.ndarray, np.ndarray, np.ndarray, Rotation | None, np.ndarray]:
    """(time, gyro, accel, attitude, measured) on a uniform 100 Hz clock; `measured` is False in
    gaps of more than 0.1 s."""
    time = imu.time[0] + np.arange(int((imu.time[-1] - imu.time[0]) * RATE + 1e-6)) / RATE
    values, measured = _samples_at(imu.time, np.concatenate([imu.gyro, imu.accel], axis=1), time)
    device = None if imu.attitude is None else Slerp(imu.time, imu.attitude)(time)
    return time, values[:, :3], values[:, 3:], device, measured


def _check_fit(fit: Alignment, kind: str, path: Path) -> None:
    """Raise `Refusal` where the best fit does not explain the motion, or says what cannot be of a
    phone on a marker body."""
    remedy = "check that both files are of one walk"
    shares = (
        ("turning", fit.gyro_unexplained, MOST_TURNING_UNEXPLAINED),
        ("acceleration", fit.accel_unexplained, MOST_ACCELERATION_UNEXPLAINED),
    )
    for what, share, most in shares:
        if not share <= most:
            raise Refusal(
                path,
                f"does not move as the phone does: {share:.0%} of the power of its "
                f"{what} stays unexplained, at most {most:.0%} is plausible",
                remedy,
            )
    if not fit.runner_up <= CLOSEST_RUNNER_UP:
        raise Refusal(
            path,
            "fits the phone at two lags alike, for the walk repeats itself (one leaves "
            f"{fit.runner_up:.0%} of what the other leaves unexplained)",
            "leave it out",
        )
    tilt = float(np.degrees(np.arccos(np.clip(fit.up[2], -1.0, 1.0))))
    bounds = (
        ("lag", float(np.abs(fit.lag).max()), LONGEST_LAG[kind], "s"),
        ("lag's drift", float(np.ptp(fit.lag)), LONGEST_DRIFT, "s"),
        ("accel's delay", abs(fit.accel_delay), LONGEST_ACCEL_DELAY, "s"),
        ("lever arm", float(np.linalg.norm(fit.lever)), LONGEST_LEVER, "m"),
        ("world's tilt", tilt, LARGEST_TILT, "°"),
        ("gyro's bias", float(np.linalg.norm(fit.gyro_bias)), LARGEST_GYRO_BIAS, "rad/s"),
        ("accel's bias", float(np.linalg.norm(fit.accel_bias)), LARGEST_ACCEL_BIAS, "m/s²"),
    )
    for what, value, most, unit in bounds:
        if not value <= most:
            raise Refusal(
                path,
                f"fits the phone only with what cannot be: the {what} would be "
                f"{value:.3g} {unit}, at most {most:g} {unit} is plausible",
                remedy,
            )


def _samples_at(
    stamps: Float[np.ndarray, " n"],
    values: Float[np.ndarray, "n w"],
    time: Float[np.ndarray, " m"],
) -> tuple[Float[np.ndarray, "m w"], Bool[np.ndarray, " m"]]:
    """A sensor's rows at other times by a cubic spline, and whether it measured there: not beyond
    its ends, where the first and last row stand in, nor in gaps of more than 0.1 s."""
    inside = np.clip(time, stamps[0], stamps[-1])
    right = np.clip(np.searchsorted(stamps, inside), 1, len(stamps) - 1)
    left = right - 1
    interval = stamps[right] - stamps[left]
    # A spline swings in a gap.
    share = ((inside - stamps[left]) / interval)[:, None]
    line = (1.0 - share) * values[left] + share * values[right]
    there = np.where((interval > 0.03)[:, None], line, CubicSpline(stamps, values, axis=0)(inside))
    return there, (interval <= 0.1) & (np.abs(time - inside) < 1e-9)


def _bridged(good: Bool[np.ndarray, " n"], seconds: float) -> Bool[np.ndarray, " n"]:
    """`good`, with holes of up to `seconds` counted in."""
    reach = max(round(seconds * RATE / 2), 1)
    padded = np.pad(good, reach)
    closed = binary_erosion(binary_dilation(padded, iterations=reach), iterations=reach)
    return (closed | padded)[reach:-reach]


def _attributes(walk: Walk, kind: str, truth: str) -> dict[str, str | float]:
    user = (
        walk.folder
        if walk.scene == "multi users"
        else "user1"
        if walk.scene in SINGLE_USER
        else "unknown"
    )
    device = walk.folder if walk.scene == "multi devices" else "iPhone 7 Plus"
    return {
        "dataset": "oxiod",
        "scene": walk.scene,
        "session": walk.session,
        "group": walk.session,
        "kind": kind,
        "subject": user,
        "device": device,
        "placement": walk.placement,
        "truth": truth,
        "licence": LICENCE,
    }


def _sequence(
    walk: Walk,
    source: Path,
    epoch: float,
    time: np.ndarray,
    gyro: np.ndarray,
    accel: np.ndarray,
    orientation: Rotation,
    position: np.ndarray,
    velocity: np.ndarray,
    valid: np.ndarray,
    device: Rotation | None,
    attributes: dict[str, str | float],
) -> Sequence:
    """The stretch from the first to the last valid sample, starting at 0 s; `start_time` is that
    moment on the phone's clock."""
    if valid.sum() < 10 * RATE:
        raise Refusal(
            source, f"only {valid.sum() / RATE:.1f} s have a usable reference", "leave it out"
        )
    span = slice(int(np.argmax(valid)), len(valid) - int(np.argmax(valid[::-1])))
    count = span.stop - span.start
    return validate(
        Sequence(
            name=walk.name,
            time=np.arange(count) / RATE,
            gyro=gyro[span],
            accel=accel[span],
            orientation=quaternions(orientation[span]),
            position=position[span],
            velocity=velocity[span],
            valid=valid[span],
            device_orientation=None if device is None else quaternions(device[span]),
            attributes=attributes | {"start_time": epoch + float(time[span.start])},
        ),
        source,
    )


def _with_tango(walk: Walk, kind: str, imu: Imu, path: Path) -> Sequence:
    """Positions from a Tango tablet, orientation from integrated gyro led by the accelerations of
    both."""
    table = _table(path, (9,))
    time, gyro, accel, device, measured = _resample(imu)
    if device is None:
        raise Refusal(path, "goes with a phone that gives no attitude", "leave it out")
    # Tango's stamps are rounded to a second in some files, and its rows are 1/100 s apart; a
    # repeated row is filler.
    stamps = np.arange(len(table)) / RATE
    fresh = np.concatenate([[True], (np.diff(table[:, 2:5], axis=0) != 0).any(axis=1)])
    rows = np.flatnonzero(fresh & np.isfinite(table[:, 2:5]).all(axis=1))
    if len(rows) < 0.5 * len(table):
        raise Refusal(
            path,
            f"only {len(rows)} of {len(table)} rows hold a position (field 'translation')",
            "copy it again",
        )
    position = np.stack(
        [np.interp(stamps, stamps[rows], column) for column in table[rows, 2:5].T], axis=1
    )
    # Where Tango relocalises, it jumps.
    jumps = binary_dilation(
        np.linalg.norm(np.gradient(position, 1.0 / RATE, axis=0), axis=1) > 5.0, iterations=10
    )
    good = np.logical_not(jumps) & (
        np.interp(stamps, stamps[rows], np.gradient(stamps[rows])) < 0.1
    )
    try:
        fit = align_heading(time, device.apply(accel)[:, :2], stamps, position, good)
    except ValueError as error:
        raise Refusal(path, f"cannot be aligned with the phone ({error})", "leave it out") from None
    if fit.correlation < 0.3:
        raise Refusal(
            path,
            f"Tango is out of step with the phone (accelerations correlate by {fit.correlation:.2f})",
            "leave it out",
        )
    if not np.abs(fit.lag).max() <= LONGEST_LAG[kind]:
        raise Refusal(
            path,
            f"Tango is out of step with the phone (by {np.abs(fit.lag).max():.2f} s, "
            f"at most {LONGEST_LAG[kind]:g} s is plausible)",
            "leave it out",
        )

    at = np.interp(time, fit.knots + fit.lag, fit.knots, left=-1.0, right=-1.0)
    covered = (at >= 0.0) & (at <= stamps[-1])
    span = slice(int(np.argmax(covered)), len(covered) - int(np.argmax(covered[::-1])))
    time, gyro, accel, device, at, measured = (
        time[span],
        gyro[span],
        accel[span],
        device[span],
        at[span],
        measured[span],
    )
    place = np.clip(np.round(at * RATE).astype(int), 0, len(stamps) - 1)
    there = np.stack([np.interp(at, stamps, column) for column in position.T], axis=1)
    position, velocity, kept = smooth_positions(there, good[place], 1.0 / RATE, cutoff=4.0)
    turned = (
        Rotation.from_rotvec(np.interp(at, fit.knots, fit.yaw)[:, None] * [0.0, 0.0, 1.0]) * device
    )
    # The phone's own attitude takes part of each stride's acceleration for gravity: up to 6° of
    # tilt, and it drifts in yaw. Over minutes, though, gravity tells it the gyro's bias in tilt.
    bias = (
        0.5 * (gyro[1:] + gyro[:-1]) - (device[:-1].inv() * device[1:]).as_rotvec() * RATE
    ).mean(axis=0)
    orientation = attitude_from_acceleration(
        integrate_gyro(gyro - bias, 1.0 / RATE), turned, accel, position, kept, 1.0 / RATE
    )
    attributes = _attributes(walk, kind, "tango") | {
        "lag": float(np.mean(fit.lag)),
        "lag_drift": float(np.ptp(fit.lag)),
        "yaw_drift_degrees": float(np.degrees(np.ptp(fit.yaw))),
        "heading_correlation": fit.correlation,
        "runner_up": fit.runner_up,
    }
    valid = _bridged(kept, LONGEST_BRIDGE) & measured
    return _sequence(
        walk,
        path,
        imu.epoch,
        time,
        gyro,
        accel,
        orientation,
        position,
        velocity,
        valid,
        device,
        attributes,
    )


# --- 6. splits
# -------------------------------------------------------------------------------------------------------


def recordings(root: Path, split: str) -> list[Recording]:
    """The walks of a split."""
    return [recording_of(walk) for walk in _chosen(Path(root), split)]


def recording_of(walk: Walk) -> Recording:
    """`raw` before `syn`, which is read where `raw` is refused."""
    forms = [
        single(walk.name, build, walk, kind)._replace(
            files=walk.files[kind], version=VERSION, form=kind
        )
        for kind in ("raw", "syn")
        if kind in walk.files
    ]
    return forms[0]._replace(fallback=forms[1]) if len(forms) == 2 else forms[0]


def _chosen(root: Path, split: str) -> list[Walk]:
    chosen = select(find_walks(root), split, root)
    if not chosen:
        raise InputError(
            root,
            f"no recording of split '{split}' is present",
            "see the warnings above, or choose another split",
        )
    return chosen


def select(walks: list[Walk], split: str, root: Path) -> list[Walk]:
    """The walks of `split`. Raises `InputError` on a list that is missing or empty."""
    if split == "unseen":
        return [walk for walk in walks if walk.scene in UNSEEN]
    if split == "large_scale":
        return [walk for walk in walks if walk.scene == LARGE_SCALE]
    single = [walk for walk in walks if walk.scene in SINGLE_USER]
    if split.startswith("sessions_"):
        room = [walk for walk in walks if walk.scene != LARGE_SCALE]
        shares = share_out(room)
        return [walk for walk in room if shares[walk.session] == split.removeprefix("sessions_")]
    if split in ("test", "seen"):
        return _listed(single, "Test.txt", root)
    listed = _listed(single, "Train.txt", root)
    held = held_out_sessions(listed)
    return [walk for walk in listed if (walk.session in held) == (split == "val")]


def _listed(walks: list[Walk], name: str, root: Path) -> list[Walk]:
    """Walks that the lists `name` of the scenes name: entries `dataN` or `dataN/imuK.csv`, the last
    line perhaps without its end."""
    chosen, absent, found = [], 0, False
    for scene in SINGLE_USER:
        for place in _scene_folders(root, scene):
            path = place / name
            if not path.is_file():
                continue
            found = True
            entries = [
                line.strip().replace("\\", "/")
                for line in path.read_text(encoding="utf-8", errors="replace").splitlines()
            ]
            entries = [entry for entry in entries if entry]
            if not entries:
                raise InputError(path, "the list is empty", "copy it again")
            for entry in entries:
                match = re.fullmatch(r"(data\d+)(?:/(?:imu)?(\d+)(?:\.csv)?)?", entry)
                if not match:
                    raise InputError(
                        path,
                        f"entry '{shortened(entry)}' is neither dataN nor dataN/imuK.csv",
                        "copy the list again",
                    )
                here = [
                    walk
                    for walk in walks
                    if walk.scene == scene
                    and walk.folder == match[1]
                    and (match[2] is None or walk.number == int(match[2]))
                ]
                absent += not here
                chosen += [walk for walk in here if walk not in chosen]
    if not found:
        raise InputError(root, f"no scene has its list {name}", f"expected layout: {LAYOUT}")
    if absent:
        warnings.warn(
            f"{root}: {absent} entries of the lists {name} are not in this copy", stacklevel=2
        )
    return chosen


def held_out_sessions(walks: list[Walk], share: float = 0.1) -> set[str]:
    """Whole sessions for validation: drawn with a fixed seed until they hold `share` of the time,
    never the last of a scene."""
    generator = np.random.default_rng(SEED)
    sessions = sorted({walk.session for walk in walks})
    minutes = {
        session: sum(walk.minutes for walk in walks if walk.session == session)
        for session in sessions
    }
    scenes = {walk.session: walk.scene for walk in walks}
    held: set[str] = set()
    for session in generator.permutation(sessions):
        left = [
            other
            for other in sessions
            if scenes[other] == scenes[session] and other not in held and other != session
        ]
        if left and sum(minutes[other] for other in held) < share * sum(minutes.values()):
            held.add(str(session))
    return held


def share_out(walks: list[Walk]) -> dict[str, str]:
    """Session -> "train", "val" or "test": of many seeded draws the one nearest to 70/10/20 of the
    time.

    A session is never divided, and every scene keeps one to train on: of two the other tests, of
    three the third validates.
    """
    minutes: dict[str, dict[str, float]] = {}
    for walk in walks:
        sessions = minutes.setdefault(walk.scene, {})
        sessions[walk.session] = sessions.get(walk.session, 0.0) + walk.minutes
    total = max(sum(sum(sessions.values()) for sessions in minutes.values()), 1e-9)
    generator = np.random.default_rng(SEED)
    best, best_score = {}, np.inf
    for _ in range(300):
        shares = {}
        for scene in sorted(minutes):
            order = [str(session) for session in generator.permutation(sorted(minutes[scene]))]
            shares |= dict(zip(order, ("train", "test", "val"), strict=False))
            shares |= {
                session: str(generator.choice(["train", "val", "test"], p=[0.8, 0.05, 0.15]))
                for session in order[3:]
            }
        times = {share: sum(length for sessions in minutes.values() for session, length in sessions.items() if shares[session] == share)
                 for share in ("train", "val", "test")}  # fmt: skip
        score = sum(
            abs(times[share] / total - wanted)
            for share, wanted in (("train", 0.7), ("val", 0.1), ("test", 0.2))
        )
        if score < best_score:
            best, best_score = shares, score
    return best


DATASET = Dataset(
    name="oxiod",
    recordings=recordings,
    splits=SPLITS,
    rate=RATE,
    source="http://deepio.cs.ox.ac.uk",
    layout=LAYOUT,
    licence=LICENCE,
)
