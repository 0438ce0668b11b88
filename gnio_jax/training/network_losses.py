"""The losses of single networks: IONet's, AirIO's and VeloBins', the balance of experts, and RIO's
rotation consistency. All are means over the windows."""

from __future__ import annotations

from typing import Any, NoReturn

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float, PRNGKeyArray

from gnio_jax.config import LossConfig
from gnio_jax.errors import InputError
from gnio_jax.models.airimu import LIKELIHOOD_WEIGHT, huber_loss
from gnio_jax.models.airio import body_axes, label_rows, velocities, with_end
from gnio_jax.models.bins import centres_of
from gnio_jax.models.equivariance import turn, turn_windows
from gnio_jax.types import Prediction, Windows

LEAST_LENGTH = 0.1
"""Displacement below which a direction is not a target, m (IONet in the benchmark IPB: 0.1 m/s)."""
VELOCITY_WEIGHT, VELOCITY_HUBER = 100.0, 0.005
"""AirIO's weight of its loss, and the size of an error from which it grows linearly, m/s."""
BIN_HUBER = 0.1
"""VeloBins' size of an error from which Huber's loss grows linearly, m/s."""
TILT_STEPS = 20
"""Newton steps that give VeloBins' label the true mean."""
LEAST_SPEED = 0.5
"""RIO: no rotation consistency at or below this speed, m/s."""


def refuse(name: str, need: str) -> NoReturn:
    """Raise `InputError` for a loss that needs what the network does not predict."""
    raise InputError("loss.name", f"is {name}, which needs {need}", "take weighted_sum")


def polar(prediction: Prediction, windows: Windows, config: LossConfig) -> Float[Array, ""]:
    """IONet: squared error of the length plus `angle_weight` times the squared error of the angle,
    wrapped to ±π, where there is a direction.

    The target of a "turn" is the angle from the first to the last tenth of the window (ours).
    """
    diagnostics, ends = prediction.diagnostics, max(windows.steps.shape[1] // 10, 1)
    moved = windows.displacement[:, :2]
    length = _length(moved)
    if "polar_turn" in diagnostics:
        first, last = (
            windows.steps[:, part, :2].sum(axis=1) for part in (slice(ends), slice(-ends, None))
        )
        rows, moving = diagnostics["polar_turn"], (_length(first) > 0.1 * LEAST_LENGTH)
        moving = moving & (_length(last) > 0.1 * LEAST_LENGTH)
        across = first[:, 0] * last[:, 1] - first[:, 1] * last[:, 0]
        angle = _angle(across, jnp.sum(first * last, axis=1), moving)
    elif "polar" in diagnostics:
        rows, moving = diagnostics["polar"], length > LEAST_LENGTH
        angle = _angle(moved[:, 1], moved[:, 0], moving)
    else:
        refuse("polar", "a length and an angle, as the network ionet gives")
    error = rows[:, 1] - angle
    wrapped = jnp.arctan2(jnp.sin(error), jnp.cos(error))
    squared = jnp.where(moving, wrapped, 0.0) ** 2
    return jnp.mean((rows[:, 0] - length) ** 2 + config.angle_weight * squared)


def body_velocity(prediction: Prediction, windows: Windows) -> Float[Array, ""]:
    """AirIO: 100 (Huber + 1e-4 (e²/σ² + ln σ²)), means over samples and axes. Velocities are metres
    per window. Velocity and attitude of a target are those at the same time (`label_rows`): for the
    last one at the window's end, where the filter measures it."""
    diagnostics, samples = prediction.diagnostics, windows.steps.shape[1]
    if "body_velocity" not in diagnostics:
        refuse("body_velocity", "velocities of the body, as the network airio gives")
    rows = label_rows(samples)
    axes = with_end(body_axes(windows.imu))[:, rows]
    truth = jnp.einsum("bnij,bni->bnj", axes, samples * velocities(windows.steps)[:, rows])
    error, log_std = truth - diagnostics["body_velocity"], diagnostics["body_velocity_log_std"]
    likelihood = error**2 * jnp.exp(-2 * log_std) + 2 * log_std
    huber = huber_loss(error, VELOCITY_HUBER)
    return VELOCITY_WEIGHT * jnp.mean(huber + LIKELIHOOD_WEIGHT * likelihood)


def bins(prediction: Prediction, windows: Windows, axes: int) -> Float[Array, ""]:
    """VeloBins: Huber's loss of the mean plus the divergence KL(label ‖ prediction), sums over the
    axes, which are those of the uncertainty (`Prediction.axes`). There is no likelihood.

    The label is a Gaussian about the truth, integrated over the bins and tilted exponentially to
    the exact mean. Its σ is the present error, at least a tenth of a bin, without gradient.
    """
    if "bin_logits" not in prediction.diagnostics:
        refuse("bins", "a network with model.head: bins")
    logits = prediction.diagnostics["bin_logits"][:, :axes]
    centres = centres_of(prediction.diagnostics["bin_reach"][0], logits.shape[-1])
    truth, mean = (
        prediction.along_axes(part[:, :axes])
        for part in (windows.displacement, prediction.displacement)
    )
    error = truth - mean
    label = jax.lax.stop_gradient(_label(truth, error, centres))
    logs = jax.nn.log_softmax(logits, axis=-1)
    entropy = jnp.sum(jnp.where(label > 0, label * jnp.log(jnp.maximum(label, 1e-30)), 0.0), -1)
    divergence = entropy - jnp.sum(label * logs, axis=-1)
    return jnp.mean(jnp.sum(huber_loss(error, BIN_HUBER) + divergence, axis=-1))


def _label(
    truth: Float[Array, "b a"], error: Float[Array, "b a"], centres: Float[Array, "n"]
) -> Float[Array, "b a n"]:
    spacing = centres[1] - centres[0]
    std = jnp.maximum(jnp.abs(error), spacing / 10)[..., None]
    edges = jnp.append(centres - spacing / 2, centres[-1] + spacing / 2)
    below = jax.scipy.stats.norm.cdf((edges[None, None] - truth[..., None]) / std)
    weight = jnp.log(jnp.maximum(jnp.diff(below, axis=-1), 1e-30))
    target = jnp.clip(truth, centres[0], centres[-1])
    tilt = jnp.zeros_like(truth)
    for _ in range(TILT_STEPS):
        label = jax.nn.softmax(weight + tilt[..., None] * centres[None, None], axis=-1)
        mean = label @ centres
        variance = jnp.sum(label * (centres[None, None] - mean[..., None]) ** 2, axis=-1)
        newton = (target - mean) / jnp.maximum(variance, 1e-6 * spacing**2)
        tilt = tilt + jnp.clip(newton, -4 / spacing, 4 / spacing)
    return jax.nn.softmax(weight + tilt[..., None] * centres[None, None], axis=-1)


def balance(router: Float[Array, "b k"]) -> Float[Array, ""]:
    """K Σ (mean share of an expert)² − 1: zero if all are used alike, K − 1 if one is."""
    return router.shape[1] * jnp.sum(router.mean(axis=0) ** 2) - 1


def rotation_consistency(
    model: nn.Module,
    variables: Any,
    windows: Windows,
    prediction: Prediction,
    keys: tuple[PRNGKeyArray, PRNGKeyArray],
    seconds: float,
) -> Float[Array, ""]:
    """RIO's self-supervision: −cos between the prediction turned by a uniform angle and the
    prediction for the turned window, 0 where the true speed is at most 0.5 m/s.

    keys: of the angles and of the dropout. seconds: length of the window.
    """
    angle_key, dropout_key = keys
    angle = jax.random.uniform(
        angle_key, windows.displacement.shape[:1], jnp.float32, 0.0, jnp.float32(2 * jnp.pi)
    )
    heading = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    options = {"mutable": ["batch_stats"], "rngs": {"dropout": dropout_key}}
    of_turned, _ = model.apply(variables, turn_windows(windows.imu, heading), train=True, **options)
    cosine = consistency(prediction, of_turned, heading)
    moving = _length(windows.displacement[:, :2]) > LEAST_SPEED * seconds
    return -jnp.mean(jnp.where(moving, cosine, 0.0))


def consistency(
    prediction: Prediction, of_turned: Prediction, heading: Float[Array, "b 2"]
) -> Float[Array, "b"]:
    """Cosine between the horizontal displacement turned by `heading` and that of the turned
    window."""
    turned = turn(prediction.displacement, heading)[:, :2]
    other = of_turned.displacement[:, :2]
    product = _length(turned) * _length(other)
    return jnp.sum(turned * other, axis=1) / jnp.maximum(product, 1e-6)


def _length(vectors: Float[Array, "b 2"]) -> Float[Array, "b"]:
    return jnp.sqrt(jnp.maximum(jnp.sum(vectors**2, axis=-1), 1e-12))


def _angle(y: Array, x: Array, defined: Array) -> Array:
    return jnp.arctan2(jnp.where(defined, y, 0.0), jnp.where(defined, x, 1.0))
