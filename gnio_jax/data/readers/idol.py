"""IDOL: an iPhone 8 on a rig with a lidar odometry, carried through three buildings (Sun, Melamed,
Kitani, AAAI 2021).

Layout: building{1,2,3}/{train,known,unknown}/<k>.feather (train in building1 alone) and
metadata.json beside them, {"<k>": {"subjectID": …, "calibration": …}}. There is one table per walk,
at 100 Hz, whose columns are read by name, because their order varies.

The IMU is that of the phone: iOS reports −f in G. The table's attitude is that of the *rig*; the
phone is mounted on it, turned by about half a turn about z. The world of the lidar's map is tilted
by up to 8°. It is levelled with the mean of R·stencilAcc, the rig's own accelerometer, minus the
mean acceleration of the positions. In some recordings the poses are late by 0.03 to 0.19 s; this
lag is estimated from the angular rates of the poses and of the gyro. The position is that of the
rig, less than a phone's length away, and the authors smoothed it until it contained no gait.

The folders are the splits: `known` (also `seen`, `test`) are people of `train`, `unknown` (also
`unseen`) are others. For validation people are held out of `train`. They are drawn by a hash of the
name, so they are the same in every copy of the data.
"""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment.body import LONGEST_POSE_LAG, pose_lag
from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.dataset import Dataset, RecordingSource, Refusal
from gnio_jax.data.parsing.stamps import first_rows
from gnio_jax.data.parsing.tables import Table, damage_error, json_object, read_feather, shorten
from gnio_jax.data.reference import LONGEST_BRIDGE
from gnio_jax.data.splits import draw_share
from gnio_jax.data.validation import FASTEST_WALKER, UNIT_NORM_TOLERANCE, WINDOW_SECONDS
from gnio_jax.errors import InputError
from gnio_jax.files import file_in
from gnio_jax.numerics import finite_rows, levelling, stretches
from gnio_jax.types import STANDARD_G, Sequence

RATE = 100.0
SEED, HELD_OUT = "idol 56", 0.12
"""Seed of the draw of people, and the share for validation. It is the first seed that takes one of
the subjects 0 to 4, and one of each ten up to 39."""

PHONE_TO_RIG = Rotation.from_rotvec([-0.01853, 0.02801, 3.12916])
"""Mounting of the phone, from gyro and reference of the whole set; the authors state x → −x, y →
−y."""
SHORTEST = 10.0
"""Shortest time of poses, and of the rig's accelerometer, that determines level and lag, s."""
MAX_TILT = 20.0
"""Largest plausible tilt of the map, degrees; beyond it, the attitude is wrong."""

_SPLITS = {
    "train": "train",
    "val": "train",
    "seen": "known",
    "known": "known",
    "test": "known",
    "unseen": "unknown",
    "unknown": "unknown",
}
_BUILDINGS = ("building1", "building2", "building3")


def recordings(root: Path, split: str) -> list[RecordingSource]:
    """The walks of a split."""
    chosen = find_walks(root, _SPLITS[split])
    if split not in ("train", "val"):
        return chosen
    people = {walk.attributes["subject"] for walk in chosen}
    held = {person for person in people if draw_share(SEED, person) < HELD_OUT}
    chosen = [walk for walk in chosen if (walk.attributes["subject"] in held) == (split == "val")]
    if people and not chosen:
        problem = f"{len(held)} of {len(people)} people are held out"
        problem = f"split '{split}' would be empty: {problem}"
        raise InputError(root, problem, "complete the data, or choose another split")
    note = {"held_out": ", ".join(sorted(held))}
    return [walk._replace(attributes=walk.attributes | note) for walk in chosen]


def find_walks(root: Path, part: str) -> list[RecordingSource]:
    """The recordings in `folder` ("train", "known", "unknown") of every building; the buildings may
    be a folder or two deeper."""
    walks: list[RecordingSource] = []
    nameless: list[Path] = []
    for building in _BUILDINGS:
        depths = ("", "*/", "*/*/")
        folders = [p for depth in depths for p in sorted(root.glob(f"{depth}{building}/{part}"))]
        for folder in folders[:1]:
            metadata_path = file_in(folder, "metadata.json")
            metadata = json_object(metadata_path) if metadata_path.is_file() else {}
            paths = [path for path in folder.iterdir() if path.suffix.lower() == ".feather"]
            for path in sorted(paths, key=lambda path: (len(path.stem), path.stem)):
                entry = metadata.get(path.stem)
                entry = entry if isinstance(entry, dict) else {}
                subject = _name(path)
                if (person := entry.get("subjectID")) is None:
                    nameless.append(path)
                else:
                    subject = shorten(f"subject{person}")
                # Times at which the rig was turned about its axes: start, end, ...
                attributes = {"calibration": shorten(entry.get("calibration", "unknown"))}
                attributes |= {"subject": subject, "group": subject}
                walks.append(
                    RecordingSource(
                        _name(path), partial(read, path), (path,), True, attributes=attributes
                    )
                )
    if nameless:
        problem = f"metadata.json does not name the subject of {len(nameless)} recordings"
        remark = "each is treated as a different person"
        warnings.warn(f"{root}: {problem}, e.g. {nameless[0]}; {remark}", stacklevel=3)
    return walks


def _name(path: Path) -> str:
    return f"{path.parent.parent.name}_{path.parent.name}_{path.stem}"


# --- one walk


def read(path: Path) -> list[Sequence]:
    """Read a walk at 100 Hz: levelled, with the reference turned to the phone and shifted to its
    clock.

    Level and lag are those of the whole walk, which is divided at gaps longer than a window. Raises
    `InputError` naming file and column, and `Refusal` if its reference cannot be that of the phone.
    """
    table = read_feather(path)
    stamps = table.take("timestamp")
    rows, start = first_rows(stamps, path, "timestamp"), float(np.median(stamps))
    time = stamps[rows] - start
    fewest = SHORTEST / float(np.median(np.diff(time)))
    gyro, accel = table.axes("iphoneGyro", "XYZ")[rows], table.axes("iphoneAcc", "XYZ")[rows]
    pull = float(np.median(np.linalg.norm(accel, axis=1)))
    if not 0.5 < pull < 2.0:
        problem = f"columns 'iphoneAcc' have a median length of {pull:.3g}, expected about 1 (G)"
        raise damage_error(path, problem)
    orientation = table.axes("orient", "WXYZ", gaps=True)[rows]
    position = table.axes("processedPos", "XYZ", gaps=True)[rows]
    # Neither a quaternion of zeros nor NaN is an attitude.
    present = orientation.any(axis=1) & finite_rows(orientation) & finite_rows(position)
    if present.sum() < max(fewest, 0.5 * len(rows)):
        problem = f"hold a pose in only {present.sum()} of {len(rows)} rows"
        raise Refusal(path, f"columns 'orient', 'processedPos' {problem}")
    rig = table.rotations(*(f"orient{axis}" for axis in "WXYZ"), rows=rows[present])

    # The map is levelled by the rig's own accelerometer.
    rig_accel = table.axes("stencilAcc", "XYZ", gaps=True)[rows][present]
    if (has_accel := finite_rows(rig_accel)).sum() < fewest:
        raise Refusal(path, f"columns 'stencilAcc' hold numbers in only {has_accel.sum()} rows")
    force = rig[has_accel].apply(rig_accel[has_accel])
    level = levelling(_gravity(time[present][has_accel], force, position[present][has_accel]))
    if (tilt := float(np.degrees(level.magnitude()))) > MAX_TILT:
        problem = f"gravity by 'orient' and 'stencilAcc' is {tilt:.0f}° off the vertical"
        raise Refusal(path, problem)
    attitude = level * rig * PHONE_TO_RIG

    # A gap gives no information about the lag, so it is shortened to a window here.
    closed = np.concatenate([[0.0], np.cumsum(np.minimum(np.diff(time), WINDOW_SECONDS))])
    fit = pose_lag(closed, gyro, closed[present], attitude)
    if not fit.correlation >= 0.5:  # NaN if the poses do not turn at all
        problem = f"do not turn as 'iphoneGyro' does (they correlate by {fit.correlation:.2f})"
        raise Refusal(path, f"columns 'orient' {problem}")
    if abs(fit.lag) >= LONGEST_POSE_LAG:
        problem = f"are out of step with 'iphoneGyro' by {LONGEST_POSE_LAG:g} s or more"
        raise Refusal(path, f"columns 'orient' {problem}")
    attributes = {
        "group": _name(path),
        "subject": "unknown",
        "building": path.parent.parent.name,
        "device": "iPhone 8",
        "placement": "handheld rig",
        "truth": "lidar-visual-inertial odometry (Kaarta Stencil)",
        "imu_compensated": "no",
        "lag": fit.lag,
        "rate_correlation": fit.correlation,
        "tilt_degrees": tilt,
    }
    smoothed = level.apply(position[present])
    streams = Streams.of_imu(_name(path), path, time, gyro, -STANDARD_G * accel)._replace(
        attributes=attributes,
        start=start,
        poses=Poses(time[present] - fit.lag, attitude, smoothed, source=str(path)),
        device=_device(table, time, rows),
    )
    return assemble(streams, RATE, divide=True, max_speed=FASTEST_WALKER)


def _gravity(
    time: Float[np.ndarray, " n"],
    force: Float[np.ndarray, "n 3"],
    position: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "3"]:
    """The mean force in the map's world minus the mean acceleration of the positions, m/s².

    The difference of the positions and the twice integrated force is a parabola. Its curvature is
    the difference of two velocities, at the beginning and at the end of each unbroken run. These
    are medians over a second of displacements over a second, which no single pose can change.
    """
    mean, second = force.mean(axis=0), round(RATE)
    velocity_gain, seconds = np.zeros(3), 0.0
    for run in stretches(np.diff(time) > LONGEST_BRIDGE):
        if run.stop - run.start >= 3 * second:
            run_time, difference = time[run], force[run] - mean
            for _ in range(2):
                difference = cumulative_trapezoid(difference, run_time, axis=0, initial=0.0)
            difference = position[run] - difference
            duration = run_time[second:] - run_time[:-second]
            speed = (difference[second:] - difference[:-second]) / duration[:, None]
            middle = run_time[:-second] + duration / 2.0
            first, last = slice(second), slice(-second, None)
            velocity_gain += np.median(speed[last], axis=0) - np.median(speed[first], axis=0)
            seconds += float(np.median(middle[last]) - np.median(middle[first]))
    return mean - velocity_gain / max(seconds, 1.0)


def _device(table: Table, time: Float[np.ndarray, " n"], rows: np.ndarray) -> Samples | None:
    """CoreMotion's attitude, if the table has it. Rows without one are left out; None if most rows
    have none."""
    if not {f"iphoneOrient{axis}" for axis in "WXYZ"} <= set(table.columns):
        return None
    wxyz = table.axes("iphoneOrient", "WXYZ", gaps=True)[rows]
    present = np.abs(np.linalg.norm(wxyz, axis=1) - 1.0) <= UNIT_NORM_TOLERANCE
    if present.sum() < 0.5 * len(rows):
        return None
    return Samples(time[present], wxyz[present], str(table.path))


DATASET = Dataset(
    name="idol",
    recordings=recordings,
    splits=tuple(_SPLITS),
    rate=RATE,
    source="https://zenodo.org/records/4484093",
    layout="<root>/building{1,2,3}/{train,known,unknown}/<k>.feather "
    "with metadata.json beside them",
    licence="CC BY 4.0",
    correlates=False,  # the authors' smoothed positions contain no gait
)
