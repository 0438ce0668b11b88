"""Files in TLIO's golden layout."""

import json

import numpy as np
from scipy.spatial.transform import Rotation

COLUMNS = ["ts_us(1)", "gyr_compensated_rotated_in_World(3)"]
COLUMNS += ["acc_compensated_rotated_in_World(3)", "qxyzw_World_Device(4)"]
COLUMNS += ["pos_World_Device(3)", "vel_World(3)"]

N, SPEED, TURN = 2400, 1.1, 0.3

TILT = 0.5  # the head looks down: the body's x axis is pitched by this


def body_values():
    """What the IMU of a head that walks a circle measures, in the world, and its pose: time,
    attitude, gyro, accel, position, velocity."""
    time = 1.0 + np.arange(N) / 200
    yaw = TURN * (time - 1.0)
    cosine, sine, zero, one = np.cos(yaw), np.sin(yaw), 0 * yaw, 0 * yaw + 1
    attitude = Rotation.from_euler("z", yaw[:, None]) * Rotation.from_euler("y", TILT)
    gyro = np.stack([zero, zero, TURN * one], 1)
    accel = np.stack([-SPEED * TURN * sine, SPEED * TURN * cosine, 9.81 * one], 1)
    position = SPEED / TURN * np.stack([sine, -cosine, zero], 1)
    velocity = SPEED * np.stack([cosine, sine, zero], 1)
    return time, attitude, gyro, accel, position, velocity


def write_sequence(folder, columns=COLUMNS, spoil=None):
    """One sequence in the layout; `spoil(parts)` may damage the columns by name."""
    time, attitude, *values = body_values()
    names = ["gyr_compensated_rotated_in_World", "acc_compensated_rotated_in_World"]
    parts = dict(zip([*names, "pos_World_Device", "vel_World"], values, strict=True))
    parts |= {"ts_us": np.round(time * 1e6)[:, None], "qxyzw_World_Device": attitude.as_quat()}
    parts["temperature"] = np.full((N, 2), 36.6)
    if spoil:
        spoil(parts)
    folder.mkdir(parents=True)
    table = np.concatenate([parts[name.split("(")[0]] for name in columns], axis=1)
    np.save(folder / "imu0_resampled.npy", table)
    description = json.dumps({"columns_name(width)": columns, "num_rows": N})
    (folder / "imu0_resampled_description.json").write_text(description)
    (folder / "calibration.json").write_text("{}")
    header = "#timestamp [ns], temperature [C], w_RS_S_x [rad s^-1]"
    (folder / "imu_samples_0.csv").write_text(f"{header}\n1000000,30,0.1\n")
    return folder


def spoil(name, rows, value):
    def change(parts):
        parts[name][rows] = value

    return change


def write_splits(root, train="ab", **options):
    """A folder of three short walks: two to train with, one for validation and test."""
    for name in "abc":
        write_sequence(root / name, **options)
    for split, names in {"train": train, "val": "c", "test": "c"}.items():
        (root / f"{split}_list.txt").write_text("".join(f"{name}\n" for name in names))
    return root
