"""Adam with linear warm-up and cosine decay (paper §IV-A), and the schedules of the networks that
GNIO is compared with."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import optax

from gnio_jax.config import LossConfig, OptimConfig
from gnio_jax.training.losses import switches

UNCERTAINTY = ("uncertainty", "log_std")
"""Names of the networks' parts from which nothing but the uncertainty comes."""


def schedule(config: OptimConfig, steps_per_epoch: int) -> optax.Schedule:
    """Learning rate of a step: linear from start to peak over the warm-up, then a cosine to the end
    of the last epoch, or no change.

    Ours: a run too short for its warm-up warms up for its first half.
    """
    warmup_steps = round(min(config.warmup_epochs, config.epochs / 2) * steps_per_epoch)
    if config.schedule != "cosine":
        warmup = optax.linear_schedule(
            config.start_learning_rate, config.learning_rate, max(warmup_steps, 1)
        )
        return optax.join_schedules(
            [warmup, optax.constant_schedule(config.learning_rate)], [warmup_steps]
        )
    return optax.warmup_cosine_decay_schedule(
        init_value=config.start_learning_rate,
        peak_value=config.learning_rate,
        warmup_steps=warmup_steps,
        decay_steps=config.epochs * steps_per_epoch,  # Optax counts the warm-up in
        end_value=config.end_learning_rate,
    )


def create(
    config: OptimConfig, loss: LossConfig, steps_per_epoch: int
) -> optax.GradientTransformationExtraArgs:
    """Adam, β = (0.9, 0.999), with the schedule; before it, where that is asked for, the gradient's
    global norm is clipped and the parameters decay. `update` takes `log_std_learns` (see
    `losses.Stage`).

    Where the uncertainty is held at first, it has a state of its own that does not count those
    steps, as PyTorch's Adam does not count steps without a gradient. In one state the zero
    gradients would be counted: at the release the bias correction of the moments would be gone, and
    the first steps 3.7 times as long as the learning rate allows.
    """
    rate = schedule(config, steps_per_epoch)
    adam = optax.adam(rate, b1=0.9, b2=0.999)
    if max(switches(loss, steps_per_epoch)) > 0:
        moments = optax.scale_by_adam(b1=0.9, b2=0.999)
        held = optax.conditionally_mask(
            moments, lambda step, log_std_learns: log_std_learns, forward_extra_args=True
        )
        adam = optax.chain(
            optax.partition({"learns": moments, "held": held}, _kinds),
            optax.scale_by_learning_rate(rate),
        )
    parts = [adam]
    if config.weight_decay:
        parts.insert(0, optax.add_decayed_weights(config.weight_decay))
    if config.clip_norm is not None:
        parts.insert(0, optax.clip_by_global_norm(config.clip_norm))
    return optax.with_extra_args_support(optax.chain(*parts) if len(parts) > 1 else parts[0])


def create_through_filter(
    config: OptimConfig, filter_learning_rate: float, steps_per_epoch: int
) -> optax.GradientTransformationExtraArgs:
    """One optimizer for the network's parameters, and one for what else learns through the filter,
    with the same schedule but another peak. The gradient of each is clipped apart."""
    ratio = filter_learning_rate / config.learning_rate
    of_filter = dataclasses.replace(
        config,
        learning_rate=filter_learning_rate,
        start_learning_rate=ratio * config.start_learning_rate,
        end_learning_rate=ratio * config.end_learning_rate,
        weight_decay=0.0,
    )
    optimizers = {
        "params": create(config, LossConfig(), steps_per_epoch),
        "filter": create(of_filter, LossConfig(), steps_per_epoch),
    }
    return optax.partition(optimizers, _collections)


def _collections(learnt: Any) -> Any:
    return {name: jax.tree.map(lambda _, name=name: name, tree) for name, tree in learnt.items()}


def _kinds(params: Any) -> Any:
    def kind(path: tuple, _: jax.Array) -> str:
        return "held" if path[0].key in UNCERTAINTY else "learns"

    return jax.tree_util.tree_map_with_path(kind, params)


class Plateau(NamedTuple):
    """How the validation error has fared (RoNIN, DeepILS: PyTorch's ReduceLROnPlateau)."""

    factor: float = 1.0
    """Share of the schedule's learning rate that is in force."""
    best: float | None = None
    """Smallest squared error so far, m²."""
    idle_epochs: int = 0
    """Epochs since it, or since the learning rate fell."""


def watch(plateau: Plateau, mse: float, config: OptimConfig) -> Plateau:
    """After an epoch with this squared error on the validation split. Better means by a
    ten-thousandth, as in PyTorch."""
    if config.schedule != "plateau":
        return plateau
    if plateau.best is None or mse < plateau.best * (1 - 1e-4):
        return plateau._replace(best=mse, idle_epochs=0)
    if plateau.idle_epochs < config.plateau_epochs:
        return plateau._replace(idle_epochs=plateau.idle_epochs + 1)
    return plateau._replace(factor=plateau.factor * config.plateau_factor, idle_epochs=0)
