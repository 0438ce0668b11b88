"""Errors of a trajectory, each under a name that says which of the field's definitions it is.

A metric without a value (no reference, too short, never standing) raises `Undefined` with the
reason; `measure` turns that into None and keeps the reason. An estimate that is not finite has
diverged: its errors are infinite, which is not the same as no value, and no summary leaves them out
in silence. Everything is NumPy in float64 and pure.
"""

from gnio_jax.evaluation.metrics.absolute import ate, ate_mean, ate_ronin, drift
from gnio_jax.evaluation.metrics.alignment import AlignmentMethod, align
from gnio_jax.evaluation.metrics.consistency import (
    coverage,
    mean_normalised,
    normalised_squared,
    position_nees,
)
from gnio_jax.evaluation.metrics.heading import relative_yaw, yaw_drift, yaw_rmse
from gnio_jax.evaluation.metrics.measures import NAMES, Measures, diverged, is_infinite, measure
from gnio_jax.evaluation.metrics.movement import (
    path_length,
    path_length_ratio,
    standing,
    stationary_drift,
)
from gnio_jax.evaluation.metrics.relative import rpe, rpe_se3, rte, rte_distance, rte_ronin
from gnio_jax.evaluation.metrics.summary import Summary, summarise
from gnio_jax.evaluation.metrics.trajectory import Trajectory, Undefined

__all__ = [
    "NAMES",
    "AlignmentMethod",
    "Measures",
    "Summary",
    "Trajectory",
    "Undefined",
    "align",
    "ate",
    "ate_mean",
    "ate_ronin",
    "coverage",
    "diverged",
    "drift",
    "is_infinite",
    "mean_normalised",
    "measure",
    "normalised_squared",
    "path_length",
    "path_length_ratio",
    "position_nees",
    "relative_yaw",
    "rpe",
    "rpe_se3",
    "rte",
    "rte_distance",
    "rte_ronin",
    "standing",
    "stationary_drift",
    "summarise",
    "yaw_drift",
    "yaw_rmse",
]
