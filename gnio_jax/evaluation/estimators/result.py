"""What every estimator gives."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.types import Array


class Estimate(NamedTuple):
    """A trajectory with what the estimator knows beside it: K + 1 rows for K strides.

    Row k is at the end of stride k, sample k·n after the start. A measurement stands in the row
    where its window ends.
    """

    name: str
    trajectory: Trajectory
    """NaN from where the filter was no longer healthy (`FilterHistory.healthy`): it has diverged.
    """
    reference: Trajectory
    """At the same rows, NaN where it cannot be trusted."""
    displacement: Float[np.ndarray, "k 3"] | None = None
    """Of the window, m, in the yaw frame of its start; NaN where none."""
    displacement_std: Float[np.ndarray, "k 3"] | None = None
    """As the filter uses it, or as the network gives it where there is no filter, m."""
    diagnostics: dict[str, Float[np.ndarray, "k 3"]] = {}
    """The network's `gate` and `scale`, where it has them; NaN where it had no window."""
    velocity: Float[np.ndarray, "k 3"] | None = None
    """m/s."""
    gyro_bias: Float[np.ndarray, "k 3"] | None = None
    """rad/s."""
    accel_bias: Float[np.ndarray, "k 3"] | None = None
    """m/s²."""
    std: Float[np.ndarray, "k 15"] | None = None
    """Standard deviation of the filter's error in θ, v, p, b_g, b_a."""
    position_covariance: Float[np.ndarray, "k 3 3"] | None = None
    """m²."""
    accepted: Float[np.ndarray, "k"] | None = None
    """1 the measurement was used, 0 it was rejected, NaN there was none."""
    nis: Float[np.ndarray, "k"] | None = None
    """Normalised innovation squared; NaN where no measurement."""
    notes: tuple[str, ...] = ()
    """What a reader of the result should know."""


def at_window_ends(values: Float[Array, "m 3"], rows: int) -> Float[np.ndarray, "k 3"]:
    """Values of the last m windows in the last m of `rows`, NaN before."""
    return np.concatenate([np.full((rows - len(values), *values.shape[1:]), np.nan), values])
