"""The training objective (paper §III-F): squared error plus Gaussian negative log-likelihood, one weighted sum."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.config import LossConfig
from gnio_jax.types import Prediction


class Losses(NamedTuple):
    """Means over a batch."""

    total: Float[jax.Array, ""]
    """λ_MSE · mse + λ_NLL · nll."""
    mse: Float[jax.Array, ""]
    """‖d − d̂‖², summed over the axes, m²."""
    nll: Float[jax.Array, ""]
    """½ (d − d̂)ᵀ Σ̂⁻¹ (d − d̂) + ½ log det Σ̂, without the constant."""


def losses(
    prediction: Prediction, displacement: Float[jax.Array, "b 3"], config: LossConfig, nll_weight: Float[jax.Array, ""] | float
) -> Losses:
    """The losses of a batch. `nll_weight` is λ_NLL as the epoch has it (zero before `config.nll_from_epoch`)."""
    error = displacement - prediction.displacement
    log_std = prediction.log_std
    if config.log_std_floor is not None:
        log_std = jnp.maximum(log_std, config.log_std_floor)
    mse = jnp.mean(jnp.sum(error**2, axis=-1))
    nll = jnp.mean(jnp.sum(0.5 * error**2 * jnp.exp(-2 * log_std) + log_std, axis=-1))
    return Losses(config.mse_weight * mse + nll_weight * nll, mse, nll)
