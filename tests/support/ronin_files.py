"""Files in RoNIN's layout."""

import json

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import known_walk as walk

BIAS, FORCE_BIAS = [0.0056, 0.0092, -0.0102], [-0.157, -0.026, 0.057]
SCALE = [0.9988, 0.9971, 0.9933]

FIRST = 3610.94

GAME_YAW, EKF_YAW = Rotation.from_euler("z", 2.1), Rotation.from_euler("z", -0.4)


def wxyz(rotation):
    return rotation.as_quat(scalar_first=True)


def chest(time):
    """Attitude of the device on the chest: upright, facing where the walker goes, and never as the
    phone is."""
    velocity = walk.velocity(time)
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    return Rotation.from_euler("ZX", np.stack([heading, np.full(len(time), 1.4)], axis=1))


def drifting(time, degrees, end):
    """A turn about the world's z that grows to `degrees` at the time `end`: what a filter without a
    compass does."""
    return Rotation.from_rotvec(np.radians(degrees) * time[:, None] / end * [0.0, 0.0, 1.0])


def write(
    folder, seconds=36.0, start_frame=600, drifts=(4.0, 7.0), errors=None, ekf=True, spoil=None
):
    """`data.hdf5` and `info.json`; game rotation vector and EKF drift by `drifts`, degrees of yaw.
    `spoil(fields, info)` may damage what is in them."""
    time = np.arange(round(seconds * 200)) / 200
    phone = walk.attitude(time)
    # The phone's place on the chest is known for the first row alone.
    start_calibration = wxyz(chest(time[:1]).inv() * phone[:1])[0]
    fields = {
        "synced/time": FIRST + time,
        "synced/gyro": walk.rate(time) + 0.003,  # as the phone compensated it, which is not used
        "synced/gyro_uncalib": walk.rate(time) + BIAS,
        "synced/acce": walk.force(time) / SCALE + FORCE_BIAS,
        "synced/magnet": np.full((len(time), 3), 30.0),
        "synced/rv": wxyz(Rotation.from_euler("z", 0.2) * phone),
        "synced/game_rv": wxyz(GAME_YAW * drifting(time, drifts[0], time[-1]) * phone),
        "pose/tango_pos": walk.position(time),
        "pose/tango_ori": wxyz(chest(time)),
    }
    if ekf:
        fields["pose/ekf_ori"] = wxyz(EKF_YAW * drifting(time, drifts[1], time[-1]) * phone)
    info = {
        "device": "asus4",
        "imu_init_gyro_bias": BIAS,
        "imu_acce_bias": FORCE_BIAS,
        "imu_acce_scale": SCALE,
        "imu_end_gyro_bias": [0.1, 0.1, 0.1],
        "start_calibration": list(start_calibration),
    }
    kinds = ("gyro_integration_error", "grv_ori_error", "ekf_ori_error")
    info |= dict(zip(kinds, errors or (30.0, *drifts), strict=True))
    if start_frame is not None:
        info["start_frame"] = start_frame
    if spoil:
        spoil(fields, info)
    folder.mkdir(parents=True)
    with h5py.File(folder / "data.hdf5", "w") as file:
        for name, values in fields.items():
            file.create_dataset(name, data=values)
    (folder / "info.json").write_text(json.dumps(info))
    return folder
