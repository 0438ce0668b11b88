"""Adaptation of a network to test windows without labels (RIO: Cao et al., "RIO: Rotation-
Equivariance Supervised Learning of Robust Inertial Odometry", CVPR 2022): a few steps on its
rotation consistency where it is uncertain."""

from __future__ import annotations

import functools
import math
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from jaxtyping import Float

from gnio_jax.models.equivariance import opposite, turn, turn_windows
from gnio_jax.training.network_losses import consistency
from gnio_jax.types import Array, Prediction

STEPS = 5
"""Steps of Adam on a batch."""
LEARNING_RATE = 1e-4
"""Learning rate (ours: it is not published)."""
LEAST_VARIANCE = 1e-4
"""Smallest variance, m², below which some window's predictions have collapsed: the first weights
come back."""
ENOUGH_VARIANCE = 0.04
"""Mean variance, m², below which the network is certain enough: the weights stay."""
ANGLES = tuple(math.radians(angle) for angle in (72, 144, 216, 288))
"""Turns of the windows in the loss."""
ENSEMBLE = tuple(math.radians(angle) for angle in (0, 120, 240))
"""Turns whose predictions, turned back, are the ensemble (ours: the published ensemble has three
members, and it is not said which)."""


class Adaptation(NamedTuple):
    """The variables for a batch, and how they came about."""

    variables: Any
    decision: Literal["restored", "kept", "adapted"]


def adapt(
    model: nn.Module,
    first: Any,
    variables: Any,
    windows: Float[Array, "b n 6"],
    learning_rate: float = LEARNING_RATE,
) -> Adaptation:
    """The variables with which a batch of windows is predicted (published: 128 windows, in the
    order of the recording).

    first: those of the trained network. variables: those of the batch before. Only the scales and
    biases of normalisations change (ours), so that a few windows cannot unlearn the network.
    """
    variance = np.asarray(ensemble_variance(model, variables, windows))
    if variance.min() < LEAST_VARIANCE:
        return Adaptation(first, "restored")
    if variance.mean() < ENOUGH_VARIANCE:
        return Adaptation(variables, "kept")
    return Adaptation(_descend(model, variables, windows, learning_rate), "adapted")


@functools.partial(jax.jit, static_argnums=0)
def ensemble_variance(
    model: nn.Module, variables: Any, windows: Float[Array, "b n 6"]
) -> Float[jax.Array, "b"]:
    """Variance of the horizontal displacement over the ensemble, the mean of both axes, m²."""
    members = []
    for angle in ENSEMBLE:
        heading = _heading(angle, len(windows))
        prediction: Any = model.apply(variables, turn_windows(windows, heading))
        members.append(turn(prediction.displacement, opposite(heading))[:, :2])
    return jnp.mean(jnp.var(jnp.stack(members), axis=0), axis=-1)


@functools.partial(jax.jit, static_argnums=0)
def _descend(
    model: nn.Module, variables: Any, windows: Float[Array, "b n 6"], learning_rate: Any
) -> Any:
    """The variables after `STEPS` steps on −cos, the mean over the windows and `ANGLES`."""
    trained = jax.tree_util.tree_map_with_path(
        lambda path, _: any("norm" in step.key or "bn" in step.key for step in path),
        variables["params"],
    )
    adam = optax.masked(optax.adam(learning_rate), trained)

    def loss(params: Any) -> jax.Array:
        changed = {**variables, "params": params}
        prediction: Prediction = model.apply(changed, windows)  # type: ignore[assignment]
        total = jnp.float32(0)
        for angle in ANGLES:
            heading = _heading(angle, len(windows))
            of_turned: Any = model.apply(changed, turn_windows(windows, heading))
            total = total - jnp.mean(consistency(prediction, of_turned, heading)) / len(ANGLES)
        return total

    params, state = variables["params"], adam.init(variables["params"])
    for _ in range(STEPS):
        gradient = jax.grad(loss)(params)
        gradient = jax.tree.map(lambda g, t: g if t else jnp.zeros_like(g), gradient, trained)
        updates, state = adam.update(gradient, state, params)
        params = optax.apply_updates(params, updates)
    return {**variables, "params": params}


def _heading(angle: float, count: int) -> jax.Array:
    return jnp.tile(jnp.array([[math.cos(angle), math.sin(angle)]], jnp.float32), (count, 1))
