"""The jitted steps of training through the filter: cut the pieces, run network and filter, take the
gradient of the losses, update; and validation.

The filter runs in float64 (JAX's x64 must be on); what learns, and the optimizer, are float32.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from gnio_jax import models
from gnio_jax.config import TrainConfig
from gnio_jax.filtering import (
    FilterConfig,
    FilterHistory,
    initial_state,
    over_sequences,
    run_odometry,
)
from gnio_jax.filtering.history import POSITION
from gnio_jax.filtering.settings import filter_setup, with_free_parameters
from gnio_jax.training import learnt as learning
from gnio_jax.training import optimizer as optimizers
from gnio_jax.training.filter_losses import FilterLosses, filter_losses, normalised_squares
from gnio_jax.training.learnt import Learnt
from gnio_jax.training.pieces import (
    Path,
    Piece,
    PieceSource,
    StartErrors,
    cut_piece,
    draw_start_errors,
    start_rotation,
    turned_piece,
)
from gnio_jax.training.step import Progress, TrainState

CHECKPOINT_EVERY = 20
"""Clone intervals between the states that the backward pass keeps."""


class Sums(NamedTuple):
    """Losses of the steps that were taken, summed, and the number of the others."""

    total: Float[jax.Array, ""]
    displacement: Float[jax.Array, ""]
    """Mean over the horizons, as the next one."""
    yaw: Float[jax.Array, ""]
    innovation: Float[jax.Array, ""]
    state: Float[jax.Array, ""]
    window: Float[jax.Array, ""]
    skipped: Float[jax.Array, ""]


class Filtered(NamedTuple):
    """What became of a piece."""

    losses: FilterLosses
    healthy: Bool[jax.Array, ""]
    """Whether the filter never diverged."""
    nis: Float[jax.Array, ""]
    """Mean normalised innovation squared over its degrees of freedom."""
    nees: Float[jax.Array, ""]
    """Mean normalised error squared of the position over its degrees of freedom."""


class Ready(NamedTuple):
    """Network and filter options as the filter's loop takes them; the same for every piece."""

    network: models.InferenceVariables
    filter: dict[str, Any]
    """Free parameters of `FilterSettings`."""


def filter_config(config: TrainConfig, training: bool) -> FilterConfig:
    """The filter of a piece: in training with a gate that has a slope and a gradient that is cut,
    else as evaluation has it."""
    ekf = filter_setup(config.data, config.filter).config
    if not training:
        return ekf
    through = config.through_filter
    return dataclasses.replace(
        ekf,
        gate_softness=through.gate_softness,
        checkpoint_every=CHECKPOINT_EVERY,
        truncate_every=round(through.truncate_seconds / config.data.stride_seconds),
    )


def intervals(config: TrainConfig) -> int:
    """Clone intervals in a piece."""
    return round(config.through_filter.piece_seconds / config.data.stride_seconds)


def ready(variables: Any, model: nn.Module) -> Ready:
    """Variables, the collection "filter" among them, made ready for the filter's loop."""
    network = {name: tree for name, tree in variables.items() if name != "filter"}
    return Ready(models.inference_variables(model, network), variables["filter"])


def run_piece(
    program: Ready,
    piece: Piece,
    errors: StartErrors,
    model: nn.Module,
    config: TrainConfig,
    ekf: FilterConfig,
) -> tuple[Path, FilterHistory]:
    """The filter over one piece with the network in its loop: its path, the start included."""
    settings = with_free_parameters(config.filter, program.filter)
    predict = functools.partial(models.Inference(model), program.network)
    truth = piece.truth
    start = initial_state(
        ekf,
        start_rotation(truth, errors),
        truth.velocity[0] + errors.velocity,
        truth.position[0] + errors.position,
        errors.gyro_bias,
        errors.accel_bias,
        settings.start,
    )
    _, history = run_odometry(predict, start, piece.gyro, piece.accel, ekf, settings.noise)
    path = Path(
        jnp.concatenate([start.rotation[None], history.rotation]),
        jnp.concatenate([start.velocity[None], history.velocity]),
        jnp.concatenate([start.position[None], history.position]),
    )
    return path, history


def filter_pieces(
    program: Ready,
    pieces: Piece,
    errors: StartErrors,
    model: nn.Module,
    config: TrainConfig,
    ekf: FilterConfig,
) -> Filtered:
    """What becomes of each of a batch of pieces, shared out among the devices."""

    def one(program: Ready, piece: Piece, errors: StartErrors) -> Filtered:
        path, history = run_piece(program, piece, errors, model, config, ekf)
        assert history.covariance is not None
        weights = config.through_filter
        found = filter_losses(path, piece.truth, history, ekf, weights)
        error = piece.truth.position[1:] - history.position
        squares = normalised_squares(error, history.covariance[:, POSITION, POSITION])
        nis = jnp.nanmean(history.nis) / 3
        return Filtered(found, history.healthy[-1] > 0, nis, jnp.mean(squares) / 3)

    return over_sequences(one, shared=1)(program, pieces, errors)


def draw_pieces(
    key: PRNGKeyArray, source: PieceSource, starts: Int[jax.Array, "b"], config: TrainConfig
) -> tuple[Piece, StartErrors]:
    """The pieces that begin at rows `starts`, and how wrong the filter starts in each."""
    count, stride = intervals(config), config.data.stride
    pieces = jax.vmap(lambda start: cut_piece(source, start, count, stride))(starts)
    std, spread = filter_setup(config.data, config.filter).initial_std, config.through_filter
    keys = jax.random.split(key, starts.shape[0])
    errors = jax.vmap(lambda key: draw_start_errors(key, std, spread.start_spread))(keys)
    return pieces, errors


def training_pieces(
    key: PRNGKeyArray, source: PieceSource, starts: Int[jax.Array, "b"], config: TrainConfig
) -> tuple[Piece, StartErrors]:
    """`draw_pieces`, with `augment.yaw` each turned by a random yaw: the filter finds the same path
    but for the turn, and the network sees windows of another heading."""
    pieces, errors = draw_pieces(key, source, starts, config)
    if config.augment.yaw:
        count, key = starts.shape[0], jax.random.fold_in(key, 1)
        angles = jax.random.uniform(key, (count,), jnp.float64, -jnp.pi, jnp.pi)
        pieces = jax.vmap(turned_piece)(pieces, angles)
    return pieces, errors


def optimizer(config: TrainConfig, steps_per_epoch: int) -> optax.GradientTransformationExtraArgs:
    """The optimizer of what learns."""
    rate = config.through_filter.filter_learning_rate
    return optimizers.create_through_filter(config.optim, rate, steps_per_epoch)


@functools.partial(jax.jit, static_argnames=("model", "config"), donate_argnames="state")
def train_steps(
    state: TrainState,
    source: PieceSource,
    order: Int[jax.Array, "p"],
    first: Int[jax.Array, ""],
    count: Int[jax.Array, ""],
    learning_rate_factor: Float[jax.Array, ""],
    key: PRNGKeyArray,
    *,
    model: nn.Module,
    config: TrainConfig,
) -> tuple[TrainState, Progress]:
    """Take `count` steps of an epoch, whose pieces begin at the rows `order`, from its step number
    `first` on; see `step.train_steps`."""
    size = config.optim.batch_size
    adam = optimizer(config, order.shape[0] // size)

    def one_step(i: jax.Array, carry: tuple[TrainState, Progress]) -> tuple[TrainState, Progress]:
        state, progress = carry
        starts = jax.lax.dynamic_slice(order, ((first + i) * size,), (size,))
        batch = training_pieces(jax.random.fold_in(key, state.step), source, starts, config)
        variables = state.variables
        learnt = learning.chosen(variables, config.through_filter.learn)
        gradient, losses, healthy = gradient_of_pieces(variables, learnt, *batch, model, config)

        update, opt_state = adam.update(gradient, state.opt_state, learnt)
        update = optax.tree.scale(learning_rate_factor, update)
        taken = learning.merged(variables, optax.apply_updates(learnt, update))

        norms = gradient_norms(gradient)
        tame = optax.tree.norm(gradient) <= config.through_filter.skip_above  # false for NaN
        tame = tame & healthy & jnp.isfinite(losses.total)
        kept = jax.tree.map(
            lambda new, old: jnp.where(tame, new, old),
            (taken, opt_state),
            (variables, state.opt_state),
        )
        progress = _add_step(progress, losses, norms, tame)
        return TrainState.of(jnp.add(state.step, 1), *kept), progress

    learnt = learning.chosen(state.variables, config.through_filter.learn)
    nothing = Progress(
        Sums(*[jnp.float64(0)] * len(Sums._fields)),
        jax.tree.map(jnp.zeros_like, gradient_norms(learnt)),
        jnp.int32(-1),
    )
    return jax.lax.fori_loop(jnp.int32(0), count, one_step, (state, nothing))


def gradient_of_pieces(
    variables: Any,
    learnt: Learnt,
    pieces: Piece,
    errors: StartErrors,
    model: nn.Module,
    config: TrainConfig,
) -> tuple[Learnt, FilterLosses, Bool[jax.Array, ""]]:
    """Gradient of the mean loss of the pieces by what learns, the mean losses, and whether the
    filter diverged in none of them."""
    ekf = filter_config(config, training=True)

    def objective(learnt: Learnt) -> tuple[jax.Array, tuple[FilterLosses, jax.Array]]:
        program = ready(learning.merged(variables, learnt), model)
        found = filter_pieces(program, pieces, errors, model, config, ekf)
        losses = jax.tree.map(lambda each: jnp.mean(each, axis=0), found.losses)
        return losses.total, (losses, jnp.all(found.healthy))

    gradient, (losses, healthy) = jax.grad(objective, has_aux=True)(learnt)
    return gradient, losses, healthy


def gradient_norms(gradient: Learnt) -> dict[str, Float[jax.Array, ""]]:
    """Norm of the gradient by each part that learns: modules of the network (`head`), options of
    the filter (`filter/gyro_density`)."""
    named = dict(gradient.get("params", {}))
    named |= {f"filter/{name}": leaf for name, leaf in gradient.get("filter", {}).items()}
    return {name: optax.tree.norm(part) for name, part in named.items()}


def _add_step(
    progress: Progress,
    losses: FilterLosses,
    norms: dict[str, jax.Array],
    tame: Bool[jax.Array, ""],
) -> Progress:
    """The progress with the losses and norms of one more step, or one more skipped."""
    means = Sums(*(jnp.mean(each) for each in losses), skipped=jnp.float64(1))
    counted = jax.tree.map(lambda value: jnp.where(tame, value, 0.0), (means, norms))
    of_step, norms = counted
    of_step = of_step._replace(skipped=jnp.where(tame, 0.0, 1.0))
    sums, norms = jax.tree.map(jnp.add, (progress.sums, progress.gradient_norms), (of_step, norms))
    return progress._replace(sums=sums, gradient_norms=norms)


@functools.partial(jax.jit, static_argnames=("model", "config"))
def validate(
    state: TrainState,
    source: PieceSource,
    key: PRNGKeyArray,
    *,
    model: nn.Module,
    config: TrainConfig,
) -> Filtered:
    """Means over the pieces of `source`, each at its earliest place, with the gate that evaluation
    has. The errors of the starts depend on `key` alone. `healthy`: all were."""
    count = source.earliest.shape[0]
    size = min(config.optim.batch_size, count)
    batches = -(-count // size)
    # The last batch is filled up with pieces of weight zero.
    which = jnp.minimum(jnp.arange(batches * size), count - 1)
    weight = (jnp.arange(batches * size) < count).astype(jnp.float64) / count
    ekf, program = filter_config(config, training=False), ready(state.variables, model)
    pieces, errors = draw_pieces(key, source, jnp.asarray(source.earliest)[which], config)

    def one_batch(batch: tuple[Piece, StartErrors, jax.Array]) -> Filtered:
        found = filter_pieces(program, batch[0], batch[1], model, config, ekf)
        found = found._replace(healthy=found.healthy.astype(jnp.float64))
        return jax.tree.map(lambda each: jnp.tensordot(batch[2], each, 1), found)

    in_batches = jax.tree.map(
        lambda each: each.reshape(batches, size, *each.shape[1:]), (pieces, errors, weight)
    )
    found = jax.lax.map(one_batch, in_batches)
    means = jax.tree.map(lambda each: jnp.sum(each, axis=0), found)
    return means._replace(healthy=means.healthy > 1 - 0.5 / count)
