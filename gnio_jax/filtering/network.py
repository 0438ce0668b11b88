"""The network in the filter's loop: its window, its prediction, the measurement made of that."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.config import NoiseModel
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.displacement import Displacement, scaled_displacement
from gnio_jax.filtering.state import FilterState
from gnio_jax.types import Array, Prediction
from gnio_jax.windows import cut_window

Predict = Callable[[Any], Prediction]
"""From windows with their context (1, C + N, 6) float32, channels [accel m/s², gyro rad/s], to a
`Prediction` with the same leading axis."""


def prediction_shapes(predict: Predict, config: FilterConfig) -> Prediction:
    """Shapes of what `predict` returns for one window; `ValueError` if that is not what the filter
    needs."""
    found = jax.eval_shape(predict, jax.ShapeDtypeStruct((1, config.seen, 6), jnp.float32))
    if not isinstance(found, Prediction):
        raise ValueError(
            f"predict: must return a gnio_jax.types.Prediction, found {type(found).__name__}"
        )
    for name, value in [("displacement", found.displacement), ("log_std", found.log_std)]:
        if value.shape != (1, 3):
            raise ValueError(f"predict: {name} must be (1, 3) for one window, found {value.shape}")
    for name, value in found.diagnostics.items():
        if value.shape[:1] != (1,):
            raise ValueError(
                f"predict: diagnostics['{name}'] must have a leading axis of one window, "
                f"found {value.shape}"
            )
    return found


def predict_window(
    predict: Predict,
    state: FilterState,
    oldest: Array | int,
    gyro: Float[Array, "r 3"],
    accel: Float[Array, "r 3"],
    config: FilterConfig,
) -> Prediction:
    """The network's prediction for one window (`network_window`), without the leading axis of
    one."""
    prediction = predict(network_window(state, oldest, gyro, accel, config))
    return jax.tree.map(lambda leaf: _as_floating(leaf[0]), prediction)


def network_window(
    state: FilterState,
    oldest: Array | int,
    gyro: Float[Array, "r 3"],
    accel: Float[Array, "r 3"],
    config: FilterConfig,
) -> Float[Array, "1 n 6"]:
    """The network's window from the clone in slot `oldest` to the present, float32.

    gyro and accel are the last `config.reach` raw samples.
    """
    gyro, accel = gyro[: config.seen], accel[: config.seen]
    rotation, biases = state.clone_rotation[oldest], (state.gyro_bias, state.accel_bias)
    window = cut_window(
        rotation, gyro, accel, *biases, config.cut, config.dt, config.context_samples
    )
    return window[None].astype(jnp.float32)


def no_prediction(shapes: Prediction) -> Prediction:
    """NaN in the shapes of one window's prediction."""
    return jax.tree.map(
        lambda leaf: jnp.full(leaf.shape[1:], jnp.nan, _as_floating(leaf).dtype), shapes
    )


def predicted_displacement(
    prediction: Prediction, config: FilterConfig, noise: NoiseModel, dtype: Any
) -> Displacement:
    """The measurement that the filter makes of a prediction: covariance diag(exp 2u), u raised to
    `log_std_min`, before scaling. It is expressed in the yaw frame that `config` names."""
    log_std = jnp.maximum(prediction.log_std.astype(dtype), config.log_std_min)
    covariance = jnp.diag(jnp.exp(2 * log_std))
    displacement = prediction.displacement.astype(dtype)
    return scaled_displacement(displacement, covariance, noise, config.displacement_frame)


def _as_floating(value: Any) -> Any:
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.float32)
