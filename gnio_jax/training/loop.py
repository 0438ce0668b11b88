"""The training loop, from top to bottom: one run after another, with epochs of dispatches,
validation, log and checkpoints. The functions below it take decisions from the figures of an
epoch."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gnio_jax import config as configuration
from gnio_jax import models, parallel
from gnio_jax.config import OptimConfig, TrainConfig
from gnio_jax.config.schema import Location
from gnio_jax.errors import InputError
from gnio_jax.filtering.measurements import create_measurements
from gnio_jax.models.memory import NetworkWithMemory
from gnio_jax.networks import TrainedNetwork
from gnio_jax.networks.folder import WEIGHTS
from gnio_jax.reporting import Lines, Reporter, Silence
from gnio_jax.training import checkpoint, optimizer, run_folder, support_vectors
from gnio_jax.training.checkpoint import RunPosition
from gnio_jax.training.filter_task import FilterTask
from gnio_jax.training.initial import load_initial_network
from gnio_jax.training.recordings import TrainingData, set_up
from gnio_jax.training.run_folder import Log
from gnio_jax.training.segment_task import HORIZON_WINDOWS, SegmentTask, horizon_lengths
from gnio_jax.training.task import DispatchSums, Row, Task, TrainState
from gnio_jax.training.walk_segments import grid_of
from gnio_jax.training.window_task import WindowTask

DISPATCH_SECONDS = 0.5
"""Approximate duration of one dispatch of steps, s: few round trips, but a progress bar that moves
and a quick stop."""
CHECKPOINT_SECONDS = 600.0
"""Longest time between checkpoints within an epoch, s; every epoch also ends with one."""
METHODS: dict[str, Callable[[TrainConfig, Path, Reporter, int, bool], float]] = {
    "support_vectors": support_vectors.train
}
"""Training without steps, by what a network says in its attribute `trained_by`: functions of the
experiment, the work folder, the reporter, the number of processes that read, and whether a finished
run stays as it is. They write the run and return its loss on the validation split."""
NO_GRADIENT = 1e-9
"""Norm of a gradient, mean over an epoch, below which Adam, whose ε is 1e-8, makes almost no
step."""


class TrainingResult(NamedTuple):
    """How a training run ended."""

    workdir: Path
    best_loss: float | None
    """Value of `optim.best_by` on the validation split at the best epoch."""
    stopped_by: int | None
    """Signal that ended this run early, or prevented the seeds after it; the state is saved."""


def train(config: TrainConfig, resume: bool = False, **options: Any) -> TrainingResult:
    """Train the network of `config` and write checkpoints and logs to its work folder. Training is
    on windows, or through the filter if `config.through_filter` names what is trained.

    With `resume` the run continues from its latest checkpoint as if it had never stopped:
    parameters, optimizer, order of the windows or segments, and random draws are functions of the
    seed and the step. A run is resumed by these rules: the settings must be those of config.yaml; a
    run without a checkpoint and without weights starts again; log rows after the checkpoint are
    removed. After SIGTERM or Ctrl-C the state is saved and the function returns. A loss or gradient
    that is not finite raises `FloatingPointError` naming the step (through the filter such a step
    is skipped). The other options and errors are those of `train_all`.
    """
    (result,) = train_all([config], resume, **options)
    return result


def train_all(
    configs: Sequence[TrainConfig],
    resume: bool = False,
    reporter: Reporter | None = None,
    workers: int = 1,
    devices: int | None = None,
) -> list[TrainingResult]:
    """`train` for experiments that differ only in their seeds and folders (`config.with_seeds`),
    one after the other. Recordings are read once and steps are compiled once.

    A signal ends the run that it interrupts. The runs after it do not begin and have no outcome.

    Args:
        configs: The experiments.
        resume: Whether finished runs are skipped and begun ones continue from their latest
            checkpoint. Missing ones start.
        reporter: It gets progress and lines of text.
        workers: Number of processes that read recordings that are slow to read.
        devices: Number of devices of each process among which a batch of windows is divided
            (`parallel.sharing`); None: all of them, and on a CPU one. It changes the results only
            by rounding, even in a run that is resumed.

    Raises:
        InputError: The initial network is not of the same network, settings do not fit together, a
            folder holds another run, or weights without a checkpoint to resume from, or the devices
            cannot share a batch evenly.
    """
    reporter = (reporter or Lines()) if parallel.is_first() else Silence()
    folders = map(configuration.default_workdir, configs)
    existing = [(folder / "config.yaml").exists() for folder in folders]
    resumes = [resume and (exists or not any(existing)) for exists in existing]
    workdirs = [
        run_folder.refuse_other_run(configuration.validate(config), resume)
        for config, resume in zip(configs, resumes, strict=True)
    ]
    refuse_untrainable(configs[0])
    method = METHODS.get(models.trained_by(models.from_experiment(configs[0])))
    if method is not None:  # without steps
        losses = [
            method(config, workdir, reporter, workers, resume)
            for config, workdir, resume in zip(configs, workdirs, resumes, strict=True)
        ]
        return [TrainingResult(*run, None) for run in zip(workdirs, losses, strict=True)]
    for workdir, resume in zip(workdirs, resumes, strict=True):
        if resume and (workdir / WEIGHTS).exists() and not checkpoint.exists(workdir):
            problem = "has weights, and no checkpoint to continue from"
            remedy = f"remove it, or begin with it: --init-from {workdir} and another --workdir"
            raise InputError(workdir, problem, remedy)
    through_filter = bool(configs[0].through_filter.learn)
    if through_filter and devices is not None:
        raise InputError("--devices", "is for training on windows", "leave it out")
    if through_filter and jax.process_count() > 1:
        problem = "runs in one process, on all of its devices"
        raise InputError("training through the filter", problem, "start one process")
    results: list[TrainingResult] = []
    # Segments are divided by `filtering.over_sequences`, not as a batch of windows is. Only the
    # filter computes in float64, independently of the settings of the process.
    sharing = parallel.sharing(1 if through_filter else devices)
    with jax.enable_x64(through_filter), sharing, _record_signals() as signals:
        resumed = all(resumes) and all(map(checkpoint.exists, workdirs))
        start = None if resumed else load_initial_network(configs[0])
        task_type = choose_task(configs[0])
        task, data = set_up(task_type, configs[0], reporter, workers)
        for config, resume in zip(configs, resumes, strict=True):
            results.append(_train(task, data, config, start, resume, signals, reporter))
            (signum,) = parallel.largest(max(signals))
            if signum and len(results) < len(configs):
                results[-1] = results[-1]._replace(stopped_by=signum)  # others are missing
                break
    return results


def refuse_untrainable(config: TrainConfig) -> None:
    """Raise `InputError` for an experiment that cannot be trained, or whose filter has measurements
    that do not exist, before anything is read: as `choose_task` does, and for a library that is
    missing."""
    create_measurements(config.filter.measurements, Location("config", "filter.measurements"))
    if models.trained_by(models.from_experiment(config)) == "support_vectors":
        support_vectors.require_library()
    else:
        choose_task(config)


def choose_task(config: TrainConfig) -> type[Task]:
    """The task of an experiment. Raises `InputError` for segments without a network with memory,
    for strides that do not fit such a network, for choices by the error of a displacement that the
    network does not predict, and for a loss over longer times than a segment has."""
    model = models.from_experiment(config)
    remembers = isinstance(model, NetworkWithMemory)
    if config.segments.seconds and not remembers:
        problem = f"is for a network with memory, and '{config.model.name}' has none"
        raise InputError("segments.seconds", problem, "set it to 0")
    if isinstance(model, NetworkWithMemory) and config.data.stride % model.multiple:
        problem = f"is {config.data.stride} samples; '{config.model.name}' takes {model.multiple}"
        remedy = f"make it a multiple of {model.multiple / config.data.rate:g} s"
        raise InputError("data.stride_seconds", problem, remedy)
    if not models.predicts_displacement(model):
        _refuse_errors_of_displacement(config)
        if not config.through_filter.learn:
            problem = f"is empty, and '{config.model.name}' is trained in the filter's loop alone"
            raise InputError("through_filter.learn", problem, "name the parts, e.g. [all]")
    if config.through_filter.learn:
        return FilterTask
    if not config.segments.seconds:
        return WindowTask
    grid = grid_of(config)
    if config.segments.horizon_weight and not horizon_lengths(grid.predictions, grid.window):
        least = ((HORIZON_WINDOWS[0] + 2) * grid.window - 1) * config.data.stride_seconds
        problem = f"has no effect on segments of {config.segments.seconds:g} s"
        remedy = f"set segments.seconds to {least:g} or more, or the weight to 0"
        raise InputError("segments.horizon_weight", problem, remedy)
    return SegmentTask


def _refuse_errors_of_displacement(config: TrainConfig) -> None:
    """Raise `InputError` where the error of a displacement would choose the best epoch or reduce
    the learning rate of a network that predicts none: every epoch has an error of 0."""
    optim, usual = config.optim, OptimConfig()
    for name, choice in (("best_by", "squared_error"), ("schedule", "plateau")):
        if getattr(optim, name) == choice:
            problem = f"is {choice}, and '{config.model.name}' predicts no displacement"
            remedy = f"set it to {getattr(usual, name)}"
            raise InputError(f"optim.{name}", f"{problem}, whose error would decide", remedy)


def _train(
    task: Task,
    data: TrainingData,
    config: TrainConfig,
    start: TrainedNetwork | None,
    resume: bool,
    signals: list[int],
    reporter: Reporter,
) -> TrainingResult:
    """Train one run to its end or until a signal."""
    epochs, steps, source = config.optim.epochs, task.steps_per_epoch, data.source
    key = jax.random.key(config.seed)
    init_key, order_key, step_key = jax.random.split(key, 3)
    statistics_key = jax.random.fold_in(key, 3)
    with_statistics = partial(task.with_statistics, source=source, key=statistics_key)
    # Copies, because steps take the memory of their state, and the next seed also starts from
    # `start`.
    state = parallel.copy_to_devices(task.initial_state(init_key, start and start.variables))
    position = RunPosition()
    if not resume:  # a loss that does not fit is refused before anything is written
        order, none = task.order(order_key, 0, source), jnp.int32(0)
        task.trace_steps(state, source, order, none, none, jnp.float32(1), step_key)
    with run_folder.open_run(config, data, state.variables, resume) as workdir:
        for line in task.description(state, workdir):
            reporter.line(line)
        if resume and checkpoint.exists(workdir):
            state, position = checkpoint.restore(workdir, state)
            reporter.line(f"resuming at step {position.step}")
        with Log(workdir, position.epoch, position.step) as log:
            if position.row and log.epochs < position.epoch:  # the process ended between the files
                _keep_epoch(workdir, config, state, position, log)
            saved = time.perf_counter()
            for epoch in range(position.epoch, epochs):
                order, end = task.order(order_key, epoch, source), (epoch + 1) * steps
                began, before, dispatch, rate = time.perf_counter(), position, 1, 0.0
                while position.step < end:
                    count, tick = min(dispatch, end - position.step), time.perf_counter()
                    numbers = jnp.int32(position.step - epoch * steps), jnp.int32(count)
                    factor = jnp.float32(position.plateau.factor)
                    state, sums = task.take_steps(state, source, order, *numbers, factor, step_key)
                    position = add_steps(position, count, jax.device_get(sums), workdir)
                    clock = time.perf_counter()
                    position = position._replace(seconds=before.seconds + clock - began)
                    rate = (position.step - before.step) * config.optim.batch_size / (clock - began)
                    target = round(DISPATCH_SECONDS * count / (clock - tick))
                    # Clocks differ between processes, and a signal may reach only one of them.
                    dispatch, due, signum = parallel.largest(
                        max(1, min(2 * dispatch, target)),
                        int(clock - saved > CHECKPOINT_SECONDS),
                        max(signals),
                    )
                    remark = _describe_progress(position, task, rate)
                    reporter.progress("training", position.step / (epochs * steps), remark)
                    if position.step < end and (due or signum):
                        checkpoint.save(workdir, with_statistics(state), position)
                        saved = clock
                        if signum:
                            return TrainingResult(workdir, position.best, signum)
                state, validation = task.validate(
                    with_statistics(state), data.held_out, statistics_key
                )
                position, row = finish_epoch(position, task, validation, rate)
                checkpoint.save(workdir, state, position)
                _keep_epoch(workdir, config, state, position, log)
                for line in describe_epoch(row, position.improved, task):
                    reporter.line(line)
                (signum,) = parallel.largest(max(signals))
                if signum and epoch + 1 < epochs:
                    return TrainingResult(workdir, position.best, signum)
    return TrainingResult(workdir, position.best, None)


def _keep_epoch(
    workdir: Path, config: TrainConfig, state: TrainState, position: RunPosition, log: Log
) -> None:
    """Write what follows from the checkpoint at the end of an epoch: the weights if they are the
    best so far, then the log's row. So whatever ends the process, a run whose log has an epoch has
    its weights and its checkpoint, and a resumed run writes what is missing."""
    if position.improved:
        checkpoint.save_best(workdir, config, state, position)
    if position.row:
        log.add(position.row)


@contextmanager
def _record_signals() -> Iterator[list[int]]:
    """Append the numbers of SIGTERM and Ctrl-C to a list that begins with 0, instead of ending the
    process; a second Ctrl-C ends it."""
    signals = [0]

    def note(signum: int, _: object) -> None:
        if signals[-1] == signal.SIGINT == signum:
            raise KeyboardInterrupt
        signals.append(signum)

    handlers: dict[Any, Any] = {
        signum: signal.signal(signum, note) for signum in (signal.SIGTERM, signal.SIGINT)
    }
    try:
        yield signals
    finally:
        for signum, handler in handlers.items():
            signal.signal(signum, handler)


# What follows from the figures
# ------------------------------------------------------------------------------------------------


def add_steps(
    position: RunPosition, count: int, dispatch: DispatchSums, workdir: Path
) -> RunPosition:
    """The position of the run in `workdir` after `count` more steps. Raises `FloatingPointError` if
    one of them failed."""
    if dispatch.failed_step >= 0:
        raise FloatingPointError(
            f"{workdir}: the loss or its gradient is not finite at step "
            f"{int(dispatch.failed_step)} (epoch {position.epoch}); lower optim.learning_rate, set "
            "optim.clip_norm, or look at the data"
        )
    sums = {name: float(figure) for name, figure in dispatch.sums.items()}
    sums = {name: position.sums.get(name, 0.0) + figure for name, figure in sums.items()}
    return position._replace(step=position.step + count, sums=sums, row=None, improved=False)


def finish_epoch(
    position: RunPosition, task: Task, validation: Row, rate: float
) -> tuple[RunPosition, Row]:
    """The end of an epoch at `position`, trained at `rate` windows or segments per second: the
    position at which the next one starts, and the log's row.

    The choice of the best epoch begins anew with the epoch that changes what is trained, and again
    with the first whole epoch after it. Losses before and after the change cannot be compared, and
    a part that has just begun to learn has learnt little. With `best_by: latest` every epoch is the
    best one so far. NaN and infinity are never the best.
    """
    optim, means = task.config.optim, mean_figures(position.sums, task.steps_per_epoch)
    norms = {name: means.pop(name) for name in position.sums if name.startswith("gradient_norm/")}
    row: Row = {
        "epoch": position.epoch,
        "step": position.step,
        **means,
        **validation,
        "learning_rate": learning_rate(position, task),
        f"{task.unit}_per_second": rate,
        "seconds": position.seconds,
        **norms,
    }
    merit = row["val_loss" if optim.best_by == "loss" else "val_mse"]
    before = position.step - 2 * task.steps_per_epoch
    changed = any(before < change < position.step for change in task.changes)
    best = None if changed else position.best
    better = optim.best_by == "latest" or best is None or merit < best
    improved = math.isfinite(merit) and better
    plateau = optimizer.update_plateau(position.plateau, row["val_mse"], optim)
    best = merit if improved else best
    position = position._replace(
        epoch=position.epoch + 1, best=best, sums={}, plateau=plateau, row=row, improved=improved
    )
    return position, row


def learning_rate(position: RunPosition, task: Task) -> float:
    """The network's learning rate at the next step."""
    schedule = optimizer.schedule(task.config.optim, task.steps_per_epoch)
    return float(schedule(position.step)) * position.plateau.factor


def mean_figures(sums: dict[str, float], steps: int) -> Row:
    """Means over the steps that were not skipped, and the number of skipped steps."""
    skipped = round(sums.get("skipped", 0))
    means: Row = {name: total / max(1, steps - skipped) for name, total in sums.items()}
    return means | ({"skipped": skipped} if "skipped" in sums else {})


def _describe_progress(position: RunPosition, task: Task, rate: float) -> str:
    """The figures beside the progress bar: the mean loss of the epoch so far, and the speed."""
    steps = task.steps_per_epoch
    loss = mean_figures(position.sums, position.step - position.epoch * steps)["loss"]
    return (
        f"{position.step}/{task.config.optim.epochs * steps}  "
        f"epoch {position.epoch + 1}  loss {loss:.4g}  "
        f"lr {learning_rate(position, task):.2e}  {_format_speed(task, rate)}"
    )


def describe_epoch(row: Row, improved: bool, task: Task) -> Iterator[str]:
    """The line of a finished epoch, with the error of each dataset if there are several, and a
    warning if a layer of the head no longer learns."""
    names = [name for name in task.config.datasets if f"val_rmse/{name}" in row]
    errors = ", ".join(f"{name} {row[f'val_rmse/{name}']:.4f}" for name in names)
    rmse = f"val rmse {row['val_rmse']:.4f} m  " if "val_rmse" in row else ""
    yield (
        f"epoch {row['epoch'] + 1:4d}/{task.config.optim.epochs}  "
        f"loss {row['loss']:.4g}  val {row['val_loss']:.4g}  {rmse}"
        f"{f'({errors})  ' if errors else ''}"
        f"{task.remark(row)}lr {row['learning_rate']:.2e}  "
        f"{_format_speed(task, row[f'{task.unit}_per_second'])}{'  best' if improved else ''}"
    )
    if stuck := stuck_layers(row):
        yield (
            f"warning: no gradient reached {', '.join(stuck)} in this epoch, so the network no "
            "longer learns; train again with a lower optim.learning_rate, or with optim.clip_norm"
        )


def _format_speed(task: Task, rate: float) -> str:
    return f"{rate:,.0f} {task.unit}/s" if rate >= 10 else f"{rate:.2g} {task.unit}/s"


def stuck_layers(row: Row) -> list[str]:
    """Layers of the head that received almost no gradient in the epoch of `row`.

    A training that diverges may end in this state: if every scale s = softplus(·) underflows to 0,
    the gradients of gate and encoder are also 0, and d̂ remains 0. A loss of 0 means that this loss
    has not begun yet (`LossConfig.nll_from_epoch`).
    """
    prefix = "gradient_norm/"
    return [
        name.removeprefix(prefix)
        for name, norm in row.items()
        if name.startswith(f"{prefix}head/") and norm < NO_GRADIENT and row["loss"] != 0
    ]
