"""The statistics of batch normalisation, estimated anew before a network is validated."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Int, PRNGKeyArray

from gnio_jax.config import TrainConfig
from gnio_jax.data.windows import WindowSource
from gnio_jax.models.layers import MOMENTUM
from gnio_jax.scaling.devices import kept_everywhere
from gnio_jax.training.step import TrainState, apply_training, draw_windows


def normalises(state: TrainState) -> bool:
    """Whether the network has batch normalisations."""
    return any(
        path[-1].key == "mean" for path, _ in jax.tree_util.tree_leaves_with_path(state.batch_stats)
    )


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
        _, changed = apply_training(model, variables, windows, dropout_key)
        return jax.tree.map(jnp.add, total, changed["batch_stats"]), None

    parts = order.reshape(batches, config.optim.batch_size)
    total, _ = jax.lax.scan(add_batch, zeros, (jnp.arange(batches), parts))

    def statistic(path: tuple, total: jax.Array, before: jax.Array) -> jax.Array:
        return total / (batches * (1 - MOMENTUM)) if path[-1].key in ("mean", "var") else before

    estimated = jax.tree_util.tree_map_with_path(statistic, total, state.batch_stats)
    return kept_everywhere(state._replace(batch_stats=estimated))
