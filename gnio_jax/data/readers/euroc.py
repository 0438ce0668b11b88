"""The ASL layout of EuRoC (Burri et al., IJRR 2016; a drone) and TUM-VI (Schubert et al., IROS
2018; hand-held): two datasets, one reader.

Layout: <root>/.../<sequence>/mav0/imu0/data.csv (stamp ns, gyro rad/s, accel m/s²; 200 Hz) and
beside `imu0` a reference, the first of
- `state_groundtruth_estimate0/data.csv`: stamp ns, position m, quaternion wxyz, velocity m/s,
biases. A smoothed estimate of the IMU body
  from tracker and IMU, at 200 Hz (some copies: 20 Hz). It is interpolated to the IMU's stamps:
  positions and velocities by cubic, attitudes by rotation splines.
- `mocap0/data.csv`: stamp ns, position m, quaternion wxyz: what the tracker saw at 120 Hz, of the
IMU too, with noise (0.1°, 0.4 mm), flips
  near its gaps, and gaps of seconds, or of minutes where TUM-VI leaves the room. Orientation is the
  integrated gyro times a robustly smoothed correction towards the tracker, position passes a
  smoother (half response at 12 Hz) and velocity is its derivative; see `gnio_jax.data.alignment`.
Either counts as valid only within gaps of `LONGEST_BRIDGE` and away from jumps; elsewhere the
sequence holds NaN. A recording is cut to the span of its reference and put on a uniform 200 Hz
clock (TUM-VI's IMU runs at 199.4 Hz).

Both clocks are one in the published sets. Where `sensor.yaml` stands beside a `data.csv`, its
`T_BS` (sensor in body) is applied: the reference then is turned and shifted from its sensor's place
to the IMU's. The bodies are left as they are: in EuRoC the IMU's x axis points up.

No split is published; ours are below. `unseen` holds whole environments out: the second Vicon room
of EuRoC, everything of TUM-VI that leaves the room (its truth begins and ends in it). Recordings of
other names, one's own in this layout, are in `test` alone.
"""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import yaml
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from gnio_jax.data.alignment import fuse_attitude, smooth_positions
from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.readers.stamps import in_order
from gnio_jax.data.readers.text import numbers, read_csv, shortened
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import check_finite, check_gaps, check_rate, check_unit_norm, validate
from gnio_jax.numerics import integrate_gyro, quaternions, rotations
from gnio_jax.types import InputError, Sequence

RATE = 200.0
VERSION = "asl 2"
"""Changes whenever other sequences would come of the same files: it is part of the cache's key."""
SPLITS = ("train", "val", "test", "seen", "unseen")
EUROC_SPLITS = {
    "train": ("MH_01_easy", "MH_02_easy", "MH_03_medium", "V1_01_easy", "V1_03_difficult"),
    "val": ("V1_02_medium",),
    "test": ("MH_04_difficult", "MH_05_difficult"),
    "unseen": ("V2_01_easy", "V2_02_medium", "V2_03_difficult"),
}
TUMVI_SPLITS = {
    "train": ("room1", "room2", "room6"),
    "val": ("room3",),
    "test": ("room4", "room5"),
    "unseen": (
        *(f"corridor{i}" for i in range(1, 6)),
        *(f"magistrale{i}" for i in range(1, 7)),
        *(f"outdoors{i}" for i in range(1, 9)),
        *(f"slides{i}" for i in range(1, 4)),
    ),
}

LONGEST_BRIDGE = 0.1
"""Stretches without a reference pose up to here (s) are bridged; longer ones are not valid."""
LOST_POSES = 2.5
"""Of a noisy tracker, poses up to this many intervals apart (one is lost) are interpolated; further
apart gyro and smoother bridge."""
LARGEST_JUMP = 0.02
"""m by which a step of the position may contradict the reference's own velocity, and smoothed
positions the seen ones."""
LONGEST_LEVER = 100.0
"""m; no sensor is further away from its body."""
SHORTEST_RUN = 8
"""Poses in a row below which a stretch between gaps is not believed."""

_REFERENCES = ("state_groundtruth_estimate0", "mocap0")
_AXES = {
    "stamp": ("timestamp", "time"),
    **{f"w{axis}": (f"w_rs_s_{axis}",) for axis in "xyz"},
    **{f"a{axis}": (f"a_rs_s_{axis}",) for axis in "xyz"},
    **{f"p{axis}": (f"p_rs_r_{axis}", f"p{axis}") for axis in "xyz"},
    **{f"q{axis}": (f"q_rs_{axis}", f"q{axis}") for axis in "wxyz"},
    **{f"v{axis}": (f"v_rs_r_{axis}", f"v{axis}") for axis in "xyz"},
}
"""Our names of the columns, and the authors' without unit, in small letters."""


def recordings(root: Path, split: str, dataset: str = "euroc") -> list[Recording]:
    """The recordings of a split."""
    about = _about(dataset)
    known = EUROC_SPLITS if dataset == "euroc" else TUMVI_SPLITS
    wanted = "test" if split == "seen" else split
    chosen = [
        folder
        for name, folder in find_sequences(Path(root), about).items()
        if _split_of(name, known) == wanted
    ]
    if not chosen:
        raise InputError(
            root,
            f"holds no sequence of split '{split}'",
            f"its sequences are {', '.join(known[wanted])}",
        )
    return [_recording(folder, about) for folder in chosen]


def _about(dataset: str) -> Dataset:
    return next(entry for entry in DATASETS if entry.name == dataset)


def _recording(folder: Path, about: Dataset) -> Recording:
    sensors = [folder / "mav0" / sensor for sensor in ("imu0", *_REFERENCES)]
    files = [sensor / name for sensor in sensors for name in ("data.csv", "sensor.yaml")]
    return single(short_name(folder.name), _read_by_name, folder, about.name)._replace(
        files=tuple(path for path in files if path.is_file()), version=f"{VERSION} {about.name}"
    )


def _read_by_name(folder: Path, dataset: str) -> Sequence:
    """Another process has a `Dataset` of its own: only the name goes there."""
    return read_sequence(folder, _about(dataset))


def find_sequences(root: Path, about: Dataset) -> dict[str, Path]:
    """Short name -> folder of every sequence below `root`. Raises `InputError` when there is none.

    TUM-VI is published in two sizes of the images, `dataset-room1_512_16` and
    `dataset-room1_1024_16`: the walk is the same, and is taken once.
    """
    found: dict[str, Path] = {}
    for depth in ("", "*/", "*/*/", "*/*/*/"):
        for mav in sorted(root.glob(f"{depth}mav0")):
            # TUM-VI's calibration recordings shake a camera in front of a board: no walk.
            if (mav / "imu0" / "data.csv").is_file() and not mav.parent.name.startswith(
                "dataset-calib"
            ):
                found.setdefault(short_name(mav.parent.name), mav.parent)
    if not found:
        raise InputError(root, "holds no mav0/imu0/data.csv", f"expected layout: {about.layout}")
    return dict(sorted(found.items()))


def short_name(folder: str) -> str:
    """`room1` of `dataset-room1_512_16`; EuRoC's names stay."""
    match = re.fullmatch(r"dataset-(\w+?)_(?:512|1024)_16", folder)
    return match[1] if match else folder


def _split_of(name: str, splits: dict[str, tuple[str, ...]]) -> str:
    return next((split for split, names in splits.items() if name in names), "test")


def read_sequence(folder: str | os.PathLike[str], about: Dataset | None = None) -> Sequence:
    """One sequence of its folder (the one that holds `mav0`), not yet self-checked. Raises
    `InputError` naming file and field."""
    folder, about = Path(folder), about or EUROC
    path = folder / "mav0" / "imu0" / "data.csv"
    table, stamps = _table(path)
    start = int(stamps.min())
    imu = _columns(table, [*"wx wy wz ax ay az".split()], path)
    check_finite(imu, "gyro and accel", path)
    time, imu, repairs = in_order((stamps - start) * 1e-9, imu, path)
    check_rate(time, RATE, path)
    check_gaps(time, path)

    kind = next(
        (kind for kind in _REFERENCES if (folder / "mav0" / kind / "data.csv").is_file()), None
    )
    if kind is None:
        raise InputError(
            folder / "mav0",
            f"has no reference ({' or '.join(_REFERENCES)})/data.csv",
            "bring a recording without one into the dataset 'csv'",
        )
    truth = folder / "mav0" / kind / "data.csv"
    seen, attitude, position, velocity = _reference(truth, start)
    offset = _pose(folder / "mav0" / "imu0" / "sensor.yaml").seen_from(
        _pose(folder / "mav0" / kind / "sensor.yaml")
    )
    position = position + attitude.apply(offset.translation)
    attitude = attitude * offset.rotation
    moved = float(np.linalg.norm(offset.translation)) > 1e-9

    inside = (time >= seen[0] - 1e-9) & (time <= seen[-1] + 1e-9)
    if inside.sum() < 2:
        raise InputError(
            truth,
            f"field 'time' ({seen[0]:.1f} to {seen[-1]:.1f} s) does not overlap the IMU's (0 to {time[-1]:.1f} s)",
            "the stamps of both must be unix time in ns",
        )
    start += round(time[inside][0] * 1e9)
    seen, time, imu = seen - time[inside][0], time[inside] - time[inside][0], imu[inside]
    clocked = _on_clock(time, imu, path)
    fill = _fuse if velocity is None else _interpolated
    orientation, place, speed, valid = fill(clocked, seen, attitude, position, velocity, moved)
    valid &= clocked.valid
    return validate(
        clocked._replace(
            name=short_name(folder.name),
            orientation=np.where(valid[:, None], orientation, np.nan),
            position=np.where(valid[:, None], place, np.nan),
            velocity=np.where(valid[:, None], speed, np.nan),
            valid=valid,
            attributes={
                "dataset": about.name,
                "group": short_name(folder.name),
                "placement": "drone" if about is EUROC else "handheld",
                "truth": "tracker and IMU, smoothed" if velocity is not None else "motion capture",
                "start_time": start * 1e-9,
                "licence": about.licence,
                **repairs,
            },
        ),
        truth,
    )


# --- files
# -----------------------------------------------------------------------------------------------------------


def _table(path: Path) -> tuple[pd.DataFrame, np.ndarray]:
    """A data.csv with our names for the columns it has, and its stamps in ns as integers (a float
    has too few digits)."""
    table = read_csv(path)
    plain = [re.sub(r"[\[(].*", "", str(name)).strip().lower() for name in table.columns]
    ours = {name: ours for ours, names in _AXES.items() for name in names}
    table.columns = [
        ours.get(short, str(name)) for short, name in zip(plain, table.columns, strict=True)
    ]
    stamps = numbers(table, ["stamp"], path)[:, 0]
    check_finite(stamps, "stamp", path)
    column = table["stamp"]
    return table, column.to_numpy() if column.dtype.kind == "i" else stamps.astype(np.int64)


def _columns(table: pd.DataFrame, names: list[str], path: Path) -> Float[np.ndarray, "n w"]:
    """The columns; one that is missing is named as the authors name it."""
    for name in names:
        if name not in table.columns:
            raise InputError(
                path,
                f"column '{_AXES[name][0]}' is missing",
                f"found: {', '.join(str(column) for column in table.columns)}",
            )
    return numbers(table, names, path)


def _reference(
    path: Path, start: int
) -> tuple[
    Float[np.ndarray, " n"], Rotation, Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"] | None
]:
    """(time s after `start` ns, attitude, position, velocity if the file has one); rows without a
    pose are no rows."""
    table, stamps = _table(path)
    names = [
        *"px py pz qw qx qy qz".split(),
        *(["vx", "vy", "vz"] if "vx" in table.columns else []),
    ]
    values = _columns(table, names, path)
    seen = np.isfinite(values).all(axis=1)
    if seen.sum() < SHORTEST_RUN:
        raise InputError(path, f"holds {seen.sum()} poses", "copy it again")
    time, values, _ = in_order((stamps[seen] - start) * 1e-9, values[seen], path)
    if (slowest := float(np.median(np.diff(time)))) > LONGEST_BRIDGE:
        raise InputError(
            path,
            f"field 'time' runs at {1 / slowest:.3g} Hz, too slow for a reference",
            f"give at least {1 / LONGEST_BRIDGE:g} Hz",
        )
    quaternion = check_unit_norm(values[:, 3:7], np.ones(len(values), dtype=bool), "q_rs", path)
    return time, rotations(quaternion), values[:, :3], values[:, 7:] if len(names) > 7 else None


class _Pose(NamedTuple):
    """T_BS of a sensor."""

    rotation: Rotation = Rotation.identity()
    """Sensor → body."""
    translation: np.ndarray = np.zeros(3)
    """Of the sensor in the body, m."""

    def seen_from(self, other: _Pose) -> _Pose:
        """This sensor in the frame of another one."""
        inverse = other.rotation.inv()
        return _Pose(inverse * self.rotation, inverse.apply(self.translation - other.translation))


def _pose(path: Path) -> _Pose:
    """T_BS of a sensor.yaml; the identity where there is no file or it names none."""
    if not path.is_file():
        return _Pose()
    try:
        # Some exports carry OpenCV's header and tag, which are no YAML.
        text = re.sub(
            r"^%YAML.*$|!!opencv-matrix", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE
        )
        content = yaml.safe_load(text)
    except (
        OSError,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        RecursionError,
        yaml.YAMLError,
    ) as error:  # tags fail in any way
        raise InputError(
            path, f"cannot be read as YAML ({shortened(error, 200)})", "copy it again"
        ) from None
    entry = content.get("T_BS") if isinstance(content, dict) else None
    if entry is None:
        return _Pose()
    try:
        rows = entry["data"] if isinstance(entry, dict) else entry
        # One by one, since aliases can make a few lines of YAML a list of billions.
        matrix = np.array(
            [float(number) for row in rows for number in (row if isinstance(row, list) else [row])]
        ).reshape(4, 4)
        turn = matrix[:3, :3]
        if (
            np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3
            or not np.isfinite(turn).all()
            or np.linalg.det(turn) < 0
        ):
            raise ValueError("its rotation is none")
        if not np.linalg.norm(matrix[:3, 3]) < LONGEST_LEVER:
            raise ValueError(f"its translation is beyond {LONGEST_LEVER:g} m")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            path,
            f"field 'T_BS' is no pose ({error})",
            "it holds cols, rows and data of a 4 × 4 matrix",
        ) from None
    return _Pose(Rotation.from_matrix(turn), matrix[:3, 3])


# --- reference on the IMU's clock
# ------------------------------------------------------------------------------------


def _on_clock(time: np.ndarray, imu: np.ndarray, path: Path) -> Sequence:
    """The IMU at 200 Hz; `valid` where it has no gap. The reference is a placeholder."""
    count = len(time)
    still = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    nothing = np.zeros((count, 3))
    sequence = Sequence(
        name="",
        time=time,
        gyro=imu[:, :3],
        accel=imu[:, 3:],
        orientation=still,
        position=nothing,
        velocity=nothing,
        valid=np.ones(count, dtype=bool),
    )
    return resample(validate(sequence, path), RATE)


def _interpolated(
    clocked: Sequence,
    seen: np.ndarray,
    attitude: Rotation,
    position: np.ndarray,
    velocity: np.ndarray,
    moved: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(orientation, position, velocity, valid) of a smooth reference, by splines within its
    unbroken runs.

    `moved`: the reference was shifted along a lever, so that its velocity is another point's and is
    differenced instead.
    """
    clock, count = clocked.time, len(clocked.time)
    orientation, place, speed = (np.full((count, width), np.nan) for width in (4, 3, 3))
    valid = np.zeros(count, dtype=bool)
    steps = np.diff(seen)
    broken = steps > LONGEST_BRIDGE
    if not moved:
        contradiction = (
            np.diff(position, axis=0) - 0.5 * (velocity[1:] + velocity[:-1]) * steps[:, None]
        )
        # Over long steps the trapezium is only a rough integral of the velocity.
        broken |= np.linalg.norm(contradiction, axis=1) > LARGEST_JUMP + 2.0 * steps**2
    for run in np.split(np.arange(len(seen)), np.flatnonzero(broken) + 1):
        if len(run) < SHORTEST_RUN:
            continue
        rows = np.flatnonzero((clock >= seen[run[0]] - 1e-6) & (clock <= seen[run[-1]] + 1e-6))
        at = np.clip(clock[rows], seen[run[0]], seen[run[-1]])
        path = CubicSpline(seen[run], position[run], axis=0)
        orientation[rows] = quaternions(RotationSpline(seen[run], attitude[run])(at))
        place[rows] = path(at)
        speed[rows] = path(at, 1) if moved else CubicSpline(seen[run], velocity[run], axis=0)(at)
        valid[rows] = True
    return orientation, place, speed, valid


def _fuse(
    clocked: Sequence,
    seen: np.ndarray,
    attitude: Rotation,
    position: np.ndarray,
    velocity: None,
    moved: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(orientation, position, velocity, valid) of a noisy tracker without velocities."""
    clock, step = clocked.time, 1.0 / RATE
    usual = LOST_POSES * float(np.median(np.diff(seen)))
    # Single poses between gaps are those that the tracker hardly saw.
    runs = [
        run
        for run in np.split(np.arange(len(seen)), np.flatnonzero(np.diff(seen) > usual) + 1)
        if len(run) >= SHORTEST_RUN
    ]
    rows = np.concatenate(runs) if runs else np.arange(len(seen))
    seen, attitude, position = seen[rows], attitude[rows], position[rows]
    right = np.clip(np.searchsorted(seen, clock), 1, len(seen) - 1)
    covered = (clock >= seen[0] - 1e-6) & (clock <= seen[-1] + 1e-6)
    measured = covered & (seen[right] - seen[right - 1] <= usual)
    bridged = covered & (seen[right] - seen[right - 1] <= LONGEST_BRIDGE)
    at = np.clip(clock, seen[0], seen[-1])
    turned, straight = (
        Slerp(seen, attitude)(at),
        np.stack([np.interp(at, seen, column) for column in position.T], axis=1),
    )
    # The gyro's constant bias would bend the correction at its ends.
    rate = (turned[:-1].inv() * turned[1:]).as_rotvec() / step
    both = measured[:-1] & measured[1:]
    bias = (
        np.median((0.5 * (clocked.gyro[1:] + clocked.gyro[:-1]) - rate)[both], axis=0)
        if both.any()
        else np.zeros(3)
    )
    fused, believed_turn = fuse_attitude(
        integrate_gyro(clocked.gyro - bias, step), turned, measured, step
    )
    smooth, speed, believed_place = smooth_positions(
        _splined(at, seen, position, straight, usual), measured, step
    )
    # Where few poses are left between gaps the smoother may swing; it must stay with what was seen.
    close = np.linalg.norm(smooth - straight, axis=1) < LARGEST_JUMP
    return (
        quaternions(fused),
        smooth,
        speed,
        np.asarray(bridged & close & (believed_turn & believed_place | ~measured)),
    )


def _splined(
    at: np.ndarray, seen: np.ndarray, position: np.ndarray, straight: np.ndarray, longest: float
) -> np.ndarray:
    """Positions at the times `at`: cubic splines within runs whose poses are no further apart than
    `longest` s, else `straight`, since a spline would swing."""
    place = straight.copy()
    for run in np.split(np.arange(len(seen)), np.flatnonzero(np.diff(seen) > longest) + 1):
        if len(run) >= 4:
            rows = (at >= seen[run[0]]) & (at <= seen[run[-1]])
            place[rows] = CubicSpline(seen[run], position[run], axis=0)(at[rows])
    return place


EUROC = Dataset(
    name="euroc",
    recordings=partial(recordings, dataset="euroc"),
    splits=SPLITS,
    rate=RATE,
    source="https://projects.asl.ethz.ch/datasets/euroc-mav/",
    layout="<root>/<sequence>/mav0/{imu0,state_groundtruth_estimate0 or mocap0}/data.csv, stamps in ns",
    licence="as stated by the authors (ETH Zürich, Autonomous Systems Lab)",
    pedestrian=False,
)
TUMVI = Dataset(
    name="tumvi",
    recordings=partial(recordings, dataset="tumvi"),
    splits=SPLITS,
    rate=RATE,
    source="https://cvg.cit.tum.de/data/datasets/visual-inertial-dataset (exported Euroc / DSO 512x512)",
    layout="<root>/dataset-<sequence>_512_16/mav0/{imu0,mocap0}/data.csv, stamps in ns",
    licence="CC BY 4.0",
)
DATASET = EUROC
DATASETS = (EUROC, TUMVI)
