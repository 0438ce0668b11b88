"""The ASL layout of EuRoC (Burri et al., IJRR 2016; a drone) and TUM-VI (Schubert et al., IROS
2018; hand-held): two datasets, one reader.

Layout: <root>/.../<sequence>/mav0/imu0/data.csv (stamp ns, gyro rad/s, accel m/s²; 200 Hz) and
beside `imu0` a reference, the first of

- `state_groundtruth_estimate0/data.csv`: stamp ns, position m, quaternion wxyz, velocity m/s,
  biases. It is a smoothed estimate of the IMU body from tracker and IMU, at 200 Hz (some copies: 20
  Hz). Splines interpolate it at the IMU's stamps.
- `mocap0/data.csv`: stamp ns, position m, quaternion wxyz. These are the tracker's poses at 120 Hz,
  with noise (0.1°, 0.4 mm), flips near its gaps, and gaps of seconds, or of minutes where TUM-VI
  leaves the room. The orientation is carried by the gyro, the position is smoothed (half response
  at 12 Hz), and the velocity is its derivative (`reference.reference_at`).

Both are valid only within gaps of 0.1 s and away from jumps; elsewhere the sequence has NaN. A
recording is cut to the span of its reference and put on a uniform 200 Hz clock (TUM-VI's IMU runs
at 199.4 Hz).

Both clocks are the same in the published sets. If there is a `sensor.yaml` beside a `data.csv`, the
reference is moved by its `T_BS` (sensor in body) from its sensor to the IMU. The body axes are not
changed: in EuRoC the IMU's x axis points up.

No split is published; ours are below. `unseen` has whole environments: the second Vicon room of
EuRoC, and all recordings of TUM-VI that leave the room (their truth begins and ends in it).
Recordings with other names, such as your own in this layout, are in `test` alone.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from gnio_jax.data.assembly import Poses, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.parsing.tables import Table, damage_error, parsing_as, read_text
from gnio_jax.data.reference import LONGEST_BRIDGE, SHORTEST_RUN
from gnio_jax.errors import InputError
from gnio_jax.files import file_in
from gnio_jax.numerics import finite_rows
from gnio_jax.types import Sequence

RATE = 200.0
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

REFERENCES = ("state_groundtruth_estimate0", "mocap0")
LONGEST_LEVER = 100.0
"""Largest distance of a sensor from its body, m."""

STAMP = "timestamp"
GYRO, ACCEL, _POSITION, _VELOCITY = (
    tuple(f"{name}_{axis}" for axis in "xyz") for name in ("w_rs_s", "a_rs_s", "p_rs_r", "v_rs_r")
)
_QUATERNION = tuple(f"q_rs_{axis}" for axis in "wxyz")
_SHORT = {
    "time": STAMP,
    **dict(zip(("px", "py", "pz"), _POSITION, strict=True)),
    **dict(zip(("qw", "qx", "qy", "qz"), _QUATERNION, strict=True)),
    **dict(zip(("vx", "vy", "vz"), _VELOCITY, strict=True)),
}
"""Other names of columns → the authors' names, both without unit and in small letters."""


def recordings(root: Path, split: str, dataset: str = "euroc") -> list[RecordingSource]:
    """The recordings of a split."""
    published = EUROC_SPLITS if dataset == "euroc" else TUMVI_SPLITS
    split_of = {name: part for part, names in published.items() for name in names}
    group, folders = "test" if split == "seen" else split, find_sequences(root)
    chosen = [path for name, path in folders.items() if split_of.get(name, "test") == group]
    if folders and not chosen:
        remedy = f"its sequences are {', '.join(published[group])}"
        raise InputError(root, f"holds no sequence of split '{split}'", remedy)
    return [_recording(folder, dataset) for folder in chosen]


def _recording(folder: Path, dataset: str) -> RecordingSource:
    sensors = [folder / "mav0" / sensor for sensor in ("imu0", *REFERENCES)]
    files = tuple(
        file_in(sensor, name) for sensor in sensors for name in ("data.csv", "sensor.yaml")
    )
    read_it = partial(read, folder, dataset)
    return RecordingSource(short_name(folder.name), read_it, files, slow=True, form=dataset)


def find_sequences(root: Path) -> dict[str, Path]:
    """Short name -> folder of every sequence below `root`.

    TUM-VI is published with two sizes of the images, `dataset-room1_512_16` and
    `dataset-room1_1024_16`. The walk is the same, and it is taken once.
    """
    sequences: dict[str, Path] = {}
    for depth in ("", "*/", "*/*/", "*/*/*/"):
        for mav in sorted(root.glob(f"{depth}mav0")):
            # TUM-VI's calibration recordings are of a camera in front of a board and have no walk.
            if file_in(mav / "imu0", "data.csv").is_file() and not mav.parent.name.startswith(
                "dataset-calib"
            ):
                sequences.setdefault(short_name(mav.parent.name), mav.parent)
    return dict(sorted(sequences.items()))


def short_name(folder: str) -> str:
    """`room1` for `dataset-room1_512_16`; EuRoC's names are unchanged."""
    match = re.fullmatch(r"dataset-(\w+?)_(?:512|1024)_16", folder)
    return match[1] if match else folder


# --- one sequence


def read(folder: Path, dataset: str = "euroc") -> list[Sequence]:
    """Read the sequence of a folder (the one with `mav0`). Raises `InputError` naming file and
    field."""
    mav, name = folder / "mav0", short_name(folder.name)
    path = file_in(mav / "imu0", "data.csv")
    table = read_table(path)
    time, start, _ = table.clock(STAMP, "ns", repeats="kept")
    poses = read_reference(mav, start)
    if poses is None:
        problem = f"has no reference ({' or '.join(REFERENCES)})/data.csv"
        raise InputError(mav, problem, "bring a recording without one into the dataset 'csv'")
    attributes = {
        "group": name,
        "placement": "drone" if dataset == "euroc" else "handheld",
        "truth": "motion capture" if poses.noisy else "tracker and IMU, smoothed",
    }
    streams = Streams.of_imu(name, path, time, table.take(*GYRO), table.take(*ACCEL))
    streams = streams._replace(attributes=attributes, start=start * 1e-9, poses=poses)
    return assemble(streams, RATE)


def read_table(path: Path) -> Table:
    """A data.csv, with columns by the authors' names without unit, in small letters."""
    table = read_text(path)
    plain = (re.sub(r"[\[(].*", "", str(name)).strip().lower() for name in table.columns)
    names = [_SHORT.get(name, name) for name in plain]
    used = {STAMP, *GYRO, *ACCEL, *_POSITION, *_QUATERNION, *_VELOCITY}
    pairs = zip(names, table.columns, strict=True)
    labels = [title if title in used else name for title, name in pairs]
    return table.rename(labels)


def read_reference(mav: Path, start: float | int) -> Poses | None:
    """Poses of the IMU from the first reference that exists, in s after the stamp `start` (ns);
    rows without a pose are left out."""
    files = (file_in(mav / name, "data.csv") for name in REFERENCES)
    path = next((file for file in files if file.is_file()), None)
    if path is None:
        return None
    table = read_table(path)
    time, *_ = table.clock(STAMP, "ns", start, "kept")
    position, quaternion = table.take(*_POSITION, gaps=True), table.take(*_QUATERNION, gaps=True)
    velocity = table.take(*_VELOCITY, gaps=True) if _VELOCITY[0] in table.columns else None
    present = finite_rows(position) & finite_rows(quaternion)
    if velocity is not None:
        present &= finite_rows(velocity)
    if present.sum() < SHORTEST_RUN:
        raise damage_error(path, f"holds {present.sum()} poses")
    time = time[present]
    if (usual := float(np.median(np.abs(np.diff(time))))) > LONGEST_BRIDGE:
        problem = f"field 'time' runs at {1 / usual:.3g} Hz, too slow for a reference"
        raise InputError(path, problem, f"give at least {1 / LONGEST_BRIDGE:g} Hz")
    poses = Poses(
        time,
        table.rotations(*_QUATERNION, rows=present),
        position[present],
        None if velocity is None else velocity[present],
        noisy=velocity is None,
        source=str(path),
    )
    tracked = sensor_pose(file_in(path.parent, "sensor.yaml"))
    return moved_to(sensor_pose(file_in(mav / "imu0", "sensor.yaml")).seen_from(tracked), poses)


# --- where a sensor sits


class SensorPose(NamedTuple):
    """T_BS of a sensor."""

    rotation: Rotation = Rotation.identity()
    """Sensor → body."""
    translation: np.ndarray = np.zeros(3)
    """Position of the sensor in the body, m."""

    def seen_from(self, other: SensorPose) -> SensorPose:
        """This sensor in the frame of another one."""
        inverse = other.rotation.inv()
        lever = inverse.apply(self.translation - other.translation)
        return SensorPose(inverse * self.rotation, lever)


def sensor_pose(path: Path) -> SensorPose:
    """T_BS of a sensor.yaml; the identity if there is no file or it has none."""
    content = _yaml(path) if path.is_file() else None
    entry = content.get("T_BS") if isinstance(content, dict) else None
    if entry is None:
        return SensorPose()
    try:
        rows = entry["data"] if isinstance(entry, dict) else entry
        # The values are read one by one, because aliases can turn a few lines of YAML into
        # billions.
        values = [float(x) for row in rows for x in (row if isinstance(row, list) else [row])]
        matrix = np.array(values).reshape(4, 4)
        turn, translation = matrix[:3, :3], matrix[:3, 3]
        orthogonal = np.abs(turn @ turn.T - np.eye(3)).max() <= 1e-3
        if not (orthogonal and np.isfinite(turn).all() and np.linalg.det(turn) >= 0):
            raise ValueError("its rotation is none")
        if not np.linalg.norm(translation) < LONGEST_LEVER:
            raise ValueError(f"its translation is beyond {LONGEST_LEVER:g} m")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        remedy = "it holds cols, rows and data of a 4 × 4 matrix"
        raise InputError(path, f"field 'T_BS' is not a pose ({error})", remedy) from None
    return SensorPose(Rotation.from_matrix(turn), translation)


def moved_to(imu: SensorPose, poses: Poses) -> Poses:
    """Poses of the IMU, whose pose in the tracked sensor's frame is `imu`."""
    lever = imu.rotation.inv().apply(imu.translation)
    return poses._replace(attitude=poses.attitude * imu.rotation, lever=lever)


def _yaml(path: Path) -> Any:
    with parsing_as(path, "YAML"):  # tags may raise any error
        # Some exports have OpenCV's header and tag, which are not YAML.
        text = path.read_text(encoding="utf-8")
        return yaml.safe_load(re.sub(r"(?m)^%YAML.*$|!!opencv-matrix", "", text))


EUROC = Dataset(
    name="euroc",
    recordings=partial(recordings, dataset="euroc"),
    splits=SPLITS,
    rate=RATE,
    source="https://projects.asl.ethz.ch/datasets/euroc-mav/",
    layout="<root>/<sequence>/mav0/{imu0,state_groundtruth_estimate0 or mocap0}/data.csv, "
    "stamps in ns",
    licence="as stated by the authors (ETH Zürich, Autonomous Systems Lab)",
    pedestrian=False,
)
TUMVI = Dataset(
    name="tumvi",
    recordings=partial(recordings, dataset="tumvi"),
    splits=SPLITS,
    rate=RATE,
    source="https://cvg.cit.tum.de/data/datasets/visual-inertial-dataset "
    "(exported Euroc / DSO 512x512)",
    layout="<root>/dataset-<sequence>_512_16/mav0/{imu0,mocap0}/data.csv, stamps in ns",
    licence="CC BY 4.0",
)
DATASETS = (EUROC, TUMVI)
