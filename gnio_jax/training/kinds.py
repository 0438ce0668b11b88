"""What the training loop needs of a kind of training: on windows, or through the filter."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax

from gnio_jax import data
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Reporter
from gnio_jax.training.checkpoint import Run
from gnio_jax.training.log import Row
from gnio_jax.training.step import Progress, TrainState
from gnio_jax.types import Sequence


@runtime_checkable
class Training(Protocol):
    """A kind of training with its data, model and optimizer: all of a run but its state."""

    @property
    def unit(self) -> str:
        """What a batch consists of, in the plural."""
        ...

    @property
    def config(self) -> TrainConfig: ...

    @property
    def splits(self) -> dict[str, list[str]]:
        """Names of the recordings of each split."""
        ...

    @property
    def recordings(self) -> Any:
        """What it learns from and is validated with: a tree of arrays."""
        ...

    @property
    def steps_per_epoch(self) -> int: ...

    @property
    def changes(self) -> tuple[int, ...]:
        """Steps at which what is trained changes: losses before and after do not compare."""
        ...

    def with_seed(self, seed: int) -> Training:
        """The same training, recordings and compiled programs with another seed."""
        ...

    def new_state(self, start: Run | None) -> TrainState:
        """The state at step 0: with drawn weights, or those of the run `start`."""
        ...

    def describe(self, state: TrainState, workdir: Path, reporter: Reporter) -> None:
        """Say what will be trained."""
        ...

    def learning_rate(self, step: int) -> float:
        """Learning rate of a step by the schedule."""
        ...

    def order(self, epoch: int) -> Any:
        """What an epoch visits, in order: a function of the seed and the epoch. For
        `take_steps`."""
        ...

    def take_steps(
        self,
        state: TrainState,
        order: Any,
        first: int,
        count: int,
        learning_rate_factor: float,
    ) -> tuple[TrainState, Progress]:
        """Take `count` steps of an epoch from its step `first` on, in one dispatch. The old state
        is used up."""
        ...

    def settled(self, state: TrainState) -> TrainState:
        """The state as it is validated and kept."""
        ...

    def validate(self, state: TrainState, step: int) -> tuple[TrainState, Row]:
        """A settled state as it is kept after `step` steps, and its figures on the validation
        split: `val_loss`, `val_mse` (squared error of the displacement), `val_rmse` and more."""
        ...

    def training_figures(self, sums: tuple[float, ...], steps: int) -> Row:
        """Mean losses of training from their sums over `steps` steps: `loss` and its parts."""
        ...

    def remark(self, row: Row) -> str:
        """What else the line of a finished epoch says of its figures."""
        ...


class Keys(NamedTuple):
    """Random keys: functions of the seed alone."""

    init: jax.Array
    order: jax.Array
    step: jax.Array
    statistics: jax.Array


def compiled(config: TrainConfig) -> TrainConfig:
    """What the compiled steps depend on: runs in several folders and with several seeds share
    them."""
    return dataclasses.replace(config, workdir=None, data_root=None, init_from=None, seed=0)


def keys_of(seed: int) -> Keys:
    """The keys of a run."""
    key = jax.random.key(seed)
    return Keys(*jax.random.split(key, 3), statistics=jax.random.fold_in(key, 3))


def read_split(
    config: TrainConfig, split: str, reporter: Reporter, workers: int
) -> Iterator[Sequence]:
    """The recordings of a split at the network's rate, one after another."""
    loaded = data.load_each(
        config.dataset,
        config.data_root,
        split,
        workers,
        lambda share: reporter.progress(f"reading {split}", share),
    )
    return (data.resample(sequence, config.data.rate) for sequence in loaded)


def describe_split(
    config: TrainConfig, split: str, samples: dict[str, int], contents: str, reporter: Reporter
) -> None:
    """Say how much was read: samples of each recording."""
    hours = sum(samples.values()) / config.data.rate / 3600
    reporter.line(f"  {split}: {len(samples)} sequences, {hours:.2f} h, {contents}")


def steps_in_epoch(count: int, unit: str, config: TrainConfig) -> int:
    """Whole batches in `count` units. Raises `InputError` when there is none."""
    size = config.optim.batch_size
    if count < size:
        problem = f"is {size}, but there are only {count} {unit}"
        raise InputError("optim.batch_size", problem, "lower it")
    return count // size


def size_of(parameters: Any) -> int:
    """Numbers in a tree of arrays."""
    return sum(leaf.size for leaf in jax.tree.leaves(parameters))
