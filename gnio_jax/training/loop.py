"""The training loop, top to bottom: set-up, epochs of dispatches, validation, log, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax

from gnio_jax import config as configuration
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Lines, Reporter, Silence
from gnio_jax.scaling.devices import chosen, sharing
from gnio_jax.scaling.processes import agreed, all_or_none, is_first, several
from gnio_jax.training import optimizer as optimizers
from gnio_jax.training import run_folder
from gnio_jax.training.checkpoint import Checkpoints, Position, Run, exists, load_run
from gnio_jax.training.initial import initial_run
from gnio_jax.training.kinds import Training
from gnio_jax.training.log import Log, Row
from gnio_jax.training.setup import set_up
from gnio_jax.training.step import TrainState
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
    devices: int | None = None,
    load_initial: Callable[[str], Run] = load_run,
) -> Outcome:
    """Train the network of `config` and leave checkpoints and logs in its work folder: on windows,
    or through the filter where `config.through_filter` says what learns.

    With `resume` the run goes on from its latest checkpoint as if it had never stopped: parameters,
    optimizer, order of the windows or pieces, and random draws are functions of the seed and the
    step. Resume rules, in order: the settings must be those of config.yaml; without a checkpoint
    yet the run starts over; log rows after the checkpoint are dropped. SIGTERM and Ctrl-C save and
    return; a loss that is not finite raises `FloatingPointError` naming the step (through the
    filter such a step is skipped). `workers` processes read recordings that are slow to read
    (`data.load`). A batch of windows is shared out among `devices` devices of each process, by
    default all (`scaling.devices.chosen`); how many there are changes the results by rounding
    alone, also in a run that is resumed. `load_initial` reads what `config.init_from` names, by
    default the folder of a run; `gnio_jax.load_pretrained` also takes packages of weights. Raises
    `InputError` where that is not of the same network, and where the devices cannot share a batch
    evenly.
    """
    through_filter = bool(config.through_filter.learn)  # it shares its pieces out by itself
    if through_filter and several():
        problem = "runs in one process, on all of its devices"
        raise InputError("training through the filter", problem, "start one process")
    if through_filter and devices is not None:
        raise InputError("--devices", "is for training on windows", "leave it out")
    sharers = jax.devices()[:1] if through_filter else chosen(devices)
    # Whatever the process has: no float64 but for the filter, and the same random draws.
    with jax.enable_x64(through_filter), sharing(sharers):
        reporter = (reporter or Lines()) if is_first() else Silence()
        return _train(config, resume, reporter, workers, load_initial)


def _train(
    config: TrainConfig,
    resume: bool,
    reporter: Reporter,
    workers: int,
    load_initial: Callable[[str], Run],
) -> Outcome:
    configuration.validate(config)
    with all_or_none():
        workdir = run_folder.prepare(config, resume)
    (resuming,) = agreed(resume and is_first() and exists(workdir))
    with all_or_none():
        start = None if resuming else initial_run(config, load_initial)
        training = set_up(config, reporter, workers)
        state = training.new_state(start)
        training.describe(state, workdir, reporter)
        run_folder.write_settings(workdir, config, training.splits, resume)
    run_folder.compare_processes(config, training.splits, training.recordings, state.variables)
    position = Position(epoch=0, step=0, best_loss=None, loss_sums=(), seconds=0.0)
    with Checkpoints(workdir) as checkpoints, stop_signals() as stop:
        if resuming:
            state, position = checkpoints.restore(state)
            reporter.line(f"resuming at step {position.step}")
        with Log(workdir, position.epoch, position.step) as log:
            for epoch in range(position.epoch, config.optim.epochs):
                state, position, rate = _run_epoch(
                    training, epoch, state, position, checkpoints, stop, reporter
                )
                if position.step < (epoch + 1) * training.steps_per_epoch:
                    break  # stopped on the way, and saved

                state, found = training.validate(training.settled(state), position.step)
                row = _row(training, epoch, position, found, rate)
                merit = row["val_loss" if config.optim.best_by == "loss" else "val_mse"]
                improved = _improves(training, position, merit)
                position = _next_epoch(training, epoch, position, row, merit if improved else None)
                log.add(row)
                reporter.line(_summary(training, row) + ("  best" if improved else ""))
                if improved:
                    checkpoints.save("best", state, position)
                checkpoints.save("latest", state, position)
                stop.agree()
                if stop.signum:
                    break
    return Outcome(workdir, position.best_loss, stop.signum)


def _run_epoch(
    training: Training,
    epoch: int,
    state: TrainState,
    position: Position,
    checkpoints: Checkpoints,
    stop: Stop,
    reporter: Reporter,
) -> tuple[TrainState, Position, float]:
    """Finish epoch `epoch` from `position` on, or save and return when asked to stop; with the
    windows or pieces per second of these steps."""
    order, steps = training.order(epoch), training.steps_per_epoch
    began = saved = time.perf_counter()
    start, first = position, position.step - epoch * steps
    done, dispatch, rate = first, 1, 0.0
    while done < steps:
        count = min(dispatch, steps - done)
        tick = time.perf_counter()
        state, position = _run_steps(training, order, epoch, done, count, state, position)
        clock = time.perf_counter()
        dispatch = max(1, min(2 * dispatch, round(DISPATCH_SECONDS * count / (clock - tick))))
        due = int(clock - saved > training.config.checkpoint_every_seconds)
        dispatch, due = agreed(dispatch, due)  # the clocks of the processes differ
        stop.agree()
        done += count
        position = position._replace(seconds=start.seconds + clock - began)
        rate = (done - first) * training.config.optim.batch_size / (clock - began)
        _report(training, epoch, done, position, rate, reporter)
        if done < steps and (stop.signum or due):
            checkpoints.save("latest", training.settled(state), position)
            saved = time.perf_counter()
            if stop.signum:
                break
    return state, position, rate


def _run_steps(
    training: Training,
    order: Any,
    epoch: int,
    first: int,
    count: int,
    state: TrainState,
    position: Position,
) -> tuple[TrainState, Position]:
    """Take `count` steps of an epoch from its step `first` on, in one dispatch."""
    factor = position.plateau.factor
    state, progress = training.take_steps(state, order, first, count, factor)
    failed_step = int(progress.failed_step)  # waits for the device
    if failed_step >= 0:
        raise FloatingPointError(
            f"the loss is not finite at step {failed_step} (epoch {epoch}); "
            "lower optim.learning_rate, set optim.clip_norm, or look at the data"
        )
    before = position.loss_sums or (0.0,) * len(progress.sums)
    sums = zip(before, progress.sums, strict=True)
    norms = {
        part: position.gradient_norms.get(part, 0.0) + float(norm)
        for part, norm in progress.gradient_norms.items()
    }
    return state, position._replace(
        step=epoch * training.steps_per_epoch + first + count,
        loss_sums=tuple(before + float(more) for before, more in sums),
        gradient_norms=norms,
    )


def _improves(training: Training, position: Position, merit: float) -> bool:
    """Whether the epoch that ends at `position` is the best one so far.

    The choice begins anew with the epoch that changes what is trained, and again with the first
    whole one after it: losses before and after do not compare, and what has just begun to learn has
    learnt little.
    """
    before = position.step - 2 * training.steps_per_epoch
    changed = any(before < change < position.step for change in training.changes)
    return position.best_loss is None or changed or merit < position.best_loss


def _next_epoch(
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


def _row(training: Training, epoch: int, position: Position, validation: Row, rate: float) -> Row:
    """The log's row of a finished epoch: mean losses of training (as its steps met them) and the
    figures of validation."""
    steps, norms = training.steps_per_epoch, position.gradient_norms
    return {
        "epoch": epoch,
        "step": position.step,
        **training.training_figures(position.loss_sums, steps),
        **validation,
        "learning_rate": _learning_rate(training, position),
        f"{training.unit}_per_second": rate,
        "seconds": position.seconds,
        **{f"gradient_norm/{part}": norms[part] / steps for part in norms},
    }


def _learning_rate(training: Training, position: Position) -> float:
    return training.learning_rate(position.step) * position.plateau.factor


def _summary(training: Training, row: Row) -> str:
    return (
        f"epoch {row['epoch'] + 1:4d}/{training.config.optim.epochs}  loss {row['loss']:.4g}  "
        f"val {row['val_loss']:.4g}  val rmse {row['val_rmse']:.4f} m  {training.remark(row)}"
        f"lr {row['learning_rate']:.2e}  {_speed(training, row[f'{training.unit}_per_second'])}"
    )


def _report(
    training: Training, epoch: int, done: int, position: Position, rate: float, reporter: Reporter
) -> None:
    """The progress of the run, with the mean loss of the epoch so far."""
    steps = training.config.optim.epochs * training.steps_per_epoch
    loss = training.training_figures(position.loss_sums, done)["loss"]
    numbers = (
        f"{position.step}/{steps}  epoch {epoch + 1}  loss {loss:.4g}  "
        f"lr {_learning_rate(training, position):.2e}  {_speed(training, rate)}"
    )
    reporter.progress("training", position.step / steps, numbers)


def _speed(training: Training, rate: float) -> str:
    return f"{rate:,.0f} {training.unit}/s" if rate >= 10 else f"{rate:.2g} {training.unit}/s"
