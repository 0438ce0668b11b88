"""Adam with linear warm-up and cosine decay (paper §IV-A)."""

from __future__ import annotations

import optax

from gnio_jax.config import OptimConfig


def schedule(config: OptimConfig, steps_per_epoch: int) -> optax.Schedule:
    """Learning rate of a step: linear from start to peak over the warm-up, then a cosine to the end of the last epoch.

    Ours: a run too short for its warm-up warms up for its first half.
    """
    warmup_epochs = min(config.warmup_epochs, config.epochs / 2)
    return optax.warmup_cosine_decay_schedule(
        init_value=config.start_learning_rate,
        peak_value=config.learning_rate,
        warmup_steps=round(warmup_epochs * steps_per_epoch),
        decay_steps=config.epochs * steps_per_epoch,  # Optax counts the warm-up in
        end_value=config.end_learning_rate,
    )


def create(config: OptimConfig, steps_per_epoch: int) -> optax.GradientTransformation:
    """Adam, β = (0.9, 0.999), with the schedule; the gradient's global norm is clipped first where that is asked for."""
    adam = optax.adam(schedule(config, steps_per_epoch), b1=0.9, b2=0.999)
    return adam if config.clip_norm is None else optax.chain(optax.clip_by_global_norm(config.clip_norm), adam)
