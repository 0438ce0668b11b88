"""The jitted training and validation steps: gather, rotate, augment, forward, backward, update, all
on the device."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from jaxtyping import Float, Int, PRNGKeyArray

from gnio_jax.config import TrainConfig
from gnio_jax.data.augmentation import augment
from gnio_jax.data.windows import WindowSource, gather, shift_windows
from gnio_jax.models import initialise
from gnio_jax.models.resnet import MOMENTUM
from gnio_jax.scaling import devices
from gnio_jax.scaling.devices import kept_everywhere, shared_out
from gnio_jax.training.losses import Losses, Stage, losses, stage
from gnio_jax.types import Prediction, Windows


class TrainState(NamedTuple):
    """All that changes from step to step. Random draws depend on the seed and `step` alone."""

    step: Int[jax.Array, ""]
    params: Any
    batch_stats: Any
    opt_state: Any
    average: Any = None
    """Moving average of `params` (`optim.ema_decay`); None where none is kept."""
    filter: Any = {}
    """Options of the filter as they learn (`learnt.filter_numbers`), if they do."""

    @property
    def variables(self) -> dict[str, Any]:
        """Variables by collection: the network's, and "filter" if that learns."""
        network = {"params": self.params, "batch_stats": self.batch_stats}
        return network | ({"filter": self.filter} if self.filter else {})

    @classmethod
    def of(cls, step: jax.Array, variables: dict[str, Any], opt_state: Any) -> TrainState:
        """The state whose `variables` these are."""
        params, batch_stats = variables["params"], variables["batch_stats"]
        numbers = variables.get("filter", {})
        return cls(step, params, batch_stats, opt_state, filter=numbers)


class Validation(NamedTuple):
    """Means over every window of a split."""

    losses: Losses
    axis_mse: Float[jax.Array, "3"]
    """Squared error of each axis, m²."""
    axis_normalised: Float[jax.Array, "3"]
    """(e/σ)² of each axis: 1 where the standard deviations are those of the errors."""


class Progress(NamedTuple):
    """What a run of steps reports."""

    sums: Any
    """Losses summed over the steps: a NamedTuple of scalars, the first of them what is minimised.
    """
    gradient_norms: dict[str, Float[jax.Array, ""]]
    """Norms of the gradient by part of the network (`gradient_norms`), summed over the steps."""
    failed_step: Int[jax.Array, ""]
    """First step whose loss was not finite; −1 when all were."""


def create_state(
    model: nn.Module,
    optimizer: optax.GradientTransformation,
    key: PRNGKeyArray,
    window: int,
    ema_decay: float = 0.0,
) -> TrainState:
    """Fresh parameters for windows of `window` samples, at step 0; with an average of them unless
    `ema_decay` is 0."""
    variables = initialise(model, key, window)
    params = variables["params"]
    return TrainState(
        jnp.int32(0),
        params,
        variables.get("batch_stats", {}),
        optimizer.init(params),
        jax.tree.map(jnp.copy, params) if ema_decay else None,
    )


def evaluated(state: TrainState) -> TrainState:
    """The state with the parameters that are validated, kept as best and evaluated: their average
    where there is one."""
    if state.average is None:
        return state
    return state._replace(params=state.average, average=None)


def epoch_order(key: PRNGKeyArray, epoch: int, source: WindowSource) -> Int[jax.Array, "m"]:
    """The order in which epoch `epoch` visits the windows: a permutation that depends on nothing
    else."""
    return jax.random.permutation(jax.random.fold_in(key, epoch), jnp.asarray(source.visited))


@functools.partial(
    jax.jit,
    static_argnames=("model", "optimizer", "config", "steps_per_epoch"),
    donate_argnames="state",
)
def train_steps(
    state: TrainState,
    source: WindowSource,
    order: Int[jax.Array, "m"],
    first: Int[jax.Array, ""],
    count: Int[jax.Array, ""],
    learning_rate_factor: Float[jax.Array, ""],
    key: PRNGKeyArray,
    *,
    model: nn.Module,
    optimizer: optax.GradientTransformationExtraArgs,
    config: TrainConfig,
    steps_per_epoch: int | None = None,
) -> tuple[TrainState, Progress]:
    """Take `count` steps from step number `first` of `order` on, in one dispatch: of an epoch, or
    of a part of one with `steps_per_epoch`. `learning_rate_factor` is `optimizer.Plateau.factor`.

    `count` is not static: however an epoch is cut into dispatches it is the same program, so a run
    that was interrupted and resumed has the same parameters to the bit.
    """
    size = config.optim.batch_size
    steps_per_epoch = steps_per_epoch or order.shape[0] // size

    def one_step(i: jax.Array, carry: tuple[TrainState, Progress]) -> tuple[TrainState, Progress]:
        state, progress = carry
        which = jax.lax.dynamic_slice(order, ((first + i) * size,), (size,))
        windows, dropout_key = draw_windows(
            jax.random.fold_in(key, state.step), source, which, config
        )
        now = stage(config.loss, state.step, steps_per_epoch)
        gradient, loss, batch_stats = _gradient(state, windows, dropout_key, now, model, config)
        update, opt_state = optimizer.update(
            gradient, state.opt_state, state.params, log_std_learns=now.log_std_learns
        )
        update = optax.tree.scale(learning_rate_factor, update)
        params = optax.apply_updates(state.params, update)
        progress = _add_step(progress, state.step, loss, gradient)
        step = jnp.add(state.step, 1)
        average = _averaged(state.average, params, step, config.optim.ema_decay)
        state = TrainState(step, params, batch_stats, opt_state, average)
        return kept_everywhere(state), progress

    nothing = Progress(
        Losses(*[jnp.float32(0)] * 3),
        jax.tree.map(jnp.zeros_like, gradient_norms(state.params)),
        jnp.int32(-1),
    )
    return jax.lax.fori_loop(jnp.int32(0), count, one_step, (state, nothing))


def _gradient(
    state: TrainState,
    windows: Windows,
    dropout_key: PRNGKeyArray,
    now: Stage,
    model: nn.Module,
    config: TrainConfig,
) -> tuple[Any, Losses, Any]:
    """Gradient of the loss of a batch, the losses, and the statistics of batch normalisation: of
    `optim.accumulate` parts of the batch, one after another."""

    def objective(
        params: Any, batch_stats: Any, windows: Windows, key: PRNGKeyArray
    ) -> tuple[jax.Array, tuple[Losses, Any]]:
        variables = {"params": params, "batch_stats": batch_stats}
        prediction, changed = _apply_training(model, variables, windows, key)
        loss = losses(prediction, windows, config.loss, now)
        return loss.total, (loss, changed.get("batch_stats", {}))

    slope, parts = jax.grad(objective, has_aux=True), config.optim.accumulate
    if parts == 1:
        found = slope(state.params, state.batch_stats, windows, dropout_key)
        return found[0], *found[1]

    def add_part(
        carry: tuple[Any, Losses, Any], part: tuple[Windows, PRNGKeyArray]
    ) -> tuple[tuple[Any, Losses, Any], None]:
        gradient, loss, batch_stats = carry
        more, (more_loss, batch_stats) = slope(state.params, batch_stats, *part)
        return (*jax.tree.map(jnp.add, (gradient, loss), (more, more_loss)), batch_stats), None

    zeros = jax.tree.map(jnp.zeros_like, state.params), Losses(*[jnp.float32(0)] * 3)
    each = jax.tree.map(lambda rows: _in_parts(rows, parts), windows)
    keys = jax.random.split(dropout_key, parts)
    (*sums, batch_stats), _ = jax.lax.scan(add_part, (*zeros, state.batch_stats), (each, keys))
    gradient, loss = jax.tree.map(lambda total: total / parts, tuple(sums))
    return gradient, loss, batch_stats


def _in_parts(rows: jax.Array, parts: int) -> jax.Array:
    """Rows of a batch as (parts, rows of a part, ...). Row r goes to part r mod `parts`: a device
    that has successive rows has the same number of each part."""
    return rows.reshape(-1, parts, *rows.shape[1:]).swapaxes(0, 1)


def _averaged(average: Any, params: Any, step: Int[jax.Array, ""], decay: float) -> Any:
    """The moving average after `step` steps, the last of which gave `params`; None where none is
    kept.

    Weights β^(step − i) of the parameters after step i, divided by their sum, as Adam corrects its
    moments: the first steps count as those of a plain mean, and the start not at all.
    """
    if average is None:
        return None
    share = (1 - decay) / -jnp.expm1(step.astype(jnp.float32) * math.log(decay))
    return jax.tree.map(lambda mean, new: mean + share * (new - mean), average, params)


def _add_step(progress: Progress, step: jax.Array, loss: Losses, gradient: Any) -> Progress:
    """The progress with the losses and norms of one more step."""
    failed = jnp.where(jnp.isfinite(loss.total), jnp.int32(-1), step)
    return added(progress, Progress(loss, gradient_norms(gradient), failed))


def added(one: Progress, other: Progress) -> Progress:
    """The progress of steps and of those after them."""
    sums, norms = jax.tree.map(
        jnp.add, (one.sums, one.gradient_norms), (other.sums, other.gradient_norms)
    )
    failed = jnp.where(one.failed_step < 0, other.failed_step, one.failed_step)
    return Progress(sums, norms, failed)


def mean_of(found: list[Validation], counts: list[int]) -> Validation:
    """The means over all windows from those over parts of so many windows."""
    if len(found) == 1:
        return found[0]
    shares = np.float32(counts) / np.float32(sum(counts))
    return jax.tree.map(
        lambda *means: sum(s * m for s, m in zip(shares, means, strict=True)), *found
    )


def _apply_training(
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


def draw_windows(
    key: PRNGKeyArray, source: WindowSource, which: Int[jax.Array, "b"], config: TrainConfig
) -> tuple[Windows, PRNGKeyArray]:
    """The windows `which`, shifted and augmented by draws from `key`, and the key of the network's
    dropout. Each device cuts its share of them."""
    augment_key, dropout_key, shift_key = jax.random.split(key, 3)
    which = shift_windows(shift_key, source, shared_out(which), config.augment.shift_samples)
    windows = gather(source, shared_out(which), config.data.seen)
    return shared_out(augment(augment_key, windows, config.augment)), dropout_key


def normalises(state: TrainState) -> bool:
    """Whether the network has batch normalisations."""
    return any(
        path[-1].key == "mean" for path, _ in jax.tree_util.tree_leaves_with_path(state.batch_stats)
    )


def calibrates(state: TrainState) -> bool:
    """Whether the network has constants or factors of the uncertainty that validation sets."""
    found = jax.tree_util.tree_leaves_with_path(state.batch_stats)
    return any(path[-1].key in ("log_std", "log_factor") for path, _ in found)


def statistics_batches(source: WindowSource, config: TrainConfig) -> int:
    """Batches of `estimate_statistics`: those of `optim.statistics_windows`, but no more than an
    epoch has."""
    size = config.optim.batch_size
    return min(-(-config.optim.statistics_windows // size), source.visited.shape[0] // size)


def statistics_order(
    key: PRNGKeyArray, source: WindowSource, config: TrainConfig
) -> Int[jax.Array, "m"]:
    """The windows of `estimate_statistics`: whole batches, drawn from `key` alone."""
    order_key, _ = jax.random.split(key)
    count = statistics_batches(source, config) * config.optim.batch_size
    return jax.random.permutation(order_key, jnp.asarray(source.visited))[:count]


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
        _, changed = _apply_training(model, variables, windows, dropout_key)
        return jax.tree.map(jnp.add, total, changed["batch_stats"]), None

    parts = order.reshape(batches, config.optim.batch_size)
    total, _ = jax.lax.scan(add_batch, zeros, (jnp.arange(batches), parts))

    def statistic(path: tuple, total: jax.Array, before: jax.Array) -> jax.Array:
        return total / (batches * (1 - MOMENTUM)) if path[-1].key in ("mean", "var") else before

    estimated = jax.tree_util.tree_map_with_path(statistic, total, state.batch_stats)
    return kept_everywhere(state._replace(batch_stats=estimated))


def gradient_norms(gradient: Any) -> dict[str, Float[jax.Array, ""]]:
    """Norm of the gradient with respect to each part of the network: its modules, and of a head its
    layers (`head/scale`)."""
    squares: dict[str, list[jax.Array]] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        names = [str(entry.key) for entry in path]
        part = "/".join(names[: 2 if names[0] == "head" else 1])
        squares.setdefault(part, []).append(jnp.sum(leaf**2))
    return {part: jnp.sqrt(sum(found)) for part, found in squares.items()}


@functools.partial(jax.jit, static_argnames=("model", "config"))
def validate(
    state: TrainState, source: WindowSource, now: Stage, *, model: nn.Module, config: TrainConfig
) -> Validation:
    """Mean losses and errors over every window of `source`, without augmentation and in inference
    mode."""
    count = source.visited.shape[0]
    # Whole batches, of which each device has the same share: the last one is filled up with windows
    # of weight zero.
    size = -(-min(config.optim.batch_size, count) // devices.count()) * devices.count()
    batches = -(-count // size)
    which = source.visited[
        jnp.minimum(jnp.arange(batches * size, dtype=jnp.int32), count - 1)
    ].reshape(batches, size)
    weight = (jnp.arange(batches * size) < count).astype(jnp.float32).reshape(batches, size)

    def one_window(prediction: Prediction, windows: Windows) -> Validation:
        prediction, windows = jax.tree.map(lambda x: x[None], (prediction, windows))
        error = windows.displacement - prediction.displacement
        return Validation(
            losses(prediction, windows, config.loss, now),
            error[0] ** 2,
            error[0] ** 2 * jnp.exp(-2 * prediction.log_std[0]),
        )

    def one_batch(which_weight: tuple[jax.Array, jax.Array]) -> Validation:
        windows = shared_out(gather(source, shared_out(which_weight[0]), config.data.seen))
        prediction: Any = model.apply(
            {"params": state.params, "batch_stats": state.batch_stats}, windows.imu
        )
        each = jax.vmap(one_window)(prediction, windows)
        return jax.tree.map(lambda x: jnp.tensordot(which_weight[1], x, 1), each)

    return jax.tree.map(
        lambda x: jnp.sum(x, axis=0) / count, jax.lax.map(one_batch, (which, weight))
    )


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

    Errors below 0.1 mm, and σ wrong by more than a factor of 1000 at once, are taken for that:
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
