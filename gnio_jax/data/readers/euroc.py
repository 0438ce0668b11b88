"""The ASL layout of EuRoC (Burri et al., IJRR 2016; a drone) and TUM-VI (Schubert et al., IROS
2018; hand-held): two datasets, one reader.

Layout: <root>/.../<sequence>/mav0/imu0/data.csv (stamp ns, gyro rad/s, accel m/s²; 200 Hz) and
beside `imu0` a reference, the first of

- `state_groundtruth_estimate0/data.csv`: stamp ns, position m, quaternion wxyz, velocity m/s,
  biases. A smoothed estimate of the IMU body from tracker and IMU, at 200 Hz (some copies: 20 Hz).
  Splines interpolate it to the IMU's stamps.
- `mocap0/data.csv`: stamp ns, position m, quaternion wxyz: what the tracker saw at 120 Hz, with
  noise (0.1°, 0.4 mm), flips near its gaps, and gaps of seconds, or of minutes where TUM-VI leaves
  the room. The gyro carries the orientation, a smoother the position (half response at 12 Hz), and
  velocity is its derivative (`reference.fused`).

Either is valid only within gaps of 0.1 s and away from jumps; elsewhere the sequence holds NaN. A
recording is cut to the span of its reference and put on a uniform 200 Hz clock (TUM-VI's IMU runs
at 199.4 Hz).

Both clocks are one in the published sets. Where `sensor.yaml` stands beside a `data.csv`, its
`T_BS` (sensor in body) turns and shifts the reference from its sensor's place to the IMU's. The
bodies are left as they are: in EuRoC the IMU's x axis points up.

No split is published; ours are below. `unseen` holds whole environments out: the second Vicon room
of EuRoC, everything of TUM-VI that leaves the room (its truth begins and ends in it). Recordings of
other names, one's own in this layout, are in `test` alone.
"""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path

import numpy as np

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.data.readers.asl import ImuFile, moved_to, read_imu, read_poses, sensor_pose
from gnio_jax.data.readers.reference import Poses, fused, interpolated
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import validate
from gnio_jax.errors import InputError
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
    sensors = [folder / "mav0" / sensor for sensor in ("imu0", *REFERENCES)]
    files = [sensor / name for sensor in sensors for name in ("data.csv", "sensor.yaml")]
    return single(short_name(folder.name), _read_by_name, folder, about.name)._replace(
        files=tuple(path for path in files if path.is_file()), slow=True, form=about.name
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
    mav = folder / "mav0"
    path = mav / "imu0" / "data.csv"
    imu = read_imu(path, RATE)
    sensor = _reference_sensor(mav)
    truth = sensor / "data.csv"
    lever = sensor_pose(mav / "imu0" / "sensor.yaml").seen_from(sensor_pose(sensor / "sensor.yaml"))
    poses = moved_to(lever, read_poses(truth, imu.start))
    inside = _overlap(imu, poses, truth)
    first = imu.time[inside][0]
    clocked = _on_clock(imu.time[inside] - first, imu.samples[inside], path)
    poses = poses._replace(time=poses.time - first)
    if poses.velocity is None:
        reference = fused(clocked, 1.0 / RATE, poses)
    else:
        shifted = float(np.linalg.norm(lever.translation)) > 1e-9
        reference = interpolated(clocked.time, poses, shifted)
    valid = reference.valid & clocked.valid
    name = short_name(folder.name)
    sequence = clocked._replace(
        name=name,
        orientation=np.where(valid[:, None], reference.orientation, np.nan),
        position=np.where(valid[:, None], reference.position, np.nan),
        velocity=np.where(valid[:, None], reference.velocity, np.nan),
        valid=valid,
        attributes={
            "dataset": about.name,
            "group": name,
            "placement": "drone" if about is EUROC else "handheld",
            "truth": "motion capture" if poses.velocity is None else "tracker and IMU, smoothed",
            "start_time": (imu.start + round(first * 1e9)) * 1e-9,
            "licence": about.licence,
            **imu.repairs,
        },
    )
    return validate(sequence, truth)


def _reference_sensor(mav: Path) -> Path:
    """Folder of the first reference that is there."""
    for kind in REFERENCES:
        if (mav / kind / "data.csv").is_file():
            return mav / kind
    raise InputError(
        mav,
        f"has no reference ({' or '.join(REFERENCES)})/data.csv",
        "bring a recording without one into the dataset 'csv'",
    )


def _overlap(imu: ImuFile, poses: Poses, truth: Path) -> np.ndarray:
    """Which rows of the IMU lie between the first pose and the last."""
    first, last = poses.time[[0, -1]]
    inside = (imu.time >= first - 1e-9) & (imu.time <= last + 1e-9)
    if inside.sum() < 2:
        raise InputError(
            truth,
            f"field 'time' ({first:.1f} to {last:.1f} s) does not overlap the IMU's "
            f"(0 to {imu.time[-1]:.1f} s)",
            "the stamps of both must be unix time in ns",
        )
    return inside


def _on_clock(time: np.ndarray, samples: np.ndarray, path: Path) -> Sequence:
    """The IMU at 200 Hz; `valid` where it has no gap. The reference is a placeholder."""
    count = len(time)
    nothing = np.zeros((count, 3))
    sequence = Sequence(
        name="",
        time=time,
        gyro=samples[:, :3],
        accel=samples[:, 3:],
        orientation=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        position=nothing,
        velocity=nothing,
        valid=np.ones(count, dtype=bool),
    )
    return resample(validate(sequence, path), RATE)


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
DATASET = EUROC
DATASETS = (EUROC, TUMVI)
