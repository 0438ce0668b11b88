"""Tyrex: two people who carry three phones in eight ways through a room with Qualisys cameras
(Michel, Genevès, Fourati, Layaïda, *Attitude estimation for indoor navigation and augmented reality
with smartphones*, Pervasive and Mobile Computing 2018).

Layout: `datasets/{android,ios}/<Person>_<Device>_<Dist|NoDist>_<Way>/` with `accelerometer.txt`,
`gyroscope.txt`, `timeAlignment.txt` and, for an iPhone, `description.txt`; the tracker's poses are
`datasets/qualisys/<same name>.mat` (MATLAB 5). `Dist` walks pass magnets, which do not affect an
IMU.

- Nexus 5: stamps in s of the record, both sensors at 200 Hz, the accelerometer in m/s² with
  Android's sign; the gyro's file has the system's estimate of the bias beside the raw rate. It is
  subtracted, as Android does for programs that read the gyro.
- iPhone 4S and 5: stamps in s since the phone was booted, the record begins at `BootTime`; each
  sensor at a rate of its own (90 to 107 Hz); the accelerometer in G with Apple's sign.
- `magnetometer-calibrated.txt`, if it is there, has the field in µT, the phone's axes, without what
  the system believes to be the phone's own, at 50 Hz (Nexus 5) or at the gyro's rate.
- Qualisys: 60 Hz, mm, rotations body → world column by column, NaN where the body was lost. Its
  time is the record's plus the number in `timeAlignment.txt`, to 0.03 s.

**The iPhones' gyros are raw**: no bias is subtracted, and it is 0.1 rad/s on an iPhone 5. In runs
two of the accelerometers reach 2 G and clip (`accel_clipped`).

The tracked body is a handle on the phone, whose axes are the phone's to a few degrees and whose
origin is some cm away. `alignment.align` finds the mounting, the level and the clocks from each
walk, as for OxIOD. Poses at 60 Hz are too infrequent to be differenced in a swinging hand, so the
gyro carries the attitude between them. A fit that does not explain the motion is refused.

Sequences have 100 Hz.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment.body import with_tracker_poses, without_jumps
from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.parsing.tables import Table, damaged, parsed_as, read_text, shortened, text_of
from gnio_jax.data.sensors import MAGNETOMETER
from gnio_jax.data.splits import find_folders
from gnio_jax.errors import InputError
from gnio_jax.files import file_in
from gnio_jax.numerics import finite_rows
from gnio_jax.types import STANDARD_G, Readings, Sequence

RATE = 100.0
"""Hz."""
DEVICES = {"Nexus5": "Nexus 5", "iPhone4S": "iPhone 4S", "iPhone5": "iPhone 5"}
"""Names in folders → names of phones."""
TRAINS = "Thibaud"
"""The person whose walks are `train`."""
WAYS = {
    "AR": "held up",
    "Texting": "texting",
    "Phoning": "at the ear",
    "FrontPocket": "front pocket",
    "BackPocket": "back pocket",
    "Swinging": "swinging hand",
    "RunningHand": "running, in the hand",
    "RunningPocket": "running, in the pocket",
}
"""Names in folders → ways of carrying in the attribute `placement`."""

LONGEST_RECORD, LATEST_START = 600.0, 60.0
"""Longest record and latest start of a sensor, s: a record lasts two minutes, and the sensors start
within a second of it."""
CLIPS = (1.95, 2.15)
"""Range in G in which the accelerometers of Nexus 5 and iPhone 4S clip; that of the iPhone 5
reaches 6 G."""
WIDEST = (0.2, 100.0)
"""Smallest and largest extent of the walks in a room, m; smaller ones are not in mm."""
FASTEST_TURN, FASTEST = np.radians(2000.0), 10.0
"""Largest rate (the range of the gyros) and speed of a tracker, rad/s and m/s; beyond these it has
jumped."""
LAG_SEARCH = 0.3
"""Largest error of `timeAlignment.txt`, s (0.04)."""
LAG_KNOTS = 60.0
"""Time between the knots of the lag, s: the clocks have almost constant rates."""

# Limits of a fit of phone and tracker. In brackets: the largest value of the 84 walks.
LIMITS = {
    "lever arm": (0.3, "m"),  # the handle is on the phone (0.07)
    "world's tilt": (5.0, "°"),  # the world of a calibrated tracker (0.3)
    "mounting's uncertainty": (2.0, "°"),  # a phone that hardly moves does not determine it
    "mounting's turn": (20.0, "°"),  # its axes are the phone's (2)
    "gyro's bias": (0.2, "rad/s"),  # raw gyros (0.104)
    "accel's delay": (0.15, "s"),  # phones filter the accelerometer (0.046)
}

_MAGNETOMETER = "magnetometer-calibrated.txt"
_TEXT_FILES = ("accelerometer.txt", "gyroscope.txt", "description.txt", "timeAlignment.txt")
_TEXT_FILES += (_MAGNETOMETER,)
_NAME = re.compile(rf"(\w+?)_({'|'.join(DEVICES)})_(Dist|NoDist)_(\w+)")


class WalkFolder(NamedTuple):
    """The folder of the phone of one walk, and the parts of its name."""

    folder: Path
    person: str
    device: str
    magnets: bool
    way: str

    @property
    def track(self) -> Path:
        """The tracker's file."""
        return file_in(self.folder.parents[1] / "qualisys", f"{self.folder.name}.mat")


def walk_of(folder: Path) -> WalkFolder | None:
    """The walk of a folder, by its name; None for another folder."""
    match = _NAME.fullmatch(folder.name)
    if match is None:
        return None
    person, device, magnets, way = match.groups()
    return WalkFolder(folder, person, DEVICES[device], magnets == "Dist", way)


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The recordings of a split that are present, anywhere below the root.

    `train` has the walks of one person. `val` has those of the other person with magnets beside the
    path, and `test` those without (including running). `all` is every walk, and `all-0of2`,
    `all+0of2` divide it by person.
    """
    folders = find_folders(root, lambda folder: walk_of(folder) is not None)
    walks = [walk for folder in folders.values() if (walk := walk_of(folder)) is not None]
    chosen = sorted(
        (walk for walk in walks if split in ("all", _split(walk))),
        key=lambda walk: walk.folder.name,
    )
    if walks and not chosen:
        people = f"'{TRAINS}' trains, and the other people validate and test"
        raise InputError(root, f"holds no walk of split '{split}'", f"complete the data: {people}")
    return [_recording(walk) for walk in chosen]


def _split(walk: WalkFolder) -> str:
    if walk.person == TRAINS:
        return "train"
    return "val" if walk.magnets else "test"


def _recording(walk: WalkFolder) -> RecordingSource:
    files = *(file_in(walk.folder, name) for name in _TEXT_FILES), walk.track
    return RecordingSource(walk.folder.name, partial(read, walk.folder), files, slow=True)


# --- one walk


def read(folder: Path) -> list[Sequence]:
    """Read a walk from its phone's folder. Raises `InputError` naming file and field, and `Refusal`
    if phone and tracker do not have the same motion."""
    walk = walk_of(folder)
    if walk is None:
        problem = "is not named <Person>_<Device>_<Dist|NoDist>_<Way>"
        raise InputError(folder, problem, "give the folder its published name")
    phone, track = read_phone(walk), read_track(walk.track, _offset(folder))
    # One of these files is damaged, so they do not fit together.
    files = f"{walk.track} and accelerometer.txt, gyroscope.txt, timeAlignment.txt of the phone"
    attributes = {
        "group": walk.person,
        "subject": walk.person,
        "device": walk.device,
        "placement": WAYS.get(walk.way, walk.way),
        "gait": "running" if walk.way.startswith("Running") else "walking",
        "truth": "Qualisys",
        "imu_compensated": "no" if walk.device.startswith("iPhone") else "Android's gyro bias",
        "accel_clipped": clipped_share(phone.accel.values),
    }
    phone, track = phone._replace(attributes=attributes), track._replace(source=files)
    return assemble(
        with_tracker_poses(phone, track, LIMITS, LAG_KNOTS, LAG_SEARCH), RATE, divide=True
    )


def clipped_share(accel: Float[np.ndarray, "n 3"]) -> float:
    """Share of the samples (m/s²) at the ends of an accelerometer's range; 0 if it reaches beyond
    `CLIPS`."""
    magnitude = np.abs(accel).max(axis=1) / STANDARD_G
    return float((magnitude > CLIPS[0]).mean()) if magnitude.max() < CLIPS[1] else 0.0


# --- the phone's text


def read_phone(walk: WalkFolder) -> Streams:
    """Read both sensors: SI units, the phone's axes, time in s of the record. Raises
    `InputError`."""
    apple = walk.device.startswith("iPhone")
    start = _boot_time(file_in(walk.folder, "description.txt")) if apple else 0.0
    sensors = []
    for name, widths in (("gyroscope.txt", (4,) if apple else (7,)), ("accelerometer.txt", (4,))):
        path = file_in(walk.folder, name)
        table = read_text(path, separator=" ", header=False, widths=widths)
        (time, _, rows), values = table.clock(0, "s", start, "dropped"), table.take(1, 2, 3)
        if 7 in widths:
            values = values - table.take(4, 5, 6)
        remedy = "cut the rows of other times, or check that all files are of one phone"
        if not abs(time[0]) <= LATEST_START:
            problem = f"field 'time' (column 0) begins {time[0]:.3g} s after the record"
            raise InputError(path, problem, remedy)
        if not time[-1] <= LONGEST_RECORD:
            problem = f"field 'time' (column 0) ends {time[-1]:.3g} s after the record's start"
            raise InputError(path, problem, remedy)
        sensors.append(Samples(time, values[rows], str(path)))
    gyro, accel = sensors
    if apple:
        accel = accel._replace(values=-STANDARD_G * accel.values)
    path, readings = file_in(walk.folder, _MAGNETOMETER), dict[str, Readings]()
    if path.is_file():
        table = read_text(path, separator=" ", header=False, widths=(5,) if apple else (4,))
        (time, _, rows), field = table.clock(0, "s", start, "dropped"), table.take(1, 2, 3)
        # An iPhone repeats the last field until there is a new one.
        changed = np.concatenate([[True], (np.diff(field[rows], axis=0) != 0).any(axis=1)])
        time, field = time[changed], field[rows][changed]
        readings[MAGNETOMETER] = Readings(time, field, np.full_like(field, np.nan))
    return Streams(walk.folder.name, str(walk.folder), gyro, accel, readings=readings)


def _boot_time(path: Path) -> float:
    """Time of the beginning of an iPhone's record, s since boot."""
    match = re.search(r"BootTime\s*=\s*(\d{1,12}(?:\.\d{1,9})?)", text_of(path))
    if match is None:
        raise damaged(path, "field 'BootTime' is missing")
    return float(match[1])


def _offset(folder: Path) -> float:
    """The tracker's time minus the record's, s."""
    path = file_in(folder, "timeAlignment.txt")
    text = text_of(path).strip()
    try:
        offset = float(text)
    except ValueError:
        offset = np.nan
    if not abs(offset) <= LONGEST_RECORD:
        raise damaged(path, f"holds '{shortened(text)}', expected one number of seconds")
    return offset


# --- the tracker's MATLAB file


def read_track(path: Path, offset: float) -> Poses:
    """Poses of the handle (m, body → world) where it was seen, in s of the record; `offset` is the
    tracker's time minus the record's, s. Raises `InputError`."""
    from scipy.io import loadmat  # it takes a quarter of a second to import

    if not path.is_file():
        raise InputError(path, "no such file", f"expected layout: {DATASET.layout}")
    with parsed_as(path, "MATLAB 5"):
        content = loadmat(path, simplify_cells=True)
    structs = [value for name, value in content.items() if not name.startswith("__")]
    struct = structs[0] if len(structs) == 1 and isinstance(structs[0], dict) else {}
    bodies, rate = struct.get("RigidBodies"), struct.get("FrameRate")
    widths = {"Positions": 3, "Rotations": 9}
    if not isinstance(bodies, dict) or not widths.keys() <= bodies.keys():
        problem = "field 'RigidBodies' with Positions and Rotations is missing"
        raise InputError(path, problem, "export it from QTM with its one rigid body (6DOF)")
    if not isinstance(rate, int | float) or not 1.0 <= rate <= 1000.0:
        raise damaged(path, f"field 'FrameRate' is {shortened(rate)} Hz, expected 60")
    table = Table(path, {name: np.asarray(bodies[name]).T for name in widths}, "field")
    position, matrices = (table.take(name, width=w, gaps=True) for name, w in widths.items())
    frames = np.flatnonzero(finite_rows(position) & finite_rows(matrices))
    if len(frames) < 0.5 * len(position):
        raise damaged(path, f"only {len(frames)} of {len(position)} frames hold a pose")
    position = position[frames] * 1e-3
    turns = matrices[frames].reshape(-1, 3, 3).transpose(0, 2, 1)  # column by column
    deviation = np.abs(turns.transpose(0, 2, 1) @ turns - np.eye(3)).max(axis=(1, 2))
    bad = ~(deviation <= 1e-3) | ~(np.linalg.det(turns) > 0)
    if bad.any():
        frame = f"first in frame {frames[np.argmax(bad)] + 1}"
        raise damaged(path, f"field 'Rotations' is no rotation in {bad.sum()} frames, {frame}")
    poses = Poses(frames / rate - offset, Rotation.from_matrix(turns), position, noisy=True)
    plausible = without_jumps(poses, FASTEST_TURN, FASTEST)._replace(source=str(path))
    if len(plausible.time) < 0.5 * len(frames):
        raise damaged(path, f"only {len(plausible.time)} of {len(frames)} poses are plausible")
    least, most = WIDEST
    if not least <= (span := float(np.ptp(plausible.position, axis=0).max())) <= most:
        problem = f"field 'Positions' spans {span:.3g} m as mm, expected {least:g} to {most:g} m"
        raise InputError(path, problem, "give it in mm")
    return plausible


DATASET = Dataset(
    name="tyrex",
    recordings=recordings,
    splits=("train", "val", "test", "all"),
    rate=RATE,
    source="http://tyrex.inria.fr/mobile/benchmarks-attitude/",
    layout="<root>/**/{android,ios}/<Person>_<Device>_<Dist|NoDist>_<Way>/"
    "{accelerometer,gyroscope,timeAlignment}.txt (iPhones: description.txt) and "
    "<root>/**/qualisys/<same name>.mat",
    licence="CeCILL 2.1",
)
