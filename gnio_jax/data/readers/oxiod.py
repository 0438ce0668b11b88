"""OxIOD, the Oxford Inertial Odometry Dataset: phones carried through a Vicon room, and two floors
of an office with Tango (Chen et al., *OxIOD: The Dataset for Deep Inertial Odometry*, 2018).

Layout: `<scene>/<dataN | userN | device>/{raw,syn}/imuK.csv` beside `viK.csv`, `handK.csv` or
`tangoK.csv`, and lists in the single-user scenes. No file has a header. A walk that exists as `raw`
and as `syn` is one walk. `raw` is used, whose stamps are accurate to 3 ms (in `syn` both streams
were put on one 100 Hz grid by repeating rows). `syn` is used if `raw` is absent or refused.

The phone is not the body with Vicon's markers. `alignment.align` finds the mounting, the level and
the clocks from each walk. A fit that does not explain the motion, or whose values are impossible
for a phone on a marker body, is refused. In `large scale` the truth is that of a Tango tablet whose
attitude is unusable, and `alignment.align_positions` finds the phone's attitude.

`gyro` and `accel` are those of the phone, including their biases. The accelerometer's delay
relative to the gyro (6 to 22 ms on an iPhone 7 Plus, 44 to 52 ms on an iPhone 5, 2 to 3 ms on a
Nexus 5) is removed. The readings of the magnetometer are beside them, in the phone's axes.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment.body import (
    TooLittle,
    hat_functions,
    near_any,
    uniform_knots,
    with_tracker_poses,
    without_jumps,
)
from gnio_jax.data.alignment.positions import align_positions
from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource, Refusal
from gnio_jax.data.parsing.tables import Table, damage_error, read_text, shorten
from gnio_jax.data.sensors import MAGNETOMETER, SENSOR_KINDS, usual_size
from gnio_jax.errors import InputError
from gnio_jax.files import file_in
from gnio_jax.numerics import quaternions
from gnio_jax.types import STANDARD_G, Readings, Sequence

RATE = 100.0
"""Hz."""
SINGLE_USER = ("handheld", "pocket", "handbag", "trolley", "running", "slow walking")
UNSEEN = ("multi users", "multi devices")
LARGE_SCALE = "large scale"
LAYOUT = (
    "<scene>/<dataN|userN|device>/{raw,syn}/imuK.csv with viK.csv (or handK.csv, tangoK.csv); "
    "<scene>/{Train,Test}.txt"
)

# Held-out sessions are named, so that they are the same in a partial copy and in the whole set.
VALIDATION = frozenset({"trolley/data1", "handheld/data4"})
"""Sessions of the authors' training lists for validation (`val`)."""
SESSIONS_VAL = frozenset({"multi users/user4", "handheld/data4"})
SESSIONS_TEST = frozenset(
    {"multi users/user2", "multi devices/nexus 5", "trolley/data1", "handheld/data5"}
    | {"handbag/data2"}
)
"""Sessions for validation and testing in `sessions_*`; all others of the Vicon room are for
training."""
SPLITS = ("train", "val", "test", "seen", "unseen", "large_scale")
SPLITS += ("sessions_train", "sessions_val", "sessions_test")

SHORTEST = 10.0
"""Shortest recording that can be used, s."""
LAG_KNOTS = {"raw": 30.0, "syn": 5.0}
"""Time between the knots of the lag, s. Clocks of raw files have almost constant rates; in syn
files rows were lost and filled in, and the lag has steps of 10 to 20 ms."""
WIDEST = 200.0
"""Largest extent of the walks in a room, m."""
FASTEST_TURN, FASTEST, FASTEST_TANGO = np.radians(600.0), 10.0, 5.0
"""Largest rate and speed of a tracker, rad/s and m/s; beyond these it has jumped."""

# Limits of a fit of phone and tracker. In brackets: the largest value of the real pairs, raw and
# syn, that we had.
CLOSEST_RUNNER_UP = 0.5
"""Largest ratio of the unexplained share of the best fit to that of the best fit with another lag
(0.14); it is 1 if both are equally good."""
LONGEST_LAG = {"raw": 5.0, "syn": 1.0}
"""Largest lag, s. The clocks of raw files differ (0.29 here, up to 1.7 in others of the set), and
the limit is that of the search; the authors matched the rows of syn files (0.29)."""
LIMITS = {
    "mounting's uncertainty": (2.0, "°"),  # on a trolley (0.5)
    "lag's drift": (1.0, "s"),  # clocks drift by 1 ms in some seconds (0.26)
    "accel's delay": (0.15, "s"),  # phones filter the accelerometer over some samples (0.052)
    "lever arm": (0.3, "m"),  # the marker body is the phone with markers on it (0.12)
    "world's tilt": (5.0, "°"),  # the world of a calibrated tracker (0.8)
    "gyro's bias": (0.1, "rad/s"),  # an uncalibrated gyro of a phone (0.02)
    "accel's bias": (0.6, "m/s²"),  # 60 mG, a bad accelerometer (0.17)
}
MIN_CORRELATION = 0.5
"""Smallest correlation of the vertical accelerations of phone and Tango: it is 0.90 and more at the
right lag, and at most 0.20 at others."""

_VECTORS = [f"{name}_{axis}" for name in ("rotation_rate", "gravity", "user_acc") for axis in "xyz"]
_IPHONE = ["time", "roll", "pitch", "yaw", *_VECTORS, "magnet_x", "magnet_y", "magnet_z"]
_NEXUS = ["time", *(f"{name}_{axis}" for name in ("acc", "gyro", "magnet") for axis in "xyz")]
_NEXUS_EVENTS = ["time", "type", "x", "y", "z"]
_TRACKER = ["time", "frame", *(f"translation_{axis}" for axis in "xyz")]
_TRACKER += [f"rotation_{axis}" for axis in "xyzw"]
_TRUTHS = ("vi", "hand", "tango")


class WalkFiles(NamedTuple):
    """The files of one walk, which is one recording."""

    scene: str
    folder: str
    """dataN, userN or the device."""
    number: int
    files: dict[str, tuple[Path, Path]]
    """kind ("raw", "syn") -> (imu, truth)."""
    placement: str

    @property
    def session(self) -> str:
        """The session, which splits never divide."""
        return f"{self.scene}/{self.folder}"

    @property
    def name(self) -> str:
        """Unique within the dataset."""
        return f"{self.scene}_{self.folder}_{self.number}".replace(" ", "-")

    def attributes(self, kind: str) -> dict[str, str]:
        """Attributes of the walk that are known without reading it."""
        subject = "user1" if self.scene in SINGLE_USER else "unknown"
        return {
            "scene": self.scene,
            "session": self.session,
            "group": self.session,
            "kind": kind,
            "subject": self.folder if self.scene == "multi users" else subject,
            "device": self.folder if self.scene == "multi devices" else "iPhone 7 Plus",
            "placement": self.placement,
        }


# --- walks


def find_walks(root: Path) -> list[WalkFiles]:
    """Find every walk below `root`, whose scenes may be some folders deeper."""
    return [
        walk
        for scene in (*SINGLE_USER, *UNSEEN, LARGE_SCALE)
        for scene_folder in _scene_folders(root, scene)
        for folder in sorted(path for path in scene_folder.iterdir() if path.is_dir())
        for walk in _walks_of(scene, folder)
    ]


def _scene_folders(root: Path, scene: str) -> list[Path]:
    """The folder of a scene, or none."""
    places = (path for depth in ("", "*/", "*/*/") for path in sorted(root.glob(f"{depth}{scene}")))
    return [path for path in places if path.is_dir()][:1]


def _walks_of(scene: str, folder: Path) -> list[WalkFiles]:
    files: dict[int, dict[str, tuple[Path, Path]]] = {}
    # `raw` of the large scale is another format, without Tango's pairs.
    for kind in ("syn",) if scene == LARGE_SCALE else ("raw", "syn"):
        for imu in sorted((folder / kind).glob("*")):
            if match := re.fullmatch(r"imu(\d+)\.csv", imu.name, re.IGNORECASE):
                truths = (file_in(folder / kind, f"{name}{match[1]}.csv") for name in _TRUTHS)
                if truth := next((path for path in truths if path.is_file()), None):
                    files.setdefault(int(match[1]), {})[kind] = (imu, truth)
                else:
                    problem = "has no vi, hand or tango file beside it; left out"
                    warnings.warn(f"{imu}: {problem}", stacklevel=2)
    placement = _placements(scene, folder)
    return [
        WalkFiles(scene, folder.name, n, kinds, placement(n)) for n, kinds in sorted(files.items())
    ]


def _placements(scene: str, folder: Path) -> Callable[[int], str]:
    """A function from the number of a walk to the placement of the phone: by the scene, or for
    other users by a note with lines like "3-5: pocket", if there is one."""
    if scene not in UNSEEN:
        by_hand = ("running", "slow walking", LARGE_SCALE)
        return lambda number: "handheld" if scene in by_hand else scene
    notes = [path for path in folder.glob("*/*.txt") if path.stem.lower() == "readme"]
    text = notes[0].read_text(encoding="utf-8", errors="replace") if notes else ""
    spans = re.findall(r"(\d+)\s*-\s*(\d+)\s*:\s*(\w+)", text)
    return lambda number: next(
        (name for first, last, name in spans if int(first) <= number <= int(last)), "unknown"
    )


# --- splits


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The walks of `split` below `root`.

    `train`, `test` (also called `seen`)
        the authors' lists of the single-user scenes; the sessions `VALIDATION` are taken from
        `train` for `val`.
    `unseen`
        other users and other devices, which are in no list and are not used for training.
    `large_scale`
        the floors with Tango, in no list either.
    `sessions_train`, `sessions_val`, `sessions_test`
        every walk of the Vicon room, including other users and devices, by whole sessions, because
        the lists of a partial copy alone have little training data. A network trained on these has
        seen users and devices of `unseen`: evaluate it only on `sessions_test`.
    """
    walks = find_walks(root)
    chosen = select(walks, split, root) if walks else []
    if walks and not chosen:
        remedy = "see the warnings above, or choose another split"
        raise InputError(root, f"no recording of split '{split}' is present", remedy)
    return [recording_of(walk) for walk in chosen]


def recording_of(walk: WalkFiles) -> RecordingSource:
    """The recording of a walk: `raw` first, and `syn` if `raw` is refused."""
    source = None
    for kind in ("syn", "raw"):
        if kind in walk.files:
            read, files = partial(build, walk, kind), walk.files[kind]
            source = RecordingSource(walk.name, read, files, slow=True, form=kind, fallback=source)
    assert source is not None
    return source


def select(walks: list[WalkFiles], split: str, root: Path) -> list[WalkFiles]:
    """The walks of `split`. Raises `InputError` if a list is missing or empty."""
    if split == "unseen":
        return [walk for walk in walks if walk.scene in UNSEEN]
    if split == "large_scale":
        return [walk for walk in walks if walk.scene == LARGE_SCALE]
    if split.startswith("sessions_"):
        held = {"sessions_val": SESSIONS_VAL, "sessions_test": SESSIONS_TEST}
        split_of = {session: name for name, sessions in held.items() for session in sessions}
        room = [walk for walk in walks if walk.scene != LARGE_SCALE]
        return [walk for walk in room if split_of.get(walk.session, "sessions_train") == split]
    if split in ("test", "seen"):
        return _read_lists(walks, "Test.txt", root)
    training = _read_lists(walks, "Train.txt", root)
    return [walk for walk in training if (walk.session in VALIDATION) == (split == "val")]


def _read_lists(walks: list[WalkFiles], name: str, root: Path) -> list[WalkFiles]:
    """The walks that the lists `name` of the single-user scenes name, by lines `dataN` (all its
    walks) and `dataN/imuK.csv`. The last line may be without a newline."""
    folders = {scene: folder for scene in SINGLE_USER for folder in _scene_folders(root, scene)}
    lists = {scene: file_in(folder, name) for scene, folder in folders.items()}
    lists = {scene: path for scene, path in lists.items() if path.is_file()}
    if not lists:
        raise InputError(root, f"no scene has its list {name}", f"expected layout: {LAYOUT}")
    chosen: list[WalkFiles] = []
    absent = 0
    for scene, path in lists.items():
        text = path.read_text(encoding="utf-8", errors="replace")
        entries = [line.strip().replace("\\", "/") for line in text.splitlines() if line.strip()]
        if not entries:
            raise damage_error(path, "the list is empty")
        for entry in entries:
            match = re.fullmatch(r"(data\d+)(?:/(?:imu)?(\d+)(?:\.csv)?)?", entry)
            if not match:
                problem = f"entry '{shorten(entry)}' is neither dataN nor dataN/imuK.csv"
                raise damage_error(path, problem)
            session = f"{scene}/{match[1]}"
            number = None if match[2] is None else int(match[2])
            matches = [
                walk for walk in walks if walk.session == session and number in (None, walk.number)
            ]
            absent += not matches
            chosen += [walk for walk in matches if walk not in chosen]
    if absent:
        problem = f"{absent} entries of the lists {name} are not in this copy"
        warnings.warn(f"{root}: {problem}", stacklevel=2)
    return chosen


# --- one walk


def build(walk: WalkFiles, kind: str) -> list[Sequence]:
    """Read a walk at 100 Hz. Raises `Refusal` if its files are damaged, or if they or the fit of
    phone and tracker cannot be used: another form of the walk may be usable."""
    imu_path, truth_path = walk.files[kind]
    try:
        # The syn files of the large scale still have the phone's stamps.
        phone = read_phone(imu_path, "raw" if walk.scene == LARGE_SCALE else kind)
        on_tango = truth_path.name.lower().startswith("tango")
        attributes = walk.attributes(kind) | {"truth": "tango" if on_tango else "vicon"}
        phone = phone._replace(name=walk.name, attributes=attributes | phone.attributes)
        if on_tango:
            phone = _with_tango_positions(phone, truth_path, kind)
        else:
            limits = {"lag": (LONGEST_LAG[kind], "s")} | LIMITS
            track = read_vicon(truth_path, kind, phone.start)
            phone = with_tracker_poses(
                phone, track, limits, LAG_KNOTS[kind], closest_runner_up=CLOSEST_RUNNER_UP
            )
        (sequence,) = assemble(phone, RATE)
    except TooLittle as error:
        raise Refusal(truth_path, f"cannot be aligned with the phone ({error})") from None
    except InputError as error:
        raise Refusal(*error.parts) from None
    if (seconds := sequence.valid.sum() / RATE) < SHORTEST:
        raise Refusal(truth_path, f"only {seconds:.1f} s have a usable reference")
    return [sequence]


def _with_tango_positions(phone: Streams, path: Path, kind: str) -> Streams:
    """The phone with Tango's positions as its own."""
    if phone.device is None:
        raise Refusal(path, "belongs to a phone that recorded no attitude")
    fit = align_positions(phone, read_tango(path))
    lag, problem = float(np.abs(fit.lag).max()), ""
    if not fit.correlation >= MIN_CORRELATION:
        problem = f"vertical accelerations correlate by {fit.correlation:.2f}"
    elif not lag <= LONGEST_LAG[kind]:
        problem = f"by {lag:.2f} s, at most {LONGEST_LAG[kind]:g} s is plausible"
    if problem:
        raise Refusal(path, f"Tango is out of step with the phone ({problem})")
    figures = {
        "lag": float(np.mean(fit.lag)),
        "lag_drift": float(np.ptp(fit.lag)),
        "yaw_drift_degrees": float(np.degrees(fit.yaw_drift)),
        "vertical_correlation": fit.correlation,
        "runner_up": fit.runner_up,
    }
    return phone._replace(poses=fit.poses, attributes=phone.attributes | figures)


# --- the phone's text


def read_phone(path: Path, kind: str) -> Streams:
    """The streams of a phone's file. iPhone: 16 columns, accelerations in G with iOS's sign, so
    that specific force = −(gravity + user_acc)·9.80665; CoreMotion has subtracted its estimate of
    the bias from the rotation rates. Nexus: rows of one sensor each (`raw`), or 10 columns (`syn`),
    in m/s².

    The stamps of kind "raw" are unix time; those of kind "syn" are destroyed, and rows are 1/100 s
    apart. Raises `InputError`.
    """
    table = _read_table(path, _IPHONE, _NEXUS, _NEXUS_EVENTS)
    if "type" in table.columns:
        return _nexus_events(table)
    if "gravity_x" not in table.columns:
        values = table.take(*_NEXUS[:7])[:, 1:]
        awake = values[:, 3:].any(axis=1)  # the gyro starts some rows after the accelerometer
        rows = _fresh_samples(np.flatnonzero(awake) / RATE, values[awake], path)
        streams = Streams.of_imu("", path, rows.time, rows.values[:, 3:], rows.values[:, :3])
        field = table.take(*_NEXUS[7:], gaps=True)[awake][_is_fresh(values[awake])]
        return streams._replace(
            attributes={"imu_compensated": "no"}, readings=field_readings(rows.time, field)
        )
    values, field = table.take(*_IPHONE[:13]), table.take(*_IPHONE[13:], gaps=True)
    stamps, start = np.arange(len(values)) / RATE, 0.0
    if kind == "raw":  # the stamps are right, but some rows are in the wrong order
        order = np.argsort(values[:, 0], kind="stable")
        values, field = values[order], field[order]
        start = float(values[0, 0])
        stamps = values[:, 0] - start
    rows = _fresh_samples(stamps, values[:, 1:], path)
    angles, rate, gravity, user_acc = np.split(rows.values, 4, axis=1)
    length = float(np.median(np.linalg.norm(gravity, axis=1)))
    if not 0.9 < length < 1.1:
        problem = f"field 'gravity' has length {length:.3g}, expected 1 G"
        raise InputError(path, problem, "check the column order")
    attitude = Rotation.from_euler("ZXY", angles[:, [2, 1, 0]])  # R_z(yaw) R_x(pitch) R_y(roll)
    streams = Streams.of_imu("", path, rows.time, rate, -(gravity + user_acc) * STANDARD_G)
    return streams._replace(
        attributes={"imu_compensated": "CoreMotion's gyro bias"},
        start=start,
        device=rows._replace(values=quaternions(attitude)),
        readings=field_readings(rows.time, field[_is_fresh(values[:, 1:])]),
    )


def field_readings(
    time: Float[np.ndarray, "n"], field: Float[np.ndarray, "n 3"]
) -> dict[str, Readings]:
    """The field (µT) of each row as readings of the magnetometer, without rows that repeat the one
    before, zeros (CoreMotion's are those before its calibration) and gaps.

    There are none if the strength is not the earth's: on a trolley CoreMotion has taken the
    vertical part of the earth's field for the phone's own.
    """
    present = np.isfinite(field).all(axis=1) & (field != 0).any(axis=1) & _is_fresh(field)
    present &= np.concatenate([[True], np.diff(time) > 0])
    least, most = SENSOR_KINDS[MAGNETOMETER].usual
    if present.sum() < 2 or not least <= usual_size(MAGNETOMETER, field[present]) <= most:
        return {}
    readings = Readings(time[present], field[present], np.full_like(field[present], np.nan))
    return {MAGNETOMETER: readings}


def _nexus_events(table: Table) -> Streams:
    """The streams from rows `t_ms, type, x, y, z` of one sensor each: 1 accelerometer, 2
    magnetometer, 4 gyro."""
    stamps, kind, *_ = table.take("time", "type").T
    values, start = table.take("x", "y", "z"), float(stamps.min()) / 1e3
    sensors = []
    for number in (4, 1):
        rows = np.flatnonzero(kind == number)
        if len(rows) < SHORTEST * RATE:
            problem = f"holds {len(rows)} rows of type {number}, less than {SHORTEST:g} s"
            raise damage_error(table.path, problem)
        rows = rows[np.argsort(stamps[rows], kind="stable")]
        time = restore_clock(stamps[rows] / 1e3 - start, table.path)
        sensors.append(Samples(time, values[rows], str(table.path)))
    gyro, accel = sensors
    rows = np.flatnonzero(kind == 2)
    rows = rows[np.argsort(stamps[rows], kind="stable")]
    readings = field_readings(stamps[rows] / 1e3 - start, values[rows])
    attributes: dict[str, str | float] = {"imu_compensated": "no"}
    return Streams("", str(table.path), gyro, accel, attributes, start, readings=readings)


def _read_table(path: Path, *layouts: list[str]) -> Table:
    """A file without header as a table; the names of the columns depend on their number."""
    named = {len(names): names for names in layouts}
    table = read_text(path, header=False, widths=tuple(named))
    if (rows := len(table.columns[0])) < SHORTEST * RATE:
        raise damage_error(path, f"holds {rows} rows, less than {SHORTEST:g} s")
    return table.rename(named[table.width()])


def _fresh_samples(stamps: np.ndarray, values: np.ndarray, path: Path) -> Samples:
    """The rows that do not repeat the row before, on the phone's own clock. Rows that repeat it are
    filler, with any stamp. A repeated stamp with other values comes from a rounded clock."""
    fresh = _is_fresh(values)
    return Samples(restore_clock(stamps[fresh], path), values[fresh], str(path))


def _is_fresh(values: Float[np.ndarray, "n w"]) -> Bool[np.ndarray, " n"]:
    return np.concatenate([[True], (np.diff(values, axis=0) != 0).any(axis=1)])


def restore_clock(stamps: Float[np.ndarray, " n"], path: Path) -> Float[np.ndarray, " n"]:
    """Times (s) of uniformly taken samples from stamps rounded to 10 ms.

    The times are piecewise linear in the number of the sample, counting lost ones, with a knot per
    30 s. Raises `InputError` if the stamps cannot come from a uniform clock.
    """
    remedy, problem = "use the syn files", ""
    if len(stamps) < 2:
        raise InputError(path, "holds one row over and over", remedy)
    steps = np.diff(stamps)
    typical, average = float(np.median(steps)), (stamps[-1] - stamps[0]) / len(steps)
    if not 0.002 < typical < 0.05 or not 0.002 < average:
        problem = f"is ruined (median step {typical:.3g} s, {average:.3g} s on average)"
    elif steps.max() > 1.0:
        problem = f"has a gap of {steps.max():.2f} s"
    if problem:
        raise InputError(path, f"field 'time' {problem}", remedy)
    period = float(np.mean(steps[steps < 2.5 * typical]))
    # Lost rows leave a longer step, whose length gives their number.
    lost = np.where(steps > 2.6 * period, np.round(steps / period) - 1.0, 0.0)
    number = np.arange(len(stamps)) + np.concatenate([[0.0], np.cumsum(lost)])
    hats = hat_functions(number, uniform_knots(number, 30.0 / period))
    weight = np.ones(len(stamps))
    for _ in range(3):  # a few late stamps must not bend the line
        at_knots = np.linalg.lstsq(hats * weight[:, None], stamps * weight, rcond=None)[0]
        error = stamps - hats @ at_knots
        weight = 1.0 / np.sqrt(1.0 + (error / 0.01) ** 2)
    if error.std() > 0.02 or np.any(np.diff(at_knots) <= 0):
        problem = f"field 'time' is not that of a uniform clock (off by {error.std():.3f} s rms)"
        raise InputError(path, problem, remedy)
    return hats @ at_knots


# --- the trackers' text


def read_vicon(path: Path, kind: str, start: float) -> Poses:
    """Poses of the marker body, quaternions xyzw, without held rows, flips and jumps.

    Time is in s since `start` (unix ns in `raw`), or since the first row, 1/100 s apart (`syn`,
    where it is destroyed). Raises `InputError`.
    """
    table = _read_table(path, _TRACKER)
    values = table.take(*_TRACKER[2:], gaps=True)
    time = np.arange(len(values)) / RATE
    if kind == "raw":
        time = table.take("time") / 1e9 - start
        if not abs(float(np.median(time))) < 3600.0 or np.ptp(time) < SHORTEST:
            problem = "field 'time' is damaged or more than an hour away from the phone's"
            raise InputError(path, problem, "use the syn files")
        values[np.abs(time) > 3600.0] = np.nan  # poses of another time
        order = np.argsort(time, kind="stable")
        time, values = time[order], values[order]
    present = np.isfinite(values).all(axis=1) & _is_fresh(values)
    present &= np.abs(np.linalg.norm(values[:, 3:], axis=1) - 1.0) < 0.01
    present &= np.concatenate([[True], np.diff(time) > 0])
    rows = _usable_rows(present, 0.5, "rows hold a pose", path)
    position, attitude = values[rows, :3], Rotation.from_quat(values[rows, 3:])
    if np.ptp(position, axis=0).max() > WIDEST:
        problem = f"field 'translation' spans more than {WIDEST:g} m, it looks like mm"
        raise InputError(path, problem, "convert it to m")
    poses = Poses(time[rows], attitude, position, noisy=True, source=str(path))
    plausible = without_jumps(poses, FASTEST_TURN, FASTEST)
    _usable_rows(np.isin(time, plausible.time), 0.3, "poses are plausible", path)
    return plausible


def read_tango(path: Path) -> Samples:
    """Tango's positions (m) without held rows and jumps. Rows are 1/100 s apart, because the stamps
    are rounded to a second in some files. Raises `InputError`."""
    values = _read_table(path, _TRACKER).take(*_TRACKER[2:5], gaps=True)
    usable = _is_fresh(values) & np.isfinite(values).all(axis=1)
    rows = _usable_rows(usable, 0.5, "rows hold a position", path)
    steps = np.linalg.norm(np.diff(values[rows], axis=0), axis=1)
    jumps = np.flatnonzero(steps > FASTEST_TANGO * np.diff(rows) / RATE)
    # The rows on both sides of a jump, and 0.1 s around them.
    rows = rows[~near_any(rows, rows[jumps], rows[jumps + 1], 10.0)]
    return Samples(rows / RATE, values[rows], str(path))


def _usable_rows(usable: Bool[np.ndarray, " n"], share: float, what: str, path: Path) -> np.ndarray:
    """The usable rows; raises `InputError` if they are fewer than this share."""
    rows = np.flatnonzero(usable)
    if len(rows) < share * len(usable):
        raise damage_error(path, f"only {len(rows)} of {len(usable)} {what}")
    return rows


DATASET = Dataset(
    name="oxiod",
    recordings=recordings,
    splits=SPLITS,
    rate=RATE,
    source="http://deepio.cs.ox.ac.uk",
    layout=LAYOUT,
    licence="for research, as stated by the authors (deepio.cs.ox.ac.uk)",
)
