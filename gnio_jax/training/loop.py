"""The training loop, top to bottom: data, state, epochs of dispatches, validation, logs, checkpoints."""

from __future__ import annotations

import dataclasses
import json
import math
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from tensorboardX import SummaryWriter

from gnio_jax import config as configuration
from gnio_jax import data
from gnio_jax.config import TrainConfig
from gnio_jax.data import windows
from gnio_jax.files import replacing
from gnio_jax.training import optimizer as optimizers
from gnio_jax.training.checkpoint import Checkpoints, Position, create_model, exists
from gnio_jax.training.step import create_state, epoch_order, train_steps, validate
from gnio_jax.types import InputError

DISPATCH_SECONDS = 0.5
"""Steps are dispatched in runs of about this long: few round trips, and still a lively progress bar and a quick stop."""


class Outcome(NamedTuple):
    """How a training run ended."""

    workdir: Path
    best_loss: float | None
    """Smallest validation loss."""
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
            raise InputError(workdir, "already holds a run", "continue it with --resume, or choose another --workdir")
        return workdir
    if not kept.exists():
        raise InputError(workdir, "holds no run to resume (config.yaml is missing)", "start it without --resume")
    ours, theirs = (dataclasses.asdict(c) for c in (config, configuration.load(kept)))
    for name in ("workdir", "data_root", "checkpoint_every_seconds"):  # where things lie may change, what is computed may not
        ours.pop(name), theirs.pop(name)
    for name in ours:
        if ours[name] != theirs[name]:
            raise InputError(kept, f"'{name}' was {theirs[name]} and is now {ours[name]}", "resume with the same settings")
    return workdir


def train(config: TrainConfig, resume: bool = False, console: Console | None = None) -> Outcome:
    """Train the network of `config` and leave checkpoints and logs in its work folder.

    With `resume` the run goes on from its latest checkpoint as if it had never stopped: parameters, optimizer, order of
    the windows and random draws are functions of the seed and the step. Resume rules, in order: the settings must be
    those of config.yaml; without a checkpoint yet the run starts over; log rows after the checkpoint are dropped.
    SIGTERM and Ctrl-C save and return; a loss that is not finite raises `FloatingPointError` naming the step.
    """
    with jax.enable_x64(False):  # whatever the process has: no float64 in the step, and the same random draws
        return _train(config, resume, console or Console(stderr=True, soft_wrap=True))


def _train(config: TrainConfig, resume: bool, console: Console) -> Outcome:
    configuration.validate(config)
    workdir = prepare_workdir(config, resume)
    model = create_model(config)

    console.print(f"reading {config.dataset}: {config.data.train_split} and {config.data.val_split}")
    source, held_out = (_load_windows(config, split, console) for split in (config.data.train_split, config.data.val_split))
    steps_per_epoch = source.start.shape[0] // config.optim.batch_size
    if steps_per_epoch == 0:
        raise InputError("optim.batch_size", f"is {config.optim.batch_size}, but there are only {source.start.shape[0]} windows", "lower it")
    total_steps = config.optim.epochs * steps_per_epoch

    optimizer = optimizers.create(config.optim, steps_per_epoch)
    learning_rate = optimizers.schedule(config.optim, steps_per_epoch)
    init_key, order_key, step_key = jax.random.split(jax.random.key(config.seed), 3)
    state = create_state(model, optimizer, init_key, config.data.window)
    console.print(f"{config.model.name}: {sum(x.size for x in jax.tree.leaves(state.params)):,} parameters on {jax.devices()[0].platform}, "
                  f"{steps_per_epoch} steps of {config.optim.batch_size} windows an epoch, {config.optim.epochs} epochs → {workdir}")

    workdir.mkdir(parents=True, exist_ok=True)
    if not resume:
        configuration.save(workdir / "config.yaml", config)
    position = Position(epoch=0, step=0, best_loss=None, loss_sums=(0.0, 0.0, 0.0), seconds=0.0)
    with Checkpoints(workdir) as checkpoints, _stop_signals() as stop, _progress(console, total_steps) as bar:
        if resume and exists(workdir):
            state, position = checkpoints.restore(state)
            console.print(f"resuming at step {position.step} of {total_steps}")
        rows = _kept_rows(workdir / "metrics.jsonl", position.epoch)
        board = SummaryWriter(str(workdir / "tensorboard"), purge_step=position.step)
        began = time.perf_counter() - position.seconds
        saved_at, dispatch = time.perf_counter(), 1
        nll_weight = jnp.float32(0)

        for epoch in range(position.epoch, config.optim.epochs):
            order = epoch_order(order_key, epoch, source.start.shape[0])
            nll_weight = jnp.float32(config.loss.nll_weight if epoch >= config.loss.nll_from_epoch else 0.0)
            sums, done = position.loss_sums, position.step - epoch * steps_per_epoch
            epoch_began, first_done = time.perf_counter(), done

            while done < steps_per_epoch:
                count = min(dispatch, steps_per_epoch - done)
                tick = time.perf_counter()
                state, progress = train_steps(state, source, order, jnp.int32(done), jnp.int32(count), nll_weight, step_key,
                                              model=model, optimizer=optimizer, config=config)  # fmt: skip
                failed_step = int(progress.failed_step)  # waits for the device
                if failed_step >= 0:
                    raise FloatingPointError(f"the loss is not finite at step {failed_step} (epoch {epoch}); lower optim.learning_rate, "
                                             f"set optim.clip_norm, or look at the data")
                # The first dispatch of a process compiles; its time says nothing of a step's.
                dispatch = max(1, min(2 * dispatch, round(DISPATCH_SECONDS * count / (time.perf_counter() - tick))))
                sums = tuple(a + float(b) for a, b in zip(sums, progress.sums, strict=True))
                done += count
                position = position._replace(epoch=epoch, step=epoch * steps_per_epoch + done, loss_sums=sums, seconds=time.perf_counter() - began)
                bar(position.step, epoch, sums[0] / done, float(learning_rate(position.step)),
                    (done - first_done) * config.optim.batch_size / (time.perf_counter() - epoch_began))  # fmt: skip
                if done < steps_per_epoch and (stop.signum or time.perf_counter() - saved_at > config.checkpoint_every_seconds):
                    checkpoints.save("latest", state, position)
                    saved_at = time.perf_counter()
                if stop.signum and done < steps_per_epoch:
                    return Outcome(workdir, position.best_loss, stop.signum)

            rate = (steps_per_epoch - first_done) * config.optim.batch_size / (time.perf_counter() - epoch_began)
            held = [float(x) for x in validate(state, held_out, nll_weight, model=model, config=config)]
            train_loss, train_mse, train_nll = (x / steps_per_epoch for x in sums)
            row = {
                "epoch": epoch, "step": position.step, "loss": train_loss, "mse": train_mse, "nll": train_nll,
                "val_loss": held[0], "val_mse": held[1], "val_nll": held[2], "val_rmse": math.sqrt(held[1]),
                "learning_rate": float(learning_rate(position.step)), "windows_per_second": rate, "seconds": position.seconds,
            }  # fmt: skip
            improved = position.best_loss is None or held[0] < position.best_loss
            # The position of a finished epoch is the start of the next one.
            position = position._replace(epoch=epoch + 1, best_loss=held[0] if improved else position.best_loss, loss_sums=(0.0, 0.0, 0.0))
            rows.append(row)
            _write_rows(workdir / "metrics.jsonl", rows)
            for name, value in row.items():
                board.add_scalar(name, value, position.step)
            console.print(f"epoch {epoch + 1:4d}/{config.optim.epochs}  loss {train_loss:.4g}  val {held[0]:.4g}  val rmse {row['val_rmse']:.4f} m  "
                          f"lr {row['learning_rate']:.2e}  {rate:,.0f} windows/s{'  best' if improved else ''}")
            if improved:
                checkpoints.save("best", state, position)
            checkpoints.save("latest", state, position)
            saved_at = time.perf_counter()
            if stop.signum:
                return Outcome(workdir, position.best_loss, stop.signum)
    return Outcome(workdir, position.best_loss, None)


def _load_windows(config: TrainConfig, split: str, console: Console) -> windows.WindowSource:
    sequences = [data.resample(s, config.data.rate) for s in data.load(config.dataset, config.data_root, split)]
    source = windows.index(sequences, config.data)
    hours = sum(len(s.time) for s in sequences) / config.data.rate / 3600
    console.print(f"  {split}: {len(sequences)} sequences, {hours:.2f} h, {source.start.shape[0]:,} windows")
    return jax.device_put(source)


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
    """A bar with losses, learning rate, windows/s and the time left; on a log file only the epoch lines remain."""
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[numbers]}"), TimeElapsedColumn(),
               TimeRemainingColumn(elapsed_when_finished=True))  # fmt: skip
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True, speed_estimate_period=120) as progress:
        task = progress.add_task("training", total=total_steps, numbers="compiling")

        def update(step: int, epoch: int, loss: float, learning_rate: float, rate: float) -> None:
            numbers = f"loss {loss:.4g}  lr {learning_rate:.2e}  {rate:,.0f} windows/s"
            progress.update(task, completed=step, description=f"epoch {epoch + 1}", numbers=numbers)

        yield update
