"""Files in IDOL's layout."""

from __future__ import annotations

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
    rig = tilt * walk.attitude(then) * mount.inv()
    blocks = {
        "index": np.arange(len(time)),
        "timestamp": EPOCH + time,
        "orient": np.roll(rig.as_quat(), 1, axis=1),
        "processedPos": tilt.apply(walk.position(then)),
        "iphoneOrient": np.roll(
            (Rotation.from_euler("z", 0.9) * walk.attitude(time)).as_quat(), 1, axis=1
        ),
        "iphoneAcc": -walk.force(time) / 9.80665,
        "iphoneGyro": walk.rate(time) + BIAS,
        "iphoneMag": np.full((len(time), 3), 30.0),
        "stencilAcc": mount.apply(walk.force(then)),
        "stencilGyro": mount.apply(walk.rate(then)),
    }
    columns = {}
    for name, values in blocks.items():
        if values.ndim == 1:
            columns[name] = values
        else:
            columns |= {
                name + axis: column
                for axis, column in zip(
                    "WXYZ" if values.shape[1] == 4 else "XYZ", values.T, strict=True
                )
            }
    return pd.DataFrame(columns)


def write(root, table, place="building1/known", number=3, subject=7):
    folder = root / place
    folder.mkdir(parents=True, exist_ok=True)
    table.reset_index(drop=True).to_feather(folder / f"{number}.feather")
    about = folder / "metadata.json"
    entries = json.loads(about.read_text()) if about.exists() else {}
    about.write_text(
        json.dumps(entries | {str(number): {"subjectID": subject, "calibration": "start"}})
    )
    return folder / f"{number}.feather"
