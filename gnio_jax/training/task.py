"""The common part of training on windows and training through the filter: state, step, set-up.

A `Task` defines what is trained, draws its batches and computes their losses. `train_steps` is the
one jitted step: gradient, check, update, all on the device.
"""

from __future__ import annotations

import functools
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import traverse_util
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from gnio_jax import models, parallel
from gnio_jax.config import TrainConfig
from gnio_jax.training import optimizer
from gnio_jax.training.losses import loss_stage
from gnio_jax.training.optimizer import Trainable
from gnio_jax.types import Sequence

Row = dict[str, int | float]
"""Figures of an epoch by their names in the log."""


class TrainState(NamedTuple):
    """All that changes from step to step. Random numbers are functions of the seed and `step`."""

    step: Int[jax.Array, ""]
    variables: dict[str, Any]
    """Variables by collection: the network's "params" and "batch_stats", and for training through
    the filter its numbers, "filter" (`optimizer.filter_numbers`)."""
    opt_state: Any


class BatchLosses(NamedTuple):
    """The losses of a batch and their side results."""

    figures: dict[str, Float[jax.Array, ""]]
    """`loss`, which is minimised, and its parts by their names in the log."""
    batch_stats: Any
    """Statistics of batch normalisation after the batch."""
    healthy: Bool[jax.Array, ""]
    """False if the filter diverged: the loss is then meaningless."""


class DispatchSums(NamedTuple):
    """Sums over the steps of one dispatch."""

    sums: dict[str, Float[jax.Array, ""]]
    """Sums over the steps of `loss`, its parts and `gradient_norm/<part>` (`gradient_norms`). A
    task that skips steps also has their number, `skipped`, and skipped steps have no part in the
    sums."""
    failed_step: Int[jax.Array, ""]
    """First step whose loss or gradient was not finite and that was not skipped; −1 if there is
    none."""


@dataclass(frozen=True)
class Task(ABC):
    """The definition of what is trained, and by which losses. It is compiled into the jitted
    functions, and it is equal for runs that differ in their seeds and folders."""

    model: nn.Module
    config: TrainConfig
    """Settings without seed and folders."""
    steps_per_epoch: int
    parts: tuple[int, ...] = ()
    """Number of training windows or segments of each dataset."""

    unit: ClassVar[str]
    """The items of a batch, in the plural: "windows" or "segments"."""
    skip_above: ClassVar[float | None] = None
    """Norm of the gradient above which a step is skipped. A step is also skipped if its loss or
    gradient is not finite, or if the filter diverged. None: the first step that is not finite ends
    the run.
    """
    join: ClassVar[Callable[[list[Any]], Any]]
    """A function that joins the windows or segments of several datasets, one after the other, on
    the host."""

    @staticmethod
    @abstractmethod
    def source_of(sequences: Iterable[Sequence], config: TrainConfig, training: bool) -> Any:
        """The windows or segments of recordings at the network's rate, on the host."""

    @staticmethod
    @abstractmethod
    def count(source: Any) -> int:
        """Number of windows or segments that an epoch visits, unless datasets have weights."""

    @abstractmethod
    def description(self, state: TrainState, workdir: Path) -> Iterator[str]:
        """Lines about what will be trained, and a warning if a part of it is never trained."""

    @property
    @abstractmethod
    def figures(self) -> tuple[str, ...]:
        """Names of the losses of a batch."""

    @property
    def changes(self) -> tuple[int, ...]:
        """Steps at which the trained parts change: losses before and after cannot be compared."""
        return ()

    @abstractmethod
    def order(self, key: PRNGKeyArray, epoch: int, source: Any) -> Int[jax.Array, "m"]:
        """The windows or segments that an epoch visits, in order: a function of `key` and the
        epoch."""

    @abstractmethod
    def draw(self, key: PRNGKeyArray, source: Any, which: Int[jax.Array, "b"]) -> Any:
        """A training batch: the entries `which` of an order, with random changes drawn from
        `key`."""

    @abstractmethod
    def losses(self, variables: Any, batch: Any, step: Int[jax.Array, ""]) -> BatchLosses:
        """The losses of a batch in a step of training."""

    def with_statistics(self, state: TrainState, source: Any, key: PRNGKeyArray) -> TrainState:
        """The state that is validated and kept: with the statistics of its batch normalisations
        estimated anew, if the settings ask for it."""
        return state

    def calibrate_uncertainty(self, state: TrainState, held_out: dict[str, Any]) -> TrainState:
        """The state with its uncertainty calibrated, if it has constants for that."""
        return state

    @abstractmethod
    def figures_of(self, state: TrainState, held_out: Any, key: PRNGKeyArray) -> Row:
        """The figures of a state on the validation split of one dataset."""

    @abstractmethod
    def remark(self, row: Row) -> str:
        """Text in the line of an epoch besides loss, speed and learning rate."""

    def trainable(self, variables: Any) -> Trainable:
        """The trained variables."""
        return optimizer.select_trained(variables, self.config.through_filter.learn)

    def validate(
        self, state: TrainState, held_out: dict[str, Any], key: PRNGKeyArray
    ) -> tuple[TrainState, Row]:
        """The state that is kept, calibrated, and its figures on the validation split. For several
        datasets these are means over the datasets that have them, and the losses and errors of each
        are added."""
        state = self.calibrate_uncertainty(state, held_out)
        rows = {name: self.figures_of(state, source, key) for name, source in held_out.items()}
        first, *others = rows.values()
        if not others:
            return state, first
        row: Row = {}
        for figure in dict.fromkeys(itertools.chain(*rows.values())):
            values = [figures[figure] for figures in rows.values() if figure in figures]
            row[figure] = sum(values) / len(values)
        for figure in ("val_loss", "val_mse", "val_rmse"):
            row |= {
                f"{figure}/{name}": figures[figure]
                for name, figures in rows.items()
                if figure in figures
            }
        return state, row

    def select_visits(self, key: PRNGKeyArray, entries: Int[jax.Array, "m"]) -> Int[jax.Array, "n"]:
        """The part of `entries`, one for each window or segment, that an epoch visits: for each
        dataset the number that its weight gives, in no order. If an epoch does not visit all of
        them equally often, `key` decides which ones it visits."""
        weights, chosen = self.config.data.weights, []
        if not weights:
            return entries
        ends = itertools.accumulate(self.parts)
        for number, (end, count, weight) in enumerate(zip(ends, self.parts, weights, strict=True)):
            members = entries[end - count : end]
            times, remainder = divmod(visit_count(count, weight), count)
            drawn = jax.random.permutation(jax.random.fold_in(key, number), members)
            chosen += [members] * times + [drawn[:remainder]]
        return jnp.concatenate(chosen)

    def initial_state(self, key: PRNGKeyArray, start: Any | None) -> TrainState:
        """The state at step 0: with drawn parameters, or with the variables `start` of a run. The
        filter's numbers are always those of the settings, even if training starts from a run."""
        variables = {
            "batch_stats": {},
            **models.initialise(self.model, key, self.config.data.input_samples),
        }
        if start is not None:
            variables = overlay(variables, start)
        if numbers := optimizer.filter_numbers(self.config):
            variables["filter"] = numbers
        trained = self.trainable(variables)
        chex.assert_type(jax.tree.leaves(trained), jnp.float32)
        adam = optimizer.create(self.config, self.steps_per_epoch)
        return TrainState(jnp.int32(0), variables, adam.init(trained))

    def take_steps(self, *arguments: Any) -> tuple[TrainState, DispatchSums]:
        """`train_steps` of this task. The old state is used up."""
        return train_steps(*arguments, task=self)

    def trace_steps(self, *arguments: Any) -> None:
        """Trace `train_steps` of this task, and take none. JAX keeps the trace for the first one.
        Raises `InputError` for a loss that the network does not fit."""
        train_steps.eval_shape(*arguments, task=self)


# The step
# ------------------------------------------------------------------------------------------------


@functools.partial(jax.jit, static_argnames="task", donate_argnames="state")
def train_steps(
    state: TrainState,
    source: Any,
    order: Int[jax.Array, "m"],
    first: Int[jax.Array, ""],
    count: Int[jax.Array, ""],
    factor: Float[jax.Array, ""],
    key: PRNGKeyArray,
    *,
    task: Task,
) -> tuple[TrainState, DispatchSums]:
    """Take `count` steps of an epoch, from its step number `first` on, in one dispatch.

    order: what the epoch visits of `source`; factor: scales the scheduled learning rate
    (`optimizer.Plateau`). `count` is traced, so the compiled program is the same for every division
    of an epoch into dispatches, and a run that was interrupted and resumed has the same parameters
    to the bit.
    """
    size = task.config.optim.batch_size
    chex.assert_rank(order, 1)
    chex.assert_axis_dimension_gteq(order, 0, size)  # a shorter order would be read twice
    chex.assert_shape([first, count, factor, state.step], ())
    adam = optimizer.create(task.config, task.steps_per_epoch)
    learning_rates = optimizer.learning_rates(task.config, task.steps_per_epoch)

    def one_step(
        i: jax.Array, carry: tuple[TrainState, DispatchSums]
    ) -> tuple[TrainState, DispatchSums]:
        state, dispatch = carry
        which = jax.lax.dynamic_slice(order, ((first + i) * size,), (size,))
        batch = task.draw(jax.random.fold_in(key, state.step), source, which)
        trained = task.trainable(state.variables)
        gradient, losses = gradient_of(trained, state.variables, batch, state.step, task)
        stage = loss_stage(task.config.loss, state.step, task.steps_per_epoch)
        update: Any
        update, opt_state = adam.update(
            gradient, state.opt_state, trained, log_std_learns=stage.log_std_learns
        )
        for name, direction in update.items():
            rate = -jnp.float32(learning_rates[name](state.step))
            update[name] = optax.tree.scale(factor, optax.tree.scale(rate, direction))
        variables = merge_trained(state.variables, optax.apply_updates(trained, update))
        variables["batch_stats"] = losses.batch_stats
        new = TrainState(state.step, variables, opt_state)

        # Loss and gradient are checked before the update is kept: a gradient that is not finite
        # must not reach a checkpoint, even if its loss is finite.
        figures = losses.figures | gradient_norms(gradient)
        sound = losses.healthy & jnp.isfinite(jnp.stack(list(figures.values()))).all()
        failed_step = dispatch.failed_step
        if task.skip_above is None:
            failed_step = jnp.where(~sound & (failed_step < 0), state.step, failed_step)
        else:
            sound = sound & (optax.tree.norm(gradient) <= task.skip_above)
            new = jax.tree.map(lambda new, old: jnp.where(sound, new, old), new, state)
            figures = {name: jnp.where(sound, value, 0.0) for name, value in figures.items()}
            figures["skipped"] = jnp.where(sound, 0.0, 1.0)
        sums = jax.tree.map(jnp.add, dispatch.sums, figures)
        new = new._replace(step=jnp.add(state.step, 1))
        return parallel.replicate(new), DispatchSums(sums, failed_step)

    names = [*task.figures, *gradient_norms(task.trainable(state.variables))]
    names += [] if task.skip_above is None else ["skipped"]
    start = (state, DispatchSums({name: jnp.zeros((), float) for name in names}, jnp.int32(-1)))
    return jax.lax.fori_loop(jnp.int32(0), count, one_step, start)


def gradient_of(
    trained: Trainable, variables: Any, batch: Any, step: Int[jax.Array, ""], task: Task
) -> tuple[Trainable, BatchLosses]:
    """Gradient of the loss of a batch by the trained variables, and the losses."""

    def objective(trained: Trainable) -> tuple[jax.Array, BatchLosses]:
        losses = task.losses(merge_trained(variables, trained), batch, step)
        return losses.figures["loss"], losses

    gradient, losses = jax.grad(objective, has_aux=True)(trained)
    chex.assert_trees_all_equal_structs(gradient, trained)
    return gradient, losses


def merge_trained(variables: Any, trained: Trainable) -> Any:
    """All variables, with the trained ones in their places."""
    return {name: {**tree, **trained.get(name, {})} for name, tree in variables.items()}


def gradient_norms(gradient: Trainable) -> dict[str, Float[jax.Array, ""]]:
    """Norm of the gradient by each part that is trained: modules of the network
    (`gradient_norm/encoder`), of a head each of its layers (`gradient_norm/head/scale`), numbers of
    the filter (`gradient_norm/filter/noise.gyro_density`)."""
    squares: dict[str, list[jax.Array]] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        collection, *names = [str(entry.key) for entry in path]
        part = "/".join(names[: 2 if names[0] == "head" else 1])
        part = part if collection == "params" else f"{collection}/{part}"
        squares.setdefault(f"gradient_norm/{part}", []).append(jnp.sum(leaf**2))
    return {part: jnp.sqrt(sum(terms)) for part, terms in squares.items()}


def visit_count(count: int, weight: float) -> int:
    """Number of windows or segments that an epoch visits of a dataset with `count` of them."""
    return round(weight * count)


def overlay(tree: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """`tree` with the leaves that `other` has in the same places."""
    flatten = functools.partial(traverse_util.flatten_dict, keep_empty_nodes=True)
    leaves, others = flatten(tree), flatten(other)
    return traverse_util.unflatten_dict({path: others.get(path, leaves[path]) for path in leaves})
