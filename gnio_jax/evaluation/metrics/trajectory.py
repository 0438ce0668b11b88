"""Trajectories and the rows of them that count.

Positions are (n, d) arrays in metres, rows a constant `step` (s) apart, d = 3 or, for the
horizontal metrics, 2. A row of the reference that cannot be trusted is NaN and counts nowhere, nor
does a displacement that starts or ends there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gnio_jax.numerics import finite_rows

Positions = Float[np.ndarray, "n d"]
Quaternions = Float[np.ndarray, "n 4"]


class Undefined(ValueError):
    """The metric has no value for this trajectory; the text is the reason."""


class Trajectory(NamedTuple):
    """Poses at uniform times. A row without a trusted pose is NaN."""

    time: Float[np.ndarray, "n"]
    """Stamps, s."""
    position: Float[np.ndarray, "n 3"]
    """In the world (z up), m."""
    orientation: Quaternions
    """Body→world, unit quaternion wxyz."""


def finite_poses(trajectory: Trajectory) -> Bool[np.ndarray, "n"]:
    """Rows with a finite position and a finite orientation."""
    return finite_rows(trajectory.position) & finite_rows(trajectory.orientation)


def trusted_errors(estimate: Positions, reference: Positions) -> Float[np.ndarray, "m d"]:
    """p̂ − p of the trusted rows, m. Raises `Undefined` without one."""
    trusted = finite_rows(reference)
    if not trusted.any():
        raise Undefined("no trusted reference")
    return (estimate - reference)[trusted]


def trusted_pairs(reference: Positions, rows_apart: int) -> Bool[np.ndarray, "m"]:
    """Whether both ends of the displacement from each row to `rows_apart` later are trusted."""
    trusted = finite_rows(reference)
    return trusted[rows_apart:] & trusted[:-rows_apart]


def rms(errors: Float[np.ndarray, "m d"], counted: Bool[np.ndarray, "m"], reason: str) -> float:
    """Root mean square norm of the counted errors. Raises `Undefined(reason)` without one."""
    if not counted.any():
        raise Undefined(reason)
    return float(np.sqrt(np.mean(np.sum(errors[counted] ** 2, 1))))
