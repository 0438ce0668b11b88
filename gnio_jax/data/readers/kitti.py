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
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.readers.oxts import Motion, read_oxts
from gnio_jax.data.readers.parsing import float_columns, parsed_as
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import (
    check_finite,
    check_gaps,
    check_increasing,
    check_rate,
    validate,
)
from gnio_jax.errors import InputError
from gnio_jax.numerics import midpoints, quaternions, stretches, within
from gnio_jax.types import Sequence

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

_DRIVE = re.compile(r"\d{4}_\d{2}_\d{2}_drive_\d{4}")
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
    """The pieces of a drive of its folder `oxts`, not yet self-checked. Raises `InputError` naming
    file and field."""
    oxts = Path(oxts)
    motion, start, repairs = read_oxts(oxts, RATE, DATASET.layout)
    drive = _drive_of(oxts)
    sequences, short = [], 0
    for number, rows in enumerate(stretches(np.diff(motion.time) > LONGEST_GAP)):
        piece = motion.part(rows)
        if piece.time[-1] - piece.time[0] < SHORTEST_PIECE:
            short += 1
            continue
        about = {"start_time": start, **repairs}
        sequences.append(_sequence(f"{drive}_extract{number}", drive, piece, oxts, about))
    if short:
        warnings.warn(
            f"{oxts}: {short} pieces between missing packets are shorter than "
            f"{SHORTEST_PIECE:g} s; left out",
            stacklevel=2,
        )
    return sequences


def read_piece(path: str | os.PathLike[str]) -> Sequence:
    """One npz, not yet self-checked. Raises `InputError` naming file and field."""
    path = Path(path)
    with parsed_as(path, "npz"), np.load(path, allow_pickle=False) as file:
        fields = float_columns(file, _ARRAYS, path)
    for name, values in fields.items():
        check_finite(values, name, path)
    time, imu = fields["t"], fields["u"]
    check_increasing(time, path)
    check_rate(time, RATE, path)
    check_gaps(time, path)
    attitude = Rotation.from_euler("ZYX", fields["ang_gt"][:, ::-1])
    motion = Motion(time, imu[:, :3], imu[:, 3:], attitude, fields["p_gt"], fields["v_gt"])
    return _sequence(_piece_name(path), _drive_of(path), motion, path, {})


def _piece_name(path: Path) -> str:
    return re.sub(r"^(train|val|test)__", "", path.stem)


def _drive_of(path: Path) -> str:
    match = _DRIVE.search(str(path.name if path.suffix == ".npz" else path.parent.name))
    return match[0] if match else path.parent.name


def _sequence(
    name: str, drive: str, motion: Motion, source: Path, attributes: dict[str, float]
) -> Sequence:
    sequence = Sequence(
        name=name,
        time=motion.time,
        gyro=motion.gyro,
        accel=motion.accel,
        orientation=quaternions(motion.attitude),
        position=motion.position,
        velocity=motion.velocity,
        valid=np.ones(len(motion.time), dtype=bool),
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


def _jumps(sequence: Sequence) -> Bool[np.ndarray, " n"]:
    """True in every second in which position and integrated velocity disagree by more than
    `LARGEST_JUMP`."""
    second = round(RATE)
    steps = midpoints(sequence.velocity) * np.diff(sequence.time)[:, None]
    error = sequence.position - np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    far = np.linalg.norm(error[second:] - error[:-second], axis=1) > LARGEST_JUMP
    middle = np.zeros(len(error), dtype=bool)
    middle[second // 2 : second // 2 + len(far)] = far
    return within(middle, second // 2)


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
