"""Made-up results of tables."""

import numpy as np

from gnio_jax.config import ModelConfig, OptimConfig, TrainConfig
from gnio_jax.tables import markdown, summary
from gnio_jax.tables.experiments import Cell, Experiment
from gnio_jax.tables.matrix import Result

BASE = TrainConfig(dataset="tlio", model=ModelConfig(width=4), optim=OptimConfig(epochs=40))
LOST = np.inf
"""An `ate` of an estimate that diverged."""


def result(name, ate, published=None, groups=None):
    """`ate`: (seeds, sequences); the other metrics are the same number. `groups`: of each sequence,
    else each is one."""
    lost = {"ate": None, "undefined": {"ate": "the estimate is not finite from 2.0 s on"}}
    figures = []
    for row in ate:
        sequences = {
            f"s{k}": {"ate": value, "rpe_1s": value} if np.isfinite(value) else dict(lost)
            for k, value in enumerate(row)
        }
        for sequence, group in zip(sequences.values(), groups or sequences, strict=True):
            sequence["group"] = group
        finite = [value for value in row if np.isfinite(value)]
        mean = float(np.mean(finite)) if finite else None
        means = {"ate": mean, "rpe_1s": mean, "stationary_drift": None}
        figures.append({"sequences": sequences, "mean": means})
    return Result(Cell(name, name.upper(), BASE, published), figures, [])


def compared(first, second):
    """The rows of a table of two results, and its text."""
    experiment = Experiment("Title", "source", [first.cell, second.cell])
    found = summary.rows(experiment, [first, second])
    return *found, markdown.render(experiment, found, [])
