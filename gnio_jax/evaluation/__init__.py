"""Trajectories from recordings, their errors, and the reports about them.

The stages have a file each: `prepare` (sequences with a start) → `infer` (the network's
displacements) → `estimate` (trajectories) → `metrics` (`score`) → `report` (figures) → `folder`
(files). `evaluate` calls them in this order.
"""

from gnio_jax.evaluation.estimate import SequenceEstimate, States, estimate, never_moves, perfect
from gnio_jax.evaluation.evaluate import Evaluation, evaluate, score_files
from gnio_jax.evaluation.folder import read as load
from gnio_jax.evaluation.infer import (
    Displacements,
    infer,
    no_displacements,
    reference_displacements,
)
from gnio_jax.evaluation.metrics import Filtered, Measures, measure, score
from gnio_jax.evaluation.prepare import PreparedRecording, prepare
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.trajectory import Trajectory, Undefined, align

__all__ = [
    "Displacements",
    "Evaluation",
    "Filtered",
    "Measures",
    "PreparedRecording",
    "Report",
    "SequenceEstimate",
    "States",
    "Trajectory",
    "Undefined",
    "align",
    "estimate",
    "evaluate",
    "infer",
    "load",
    "measure",
    "never_moves",
    "no_displacements",
    "perfect",
    "prepare",
    "reference_displacements",
    "score",
    "score_files",
]
