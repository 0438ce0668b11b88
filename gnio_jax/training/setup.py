"""What a run needs before its first step: network, windows on the device, optimizer, keys."""

from __future__ import annotations

from typing import NamedTuple

import jax
import optax
from flax import linen as nn

from gnio_jax import data
from gnio_jax.config import TrainConfig
from gnio_jax.data import windows
from gnio_jax.errors import InputError
from gnio_jax.reporting import Reporter
from gnio_jax.training import optimizer as optimizers
from gnio_jax.training.checkpoint import create_model
from gnio_jax.training.losses import switches


class Keys(NamedTuple):
    """Random keys: functions of the seed alone."""

    init: jax.Array
    order: jax.Array
    step: jax.Array
    statistics: jax.Array


class Run(NamedTuple):
    """What stays the same from the first step of a run to its last."""

    config: TrainConfig
    model: nn.Module
    optimizer: optax.GradientTransformationExtraArgs
    learning_rate: optax.Schedule
    source: windows.WindowSource
    """Training windows."""
    held_out: windows.WindowSource
    """Validation windows."""
    splits: dict[str, list[str]]
    """Names of the recordings of each split."""
    steps_per_epoch: int
    keys: Keys

    @property
    def steps(self) -> int:
        """Steps of the whole run."""
        return self.config.optim.epochs * self.steps_per_epoch


def set_up(config: TrainConfig, reporter: Reporter, workers: int = 1) -> Run:
    """Load the recordings and make everything of a run but its state.

    Raises `InputError` for options that the network does not have, missing data, and a batch that
    is larger than the split. `workers` processes read recordings that are slow to read.
    """
    model = create_model(config)  # a mistake in its options should not wait for the data
    train, val = config.data.train_split, config.data.val_split
    reporter.line(f"reading {config.dataset}: {train} and {val}")
    shift = config.augment.shift_samples
    source, learnt_from = _windows(
        config, train, config.data.train_stride, shift, reporter, workers
    )
    held_out, validated_with = _windows(config, val, config.data.stride, 0, reporter, workers)
    count, size = source.visited.shape[0], config.optim.batch_size
    if count < size:
        problem = f"is {size}, but there are only {count} windows"
        raise InputError("optim.batch_size", problem, "lower it")
    steps_per_epoch = count // size
    return Run(
        config,
        model,
        optimizers.create(config.optim, config.loss, steps_per_epoch),
        optimizers.schedule(config.optim, steps_per_epoch),
        source,
        held_out,
        {train: learnt_from, val: validated_with},
        steps_per_epoch,
        _keys(config.seed),
    )


def _keys(seed: int) -> Keys:
    key = jax.random.key(seed)
    return Keys(*jax.random.split(key, 3), statistics=jax.random.fold_in(key, 3))


def _windows(
    config: TrainConfig, split: str, stride: int, shift: int, reporter: Reporter, workers: int
) -> tuple[windows.WindowSource, list[str]]:
    """The windows of a split on the device, and the names of its recordings."""
    loaded = data.load(
        config.dataset,
        config.data_root,
        split,
        workers,
        lambda share: reporter.progress(f"reading {split}", share),
    )
    sequences = [data.resample(sequence, config.data.rate) for sequence in loaded]
    source = windows.window_source(sequences, config.data, stride, shift)
    hours = sum(len(sequence.time) for sequence in sequences) / config.data.rate / 3600
    count = source.visited.shape[0]
    reporter.line(f"  {split}: {len(sequences)} sequences, {hours:.2f} h, {count:,} windows")
    return jax.device_put(source), [sequence.name for sequence in sequences]


def describe(run: Run, parameters: int, workdir: object, reporter: Reporter) -> None:
    """Say what will be trained, and when what is trained changes."""
    optim = run.config.optim
    reporter.line(
        f"{run.config.model.name}: {parameters:,} parameters on {jax.devices()[0].platform}, "
        f"{run.steps_per_epoch} steps of {optim.batch_size} windows an epoch, "
        f"{optim.epochs} epochs → {workdir}"
    )
    likelihood, uncertainty = switches(run.config.loss, run.steps_per_epoch)
    for what, step in (
        ("the likelihood counts", likelihood),
        ("the uncertainty learns", uncertainty),
    ):
        if step > 0:
            reporter.line(f"{what} from step {step:,} of {run.steps:,}")
