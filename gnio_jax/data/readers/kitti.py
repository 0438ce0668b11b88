"""KITTI raw: a car with an OXTS RT3003, the vehicle case (Geiger et al., IJRR 2013).

Two layouts are read, also side by side:

1. *Text as published*: `<root>/<date>/<drive>_extract/oxts/{timestamps.txt,data/<row>.txt}`, one
packet of 30 values a file at 100 Hz.
   Stamps are unix time to the nanosecond by the recording computer; rows come out of order, some
   stamps twice, and packets are lost. Rows are sorted, of equal stamps the first is kept, and the
   drive is divided where more than 0.1 s is missing. The `_sync` export carries 10 Hz, too slow for
   an IMU: it is refused.
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
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.readers.stamps import in_order
from gnio_jax.data.readers.text import shortened
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import (
    FASTEST,
    FASTEST_TURN,
    STRONGEST_FORCE,
    check_finite,
    check_gaps,
    check_increasing,
    check_rate,
    validate,
)
from gnio_jax.numerics import quaternions, stretches
from gnio_jax.types import InputError, Sequence

RATE = 100.0
SPLITS = ("train", "val", "test")
SEED = "kitti raw 28"
"""Of the draw of drives: of a few the one whose shares of the drives' time came nearest to the
shares of the names."""

EARTH_RADIUS = 6378137.0
"""m, of the sphere of the projection."""
LONGEST_BRIDGE = 0.1
"""A drive is divided where packets are missing for longer than this, s."""
SHORTEST_PIECE = 3.0
"""s; what is shorter holds too few windows to be worth a sequence."""
LARGEST_JUMP = 0.5
"""m within a second by which position and integrated velocity may disagree."""

_STAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d+)?")
_PACKET = re.compile(r"[0-9]+\.txt")
_DRIVE = re.compile(r"\d{4}_\d{2}_\d{2}_drive_\d{4}")
_VALUES = (
    "lat",
    "lon",
    "alt",
    "roll",
    "pitch",
    "yaw",
    "vn",
    "ve",
    "vf",
    "vl",
    "vu",
    "ax",
    "ay",
    "az",
    "af",
    "al",
    "au",
    "wx",
    "wy",
    "wz",
    "wf",
    "wl",
    "wu",
    "pos_accuracy",
    "vel_accuracy",
    "navstat",
    "numsats",
    "posmode",
    "velmode",
    "orimode",
)
_MOST = np.array(
    [85.0, 180.0, 1e5, *[10.0] * 3, *[FASTEST] * 5, *[STRONGEST_FORCE] * 6, *[FASTEST_TURN] * 3]
)
"""Magnitudes of the values up to `wz` beyond which a packet is damaged; the rest is not used."""
_ARRAYS = {"t": None, "p_gt": 3, "ang_gt": 3, "v_gt": 3, "u": 6}


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
            found += [single(_piece_name(path), read_piece, path) for path in drive.pieces]
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
    """Every drive below `root`. Raises `InputError` when there is none, or only the 10 Hz export."""
    folders: dict[str, list[Path]] = {}
    for depth in ("", "*/", "*/*/", "*/*/*/"):
        for oxts in sorted(path for path in root.glob(f"{depth}oxts") if path.is_dir()):
            if match := _DRIVE.search(oxts.parent.name):
                folders.setdefault(match[0], []).append(oxts)
    pieces: dict[str, list[Path]] = {}
    for path in sorted(root.glob("*.npz")):
        if match := _DRIVE.search(path.name):
            pieces.setdefault(match[0], []).append(path)
    drives, slow = [], []
    for name in sorted({*folders, *pieces}):
        quick = [oxts for oxts in folders.get(name, []) if not oxts.parent.name.endswith("_sync")]
        if quick or name in pieces:
            drives.append(Drive(name, quick[0] if quick else None, tuple(pieces.get(name, []))))
        else:
            slow.append(name)
    remedy = "get its _extract archive, which carries the 100 Hz of the IMU"
    if slow and not drives:
        raise InputError(
            root,
            f"holds only the 10 Hz export (_sync), of {', '.join(slow[:3])}{', ...' if len(slow) > 3 else ''}",
            remedy,
        )
    if slow:
        warnings.warn(
            f"{root}: {len(slow)} drives are there only as the 10 Hz export (_sync) and are left out: "
            f"{', '.join(slow[:3])}; {remedy}",
            stacklevel=3,
        )
    if not drives:
        raise InputError(root, "holds no drive of KITTI", f"expected layout: {DATASET.layout}")
    return drives


# --- text packets
# ----------------------------------------------------------------------------------------------------


def read_packets(oxts: str | os.PathLike[str]) -> list[Sequence]:
    """The pieces of a drive of its folder `oxts`, not yet self-checked. Raises `InputError` naming
    file and field."""
    oxts = Path(oxts)
    rows, packets = _packets(oxts / "data")
    stamps = _stamps(oxts / "timestamps.txt")
    if rows[-1] >= len(stamps):
        raise InputError(
            oxts / "timestamps.txt",
            f"holds {len(stamps)} stamps, but there is a packet {rows[-1]}",
            "copy the drive again",
        )
    known = ~np.isnat(stamps[rows])
    if known.sum() < 2:
        raise InputError(
            oxts / "timestamps.txt", f"gives {known.sum()} packets a stamp", "copy the drive again"
        )
    stamps, packets = stamps[rows][known], packets[known]
    start = stamps.min()
    time, packets, repairs = in_order(
        (stamps - start).astype(np.int64) * 1e-9, packets, oxts / "timestamps.txt", repeats="first"
    )
    if np.median(np.diff(time)) > 0.05:
        raise InputError(
            oxts / "timestamps.txt",
            f"field 'time' runs at {1 / np.median(np.diff(time)):.3g} Hz, as the _sync export does",
            "get the _extract archive, which carries the 100 Hz of the IMU",
        )
    check_rate(time, RATE, oxts / "timestamps.txt")

    latitude, longitude, altitude, roll, pitch, yaw, north, east = packets[:, :8].T
    position = project(latitude, longitude, altitude)
    velocity = np.stack([east, north, packets[:, _VALUES.index("vu")]], axis=1)
    force, rate = (
        packets[:, _VALUES.index(first) : _VALUES.index(first) + 3] for first in ("ax", "wx")
    )
    attitude = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1))
    name = _drive_of(oxts)
    sequences, short = [], 0
    for piece, inside in enumerate(stretches(np.diff(time) > LONGEST_BRIDGE)):
        if time[inside][-1] - time[inside][0] < SHORTEST_PIECE:
            short += 1
            continue
        sequences.append(
            _sequence(
                f"{name}_extract{piece}",
                time[inside],
                rate[inside],
                force[inside],
                attitude[inside],
                position[inside],
                velocity[inside],
                name,
                oxts,
                {"start_time": float(start.astype(np.int64) * 1e-9), **repairs},
            )
        )
    if short:
        warnings.warn(
            f"{oxts}: {short} pieces between missing packets are shorter than {SHORTEST_PIECE:g} s; left out",
            stacklevel=2,
        )
    return sequences


def project(
    latitude: Float[np.ndarray, " n"],
    longitude: Float[np.ndarray, " n"],
    altitude: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """East, north, up (m) from the first point, of degrees and metres: Mercator's projection with
    the scale of the first latitude."""
    scale = np.cos(np.radians(latitude[0])) * EARTH_RADIUS
    position = np.stack(
        [
            scale * np.radians(longitude),
            scale * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2)),
            altitude,
        ],
        axis=1,
    )
    return position - position[0]


def _packets(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """(rows,) numbers of the packets and their values (rows, 30)."""
    # Plain names, not paths: at 100 Hz these are tens of thousands of files.
    names = (
        sorted(name for name in os.listdir(folder) if _PACKET.fullmatch(name))
        if folder.is_dir()
        else []
    )
    if len(names) < 2:
        raise InputError(folder, "holds no packets <row>.txt", f"expected layout: {DATASET.layout}")
    table = np.empty((len(names), len(_VALUES)))
    for row, name in enumerate(names):
        try:
            with open(os.path.join(folder, name), "rb") as file:
                values = file.read().split()
            if len(values) != len(_VALUES):
                raise InputError(
                    folder / name,
                    f"holds {len(values)} values, expected {len(_VALUES)} ({_VALUES[0]} ... {_VALUES[-1]})",
                    "it may be cut short: copy it again",
                )
            table[row] = [float(value) for value in values]
        except OSError as error:
            raise InputError(folder / name, f"cannot be read ({error.strerror})") from None
        except InputError:
            raise
        except ValueError as error:
            raise InputError(
                folder / name, f"holds what is no number ({shortened(error, 200)})", "copy it again"
            ) from None
    absurd = ~(np.abs(table[:, : len(_MOST)]) <= _MOST)  # NaN, too
    if absurd.any():
        row, index = np.argwhere(absurd)[0]
        raise InputError(
            folder / names[row],
            f"field '{_VALUES[index]}' is {table[row, index]:g}, expected within ±{_MOST[index]:g}",
            "copy it again",
        )
    return np.array([int(name.removesuffix(".txt")) for name in names]), table


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


# --- npz
# -------------------------------------------------------------------------------------------------------------


def read_piece(path: str | os.PathLike[str]) -> Sequence:
    """One npz, not yet self-checked. Raises `InputError` naming file and field."""
    path = Path(path)
    values: dict[str, np.ndarray] = {}
    try:
        with np.load(path, allow_pickle=False) as file:
            for field, width in _ARRAYS.items():
                if field not in file:
                    raise InputError(
                        path, f"field '{field}' is missing", f"found: {', '.join(file.files)}"
                    )
                value = file[field]
                rows = len(values["t"]) if "t" in values else value.size
                wanted = (rows,) if width is None else (rows, width)
                if value.dtype.kind != "f" or value.shape != wanted:
                    raise InputError(
                        path,
                        f"field '{field}' is {value.dtype} of shape {value.shape}, expected floats {wanted}",
                    )
                values[field] = value.astype(np.float64)
    except InputError:
        raise
    except Exception as error:  # a damaged file makes the parser fail in any way
        raise InputError(
            path,
            f"cannot be read as npz, it may be cut short ({shortened(error, 200)})",
            "copy it again",
        ) from None
    for field, value in values.items():
        check_finite(value, field, path)
    time = values["t"]
    check_increasing(time, path)
    check_rate(time, RATE, path)
    check_gaps(time, path)
    return _sequence(
        _piece_name(path),
        time,
        values["u"][:, :3],
        values["u"][:, 3:],
        Rotation.from_euler("ZYX", values["ang_gt"][:, ::-1]),
        values["p_gt"],
        values["v_gt"],
        _drive_of(path),
        path,
        {},
    )


def _piece_name(path: Path) -> str:
    return re.sub(r"^(train|val|test)__", "", path.stem)


# --- both
# ------------------------------------------------------------------------------------------------------------


def _drive_of(path: Path) -> str:
    match = _DRIVE.search(str(path.name if path.suffix == ".npz" else path.parent.name))
    return match[0] if match else path.parent.name


def _sequence(
    name: str,
    time: np.ndarray,
    gyro: np.ndarray,
    accel: np.ndarray,
    attitude: Rotation,
    position: np.ndarray,
    velocity: np.ndarray,
    drive: str,
    source: Path,
    attributes: dict[str, float],
) -> Sequence:
    sequence = Sequence(
        name=name,
        time=time,
        gyro=gyro,
        accel=accel,
        orientation=quaternions(attitude),
        position=position,
        velocity=velocity,
        valid=np.ones(len(time), dtype=bool),
        attributes={
            "dataset": "kitti",
            "group": drive,
            "session": drive[:10],
            "placement": "car",
            "truth": "INS with RTK-GPS (OXTS RT3003)",
            "imu_compensated": "reference",
            "licence": DATASET.licence,
            **attributes,
        },
    )
    sequence = resample(validate(sequence, source), RATE)
    return sequence._replace(valid=~_jumps(sequence))


def _jumps(sequence: Sequence) -> np.ndarray:
    """True in every second in which position and integrated velocity disagree by more than
    `LARGEST_JUMP`."""
    second = round(RATE)
    steps = 0.5 * (sequence.velocity[1:] + sequence.velocity[:-1]) * np.diff(sequence.time)[:, None]
    error = sequence.position - np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    far = np.linalg.norm(error[second:] - error[:-second], axis=1) > LARGEST_JUMP
    middle = np.zeros(len(error), dtype=bool)
    middle[second // 2 : second // 2 + len(far)] = far
    return np.asarray(binary_dilation(middle, np.ones(second + 1, dtype=bool)))


DATASET = Dataset(
    name="kitti",
    recordings=recordings,
    splits=SPLITS,
    rate=RATE,
    source="https://www.cvlibs.net/datasets/kitti/raw_data.php (the unsynced+unrectified, _extract, archives)",
    layout="<root>/<date>/<drive>_extract/oxts/{timestamps.txt,data/*.txt} or <root>/*<drive>_extract<piece>.npz",
    licence="CC BY-NC-SA 3.0",
    pedestrian=False,
)
