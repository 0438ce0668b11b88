"""Training objectives on windows: GNIO's weighted sum of squared error and likelihood (paper
§III-F), and that of CTIN."""

from __future__ import annotations

import math
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from gnio_jax.config import LossConfig
from gnio_jax.errors import InputError
from gnio_jax.models.airimu import preintegration_loss
from gnio_jax.training import network_losses
from gnio_jax.types import Prediction, Windows

TASK_LOG_STD_FLOOR = -math.log(2.0)
"""Lower bound of CTIN's trainable log δ_v and log δ_c: no term has a weight above 2 (ours). Without
it the loss has no lower bound: a good network has a negative log-likelihood below 0, which drives
log δ_c to −∞, and the weight of the likelihood grows until the error of the velocity has no
effect."""
_NEVER = 2**31 - 1


class Losses(NamedTuple):
    """Means over a batch, sums over the axes that the network predicts."""

    total: Float[jax.Array, ""]
    """The objective of training."""
    mse: Float[jax.Array, ""]
    """‖d − d̂‖², m²."""
    nll: Float[jax.Array, ""]
    """½ (d − d̂)ᵀ Σ̂⁻¹ (d − d̂) + ½ log det Σ̂, without its constant (paper §III-F), with the bounds
    that `LossConfig` gives."""
    preintegration: Float[jax.Array, ""] | None = None
    """The loss from which a corrector learns (`models.airimu`), without its weight; None for a
    network without one."""


class Stage(NamedTuple):
    """The parts of the objective that depend on the progress of training."""

    nll_weight: Float[jax.Array, ""]
    """λ_NLL, or zero before `LossConfig.nll_from_epoch`."""
    log_std_learns: Bool[jax.Array, ""]
    """False before `LossConfig.log_std_from_epoch`, and while there is no likelihood."""


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


def loss_stage(config: LossConfig, step: Int[jax.Array, ""] | int, steps_per_epoch: int) -> Stage:
    """The stage at a step."""
    likelihood, uncertainty = switches(config, steps_per_epoch)
    step = jnp.asarray(step)
    nll_weight = jnp.where(step >= likelihood, jnp.float32(config.nll_weight), jnp.float32(0))
    return Stage(nll_weight, step >= uncertainty)


def losses(
    prediction: Prediction,
    windows: Windows,
    config: LossConfig,
    stage: Stage,
    axes: int = 3,
    dt: float = 0.005,
) -> Losses:
    """The losses of a batch.

    Args:
        prediction: The network's output for b windows.
        windows: The b windows with their true displacements.
        config: The loss and its weights.
        stage: The parts of the loss that take effect at this step (`loss_stage`).
        axes: Number of axes, 3, or 2 for a network without the vertical.
        dt: Time between the samples of a window, s, which the preintegration loss needs.

    Raises:
        InputError: The loss needs more than the network predicts (e.g. a velocity for every
            sample), or the network has a corrector, which learns from nothing in this loss.
    """
    vectors = (prediction.displacement, prediction.log_std, windows.displacement)
    chex.assert_equal_shape(vectors)
    chex.assert_shape(vectors, (None, 3))
    error = (windows.displacement - prediction.displacement)[:, :axes]
    held = prediction._replace(log_std=_hold_log_std(prediction.log_std, stage))
    mse = jnp.mean(jnp.sum(error**2, axis=-1))
    nll = gaussian_nll(held, error, config)
    match config.name:
        case "velocity_and_covariance":
            total = _velocity_and_covariance(prediction, windows, config, stage, axes)
        case "polar":
            total = network_losses.polar(prediction, windows, config)
        case "body_velocity":
            total = network_losses.body_velocity(prediction, windows)
        case "bins":
            total = network_losses.bins(prediction, windows, axes)
        case _:
            total = config.mse_weight * mse + stage.nll_weight * nll
            if config.mae_weight:
                total = total + config.mae_weight * jnp.mean(jnp.sum(jnp.abs(error), axis=-1))
    if "router" in prediction.diagnostics:
        balance = network_losses.balance(prediction.diagnostics["router"])
        total = total + config.balance_weight * balance
    elif config.balance_weight != LossConfig().balance_weight:
        problem = "is for networks with a router, e.g. experts"
        raise InputError("loss.balance_weight", problem, "leave it out")
    has_corrector = "corrected" in prediction.diagnostics
    if has_corrector and not config.preintegration_weight:
        problem = "is 0, and a corrector learns from the preintegration alone"
        raise InputError(
            "loss.preintegration_weight",
            problem,
            "set it to 1, or name a trained one in filter.corrector",
        )
    if config.preintegration_weight:
        if not has_corrector:
            problem = "needs a network with a corrector, e.g. model.corrector: airimu"
            raise InputError("loss.preintegration_weight", problem, "or set it to 0")
        preintegration = preintegration_loss(prediction, windows.imu, windows.steps, dt)
        total = total + config.preintegration_weight * preintegration
        return Losses(total, mse, nll, preintegration)
    return Losses(total, mse, nll)


def _velocity_and_covariance(
    prediction: Prediction, windows: Windows, config: LossConfig, stage: Stage, axes: int
) -> Float[jax.Array, ""]:
    """CTIN's L_v / 2δ_v² + L_c / 2δ_c² + log δ_v δ_c (its eq. 9–11), with trainable δ.

    L_v is the squared error of each sample's velocity plus that of the position to which they add
    up, L_c the likelihood of the velocities. Velocities are metres per window. Ours: means over the
    samples, sums over the axes, and the lower bound of both log δ.
    """
    diagnostics = prediction.diagnostics
    if not {"velocity", "velocity_log_std", "task_log_std"} <= diagnostics.keys():
        need = "a velocity for every sample, as the network ctin gives"
        network_losses.refuse("velocity_and_covariance", need)
    # For a context before the window CTIN would predict velocities for which there is no target.
    chex.assert_equal_shape(
        [windows.steps, diagnostics["velocity"], diagnostics["velocity_log_std"]]
    )
    error = (windows.steps * windows.steps.shape[1] - diagnostics["velocity"])[..., :axes]
    position = (windows.displacement - prediction.displacement)[:, :axes]
    velocity_loss = jnp.mean(jnp.sum(error**2, axis=-1)) + jnp.mean(jnp.sum(position**2, axis=-1))
    held = Prediction(
        diagnostics["velocity"], _hold_log_std(diagnostics["velocity_log_std"], stage)
    )
    covariance_loss = gaussian_nll(held, error, config)
    log_v, log_c = jnp.maximum(diagnostics["task_log_std"][0], TASK_LOG_STD_FLOOR)
    return (
        0.5 * jnp.exp(-2 * log_v) * velocity_loss
        + 0.5 * jnp.exp(-2 * log_c) * covariance_loss
        + log_v
        + log_c
    )


def gaussian_nll(
    prediction: Prediction, error: Float[jax.Array, "*b d"], config: LossConfig
) -> Float[jax.Array, ""]:
    """Mean over the windows of ½ (e/σ)² + log σ, summed over the axes (paper §III-F, L_NLL).

    With `outlier_sigmas` = k (ours), (e/σ)² beyond k² grows only with its logarithm. Otherwise the
    gradient of one window with a tiny σ is unbounded, and Adam's second moment remembers it for a
    thousand steps.
    """
    normalised, log_std = prediction.normalise(error, config.log_std_floor)
    if config.outlier_sigmas is not None:
        bound = config.outlier_sigmas**2
        beyond = bound * (1 + jnp.log(jnp.maximum(normalised, bound) / bound))
        normalised = jnp.where(normalised > bound, beyond, normalised)
    return jnp.mean(jnp.sum(0.5 * normalised + log_std, axis=-1))


def _hold_log_std(log_std: Float[jax.Array, "*b 3"], stage: Stage) -> Float[jax.Array, "*b 3"]:
    """The same values, with a gradient only if the uncertainty learns in this stage."""
    held = jax.lax.stop_gradient(log_std)
    return held + jnp.where(stage.log_std_learns, log_std - held, 0.0)
