"""Velocities of phone recordings."""

from __future__ import annotations

import numpy as np

from gnio_jax.data.reference import smooth_positions
from gnio_jax.numerics import within
from gnio_jax.types import Sequence

JUMP_SPEED = 6.0
"""m/s: faster than this not a person walks but a visual odometry that relocalises."""


def with_velocity(sequence: Sequence) -> Sequence:
    """`sequence` (on a uniform clock) with the velocity of its smoothed positions; around jumps of
    these it is no longer valid."""
    step = float(np.median(np.diff(sequence.time)))
    fast = np.linalg.norm(np.diff(sequence.position, axis=0), axis=1) > JUMP_SPEED * step
    jumps = np.concatenate([fast, [False]]) | np.concatenate([[False], fast])
    good = sequence.valid & ~within(jumps, max(round(0.1 / step), 1))
    _, velocity, _ = smooth_positions(sequence.position, good, step)
    return sequence._replace(velocity=velocity, valid=good)
