"""Training through the filter: pieces of recordings, the network in the filter's loop (ours)."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn

from gnio_jax.config import TrainConfig
from gnio_jax.reporting import Reporter
from gnio_jax.training import learnt as learning
from gnio_jax.training import optimizer as optimizers
from gnio_jax.training.checkpoint import Run, create_model, uncommitted
from gnio_jax.training.filter_losses import HORIZON_SECONDS
from gnio_jax.training.filter_step import Sums, intervals, optimizer, train_steps, validate
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
from gnio_jax.training.pieces import PieceSource, piece_source, random_starts
from gnio_jax.training.step import Progress, TrainState, create_state


class FilterTraining(NamedTuple):
    """A `kinds.Training`."""

    config: TrainConfig
    model: nn.Module
    schedule: optax.Schedule
    source: PieceSource
    """Training pieces."""
    held_out: PieceSource
    """Validation pieces."""
    splits: dict[str, list[str]]
    steps_per_epoch: int
    keys: Keys
    unit: str = "pieces"

    @property
    def recordings(self) -> Any:
        return self.source, self.held_out

    @property
    def changes(self) -> tuple[int, ...]:
        return ()

    def with_seed(self, seed: int) -> FilterTraining:
        config = dataclasses.replace(self.config, seed=seed)
        return self._replace(config=config, keys=keys_of(seed))

    def new_state(self, start: Run | None) -> TrainState:
        nothing = optax.identity()
        state = create_state(self.model, nothing, self.keys.init, self.config.data.seen)
        state = state._replace(filter=learning.filter_numbers(self.config.filter))
        if start is not None:
            state = with_weights(state, start)
        learnt = learning.chosen(state.variables, self.config.through_filter.learn)
        adam = optimizer(self.config, self.steps_per_epoch)
        return state._replace(opt_state=adam.init(learnt))

    def describe(self, state: TrainState, workdir: Path, reporter: Reporter) -> None:
        optim, through = self.config.optim, self.config.through_filter
        learnt = size_of(learning.chosen(state.variables, through.learn))
        reporter.line(
            f"{self.config.model.name} in the filter's loop: {' and '.join(through.learn)} learn, "
            f"{learnt:,} numbers, on {jax.devices()[0].platform}, {self.steps_per_epoch} steps of "
            f"{optim.batch_size} pieces an epoch, {optim.epochs} epochs → {workdir}"
        )

    def learning_rate(self, step: int) -> float:
        return float(self.schedule(step))

    def order(self, epoch: int) -> jax.Array:
        return random_starts(jax.random.fold_in(self.keys.order, epoch), self.source)

    def take_steps(
        self,
        state: TrainState,
        order: jax.Array,
        first: int,
        count: int,
        learning_rate_factor: float,
    ) -> tuple[TrainState, Progress]:
        state, progress = train_steps(
            state,
            self.source,
            order,
            jnp.int32(first),
            jnp.int32(count),
            jnp.float32(learning_rate_factor),
            self.keys.step,
            model=self.model,
            config=compiled(self.config),
        )
        # Where the pieces were shared out, the state now lies on all devices, and the next step
        # would be compiled once more for that.
        return uncommitted(state) if len(jax.devices()) > 1 else state, progress

    def settled(self, state: TrainState) -> TrainState:
        """As it is: the batch statistics are frozen."""
        return state

    def validate(self, state: TrainState, step: int) -> tuple[TrainState, Row]:
        """The loss is infinite where the filter diverges."""
        fixed = {"model": self.model, "config": compiled(self.config)}
        found = validate(state, self.held_out, self.keys.statistics, **fixed)
        losses = jax.device_get(found.losses)
        sound = bool(found.healthy) and math.isfinite(losses.total)
        return state, {
            "val_loss": float(losses.total) if sound else math.inf,
            "val_mse": float(losses.window),
            "val_rmse": math.sqrt(losses.window),
            "val_innovation": float(losses.innovation),
            "val_state": float(losses.state),
            **_by_horizon("val_displacement_error", losses.displacement),
            **_by_horizon("val_yaw_error", losses.yaw),
            "val_nis": float(found.nis),
            "val_nees": float(found.nees),
        }

    def training_figures(self, sums: tuple[float, ...], steps: int) -> Row:
        """Means over the steps that were not skipped, and the number of those that were."""
        found = dict(zip(Sums._fields, sums, strict=True))
        skipped = round(found.pop("skipped"))
        means = {name: total / max(1, steps - skipped) for name, total in found.items()}
        loss, mse = means.pop("total"), means.pop("window")
        return {"loss": loss, "mse": mse, **means, "skipped": skipped}

    def remark(self, row: Row) -> str:
        skipped = f"{row['skipped']} skipped  " if row["skipped"] else ""
        return f"nis/3 {row['val_nis']:.2f}  nees/3 {row['val_nees']:.2f}  {skipped}"


def _by_horizon(name: str, squares: np.ndarray) -> Row:
    """Roots of the squared errors of each horizon: shares of the distance, rad per metre."""
    seconds = HORIZON_SECONDS[: len(squares)]
    both = zip(seconds, squares, strict=True)
    return {f"{name}/{each:g}s": math.sqrt(square) for each, square in both}


def set_up(config: TrainConfig, reporter: Reporter, workers: int = 1) -> FilterTraining:
    """Load the recordings and find the pieces in them.

    Raises `InputError` for options that the network does not have, missing data, recordings that
    are too short, and a batch that is larger than the split. `workers` processes read recordings
    that are slow to read.
    """
    model = create_model(config)  # a mistake in its options should not wait for the data
    train, val = config.data.train_split, config.data.val_split
    reporter.line(f"reading {config.dataset}: {train} and {val}")
    source, learnt_from = _pieces(config, train, reporter, workers)
    held_out, validated_with = _pieces(config, val, reporter, workers)
    steps_per_epoch = steps_in_epoch(source.earliest.shape[0], "pieces", config)
    return FilterTraining(
        config,
        model,
        optimizers.schedule(config.optim, steps_per_epoch),
        source,
        held_out,
        {train: learnt_from, val: validated_with},
        steps_per_epoch,
        keys_of(config.seed),
    )


def _pieces(
    config: TrainConfig, split: str, reporter: Reporter, workers: int
) -> tuple[PieceSource, list[str]]:
    """The pieces of a split on the device, and the names of its recordings."""
    sequences = list(read_split(config, split, reporter, workers))
    source = piece_source(sequences, intervals(config) * config.data.stride)
    samples = {sequence.name: len(sequence.time) for sequence in sequences}
    describe_split(config, split, samples, f"{source.earliest.shape[0]:,} pieces", reporter)
    return jax.device_put(source), list(samples)
