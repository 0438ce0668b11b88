"""Writes the known walk in PedLocData's layout: slices in the groups of one HDF5 file."""

import h5py
import numpy as np

from tests.support import known_walk

RATE, START = 100.0, 1700000000.0
SLICE = "train/lab07_003"


def write(root, slices=(SLICE,), seconds=known_walk.SECONDS, unit=1.0, change=None):
    """`root`/pedloc.h5 with these slices of the same walk; stamps in `unit` s. `change(fields)` may
    damage the fields of each."""
    root.mkdir(parents=True, exist_ok=True)
    time = np.arange(round(seconds * RATE)) / RATE
    stamps = (START + time) / unit
    with h5py.File(root / "pedloc.h5", "w") as file:
        for name in slices:
            fields = {
                "ts": np.round(stamps).astype(np.int64) if unit < 1e-2 else stamps,
                "acc": known_walk.force(time),
                "gyr": known_walk.rate(time),
                "pos": known_walk.position(time),
                "qua": known_walk.attitude(time).as_quat(scalar_first=True),
            }
            if change is not None:
                change(fields)
            for field, values in fields.items():
                file[f"{name}/{field}"] = values
    return root / "pedloc.h5"
