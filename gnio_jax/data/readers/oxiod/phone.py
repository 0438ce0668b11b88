"""The phones' native text files, and the clocks their samples were taken by."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Refusal
from gnio_jax.data.parsing.tables import shortened
from gnio_jax.data.readers.oxiod.walks import RATE
from gnio_jax.data.validation import check_accel, check_gyro
from gnio_jax.errors import InputError
from gnio_jax.types import STANDARD_G

SHORTEST = 10.0
"""s; nothing shorter is of use."""
KNOT_SECONDS = 30.0
"""s between the knots of a phone's clock."""
_VECTORS = ("rotation_rate", "gravity", "user_acc")
_IPHONE = (
    "time",
    "roll",
    "pitch",
    "yaw",
    *(f"{name}_{axis}" for name in _VECTORS for axis in "xyz"),
)
_NEXUS = ("time", "acc_x", "acc_y", "acc_z", "gyro_x", "gyro_y", "gyro_z")
_NEXUS_EVENTS = ("time", "type", "x", "y", "z")
_ACCEL_EVENT, _GYRO_EVENT = 1, 4


class PhoneSamples(NamedTuple):
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


def read_imu(path: Path, kind: str) -> PhoneSamples:
    """A phone's file. Of kind "raw" its stamps are unix time; of kind "syn" they are not, and its
    rows are 1/100 s apart. Raises `Refusal`."""
    table = read_table(path, (16, 10, 5))
    check_length(table, path)
    if table.shape[1] == 16:
        imu = _iphone(table, kind, path)
    elif table.shape[1] == 10:
        imu = _nexus_rows(table, path)
    else:
        imu = _nexus_events(table, path)
    try:
        check_accel(imu.accel, path)
        check_gyro(imu.gyro, path)
    except InputError as error:
        raise Refusal(*error.parts) from None
    return imu


# --- tables


def read_table(path: Path, widths: Iterable[int]) -> Float[np.ndarray, "n w"]:
    """The numbers of a text file, whose header is skipped where it has one.

    Raises `Refusal` when it has another number of columns or holds what is no number.
    """
    try:
        first = pd.read_csv(path, header=None, dtype=str, keep_default_na=False, nrows=1)
        has_header = not re.match(r"\s*[-+.\d]", str(first.iloc[0, 0]))  # some exports do
        table = pd.read_csv(path, header=None, skiprows=int(has_header), low_memory=False)
    except (OSError, ValueError, IndexError, UnicodeDecodeError) as error:
        reason = shortened(str(error).strip(), 200)
        raise Refusal(
            path, f"cannot be read as comma-separated numbers ({reason})", "copy it again"
        ) from None
    if table.shape[1] not in widths:
        expected = " or ".join(str(width) for width in widths)
        raise Refusal(path, f"has {table.shape[1]} columns, expected {expected}", "copy it again")
    try:
        return table.to_numpy(dtype=np.float64)
    except (ValueError, OverflowError) as error:
        raise Refusal(
            path, f"holds what is no number ({shortened(error, 200)})", "copy it again"
        ) from None


def check_length(table: np.ndarray, path: Path) -> None:
    """Raise `Refusal` where the rows are fewer than `SHORTEST` of recording."""
    if len(table) < SHORTEST * RATE:
        raise Refusal(path, f"holds {len(table)} rows, less than {SHORTEST:g} s", "copy it again")


def check_complete(table: np.ndarray, names: Iterable[str], path: Path) -> None:
    """Raise `Refusal` where one of the first columns, which have these names, is not finite."""
    for column, name in zip(table.T, names, strict=False):
        bad = ~np.isfinite(column)
        if bad.any():
            raise Refusal(
                path,
                f"field '{name}' is NaN, Inf or cut short in {bad.sum()} rows, "
                f"first in row {int(np.argmax(bad)) + 1}",
                "copy it again or cut it there",
            )


def is_fresh(values: Float[np.ndarray, "n w"]) -> Bool[np.ndarray, " n"]:
    """False in rows that repeat the row before: they are filler, whatever their stamps."""
    return np.concatenate([[True], (np.diff(values, axis=0) != 0).any(axis=1)])


def _iphone(table: np.ndarray, kind: str, path: Path) -> PhoneSamples:
    check_complete(table, _IPHONE, path)
    stamps, values = np.arange(len(table)) / RATE, table[:, 1:13]
    if kind == "raw":  # the stamps are right, the order of some rows is not
        order = np.argsort(table[:, 0], kind="stable")
        stamps, values = table[order, 0], values[order]
    fresh = is_fresh(values)  # a repeated stamp with other values is a rounded clock
    stamps, values = stamps[fresh], values[fresh]
    roll_pitch_yaw, rotation_rate, gravity, user_acc = np.split(values, 4, axis=1)
    length = np.median(np.linalg.norm(gravity, axis=1))
    if not 0.9 < length < 1.1:
        raise Refusal(
            path,
            f"field 'gravity' has length {length:.3g}, expected 1 G",
            "check the column order",
        )
    epoch = float(stamps[0]) if kind == "raw" else 0.0
    return PhoneSamples(
        time=restore_clock(stamps - epoch, path),
        gyro=rotation_rate,
        accel=-(gravity + user_acc) * STANDARD_G,
        attitude=Rotation.from_euler("ZXY", roll_pitch_yaw[:, [2, 1, 0]]),
        epoch=epoch,
    )


def _nexus_rows(table: np.ndarray, path: Path) -> PhoneSamples:
    check_complete(table, _NEXUS, path)
    stamps, accel, gyro = np.arange(len(table)) / RATE, table[:, 1:4], table[:, 4:7]
    awake = gyro.any(axis=1)  # the gyro starts some rows after the accelerometer
    fresh = is_fresh(table[:, 1:7]) & awake
    return PhoneSamples(restore_clock(stamps[fresh], path), gyro[fresh], accel[fresh], None, 0.0)


def _nexus_events(table: np.ndarray, path: Path) -> PhoneSamples:
    """Rows of one sensor each."""
    check_complete(table, _NEXUS_EVENTS, path)
    kind = table[:, 1]
    accel, gyro = table[kind == _ACCEL_EVENT], table[kind == _GYRO_EVENT]
    if min(len(accel), len(gyro)) < SHORTEST * RATE:
        raise Refusal(
            path,
            f"holds {len(accel)} rows of type 1 (acc) and {len(gyro)} of type 4 (gyro), "
            f"less than {SHORTEST:g} s",
            "copy it again",
        )
    epoch = float(table[:, 0].min()) / 1e3

    def in_order(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        return restore_clock(rows[:, 0] / 1e3 - epoch, path), rows[:, 2:5]

    (accel_time, accel), (time, gyro) = in_order(accel), in_order(gyro)
    # The two sensors tick together; where one has lost rows the other's clock still holds.
    inside = (time >= accel_time[0]) & (time <= accel_time[-1])
    time, gyro = time[inside], gyro[inside]
    return PhoneSamples(time, gyro, CubicSpline(accel_time, accel, axis=0)(time), None, epoch)


# --- clocks


def restore_clock(stamps: Float[np.ndarray, " n"], path: Path) -> Float[np.ndarray, " n"]:
    """Times (s) of uniformly taken samples from stamps rounded to 10 ms.

    The times are piecewise linear in the number of the sample, lost ones counted, with a knot per
    30 s. Raises `Refusal` when the stamps cannot come from a uniform clock.
    """
    typical = _typical_step(stamps, path)
    steps = np.diff(stamps)
    period = float(np.mean(steps[steps < 2.5 * typical]))
    # Lost rows leave a step behind, which is counted by its length.
    lost = np.where(steps > 2.6 * period, np.round(steps / period) - 1.0, 0.0)
    number = np.arange(len(stamps)) + np.concatenate([[0.0], np.cumsum(lost)])
    intervals = max(int((stamps[-1] - stamps[0]) / KNOT_SECONDS), 1)
    knots = np.linspace(number[0], number[-1], intervals + 1)
    hats = np.clip(1.0 - np.abs((number[:, None] - knots) / (knots[1] - knots[0])), 0.0, 1.0)
    weight = np.ones(len(stamps))
    for _ in range(3):  # a few late stamps must not bend the line
        at_knots = np.linalg.lstsq(hats * weight[:, None], stamps * weight, rcond=None)[0]
        error = stamps - hats @ at_knots
        weight = 1.0 / np.sqrt(1.0 + (error / 0.01) ** 2)
    if error.std() > 0.02 or np.any(np.diff(at_knots) <= 0):
        raise Refusal(
            path,
            f"field 'time' is not that of a uniform clock (off by {error.std() * 1e3:.0f} ms rms)",
            "use the syn files",
        )
    return hats @ at_knots


def _typical_step(stamps: Float[np.ndarray, " n"], path: Path) -> float:
    """Median step, s. Raises `Refusal` where the stamps are ruined or have a long gap."""
    steps = np.diff(stamps)
    typical, average = float(np.median(steps)), (stamps[-1] - stamps[0]) / len(steps)
    if not 0.002 < typical < 0.05 or not 0.002 < average:
        raise Refusal(
            path,
            f"field 'time' is ruined (median step {typical:.3g} s, {average:.3g} s on average)",
            "use the syn files",
        )
    if steps.max() > 1.0:
        row = int(np.argmax(steps)) + 1
        raise Refusal(
            path,
            f"field 'time' has a gap of {steps.max():.2f} s before row {row}",
            "cut the recording there",
        )
    return typical
