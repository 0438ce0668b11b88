"""Trajectories in TUM format, which evo reads.

A line is `t x y z qx qy qz qw`, in s and m, body→world.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gnio_jax.evaluation.metrics import Trajectory


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory; rows that are not finite are left out."""
    xyzw = trajectory.orientation[:, [1, 2, 3, 0]]
    rows = np.column_stack([trajectory.time, trajectory.position, xyzw])
    np.savetxt(path, rows[np.isfinite(rows).all(1)], fmt="%.9f", header="t x y z qx qy qz qw")


def read_tum(path: Path) -> Trajectory:
    """Read what `write_tum` wrote."""
    rows = np.loadtxt(path, ndmin=2)
    return Trajectory(rows[:, 0], rows[:, 1:4], rows[:, [7, 4, 5, 6]])
