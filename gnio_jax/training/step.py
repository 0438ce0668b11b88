"""The jitted training and validation steps: gather, rotate, augment, forward, backward, update, all on the device."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Float, Int, PRNGKeyArray

from gnio_jax.config import TrainConfig
from gnio_jax.data.augment import augment
from gnio_jax.data.windows import WindowSource, gather, shifted
from gnio_jax.models import initialise
from gnio_jax.training.losses import Losses, Stage, losses
from gnio_jax.types import Prediction, Windows


class TrainState(NamedTuple):
    """All that changes from step to step. Random draws are functions of the seed and `step` alone."""

    step: Int[jax.Array, ""]
    params: Any
    batch_stats: Any
    opt_state: Any


class Progress(NamedTuple):
    """What a run of steps reports."""

    sums: Losses
    """Losses summed over the steps."""
    gradient_norms: dict[str, Float[jax.Array, ""]]
    """Norms of the gradient by part of the network (`gradient_norms`), summed over the steps."""
    failed_step: Int[jax.Array, ""]
    """First step whose loss was not finite; −1 when all were."""


def create_state(model: nn.Module, optimizer: optax.GradientTransformation, key: PRNGKeyArray, window: int) -> TrainState:
    """Fresh parameters for windows of `window` samples, at step 0."""
    variables = initialise(model, key, window)
    params = variables["params"]
    return TrainState(jnp.int32(0), params, variables.get("batch_stats", {}), optimizer.init(params))


def epoch_order(key: PRNGKeyArray, epoch: int, source: WindowSource) -> Int[jax.Array, "m"]:
    """The order in which epoch `epoch` visits the windows: a permutation that depends on nothing else."""
    return jax.random.permutation(jax.random.fold_in(key, epoch), jnp.asarray(source.visited))


@functools.partial(jax.jit, static_argnames=("model", "optimizer", "config"), donate_argnames="state")
def train_steps(
    state: TrainState,
    source: WindowSource,
    order: Int[jax.Array, "m"],
    first: Int[jax.Array, ""],
    count: Int[jax.Array, ""],
    stage: Stage,
    key: PRNGKeyArray,
    *,
    model: nn.Module,
    optimizer: optax.GradientTransformation,
    config: TrainConfig,
) -> tuple[TrainState, Progress]:
    """Take `count` steps of an epoch from its step number `first` on, in one dispatch.

    `count` is not static: however an epoch is cut into dispatches it is the same program, so a run that was
    interrupted and resumed has the same parameters to the bit.
    """
    size = config.optim.batch_size

    def one_step(i: jax.Array, carry: tuple[TrainState, Progress]) -> tuple[TrainState, Progress]:
        state, progress = carry
        which = jax.lax.dynamic_slice(order, ((first + i) * size,), (size,))
        augment_key, dropout_key, shift_key = jax.random.split(jax.random.fold_in(key, state.step), 3)
        which = shifted(shift_key, source, which, config.augment.shift_samples)
        windows = augment(augment_key, gather(source, which, config.data.window), config.augment)

        def objective(params: Any) -> tuple[jax.Array, tuple[Losses, Any]]:
            prediction, changed = model.apply(
                {"params": params, "batch_stats": state.batch_stats}, windows.imu, train=True,
                mutable=["batch_stats"], rngs={"dropout": dropout_key},
            )  # fmt: skip
            loss = losses(prediction, windows, config.loss, stage)
            return loss.total, (loss, changed.get("batch_stats", {}))

        gradient, (loss, batch_stats) = jax.grad(objective, has_aux=True)(state.params)
        update, opt_state = optimizer.update(gradient, state.opt_state, state.params)
        update = optax.tree.scale(stage.learning_rate_factor, update)
        failed = jnp.where((progress.failed_step < 0) & ~jnp.isfinite(loss.total), state.step, progress.failed_step)
        state = TrainState(jnp.add(state.step, 1), optax.apply_updates(state.params, update), batch_stats, opt_state)
        sums = jax.tree.map(jnp.add, (progress.sums, progress.gradient_norms), (loss, gradient_norms(gradient)))
        return state, Progress(sums[0], sums[1], failed)

    nothing = Progress(Losses(*[jnp.float32(0)] * 3), jax.tree.map(jnp.zeros_like, gradient_norms(state.params)), jnp.int32(-1))
    return jax.lax.fori_loop(jnp.int32(0), count, one_step, (state, nothing))


def gradient_norms(gradient: Any) -> dict[str, Float[jax.Array, ""]]:
    """Norm of the gradient with respect to each part of the network: its modules, and of a head its layers (`head/scale`)."""
    squares: dict[str, list[jax.Array]] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        names = [str(entry.key) for entry in path]
        part = "/".join(names[: 2 if names[0] == "head" else 1])
        squares.setdefault(part, []).append(jnp.sum(leaf**2))
    return {part: jnp.sqrt(sum(found)) for part, found in squares.items()}


@functools.partial(jax.jit, static_argnames=("model", "config"))
def validate(
    state: TrainState, source: WindowSource, stage: Stage, *, model: nn.Module, config: TrainConfig
) -> tuple[Losses, Float[jax.Array, "3"]]:
    """Mean losses over every window of `source`, without augmentation and with the running batch statistics; and the mean
    squared error of each axis, m²."""
    count = source.visited.shape[0]
    size = min(config.optim.batch_size, count)
    batches = -(-count // size)
    # The last batch is filled up with windows of weight zero.
    which = source.visited[jnp.minimum(jnp.arange(batches * size, dtype=jnp.int32), count - 1)].reshape(batches, size)
    weight = (jnp.arange(batches * size) < count).astype(jnp.float32).reshape(batches, size)

    def one_window(prediction: Prediction, windows: Windows) -> tuple[Losses, jax.Array]:
        prediction, windows = jax.tree.map(lambda x: x[None], (prediction, windows))
        return losses(prediction, windows, config.loss, stage), jnp.square(windows.displacement - prediction.displacement)[0]

    def one_batch(which_weight: tuple[jax.Array, jax.Array]) -> tuple[Losses, jax.Array]:
        windows = gather(source, which_weight[0], config.data.window)
        prediction: Any = model.apply({"params": state.params, "batch_stats": state.batch_stats}, windows.imu)
        each = jax.vmap(one_window)(prediction, windows)
        return jax.tree.map(lambda x: jnp.tensordot(which_weight[1], x, 1), each)

    return jax.tree.map(lambda x: jnp.sum(x, axis=0) / count, jax.lax.map(one_batch, (which, weight)))


def calibrated(state: TrainState, axis_mse: Float[jax.Array, "3"]) -> TrainState:
    """The state with every constant uncertainty (`models.heads.ConstantUncertainty`) set to these squared errors, m²."""
    def constant(path: tuple, leaf: jax.Array) -> jax.Array:
        return 0.5 * jnp.log(axis_mse) if path[-1] == jax.tree_util.DictKey("log_std") else leaf

    return state._replace(batch_stats=jax.tree_util.tree_map_with_path(constant, state.batch_stats))
