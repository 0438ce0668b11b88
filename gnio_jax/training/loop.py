"""The training loop, top to bottom: set-up, epochs of dispatches, validation, log, checkpoints.

It trains any number of seeds of an experiment together. Each is a run with a folder of its own; one
seed is the case of length one.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import jax

from gnio_jax import config as configuration
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Lines, Reporter, Silence
from gnio_jax.scaling.devices import BATCH, SEEDS, chosen, sharing
from gnio_jax.scaling.processes import agreed, all_or_none, is_first, several
from gnio_jax.training import run_folder
from gnio_jax.training.checkpoint import Checkpoints, Run, exists, load_run
from gnio_jax.training.initial import initial_run
from gnio_jax.training.kinds import Training
from gnio_jax.training.log import Log
from gnio_jax.training.seed_runs import (
    BEGINNING,
    Group,
    SeedRun,
    after_steps,
    improves,
    learning_rate,
    next_epoch,
    row_of,
    speed,
    stuck_head,
    summary,
)
from gnio_jax.training.setup import set_up
from gnio_jax.training.step import TrainState
from gnio_jax.training.stopping import Stop, stop_signals
from gnio_jax.training.together import together

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
    _check_devices(config, devices)
    through_filter = bool(config.through_filter.learn)
    sharers = jax.devices()[:1] if through_filter else chosen(devices)
    # Whatever the process has: no float64 but for the filter, and the same random draws.
    with jax.enable_x64(through_filter), sharing(sharers, BATCH):
        (outcome,) = _train([config], resume, reporter or Lines(), workers, load_initial)
    return outcome


def train_seeds(
    config: TrainConfig,
    seeds: Sequence[int],
    resume: bool = False,
    reporter: Reporter | None = None,
    workers: int = 1,
    devices: int | None = None,
    load_initial: Callable[[str], Run] = load_run,
) -> list[Outcome]:
    """Train `config` with each of these seeds together, as `train` would in the work folders
    WORKDIR_s0, WORKDIR_s1, ... (`config.with_seeds`).

    Recordings are read once, and the seeds share what is compiled. `devices` devices, by default
    all, share the seeds out among them: a device has whole seeds, and a batch is not shared. Each
    run has the numbers that it has alone, to rounding; it may be resumed alone, and `resume` takes
    runs that were trained alone, also those that stand at different steps. Raises
    `FloatingPointError` and `InputError` as `train`, and `InputError` in several processes, for no
    seed, and for one that is named twice.
    """
    configs = configuration.with_seeds(config, seeds)
    if len(configs) > 1 and several():
        remedy = "start one process, or each seed as a run of its own"
        raise InputError("--seeds", "run in one process, on all of its devices", remedy)
    _check_devices(config, devices)
    through_filter = bool(config.through_filter.learn)
    sharers = jax.devices()[:1] if through_filter else chosen(devices)[: len(configs)]
    with jax.enable_x64(through_filter), sharing(sharers, SEEDS):
        return _train(configs, resume, reporter or Lines(), workers, load_initial)


def _check_devices(config: TrainConfig, devices: int | None) -> None:
    """Training through the filter shares its pieces out by itself."""
    if config.through_filter.learn and several():
        problem = "runs in one process, on all of its devices"
        raise InputError("training through the filter", problem, "start one process")
    if config.through_filter.learn and devices is not None:
        raise InputError("--devices", "is for training on windows", "leave it out")


def _train(
    configs: list[TrainConfig],
    resume: bool,
    reporter: Reporter,
    workers: int,
    load_initial: Callable[[str], Run],
) -> list[Outcome]:
    """Set the runs up, and train them."""
    reporter = reporter if is_first() else Silence()
    for config in configs:
        configuration.validate(config)
    with all_or_none():
        workdirs = [run_folder.prepare(config, resume) for config in configs]
    resuming = agreed(*(resume and is_first() and exists(workdir) for workdir in workdirs))
    with all_or_none():
        start = None if all(resuming) else initial_run(configs[0], load_initial)
        first = set_up(configs[0], reporter, workers)
        trainings = [first, *(first.with_seed(config.seed) for config in configs[1:])]
        states = [training.new_state(start) for training in trainings]
        _describe(trainings, workdirs, states[0], reporter)
        for config, workdir in zip(configs, workdirs, strict=True):
            run_folder.write_settings(workdir, config, first.splits, resume)
    run_folder.compare_processes(configs[0], first.splits, first.recordings, states[0].variables)
    with stop_signals() as stop, ExitStack() as opened:
        runs = []
        for config, workdir, training in zip(configs, workdirs, trainings, strict=True):
            name = f"seed {config.seed}: " if len(configs) > 1 else ""
            checkpoints = opened.enter_context(Checkpoints(workdir))
            runs.append(SeedRun(name, workdir, training, checkpoints, BEGINNING))
        for k in range(len(runs)):
            if resuming[k]:
                runs[k], states[k] = _restored(runs[k], states[k], reporter)
        runs = _train_all(runs, states, stop, reporter)
        return [Outcome(run.workdir, run.position.best_loss, stop.signum) for run in runs]


def _restored(run: SeedRun, template: TrainState, reporter: Reporter) -> tuple[SeedRun, TrainState]:
    """A run at its latest checkpoint."""
    state, position = run.checkpoints.restore(template)
    reporter.line(f"{run.name}resuming at step {position.step}")
    return run._replace(position=position), state


def _train_all(
    runs: list[SeedRun], states: list[TrainState], stop: Stop, reporter: Reporter
) -> list[SeedRun]:
    """Train the runs that stand at the same step together, to their end."""
    ended = {}
    for group in _at_the_same_step(runs, states):
        for run in _train_group(group, stop, reporter).runs:
            ended[run.workdir] = run
    return [ended[run.workdir] for run in runs]


def _describe(
    trainings: list[Training], workdirs: list[Path], state: TrainState, reporter: Reporter
) -> None:
    trainings[0].describe(state, workdirs[0], reporter)
    for training, workdir in zip(trainings[1:], workdirs[1:], strict=True):
        reporter.line(f"together with seed {training.config.seed} → {workdir}")


def _at_the_same_step(runs: list[SeedRun], states: list[TrainState]) -> Iterator[Group]:
    """Runs that are resumed may stand at different steps, e.g. where they were killed while some
    had saved. Those that are behind come first."""
    in_order = sorted(zip(runs, states, strict=True), key=lambda each: each[0].position.step)
    for _, same in itertools.groupby(in_order, key=lambda each: each[0].position.step):
        members, their_states = zip(*same, strict=True)
        program = together([run.training for run in members])
        yield Group(members, program, program.joined(their_states))


def _train_group(group: Group, stop: Stop, reporter: Reporter) -> Group:
    """Train to the end, or until asked to stop."""
    training, position = group.training, group.runs[0].position
    with ExitStack() as opened:
        logs = [
            opened.enter_context(Log(run.workdir, position.epoch, position.step))
            for run in group.runs
        ]
        for epoch in range(position.epoch, training.config.optim.epochs):
            if stop.signum:
                break
            group, rate = _run_epoch(group, epoch, stop, reporter)
            if group.step < (epoch + 1) * training.steps_per_epoch:
                break  # stopped on the way, and saved

            group = _end_epoch(group, epoch, rate, logs, reporter)
            stop.agree()
    return group


def _run_epoch(group: Group, epoch: int, stop: Stop, reporter: Reporter) -> tuple[Group, float]:
    """Finish epoch `epoch`, or save and return when asked to stop; with the windows or pieces of a
    seed per second of these steps."""
    training = group.training
    order, steps = group.together.order(epoch), training.steps_per_epoch
    began = saved = time.perf_counter()
    seconds, first = [run.position.seconds for run in group.runs], group.step - epoch * steps
    done, dispatch, rate = first, 1, 0.0
    while done < steps:
        count = min(dispatch, steps - done)
        tick = time.perf_counter()
        group = _run_steps(group, order, epoch, done, count)
        clock = time.perf_counter()
        dispatch = max(1, min(2 * dispatch, round(DISPATCH_SECONDS * count / (clock - tick))))
        due = int(clock - saved > training.config.checkpoint_every_seconds)
        dispatch, due = agreed(dispatch, due)  # the clocks of the processes differ
        stop.agree()
        done += count
        group = group.at(
            [
                run.position._replace(seconds=before + clock - began)
                for run, before in zip(group.runs, seconds, strict=True)
            ]
        )
        rate = (done - first) * training.config.optim.batch_size / (clock - began)
        _report(group, epoch, done, rate, reporter)
        if done < steps and (stop.signum or due):
            group._replace(states=group.together.settled(group.states)).save()
            saved = time.perf_counter()
            if stop.signum:
                break
    return group, rate


def _run_steps(group: Group, order: Any, epoch: int, first: int, count: int) -> Group:
    """Take `count` steps of an epoch from its step `first` on, in one dispatch."""
    factors = [run.position.plateau.factor for run in group.runs]
    states, found = group.together.take_steps(group.states, order, first, count, factors)
    step = epoch * group.training.steps_per_epoch + first + count
    positions = [
        after_steps(run, progress, epoch, step)
        for run, progress in zip(group.runs, found, strict=True)
    ]
    return group._replace(states=states).at(positions)


def _end_epoch(
    group: Group, epoch: int, rate: float, logs: Sequence[Log], reporter: Reporter
) -> Group:
    """Validate, and write the row and the checkpoints of each run."""
    states = group.together.settled(group.states)
    states, found = group.together.validate(states, group.step)
    group = group._replace(states=states)
    positions = []
    for run, state, figures, log in zip(
        group.runs, group.together.apart(states), found, logs, strict=True
    ):
        row = row_of(run, epoch, figures, rate)
        by_loss = run.training.config.optim.best_by == "loss"
        merit = row["val_loss" if by_loss else "val_mse"]
        improved = improves(run.training, run.position, merit)
        best = merit if improved else None
        position = next_epoch(run.training, epoch, run.position, row, best)
        log.add(row)
        reporter.line(summary(run, row) + ("  best" if improved else ""))
        if warning := stuck_head(row):
            reporter.line(run.name + warning)
        if improved:
            run.checkpoints.save("best", state, position)
        run.checkpoints.save("latest", state, position)
        positions.append(position)
    return group.at(positions)


def _report(group: Group, epoch: int, done: int, rate: float, reporter: Reporter) -> None:
    """The progress of the runs: the mean loss of the epoch so far, over the seeds too, and what all
    of them do in a second."""
    training, step = group.training, group.step
    steps = training.config.optim.epochs * training.steps_per_epoch
    losses = [training.training_figures(run.position.loss_sums, done)["loss"] for run in group.runs]
    numbers = (
        f"{step}/{steps}  epoch {epoch + 1}  loss {sum(losses) / len(losses):.4g}  "
        f"lr {learning_rate(group.runs[0]):.2e}  {speed(training, rate * len(losses))}"
    )
    reporter.progress("training", step / steps, numbers)
