"""The jitted training step on windows: gather, rotate, augment, forward, backward, update, all on
the device."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Float, Int, PRNGKeyArray

from gnio_jax.config import TrainConfig
from gnio_jax.data.augmentation import augment
from gnio_jax.data.windows import WindowSource, gather, shift_windows
from gnio_jax.models import initialise
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
        prediction, changed = apply_training(model, variables, windows, key)
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


def draw_windows(
    key: PRNGKeyArray, source: WindowSource, which: Int[jax.Array, "b"], config: TrainConfig
) -> tuple[Windows, PRNGKeyArray]:
    """The windows `which`, shifted and augmented by draws from `key`, and the key of the network's
    dropout. Each device cuts its share of them."""
    augment_key, dropout_key, shift_key = jax.random.split(key, 3)
    which = shift_windows(shift_key, source, shared_out(which), config.augment.shift_samples)
    windows = gather(source, shared_out(which), config.data.seen)
    return shared_out(augment(augment_key, windows, config.augment)), dropout_key


def gradient_norms(gradient: Any) -> dict[str, Float[jax.Array, ""]]:
    """Norm of the gradient with respect to each part of the network: its modules, and of a head its
    layers (`head/scale`)."""
    squares: dict[str, list[jax.Array]] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        names = [str(entry.key) for entry in path]
        part = "/".join(names[: 2 if names[0] == "head" else 1])
        squares.setdefault(part, []).append(jnp.sum(leaf**2))
    return {part: jnp.sqrt(sum(found)) for part, found in squares.items()}
