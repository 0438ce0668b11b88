"""Text packets of an OXTS inertial navigation system, as KITTI publishes them.

`oxts/timestamps.txt` holds a line for each packet, `oxts/data/<row>.txt` its 30 values.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from gnio_jax.data.parsing.stamps import in_order
from gnio_jax.data.parsing.tables import shortened
from gnio_jax.data.validation import FASTEST, check_rate
from gnio_jax.errors import InputError
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE

EARTH_RADIUS = 6378137.0
"""m, of the sphere of the projection."""

_STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d+)?")
_PACKET = re.compile(r"[0-9]+\.txt")
_VALUES = (
    "lat lon alt roll pitch yaw vn ve vf vl vu ax ay az af al au wx wy wz wf wl wu "
    "pos_accuracy vel_accuracy navstat numsats posmode velmode orimode"
).split()
_MOST = np.array(
    [85.0, 180.0, 1e5, *[10.0] * 3, *[FASTEST] * 5, *[STRONGEST_FORCE] * 6, *[FASTEST_TURN] * 3]
)
"""Magnitudes of the values up to `wz` beyond which a packet is damaged; the rest is not used."""


class Motion(NamedTuple):
    """IMU and reference of a vehicle, on one clock."""

    time: Float[np.ndarray, " n"]
    """s, increasing."""
    gyro: Float[np.ndarray, "n 3"]
    """rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """m/s²."""
    attitude: Rotation
    """Vehicle → east, north, up."""
    position: Float[np.ndarray, "n 3"]
    """East, north, up, m."""
    velocity: Float[np.ndarray, "n 3"]
    """East, north, up, m/s."""

    def part(self, rows: slice) -> Motion:
        """The same of some rows."""
        return Motion(*(values[rows] for values in self))


def read_oxts(oxts: Path, rate: float, layout: str) -> tuple[Motion, float, dict[str, float]]:
    """(motion, unix time s of its stamp 0, counts of repaired rows) of a folder `oxts`.

    Rows are sorted, of equal stamps the first is kept, packets without a stamp are left out. World:
    east, north, up from the first packet (`project`). Raises `InputError` naming file and field,
    where it lacks `layout` or does not run at about `rate` Hz.
    """
    times = oxts / "timestamps.txt"
    rows, packets = _packets(oxts / "data", layout)
    stamps = _stamps(times)
    if rows[-1] >= len(stamps):
        raise InputError(
            times,
            f"holds {len(stamps)} stamps, but there is a packet {rows[-1]}",
            "copy the drive again",
        )
    known = ~np.isnat(stamps[rows])
    if known.sum() < 2:
        raise InputError(times, f"gives {known.sum()} packets a stamp", "copy the drive again")
    stamps, packets = stamps[rows][known], packets[known]
    start = stamps.min()
    seconds = (stamps - start).astype(np.int64) * 1e-9
    order, repairs = in_order(seconds, packets, times)
    time, packets = seconds[order], packets[order]
    if np.median(np.diff(time)) > 0.05:
        raise InputError(
            times,
            f"field 'time' runs at {1 / np.median(np.diff(time)):.3g} Hz, as the _sync export does",
            "get the _extract archive, which carries the 100 Hz of the IMU",
        )
    check_rate(time, rate, times)
    return _motion(time, packets), float(start.astype(np.int64) * 1e-9), repairs


def _motion(time: Float[np.ndarray, " n"], packets: Float[np.ndarray, "n 30"]) -> Motion:
    def values(*names: str) -> Float[np.ndarray, "n w"]:
        return packets[:, [_VALUES.index(name) for name in names]]

    return Motion(
        time=time,
        gyro=values("wx", "wy", "wz"),
        accel=values("ax", "ay", "az"),
        attitude=Rotation.from_euler("ZYX", values("yaw", "pitch", "roll")),
        position=project(*values("lat", "lon", "alt").T),
        velocity=values("ve", "vn", "vu"),
    )


def project(
    latitude: Float[np.ndarray, " n"],
    longitude: Float[np.ndarray, " n"],
    altitude: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """East, north, up (m) from the first point, of degrees and metres: Mercator's projection with
    the scale of the first latitude."""
    scale = np.cos(np.radians(latitude[0])) * EARTH_RADIUS
    east = scale * np.radians(longitude)
    north = scale * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    position = np.stack([east, north, altitude], axis=1)
    return position - position[0]


def _packets(folder: Path, layout: str) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 30"]]:
    """Numbers of the packets, and their values."""
    # Plain names, not paths: at 100 Hz these are tens of thousands of files.
    names = sorted(filter(_PACKET.fullmatch, os.listdir(folder))) if folder.is_dir() else []
    if len(names) < 2:
        raise InputError(folder, "holds no packets <row>.txt", f"expected layout: {layout}")
    table = np.empty((len(names), len(_VALUES)))
    for row, name in enumerate(names):
        table[row] = _packet(os.path.join(folder, name))
    absurd = ~(np.abs(table[:, : len(_MOST)]) <= _MOST)  # NaN, too
    if absurd.any():
        row, index = np.argwhere(absurd)[0]
        raise InputError(
            folder / names[row],
            f"field '{_VALUES[index]}' is {table[row, index]:g}, expected within ±{_MOST[index]:g}",
            "copy it again",
        )
    return np.array([int(name.removesuffix(".txt")) for name in names]), table


def _packet(path: str) -> list[float]:
    try:
        with open(path, "rb") as file:
            values = file.read().split()
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from None
    if len(values) != len(_VALUES):
        raise InputError(
            path,
            f"holds {len(values)} values, expected {len(_VALUES)} ({_VALUES[0]} ... {_VALUES[-1]})",
            "it may be cut short: copy it again",
        )
    try:
        return [float(value) for value in values]
    except ValueError as error:
        raise InputError(
            path, f"holds what is no number ({shortened(error, 200)})", "copy it again"
        ) from None


def _stamps(path: Path) -> np.ndarray:
    """datetime64[ns] of each line, NaT for an empty one (a packet without a stamp)."""
    try:
        lines = path.read_text(encoding="utf-8").rstrip().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            path, f"cannot be read ({getattr(error, 'strerror', None) or error})"
        ) from None
    stamps = np.full(len(lines), np.datetime64("NaT"), dtype="datetime64[ns]")
    for row, line in enumerate(lines):
        if line.strip():
            try:
                if not _STAMP.fullmatch(line.strip()):  # NumPy takes "now" for a stamp, too
                    raise ValueError
                stamps[row] = np.datetime64(line.strip(), "ns")
            except ValueError:
                raise InputError(
                    path,
                    f"line {row + 1} ('{shortened(line.strip())}') is no stamp",
                    "stamps look like 2011-09-26 14:02:22.484109563",
                ) from None
    return stamps
