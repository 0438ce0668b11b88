"""The jitted validation on windows, and the constants of the uncertainty that it sets."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Float

from gnio_jax.config import TrainConfig
from gnio_jax.data.windows import WindowSource, gather
from gnio_jax.scaling import devices
from gnio_jax.scaling.devices import shared_out
from gnio_jax.training.losses import Losses, Stage, losses
from gnio_jax.training.step import TrainState
from gnio_jax.types import Prediction, Windows


class Validation(NamedTuple):
    """Means over every window of a split."""

    losses: Losses
    axis_mse: Float[jax.Array, "3"]
    """Squared error of each axis, m²."""
    axis_normalised: Float[jax.Array, "3"]
    """(e/σ)² of each axis: 1 where the standard deviations are those of the errors."""


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


def mean_of(found: list[Validation], counts: list[int]) -> Validation:
    """The means over all windows from those over parts of so many windows."""
    if len(found) == 1:
        return found[0]
    shares = np.float32(counts) / np.float32(sum(counts))
    return jax.tree.map(
        lambda *means: sum(s * m for s, m in zip(shares, means, strict=True)), *found
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
