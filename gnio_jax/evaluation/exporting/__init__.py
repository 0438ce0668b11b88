"""Trajectories in the formats of other programs.

- `tum`: `t x y z qx qy qz qw`, as `gnio evaluate` writes it (evo).
- `csv`: with the columns of our own dataset `csv`.
- `mcap`: `nav_msgs/Odometry`, `nav_msgs/Path` and TF for Foxglove and ROS 2 (`ros`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from gnio_jax.errors import InputError, require_packages
from gnio_jax.evaluation.exporting.ros import check_stamps, write_mcap
from gnio_jax.evaluation.trajectory import Trajectory, write_tum
from gnio_jax.files import replacing

SUFFIXES = {
    ".tum": "tum",
    ".txt": "tum",
    ".csv": "csv",
    ".mcap": "mcap",
}
FORMATS = tuple(dict.fromkeys(SUFFIXES.values()))


def export(
    path: Path,
    trajectory: Trajectory,
    kind: str | None = None,
    covariance: Float[np.ndarray, "n 3 3"] | None = None,
) -> int:
    """Write a trajectory, whole or not at all, and return its number of poses.

    Rows that are not finite are left out. `kind` is one of `FORMATS`; None takes that of the
    suffix. `covariance` is that of the positions, m², an `Estimate.position_covariance` (mcap).
    Raises `InputError`.
    """
    kind = kind or SUFFIXES.get(path.suffix.lower())
    if kind not in FORMATS:
        raise InputError(path, "its name tells no format", f"known: {', '.join(SUFFIXES)}")
    known = trajectory.known & np.isfinite(trajectory.time)
    if not known.any():
        raise InputError(path, "the trajectory has no pose", "evaluate the recording again")
    poses = Trajectory(*(field[known] for field in trajectory))
    check_format(path, kind)
    if kind == "mcap":
        check_stamps(path, poses)
    with replacing(path) as temporary:
        match kind:
            case "tum":
                write_tum(temporary, poses)
            case "csv":
                _write_csv(temporary, poses)
            case _:
                write_mcap(temporary, poses, None if covariance is None else covariance[known])
    return len(poses.time)


def check_format(where: object, kind: str) -> None:
    """Raise `InputError` for a format whose packages are missing."""
    if kind == "mcap":
        require_packages(where, "bags", "mcap", "rosbags")


def _write_csv(path: Path, poses: Trajectory) -> None:
    rows = np.column_stack([poses.time, poses.position, poses.orientation])
    names = "time,px,py,pz,qw,qx,qy,qz"
    np.savetxt(path, rows, fmt="%.9f", delimiter=",", header=names, comments="")
