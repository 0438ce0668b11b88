"""Training on windows: each window against the displacement of the reference (paper §III-F).

This module has the task, its batches, the statistics of batch normalisation, and validation. The
step is `task.train_steps`.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Float, Int, PRNGKeyArray

from gnio_jax import models, parallel
from gnio_jax.config import TrainConfig
from gnio_jax.models.layers import MOMENTUM
from gnio_jax.training.losses import Losses, Stage, loss_stage, losses, switches
from gnio_jax.training.network_losses import rotation_consistency
from gnio_jax.training.task import BatchLosses, Row, Task, TrainState
from gnio_jax.training.windows import (
    NO_MOTION,
    WindowSource,
    augment,
    gather,
    join_windows,
    low_pass,
    low_pass_margin,
    shift_windows,
    window_source,
)
from gnio_jax.types import Prediction, Sequence, Windows


class WindowTask(Task):
    """Training on the windows of a `WindowSource`."""

    unit = "windows"
    join = staticmethod(join_windows)

    @property
    def figures(self) -> tuple[str, ...]:
        has_corrector = self.config.model.corrector != "none"
        return ("loss", "mse", "nll", *(["preintegration"] if has_corrector else []))

    @staticmethod
    def source_of(
        sequences: Iterable[Sequence], config: TrainConfig, training: bool
    ) -> WindowSource:
        data, shift = config.data, config.augment.shift_samples
        steps = (data.train_stride, shift) if training else (data.stride, 0)
        return window_source(sequences, data, *steps)

    @staticmethod
    def count(source: WindowSource) -> int:
        return source.visited.shape[0]

    def description(self, state: TrainState, workdir: Path) -> Iterator[str]:
        optim, steps = self.config.optim, self.steps_per_epoch
        count = optax.tree.size(state.variables["params"])
        yield (
            f"{self.config.model.name}: {count:,} parameters on "
            f"{parallel.describe()}, {steps} steps of {optim.batch_size} windows an epoch, "
            f"{optim.epochs} epochs → {workdir}"
        )
        changes = self.config.augment
        if self.config.model.corrector != "none" and any(
            getattr(changes, name) != without for name, without in NO_MOTION.items()
        ):
            yield (
                "warning: augment.tilt_degrees, rocking_share and vertical_gain change samples and "
                "not their motion, from which a corrector learns; set them to 0, 0 and [1, 1]"
            )
        total = optim.epochs * steps
        parts = ("the likelihood counts", "nll"), ("the uncertainty learns", "log_std")
        for (what, field), step in zip(parts, self.changes, strict=True):
            if step >= total:
                yield (
                    f"warning: {what} only from step {step:,} on, and the run ends at step "
                    f"{total:,}; raise optim.epochs or lower loss.{field}_from_epoch"
                )
            elif step > 0:
                yield f"{what} from step {step:,} of {total:,} on"

    @property
    def changes(self) -> tuple[int, ...]:
        return switches(self.config.loss, self.steps_per_epoch)

    def order(self, key: PRNGKeyArray, epoch: int, source: WindowSource) -> Int[jax.Array, "m"]:
        """Numbers of the windows, permuted."""
        key = jax.random.fold_in(key, epoch)
        return jax.random.permutation(key, self.select_visits(key, jnp.asarray(source.visited)))

    def draw(
        self, key: PRNGKeyArray, source: WindowSource, which: Int[jax.Array, "b"]
    ) -> tuple[Windows, PRNGKeyArray]:
        """The windows `which`, shifted, low-passed and augmented, and a key for the network's
        dropout. Each device cuts its share of the windows."""
        chex.assert_equal_shape_prefix([source.start, source.rotation, source.displacement], 1)
        augment_key, dropout_key, shift_key = jax.random.split(key, 3)
        data, changes = self.config.data, self.config.augment
        margin = low_pass_margin(changes, data.rate)
        which = shift_windows(shift_key, source, parallel.split(which), changes.shift_samples)
        windows = gather(source, parallel.split(which), data.input_samples, margin)
        windows = low_pass(jax.random.fold_in(key, 3), windows, changes, data.rate)
        return parallel.split(augment(augment_key, windows, changes)), dropout_key

    def losses(
        self, variables: Any, batch: tuple[Windows, PRNGKeyArray], step: Int[jax.Array, ""]
    ) -> BatchLosses:
        windows, key = batch
        stage = loss_stage(self.config.loss, step, self.steps_per_epoch)
        prediction, changed = apply_training(self.model, variables, batch)
        data, loss = self.config.data, self.config.loss
        axes = predicted_axes(self.model)
        values = losses(prediction, windows, loss, stage, axes, 1 / data.rate)
        total = values.total
        if loss.rotation_weight:
            keys = (jax.random.fold_in(key, 1), jax.random.fold_in(key, 2))
            arguments = self.model, variables, windows, prediction, keys, data.window_seconds
            total = total + loss.rotation_weight * rotation_consistency(*arguments)
        figures = {"loss": total, "mse": values.mse, "nll": values.nll}
        if values.preintegration is not None:
            figures["preintegration"] = values.preintegration
        return BatchLosses(figures, changed.get("batch_stats", {}), jnp.bool_(True))

    def with_statistics(
        self, state: TrainState, source: WindowSource, key: PRNGKeyArray
    ) -> TrainState:
        if not self.config.optim.statistics_windows or not has_statistics(state, "mean"):
            return state
        order = statistics_order(key, source, self)
        return estimate_statistics(state, source, order, key, task=self)

    def calibrate_uncertainty(
        self, state: TrainState, held_out: dict[str, WindowSource]
    ) -> TrainState:
        if not has_statistics(state, "log_std", "log_factor"):
            return state
        stage = self.last_stage(state)
        validations = [validate(state, source, stage, task=self) for source in held_out.values()]
        mean = jax.tree.map(lambda *figures: sum(figures) / len(figures), *validations)
        isotropic = getattr(self.model, "averages_headings", False)
        return calibrate_uncertainty(state, mean, isotropic)

    def figures_of(self, state: TrainState, held_out: WindowSource, key: PRNGKeyArray) -> Row:
        validation = validate(state, held_out, self.last_stage(state), task=self)
        loss, mse, nll, preintegration = validation.losses
        row: Row = {"val_loss": float(loss), "val_mse": float(mse), "val_nll": float(nll)}
        row["val_rmse"] = math.sqrt(row["val_mse"])
        if preintegration is not None:
            row["val_preintegration"] = float(preintegration)
        normalised = zip("xyz", validation.axis_normalised, strict=True)
        return row | {f"val_normalised/{axis}": float(value) for axis, value in normalised}

    def last_stage(self, state: TrainState) -> Stage:
        """The stage of the step that led to `state`."""
        return loss_stage(self.config.loss, state.step - 1, self.steps_per_epoch)

    def remark(self, row: Row) -> str:
        """The parts of both losses, which can be compared between networks, unlike the losses."""
        parts = ("mse", "nll", "preintegration")
        training, validation = (
            " ".join(f"{part} {row[prefix + part]:.4g}" for part in parts if prefix + part in row)
            for prefix in ("", "val_")
        )
        return f"{training}  val {validation}  "


# A batch
# ------------------------------------------------------------------------------------------------


def apply_training(
    model: nn.Module, variables: Any, batch: tuple[Windows, PRNGKeyArray]
) -> tuple[Prediction, Any]:
    """The prediction in training mode, and the variables that changed: statistics of the batch."""
    windows, dropout_key = batch
    options = {"mutable": ["batch_stats"], "rngs": {"dropout": dropout_key}}
    return model.apply(variables, windows.imu, train=True, **options)  # type: ignore[return-value]


def predicted_axes(model: nn.Module) -> int:
    """How many axes of the displacement a network predicts: 2 where the vertical is always 0."""
    return getattr(models.innermost(model), "output_dim", 3)


# The statistics of batch normalisation
# ------------------------------------------------------------------------------------------------


def has_statistics(state: TrainState, *names: str) -> bool:
    """Whether the network has statistics of one of these names: "mean" of a normalisation,
    "log_std" or "log_factor" of an uncertainty that validation calibrates (`models.heads`)."""
    leaves = jax.tree_util.tree_leaves_with_path(state.variables["batch_stats"])
    return any(path[-1].key in names for path, _ in leaves)


def statistics_order(
    key: PRNGKeyArray, source: WindowSource, task: WindowTask
) -> Int[jax.Array, "m"]:
    """The windows of `estimate_statistics`: whole batches for `optim.statistics_windows`, at most
    those of an epoch, drawn from `key` alone."""
    optim = task.config.optim
    order_key, _ = jax.random.split(key)
    visited = task.select_visits(order_key, jnp.asarray(source.visited))
    size = optim.batch_size
    batches = min(-(-optim.statistics_windows // size), len(visited) // size)
    return jax.random.permutation(order_key, visited)[: batches * size]


@functools.partial(jax.jit, static_argnames="task")
def estimate_statistics(
    state: TrainState,
    source: WindowSource,
    order: Int[jax.Array, "m"],
    key: PRNGKeyArray,
    *,
    task: WindowTask,
) -> TrainState:
    """The state with the statistics of every batch normalisation estimated anew for its parameters.

    The statistics are means over batches of augmented training windows, in training mode: those of
    `order`, which `statistics_order` draws from the same `key`. Running averages remember only ten
    steps, and their error is an offset of the displacement (ours; Wu and Johnson 2021, "Rethinking
    'Batch' in BatchNorm"). Nothing else of `batch_stats` changes.
    """
    size, before = task.config.optim.batch_size, state.variables["batch_stats"]
    batches = order.shape[0] // size
    _, draw_key = jax.random.split(key)
    # A normalisation adds the batch's statistics times 1 − MOMENTUM to its own times MOMENTUM. If
    # its own are zero, only the first term remains.
    zeros = jax.tree.map(jnp.zeros_like, before)
    variables = state.variables | {"batch_stats": zeros}

    def add_batch(total: Any, number_which: tuple[jax.Array, jax.Array]) -> tuple[Any, None]:
        number, which = number_which
        batch = task.draw(jax.random.fold_in(draw_key, number), source, which)
        _, changed = apply_training(task.model, variables, batch)
        return jax.tree.map(jnp.add, total, changed["batch_stats"]), None

    parts = order.reshape(batches, size)
    total, _ = jax.lax.scan(add_batch, zeros, (jnp.arange(batches), parts))

    def statistic(path: tuple, total: jax.Array, before: jax.Array) -> jax.Array:
        return total / (batches * (1 - MOMENTUM)) if path[-1].key in ("mean", "var") else before

    estimated = jax.tree_util.tree_map_with_path(statistic, total, before)
    return parallel.replicate(
        state._replace(variables=state.variables | {"batch_stats": estimated})
    )


# Validation
# ------------------------------------------------------------------------------------------------


class Validation(NamedTuple):
    """Means over every window of a split."""

    losses: Losses
    axis_mse: Float[jax.Array, "3"]
    """Squared error of each axis of the uncertainty, m²."""
    axis_normalised: Float[jax.Array, "3"]
    """(e/σ)² of each axis: 1 if the standard deviations are those of the errors."""


@functools.partial(jax.jit, static_argnames="task")
def validate(
    state: TrainState, source: WindowSource, stage: Stage, *, task: WindowTask
) -> Validation:
    """Mean losses and errors over every window of `source`, without augmentation and in inference
    mode. The balance of experts is that of a batch and not of a window, where it would be the
    larger the surer the router is; it is left out."""
    config, model, axes = task.config, task.model, predicted_axes(task.model)
    count = source.visited.shape[0]
    # Batches are whole, so that each device has the same share: the last one is filled up with
    # windows of weight zero.
    size = -(-min(config.optim.batch_size, count) // parallel.count()) * parallel.count()
    batches = -(-count // size)
    which = source.visited[
        jnp.minimum(jnp.arange(batches * size, dtype=jnp.int32), count - 1)
    ].reshape(batches, size)
    weight = (jnp.arange(batches * size) < count).astype(jnp.float32).reshape(batches, size)

    def one_window(prediction: Prediction, windows: Windows) -> Validation:
        prediction, windows = jax.tree.map(lambda x: x[None], (prediction, windows))
        error = windows.displacement - prediction.displacement
        loss = config.loss
        if "router" in prediction.diagnostics:
            loss = dataclasses.replace(loss, balance_weight=0.0)
        return Validation(
            losses(prediction, windows, loss, stage, axes, 1 / config.data.rate),
            prediction.along_axes(error)[0] ** 2,
            prediction.normalise(error, None)[0][0],
        )

    def one_batch(which_weight: tuple[jax.Array, jax.Array]) -> Validation:
        windows = parallel.split(
            gather(source, parallel.split(which_weight[0]), config.data.input_samples)
        )
        figures = jax.vmap(one_window)(model.apply(state.variables, windows.imu), windows)
        return jax.tree.map(lambda x: jnp.tensordot(which_weight[1], x, 1), figures)

    return jax.tree.map(
        lambda x: jnp.sum(x, axis=0) / count, jax.lax.map(one_batch, (which, weight))
    )


def calibrate_uncertainty(
    state: TrainState, validation: Validation, isotropic: bool = False
) -> TrainState:
    """The state whose constants and factors of the uncertainty (`models.heads`) fit the errors that
    validation found with it.

    `isotropic`: both horizontal axes get their mean, because constants of a mean over headings
    cannot distinguish them. Errors below 0.1 mm count as 0.1 mm, and a σ changes at most by a
    factor of 1000 at once, so that nothing becomes infinite.
    """
    mse, normalised = (
        axes.at[:2].set(axes[:2].mean()) if isotropic else axes
        for axes in (validation.axis_mse, validation.axis_normalised)
    )

    def fit_leaf(path: tuple, leaf: jax.Array) -> jax.Array:
        match path[-1].key:
            case "log_std":
                return 0.5 * jnp.log(jnp.maximum(mse, 1e-8))
            case "log_factor":
                return leaf + 0.5 * jnp.log(jnp.clip(normalised, 1e-6, 1e6))
            case _:
                return leaf

    statistics = jax.tree_util.tree_map_with_path(fit_leaf, state.variables["batch_stats"])
    return state._replace(variables=state.variables | {"batch_stats": statistics})
