"""What the filter's public functions refuse, each with a `ValueError` that names the argument, and
the arguments of a run in one precision.

Values are only known outside `jax.jit`. Inside it shapes and precisions are checked alone, and
`FilterHistory.healthy` reports bad values.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gnio_jax.config import NoiseModel
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.state import FilterState, state_shapes, with_correlated_error
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Array

BATCH_REMEDY = "for a batch of sequences use jax.vmap"


class Inputs(NamedTuple):
    """The arguments of every run, checked and in one precision."""

    state: FilterState
    gyro: Array
    """(K·n, 3), rad/s, raw, in the body frame."""
    accel: Array
    """(K·n, 3), m/s²."""
    imu_valid: Array | None
    """(K·n,) booleans: which samples are there; None: the stream is complete."""
    measurements: tuple[Any, ...]
    """Trees of arrays that lead with K."""
    noise: NoiseModel


# One argument
# ------------------------------------------------------------------------------------------------


def checked_array(name: str, value: Any, shape: tuple[int, ...], config: FilterConfig) -> jax.Array:
    """`value` as a JAX array of this shape and of the precision that `config` asks for."""
    value = on_device(value)
    check_shape(name, value, shape)
    single = value.dtype == jnp.float32
    if value.dtype == jnp.float64 or (single and config.allow_float32):
        return value
    remedy = "call jax.config.update('jax_enable_x64', True) first"
    if jax.config.read("jax_enable_x64"):
        remedy = "cast it"
    if single:
        remedy += ", or ask for FilterConfig(allow_float32=True)"
    raise ValueError(f"{name}: the filter runs in float64, found {value.dtype}; {remedy}")


def check_shape(name: str, value: Any, shape: tuple[int, ...]) -> None:
    found = jnp.shape(value)
    if found != shape:
        raise ValueError(f"{name}: the shape must be {shape}, found {found}; {BATCH_REMEDY}")


def on_device(value: Any) -> jax.Array:
    """`value` as a JAX array, which shares no memory with it. `jnp.asarray` would compile a program
    for each shape of NumPy's arrays."""
    if isinstance(value, np.ndarray):
        return jax.device_put(np.array(value))
    return jnp.asarray(value)


def check_finite(name: str, value: jax.Array, remedy: str = "") -> None:
    """Refuse rows that are not finite, naming the first."""
    if not isinstance(value, Tracer):
        finite = np.isfinite(np.asarray(value)).reshape(len(value), -1).all(1)
        _refuse_rows(name, ~finite, "rows are not finite", remedy)


def check_positive_definite(name: str, value: jax.Array) -> None:
    """Refuse matrices (k, d, d) that are not symmetric and positive definite, naming the first;
    those with a NaN pass."""
    if isinstance(value, Tracer):
        return
    matrices = np.asarray(value, np.float64)
    known = np.asarray(np.isfinite(matrices).all((1, 2)))
    clean = np.where(known[:, None, None], matrices, np.eye(matrices.shape[1]))
    largest = np.abs(clean).max((1, 2))
    asymmetric = np.abs(clean - clean.transpose(0, 2, 1)).max((1, 2)) > 1e-6 * largest
    bad = asymmetric | (np.linalg.eigvalsh(clean)[:, 0] <= 0)
    _refuse_rows(name, bad, "are not symmetric and positive definite", "")


def _refuse_rows(name: str, bad: np.ndarray, problem: str, remedy: str) -> None:
    if bad.any():
        found = f"{bad.sum()} of {len(bad)} {problem}, the first is row {bad.argmax()}"
        raise ValueError(f"{name}: {found}" + (f"; {remedy}" if remedy else ""))


def check_measurable(
    name: str, value: jax.Array, largest: float, unit: str, valid: Any = None
) -> None:
    """Refuse finite values, of the rows that are `valid`, which no IMU measures, naming the first
    such row."""
    if isinstance(value, Tracer) or isinstance(valid, Tracer):
        return
    size = np.abs(np.asarray(value)).max(1)
    bad = np.isfinite(size) & (size > largest)
    bad = bad if valid is None else bad & np.asarray(valid)
    if bad.any():
        problem = f"is beyond {largest:g} {unit} in {bad.sum()} of {len(bad)} rows"
        raise ValueError(f"{name}: {problem}, the first is row {bad.argmax()}")


def check_rotation(name: str, value: jax.Array) -> None:
    """Refuse what is no rotation matrix, to what rounding and text files leave of one."""
    if not isinstance(value, Tracer):
        matrix = np.asarray(value, np.float64)
        if not (np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-3 and np.linalg.det(matrix) > 0):
            raise ValueError(f"{name}: is not a rotation matrix")


def check_not_negative(name: str, value: Any) -> None:
    """Refuse what is not one number, or a number that is negative or not finite."""
    if jnp.shape(value) != ():
        raise ValueError(f"{name}: must be one number, found shape {jnp.shape(value)}")
    if not isinstance(value, Tracer):
        number = float(np.asarray(value))
        if not (math.isfinite(number) and number >= 0):
            raise ValueError(f"{name}: must be a number that is not negative, found {number}")


# The arguments of a run
# ------------------------------------------------------------------------------------------------


def checked_inputs(
    state: FilterState,
    gyro: Any,
    accel: Any,
    imu_valid: Any,
    measurements: tuple[Any, ...],
    config: FilterConfig,
    noise: NoiseModel,
) -> Inputs:
    """What every run takes, checked and in the state's precision. The values of the caller's own
    measurements are not checked: NaN is no measurement."""
    state = checked_state(state, config, noise)
    dtype, n = state.offset.dtype, config.samples_per_clone
    samples = jnp.shape(gyro)[0] if jnp.ndim(gyro) else 0
    if samples < n or samples % n:
        raise ValueError(
            f"gyro: the samples must be a multiple of samples_per_clone = {n}, found {samples}"
        )
    gyro = checked_array("gyro", gyro, (samples, 3), config)
    accel = checked_array("accel", accel, (samples, 3), config)
    if imu_valid is None:
        remedy = "name the missing samples with imu_valid to have them bridged"
        check_finite("gyro", gyro, remedy)
        check_finite("accel", accel, remedy)
    else:
        imu_valid = on_device(imu_valid)
        if imu_valid.shape != (samples,) or imu_valid.dtype != jnp.bool_:
            found = f"{imu_valid.dtype} of shape {imu_valid.shape}"
            raise ValueError(f"imu_valid: must be {samples} booleans, found {found}")
    check_measurable("gyro", gyro, FASTEST_TURN, "rad/s", imu_valid)
    check_measurable("accel", accel, STRONGEST_FORCE, "m/s²", imu_valid)

    def checked_rows(path: Any, value: Any) -> jax.Array:
        value, name = on_device(value), "measurements" + jax.tree_util.keystr(path)
        check_shape(name, value, (samples // n, *value.shape[1:]))
        return value.astype(dtype) if jnp.issubdtype(value.dtype, jnp.floating) else value

    measurements = jax.tree_util.tree_map_with_path(checked_rows, measurements)
    signals = gyro.astype(dtype), accel.astype(dtype), imu_valid
    return Inputs(state, *signals, measurements, checked_noise(noise, dtype))


def checked_noise(noise: NoiseModel, dtype: Any) -> NoiseModel:
    """`noise` in one precision."""
    for path, value in jax.tree_util.tree_leaves_with_path(noise):
        check_not_negative("noise" + jax.tree_util.keystr(path), value)
    if len(noise.std_factor) != 3:
        raise ValueError("noise.std_factor: must be three numbers, for x, y and z")
    positive = {"measurement_scale": noise.measurement_scale, "std_factor": noise.std_factor}
    if noise.correlation is not None:
        positive["correlation.seconds"] = noise.correlation.seconds
        share = noise.correlation.share
        if not isinstance(share, Tracer) and not float(share) < 1:
            raise ValueError(f"noise.correlation.share: must be below 1, found {float(share)}")
    for name, values in positive.items():
        for value in jax.tree.leaves(values):
            if not isinstance(value, Tracer) and float(value) == 0:
                raise ValueError(f"noise.{name}: must be positive, found {float(value)}")
    return jax.tree.map(lambda value: jnp.asarray(value, dtype), noise)


def checked_state(state: FilterState, config: FilterConfig, noise: NoiseModel) -> FilterState:
    """`state` in one precision, with the shapes that `config` and `noise` want.

    A state without a temporally correlated error gets one where `noise` has one.
    """
    if noise.correlation is not None:
        state = with_correlated_error(state)
    elif len(state.correlated):
        problem = "the state has a correlated error, but noise.correlation is None"
        raise ValueError(f"state.correlated: {problem}")
    wanted = state_shapes(config, noise, jnp.float32 if config.allow_float32 else jnp.float64)

    def checked_leaf(path: Any, value: Any, like: jax.ShapeDtypeStruct) -> jax.Array:
        name = "state" + jax.tree_util.keystr(path)
        if jnp.issubdtype(like.dtype, jnp.floating):
            return checked_array(name, value, like.shape, config).astype(state.offset.dtype)
        check_shape(name, value, like.shape)
        return jnp.asarray(value, like.dtype)

    checked = jax.tree_util.tree_map_with_path(checked_leaf, state, wanted)
    if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(checked)):
        _check_state_values(checked)
    return checked


def _check_state_values(state: FilterState) -> None:
    for name, value in state._asdict().items():
        # The IMU's memory is NaN before the first sample.
        if isinstance(value, jax.Array) and value.ndim and value.size:
            check_finite(f"state.{name}", value)
    core = np.asarray(state.core_covariance, np.float64)
    variances = np.diag(core)
    scale = np.sqrt(np.abs(variances)) + 1e-150
    correlations = core / np.outer(scale, scale)
    if np.linalg.eigvalsh(correlations)[0] < -1e-5 or (variances < 0).any():
        raise ValueError("state.core_covariance: is not positive definite")
    check_rotation("state.rotation", state.rotation)


def checked_displacements(
    displacement: Any, covariance: Any, inputs: Inputs, config: FilterConfig
) -> tuple[jax.Array, jax.Array]:
    """A displacement and its covariance for every clone interval of a run, in its precision."""
    dtype, count = inputs.gyro.dtype, len(inputs.gyro) // config.samples_per_clone
    displacement = checked_array("displacement", displacement, (count, 3), config)
    covariance = checked_array("covariance", covariance, (count, 3, 3), config)
    check_positive_definite("covariance", covariance.astype(dtype))
    return displacement.astype(dtype), covariance.astype(dtype)
