"""Files in Blackbird's layout."""

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import known_walk

START = 1_525_745_865.0016553

FLIP = np.diag([1.0, -1.0, -1.0])  # forward-left-up to forward-right-down, and z-up to z-down


def write(folder, down=False, text=11, spoil=None, seconds=12.0):
    """One flight: body front-right-down, world z-up or z-down; the text beside it has `text`
    columns (0: none)."""
    time = np.arange(round(seconds * 100)) / 100
    body = known_walk.attitude(time).as_matrix() @ FLIP
    position, speed = known_walk.position(time), known_walk.velocity(time)
    if down:
        body, position, speed = FLIP @ body, position @ FLIP, speed @ FLIP
    pose = np.concatenate([position, Rotation.from_matrix(body).as_quat()], axis=1)
    gyro, accel = known_walk.rate(time) @ FLIP, known_walk.force(time) @ FLIP
    bias = np.array([0.01, -0.02, 0.005])
    fields = {"ts": START + time, "gyro_calib": gyro, "accel_calib": accel, "traj_target": pose}
    fields |= {"gyro_raw": gyro + bias, "accel_raw": accel + bias, "thrust": 0 * gyro}
    fields |= {"gyro_bias": bias, "accel_bias": bias}
    if spoil:
        spoil(fields)
    folder.mkdir(parents=True, exist_ok=True)
    with h5py.File(folder / "data.hdf5", "w") as file:
        for name, values in fields.items():
            file.create_dataset(name, data=values)
    if text:
        table = np.concatenate([(START + time)[:, None], pose, speed], axis=1)[:, :text]
        style = " ".join(["%.12f"] * text)
        rows = ["# ts x y z qx qy qz qw", *(style % tuple(row) for row in table.tolist())]
        (folder / "stamped_groundtruth_imu.txt").write_text("\n".join(rows) + "\n")
    return folder
