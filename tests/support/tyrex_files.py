"""Files in Tyrex's layout: the known walk, seen as a handle on the phone, at two phones' rates."""

from pathlib import Path

import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from tests.support import known_walk as walk

NEXUS, IPHONE = "Guillaume_Nexus5_Dist_Texting", "Thibaud_iPhone4S_NoDist_RunningHand"
BOOT = 81204.3412
"""s since boot at which an iPhone's record begins."""
OFFSET = -0.9
"""s: the tracker's time minus the record's, as the file has it."""
LAG = 0.02
"""s by which that number is wrong."""
HANDLE = Rotation.from_euler("xyz", [1.5, -2.0, 1.0], degrees=True)
"""Phone → handle."""
LEVER = np.array([0.01, -0.06, -0.008])
"""From the handle's origin to the phone's IMU, in the handle, m."""
BIAS = np.array([0.06, -0.02, 0.01])
"""Of the gyro as it is read, rad/s."""
SYSTEM_BIAS = np.array([0.012, -0.005, 0.07])
"""What Android takes off a gyro's raw rate besides, rad/s."""
LOST = slice(300, 309)
"""Frames in which the handle was not seen."""


def _write(path: Path, columns: list[np.ndarray], style: str) -> None:
    rows = np.column_stack(columns).tolist()
    path.write_text("\n".join(style % tuple(row) for row in rows) + "\n")


def write_phone(folder: Path, seconds: float) -> None:
    """The phone's text, of an iPhone where the folder's name says so. Record time is the walk's."""
    folder.mkdir(parents=True)
    (folder / "timeAlignment.txt").write_text(f"{OFFSET:17.7e}")
    if "iPhone" in folder.name:
        (folder / "description.txt").write_text(f"[Time]\nBootTime = {BOOT}")
        felt, turned = np.arange(-0.04, seconds, 1 / 90.0), np.arange(0.66, seconds, 1 / 107.0)
        force, style = -walk.force(felt) / 9.80665, "%.4f %.6f %.6f %.6f"
        _write(folder / "accelerometer.txt", [BOOT + felt, force], style)
        _write(folder / "gyroscope.txt", [BOOT + turned, walk.rate(turned) + BIAS], style)
        return
    (folder / "record.properties").write_text("[Device]\nModel = Nexus 5\nStartTime = 1464965086")
    felt, turned = np.arange(0.36, seconds, 1 / 200.0), np.arange(0.41, seconds, 1 / 200.0)
    bias = np.tile(SYSTEM_BIAS, (len(turned), 1))
    _write(folder / "accelerometer.txt", [felt, walk.force(felt)], " ".join(["%.9f"] * 4))
    gyro = [turned, walk.rate(turned) + BIAS + bias, bias]
    _write(folder / "gyroscope.txt", gyro, " ".join(["%.9f"] * 7))


def track(seconds: float) -> dict:
    """What the tracker's file holds, under the names of its fields."""
    frame = np.arange(int((seconds - 1.5) * 60))
    time = frame / 60.0 - (OFFSET + LAG)
    phone = walk.attitude(time)
    handle = phone * HANDLE.inv()
    position = walk.position(time) - handle.apply(LEVER)
    matrices = handle.as_matrix().transpose(0, 2, 1).reshape(-1, 9)
    position[LOST], matrices[LOST] = np.nan, np.nan
    bodies = {
        "Name": "Handler",
        "Positions": (1e3 * position.T)[None],
        "Rotations": matrices.T[None],
    }
    return {"File": "C:\\walk.qtm", "FrameRate": 60.0, "RigidBodies": bodies}


def write(root, name=NEXUS, seconds=walk.SECONDS):
    """One walk below `root`; returns its phone's folder."""
    folder = root / "datasets" / ("ios" if "iPhone" in name else "android") / name
    write_phone(folder, seconds)
    path = root / "datasets" / "qualisys" / f"{name}.mat"
    path.parent.mkdir(exist_ok=True)
    savemat(path, {name: track(seconds)}, long_field_names=True)
    return folder
