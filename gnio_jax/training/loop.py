"""The training loop, top to bottom: one run after another; epochs of dispatches, validation, log,
checkpoints. What follows from their figures is in `epochs`."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax

from gnio_jax import config as configuration
from gnio_jax import parallel
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Lines, Reporter, Silence
from gnio_jax.training import checkpoint, epochs, run_folder
from gnio_jax.training.checkpoint import Run, load_run
from gnio_jax.training.epochs import Position
from gnio_jax.training.filter_task import FilterTask
from gnio_jax.training.run_folder import Log
from gnio_jax.training.task import Recordings, Task, keys_of, set_up
from gnio_jax.training.window_task import WindowTask

DISPATCH_SECONDS = 0.5
"""Steps are dispatched in runs of about this long: few round trips, and still a lively progress bar
and a quick stop."""
CHECKPOINT_SECONDS = 600.0
"""Longest time between checkpoints within an epoch; every epoch ends with one anyway."""


class Outcome(NamedTuple):
    """How a training run ended."""

    workdir: Path
    best_loss: float | None
    """Smallest value on the validation split of what `optim.best_by` names."""
    stopped_by: int | None
    """Signal that ended it early, or the seeds after it; its state is saved."""


def train(
    config: TrainConfig,
    resume: bool = False,
    reporter: Reporter | None = None,
    workers: int = 1,
    devices: int | None = None,
    load_initial: Callable[[str], Run] = load_run,
) -> Outcome:
    """Train the network of `config` and leave checkpoints and logs in its work folder: on windows,
    or through the filter where `config.through_filter` names what is trained.

    With `resume` the run goes on from its latest checkpoint as if it had never stopped: parameters,
    optimizer, order of the windows or segments, and random draws are functions of the seed and the
    step. Resume rules, in order: the settings must be those of config.yaml; without a checkpoint
    yet the run starts over; log rows after the checkpoint are dropped. SIGTERM and Ctrl-C save and
    return; a loss or gradient that is not finite raises `FloatingPointError` naming the step
    (through the filter such a step is skipped). `workers` processes read recordings that are slow
    to read (`data.load`). A batch of windows is shared out among `devices` devices of each process
    (`parallel.sharing`); how many there are changes the results by rounding alone, also in a run
    that is resumed. `load_initial` reads what `config.init_from` names, by default the folder of a
    run; `gnio_jax.load_pretrained` also takes packages of weights. Raises `InputError` where that
    is not of the same network, for settings that do not fit together, for a folder that holds
    another run, and where the devices cannot share a batch evenly.
    """
    (outcome,) = train_all([config], resume, reporter, workers, devices, load_initial)
    return outcome


def train_all(
    configs: Sequence[TrainConfig],
    resume: bool = False,
    reporter: Reporter | None = None,
    workers: int = 1,
    devices: int | None = None,
    load_initial: Callable[[str], Run] = load_run,
) -> list[Outcome]:
    """`train` experiments that differ in nothing but their seeds and folders (`config.with_seeds`),
    one after the other. Recordings are read once and steps are compiled once.

    With `resume` finished runs are skipped, begun ones continue from their latest checkpoint,
    missing ones start. A signal ends the run that it interrupts, and those after it do not begin:
    they have no outcome.
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
    # Segments are shared out by `filtering.over_sequences`, not as a batch of windows is. Whatever
    # the process has set: no float64 but for the filter.
    sharing = parallel.sharing(1 if through_filter else devices)
    with jax.enable_x64(through_filter), sharing, _stop_signals() as stop:
        resumed = all(resumes) and all(map(checkpoint.exists, workdirs))
        start = None if resumed else checkpoint.initial_run(configs[0], load_initial)
        chosen = FilterTask if through_filter else WindowTask
        task, recordings = set_up(chosen, configs[0], reporter, workers)
        for config, resume in zip(configs, resumes, strict=True):
            outcomes.append(_train(task, recordings, config, start, resume, stop, reporter))
            if stop.signum and len(outcomes) < len(configs):
                outcomes[-1] = outcomes[-1]._replace(stopped_by=stop.signum)  # others are missing
                break
    return outcomes


def _train(
    task: Task,
    recordings: Recordings,
    config: TrainConfig,
    start: Run | None,
    resume: bool,
    stop: _Stop,
    reporter: Reporter,
) -> Outcome:
    """One run, to its end or until a signal."""
    optim, steps, keys = config.optim, task.steps_per_epoch, keys_of(config.seed)
    with_statistics = partial(task.with_statistics, source=recordings.source, key=keys.statistics)
    # Copies: steps take the memory of their state, and the next seed starts from `start` too.
    state = parallel.everywhere(task.initial_state(keys.init, start and start.variables))
    at = Position()
    with run_folder.opened(config, recordings, state.variables, resume) as workdir:
        for line in task.description(state, workdir):
            reporter.line(line)
        if resume and checkpoint.exists(workdir):
            state, at = checkpoint.restore(workdir, state)
            reporter.line(f"resuming at step {at.step}")
        with Log(workdir, at.epoch, at.step) as log:
            saved = time.perf_counter()
            for epoch in range(at.epoch, optim.epochs):
                order = task.order(keys.order, epoch, recordings.source)
                end = (epoch + 1) * steps
                began, before, first, dispatch, rate = time.perf_counter(), at, at.step, 1, 0.0
                while at.step < end:
                    count, tick = min(dispatch, end - at.step), time.perf_counter()
                    state, progress = task.take_steps(
                        state,
                        recordings.source,
                        order,
                        at.step - epoch * steps,
                        count,
                        at.plateau.factor,
                        keys.step,
                    )
                    at = epochs.after_steps(at, count, jax.device_get(progress), workdir)
                    clock = time.perf_counter()
                    at = at._replace(seconds=before.seconds + clock - began)
                    rate = (at.step - first) * optim.batch_size / (clock - began)
                    wished = round(DISPATCH_SECONDS * count / (clock - tick))
                    # Clocks differ between processes, and a signal reaches one of them.
                    dispatch, due, signum = parallel.largest(
                        max(1, min(2 * dispatch, wished)),
                        int(clock - saved > CHECKPOINT_SECONDS),
                        stop.received,
                    )
                    share = at.step / (optim.epochs * steps)
                    reporter.progress("training", share, epochs.under_way(at, task, rate))
                    if at.step < end and (due or signum):
                        checkpoint.save(workdir, "latest", with_statistics(state), at)
                        saved = clock
                    if at.step < end and signum:
                        stop.signum = signum
                        return Outcome(workdir, at.best, signum)
                state, validation = task.validate(
                    with_statistics(state), recordings.held_out, keys.statistics
                )
                done = epochs.finish(at, task, validation, rate)
                at = done.at
                log.add(done.row)
                for line in epochs.lines(done, task):
                    reporter.line(line)
                if done.improved:
                    checkpoint.save(workdir, "best", state, at)
                checkpoint.save(workdir, "latest", state, at)
                (stop.signum,) = parallel.largest(stop.received)
                if stop.signum and epoch + 1 < optim.epochs:
                    return Outcome(workdir, at.best, stop.signum)
    return Outcome(workdir, at.best, None)


class _Stop:
    """Whether a signal has asked the run to stop; 0 where none has."""

    received = 0
    """The signal that this process has been sent."""
    signum = 0
    """The signal that one of the processes has been sent, once all of them know."""


@contextmanager
def _stop_signals() -> Iterator[_Stop]:
    """Note SIGTERM and Ctrl-C instead of leaving; a second Ctrl-C leaves at once."""
    stop = _Stop()

    def note(signum: int, _: object) -> None:
        if stop.received == signal.SIGINT == signum:
            raise KeyboardInterrupt
        stop.received = signum

    before: dict[Any, Any] = {
        signum: signal.signal(signum, note) for signum in (signal.SIGTERM, signal.SIGINT)
    }
    try:
        yield stop
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
