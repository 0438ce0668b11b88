"""The network in the filter's loop: its window, its prediction, and the resulting measurement."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from gnio_jax.filtering.displacement import Displacement, scaled_displacement
from gnio_jax.filtering.filter import Filter
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import FilterState
from gnio_jax.types import Array, Prediction
from gnio_jax.windows import cut_window

Predict = Callable[[Any], Prediction]
"""From windows with their context (1, C + N, 6) float32, channels [accel m/s², gyro rad/s], to a
`Prediction` with the same leading axis."""


def network_measurement(
    predict: Predict, ekf: Filter
) -> Callable[..., tuple[Displacement, dict[str, Array]]]:
    """The displacement that the network measures, with its diagnostics, as a function

        measure(has_window, latest, state, oldest)

    where `latest()` gives the last `config.reach` raw samples, and `oldest` is the slot of the
    oldest clone. The network is called where `has_window`. There is no measurement elsewhere, nor
    from a window in which the filter coasted. Raises `ValueError` if `predict` does not return what
    the filter needs.
    """

    config = ekf.config

    def predict_one(window: Float[Array, "1 n 6"]) -> Prediction:
        prediction = predict(window)
        _check(prediction)
        return jax.tree.map(lambda leaf: _make_floating(leaf[0]), prediction)

    shapes = jax.eval_shape(predict_one, jax.ShapeDtypeStruct((1, config.seen, 6), jnp.float32))

    def predict_nothing() -> Prediction:
        return jax.tree.map(lambda leaf: jnp.full(leaf.shape, jnp.nan, leaf.dtype), shapes)

    def measure(
        has_window: Bool[Array, ""],
        latest: Callable[[], Imu],
        state: FilterState,
        oldest: Array | int,
    ) -> tuple[Displacement, dict[str, Array]]:
        def infer() -> Prediction:
            gyro, accel, gap = latest()
            prediction = predict_one(network_window(state, oldest, gyro, accel, config))
            whole = gap is None or jnp.all(gap.used > 0)
            displacement = jnp.where(whole, prediction.displacement, jnp.nan)
            return prediction._replace(displacement=displacement)

        prediction = jax.lax.cond(has_window, infer, predict_nothing)
        dtype, frame = state.offset.dtype, config.displacement_frame
        covariance = prediction.covariance(config.log_std_min, dtype)
        displacement = prediction.displacement.astype(dtype)
        measurement = scaled_displacement(displacement, covariance, ekf.noise, frame)
        return measurement, prediction.diagnostics

    return measure


def _check(prediction: Any) -> None:
    """Refuse a result that is no prediction of one window."""
    if not isinstance(prediction, Prediction):
        kind = type(prediction).__name__
        raise ValueError(f"predict: must return a gnio_jax.types.Prediction, found {kind}")
    for name, value in {**prediction._asdict(), **prediction.diagnostics}.items():
        if name in ("displacement", "log_std") and value.shape != (1, 3):
            raise ValueError(f"predict: {name} must be (1, 3) for one window, found {value.shape}")
        if name in prediction.diagnostics and value.shape[:1] != (1,):
            problem = f"must have a leading axis of one window, found {value.shape}"
            raise ValueError(f"predict: diagnostics['{name}'] {problem}")


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


def _make_floating(value: Any) -> Any:
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.float32)
