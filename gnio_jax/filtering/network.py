"""The network in the filter's loop: its window or its memory, its prediction, and the resulting
measurement.

A network with memory sees each sample once, at the attitude that the filter has then. Its frame has
gravity on z. The yaw of this frame is carried with the memory: when an update turns the filter's
attitude about z, the frame turns by the same angle (`models.memory`), so the network never sees a
step of the yaw, and recent samples remain consistent with each other. The frame of the prediction
therefore has the error δθ_z of the filter's own yaw, as the frame of a window has, and the
displacement is linearised in the same way (`displacement.linearise_displacement`, frame "own").
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeGuard, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.filtering.displacement import Displacement, scaled_displacement
from gnio_jax.filtering.filter import Filter
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import FilterState
from gnio_jax.types import Array, Memory, Prediction
from gnio_jax.windows import cut_window

Predict = Callable[[Any], Prediction]
"""From windows with their context (1, C + N, 6) float32, channels [accel m/s², gyro rad/s], to a
`Prediction` with the same leading axis."""


@runtime_checkable
class PredictWithMemory(Protocol):
    """A network that carries a memory from one clone interval to the next. Its samples have the 6
    channels [accel, gyro], or 12, if it has the attribute `channels` that says so."""

    def begin(self, dtype: Any) -> Memory:
        """An empty memory, whose attitude is of this type."""
        ...

    def step(
        self, memory: Memory, samples: Float[Array, "n c"], attitude: Float[Array, "3 3 n+1"]
    ) -> tuple[Memory, Prediction]:
        """The memory after the n samples of one clone interval, and the displacement over the last
        window, in the frame of this memory.

        samples: [accel m/s², gyro rad/s] in the body, without their biases, and with
        `window_rotation` "body_axes" the x and y axes of the body after them (zeros with
        "hidden_axes"); attitude: body → world, at each sample and at the end of the interval.
        """
        ...


class Recall(NamedTuple):
    """What a network with memory predicts at the end of a clone interval."""

    prediction: Prediction
    """In the frame of the memory; NaN where there is no whole window."""
    heading: Float[Array, "2"]
    """Cosine and sine of the yaw that turns this frame to the world."""


MemoryStep = Callable[[Any, FilterState, Imu], tuple[Memory, Recall]]
"""From the memory and the filter's state at the start of a clone interval, and its samples, to the
memory and the prediction at its end."""


def has_memory(predict: Predict | PredictWithMemory) -> TypeGuard[PredictWithMemory]:
    """Whether this is a network with memory."""
    return isinstance(predict, PredictWithMemory)


def first_memory(predict: PredictWithMemory, ekf: Filter, state: FilterState) -> Memory:
    """The memory at the start of a run: that of the state, or an empty one. Raises `ValueError` if
    the state has the memory of another network, if `window_rotation` is not "per_sample" (with 12
    channels "body_axes" or "hidden_axes"), or if the filter measures something else than
    displacements."""
    if ekf.config.measures != "displacement":
        problem = "a network with memory predicts displacements"
        raise ValueError(f"ekf.config.measures: {problem}: it must be 'displacement'")
    if getattr(predict, "channels", 6) == 12:
        rotations, sight = ("body_axes", "hidden_axes"), "sees the axes of the body"
    else:
        rotations, sight = ("per_sample",), "sees samples alone (its attribute channels is 6)"
    if ekf.config.window_rotation not in rotations:
        problem = f"this network with memory {sight}"
        remedy = f"it must be {' or '.join(map(repr, rotations))}"
        raise ValueError(f"ekf.config.window_rotation: {problem}: {remedy}")
    memory = predict.begin(state.offset.dtype)
    if state.memory is None:
        return memory
    shapes, state_shapes = (
        jax.tree.map(lambda leaf: (jnp.shape(leaf), leaf.dtype), tree)
        for tree in (memory, state.memory)
    )
    if shapes != state_shapes:
        raise ValueError("state.memory: is the memory of another network")
    return state.memory


def memory_step(predict: PredictWithMemory, ekf: Filter) -> MemoryStep:
    """The network's step in every clone interval.

    There is a prediction where the memory has seen the whole window and the filter has made W
    intervals. An interval in which the filter coasts empties the memory. Raises `ValueError` if
    `predict` does not return what the filter needs.
    """
    config = ekf.config

    def advance(memory: Memory, state: FilterState, imu: Imu) -> tuple[Memory, Recall]:
        memory, prediction = predict.step(memory, *interval_samples(state, imu, config))
        _check(jax.tree.map(lambda leaf: leaf[None], prediction))
        prediction = jax.tree.map(_make_floating, prediction)
        if imu.gap is not None:
            coasted, empty = jnp.any(imu.gap.used == 0), predict.begin(state.offset.dtype)
            memory = jax.tree.map(lambda x, new: jnp.where(coasted, new, x), memory, empty)
        window = config.clones_per_window
        whole = (memory.intervals >= window) & (state.step >= window)
        displacement, diagnostics = jax.tree.map(
            lambda leaf: jnp.where(whole, leaf, jnp.nan),
            (prediction.displacement, prediction.diagnostics),
        )
        prediction = prediction._replace(displacement=displacement, diagnostics=diagnostics)
        return memory, Recall(prediction, memory.heading)

    return advance


def interval_samples(
    state: FilterState, imu: Imu, config: FilterConfig
) -> tuple[Float[Array, "n c"], Float[Array, "3 3 n+1"]]:
    """The samples and attitudes of a clone interval that begins with `state`, as
    `PredictWithMemory.step` takes them."""
    rates, forces = imu.gyro - state.gyro_bias[None], imu.accel - state.accel_bias[None]
    attitude = geometry.integrate_turns(state.rotation, rates * config.dt)
    samples = [forces, rates]
    if config.cut.body_axes:
        axes = jnp.eye(2, 3, dtype=rates.dtype).reshape(1, 6) * (not config.cut.hidden)
        samples.append(jnp.broadcast_to(axes, (len(rates), 6)))
    return jnp.concatenate(samples, axis=1), attitude


def recalled_displacement(
    ekf: Filter, recall: Recall, state: FilterState, oldest: Array | int
) -> tuple[Displacement, dict[str, Array]]:
    """The displacement that a network with memory measures, in the yaw frame of the oldest clone,
    with its diagnostics."""
    dtype = state.offset.dtype
    displacement = recall.prediction.displacement.astype(dtype)
    covariance = recall.prediction.covariance(ekf.config.log_std_min, dtype)
    measured = turned_displacement(ekf, displacement, covariance, recall.heading, state, oldest)
    return measured, recall.prediction.diagnostics


def turned_displacement(
    ekf: Filter,
    displacement: Float[Array, "3"],
    covariance: Float[Array, "3 3"],
    heading: Float[Array, "2"],
    state: FilterState,
    oldest: Array | int,
) -> Displacement:
    """A displacement in the frame of a memory with this heading, m, and its covariance, m², as
    measured in the yaw frame of the oldest clone."""
    dtype = state.offset.dtype
    to_world = geometry.heading_rotation(*heading.astype(dtype))
    turn = geometry.matmul(geometry.yaw_rotation(state.clone_rotation[oldest]).T, to_world)
    # No NaN may enter the products, because otherwise the derivatives would be NaN too.
    finite = jnp.isfinite(displacement).all() & jnp.isfinite(covariance).all()
    turned = geometry.matmul(turn, jnp.where(finite, displacement, 0.0)[:, None])[:, 0]
    turned = jnp.where(finite, turned, jnp.nan)
    covariance = jnp.where(finite, covariance, jnp.eye(3, dtype=dtype))
    covariance = geometry.matmul(geometry.matmul(turn, covariance), turn.T)
    symmetric = 0.5 * (covariance + covariance.T)
    return scaled_displacement(turned, symmetric, ekf.noise, ekf.config.displacement_frame)


def network_measurement(
    predict: Predict, ekf: Filter
) -> Callable[..., tuple[Displacement, dict[str, Array]]]:
    """The displacement or velocity that the network measures, with its diagnostics, as a function

        measure(has_window, latest, state, oldest)

    where `latest()` gives the last `config.reach` raw samples, and `oldest` is the slot of the
    oldest clone. The network is called where `has_window`. There is no measurement elsewhere, nor
    from a window in which the filter coasted, and the diagnostics are NaN there. Raises
    `ValueError` if `predict` does not return what the filter needs.
    """

    unbound = hasattr(predict, "apply") and getattr(predict, "scope", None) is None
    if unbound or not callable(predict):
        problem = f"must be a function from windows to a Prediction, found {type(predict).__name__}"
        remedy = "models.Network.of(model, variables).predict() makes one of a network"
        raise ValueError(f"predict: {problem}; {remedy}")
    config = ekf.config
    shape = jax.ShapeDtypeStruct((1, config.input_samples, config.channels), jnp.float32)

    def predict_one(window: Float[Array, "1 n c"]) -> Prediction:
        prediction = predict(window)
        _check(prediction)
        prediction = prediction.with_quantity(config.measures)
        return jax.tree.map(lambda leaf: _make_floating(leaf[0]), prediction)

    shapes = jax.eval_shape(predict_one, shape)

    def predict_nothing() -> Prediction:
        return jax.tree.map(lambda leaf: jnp.full(leaf.shape, jnp.nan, leaf.dtype), shapes)

    def measure(
        has_window: Bool[Array, ""],
        latest: Callable[[], Imu],
        state: FilterState,
        oldest: Array | int,
    ) -> tuple[Displacement, dict[str, Array]]:
        def infer() -> Prediction:
            imu = latest()
            window = network_window(state, oldest, imu.gyro, imu.accel, config)
            prediction = predict_one(window)
            whole = imu.gap is None or jnp.all(imu.gap.used > 0)
            displacement, diagnostics = jax.tree.map(
                lambda leaf: jnp.where(whole, leaf, jnp.nan),
                (prediction.displacement, prediction.diagnostics),
            )
            return prediction._replace(displacement=displacement, diagnostics=diagnostics)

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
    axes = () if prediction.axes is None else (("axes", prediction.axes, 2),)
    vectors = ("displacement", prediction.displacement, 3), ("log_std", prediction.log_std, 3)
    if prediction.velocity is not None:
        value, log_std = prediction.velocity
        vectors = (*vectors, ("velocity", value, 3), ("velocity.log_std", log_std, 3))
    for name, value, size in (*vectors, *axes):
        shape = getattr(value, "shape", type(value).__name__)
        if shape != (1, size):
            raise ValueError(f"predict: {name} must be (1, {size}) for one window, found {shape}")
    for name, value in prediction.diagnostics.items():
        if value.shape[:1] != (1,):
            problem = f"must have a leading axis of one window, found {value.shape}"
            raise ValueError(f"predict: diagnostics['{name}'] {problem}")


def network_window(
    state: FilterState,
    oldest: Array | int,
    gyro: Float[Array, "r 3"],
    accel: Float[Array, "r 3"],
    config: FilterConfig,
) -> Float[Array, "1 n c"]:
    """The network's window from the clone in slot `oldest` to the present, float32.

    gyro and accel are the last `config.reach` raw samples.
    """
    gyro, accel = gyro[: config.input_samples], accel[: config.input_samples]
    rotation, biases = state.clone_rotation[oldest], (state.gyro_bias, state.accel_bias)
    window = cut_window(
        rotation, gyro, accel, *biases, config.cut, config.dt, config.context_samples
    )
    return window[None].astype(jnp.float32)


def _make_floating(value: Any) -> Any:
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.float32)
