"""Writes the known walk in the ASL layout of EuRoC and TUM-VI, with the traps of the published
files.

`T_BS` places a sensor in a body: the IMU is at the known walk's place, the reference may be another
point of the same body.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import known_walk

EPOCH = 1_520_530_308_181_901_469
IMU_HEADER = ["#timestamp [ns]", *(f"w_RS_S_{axis} [rad s^-1]" for axis in "xyz")]
IMU_HEADER += [f"a_RS_S_{axis} [m s^-2]" for axis in "xyz"]
POSE_HEADER = ["#timestamp", *(f" p_RS_R_{axis} [m]" for axis in "xyz")]
POSE_HEADER += [f" q_RS_{axis} []" for axis in "wxyz"]
MORE = ("v_RS_R", "m s^-1"), ("b_w_RS_S", "rad s^-1"), ("b_a_RS_S", "m s^-2")
LONG_HEADER = [*POSE_HEADER, *(f" {name}_{axis} [{unit}]" for name, unit in MORE for axis in "xyz")]
SHORT_HEADER = "#time(ns) px py pz qw qx qy qz vx vy vz bwx bwy bwz bax bay baz".split()


class Mount(NamedTuple):
    """T_BS."""

    rotation: Rotation = Rotation.identity()
    translation: np.ndarray = np.zeros(3)


def mount(axes, degrees, translation):
    return Mount(Rotation.from_euler(axes, degrees, degrees=True), np.array(translation))


def write_table(path, header, time, values, style="%.9f", shuffle=False, spoil=None):
    """`spoil(stamps, values) -> (stamps, values)` may damage the rows."""
    stamps = EPOCH + np.round(time * 1e9).astype(np.int64)
    if spoil:
        stamps, values = spoil(stamps, values)
    columns = np.arange(len(header))
    if shuffle:
        columns = np.random.default_rng(3).permutation(len(header))
        header = [header[i].strip().lstrip("#") for i in columns]
        header[0] = "#" + header[0]
    styles = ",".join("%s" if i == 0 else style for i in columns)
    cells = zip(stamps.tolist(), *values.T.tolist(), strict=True)
    text = [",".join(header), *(styles % tuple(row[i] for i in columns) for row in cells)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(text) + "\n")


def write_yaml(path, mount, opencv=False):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = mount.rotation.as_matrix(), mount.translation
    head = "%YAML:1.0\n---\n" if opencv else "#Default imu sensor yaml file\n"
    tag = " !!opencv-matrix" if opencv else ""
    fields = f"sensor_type: imu\n\nT_BS:{tag}\n  cols: 4\n  rows: 4\n"
    path.write_text(f"{head}{fields}  data: {matrix.ravel().tolist()}\nrate_hz: 200\n")


def write_imu(mav, seconds=12.0, step=0.005, bias=0.0, shuffle=False):
    time = np.arange(round(seconds / step)) * step
    values = np.concatenate([known_walk.rate(time) + bias, known_walk.force(time)], axis=1)
    write_table(mav / "imu0" / "data.csv", IMU_HEADER, time, values, shuffle=shuffle)


def poses(time, mount, imu_mount):
    """(position, attitude, velocity) of the reference's sensor: world ← IMU ← body ← sensor."""
    attitude = known_walk.attitude(time)
    turn = imu_mount.rotation.inv() * mount.rotation
    lever = imu_mount.rotation.inv().apply(mount.translation - imu_mount.translation)
    swing = attitude.apply(np.cross(known_walk.rate(time), lever))
    position = known_walk.position(time) + attitude.apply(lever)
    return position, attitude * turn, known_walk.velocity(time) + swing


def write_estimate(
    mav, first=1.0, last=11.0, step=0.005, header=LONG_HEADER, mount=None, imu_mount=None, **options
):
    """state_groundtruth_estimate0, at stamps of its own; `options` as of `write_table`."""
    time = np.arange(first + 0.0013, last, step)
    position, attitude, speed = poses(time, mount or Mount(), imu_mount or Mount())
    biases = np.full((len(time), 6), 0.07)
    values = np.concatenate([position, attitude.as_quat(scalar_first=True), speed, biases], axis=1)
    folder = mav / "state_groundtruth_estimate0"
    write_table(folder / "data.csv", header, time, values, **options)
    if mount is not None:
        write_yaml(folder / "sensor.yaml", mount)


def write_mocap(mav, first=1.0, last=11.0, gaps=(), noise=0.0, flips=(), mount=None, spoil=None):
    """mocap0 at 120 Hz: nothing within `gaps` (s), flips of single poses; `noise` 1 is 0.1° and 0.4
    mm."""
    random = np.random.default_rng(11)
    time = np.arange(first, last, 1 / 120.0)
    position, attitude, _ = poses(time, mount or Mount(), Mount())
    shaken = noise * random.normal(0, np.radians(0.1), (len(time), 3))
    attitude = attitude * Rotation.from_rotvec(shaken)
    position = position + noise * random.normal(0, 4e-4, position.shape)
    for when in flips:
        row = int(np.argmin(np.abs(time - when)))
        attitude[row] = attitude[row] * Rotation.from_euler("x", 120, degrees=True)
        position[row] += 0.3
    sign = np.where(np.arange(len(time)) % 50 < 25, 1.0, -1.0)[:, None]  # q and −q are one rotation
    values = np.concatenate([position, attitude.as_quat(scalar_first=True) * sign], axis=1)
    keep = np.all([(time <= start) | (time >= end) for start, end in ((0, 0), *gaps)], axis=0)
    path = mav / "mocap0" / "data.csv"
    write_table(path, POSE_HEADER, time[keep], values[keep], "%.10f", spoil=spoil)
    if mount is not None:
        write_yaml(mav / "mocap0" / "sensor.yaml", mount, opencv=True)
