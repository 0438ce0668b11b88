"""The training loop, top to bottom: data, state, epochs of dispatches, validation, logs,
checkpoints."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
import yaml
from flax import linen as nn
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from tensorboardX import SummaryWriter

from gnio_jax import config as configuration
from gnio_jax import data
from gnio_jax.config import TrainConfig
from gnio_jax.data import windows
from gnio_jax.files import replacing
from gnio_jax.training import optimizer as optimizers
from gnio_jax.training.checkpoint import Checkpoints, Position, create_model, exists
from gnio_jax.training.losses import stage, switches
from gnio_jax.training.step import (
    TrainState,
    Validation,
    calibrated,
    calibrates,
    create_state,
    epoch_order,
    estimate_statistics,
    normalises,
    train_steps,
    validate,
)
from gnio_jax.types import InputError

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


def default_workdir(config: TrainConfig) -> Path:
    """Where the run goes: its `workdir`, else runs/<dataset>_<model>."""
    return Path(config.workdir or f"runs/{config.dataset}_{config.model.name}")


def prepare_workdir(config: TrainConfig, resume: bool) -> Path:
    """Check that `config` may run in its work folder, before anything is loaded or written.

    A run is never overwritten, and never continued with other settings than it began with.
    """
    workdir = default_workdir(config)
    kept = workdir / "config.yaml"
    if not resume:
        if kept.exists():
            raise InputError(
                workdir,
                "already holds a run",
                "continue it with --resume, or choose another --workdir",
            )
        return workdir
    if not kept.exists():
        raise InputError(
            workdir, "holds no run to resume (config.yaml is missing)", "start it without --resume"
        )
    ours, theirs = (dataclasses.asdict(c) for c in (config, configuration.load(kept)))
    for name in (
        "workdir",
        "data_root",
        "checkpoint_every_seconds",
    ):  # where things lie may change, what is computed may not
        del ours[name], theirs[name]
    for name in ours:
        if ours[name] != theirs[name]:
            raise InputError(
                kept,
                f"'{name}' was {theirs[name]} and is now {ours[name]}",
                "resume with the same settings",
            )
    return workdir


def train(
    config: TrainConfig,
    resume: bool = False,
    console: Console | None = None,
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
    with jax.enable_x64(
        False
    ):  # whatever the process has: no float64 in the step, and the same random draws
        return _train(config, resume, console or Console(stderr=True, soft_wrap=True), workers)


def _train(config: TrainConfig, resume: bool, console: Console, workers: int) -> Outcome:
    configuration.validate(config)
    workdir = prepare_workdir(config, resume)
    run = _prepare(config, console, workers)
    state = create_state(run.model, run.optimizer, run.init_key, config.data.window)
    console.print(
        f"{config.model.name}: {sum(x.size for x in jax.tree.leaves(state.params)):,} parameters on {jax.devices()[0].platform}, "
        f"{run.steps_per_epoch} steps of {config.optim.batch_size} windows an epoch, {config.optim.epochs} epochs → {workdir}"
    )
    for what, step in zip(
        ("the likelihood counts", "the uncertainty learns"),
        switches(config.loss, run.steps_per_epoch),
        strict=True,
    ):
        if step > 0:
            console.print(
                f"{what} from step {step:,} of {config.optim.epochs * run.steps_per_epoch:,}"
            )

    workdir.mkdir(parents=True, exist_ok=True)
    if not resume:
        configuration.save(workdir / "config.yaml", config)
    _keep_splits(workdir / "splits.yaml", run.splits)
    position = Position(epoch=0, step=0, best_loss=None, loss_sums=(0.0, 0.0, 0.0), seconds=0.0)
    with (
        Checkpoints(workdir) as checkpoints,
        _stop_signals() as stop,
        _progress(console, config.optim.epochs * run.steps_per_epoch) as bar,
    ):
        if resume and exists(workdir):
            state, position = checkpoints.restore(state)
            console.print(f"resuming at step {position.step}")
        rows = _kept_rows(workdir / "metrics.jsonl", position.epoch)
        board = SummaryWriter(str(workdir / "tensorboard"), purge_step=position.step)
        for epoch in range(position.epoch, config.optim.epochs):
            state, position, rate = _run_epoch(run, epoch, state, position, checkpoints, stop, bar)
            if position.step < (epoch + 1) * run.steps_per_epoch:
                break  # stopped on the way, and saved

            state = run.estimated(state)
            state, held_out = _validated(run, state, position.step)
            row = _row(run, epoch, position, held_out, rate)
            merit = row["val_loss" if config.optim.best_by == "loss" else "val_mse"]
            improved = (
                position.best_loss is None
                or _switched(run, position.step)
                or merit < position.best_loss
            )
            best_loss = merit if improved else position.best_loss
            # The position of a finished epoch is the start of the next one.
            position = position._replace(
                epoch=epoch + 1,
                best_loss=best_loss,
                loss_sums=(0.0, 0.0, 0.0),
                gradient_norms={},
                plateau=optimizers.watch(position.plateau, row["val_mse"], config.optim),
            )
            rows.append(row)
            _write_rows(workdir / "metrics.jsonl", rows)
            for name, value in row.items():
                board.add_scalar(name, value, position.step)
            console.print(
                f"epoch {epoch + 1:4d}/{config.optim.epochs}  loss {row['loss']:.4g}  val {row['val_loss']:.4g}  "
                f"val rmse {row['val_rmse']:.4f} m  lr {row['learning_rate']:.2e}  {rate:,.0f} windows/s{'  best' if improved else ''}"
            )
            if improved:
                checkpoints.save("best", state, position)
            checkpoints.save("latest", state, position)
            if stop.signum:
                break
        board.close()
    return Outcome(workdir, position.best_loss, stop.signum)


class _Run(NamedTuple):
    """What stays the same from the first step of a run to its last."""

    config: TrainConfig
    model: nn.Module
    optimizer: optax.GradientTransformationExtraArgs
    learning_rate: optax.Schedule
    source: windows.WindowSource
    held_out: windows.WindowSource
    splits: dict[str, list[str]]
    """Names of the recordings of each split."""
    steps_per_epoch: int
    init_key: jax.Array
    order_key: jax.Array
    step_key: jax.Array
    statistics_key: jax.Array

    def estimated(self, state: TrainState) -> TrainState:
        """The state as it is validated and kept: with the statistics of its batch normalisations
        estimated anew, if asked for."""
        if not self.config.optim.statistics_windows or not normalises(state):
            return state
        return estimate_statistics(
            state, self.source, self.statistics_key, model=self.model, config=self.config
        )


def _prepare(config: TrainConfig, console: Console, workers: int) -> _Run:
    model = create_model(config)  # a mistake in its options should not wait for the data
    console.print(
        f"reading {config.dataset}: {config.data.train_split} and {config.data.val_split}"
    )
    source, learnt_from = _load_windows(
        config,
        config.data.train_split,
        config.data.train_stride,
        config.augment.shift_samples,
        console,
        workers,
    )
    held_out, validated_with = _load_windows(
        config, config.data.val_split, config.data.stride, 0, console, workers
    )
    splits = {config.data.train_split: learnt_from, config.data.val_split: validated_with}
    count, size = source.visited.shape[0], config.optim.batch_size
    if count < size:
        raise InputError(
            "optim.batch_size", f"is {size}, but there are only {count} windows", "lower it"
        )
    steps_per_epoch = count // size
    key = jax.random.key(config.seed)
    init_key, order_key, step_key = jax.random.split(key, 3)
    statistics_key = jax.random.fold_in(key, 3)
    return _Run(config, model, optimizers.create(config.optim, config.loss, steps_per_epoch),
                optimizers.schedule(config.optim, steps_per_epoch), source, held_out, splits, steps_per_epoch,
                init_key, order_key, step_key, statistics_key)  # fmt: skip


def _run_epoch(
    run: _Run,
    epoch: int,
    state: TrainState,
    position: Position,
    checkpoints: Checkpoints,
    stop: _Stop,
    bar: Callable[[int, int, float, float, float], None],
) -> tuple[TrainState, Position, float]:
    """Finish epoch `epoch` from `position` on, or save and return when asked to stop; with the
    windows/s of these steps."""
    size = run.config.optim.batch_size
    order = epoch_order(run.order_key, epoch, run.source)
    began = saved = time.perf_counter()
    before, first = position.seconds, position.step - epoch * run.steps_per_epoch
    done, dispatch, rate = first, 1, 0.0
    while done < run.steps_per_epoch:
        count = min(dispatch, run.steps_per_epoch - done)
        tick = time.perf_counter()
        state, progress = train_steps(state, run.source, order, jnp.int32(done), jnp.int32(count),
                                      jnp.float32(position.plateau.factor), run.step_key,
                                      model=run.model, optimizer=run.optimizer, config=run.config)  # fmt: skip
        failed_step = int(progress.failed_step)  # waits for the device
        if failed_step >= 0:
            raise FloatingPointError(
                f"the loss is not finite at step {failed_step} (epoch {epoch}); lower optim.learning_rate, "
                "set optim.clip_norm, or look at the data"
            )
        clock = time.perf_counter()
        dispatch = max(1, min(2 * dispatch, round(DISPATCH_SECONDS * count / (clock - tick))))
        done += count
        sums = tuple(a + float(b) for a, b in zip(position.loss_sums, progress.sums, strict=True))
        norms = {
            part: position.gradient_norms.get(part, 0.0) + float(norm)
            for part, norm in progress.gradient_norms.items()
        }
        position = position._replace(
            step=epoch * run.steps_per_epoch + done,
            loss_sums=sums,
            gradient_norms=norms,
            seconds=before + clock - began,
        )
        rate = (done - first) * size / (clock - began)
        bar(position.step, epoch, sums[0] / done, _learning_rate(run, position), rate)
        if done < run.steps_per_epoch and (
            stop.signum or clock - saved > run.config.checkpoint_every_seconds
        ):
            checkpoints.save("latest", run.estimated(state), position)
            saved = time.perf_counter()
            if stop.signum:
                break
    return state, position, rate


def _validated(run: _Run, state: TrainState, step: int) -> tuple[TrainState, Validation]:
    """The state as it is kept, its uncertainty calibrated where it has constants for that, and the
    losses of that state."""
    validated = functools.partial(validate, source=run.held_out, now=stage(run.config.loss, step - 1, run.steps_per_epoch),
                                  model=run.model, config=run.config)  # fmt: skip
    found = validated(state)
    if not calibrates(state):
        return state, found
    state = calibrated(state, found)
    return state, validated(state)


def _switched(run: _Run, step: int) -> bool:
    """Whether the epoch that ends at `step` changed what is trained, or is the first whole one
    after such a change: losses before and after do not compare, and what has just begun to learn
    has learnt little."""
    return any(
        step - 2 * run.steps_per_epoch < switch < step
        for switch in switches(run.config.loss, run.steps_per_epoch)
    )


def _row(
    run: _Run, epoch: int, position: Position, held_out: Validation, rate: float
) -> dict[str, int | float]:
    """The log's line of a finished epoch: mean losses of training (as its steps met them) and of
    validation."""
    loss, mse, nll = (x / run.steps_per_epoch for x in position.loss_sums)
    val_loss, val_mse, val_nll = (float(x) for x in held_out.losses)
    return {
        "epoch": epoch, "step": position.step, "loss": loss, "mse": mse, "nll": nll,
        "val_loss": val_loss, "val_mse": val_mse, "val_nll": val_nll, "val_rmse": math.sqrt(val_mse),
        **{f"val_normalised/{axis}": float(x) for axis, x in zip("xyz", held_out.axis_normalised, strict=True)},
        "learning_rate": _learning_rate(run, position), "windows_per_second": rate, "seconds": position.seconds,
        **{f"gradient_norm/{part}": norm / run.steps_per_epoch for part, norm in position.gradient_norms.items()},
    }  # fmt: skip


def _learning_rate(run: _Run, position: Position) -> float:
    return float(run.learning_rate(position.step)) * position.plateau.factor


def _load_windows(
    config: TrainConfig, split: str, stride: int, shift: int, console: Console, workers: int
) -> tuple[windows.WindowSource, list[str]]:
    """The windows of a split on the device, and the names of its recordings."""
    sequences = [
        data.resample(s, config.data.rate)
        for s in data.load(config.dataset, config.data_root, split, workers)
    ]
    source = windows.window_source(sequences, config.data, stride, shift)
    hours = sum(len(s.time) for s in sequences) / config.data.rate / 3600
    console.print(
        f"  {split}: {len(sequences)} sequences, {hours:.2f} h, {source.visited.shape[0]:,} windows"
    )
    return jax.device_put(source), [s.name for s in sequences]


def _keep_splits(path: Path, splits: dict[str, list[str]]) -> None:
    """Note which recordings the network learns from and is chosen by: hold-outs are drawn from what
    a copy of the data holds.

    Raises `InputError` when the run was begun with others.
    """
    if not path.exists():
        with replacing(path) as temporary:
            temporary.write_text(
                yaml.safe_dump(splits, sort_keys=False, allow_unicode=True), encoding="utf-8"
            )
        return
    try:
        before = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(
            path,
            f"cannot be read ({' '.join(str(error).split())})",
            "remove it, and the recordings are noted anew",
        ) from None
    for split, names in splits.items():
        theirs = before.get(split) if isinstance(before, dict) else None
        if names != theirs:
            changed = sorted(set(names) ^ set(theirs if isinstance(theirs, list) else []))
            raise InputError(
                path,
                f"the run was begun with other recordings in split '{split}' ({len(changed)} differ"
                f"{f', e.g. {changed[0]}' if changed else ', their order does'})",
                "resume with the same data",
            )


def _kept_rows(path: Path, epoch: int) -> list[dict]:
    """The log of the epochs before `epoch`; a resumed run writes the others again."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [row for row in map(json.loads, lines) if row["epoch"] < epoch]


def _write_rows(path: Path, rows: list[dict]) -> None:
    with replacing(path) as temporary:
        temporary.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


class _Stop:
    signum: int | None = None


@contextmanager
def _stop_signals() -> Iterator[_Stop]:
    """SIGTERM and Ctrl-C ask the loop to save and leave; a second Ctrl-C leaves at once."""
    stop = _Stop()

    def ask(signum: int, _: object) -> None:
        if stop.signum == signal.SIGINT == signum:
            raise KeyboardInterrupt
        stop.signum = signum

    before = {signum: signal.signal(signum, ask) for signum in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stop
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


@contextmanager
def _progress(console: Console, total_steps: int):
    """A bar with losses, learning rate, windows/s and the time left; on a log file only the epoch
    lines remain."""
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[numbers]}"), TimeElapsedColumn(),
               TimeRemainingColumn(elapsed_when_finished=True))  # fmt: skip
    with Progress(
        *columns,
        console=console,
        disable=not console.is_terminal,
        transient=True,
        speed_estimate_period=120,
    ) as progress:
        task = progress.add_task("training", total=total_steps, numbers="compiling")

        def update(step: int, epoch: int, loss: float, learning_rate: float, rate: float) -> None:
            numbers = f"loss {loss:.4g}  lr {learning_rate:.2e}  {rate:,.0f} windows/s"
            progress.update(task, completed=step, description=f"epoch {epoch + 1}", numbers=numbers)

        yield update
