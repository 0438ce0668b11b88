"""Trajectories out of recordings, their errors, and the reports about them.

The way through, a file each: `setup` (the choices) → `preparation` (sequences cut and started) →
`inference` (the network's displacements) → `estimation` (trajectories) → `scores` (metrics) →
`report`, `table`, `plots`. `run` walks it.
"""

from gnio_jax.evaluation.estimation import estimate, never_moves, perfect_displacements
from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.inference import (
    Network,
    attitude,
    inference_network,
    predict_windows,
    true_displacements,
)
from gnio_jax.evaluation.metrics import Measures, measure
from gnio_jax.evaluation.preparation import Prepared, prepare
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.report import read as load
from gnio_jax.evaluation.run import Evaluation, evaluate
from gnio_jax.evaluation.scores import score
from gnio_jax.evaluation.setup import Setup, resolve
from gnio_jax.evaluation.trajectory import Trajectory, Undefined, align
from gnio_jax.filtering.settings import FilterSetup, filter_setup

__all__ = [
    "Estimate",
    "Evaluation",
    "FilterSetup",
    "Measures",
    "Network",
    "Prepared",
    "Report",
    "Setup",
    "Trajectory",
    "Undefined",
    "align",
    "attitude",
    "estimate",
    "evaluate",
    "filter_setup",
    "inference_network",
    "load",
    "measure",
    "never_moves",
    "perfect_displacements",
    "predict_windows",
    "prepare",
    "resolve",
    "score",
    "true_displacements",
]
