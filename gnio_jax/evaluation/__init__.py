"""Trajectories out of recordings, their errors, and the reports about them."""

from gnio_jax.evaluation.metrics import (
    Measures,
    Summary,
    Trajectory,
    Undefined,
    align,
    measure,
    summarise,
)
from gnio_jax.evaluation.odometry import (
    Estimate,
    Network,
    Recording,
    Setup,
    estimate,
    never_moves,
    perfect_displacements,
    prepare,
)
from gnio_jax.evaluation.report import Report, Scores, score
from gnio_jax.evaluation.run import Evaluation, evaluate

__all__ = [
    "Estimate",
    "Evaluation",
    "Measures",
    "Network",
    "Recording",
    "Report",
    "Scores",
    "Setup",
    "Summary",
    "Trajectory",
    "Undefined",
    "align",
    "estimate",
    "evaluate",
    "measure",
    "never_moves",
    "perfect_displacements",
    "prepare",
    "score",
    "summarise",
]
