"""The training loop, top to bottom: set-up, epochs of dispatches, validation, log, checkpoints."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gnio_jax import config as configuration
from gnio_jax.config import TrainConfig
from gnio_jax.reporting import Lines, Reporter
from gnio_jax.training import optimizer as optimizers
from gnio_jax.training import run_folder
from gnio_jax.training.checkpoint import Checkpoints, Position, exists
from gnio_jax.training.log import Log, Row
from gnio_jax.training.losses import stage, switches
from gnio_jax.training.setup import Run, describe, set_up
from gnio_jax.training.step import (
    TrainState,
    Validation,
    calibrated,
    calibrates,
    create_state,
    epoch_order,
    estimate_statistics,
    evaluated,
    isotropic,
    normalises,
    train_steps,
    validate,
)
from gnio_jax.training.stopping import Stop, stop_signals

DISPATCH_SECONDS = 0.5
"""Steps are dispatched in runs of about this long: few round trips, and still a lively progress bar
and a quick stop."""


class Outcome(NamedTuple):
    """How a training run ended."""

    workdir: Path
    best_loss: float | None
    """Smallest value on the validation split of what `optim.best_by` names."""
    stopped_by: int | None
    """Signal that ended it early; its state is saved."""


def train(
    config: TrainConfig,
    resume: bool = False,
    reporter: Reporter | None = None,
    workers: int = 1,
) -> Outcome:
    """Train the network of `config` and leave checkpoints and logs in its work folder.

    With `resume` the run goes on from its latest checkpoint as if it had never stopped: parameters,
    optimizer, order of the windows and random draws are functions of the seed and the step. Resume
    rules, in order: the settings must be those of config.yaml; without a checkpoint yet the run
    starts over; log rows after the checkpoint are dropped. SIGTERM and Ctrl-C save and return; a
    loss that is not finite raises `FloatingPointError` naming the step. `workers` processes read
    recordings that are slow to read (`data.load`).
    """
    # Whatever the process has: no float64 in the step, and the same random draws.
    with jax.enable_x64(False):
        return _train(config, resume, reporter or Lines(), workers)


def _train(config: TrainConfig, resume: bool, reporter: Reporter, workers: int) -> Outcome:
    configuration.validate(config)
    workdir = run_folder.prepare(config, resume)
    run = set_up(config, reporter, workers)
    state = create_state(
        run.model, run.optimizer, run.keys.init, config.data.window, config.optim.ema_decay
    )
    describe(run, sum(x.size for x in jax.tree.leaves(state.params)), workdir, reporter)
    run_folder.write_settings(workdir, config, run.splits, resume)
    position = Position(epoch=0, step=0, best_loss=None, loss_sums=(0.0, 0.0, 0.0), seconds=0.0)
    with Checkpoints(workdir) as checkpoints, stop_signals() as stop:
        if resume and exists(workdir):
            state, position = checkpoints.restore(state)
            reporter.line(f"resuming at step {position.step}")
        with Log(workdir, position.epoch, position.step) as log:
            for epoch in range(position.epoch, config.optim.epochs):
                state, position, rate = _run_epoch(
                    run, epoch, state, position, checkpoints, stop, reporter
                )
                if position.step < (epoch + 1) * run.steps_per_epoch:
                    break  # stopped on the way, and saved

                state, validation = _validate(run, _with_statistics(run, state), position.step)
                row = _row(run, epoch, position, validation, rate)
                merit = row["val_loss" if config.optim.best_by == "loss" else "val_mse"]
                improved = _improves(run, position, merit)
                position = _next_epoch(run, epoch, position, row, merit if improved else None)
                log.add(row)
                reporter.line(_summary(run, row) + ("  best" if improved else ""))
                if improved:
                    checkpoints.save("best", state, position)
                checkpoints.save("latest", state, position)
                if stop.signum:
                    break
    return Outcome(workdir, position.best_loss, stop.signum)


def _run_epoch(
    run: Run,
    epoch: int,
    state: TrainState,
    position: Position,
    checkpoints: Checkpoints,
    stop: Stop,
    reporter: Reporter,
) -> tuple[TrainState, Position, float]:
    """Finish epoch `epoch` from `position` on, or save and return when asked to stop; with the
    windows/s of these steps."""
    order = epoch_order(run.keys.order, epoch, run.source)
    began = saved = time.perf_counter()
    start, first = position, position.step - epoch * run.steps_per_epoch
    done, dispatch, rate = first, 1, 0.0
    while done < run.steps_per_epoch:
        count = min(dispatch, run.steps_per_epoch - done)
        tick = time.perf_counter()
        state, position = _run_steps(run, order, epoch, done, count, state, position)
        clock = time.perf_counter()
        dispatch = max(1, min(2 * dispatch, round(DISPATCH_SECONDS * count / (clock - tick))))
        done += count
        position = position._replace(seconds=start.seconds + clock - began)
        rate = (done - first) * run.config.optim.batch_size / (clock - began)
        _report(run, epoch, done, position, rate, reporter)
        due = clock - saved > run.config.checkpoint_every_seconds
        if done < run.steps_per_epoch and (stop.signum or due):
            checkpoints.save("latest", _with_statistics(run, state), position)
            saved = time.perf_counter()
            if stop.signum:
                break
    return state, position, rate


def _run_steps(
    run: Run,
    order: jax.Array,
    epoch: int,
    first: int,
    count: int,
    state: TrainState,
    position: Position,
) -> tuple[TrainState, Position]:
    """Take `count` steps of an epoch from its step `first` on, in one dispatch."""
    state, progress = train_steps(
        state,
        run.source,
        order,
        jnp.int32(first),
        jnp.int32(count),
        jnp.float32(position.plateau.factor),
        run.keys.step,
        model=run.model,
        optimizer=run.optimizer,
        config=run.config,
    )
    failed_step = int(progress.failed_step)  # waits for the device
    if failed_step >= 0:
        raise FloatingPointError(
            f"the loss is not finite at step {failed_step} (epoch {epoch}); "
            "lower optim.learning_rate, set optim.clip_norm, or look at the data"
        )
    sums = zip(position.loss_sums, progress.sums, strict=True)
    norms = {
        part: position.gradient_norms.get(part, 0.0) + float(norm)
        for part, norm in progress.gradient_norms.items()
    }
    return state, position._replace(
        step=epoch * run.steps_per_epoch + first + count,
        loss_sums=tuple(before + float(more) for before, more in sums),
        gradient_norms=norms,
    )


def _with_statistics(run: Run, state: TrainState) -> TrainState:
    """The state as it is validated and kept: with the statistics of its batch normalisations
    estimated anew, for the parameters that are evaluated, if asked for."""
    if not run.config.optim.statistics_windows or not normalises(state):
        return state
    estimated = estimate_statistics(
        evaluated(state), run.source, run.keys.statistics, model=run.model, config=run.config
    )
    return state._replace(batch_stats=estimated.batch_stats)


def _validate(run: Run, state: TrainState, step: int) -> tuple[TrainState, Validation]:
    """The state as it is kept, its uncertainty calibrated where it has constants for that, and the
    losses of that state."""
    now = stage(run.config.loss, step - 1, run.steps_per_epoch)
    options = {"model": run.model, "config": run.config}
    validation = validate(evaluated(state), source=run.held_out, now=now, **options)
    if not calibrates(state):
        return state, validation
    equivariant = run.config.model.equivariance != "none"
    state = calibrated(state, isotropic(validation) if equivariant else validation)
    return state, validate(evaluated(state), source=run.held_out, now=now, **options)


def _improves(run: Run, position: Position, merit: float) -> bool:
    """Whether the epoch that ends at `position` is the best one so far.

    The choice begins anew with the epoch that changes what is trained, and again with the first
    whole one after it: losses before and after do not compare, and what has just begun to learn has
    learnt little.
    """
    before = position.step - 2 * run.steps_per_epoch
    changes = switches(run.config.loss, run.steps_per_epoch)
    changed = any(before < change < position.step for change in changes)
    return position.best_loss is None or changed or merit < position.best_loss


def _next_epoch(
    run: Run, epoch: int, position: Position, row: Row, best_loss: float | None
) -> Position:
    """The start of the next epoch; `best_loss` is None where the epoch was not the best."""
    return position._replace(
        epoch=epoch + 1,
        best_loss=position.best_loss if best_loss is None else best_loss,
        loss_sums=(0.0, 0.0, 0.0),
        gradient_norms={},
        plateau=optimizers.watch(position.plateau, row["val_mse"], run.config.optim),
    )


def _row(run: Run, epoch: int, position: Position, validation: Validation, rate: float) -> Row:
    """The log's row of a finished epoch: mean losses of training (as its steps met them) and of
    validation."""
    loss, mse, nll = (x / run.steps_per_epoch for x in position.loss_sums)
    val_loss, val_mse, val_nll = (float(x) for x in validation.losses)
    normalised = zip("xyz", validation.axis_normalised, strict=True)
    norms = position.gradient_norms
    return {
        "epoch": epoch,
        "step": position.step,
        "loss": loss,
        "mse": mse,
        "nll": nll,
        "val_loss": val_loss,
        "val_mse": val_mse,
        "val_nll": val_nll,
        "val_rmse": math.sqrt(val_mse),
        **{f"val_normalised/{axis}": float(x) for axis, x in normalised},
        "learning_rate": _learning_rate(run, position),
        "windows_per_second": rate,
        "seconds": position.seconds,
        **{f"gradient_norm/{part}": norms[part] / run.steps_per_epoch for part in norms},
    }


def _learning_rate(run: Run, position: Position) -> float:
    return float(run.learning_rate(position.step)) * position.plateau.factor


def _summary(run: Run, row: Row) -> str:
    return (
        f"epoch {row['epoch'] + 1:4d}/{run.config.optim.epochs}  loss {row['loss']:.4g}  "
        f"val {row['val_loss']:.4g}  val rmse {row['val_rmse']:.4f} m  "
        f"lr {row['learning_rate']:.2e}  {row['windows_per_second']:,.0f} windows/s"
    )


def _report(
    run: Run, epoch: int, done: int, position: Position, rate: float, reporter: Reporter
) -> None:
    """The progress of the run, with the mean loss of the epoch so far."""
    numbers = (
        f"{position.step}/{run.steps}  epoch {epoch + 1}  loss {position.loss_sums[0] / done:.4g}  "
        f"lr {_learning_rate(run, position):.2e}  {rate:,.0f} windows/s"
    )
    reporter.progress("training", position.step / run.steps, numbers)
