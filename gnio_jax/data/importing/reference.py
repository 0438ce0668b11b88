"""A reference trajectory on the clock of an imported IMU."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gnio_jax.data.importing.source import Track
from gnio_jax.data.parsing.stamps import in_order
from gnio_jax.data.reference import SHORTEST_RUN, Poses, reference_at
from gnio_jax.data.validation import check_motion, check_unit_norm, validate
from gnio_jax.errors import InputError
from gnio_jax.numerics import finite_rows, rotations
from gnio_jax.types import Sequence

FAST_TRACKER = 20.0
"""Hz from which a tracker's noise is smoothed and the gyro carries its attitude; below it its poses
are taken as they are (ours)."""
SLOWEST = 4.0
"""Hz below which a reference says too little of a walk (ours)."""
SHORTEST_OVERLAP = 1.0
"""s that IMU and reference must share."""


def poses_of(
    time: Float[np.ndarray, " n"], pose: Float[np.ndarray, "n 7"], source: object
) -> Poses:
    """Poses from stamps (s) and rows of position (m) and quaternion wxyz, in any order.

    Rows that are not finite are left out, of rows that share a stamp the first counts. Raises
    `InputError` where they are too few, too slow, or no unit quaternions.
    """
    seen = finite_rows(pose)
    time, pose = time[seen], pose[seen]
    rows, _ = in_order(time, pose, source)
    time, pose = time[rows], pose[rows]
    if len(time) < SHORTEST_RUN:
        raise InputError(source, f"holds {len(time)} poses", "name another reference")
    rate = 1.0 / float(np.median(np.diff(time)))
    if rate < SLOWEST:
        raise InputError(
            source, f"its poses come at {rate:.3g} Hz", f"a reference needs {SLOWEST:g} Hz"
        )
    everywhere = np.ones(len(time), dtype=bool)
    wxyz = check_unit_norm(pose[:, 3:], everywhere, "orientation", source)
    return Poses(time, rotations(wxyz), pose[:, :3], noisy=rate >= FAST_TRACKER)


def with_reference(sequence: Sequence, start: float, track: Track) -> Sequence:
    """`sequence`, on a uniform clock that begins at the stamp `start` (s), with the track as its
    reference; NaN and not valid where there is none.

    The poses are laid on the clock as those of the data sets are (`data.reference`). Raises
    `InputError` where both hardly overlap, or the reference moves as nothing does.
    """
    poses = track.poses._replace(time=track.poses.time + (track.start - start))
    _check_overlap(sequence.time - sequence.time[0], poses, track)
    found = reference_at(sequence.time - sequence.time[0], sequence.gyro, poses)
    if not found.valid.any():
        raise InputError(
            track.path,
            f"the reference {track.name} can be trusted nowhere while the IMU was recorded",
            "look for its gaps, and whether its velocity is that of its position",
        )
    known = found.valid[:, None]
    result = sequence._replace(
        orientation=np.where(known, found.orientation, np.nan),
        position=np.where(known, found.position, np.nan),
        velocity=np.where(known, found.velocity, np.nan),
        valid=found.valid,
        attributes=sequence.attributes | {"truth": track.name},
    )
    check_motion(result, track.path)
    return validate(result, track.path)


def _check_overlap(clock: np.ndarray, poses: Poses, track: Track) -> None:
    first, last = poses.time[0], poses.time[-1]
    if min(last, clock[-1]) - max(first, 0.0) < SHORTEST_OVERLAP:
        raise InputError(
            track.path,
            f"the reference {track.name} ({first:.1f} to {last:.1f} s after the IMU's start) does "
            f"not overlap the IMU (0 to {clock[-1]:.1f} s)",
            "both must be stamped by one clock",
        )
