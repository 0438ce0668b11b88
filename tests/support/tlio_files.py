"""Files in TLIO's golden layout."""

import json

import numpy as np

COLUMNS = [
    "ts_us(1)",
    "gyr_compensated_rotated_in_World(3)",
    "acc_compensated_rotated_in_World(3)",
    "qxyzw_World_Device(4)",
    "pos_World_Device(3)",
    "vel_World(3)",
]

N, SPEED, TURN = 2400, 1.1, 0.3

TILT = 0.5  # the head looks down: the body's x axis is pitched by this


def body_values():
    """What the IMU of a head that walks a circle measures, in the body frame, and its pose."""
    time = 1.0 + np.arange(N) / 200
    yaw = TURN * (time - 1.0)
    cosine, sine, zero, one = np.cos(yaw), np.sin(yaw), 0 * yaw, 0 * yaw + 1
    turn = np.stack(
        [
            np.stack([cosine, -sine, zero], -1),
            np.stack([sine, cosine, zero], -1),
            np.stack([zero, zero, one], -1),
        ],
        1,
    )
    pitch = np.array([[np.cos(TILT), 0, np.sin(TILT)], [0, 1, 0], [-np.sin(TILT), 0, np.cos(TILT)]])
    rotation = turn @ pitch
    half = np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], 1)
    c, s = np.cos(TILT / 2), np.sin(TILT / 2)
    wxyz = np.stack([half[:, 0] * c, -half[:, 3] * s, half[:, 0] * s, half[:, 3] * c], 1)
    gyro_world = np.stack([zero, zero, TURN * one], 1)
    accel_world = np.stack([-SPEED * TURN * sine, SPEED * TURN * cosine, 9.81 * one], 1)
    position = SPEED / TURN * np.stack([sine, -cosine, zero], 1)
    velocity = SPEED * np.stack([cosine, sine, zero], 1)
    return time, rotation, wxyz, gyro_world, accel_world, position, velocity


def write_sequence(folder, columns=COLUMNS, spoil=None, dtype=np.float64):
    """One sequence in the layout; `spoil(parts)` may damage the columns by name."""
    time, _, wxyz, gyro, accel, position, velocity = body_values()
    parts = {
        "ts_us": np.round(time * 1e6)[:, None],
        "gyr_compensated_rotated_in_World": gyro,
        "acc_compensated_rotated_in_World": accel,
        "qxyzw_World_Device": wxyz[:, [1, 2, 3, 0]],
        "pos_World_Device": position,
        "vel_World": velocity,
        "temperature": np.full((N, 2), 36.6),
    }
    if spoil:
        spoil(parts)
    folder.mkdir(parents=True)
    np.save(
        folder / "imu0_resampled.npy",
        np.concatenate([parts[name.split("(")[0]] for name in columns], axis=1).astype(dtype),
    )
    (folder / "imu0_resampled_description.json").write_text(
        json.dumps({"columns_name(width)": columns, "num_rows": N})
    )
    (folder / "calibration.json").write_text("{}")
    (folder / "imu_samples_0.csv").write_text(
        "#timestamp [ns], temperature [C], w_RS_S_x [rad s^-1]\n1000000,30,0.1\n"
    )
    return folder


def spoil(name, rows, value):
    def change(parts):
        parts[name][rows] = value

    return change


def write_splits(root):
    """A folder of three short walks: two to train with, one for validation and test."""
    for name in "abc":
        write_sequence(root / name)
    (root / "train_list.txt").write_text("a\nb\n")
    for split in ("val", "test"):
        (root / f"{split}_list.txt").write_text("c\n")
    return root
