"""KITTI raw: a car with an OXTS RT3003, the vehicle case (Geiger et al., IJRR 2013).

Two layouts are read, also side by side:

1. *Text as published*: `<root>/<date>/<drive>_extract/oxts/{timestamps.txt,data/<row>.txt}`, one
   packet of 30 values a file at 100 Hz. Stamps are unix time to the nanosecond by the recording
   computer; rows come out of order, some stamps twice, and packets are lost. Rows are sorted, of
   equal stamps the first is kept, and the drive is divided where more than 0.1 s is missing. The
   `_sync` export carries 10 Hz, too slow for an IMU: it is refused.
2. `<root>/*__<drive>_extract<piece>.npz`: t s, p_gt m, ang_gt roll-pitch-yaw rad, v_gt m/s
   east-north-up, u = [gyro rad/s, accel m/s²].

The body is the car's: x forward, y left, z up. World: east, north, up from the drive's first packet
by a Mercator projection whose scale is that latitude's. Orientation: Rz(yaw) Ry(pitch) Rx(roll),
yaw from east, counter-clockwise.

Truth and IMU are one INS, so the IMU is compensated with the reference's biases
(`imu_compensated`), and its positions are corrected by jumps: where position and integrated
velocity disagree by more than half a metre over a second, the reference is not valid. The rates are
published behind a low-pass of first order (0.06 s, against the derivative of the attitudes); they
are given as they are.

Splits are ours, as none is published for the raw drives: a drive is drawn by a hash of its name
(70/10/20 % of the names), hence always falls into the same split whatever else a copy holds, and
pieces of one drive are never divided between splits.
"""

from __future__ import annotations

import hashlib
import os
import re
import warnings
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.dataset import Dataset, Recording
from gnio_jax.data.parsing.stamps import in_order
from gnio_jax.data.parsing.tables import read_npz, shortened
from gnio_jax.data.validation import FASTEST, check_increasing, check_rate
from gnio_jax.errors import InputError
from gnio_jax.numerics import stretches
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Sequence

RATE = 100.0
SPLITS = ("train", "val", "test")
SEED = "kitti raw 28"
"""Of the draw of drives: of a few the one whose shares of the drives' time came nearest to the
shares of the names."""

LONGEST_GAP = 0.1
"""A drive is divided where packets are missing for longer than this, s."""
SHORTEST_PIECE = 3.0
"""s; what is shorter holds too few windows to be worth a sequence."""
LARGEST_JUMP = 0.5
"""m within a second by which position and integrated velocity may disagree."""
EARTH_RADIUS = 6378137.0
"""m, of the sphere of the projection."""

_DRIVE = re.compile(r"\d{4}_\d{2}_\d{2}_drive_\d{4}")
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


class Drive(NamedTuple):
    """Where one drive lies in this copy."""

    name: str
    """<date>_drive_<number>."""
    oxts: Path | None
    """Folder of the text packets."""
    pieces: tuple[Path, ...]
    """Its npz files; not read where there are packets."""


def recordings(root: Path, split: str) -> list[Recording]:
    """The drives of a split, or their pieces where these are files of their own."""
    found = []
    for drive in find_drives(Path(root)):
        if share_of(drive.name) == split and drive.oxts:
            found.append(Recording(drive.name, partial(read_packets, drive.oxts)))
        elif share_of(drive.name) == split:
            found += [
                Recording(_piece_name(path), partial(read_piece, path)) for path in drive.pieces
            ]
    if not found:
        raise InputError(
            root,
            f"none of its drives falls into split '{split}'",
            "drives are drawn by their names; take another split or more drives",
        )
    return found


def share_of(drive: str) -> str:
    """Split of a drive, from its name alone."""
    place = int(hashlib.sha256(f"{SEED} {drive}".encode()).hexdigest()[:8], 16) / 2**32
    return "train" if place < 0.7 else "val" if place < 0.8 else "test"


def find_drives(root: Path) -> list[Drive]:
    """Every drive below `root`. Raises `InputError` where there is none, or only the 10 Hz
    export."""
    places = [path for depth in ("", "*/", "*/*/", "*/*/*/") for path in root.glob(f"{depth}oxts")]
    folders = _by_drive((path.parent.name, path) for path in places if path.is_dir())
    pieces = _by_drive((path.name, path) for path in root.glob("*.npz"))
    drives, slow = [], []
    for name in sorted({*folders, *pieces}):
        quick = [oxts for oxts in folders.get(name, []) if not oxts.parent.name.endswith("_sync")]
        if quick or name in pieces:
            drives.append(Drive(name, quick[0] if quick else None, tuple(pieces.get(name, []))))
        else:
            slow.append(name)
    few = f"{', '.join(slow[:3])}{', ...' if len(slow) > 3 else ''}"
    remedy = "get its _extract archive, which carries the 100 Hz of the IMU"
    if slow and not drives:
        raise InputError(root, f"holds only the 10 Hz export (_sync), of {few}", remedy)
    if slow:
        warnings.warn(
            f"{root}: {len(slow)} drives are there only as the 10 Hz export (_sync) and are left "
            f"out: {', '.join(slow[:3])}; {remedy}",
            stacklevel=3,
        )
    if not drives:
        raise InputError(root, "holds no drive of KITTI", f"expected layout: {DATASET.layout}")
    return drives


def _by_drive(named: Iterable[tuple[str, Path]]) -> dict[str, list[Path]]:
    """Paths by the drive that their names tell; the nearest to the root first."""
    found: dict[str, list[Path]] = {}
    for name, path in sorted(named, key=lambda entry: (len(entry[1].parts), entry[1])):
        if match := _DRIVE.search(name):
            found.setdefault(match[0], []).append(path)
    return found


# --- one drive


def read_packets(oxts: str | os.PathLike[str]) -> list[Sequence]:
    """The pieces of a drive of its folder `oxts`.

    Packets without a stamp are left out, rows are sorted, of equal stamps the first is kept. World:
    east, north, up from the first packet (`project`). Raises `InputError` naming file and field.
    """
    oxts = Path(oxts)
    times, drive = oxts / "timestamps.txt", _drive_of(oxts)
    rows, packets = _packets(oxts / "data")
    stamps = _stamps(times)
    if rows.max() >= len(stamps):
        raise InputError(
            times,
            f"holds {len(stamps)} stamps, but there is a packet {rows.max()}",
            "copy the drive again",
        )
    known = ~np.isnat(stamps[rows])
    if known.sum() < 2:
        raise InputError(times, f"gives {known.sum()} packets a stamp", "copy the drive again")
    stamps, packets = stamps[rows][known], packets[known]
    start = stamps.min()
    time = (stamps - start).astype(np.int64) * 1e-9
    order, repairs = in_order(time, packets, times)
    time, packets = time[order], packets[order]
    if np.median(np.diff(time)) > 0.05:
        raise InputError(
            times,
            f"field 'time' runs at {1 / np.median(np.diff(time)):.3g} Hz, as the _sync export does",
            "get the _extract archive, which carries the 100 Hz of the IMU",
        )
    check_rate(time, RATE, times)

    def values(*names: str) -> Float[np.ndarray, "n w"]:
        return packets[:, [_VALUES.index(name) for name in names]]

    position = project(*values("lat", "lon", "alt").T)
    attitude = Rotation.from_euler("ZYX", values("yaw", "pitch", "roll"))
    velocity = values("ve", "vn", "vu")
    gyro, accel = values("wx", "wy", "wz"), values("ax", "ay", "az")
    sequences, short = [], 0
    for number, own in enumerate(stretches(np.diff(time) > LONGEST_GAP)):
        if time[own.stop - 1] - time[own.start] < SHORTEST_PIECE:
            short += 1
            continue
        poses = Poses(time[own], attitude[own], position[own], velocity[own], source=str(oxts))
        sequences += assemble(
            Streams(
                f"{drive}_extract{number}",
                str(oxts),
                Samples(time[own], gyro[own], str(oxts)),
                Samples(time[own], accel[own], str(oxts)),
                _attributes(drive) | repairs,
                float(start.astype(np.int64) * 1e-9),
                poses,
            ),
            RATE,
            native=RATE,
            max_drift=LARGEST_JUMP,
        )
    if short:
        warnings.warn(
            f"{oxts}: {short} pieces between missing packets are shorter than "
            f"{SHORTEST_PIECE:g} s; left out",
            stacklevel=2,
        )
    return sequences


def read_piece(path: str | os.PathLike[str]) -> list[Sequence]:
    """The sequence of one npz. Raises `InputError` naming file and field."""
    path = Path(path)
    table = read_npz(path)
    time, imu = table.take("t"), table.take("u", width=6)
    check_increasing(time, path)
    position, velocity, angles = (table.take(n, width=3) for n in ("p_gt", "v_gt", "ang_gt"))
    attitude = Rotation.from_euler("ZYX", angles[:, ::-1])
    gyro, accel = (Samples(time, part, str(path)) for part in np.split(imu, 2, axis=1))
    poses = Poses(time, attitude, position, velocity, source=str(path))
    about = _attributes(_drive_of(path))
    streams = Streams(_piece_name(path), str(path), gyro, accel, about, poses=poses)
    return assemble(streams, RATE, native=RATE, max_drift=LARGEST_JUMP)


def _attributes(drive: str) -> dict[str, Any]:
    return {
        "dataset": "kitti",
        "group": drive,
        "session": drive[:10],
        "placement": "car",
        "truth": "INS with RTK-GPS (OXTS RT3003)",
        "imu_compensated": "reference",
        "licence": DATASET.licence,
    }


def _piece_name(path: Path) -> str:
    return re.sub(r"^(train|val|test)__", "", path.stem)


def _drive_of(path: Path) -> str:
    match = _DRIVE.search(str(path.name if path.suffix == ".npz" else path.parent.name))
    return match[0] if match else path.parent.name


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


def _packets(folder: Path) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 30"]]:
    """Numbers of the packets, and their values."""
    # Plain names, not paths: at 100 Hz these are tens of thousands of files.
    names = sorted(filter(_PACKET.fullmatch, os.listdir(folder))) if folder.is_dir() else []
    if len(names) < 2:
        raise InputError(folder, "holds no packets <row>.txt", f"expected layout: {DATASET.layout}")
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


DATASET = Dataset(
    name="kitti",
    recordings=recordings,
    splits=SPLITS,
    rate=RATE,
    source="https://www.cvlibs.net/datasets/kitti/raw_data.php "
    "(the unsynced+unrectified, _extract, archives)",
    layout="<root>/<date>/<drive>_extract/oxts/{timestamps.txt,data/*.txt} or "
    "<root>/*<drive>_extract<piece>.npz",
    licence="CC BY-NC-SA 3.0",
    pedestrian=False,
)
