"""The trained variables and their optimizer: Adam with linear warm-up and cosine decay (paper
§IV-A), and the schedules of the networks that GNIO is compared with.

A learning rate is a function of the step, and the optimizer's state holds only Adam's moments, so a
step that is skipped does not shift the schedule. The filter's settings are trained as numbers
without bounds (`filtering.settings`); they are the collection "filter" beside the network's
variables.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Float

from gnio_jax.config import FilterSettings, LossConfig, OptimConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.filtering.settings import free_parameters, is_below, with_written_parameters
from gnio_jax.training.losses import switches

END_LEARNING_RATE = 1e-6
"""Learning rate at the last step of the cosine, unless its peak is lower."""
PLATEAU_EPOCHS, PLATEAU_FACTOR = 10, 0.1
"""The learning rate is multiplied by the factor after more than this number of epochs without a
smaller squared error on the validation split (RoNIN, DeepILS)."""
NETWORK_PARTS = {"uncertainty": ("uncertainty", "log_std"), "head": ("head", "displacement")}
"""Names of the modules of a network that belong to each of its parts; all others are its encoder
(docs/networks.md). Those of one expert of several have its name before theirs: expert1_log_std."""
FILTER_PARTS = {
    "noise": (
        "noise.gyro_density",
        "noise.accel_density",
        "noise.gyro_bias_walk",
        "noise.accel_bias_walk",
    ),
    "measurement": (
        "noise.measurement_scale",
        "noise.std_factor",
        "noise.correlation",
        "measurements",
    ),
    "start": ("start",),
}
"""Paths of the numbers of `FilterSettings` that belong to each part of the filter."""
DIGITS = 5
"""Digits of a value that remain if its logarithm is stored in float32."""

Trainable = dict[str, dict[str, Any]]
"""Variables that are trained, by collection: "params" and "filter"; none of them empty."""

# What is trained
# ------------------------------------------------------------------------------------------------


def filter_numbers(config: TrainConfig) -> dict[str, Float[jax.Array, ""]]:
    """The collection "filter": a number for each setting that is not switched off; none for
    training on windows."""
    if not config.through_filter.learn:
        return {}
    paths = [path for of_part in FILTER_PARTS.values() for path in of_part]
    numbers = free_parameters(config.filter, paths)
    return {name: jnp.float32(number) for name, number in numbers.items()}


def trained_settings(settings: FilterSettings, numbers: dict[str, Any]) -> FilterSettings:
    """The filter's settings with the values that were trained, rounded to five digits."""
    return with_written_parameters(settings, numbers, DIGITS)


def select_trained(variables: Any, learn: Iterable[str]) -> Trainable:
    """The variables of the parts `learn`; if there are none, the network's parameters. Raises
    `InputError` for a part of which the network has no parameter."""
    parts = set(learn)
    if not parts:
        return {"params": variables["params"]}
    existing = {_network_part(name) for name in variables["params"]}
    if missing := sorted(parts & {*NETWORK_PARTS, "encoder"} - existing):
        modules = " or ".join(NETWORK_PARTS.get(missing[0], ("encoder",)))
        problem = f"names '{missing[0]}', but no module of the network is called {modules}"
        raise InputError("through_filter.learn", problem, "leave it out")
    if "all" in parts:
        parts = {*FILTER_PARTS, *NETWORK_PARTS, "encoder"}
    paths = [path for part in parts for path in FILTER_PARTS.get(part, ())]

    def is_trained(collection: str, name: str) -> bool:
        if collection == "filter":
            return any(is_below(name, path) for path in paths)
        return _network_part(name) in parts

    selected = {
        collection: {name: leaf for name, leaf in tree.items() if is_trained(collection, name)}
        for collection, tree in variables.items()
        if collection != "batch_stats"
    }
    return {collection: tree for collection, tree in selected.items() if tree}


def _network_part(module: str) -> str:
    name = re.sub("^expert[0-9]+_", "", module)
    return next((part for part, modules in NETWORK_PARTS.items() if name in modules), "encoder")


# By which steps
# ------------------------------------------------------------------------------------------------


def schedule(config: OptimConfig, steps_per_epoch: int, scale: float = 1.0) -> optax.Schedule:
    """Learning rate of a step: linear from start to peak over the warm-up, then a cosine to the end
    of the last epoch, or no change; all of it multiplied by `scale`.

    Ours: a run too short for its warm-up warms up for its first half.
    """
    start, peak = scale * config.start_learning_rate, scale * config.learning_rate
    warmup_steps = round(min(config.warmup_epochs, config.epochs / 2) * steps_per_epoch)
    if config.schedule != "cosine":
        warmup = optax.linear_schedule(start, peak, max(warmup_steps, 1))
        return optax.join_schedules([warmup, optax.constant_schedule(peak)], [warmup_steps])
    return optax.warmup_cosine_decay_schedule(
        init_value=start,
        peak_value=peak,
        warmup_steps=warmup_steps,
        decay_steps=config.epochs * steps_per_epoch,  # in Optax this includes the warm-up
        end_value=min(scale * END_LEARNING_RATE, peak),
    )


def adam(
    config: OptimConfig, loss: LossConfig, steps_per_epoch: int, corrector: bool = False
) -> optax.GradientTransformationExtraArgs:
    """Adam's direction, β = (0.9, 0.999): an update is −(learning rate) times it. Before that, if
    the settings ask for it, the gradient's global norm is clipped and weight decay is added. A
    corrector has a loss and a norm of its own. `update` takes `log_std_learns` (see
    `losses.Stage`).

    If the uncertainty is held fixed at first, it has a state of its own that does not count those
    steps, as PyTorch's Adam does not count steps without a gradient. A common state would count the
    zero gradients: when the uncertainty begins to learn, the moments would no longer be corrected
    for their bias, and the first steps would be 3.7 times as long as the learning rate allows.
    """
    moments = optax.scale_by_adam(b1=0.9, b2=0.999)
    parts = [moments]
    if max(switches(loss, steps_per_epoch)) > 0:
        held = optax.conditionally_mask(
            moments, lambda step, log_std_learns: log_std_learns, forward_extra_args=True
        )
        labels = _by_path(
            lambda path: "held" if _network_part(path[1].key) == "uncertainty" else "learns"
        )
        parts = [optax.partition({"learns": moments, "held": held}, labels)]
    if config.weight_decay:
        parts.insert(0, optax.add_decayed_weights(config.weight_decay))
    if config.clip_norm is not None:
        clip = optax.clip_by_global_norm(config.clip_norm)
        if corrector:
            labels = _by_path(lambda path: path[1].key == "corrector")
            clip = optax.partition({True: clip, False: clip}, labels)
        parts.insert(0, clip)
    return optax.with_extra_args_support(optax.chain(*parts))


def create(config: TrainConfig, steps_per_epoch: int) -> optax.GradientTransformationExtraArgs:
    """The optimizer of each trained collection: `adam` for the network's parameters, and for
    training through the filter another one for the filter's numbers, without weight decay. Each
    gradient is clipped separately."""
    if not config.through_filter.learn:
        corrector = config.model.corrector != "none"
        return adam(config.optim, config.loss, steps_per_epoch, corrector)
    optimizers = {
        "params": adam(config.optim, LossConfig(), 1),
        "filter": adam(dataclasses.replace(config.optim, weight_decay=0.0), LossConfig(), 1),
    }
    return optax.partition(optimizers, _by_path(lambda path: path[0].key))


def learning_rates(config: TrainConfig, steps_per_epoch: int) -> dict[str, optax.Schedule]:
    """The schedule of each collection that may be trained."""
    ratio = config.through_filter.filter_learning_rate / config.optim.learning_rate
    return {
        "params": schedule(config.optim, steps_per_epoch),
        "filter": schedule(config.optim, steps_per_epoch, ratio),
    }


def _by_path(label: Callable[[tuple], Any]) -> Callable[[Any], Any]:
    """A function that labels each leaf of a tree by its path."""
    return lambda tree: jax.tree_util.tree_map_with_path(lambda path, _: label(path), tree)


class Plateau(NamedTuple):
    """The history of the validation error (RoNIN, DeepILS: PyTorch's ReduceLROnPlateau)."""

    factor: float = 1.0
    """Current factor of the schedule's learning rate."""
    best: float | None = None
    """Smallest squared error so far, m²; NaN if there is none."""
    idle_epochs: int = 0
    """Epochs since the smallest error, or since the learning rate was reduced."""


def update_plateau(plateau: Plateau, mse: float, config: OptimConfig) -> Plateau:
    """The plateau after an epoch with this squared error on the validation split. An error counts
    as smaller if it is smaller by a ten-thousandth, as in PyTorch."""
    if config.schedule != "plateau":
        return plateau
    if not math.isnan(mse) and (plateau.best is None or mse < plateau.best * (1 - 1e-4)):
        return plateau._replace(best=mse, idle_epochs=0)
    if plateau.idle_epochs < PLATEAU_EPOCHS:
        return plateau._replace(idle_epochs=plateau.idle_epochs + 1)
    return plateau._replace(factor=plateau.factor * PLATEAU_FACTOR, idle_epochs=0)
