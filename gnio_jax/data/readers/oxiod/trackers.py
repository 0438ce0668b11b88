"""The trackers' native text files: Vicon's poses and Tango's positions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment import Track
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.readers.oxiod.phone import (
    SHORTEST,
    check_complete,
    check_length,
    is_fresh,
    read_table,
)
from gnio_jax.data.readers.oxiod.walks import RATE
from gnio_jax.numerics import interpolate, neighbours, slerp, turns_between, within

_POSITION, _QUATERNION = slice(2, 5), slice(5, 9)
"""Columns of m, and of xyzw."""
WIDEST = 200.0
"""m that the walks in a room span at most."""
FASTEST_TURN, FASTEST = np.radians(600.0), 10.0
"""rad/s and m/s: a tracker that shows more has jumped."""
AROUND_JUMPS = 0.1
"""s before and after a jump that are not believed, either."""
LONGEST_STEP = 0.025
"""s between poses that are interpolated."""
FASTEST_TANGO = 5.0
"""m/s: where Tango relocalises, it jumps."""


def read_vicon(path: Path, kind: str, epoch: float) -> Track:
    """Vicon's poses on a uniform 100 Hz clock; time in s since `epoch` (`raw`) or since the first
    row (`syn`).

    Held rows, and everything within 0.1 s of a step faster than 600 °/s or 10 m/s, are not `good`.
    Raises `Refusal`.
    """
    table = read_table(path, (9,))
    check_length(table, path)
    stamps, table = _stamps(table, kind, epoch, path)
    rows = _rows_with_pose(table, stamps, path)
    stamps, position = stamps[rows], table[rows, _POSITION]
    attitude = Rotation.from_quat(table[rows, _QUATERNION])
    if np.ptp(position, axis=0).max() > WIDEST:
        raise Refusal(
            path,
            f"field 'translation' spans more than {WIDEST:g} m, it looks like mm",
            "convert it to m",
        )
    good = _plausible(stamps, position, attitude)
    if good.sum() < 0.3 * len(table):
        raise Refusal(
            path, f"only {good.sum()} of {len(table)} poses are plausible", "copy it again"
        )
    return _on_clock(stamps, position, attitude, good)


def _stamps(
    table: np.ndarray, kind: str, epoch: float, path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """(stamps s, table), both in the order of the stamps."""
    if kind == "syn":
        return np.arange(len(table)) / RATE, table
    check_complete(table, ("time",), path)
    stamps = table[:, 0] / 1e9 - epoch
    if not abs(float(np.median(stamps))) < 3600.0 or np.ptp(stamps) < SHORTEST:
        raise Refusal(
            path,
            "field 'time' is ruined or not of the phone's hour "
            f"(median {np.median(table[:, 0]):.6g} ns)",
            "use the syn files",
        )
    return np.sort(stamps), table[np.argsort(stamps, kind="stable")]


def _rows_with_pose(table: np.ndarray, stamps: np.ndarray, path: Path) -> np.ndarray:
    """Rows that hold a pose, not that of the row before, and a stamp of their own."""
    norm = np.linalg.norm(table[:, _QUATERNION], axis=1)
    known = np.isfinite(table).all(axis=1) & (np.abs(norm - 1.0) < 0.01)
    own_stamp = np.concatenate([[True], np.diff(stamps) > 0])
    rows = np.flatnonzero(known & is_fresh(table[:, 2:9]) & own_stamp)
    if len(rows) < 0.5 * len(table):
        raise Refusal(
            path,
            f"only {len(rows)} of {len(table)} rows hold a pose (fields 'translation', 'rotation')",
            "copy it again",
        )
    return rows


def _plausible(
    stamps: np.ndarray, position: np.ndarray, attitude: Rotation
) -> Bool[np.ndarray, " n"]:
    """False around steps that nobody makes."""
    steps = np.diff(stamps)
    angle = np.linalg.norm(turns_between(attitude), axis=1)
    distance = np.linalg.norm(np.diff(position, axis=0), axis=1)
    jumps = np.flatnonzero((angle > FASTEST_TURN * steps) | (distance > FASTEST * steps))
    first = np.searchsorted(stamps, stamps[jumps] - AROUND_JUMPS)
    stop = np.searchsorted(stamps, stamps[jumps + 1] + AROUND_JUMPS)
    good = np.ones(len(stamps), dtype=bool)
    for rows in map(slice, first, stop):
        good[rows] = False
    return good


def _on_clock(
    stamps: np.ndarray, position: np.ndarray, attitude: Rotation, good: np.ndarray
) -> Track:
    time = np.arange(np.ceil(stamps[0] * RATE), np.floor(stamps[-1] * RATE) + 1) / RATE
    time = time[(time >= stamps[0]) & (time <= stamps[-1])]
    left, right = neighbours(stamps, time)
    between = good[left] & good[right] & (stamps[right] - stamps[left] < LONGEST_STEP)
    exact = good[right] & (stamps[right] - time < 1e-6)
    # What was not good must not stand in for what surrounds it: interpolate over it.
    kept = stamps[good]
    inside = np.clip(time, kept[0], kept[-1])
    return Track(
        time,
        interpolate(inside, kept, position[good]),
        slerp(inside, kept, attitude[good]),
        between | exact,
    )


def read_tango(
    path: Path,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """(time s, position m, good) of Tango's rows, which are 1/100 s apart.

    Its stamps are rounded to a second in some files. Not good are jumps and rows that were not
    seen for long. Raises `Refusal`.
    """
    table = read_table(path, (9,))
    time = np.arange(len(table)) / RATE
    position = table[:, _POSITION]
    rows = np.flatnonzero(is_fresh(position) & np.isfinite(position).all(axis=1))
    if len(rows) < 0.5 * len(table):
        raise Refusal(
            path,
            f"only {len(rows)} of {len(table)} rows hold a position (field 'translation')",
            "copy it again",
        )
    position = interpolate(time, time[rows], position[rows])
    speed = np.linalg.norm(np.gradient(position, 1.0 / RATE, axis=0), axis=1)
    jumps = within(speed > FASTEST_TANGO, round(AROUND_JUMPS * RATE))
    seen = np.interp(time, time[rows], np.gradient(time[rows])) < 0.1
    return time, position, np.logical_not(jumps) & seen
