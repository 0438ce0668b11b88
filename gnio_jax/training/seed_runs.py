"""The runs that are trained together: where each stands, and what it says of an epoch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax.training import optimizer as optimizers
from gnio_jax.training.checkpoint import Checkpoints, Position
from gnio_jax.training.kinds import Training
from gnio_jax.training.log import Row
from gnio_jax.training.step import Progress
from gnio_jax.training.together import Together

_HEAD = "gradient_norm/head/"
_NOTHING = 1e-9
"""Norm of a gradient, mean of an epoch, of which Adam, whose ε is 1e-8, makes next to no step."""
BEGINNING = Position(epoch=0, step=0, best_loss=None, loss_sums=(), seconds=0.0)


class SeedRun(NamedTuple):
    """The run of one seed, and where it stands."""

    name: str
    """What its lines begin with; nothing where there is one seed alone."""
    workdir: Path
    training: Training
    checkpoints: Checkpoints
    position: Position


class Group(NamedTuple):
    """Runs at the same step, and their states as `together` holds them."""

    runs: tuple[SeedRun, ...]
    together: Together
    states: Any

    @property
    def training(self) -> Training:
        """What is the same for all seeds."""
        return self.together.trainings[0]

    @property
    def step(self) -> int:
        return self.runs[0].position.step

    def at(self, positions: Sequence[Position]) -> Group:
        """The same runs where they stand now."""
        both = zip(self.runs, positions, strict=True)
        return self._replace(runs=tuple(run._replace(position=where) for run, where in both))

    def save(self) -> None:
        """Write the checkpoint `latest` of each run."""
        for run, state in zip(self.runs, self.together.apart(self.states), strict=True):
            run.checkpoints.save("latest", state, run.position)


def after_steps(run: SeedRun, progress: Progress, epoch: int, step: int) -> Position:
    """Where a run stands at step `step`, after steps that made this progress."""
    failed_step = int(progress.failed_step)  # waits for the device
    if failed_step >= 0:
        raise FloatingPointError(
            f"{run.name}the loss is not finite at step {failed_step} (epoch {epoch}); "
            "lower optim.learning_rate, set optim.clip_norm, or look at the data"
        )
    position = run.position
    before = position.loss_sums or (0.0,) * len(progress.sums)
    sums = zip(before, progress.sums, strict=True)
    norms = {
        part: position.gradient_norms.get(part, 0.0) + float(norm)
        for part, norm in progress.gradient_norms.items()
    }
    return position._replace(
        step=step,
        loss_sums=tuple(before + float(more) for before, more in sums),
        gradient_norms=norms,
    )


def improves(training: Training, position: Position, merit: float) -> bool:
    """Whether the epoch that ends at `position` is the best one so far.

    The choice begins anew with the epoch that changes what is trained, and again with the first
    whole one after it: losses before and after do not compare, and what has just begun to learn has
    learnt little.
    """
    before = position.step - 2 * training.steps_per_epoch
    changed = any(before < change < position.step for change in training.changes)
    return position.best_loss is None or changed or merit < position.best_loss


def next_epoch(
    training: Training, epoch: int, position: Position, row: Row, best_loss: float | None
) -> Position:
    """The start of the next epoch; `best_loss` is None where the epoch was not the best."""
    return position._replace(
        epoch=epoch + 1,
        best_loss=position.best_loss if best_loss is None else best_loss,
        loss_sums=(),
        gradient_norms={},
        plateau=optimizers.watch(position.plateau, row["val_mse"], training.config.optim),
    )


def row_of(run: SeedRun, epoch: int, validation: Row, rate: float) -> Row:
    """The log's row of a finished epoch: mean losses of training (as its steps met them) and the
    figures of validation."""
    training, position = run.training, run.position
    steps, norms = training.steps_per_epoch, position.gradient_norms
    return {
        "epoch": epoch,
        "step": position.step,
        **training.training_figures(position.loss_sums, steps),
        **validation,
        "learning_rate": learning_rate(run),
        f"{training.unit}_per_second": rate,
        "seconds": position.seconds,
        **{f"gradient_norm/{part}": norms[part] / steps for part in norms},
    }


def learning_rate(run: SeedRun) -> float:
    """That of the next step."""
    return run.training.learning_rate(run.position.step) * run.position.plateau.factor


def summary(run: SeedRun, row: Row) -> str:
    """The line of a finished epoch."""
    training = run.training
    return (
        f"{run.name}epoch {row['epoch'] + 1:4d}/{training.config.optim.epochs}  "
        f"loss {row['loss']:.4g}  val {row['val_loss']:.4g}  val rmse {row['val_rmse']:.4f} m  "
        f"{training.remark(row)}lr {row['learning_rate']:.2e}  "
        f"{speed(training, row[f'{training.unit}_per_second'])}"
    )


def stuck_head(row: Row) -> str | None:
    """A warning where hardly a gradient reached a layer of the head in the epoch of `row`.

    A training that diverges may leave the network there: where every scale s = softplus(·)
    underflows to 0, so do the gradients of gate and encoder, and d̂ = 0 for good. A loss of 0 has
    not begun yet (`LossConfig.nll_from_epoch`).
    """
    layers = [name for name, norm in row.items() if name.startswith(_HEAD) and norm < _NOTHING]
    if not layers or row["loss"] == 0:
        return None
    named = ", ".join(name.removeprefix("gradient_norm/") for name in layers)
    return (
        f"warning: no gradient reached {named} in this epoch, the network learns no more; "
        "start over with a lower optim.learning_rate, or with optim.clip_norm"
    )


def speed(training: Training, rate: float) -> str:
    """Windows or pieces per second in words."""
    return f"{rate:,.0f} {training.unit}/s" if rate >= 10 else f"{rate:.2g} {training.unit}/s"
