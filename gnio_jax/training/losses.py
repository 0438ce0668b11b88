"""Training objectives: GNIO's weighted sum of squared error and likelihood (paper §III-F), and
those of the networks beside it."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from gnio_jax.config import LossConfig
from gnio_jax.types import Prediction, Windows

_NEVER = 2**31 - 1


OUTLIER = 10.0
"""Standard deviations beyond which the likelihood takes an error for an outlier (ours)."""


class Losses(NamedTuple):
    """Means over a batch."""

    total: Float[jax.Array, ""]
    """What training minimises."""
    mse: Float[jax.Array, ""]
    """‖d − d̂‖², summed over the axes, m²."""
    nll: Float[jax.Array, ""]
    """½ (d − d̂)ᵀ Σ̂⁻¹ (d − d̂) + ½ log det Σ̂, without the constant."""


class Stage(NamedTuple):
    """What of the objective the progress of training decides."""

    nll_weight: Float[jax.Array, ""]
    """λ_NLL, or zero before `LossConfig.nll_from_epoch`."""
    log_std_learns: Bool[jax.Array, ""]
    """False before `LossConfig.log_std_from_epoch`, and as long as there is no likelihood."""


def switches(config: LossConfig, steps_per_epoch: int) -> tuple[int, int]:
    """First steps of the likelihood and of the uncertainty, from the fractions of an epoch that the
    config gives."""
    likelihood, uncertainty = (
        min(math.ceil(epochs * steps_per_epoch - 1e-6), _NEVER)
        for epochs in (config.nll_from_epoch, config.log_std_from_epoch)
    )
    # CTIN's loss has a likelihood of its own from the start.
    weighted = config.name == "weighted_sum"
    return likelihood, max(likelihood, uncertainty) if weighted else uncertainty


def stage(config: LossConfig, step: Int[jax.Array, ""] | int, steps_per_epoch: int) -> Stage:
    """The stage at a step."""
    likelihood, uncertainty = switches(config, steps_per_epoch)
    step = jnp.asarray(step)
    nll_weight = jnp.where(step >= likelihood, jnp.float32(config.nll_weight), jnp.float32(0))
    return Stage(nll_weight, step >= uncertainty)


def losses(prediction: Prediction, windows: Windows, config: LossConfig, stage: Stage) -> Losses:
    """The losses of a batch.

    Raises `ValueError` if the loss wants more than the network says (a velocity for every sample).
    """
    error = windows.displacement - prediction.displacement
    log_std = _held(prediction.log_std, stage)
    mse = jnp.mean(jnp.sum(error**2, axis=-1))
    nll = _nll(error, log_std, config)
    if config.name == "velocity_and_covariance":
        return Losses(_velocity_and_covariance(prediction, windows, config, stage), mse, nll)
    total = config.mse_weight * mse + stage.nll_weight * nll
    if config.mae_weight:
        total = total + config.mae_weight * jnp.mean(jnp.sum(jnp.abs(error), axis=-1))
    return Losses(total, mse, nll)


def _velocity_and_covariance(
    prediction: Prediction, windows: Windows, config: LossConfig, stage: Stage
) -> Float[jax.Array, ""]:
    """CTIN's L_v / 2δ_v² + L_c / 2δ_c² + log δ_v δ_c (its eq. 9–11), δ being learnt.

    L_v is the squared error of each sample's velocity plus that of the position to which they add
    up, L_c the likelihood of the velocities. Velocities are metres per window. Ours: means over the
    samples, sums over the axes.
    """
    said = prediction.diagnostics
    if not {"velocity", "velocity_log_std", "task_log_std"} <= said.keys():
        raise ValueError(
            "loss 'velocity_and_covariance' wants a velocity for every sample, "
            "which only the network 'ctin' gives"
        )
    error = windows.steps * windows.steps.shape[1] - said["velocity"]
    position = windows.displacement - prediction.displacement
    velocity_loss = jnp.mean(jnp.sum(error**2, axis=-1)) + jnp.mean(jnp.sum(position**2, axis=-1))
    covariance_loss = _nll(error, _held(said["velocity_log_std"], stage), config)
    log_v, log_c = said["task_log_std"][0]
    return (
        0.5 * jnp.exp(-2 * log_v) * velocity_loss
        + 0.5 * jnp.exp(-2 * log_c) * covariance_loss
        + log_v
        + log_c
    )


def _nll(
    error: Float[jax.Array, "*b 3"], log_std: Float[jax.Array, "*b 3"], config: LossConfig
) -> Float[jax.Array, ""]:
    """Mean over the windows of ½ (e/σ)² + log σ, summed over the axes (paper §III-F, eq. of L_NLL).

    Ours: (e/σ)² grows only with its logarithm beyond `OUTLIER`². One window with a tiny σ would
    else have a gradient without bound, which Adam's second moment remembers for a thousand steps.
    """
    if config.log_std_floor is not None:
        log_std = jnp.maximum(log_std, config.log_std_floor)
    squared, bound = error**2 * jnp.exp(-2 * log_std), OUTLIER**2
    beyond = bound * (1 + jnp.log(jnp.maximum(squared, bound) / bound))
    normalised = jnp.where(squared > bound, beyond, squared)
    return jnp.mean(jnp.sum(0.5 * normalised + log_std, axis=-1))


def _held(log_std: Float[jax.Array, "*b 3"], stage: Stage) -> Float[jax.Array, "*b 3"]:
    """The same values, with a gradient only where the stage lets the uncertainty learn."""
    held = jax.lax.stop_gradient(log_std)
    return held + jnp.where(stage.log_std_learns, log_std - held, 0.0)
