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
from gnio_jax import parallel
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Lines, Reporter, Silence
from gnio_jax.training import checkpoint, optimizer, run_folder
from gnio_jax.training.checkpoint import Position, Run, load_run
from gnio_jax.training.filter_task import FilterTask
from gnio_jax.training.recordings import Recordings, set_up
from gnio_jax.training.run_folder import Log
from gnio_jax.training.task import Progress, Row, Task
from gnio_jax.training.window_task import WindowTask

DISPATCH_SECONDS = 0.5
"""Approximate duration of one dispatch of steps, s: few round trips, but a progress bar that moves
and a quick stop."""
CHECKPOINT_SECONDS = 600.0
"""Longest time between checkpoints within an epoch, s; every epoch also ends with one."""
NO_GRADIENT = 1e-9
"""Norm of a gradient, mean over an epoch, below which Adam, whose ε is 1e-8, makes almost no
step."""


class Outcome(NamedTuple):
    """How a training run ended."""

    workdir: Path
    best_loss: float | None
    """Smallest value of `optim.best_by` on the validation split."""
    stopped_by: int | None
    """Signal that ended this run early, or prevented the seeds after it; the state is saved."""


def train(config: TrainConfig, resume: bool = False, **options: Any) -> Outcome:
    """Train the network of `config` and write checkpoints and logs to its work folder. Training is
    on windows, or through the filter if `config.through_filter` names what is trained.

    With `resume` the run continues from its latest checkpoint as if it had never stopped:
    parameters, optimizer, order of the windows or segments, and random draws are functions of the
    seed and the step. A run is resumed by these rules: the settings must be those of config.yaml; a
    run without a checkpoint starts again; log rows after the checkpoint are removed. After SIGTERM
    or Ctrl-C the state is saved and the function returns. A loss or gradient that is not finite
    raises `FloatingPointError` naming the step (through the filter such a step is skipped). The
    other options and errors are those of `train_all`.
    """
    (outcome,) = train_all([config], resume, **options)
    return outcome


def train_all(
    configs: Sequence[TrainConfig],
    resume: bool = False,
    reporter: Reporter | None = None,
    workers: int = 1,
    devices: int | None = None,
    load: Callable[[str], Run] = load_run,
) -> list[Outcome]:
    """`train` for experiments that differ only in their seeds and folders (`config.with_seeds`),
    one after the other. Recordings are read once and steps are compiled once.

    With `resume` finished runs are skipped, begun ones continue from their latest checkpoint, and
    missing ones start. A signal ends the run that it interrupts. The runs after it do not begin and
    have no outcome. `workers` processes read recordings that are slow to read. A batch of windows
    is divided among `devices` devices of each process (`parallel.sharing`); their number changes
    the results only by rounding, even in a run that is resumed. `load` reads what
    `config.init_from` and `config.data.poses_by` name, by default the folder of a run;
    `gnio_jax.load_pretrained` also takes packages of weights. Raises `InputError` where the initial
    run is not of the same network, for settings that do not fit together, for a folder that holds
    another run, and where the devices cannot share a batch evenly.
    """
    reporter = (reporter or Lines()) if parallel.is_first() else Silence()
    begun = [(configuration.default_workdir(each) / "config.yaml").exists() for each in configs]
    resumes = [resume and (there or not any(begun)) for there in begun]
    workdirs = [
        run_folder.refuse_other_run(configuration.validate(config), resume)
        for config, resume in zip(configs, resumes, strict=True)
    ]
    through_filter = bool(configs[0].through_filter.learn)
    if through_filter and devices is not None:
        raise InputError("--devices", "is for training on windows", "leave it out")
    if through_filter and jax.process_count() > 1:
        problem = "runs in one process, on all of its devices"
        raise InputError("training through the filter", problem, "start one process")
    outcomes: list[Outcome] = []
    # Segments are divided by `filtering.over_sequences`, not as a batch of windows is. Only the
    # filter computes in float64, independently of the settings of the process.
    sharing = parallel.sharing(1 if through_filter else devices)
    with jax.enable_x64(through_filter), sharing, _signals() as received:
        resumed = all(resumes) and all(map(checkpoint.exists, workdirs))
        start = None if resumed else checkpoint.initial_run(configs[0], load)
        chosen = FilterTask if through_filter else WindowTask
        task, recordings = set_up(chosen, configs[0], reporter, workers, load)
        for config, resume in zip(configs, resumes, strict=True):
            outcomes.append(_train(task, recordings, config, start, resume, received, reporter))
            (signum,) = parallel.largest(max(received))
            if signum and len(outcomes) < len(configs):
                outcomes[-1] = outcomes[-1]._replace(stopped_by=signum)  # others are missing
                break
    return outcomes


def _train(
    task: Task,
    recordings: Recordings,
    config: TrainConfig,
    start: Run | None,
    resume: bool,
    received: list[int],
    reporter: Reporter,
) -> Outcome:
    """Train one run to its end or until a signal."""
    epochs, steps, source = config.optim.epochs, task.steps_per_epoch, recordings.source
    key = jax.random.key(config.seed)
    of_init, of_order, of_steps = jax.random.split(key, 3)
    of_statistics = jax.random.fold_in(key, 3)
    with_statistics = partial(task.with_statistics, source=source, key=of_statistics)
    # Copies, because steps take the memory of their state, and the next seed also starts from
    # `start`.
    state = parallel.everywhere(task.initial_state(of_init, start and start.variables))
    at = Position()
    with run_folder.opened(config, recordings, state.variables, resume) as workdir:
        for line in task.description(state, workdir):
            reporter.line(line)
        if resume and checkpoint.exists(workdir):
            state, at = checkpoint.restore(workdir, state)
            reporter.line(f"resuming at step {at.step}")
        with Log(workdir, at.epoch, at.step) as log:
            saved = time.perf_counter()
            for epoch in range(at.epoch, epochs):
                order, end = task.order(of_order, epoch, source), (epoch + 1) * steps
                began, before, dispatch, rate = time.perf_counter(), at, 1, 0.0
                while at.step < end:
                    count, tick = min(dispatch, end - at.step), time.perf_counter()
                    numbers = jnp.int32(at.step - epoch * steps), jnp.int32(count)
                    given = *numbers, jnp.float32(at.plateau.factor), of_steps
                    state, progress = task.take_steps(state, source, order, *given)
                    at = after_steps(at, count, jax.device_get(progress), workdir)
                    clock = time.perf_counter()
                    at = at._replace(seconds=before.seconds + clock - began)
                    rate = (at.step - before.step) * config.optim.batch_size / (clock - began)
                    wished = round(DISPATCH_SECONDS * count / (clock - tick))
                    # Clocks differ between processes, and a signal may reach only one of them.
                    dispatch, due, signum = parallel.largest(
                        max(1, min(2 * dispatch, wished)),
                        int(clock - saved > CHECKPOINT_SECONDS),
                        max(received),
                    )
                    reporter.progress("training", at.step / (epochs * steps), _now(at, task, rate))
                    if at.step < end and (due or signum):
                        checkpoint.save(workdir, "latest", with_statistics(state), at)
                        saved = clock
                        if signum:
                            return Outcome(workdir, at.best, signum)
                state, validation = task.validate(
                    with_statistics(state), recordings.held_out, of_statistics
                )
                at, row, improved = finished(at, task, validation, rate)
                log.add(row)
                for line in lines(row, improved, task):
                    reporter.line(line)
                for which in ("best", "latest") if improved else ("latest",):
                    checkpoint.save(workdir, which, state, at)
                (signum,) = parallel.largest(max(received))
                if signum and epoch + 1 < epochs:
                    return Outcome(workdir, at.best, signum)
    return Outcome(workdir, at.best, None)


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Append the numbers of SIGTERM and Ctrl-C to a list that begins with 0, instead of ending the
    process; a second Ctrl-C ends it."""
    received = [0]

    def note(signum: int, _: object) -> None:
        if received[-1] == signal.SIGINT == signum:
            raise KeyboardInterrupt
        received.append(signum)

    handlers: dict[Any, Any] = {
        signum: signal.signal(signum, note) for signum in (signal.SIGTERM, signal.SIGINT)
    }
    try:
        yield received
    finally:
        for signum, handler in handlers.items():
            signal.signal(signum, handler)


# What follows from the figures
# ------------------------------------------------------------------------------------------------


def after_steps(at: Position, count: int, progress: Progress, workdir: Path) -> Position:
    """The position of the run in `workdir` after `count` more steps. Raises `FloatingPointError` if
    one of them failed."""
    if progress.failed_step >= 0:
        raise FloatingPointError(
            f"{workdir}: the loss or its gradient is not finite at step "
            f"{int(progress.failed_step)} (epoch {at.epoch}); lower optim.learning_rate, set "
            "optim.clip_norm, or look at the data"
        )
    sums = {name: at.sums.get(name, 0.0) + float(more) for name, more in progress.sums.items()}
    return at._replace(step=at.step + count, sums=sums)


def finished(at: Position, task: Task, validation: Row, rate: float) -> tuple[Position, Row, bool]:
    """The end of an epoch at `at`, trained at `rate` windows or segments per second: the position
    at which the next one starts, the log's row, and whether the epoch is the best one so far.

    The choice of the best epoch begins anew with the epoch that changes what is trained, and again
    with the first whole epoch after it. Losses before and after the change cannot be compared, and
    a part that has just begun to learn has learnt little. NaN and infinity are never the best.
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
    return at._replace(epoch=at.epoch + 1, best=best, sums={}, plateau=plateau), row, improved


def learning_rate(at: Position, task: Task) -> float:
    """The network's learning rate at the next step."""
    schedule = optimizer.schedule(task.config.optim, task.steps_per_epoch)
    return float(schedule(at.step)) * at.plateau.factor


def mean_figures(sums: dict[str, float], steps: int) -> Row:
    """Means over the steps that were not skipped, and the number of skipped steps."""
    skipped = round(sums.get("skipped", 0))
    means: Row = {name: total / max(1, steps - skipped) for name, total in sums.items()}
    return means | ({"skipped": skipped} if "skipped" in sums else {})


def _now(at: Position, task: Task, rate: float) -> str:
    """The figures beside the progress bar: the mean loss of the epoch so far, and the speed."""
    steps = task.steps_per_epoch
    loss = mean_figures(at.sums, at.step - at.epoch * steps)["loss"]
    return (
        f"{at.step}/{task.config.optim.epochs * steps}  epoch {at.epoch + 1}  loss {loss:.4g}  "
        f"lr {learning_rate(at, task):.2e}  {_speed(task, rate)}"
    )


def lines(row: Row, improved: bool, task: Task) -> Iterator[str]:
    """The line of a finished epoch, with the error of each dataset if there are several, and a
    warning if a layer of the head no longer learns."""
    names = task.config.datasets
    own = ", ".join(f"{name} {row[f'val_rmse/{name}']:.4f}" for name in names if len(names) > 1)
    yield (
        f"epoch {row['epoch'] + 1:4d}/{task.config.optim.epochs}  "
        f"loss {row['loss']:.4g}  val {row['val_loss']:.4g}  val rmse {row['val_rmse']:.4f} m  "
        f"{f'({own})  ' if own else ''}"
        f"{task.remark(row)}lr {row['learning_rate']:.2e}  "
        f"{_speed(task, row[f'{task.unit}_per_second'])}{'  best' if improved else ''}"
    )
    if stuck := stuck_layers(row):
        yield (
            f"warning: no gradient reached {', '.join(stuck)} in this epoch, so the network no "
            "longer learns; train again with a lower optim.learning_rate, or with optim.clip_norm"
        )


def _speed(task: Task, rate: float) -> str:
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
