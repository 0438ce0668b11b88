"""The stochastic-cloning EKF as one scan over clone intervals: with given measurements, or with the network in the loop."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.filtering.propagation import interval, propagate
from gnio_jax.filtering.state import CLONE, CORE, FilterConfig, FilterState, NoiseModel, check
from gnio_jax.filtering.update import Measurement, Outcome, update
from gnio_jax.types import Array, Prediction


class FilterHistory(NamedTuple):
    """The filter after each of K clone intervals: row k is at t_0 + (k + 1)·n·dt, after its update."""

    rotation: Float[Array, "k 3 3"]
    """Body → world."""
    velocity: Float[Array, "k 3"]
    """World frame, m/s."""
    position: Float[Array, "k 3"]
    """World frame, m."""
    gyro_bias: Float[Array, "k 3"]
    """rad/s"""
    accel_bias: Float[Array, "k 3"]
    """m/s²"""
    displacement: Float[Array, "k 3"]
    """The measurement, m, in the yaw frame of the oldest clone; NaN where none."""
    measurement_std: Float[Array, "k 3"]
    """Its standard deviations after `FilterConfig.measurement_scale`, m; NaN where none."""
    innovation: Float[Array, "k 3"]
    """Measured − predicted displacement, m; NaN where no measurement."""
    covariance_diagonal: Float[Array, "k 15"]
    """Variances of θ, v, p, b_g, b_a."""
    covariance: Float[Array, "k 15 15"] | None
    """The whole core block where `FilterConfig.history` is "core", else None."""
    accepted: Float[Array, "k"]
    """1 an update was applied (also one with scaled covariance), 0 none was (gate or gimbal lock), NaN no measurement."""
    gate_passed: Float[Array, "k"]
    """1 the gate let the measurement through as it is, 0 it did not, NaN no measurement."""
    nis: Float[Array, "k"]
    """Normalised innovation squared, rᵀ S⁻¹ r; NaN where no measurement."""
    diagnostics: dict[str, Array]
    """The network's diagnostics stacked over K, NaN where it had no window; empty without a network."""


def run_filter(state: FilterState, gyro: Any, accel: Any, displacement: Any, covariance: Any, config: FilterConfig,
               noise: NoiseModel) -> tuple[FilterState, FilterHistory]:
    """Filter K clone intervals of IMU samples with given displacement measurements.

    gyro rad/s and accel m/s² (K·n, 3), raw, in the body frame: the filter's biases are subtracted inside; displacement (K, 3), m, row k
    from clone k−W to clone k in the yaw frame of clone k−W; covariance (K, 3, 3), m², before `measurement_scale`. A row with a NaN, or
    before there are W + 1 clones, is no measurement. Returns the final state, from which a later call goes on (clone numbers k then count
    on, too), and the history. Works under `jax.jit`, `jax.vmap` and `jax.grad`.
    Raises `ValueError` naming an argument of wrong shape or precision.
    """
    state, gyro, accel, noise = _admit(state, gyro, accel, config, noise)
    intervals = gyro.shape[0] // config.samples_per_clone
    displacement = check("displacement", displacement, (intervals, 3), config).astype(gyro.dtype)
    covariance = check("covariance", covariance, (intervals, 3, 3), config).astype(gyro.dtype)
    return _run_filter(state, gyro, accel, displacement, covariance, config, noise)


@functools.partial(jax.jit, static_argnames="config")
def _run_filter(state, gyro, accel, displacement, covariance, config, noise):
    measurements = jax.vmap(functools.partial(_measurement, config=config))(displacement, covariance)
    return _scan(lambda k, _state, _oldest, given: (given, {}), state, gyro, accel, config, noise, measurements)


def run_odometry(predict: Callable[[Any], Prediction], state: FilterState, gyro: Any, accel: Any, config: FilterConfig,
                 noise: NoiseModel) -> tuple[FilterState, FilterHistory]:
    """Filter K clone intervals with the network in the loop (paper fig. 2): its windows are cut with the filter's own state.

    predict maps windows (1, N, 6) float32, N = n·W, channels [accel m/s², gyro rad/s], to a `Prediction` with the same leading axis.
    A window spans the samples between its two clones i and j; the filter's present biases are subtracted and the samples rotated by
    R_γ(R_i)ᵀ R_j, R_j being the present estimate of clone i advanced by integrating gyro − b_g (paper eq. 1; TLIO). The measurement's
    covariance is diag(exp 2u), u raised to `log_std_min`. The network is not called in the first W intervals, which have no window.
    gyro and accel as in `run_filter`. Jit it from outside; differentiable in whatever `predict` closes over, too.
    Raises `ValueError` naming an argument of wrong shape or precision, or a `predict` that returns something else.
    """
    state, gyro, accel, noise = _admit(state, gyro, accel, config, noise)
    dtype = gyro.dtype
    window = jax.ShapeDtypeStruct((1, config.window, 6), jnp.float32)
    expected = jax.eval_shape(predict, window)
    if not isinstance(expected, Prediction):
        raise ValueError(f"predict: must return a gnio_jax.types.Prediction, found {type(expected).__name__}")
    for name, value in [("displacement", expected.displacement), ("log_std", expected.log_std)]:
        if value.shape != (1, 3):
            raise ValueError(f"predict: {name} must be (1, 3) for one window, found {value.shape}")
    for name, value in expected.diagnostics.items():
        if value.shape[:1] != (1,):
            raise ValueError(f"predict: diagnostics['{name}'] must have a leading axis of one window, found {value.shape}")

    def infer(k: Array, state: FilterState, oldest: Array) -> Prediction:
        start = (k - config.clones_per_window + 1) * config.samples_per_clone
        cut = [jax.lax.dynamic_slice_in_dim(signal, start, config.window) for signal in (gyro, accel)]
        imu = network_window(state.clone_rotation[oldest], cut[0] - state.gyro_bias[None], cut[1] - state.accel_bias[None], config)
        return jax.tree.map(lambda leaf: _floating(leaf[0]), predict(imu[None].astype(jnp.float32)))

    def nothing(k: Array, state: FilterState, oldest: Array) -> Prediction:
        return jax.tree.map(lambda leaf: jnp.full(leaf.shape[1:], jnp.nan, _floating(leaf).dtype), expected)

    def measure(k: Array, state: FilterState, oldest: Array, _given: None) -> tuple[Measurement, dict]:
        # k is the scan's own counter, the same for every sequence of a batch, so that this stays a branch under vmap.
        prediction = jax.lax.cond(k >= config.clones_per_window, infer, nothing, k, state, oldest)
        log_std = jnp.maximum(prediction.log_std.astype(dtype), config.log_std_min)
        return _measurement(prediction.displacement.astype(dtype), jnp.diag(jnp.exp(2 * log_std)), config), prediction.diagnostics

    return _scan(measure, state, gyro, accel, config, noise, None)


def network_window(rotation: Float[Array, "3 3"], gyro: Float[Array, "n 3"], accel: Float[Array, "n 3"],
                   config: FilterConfig) -> Float[Array, "n 6"]:
    """[accel, gyro], biases already subtracted, of a window whose first sample has this attitude, rotated by R_γ(R_i)ᵀ R_j (eq. 1)."""
    level = geometry.yaw_rotation(rotation).T @ rotation
    if config.window_rotation == "single":
        return jnp.concatenate([accel @ level.T, gyro @ level.T], axis=1)
    rotations = geometry.cumulative_rotation(level, jax.vmap(geometry.exp, out_axes=2)(gyro[:-1] * config.dt))
    return geometry.matmul(rotations, jnp.stack([accel.T, gyro.T], axis=1)).transpose(2, 1, 0).reshape(-1, 6)


def _scan(measure: Callable, state: FilterState, gyro: Array, accel: Array, config: FilterConfig, noise: NoiseModel,
          measurements: Any) -> tuple[FilterState, FilterHistory]:
    n, clones = config.samples_per_clone, config.clones_per_window + 1
    intervals = gyro.shape[0] // n

    def step(state: FilterState, inputs: tuple) -> tuple[FilterState, tuple]:
        k, gyro, accel, given = inputs
        # A ring of clones: the newest takes the place of the one that has served as oldest, and the next slot is the oldest now.
        newest, oldest = k % clones, (k + 1) % clones
        state = propagate(state, interval(state, gyro, accel, noise, config.dt), newest)
        measurement, diagnostics = measure(k, state, oldest, given)
        state, outcome = update(state, measurement, newest, oldest, state.step >= clones, config)
        kept = state.core_covariance if config.history == "core" else jnp.diagonal(state.core_covariance)
        mean = (state.rotation, state.velocity, state.position, state.gyro_bias, state.accel_bias)
        return state, (mean, kept, measurement, outcome, diagnostics)

    inputs = (jnp.arange(intervals), gyro.reshape(intervals, n, 3), accel.reshape(intervals, n, 3), measurements)
    state, (mean, kept, measurement, outcome, diagnostics) = jax.lax.scan(step, state, inputs)
    return _oldest_first(state, intervals % clones), _history(mean, kept, measurement, outcome, diagnostics, config)


def _history(mean: tuple, kept: Array, measurement: Measurement, outcome: Outcome, diagnostics: dict,
             config: FilterConfig) -> FilterHistory:
    def where_present(value: Array) -> Array:
        present = outcome.present.reshape(-1, *[1] * (value.ndim - 1))
        return jnp.where(present, value, jnp.nan).astype(kept.dtype)

    std = jnp.sqrt(jnp.diagonal(measurement.covariance, axis1=1, axis2=2))
    return FilterHistory(
        *mean, displacement=where_present(measurement.displacement), measurement_std=where_present(std),
        innovation=where_present(outcome.innovation),
        covariance_diagonal=jnp.diagonal(kept, axis1=1, axis2=2) if config.history == "core" else kept,
        covariance=kept if config.history == "core" else None, accepted=where_present(outcome.accepted),
        gate_passed=where_present(outcome.gate_passed), nis=where_present(outcome.nis), diagnostics=diagnostics)


def _measurement(displacement: Float[Array, "3"], covariance: Float[Array, "3 3"], config: FilterConfig) -> Measurement:
    """Scale; keep NaN out of the arithmetic, or its derivatives would be NaN too."""
    present = jnp.all(jnp.isfinite(displacement)) & jnp.all(jnp.isfinite(covariance))
    scaled = jnp.where(present, config.measurement_scale * covariance, jnp.eye(3, dtype=covariance.dtype))
    return Measurement(displacement=jnp.where(present, displacement, 0.0), covariance=scaled, present=present)


def _oldest_first(state: FilterState, shift: int) -> FilterState:
    """The ring of clones turned by `shift`, so that slot 0 is the oldest again."""
    blocks = CLONE * shift
    return state._replace(
        clone_rotation=jnp.roll(state.clone_rotation, -shift, 0), clone_position=jnp.roll(state.clone_position, -shift, 0),
        cross_covariance=jnp.roll(state.cross_covariance, -blocks, 1),
        clone_covariance=jnp.roll(state.clone_covariance, (-blocks, -blocks), (0, 1)))


def _floating(value: Any) -> Any:
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.float32)


def _admit(state: FilterState, gyro: Any, accel: Any, config: FilterConfig,
           noise: NoiseModel) -> tuple[FilterState, Array, Array, NoiseModel]:
    """Check what both doors take, and bring it to the state's precision."""
    clones = config.clones_per_window + 1
    shapes = FilterState((3, 3), (3,), (3,), (3,), (3,), (clones, 3, 3), (clones, 3), (CORE, CORE), (CORE, CLONE * clones),
                         (CLONE * clones, CLONE * clones), (), None)
    fields = {name: check(f"state.{name}", getattr(state, name), shape, config) for name, shape in shapes._asdict().items()
              if name not in ("step", "gate")}
    dtype = fields["position"].dtype
    samples = jnp.shape(gyro)[0] if jnp.ndim(gyro) else 0
    if samples < config.samples_per_clone or samples % config.samples_per_clone:
        raise ValueError(f"gyro: the samples must be a multiple of samples_per_clone = {config.samples_per_clone}, found {samples}")
    gyro, accel = (check(name, value, (samples, 3), config).astype(dtype) for name, value in [("gyro", gyro), ("accel", accel)])
    for name, value in noise._asdict().items():
        if jnp.shape(value) != ():
            raise ValueError(f"noise.{name}: must be one number, found shape {jnp.shape(value)}")
    return state._replace(**{name: value.astype(dtype) for name, value in fields.items()}), gyro, accel, NoiseModel(
        *[jnp.asarray(value, dtype) for value in noise])
