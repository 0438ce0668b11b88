"""How long the training of a table's rows will take, by a measured step of each."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp

from gnio_jax import models, parallel
from gnio_jax.config import TrainConfig
from gnio_jax.reporting import Reporter, Silence
from gnio_jax.tables.experiments import TableRow
from gnio_jax.tables.runs import finished_epochs, unfinished_runs
from gnio_jax.training import loop
from gnio_jax.training.recordings import set_up

STEPS = 3
"""Steps that are timed, after one that compiles the program."""


def announce(rows: Sequence[TableRow], out: Path, seeds: int, reporter: Reporter) -> float | None:
    """Say how long the epochs that are not trained yet will take, and return it in s; None if there
    is nothing to estimate. Rows that are fitted without steps are named without a time."""
    unfinished, texts, total = [], [], 0.0
    for row in rows:
        runs = unfinished_runs(row, out, seeds)
        epochs = [finished_epochs(Path(run.workdir or "")) for run in runs]
        if runs:
            unfinished.append((row, len(runs) - sum(epochs) / row.config.optim.epochs))
    if not unfinished:
        return None
    for number, (row, remaining_runs) in enumerate(unfinished):
        reporter.progress("timing a step of each network", number / len(unfinished))
        if models.trained_by(models.from_experiment(row.config)) != "gradient":
            texts.append(f"{row.label} without steps")
            continue
        seconds = remaining_runs * training_seconds(row.config)
        total += seconds
        texts.append(f"{row.label} {spell(seconds)}")
    reporter.line(
        f"training will take about {spell(total)} ({', '.join(texts)}), by {STEPS} measured steps "
        "of each network, without calibration and evaluation"
    )
    return total


def training_seconds(config: TrainConfig) -> float:
    """Time for all steps of one run, s, by a few of them after the program is compiled."""
    with jax.enable_x64(False), parallel.sharing(None):
        task, data = set_up(loop.choose_task(config), config, Silence())
        keys = jax.random.split(jax.random.key(config.seed), 3)
        state = parallel.copy_to_devices(task.initial_state(keys[0], None))
        order, factor = task.order(keys[1], 0, data.source), jnp.float32(1.0)
        steps = min(STEPS, task.steps_per_epoch)
        duration = 0.0
        for count in (1, steps):
            begun = time.perf_counter()
            arguments = order, jnp.int32(0), jnp.int32(count), factor, keys[2]
            state, sums = task.take_steps(state, data.source, *arguments)
            jax.block_until_ready(sums)
            duration = time.perf_counter() - begun
    return duration / steps * task.steps_per_epoch * config.optim.epochs


def spell(seconds: float) -> str:
    """A duration in words: 40 s, 12 min, 3 h 20 min."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 120:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"
