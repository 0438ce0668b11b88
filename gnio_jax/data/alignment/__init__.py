"""An IMU laid on what a tracker saw of it: clocks, mounting and attitude from one recording.

`body` has poses of a tracked body: where the IMU sits on it, and by how much the clocks differ.
`positions` has positions alone.
"""

from gnio_jax.data.alignment.body import (
    BodyFit,
    PoseLag,
    TooLittle,
    align,
    check_fit,
    pose_lag,
    without_jumps,
)
from gnio_jax.data.alignment.positions import PositionsFit, align_positions

__all__ = [
    "BodyFit",
    "PoseLag",
    "PositionsFit",
    "TooLittle",
    "align",
    "align_positions",
    "check_fit",
    "pose_lag",
    "without_jumps",
]
