"""KITTI raw: a car with an OXTS RT3003, the vehicle case (Geiger et al., IJRR 2013).

Two layouts are read, also side by side:

1. *Text as published*: `<root>/<date>/<drive>_extract/oxts/{timestamps.txt,data/<row>.txt}`, one
   packet of 30 values a file at 100 Hz. Stamps are unix time of the recording computer, in ns. Some
   rows are out of order, some stamps occur twice, and some packets are lost. Rows are sorted, the
   first of equal stamps is kept, and the drive is divided where more than 0.1 s is missing. The
   `_sync` export has 10 Hz, which is too slow for an IMU, and is refused.
2. `<root>/*__<drive>_extract<piece>.npz`: t s, p_gt m, ang_gt roll-pitch-yaw rad, v_gt m/s
   east-north-up, u = [gyro rad/s, accel m/s²].

The body is the car's: x forward, y left, z up. World: east, north, up from the drive's first packet
by a Mercator projection whose scale is that latitude's. Orientation: Rz(yaw) Ry(pitch) Rx(roll),
yaw from east, counter-clockwise.

Truth and IMU come from one INS, so the IMU is compensated with the reference's biases
(`imu_compensated`). The INS corrects its positions by jumps: where position and integrated velocity
differ by more than half a metre over a second, the reference is not valid. The published rates have
passed a low-pass of first order (0.06 s, compared with the derivative of the attitudes); they are
not changed.

Splits are ours, because none is published for the raw drives. A drive is assigned by a hash of its
name (70/10/20 % of the names), so it is in the same split in every copy, and pieces of one drive
are never in different splits. `all` is every drive, for folds of whole drives.
"""

from __future__ import annotations

import os
import re
import warnings
from collections import defaultdict
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from gnio_jax.data.assembly import Poses, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.parsing.stamps import in_order
from gnio_jax.data.parsing.tables import damage_error, read_npz, shorten, text_of
from gnio_jax.data.splits import draw_share
from gnio_jax.data.validation import FASTEST
from gnio_jax.errors import InputError
from gnio_jax.files import file_in
from gnio_jax.numerics import stretches
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Sequence

RATE = 100.0
SPLITS = ("train", "val", "test", "all")
SEED = "kitti raw 28"
"""Seed of the draw of drives. Of a few seeds it is the one for which the shares of the drives' time
are nearest to the shares of the names."""

LONGEST_GAP = 0.1
"""A drive is divided where packets are missing for longer than this, s."""
SLOWEST_STEP = 0.05
"""Largest median time between packets, s: half of that of the 10 Hz export."""
SHORTEST_PIECE = 3.0
"""Shortest piece that becomes a sequence, s; shorter ones have too few windows."""
LARGEST_JUMP = 0.5
"""Largest difference of position and integrated velocity within a second, m."""
EARTH_RADIUS = 6378137.0
"""Radius of the sphere of the projection, m."""

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
"""Largest magnitudes of the values up to `wz`, beyond which a packet is damaged; the others are not
used."""


# --- the drives


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The drives of a split, or their pieces if these are separate files."""
    sources, drives = [], find_drives(root)
    for drive, paths in drives.items():
        belongs = split in ("all", split_of(drive))
        if belongs and paths[0].is_dir():
            files = file_in(paths[0], "timestamps.txt"), paths[0] / "data"
            sources.append(RecordingSource(drive, partial(read_packets, paths[0]), files))
        elif belongs:
            sources += [
                RecordingSource(_piece_name(path), partial(read_piece, path), (path,))
                for path in paths
            ]
    if drives and not sources:
        problem = f"none of its drives falls into split '{split}'"
        raise InputError(root, problem, "take another split or more drives")
    return sources


def split_of(drive: str) -> str:
    """The split of a drive, which depends only on its name."""
    share = draw_share(SEED, drive)
    return "train" if share < 0.7 else "val" if share < 0.8 else "test"


def find_drives(root: Path) -> dict[str, list[Path]]:
    """Drive -> its folder of packets, or else its npz files. Raises `InputError` if there is only
    the 10 Hz export."""
    drives, slow = defaultdict[str, list[Path]](list), set()
    for depth in ("", "*/", "*/*/", "*/*/*/"):
        for path in sorted(root.glob(f"{depth}oxts")):
            match = _DRIVE.search(path.parent.name)
            if match and path.is_dir() and path.parent.name.endswith("_sync"):
                slow.add(match[0])
            elif match and path.is_dir() and match[0] not in drives:
                drives[match[0]].append(path)
    packets = set(drives)
    for path in sorted(root.glob("*.npz")):
        if (match := _DRIVE.search(path.name)) and match[0] not in packets:
            drives[match[0]].append(path)
    if missing := sorted(slow - drives.keys()):
        remedy = "get the _extract archives, which carry the 100 Hz of the IMU"
        problem = f"{len(missing)} drives are there only as the 10 Hz export (_sync)"
        problem += f": {shorten(', '.join(missing))}"
        if not drives:
            raise InputError(root, problem, remedy)
        warnings.warn(f"{root}: {problem}; left out; {remedy}", stacklevel=3)
    return dict(sorted(drives.items()))


# --- one drive


def read_packets(oxts: Path) -> list[Sequence]:
    """The pieces of a drive from its folder `oxts`.

    Packets without a stamp are left out, rows are sorted, and the first of equal stamps is kept.
    World: east, north, up from the first packet (`project`). Raises `InputError` naming file and
    field.
    """
    times, drive = file_in(oxts, "timestamps.txt"), _drive_of(oxts.parent.name)
    rows, packets = _packets(oxts / "data")
    stamps = _stamps(times)
    if rows.max() >= len(stamps):
        raise damage_error(times, f"holds {len(stamps)} stamps, but there is a packet {rows.max()}")
    stamped = ~np.isnat(stamps[rows])
    if stamped.sum() < 2:
        raise damage_error(times, f"gives {stamped.sum()} packets a stamp")
    stamps, packets = stamps[rows][stamped], packets[stamped]
    start = stamps.min()
    time = (stamps - start).astype(np.int64) * 1e-9
    order, repairs = in_order(time, packets, times)
    time, packets = time[order], packets[order]
    _check_rate(time, times)

    def values(*names: str) -> Float[np.ndarray, "n w"]:
        return packets[:, [_VALUES.index(name) for name in names]]

    attitude = Rotation.from_euler("ZYX", values("yaw", "pitch", "roll"))
    position, velocity = project(*values("lat", "lon", "alt").T), values("ve", "vn", "vu")
    poses = Poses(time, attitude, position, velocity, source=str(oxts))
    gyro, accel = values("wx", "wy", "wz"), values("ax", "ay", "az")
    epoch = float(start.astype(np.int64) * 1e-9)
    sequences, short = [], 0
    for number, run in enumerate(stretches(np.diff(time) > LONGEST_GAP)):
        if time[run.stop - 1] - time[run.start] < SHORTEST_PIECE:
            short += 1
            continue
        name = f"{drive}_extract{number}"
        streams = Streams.of_imu(name, oxts, time[run], gyro[run], accel[run])
        streams = streams._replace(attributes=repairs, start=epoch, poses=poses.rows(run))
        sequences += _assemble_drive(streams, drive)
    if short:
        problem = f"{short} pieces between missing packets are shorter than {SHORTEST_PIECE:g} s"
        warnings.warn(f"{oxts}: {problem}; left out", stacklevel=2)
    return sequences


def read_piece(path: Path) -> list[Sequence]:
    """The sequence of one npz. Raises `InputError` naming file and field."""
    table = read_npz(path)
    (time, start, _), imu = table.clock("t", "s"), table.take("u", width=6)
    _check_rate(time, path)
    position, velocity, angles = (table.take(n, width=3) for n in ("p_gt", "v_gt", "ang_gt"))
    attitude = Rotation.from_euler("ZYX", angles[:, ::-1])
    poses = Poses(time, attitude, position, velocity, source=str(path))
    streams = Streams.of_imu(_piece_name(path), path, time, imu[:, :3], imu[:, 3:])
    return _assemble_drive(streams._replace(start=start, poses=poses), _drive_of(path.stem))


def _check_rate(time: Float[np.ndarray, " n"], path: Path) -> None:
    if (step := float(np.median(np.diff(time)))) > SLOWEST_STEP:
        problem = f"field 'time' runs at {1 / step:.3g} Hz, as the _sync export does"
        raise InputError(path, problem, "get the _extract archive")


def _assemble_drive(streams: Streams, drive: str) -> list[Sequence]:
    attributes = {
        "group": drive,
        "session": drive[:10],
        "placement": "car",
        "truth": "INS with RTK-GPS (OXTS RT3003)",
        "imu_compensated": "reference",
    }
    streams = streams._replace(attributes=attributes | streams.attributes)
    return assemble(streams, RATE, max_drift=LARGEST_JUMP)


def _piece_name(path: Path) -> str:
    return re.sub(r"^(train|val|test)__", "", path.stem)


def _drive_of(name: str) -> str:
    match = _DRIVE.search(name)
    return match[0] if match else name


def project(
    latitude: Float[np.ndarray, " n"],
    longitude: Float[np.ndarray, " n"],
    altitude: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """East, north, up (m) from the first point, for degrees and metres: Mercator's projection with
    the scale of the first latitude."""
    scale = np.cos(np.radians(latitude[0])) * EARTH_RADIUS
    east = scale * np.radians(longitude)
    north = scale * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    position = np.stack([east, north, altitude], axis=1)
    return position - position[0]


def _packets(folder: Path) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 30"]]:
    """Numbers of the packets, and their values."""
    # Names are plain text, not paths, because at 100 Hz there are tens of thousands of files.
    names = sorted(filter(_PACKET.fullmatch, os.listdir(folder))) if folder.is_dir() else []
    if len(names) < 2:
        raise InputError(folder, "holds no packets <row>.txt", f"expected layout: {DATASET.layout}")
    table = np.array([_packet(os.path.join(folder, name)) for name in names])
    absurd = ~(np.abs(table[:, : len(_MOST)]) <= _MOST)  # includes NaN
    if absurd.any():
        row, index = np.argwhere(absurd)[0]
        problem = f"field '{_VALUES[index]}' is {table[row, index]:g}"
        raise damage_error(folder / names[row], f"{problem}, expected within ±{_MOST[index]:g}")
    return np.array([int(name.removesuffix(".txt")) for name in names]), table


def _packet(path: str) -> list[float]:
    try:
        with open(path, "rb") as file:
            values = [float(value) for value in file.read().split()]
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise damage_error(
            path, f"holds a value that is not a number ({shorten(error, 200)})"
        ) from None
    if len(values) != len(_VALUES):
        raise damage_error(
            path, f"holds {len(values)} values, expected {len(_VALUES)}; it may be cut short"
        )
    return values


def _stamps(path: Path) -> np.ndarray:
    """datetime64[ns] of each line, NaT for an empty one (a packet without a stamp)."""
    lines = [line.strip() for line in text_of(path).rstrip().splitlines()]
    stamps = np.full(len(lines), np.datetime64("NaT"), dtype="datetime64[ns]")
    for row, line in enumerate(lines):
        try:
            if line and not _STAMP.fullmatch(line):  # NumPy would also accept "now" as a stamp
                raise ValueError
            stamps[row] = np.datetime64(line or "NaT", "ns")
        except ValueError:
            problem = f"line {row + 1} ('{shorten(line)}') is not a stamp"
            remedy = "stamps look like 2011-09-26 14:02:22.484109563"
            raise InputError(path, problem, remedy) from None
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
