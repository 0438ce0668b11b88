"""Training on windows: each one apart, against the displacement of the reference."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn

from gnio_jax.config import TrainConfig
from gnio_jax.data import windows
from gnio_jax.reporting import Reporter
from gnio_jax.scaling import devices
from gnio_jax.training import optimizer as optimizers
from gnio_jax.training.batch_statistics import estimate_statistics, normalises, statistics_order
from gnio_jax.training.checkpoint import Run, create_model
from gnio_jax.training.initial import with_weights
from gnio_jax.training.kinds import (
    Keys,
    compiled,
    describe_split,
    keys_of,
    read_split,
    size_of,
    steps_in_epoch,
)
from gnio_jax.training.log import Row
from gnio_jax.training.losses import stage, switches
from gnio_jax.training.step import (
    Progress,
    TrainState,
    added,
    create_state,
    epoch_order,
    evaluated,
    train_steps,
)
from gnio_jax.training.supply import Epoch, FromHost, Supply, stored, supplied
from gnio_jax.training.validation import (
    Validation,
    calibrated,
    calibrates,
    isotropic,
    mean_of,
    validate,
)
from gnio_jax.types import Sequence


class WindowTraining(NamedTuple):
    """A `kinds.Training`."""

    config: TrainConfig
    model: nn.Module
    optimizer: optax.GradientTransformationExtraArgs
    schedule: optax.Schedule
    source: windows.WindowSource
    """Training windows, on the device or on the disk."""
    held_out: windows.WindowSource
    """Validation windows, likewise."""
    splits: dict[str, list[str]]
    steps_per_epoch: int
    keys: Keys
    supply: Supply
    """How they come to the device."""
    unit: str = "windows"

    @property
    def recordings(self) -> Any:
        return self.source, self.held_out, isinstance(self.supply, FromHost)

    @property
    def changes(self) -> tuple[int, ...]:
        return switches(self.config.loss, self.steps_per_epoch)

    def with_seed(self, seed: int) -> WindowTraining:
        config = dataclasses.replace(self.config, seed=seed)
        return self._replace(config=config, keys=keys_of(seed))

    def new_state(self, start: Run | None) -> TrainState:
        window, decay = self.config.data.seen, self.config.optim.ema_decay
        state = create_state(self.model, self.optimizer, self.keys.init, window, decay)
        if start is not None:
            state = with_weights(state, start)
            average = jax.tree.map(jnp.copy, state.params) if decay else None
            state = state._replace(opt_state=self.optimizer.init(state.params), average=average)
        return devices.everywhere(state)

    def describe(self, state: TrainState, workdir: Path, reporter: Reporter) -> None:
        optim, steps = self.config.optim, self.steps_per_epoch
        reporter.line(
            f"{self.config.model.name}: {size_of(state.params):,} parameters on "
            f"{devices.described()}, {steps} steps of {optim.batch_size} windows an epoch, "
            f"{optim.epochs} epochs → {workdir}"
        )
        likelihood, uncertainty = self.changes
        for what, step in (
            ("the likelihood counts", likelihood),
            ("the uncertainty learns", uncertainty),
        ):
            if step > 0:
                reporter.line(f"{what} from step {step:,} of {optim.epochs * steps:,}")

    def learning_rate(self, step: int) -> float:
        return float(self.schedule(step))

    def order(self, epoch: int) -> Epoch:
        order = epoch_order(self.keys.order, epoch, self.source)
        return self.supply.epoch(self.source, order)

    def take_steps(
        self,
        state: TrainState,
        order: Epoch,
        first: int,
        count: int,
        learning_rate_factor: float,
    ) -> tuple[TrainState, Progress]:
        found = None
        for part in order.parts(first, count):
            state, progress = train_steps(
                state,
                part.source,
                part.order,
                jnp.int32(part.first),
                jnp.int32(part.count),
                jnp.float32(learning_rate_factor),
                self.keys.step,
                model=self.model,
                optimizer=self.optimizer,
                config=compiled(self.config),
                steps_per_epoch=self.steps_per_epoch,
            )
            found = progress if found is None else added(found, progress)
        assert found is not None, "no step was asked for"
        return state, found

    def settled(self, state: TrainState) -> TrainState:
        """With the statistics of its batch normalisations estimated anew, for the parameters that
        are evaluated, if asked for."""
        if not self.config.optim.statistics_windows or not normalises(state):
            return state
        options = {"model": self.model, "config": compiled(self.config)}
        key = self.keys.statistics
        order = statistics_order(key, self.source, self.config)
        source, order = self.supply.windows(self.source, order)
        estimated = estimate_statistics(evaluated(state), source, order, key, **options)
        return state._replace(batch_stats=estimated.batch_stats)

    def validate(self, state: TrainState, step: int) -> tuple[TrainState, Row]:
        """With its uncertainty calibrated where it has constants for that."""
        found = self._errors(state, step)
        if calibrates(state):
            equivariant = self.config.model.equivariance != "none"
            state = calibrated(state, isotropic(found) if equivariant else found)
            found = self._errors(state, step)
        return state, figures(found)

    def _errors(self, state: TrainState, step: int) -> Validation:
        """Means over the validation windows."""
        now = stage(self.config.loss, step - 1, self.steps_per_epoch)
        options = {"model": self.model, "config": compiled(self.config)}
        means, counts = [], []
        for source in self.supply.sources(self.held_out):
            means.append(validate(evaluated(state), source=source, now=now, **options))
            counts.append(source.visited.shape[0])
        return mean_of(means, counts)

    def training_figures(self, sums: tuple[float, ...], steps: int) -> Row:
        names = ("loss", "mse", "nll")
        return {name: each / steps for name, each in zip(names, sums, strict=True)}

    def remark(self, row: Row) -> str:
        return ""


def figures(found: Validation) -> Row:
    """The figures of the log."""
    loss, mse, nll = (float(each) for each in found.losses)
    normalised = zip("xyz", found.axis_normalised, strict=True)
    return {
        "val_loss": loss,
        "val_mse": mse,
        "val_nll": nll,
        "val_rmse": math.sqrt(mse),
        **{f"val_normalised/{axis}": float(each) for axis, each in normalised},
    }


def set_up(config: TrainConfig, reporter: Reporter, workers: int = 1) -> WindowTraining:
    """Load the recordings and cut their windows.

    Raises `InputError` for options that the network does not have, missing data, and a batch that
    is larger than the split. `workers` processes read recordings that are slow to read.
    """
    model = create_model(config)  # a mistake in the options should not wait for the data
    devices.check_batch(config.optim.batch_size, config.optim.accumulate)
    train, val = config.data.train_split, config.data.val_split
    reporter.line(f"reading {config.dataset}: {train} and {val}")
    stride, shift = config.data.train_stride, config.augment.shift_samples
    source, learnt_from = _windows(config, train, stride, shift, reporter, workers)
    stride = config.data.stride
    held_out, validated_with = _windows(config, val, stride, 0, reporter, workers)
    supply, source, held_out = supplied(config, source, held_out)
    steps_per_epoch = steps_in_epoch(source.visited.shape[0], "windows", config)
    return WindowTraining(
        config,
        model,
        optimizers.create(config.optim, config.loss, steps_per_epoch),
        optimizers.schedule(config.optim, steps_per_epoch),
        source,
        held_out,
        {train: learnt_from, val: validated_with},
        steps_per_epoch,
        keys_of(config.seed),
        supply,
    )


def _windows(
    config: TrainConfig, split: str, stride: int, shift: int, reporter: Reporter, workers: int
) -> tuple[windows.WindowSource, list[str]]:
    """The windows of a split, on the host or on its disk, and the names of its recordings."""
    samples: dict[str, int] = {}

    def noted() -> Iterator[Sequence]:
        for sequence in read_split(config, split, reporter, workers):
            samples[sequence.name] = len(sequence.time)
            yield sequence

    source = stored(config, noted(), stride, shift)
    describe_split(config, split, samples, f"{source.visited.shape[0]:,} windows", reporter)
    return source, list(samples)
