"""The arguments of a run, checked once at the door and brought to one precision."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gnio_jax.config import NoiseModel
from gnio_jax.filtering.checks import (
    BATCH_REMEDY,
    check_correlation,
    check_finite,
    check_measurable,
    check_not_negative,
    check_positive,
    check_positive_definite,
    check_rotation,
    checked_array,
    on_device,
)
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.start import initial_state, with_lasting_errors
from gnio_jax.filtering.state import FilterState
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Array

_FINITE_FIELDS = (
    "velocity",
    "offset",
    "gyro_bias",
    "accel_bias",
    "anchor",
    "core_covariance",
    "cross_covariance",
    "clone_covariance",
)


class Signals(NamedTuple):
    """An IMU stream of whole clone intervals, raw, in the body frame."""

    gyro: Array
    """(K·n, 3), rad/s."""
    accel: Array
    """(K·n, 3), m/s²."""
    valid: Array | None
    """(K·n,) booleans: which samples are there; None: the stream is complete."""


def checked_noise(noise: NoiseModel, dtype: Any) -> NoiseModel:
    """`noise` in one precision."""
    for path, value in jax.tree_util.tree_leaves_with_path(noise):
        check_not_negative("noise" + jax.tree_util.keystr(path), value)
    if len(noise.std_factor) != 3:
        raise ValueError("noise.std_factor: must be three numbers, for x, y and z")
    for name in ("measurement_scale", "std_factor"):
        for value in jax.tree.leaves(getattr(noise, name)):
            if not isinstance(value, Tracer) and float(value) == 0:
                raise ValueError(f"noise.{name}: must be positive, found 0")
    if noise.correlation is not None:
        check_correlation("noise.correlation", noise.correlation)
    return jax.tree.map(lambda value: jnp.asarray(value, dtype), noise)


def checked_state(state: FilterState, config: FilterConfig, noise: NoiseModel) -> FilterState:
    """`state` in one precision, with the fields and shapes that `config` and `noise` want.

    A state without the errors that last gets them, as large as `noise` says.
    """
    if noise.correlation is not None:
        state = with_lasting_errors(state)
    elif len(state.lasting):
        problem = "the state has errors that last, but noise.correlation is None"
        raise ValueError(f"state.lasting: {problem}")
    wanted = state_shapes(config, noise, jnp.float32 if config.allow_float32 else jnp.float64)
    if jax.tree.structure(state) != jax.tree.structure(wanted):
        raise ValueError(
            "state: was made for another FilterConfig than this one, "
            f"with jacobians = '{config.jacobians}'"
        )

    def checked_leaf(path: Any, value: Any, like: jax.ShapeDtypeStruct) -> jax.Array:
        name = "state" + jax.tree_util.keystr(path)
        if jnp.issubdtype(like.dtype, jnp.floating):
            return checked_array(name, value, like.shape, config).astype(state.offset.dtype)
        if jnp.shape(value) != like.shape:
            found = jnp.shape(value)
            raise ValueError(
                f"{name}: the shape must be {like.shape}, found {found}; {BATCH_REMEDY}"
            )
        return jnp.asarray(value, like.dtype)

    checked = jax.tree_util.tree_map_with_path(checked_leaf, state, wanted)
    if not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(checked)):
        _check_state_values(checked)
    return checked


def state_shapes(config: FilterConfig, noise: NoiseModel, dtype: Any) -> FilterState:
    """Shapes and types of the filter's state."""

    def start() -> FilterState:
        nothing = jnp.zeros(3, dtype)
        state = initial_state(config, jnp.eye(3, dtype=dtype), nothing, nothing)
        return state if noise.correlation is None else with_lasting_errors(state)

    return jax.eval_shape(start)


def _check_state_values(state: FilterState) -> None:
    for name in _FINITE_FIELDS:
        check_finite(f"state.{name}", getattr(state, name))
    core = np.asarray(state.core_covariance, np.float64)
    variances = np.diag(core)
    scale = np.sqrt(np.abs(variances)) + 1e-150
    correlations = core / np.outer(scale, scale)
    if np.linalg.eigvalsh(correlations)[0] < -1e-5 or (variances < 0).any():
        raise ValueError("state.core_covariance: is not positive definite")
    check_rotation("state.rotation", state.rotation)


def checked_inputs(
    state: FilterState,
    gyro: Any,
    accel: Any,
    imu_valid: Any,
    config: FilterConfig,
    noise: NoiseModel,
) -> tuple[FilterState, Signals, NoiseModel]:
    """What every run takes, checked and in the state's precision."""
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
        imu_valid = _checked_mask(imu_valid, samples)
    check_measurable("gyro", gyro, FASTEST_TURN, "rad/s", imu_valid)
    check_measurable("accel", accel, STRONGEST_FORCE, "m/s²", imu_valid)
    signals = Signals(gyro.astype(dtype), accel.astype(dtype), imu_valid)
    return state, signals, checked_noise(noise, dtype)


def _checked_mask(imu_valid: Any, samples: int) -> jax.Array:
    mask = on_device(imu_valid)
    if mask.shape != (samples,) or mask.dtype != jnp.bool_:
        found = f"{mask.dtype} of shape {mask.shape}"
        raise ValueError(f"imu_valid: must be {samples} booleans, found {found}")
    return mask


def checked_measurements(
    displacement: Any, covariance: Any, signals: Signals, config: FilterConfig
) -> tuple[jax.Array, jax.Array]:
    """A displacement and its covariance for every clone interval of `signals`, in its precision."""
    dtype = signals.gyro.dtype
    intervals = signals.gyro.shape[0] // config.samples_per_clone
    displacement = checked_array("displacement", displacement, (intervals, 3), config)
    covariance = checked_array("covariance", covariance, (intervals, 3, 3), config)
    check_positive_definite("covariance", covariance.astype(dtype))
    return displacement.astype(dtype), covariance.astype(dtype)


def checked_displacements(
    displacement: Any, std: Any, signals: Signals, config: FilterConfig
) -> tuple[jax.Array, jax.Array]:
    """The displacements of a run and their standard deviations, for every clone interval of
    `signals`, in its precision."""
    shape = (signals.gyro.shape[0] // config.samples_per_clone, 3)
    displacement, std = (
        checked_array(name, value, shape, config).astype(signals.gyro.dtype)
        for name, value in [("displacement", displacement), ("measurement_std", std)]
    )
    check_positive("measurement_std", std)
    return displacement, std
