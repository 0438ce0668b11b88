"""Files in IDOL's layout."""

import json

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from tests.support import known_walk as walk

EPOCH = 1_583_090_000.25

BIAS = np.array([0.012, -0.016, 0.009])

RIG_OF_PHONE = Rotation.from_rotvec([-0.01853, 0.02801, 3.12916])

TILT = Rotation.from_rotvec(np.radians(6.0) * np.array([0.8, -0.6, 0.0]))
"""Level world → the map's."""


def frame(seconds=walk.SECONDS, lag=0.0, tilt=TILT, mount=RIG_OF_PHONE, start=0.0):
    """The table of a walk: the phone's columns at its stamps, the rig's late by `lag` and in the
    map's world."""
    time = start + np.arange(round(seconds * 100)) / 100
    then = time - lag
    phone = Rotation.from_euler("z", 0.9) * walk.attitude(time)
    rig = tilt * walk.attitude(then) * mount.inv()
    blocks = {
        "orient": rig.as_quat(scalar_first=True),
        "processedPos": tilt.apply(walk.position(then)),
        "iphoneOrient": phone.as_quat(scalar_first=True),
        "iphoneAcc": -walk.force(time) / 9.80665,
        "iphoneGyro": walk.rate(time) + BIAS,
        "iphoneMag": np.full((len(time), 3), 30.0),
        "stencilAcc": mount.apply(walk.force(then)),
        "stencilGyro": mount.apply(walk.rate(then)),
    }
    columns = {"index": np.arange(len(time)), "timestamp": EPOCH + time}
    for name, values in blocks.items():
        axes = "WXYZ" if values.shape[1] == 4 else "XYZ"
        columns |= {name + axis: row for axis, row in zip(axes, values.T, strict=True)}
    return pd.DataFrame(columns)


def write(root, table, subfolder="building1/known", number=3, subject=7):
    folder = root / subfolder
    folder.mkdir(parents=True, exist_ok=True)
    table.reset_index(drop=True).to_feather(folder / f"{number}.feather")
    metadata = folder / "metadata.json"
    entries = json.loads(metadata.read_text()) if metadata.exists() else {}
    metadata.write_text(
        json.dumps(entries | {str(number): {"subjectID": subject, "calibration": "start"}})
    )
    return folder / f"{number}.feather"
