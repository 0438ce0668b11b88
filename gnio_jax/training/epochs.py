"""Where a run stands, step by step and epoch by epoch, and what the log and the console say of it.

Pure functions: the loop asks them after each dispatch and after each validation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from gnio_jax.training import optimizer
from gnio_jax.training.optimizer import Plateau
from gnio_jax.training.task import Progress, Row, Task

NO_GRADIENT = 1e-9
"""Norm of a gradient, mean of an epoch, of which Adam, whose ε is 1e-8, makes next to no step."""


class Position(NamedTuple):
    """Where a run stands besides its `TrainState`: kept as JSON with the checkpoint."""

    epoch: int = 0
    """Epoch in progress, or finished if `step` is a multiple of the steps per epoch."""
    step: int = 0
    best: float | None = None
    """Smallest value on the validation split, since the last switch of what is trained, of what
    `optim.best_by` names."""
    sums: dict[str, float] = {}
    """Figures summed over the steps of the epoch in progress (`task.Progress`)."""
    seconds: float = 0.0
    """Time spent training so far."""
    plateau: Plateau = Plateau()


class Finished(NamedTuple):
    """An epoch with its validation."""

    row: Row
    """The log's: means of training, as its steps met them, and the figures of validation."""
    improved: bool
    """Whether it is the best one so far."""
    at: Position
    """Where the next one starts."""


def after_steps(at: Position, count: int, progress: Progress, workdir: Path) -> Position:
    """Where the run in `workdir` stands after `count` more steps. Raises `FloatingPointError` where
    one of them failed."""
    if progress.failed_step >= 0:
        raise FloatingPointError(
            f"{workdir}: the loss or its gradient is not finite at step "
            f"{int(progress.failed_step)} (epoch {at.epoch}); lower optim.learning_rate, set "
            "optim.clip_norm, or look at the data"
        )
    sums = {name: at.sums.get(name, 0.0) + float(more) for name, more in progress.sums.items()}
    return at._replace(step=at.step + count, sums=sums)


def finish(at: Position, task: Task, validation: Row, rate: float) -> Finished:
    """The epoch that ends at `at`, trained at `rate` windows or segments per second.

    The choice of the best begins anew with the epoch that changes what is trained, and again with
    the first whole one after it: losses before and after do not compare, and what has just begun to
    learn has learnt little. NaN and infinity are never the best.
    """
    optim, means = task.config.optim, mean_figures(at.sums, task.steps_per_epoch)
    norms = {name: means.pop(name) for name in at.sums if name.startswith("gradient_norm/")}
    row: Row = {
        "epoch": at.epoch,
        "step": at.step,
        **means,
        **validation,
        "learning_rate": learning_rate(at, task),
        f"{task.unit}_per_second": rate,
        "seconds": at.seconds,
        **norms,
    }
    merit = row["val_loss" if optim.best_by == "loss" else "val_mse"]
    before = at.step - 2 * task.steps_per_epoch
    best = None if any(before < change < at.step for change in task.changes) else at.best
    improved = math.isfinite(merit) and (best is None or merit < best)
    plateau = optimizer.watch(at.plateau, row["val_mse"], optim)
    best = merit if improved else best
    following = at._replace(epoch=at.epoch + 1, best=best, sums={}, plateau=plateau)
    return Finished(row, improved, following)


def learning_rate(at: Position, task: Task) -> float:
    """The network's, of the step that comes next."""
    schedule = optimizer.schedule(task.config.optim, task.steps_per_epoch)
    return float(schedule(at.step)) * at.plateau.factor


def mean_figures(sums: dict[str, float], steps: int) -> Row:
    """Means over the steps that were not skipped, and the number of those that were."""
    skipped = round(sums.get("skipped", 0))
    means: Row = {name: total / max(1, steps - skipped) for name, total in sums.items()}
    return means | ({"skipped": skipped} if "skipped" in sums else {})


# What is said
# ------------------------------------------------------------------------------------------------


def under_way(at: Position, task: Task, rate: float) -> str:
    """The figures beside the progress bar: the mean loss of the epoch so far, and the speed."""
    steps = task.steps_per_epoch
    loss = mean_figures(at.sums, at.step - at.epoch * steps)["loss"]
    return (
        f"{at.step}/{task.config.optim.epochs * steps}  epoch {at.epoch + 1}  loss {loss:.4g}  "
        f"lr {learning_rate(at, task):.2e}  {_speed(task, rate)}"
    )


def lines(epoch: Finished, task: Task) -> Iterator[str]:
    """The line of a finished epoch, with the error of each of several datasets, and a warning where
    a layer of the head has stopped to learn."""
    row, names = epoch.row, task.config.datasets
    own = ", ".join(f"{name} {row[f'val_rmse/{name}']:.4f}" for name in names if len(names) > 1)
    yield (
        f"epoch {row['epoch'] + 1:4d}/{task.config.optim.epochs}  "
        f"loss {row['loss']:.4g}  val {row['val_loss']:.4g}  val rmse {row['val_rmse']:.4f} m  "
        f"{f'({own})  ' if own else ''}"
        f"{task.remark(row)}lr {row['learning_rate']:.2e}  "
        f"{_speed(task, row[f'{task.unit}_per_second'])}"
        f"{'  best' if epoch.improved else ''}"
    )
    if stuck := stuck_layers(row):
        yield (
            f"warning: no gradient reached {', '.join(stuck)} in this epoch, the network learns no "
            "more; start over with a lower optim.learning_rate, or with optim.clip_norm"
        )


def _speed(task: Task, rate: float) -> str:
    return f"{rate:,.0f} {task.unit}/s" if rate >= 10 else f"{rate:.2g} {task.unit}/s"


def stuck_layers(row: Row) -> list[str]:
    """Layers of the head that hardly a gradient reached in the epoch of `row`.

    A training that diverges may leave the network there: where every scale s = softplus(·)
    underflows to 0, so do the gradients of gate and encoder, and d̂ = 0 for good. A loss of 0 has
    not begun yet (`LossConfig.nll_from_epoch`).
    """
    norms = {name: row[name] for name in row if name.startswith("gradient_norm/head/")}
    layers = [name for name, norm in norms.items() if norm < NO_GRADIENT and row["loss"] != 0]
    return [name.removeprefix("gradient_norm/") for name in layers]
