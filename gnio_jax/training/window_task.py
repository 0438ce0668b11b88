"""Training on windows: each window against the displacement of the reference (paper §III-F).

`train_steps` is the jitted step: gather, rotate, augment, forward, backward, update, all on the
device. Then come the statistics of batch normalisation and validation, then the task as the loop
takes it, and last what it shares with training through the filter.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Float, Int, PRNGKeyArray

from gnio_jax import data, models, parallel
from gnio_jax.config import TrainConfig
from gnio_jax.data.windows import WindowSource, augment, gather, shift_windows, window_source
from gnio_jax.errors import InputError
from gnio_jax.models.layers import MOMENTUM
from gnio_jax.reporting import Reporter
from gnio_jax.training import optimizer
from gnio_jax.training.losses import Losses, Stage, loss_stage, losses, switches
from gnio_jax.types import Prediction, Sequence, Windows

Row = dict[str, int | float]
"""Figures of an epoch by name, as the log keeps them."""


class TrainState(NamedTuple):
    """All that changes from step to step. Random numbers are functions of the seed and `step`."""

    step: Int[jax.Array, ""]
    params: Any
    batch_stats: Any
    opt_state: Any
    filter: Any = {}
    """Numbers of the filter that may be trained (`filter_task.filter_numbers`); none on windows."""

    @property
    def variables(self) -> dict[str, Any]:
        """Variables by collection: the network's, and "filter" where there are any."""
        network = {"params": self.params, "batch_stats": self.batch_stats}
        return network | ({"filter": self.filter} if self.filter else {})


class Progress(NamedTuple):
    """Figures of the steps of one dispatch."""

    sums: dict[str, Float[jax.Array, ""]]
    """Summed over the steps: `loss` and its parts, and `gradient_norm/<module>` for each module of
    the network, of a head for each of its layers."""
    failed_step: Int[jax.Array, ""]
    """First step whose loss or gradient was not finite; −1: none."""


# The step
# ------------------------------------------------------------------------------------------------


@functools.partial(
    jax.jit, static_argnames=("model", "config", "steps_per_epoch"), donate_argnames="state"
)
def train_steps(
    state: TrainState,
    source: WindowSource,
    order: Int[jax.Array, "m"],
    first: Int[jax.Array, ""],
    count: Int[jax.Array, ""],
    factor: Float[jax.Array, ""],
    key: PRNGKeyArray,
    *,
    model: nn.Module,
    config: TrainConfig,
    steps_per_epoch: int,
) -> tuple[TrainState, Progress]:
    """Take `count` steps of an epoch, from its step number `first` on, in one dispatch.

    order: numbers of the epoch's windows; factor: scales the scheduled learning rate
    (`optimizer.Plateau`). `count` is traced: however an epoch is cut into dispatches it is the same
    compiled program, so a run that was interrupted and resumed has the same parameters to the bit.
    """
    size = config.optim.batch_size
    chex.assert_rank(order, 1)
    chex.assert_axis_dimension_gteq(order, 0, size)  # a shorter order would be read twice
    chex.assert_shape([first, count, factor, state.step], ())
    chex.assert_equal_shape_prefix([source.start, source.rotation, source.displacement], 1)
    adam = optimizer.adam(config.optim, config.loss, steps_per_epoch)
    learning_rate = optimizer.schedule(config.optim, steps_per_epoch)

    def one_step(i: jax.Array, carry: tuple[TrainState, Progress]) -> tuple[TrainState, Progress]:
        state, progress = carry
        which = jax.lax.dynamic_slice(order, ((first + i) * size,), (size,))
        step_key = jax.random.fold_in(key, state.step)
        windows, dropout_key = draw_windows(step_key, source, which, config)
        stage = loss_stage(config.loss, state.step, steps_per_epoch)

        def objective(params: Any) -> tuple[jax.Array, tuple[Losses, Any]]:
            variables = {"params": params, "batch_stats": state.batch_stats}
            prediction, changed = apply_training(model, variables, windows, dropout_key)
            found = losses(prediction, windows, config.loss, stage, predicted_axes(model))
            return found.total, (found, changed.get("batch_stats", {}))

        gradient, (found, batch_stats) = jax.grad(objective, has_aux=True)(state.params)
        direction, opt_state = adam.update(
            gradient, state.opt_state, state.params, log_std_learns=stage.log_std_learns
        )
        update = optax.tree.scale(-jnp.float32(learning_rate(state.step)), direction)
        params = optax.apply_updates(state.params, optax.tree.scale(factor, update))
        parts = {"loss": found.total, "mse": found.mse, "nll": found.nll}
        progress = _after_step(progress, state.step, parts | gradient_norms(gradient))
        state = TrainState(jnp.add(state.step, 1), params, batch_stats, opt_state)
        return parallel.replicated(state), progress

    nothing = {"loss": 0, "mse": 0, "nll": 0} | gradient_norms(state.params)
    sums = jax.tree.map(lambda _: jnp.float32(0), nothing)
    start = (state, Progress(sums, jnp.int32(-1)))
    return jax.lax.fori_loop(jnp.int32(0), count, one_step, start)


def draw_windows(
    key: PRNGKeyArray, source: WindowSource, which: Int[jax.Array, "b"], config: TrainConfig
) -> tuple[Windows, PRNGKeyArray]:
    """The windows `which`, shifted and augmented by draws from `key`, and a key for the network's
    dropout. Each device cuts its share of them."""
    augment_key, dropout_key, shift_key = jax.random.split(key, 3)
    which = shift_windows(shift_key, source, parallel.split(which), config.augment.shift_samples)
    windows = gather(source, parallel.split(which), config.data.seen)
    return parallel.split(augment(augment_key, windows, config.augment)), dropout_key


def apply_training(
    model: nn.Module, variables: Any, windows: Windows, dropout_key: PRNGKeyArray
) -> tuple[Prediction, Any]:
    """The prediction in training mode, and the variables that changed: statistics of the batch."""
    return model.apply(
        variables,
        windows.imu,
        train=True,
        mutable=["batch_stats"],
        rngs={"dropout": dropout_key},
    )  # type: ignore[return-value]


def predicted_axes(model: nn.Module) -> int:
    """How many axes of the displacement a network predicts: 2 where the vertical is always 0."""
    network = getattr(model, "network", model)  # what an equivariant construction is made around
    return getattr(network, "output_dim", 3)


def gradient_norms(gradient: Any) -> dict[str, Float[jax.Array, ""]]:
    """`gradient_norm/<module>`: norm of the gradient with respect to each module of the network, of
    a head with respect to each of its layers (`head/scale`)."""
    squares: dict[str, list[jax.Array]] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        names = [str(entry.key) for entry in path]
        part = "/".join(names[: 2 if names[0] == "head" else 1])
        squares.setdefault(f"gradient_norm/{part}", []).append(jnp.sum(leaf**2))
    return {part: jnp.sqrt(sum(found)) for part, found in squares.items()}


def _after_step(progress: Progress, step: jax.Array, figures: dict[str, jax.Array]) -> Progress:
    """The progress with the figures of one more step.

    Loss and gradient are looked at before the update is kept: a gradient that is not finite must
    not reach a checkpoint, though its loss is.
    """
    finite = jnp.isfinite(jnp.stack(list(figures.values()))).all()
    fails = ~finite & (progress.failed_step < 0)
    sums = jax.tree.map(jnp.add, progress.sums, figures)
    return Progress(sums, jnp.where(fails, step, progress.failed_step))


def epoch_order(key: PRNGKeyArray, epoch: int, source: WindowSource) -> Int[jax.Array, "m"]:
    """The order in which epoch `epoch` visits the windows: a permutation that depends on nothing
    else."""
    return jax.random.permutation(jax.random.fold_in(key, epoch), jnp.asarray(source.visited))


# The statistics of batch normalisation
# ------------------------------------------------------------------------------------------------


def normalises(state: TrainState) -> bool:
    """Whether the network has batch normalisations."""
    return any(
        path[-1].key == "mean" for path, _ in jax.tree_util.tree_leaves_with_path(state.batch_stats)
    )


def statistics_order(
    key: PRNGKeyArray, source: WindowSource, config: TrainConfig
) -> Int[jax.Array, "m"]:
    """The windows of `estimate_statistics`: whole batches for `optim.statistics_windows`, but no
    more than an epoch has, drawn from `key` alone."""
    size = config.optim.batch_size
    batches = min(-(-config.optim.statistics_windows // size), source.visited.shape[0] // size)
    order_key, _ = jax.random.split(key)
    return jax.random.permutation(order_key, jnp.asarray(source.visited))[: batches * size]


@functools.partial(jax.jit, static_argnames=("model", "config"))
def estimate_statistics(
    state: TrainState,
    source: WindowSource,
    order: Int[jax.Array, "m"],
    key: PRNGKeyArray,
    *,
    model: nn.Module,
    config: TrainConfig,
) -> TrainState:
    """The state with the statistics of every batch normalisation estimated anew for its parameters.

    Means over batches of augmented training windows, in training mode: those of `order`, as
    `statistics_order` draws them from the same `key`. The running averages remember ten steps, and
    what those miss is an offset of the displacement (ours; Wu and Johnson 2021, "Rethinking 'Batch'
    in BatchNorm"). Nothing else of `batch_stats` changes.
    """
    batches = order.shape[0] // config.optim.batch_size
    _, draw_key = jax.random.split(key)
    # A normalisation adds 1 − MOMENTUM of the batch's statistics to the MOMENTUM-fold of its own:
    # of zeros, that alone is left.
    zeros = jax.tree.map(jnp.zeros_like, state.batch_stats)

    def add_batch(total: Any, number_which: tuple[jax.Array, jax.Array]) -> tuple[Any, None]:
        number, which = number_which
        windows, dropout_key = draw_windows(
            jax.random.fold_in(draw_key, number), source, which, config
        )
        variables = {"params": state.params, "batch_stats": zeros}
        _, changed = apply_training(model, variables, windows, dropout_key)
        return jax.tree.map(jnp.add, total, changed["batch_stats"]), None

    parts = order.reshape(batches, config.optim.batch_size)
    total, _ = jax.lax.scan(add_batch, zeros, (jnp.arange(batches), parts))

    def statistic(path: tuple, total: jax.Array, before: jax.Array) -> jax.Array:
        return total / (batches * (1 - MOMENTUM)) if path[-1].key in ("mean", "var") else before

    estimated = jax.tree_util.tree_map_with_path(statistic, total, state.batch_stats)
    return parallel.replicated(state._replace(batch_stats=estimated))


# Validation
# ------------------------------------------------------------------------------------------------


class Validation(NamedTuple):
    """Means over every window of a split."""

    losses: Losses
    axis_mse: Float[jax.Array, "3"]
    """Squared error of each axis, m²."""
    axis_normalised: Float[jax.Array, "3"]
    """(e/σ)² of each axis: 1 where the standard deviations are those of the errors."""


@functools.partial(jax.jit, static_argnames=("model", "config"))
def validate(
    state: TrainState, source: WindowSource, stage: Stage, *, model: nn.Module, config: TrainConfig
) -> Validation:
    """Mean losses and errors over every window of `source`, without augmentation and in inference
    mode."""
    count = source.visited.shape[0]
    # Whole batches, of which each device has the same share: the last one is filled up with windows
    # of weight zero.
    size = -(-min(config.optim.batch_size, count) // parallel.count()) * parallel.count()
    batches = -(-count // size)
    which = source.visited[
        jnp.minimum(jnp.arange(batches * size, dtype=jnp.int32), count - 1)
    ].reshape(batches, size)
    weight = (jnp.arange(batches * size) < count).astype(jnp.float32).reshape(batches, size)

    def one_window(prediction: Prediction, windows: Windows) -> Validation:
        prediction, windows = jax.tree.map(lambda x: x[None], (prediction, windows))
        error = windows.displacement - prediction.displacement
        return Validation(
            losses(prediction, windows, config.loss, stage, predicted_axes(model)),
            error[0] ** 2,
            error[0] ** 2 * jnp.exp(-2 * prediction.log_std[0]),
        )

    def one_batch(which_weight: tuple[jax.Array, jax.Array]) -> Validation:
        windows = parallel.split(gather(source, parallel.split(which_weight[0]), config.data.seen))
        prediction: Any = model.apply(
            {"params": state.params, "batch_stats": state.batch_stats}, windows.imu
        )
        each = jax.vmap(one_window)(prediction, windows)
        return jax.tree.map(lambda x: jnp.tensordot(which_weight[1], x, 1), each)

    return jax.tree.map(
        lambda x: jnp.sum(x, axis=0) / count, jax.lax.map(one_batch, (which, weight))
    )


def calibrates(state: TrainState) -> bool:
    """Whether the network has constants or factors of the uncertainty that validation sets."""
    found = jax.tree_util.tree_leaves_with_path(state.batch_stats)
    return any(path[-1].key in ("log_std", "log_factor") for path, _ in found)


def isotropic(found: Validation) -> Validation:
    """The same, with the mean of the two horizontal axes in the place of each. Constants of the
    uncertainty of an equivariant network cannot tell one from the other."""

    def mean(axes: Float[jax.Array, "3"]) -> Float[jax.Array, "3"]:
        return axes.at[:2].set(axes[:2].mean())

    return found._replace(
        axis_mse=mean(found.axis_mse), axis_normalised=mean(found.axis_normalised)
    )


def calibrated(state: TrainState, found: Validation) -> TrainState:
    """The state whose constants and factors of the uncertainty (`models.heads`) fit the errors that
    validation found with it.

    Errors below 0.1 mm count as 0.1 mm, and a σ changes by no more than a factor of 1000 at once:
    nothing becomes infinite.
    """

    def fitted(path: tuple, leaf: jax.Array) -> jax.Array:
        match path[-1].key:
            case "log_std":
                return 0.5 * jnp.log(jnp.maximum(found.axis_mse, 1e-8))
            case "log_factor":
                return leaf + 0.5 * jnp.log(jnp.clip(found.axis_normalised, 1e-6, 1e6))
            case _:
                return leaf

    return state._replace(batch_stats=jax.tree_util.tree_map_with_path(fitted, state.batch_stats))


# The task
# ------------------------------------------------------------------------------------------------


class Keys(NamedTuple):
    """Random keys of a run: functions of the seed alone."""

    init: jax.Array
    order: jax.Array
    step: jax.Array
    statistics: jax.Array


@dataclass(frozen=True)
class Task:
    """A run's settings, network and recordings: all of it but its state. Both tasks are one."""

    config: TrainConfig
    model: nn.Module
    source: Any
    """What the task is trained on, on the devices: windows or segments."""
    held_out: Any
    """Those of validation, likewise."""
    splits: dict[str, list[str]]
    """Names of the recordings of each split."""
    steps_per_epoch: int
    unit = "windows"
    """What a batch consists of, in the plural."""

    @property
    def keys(self) -> Keys:
        """Random keys of the run."""
        return keys_of(self.config.seed)

    @property
    def compiled_for(self) -> dict[str, Any]:
        """The static arguments of the jitted functions. Runs in several folders and with several
        seeds share the programs."""
        anywhere = {"workdir": None, "data_root": None, "init_from": None, "seed": 0}
        return {"model": self.model, "config": dataclasses.replace(self.config, **anywhere)}

    @property
    def changes(self) -> tuple[int, ...]:
        """Steps at which what is trained changes: losses before and after do not compare."""
        return ()

    def learning_rate(self, step: int) -> float:
        """Learning rate of a step by the schedule."""
        return float(optimizer.schedule(self.config.optim, self.steps_per_epoch)(step))


class WindowTask(Task):
    """Training on windows: `source` and `held_out` are `WindowSource`s."""

    @property
    def changes(self) -> tuple[int, ...]:
        return switches(self.config.loss, self.steps_per_epoch)

    def initial_state(self, start: Any | None) -> TrainState:
        """The state at step 0: with drawn parameters, or with the variables `start` of a run."""
        state = initial_state(self.model, self.keys.init, self.config.data.seen)
        if start is not None:
            found = overlaid(state.variables, start)
            state = state._replace(params=found["params"], batch_stats=found["batch_stats"])
        adam = optimizer.adam(self.config.optim, self.config.loss, self.steps_per_epoch)
        return parallel.everywhere(state._replace(opt_state=adam.init(state.params)))

    def description(self, state: TrainState, workdir: Path) -> Iterator[str]:
        """Lines about what will be trained, and a warning where a part of it never will be."""
        optim, steps = self.config.optim, self.steps_per_epoch
        yield (
            f"{self.config.model.name}: {size_of(state.params):,} parameters on "
            f"{parallel.described()}, {steps} steps of {optim.batch_size} windows an epoch, "
            f"{optim.epochs} epochs → {workdir}"
        )
        total = optim.epochs * steps
        names = ("the likelihood counts", "the uncertainty learns")
        for what, step in zip(names, self.changes, strict=True):
            if step >= total:
                field = "nll_from_epoch" if what == names[0] else "log_std_from_epoch"
                yield (
                    f"warning: {what} only from step {step:,} on, and the run ends at step "
                    f"{total:,}; raise optim.epochs or lower loss.{field}"
                )
            elif step > 0:
                yield f"{what} from step {step:,} of {total:,} on"

    def order(self, epoch: int) -> Int[jax.Array, "m"]:
        """The windows that an epoch visits, in order: a function of the seed and the epoch."""
        return epoch_order(self.keys.order, epoch, self.source)

    def take_steps(
        self, state: TrainState, order: Int[jax.Array, "m"], first: int, count: int, factor: float
    ) -> tuple[TrainState, Progress]:
        """`train_steps`. The old state is used up."""
        return train_steps(
            state,
            self.source,
            order,
            jnp.int32(first),
            jnp.int32(count),
            jnp.float32(factor),
            self.keys.step,
            **self.compiled_for,
            steps_per_epoch=self.steps_per_epoch,
        )

    def with_statistics(self, state: TrainState) -> TrainState:
        """The state as it is validated and kept: with the statistics of its batch normalisations
        estimated anew, if asked for."""
        if not self.config.optim.statistics_windows or not normalises(state):
            return state
        key = self.keys.statistics
        order = statistics_order(key, self.source, self.config)
        return estimate_statistics(state, self.source, order, key, **self.compiled_for)

    def validate(self, state: TrainState, step: int) -> tuple[TrainState, Row]:
        """The state as it is kept after `step` steps, with its uncertainty calibrated where it has
        constants for that, and its figures on the validation split."""
        stage = loss_stage(self.config.loss, step - 1, self.steps_per_epoch)
        found = validate(state, self.held_out, stage, **self.compiled_for)
        if calibrates(state):
            equivariant = self.config.model.equivariance != "none"
            state = calibrated(state, isotropic(found) if equivariant else found)
            found = validate(state, self.held_out, stage, **self.compiled_for)
        loss, mse, nll = (float(each) for each in found.losses)
        row: Row = {"val_loss": loss, "val_mse": mse, "val_nll": nll, "val_rmse": math.sqrt(mse)}
        normalised = zip("xyz", found.axis_normalised, strict=True)
        return state, row | {f"val_normalised/{axis}": float(each) for axis, each in normalised}

    def remark(self, row: Row) -> str:
        """The parts of both losses, which compare between networks where the losses do not."""
        return (
            f"mse {row['mse']:.4g} nll {row['nll']:.4g}  "
            f"val mse {row['val_mse']:.4g} nll {row['val_nll']:.4g}  "
        )


def set_up(config: TrainConfig, reporter: Reporter, workers: int = 1) -> WindowTask:
    """Load the recordings and cut their windows.

    Raises `InputError` for options that the network does not have, missing data, a batch that is
    larger than the split, and one that the devices cannot share evenly. `workers` processes read
    recordings that are slow to read.
    """
    model = create_model(config)  # a mistake in the options should not wait for the data
    size = config.optim.batch_size
    if size % parallel.count():
        problem = f"is {size}, which {parallel.count()} devices cannot share evenly"
        remedy = f"make it a multiple of {parallel.count()}, or use fewer --devices"
        raise InputError("optim.batch_size", problem, remedy)
    train, val = config.data.train_split, config.data.val_split
    reporter.line(f"reading {config.dataset}: {train} and {val}")

    def windows(split: str, stride: int, shift: int) -> tuple[WindowSource, list[str]]:
        samples: dict[str, int] = {}
        sequences = read_split(config, split, reporter, workers, samples)
        source = window_source(sequences, config.data, stride, shift)
        contents = f"{source.visited.shape[0]:,} windows"
        reporter.line(described_split(config, split, samples, contents))
        return parallel.everywhere(source), list(samples)

    source, trained = windows(train, config.data.train_stride, config.augment.shift_samples)
    held_out, validated = windows(val, config.data.stride, 0)
    splits = {train: trained, val: validated}
    steps = steps_in_epoch(source.visited.shape[0], "windows", config)
    return WindowTask(config, model, source, held_out, splits, steps)


# Shared with training through the filter
# ------------------------------------------------------------------------------------------------


def create_model(config: TrainConfig) -> nn.Module:
    """The network that `config.model` describes; what that leaves open is the network's own."""
    given = {key: value for key, value in vars(config.model).items() if value is not None}
    return models.create(**given)


def keys_of(seed: int) -> Keys:
    """The keys of a run."""
    key = jax.random.key(seed)
    return Keys(*jax.random.split(key, 3), statistics=jax.random.fold_in(key, 3))


def initial_state(model: nn.Module, key: PRNGKeyArray, window: int) -> TrainState:
    """Fresh parameters for windows of `window` samples, at step 0, without an optimizer's state."""
    variables = models.initialise(model, key, window)
    return TrainState(jnp.int32(0), variables["params"], variables.get("batch_stats", {}), ())


def overlaid(tree: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """`tree` with the leaves that `other` has in the same places."""
    return {
        name: overlaid(leaf, other.get(name, {}))
        if isinstance(leaf, dict)
        else other.get(name, leaf)
        for name, leaf in tree.items()
    }


def read_split(
    config: TrainConfig, split: str, reporter: Reporter, workers: int, samples: dict[str, int]
) -> Iterator[Sequence]:
    """The recordings of a split at the network's rate, one after another. The number of samples of
    each is noted in `samples` by its name."""
    for sequence in data.load_each(
        config.dataset,
        config.data_root,
        split,
        workers,
        lambda share: reporter.progress(f"reading {split}", share),
    ):
        resampled = data.resample(sequence, config.data.rate)
        samples[resampled.name] = len(resampled.time)
        yield resampled


def described_split(config: TrainConfig, split: str, samples: dict[str, int], contents: str) -> str:
    """A line about how much was read: samples of each recording."""
    hours = sum(samples.values()) / config.data.rate / 3600
    return f"  {split}: {len(samples)} sequences, {hours:.2f} h, {contents}"


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
