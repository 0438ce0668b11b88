"""Checks of the arguments of the filter's public functions, each with a `ValueError` that names the
argument, and conversion of the arguments of a run to one precision.

Values are only known outside `jax.jit`. Inside it only shapes and precisions are checked, and
`FilterHistory.healthy` reports bad values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.tree_util import keystr, tree_map_with_path

from gnio_jax.config import NoiseModel
from gnio_jax.config.files import bounds, named
from gnio_jax.config.schema import Bound
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import FilterState, state_shapes, with_correlated_error
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Array


class Inputs(NamedTuple):
    """The arguments of every run, checked and in one precision."""

    state: FilterState
    gyro: Array
    """(K·n, 3), rad/s, raw, in the body frame."""
    accel: Array
    """(K·n, 3), m/s²."""
    imu_valid: Array | None
    """(K·n,) booleans: which samples are present; None: the stream is complete."""
    measurements: tuple[Any, ...]
    """Trees of arrays whose leading axis is K."""
    noise: NoiseModel


# One argument
# ------------------------------------------------------------------------------------------------


def checked_array(
    name: str, value: Any, shape: tuple[int, ...], config: FilterConfig, finite: bool = True
) -> jax.Array:
    """`value` as a JAX array of this shape and of the precision that `config` asks for, whose rows
    are `finite`."""
    value = checked_shape(name, value, shape)
    single = value.dtype == jnp.float32
    if value.dtype != jnp.float64 and not (single and config.allow_float32):
        remedy = "call jax.config.update('jax_enable_x64', True) first"
        if jax.config.read("jax_enable_x64"):
            remedy = "cast it"
        if single:
            remedy += ", or ask for FilterConfig(allow_float32=True)"
        raise ValueError(f"{name}: the filter runs in float64, found {value.dtype}; {remedy}")
    if finite and value.size:
        axes = tuple(range(1, value.ndim))
        check_rows(name, value, lambda rows: ~np.isfinite(rows).all(axes), "are not finite")
    return value


def checked_shape(name: str, value: Any, shape: tuple[int, ...]) -> jax.Array:
    """`value` as a JAX array of this shape, which shares no memory with it. `jnp.asarray` would
    compile a program for each shape of NumPy's arrays."""
    array = isinstance(value, np.ndarray)
    value = jax.device_put(np.array(value)) if array else jnp.asarray(value)
    if value.shape != shape:
        remedy = "for a batch of sequences use jax.vmap"
        raise ValueError(f"{name}: the shape must be {shape}, found {value.shape}; {remedy}")
    return value


def check_rows(
    name: str, value: jax.Array, bad: Callable[[np.ndarray], np.ndarray], problem: str
) -> None:
    """Refuse an array of which some rows are `bad`, naming the first."""
    if not isinstance(value, Tracer):
        rows = bad(np.asarray(value, np.float64))
        if rows.any():
            found = f"{rows.sum()} of {len(rows)} rows {problem}"
            raise ValueError(f"{name}: {found}, the first is row {rows.argmax()}")


def check_rotation(name: str, value: jax.Array) -> None:
    """Refuse a matrix that is no rotation, up to the rounding of text files."""
    if not isinstance(value, Tracer):
        matrix = np.asarray(value, np.float64)
        if not (np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-3 and np.linalg.det(matrix) > 0):
            raise ValueError(f"{name}: is not a rotation matrix")


def check_number(name: str, value: Any, least: float, unit: str) -> None:
    """Refuse a value that is not a finite Python number of at least `least`."""
    if not (isinstance(value, int | float) and least <= value < math.inf):
        raise ValueError(f"{name}: must be a number of at least {least:g} {unit}, found {value!r}")


def check_bounds(name: str, number: Any, limits: Iterable[Bound]) -> None:
    """Refuse what is neither None nor one number within the limits."""
    if np.shape(number) != ():
        raise ValueError(f"{name}: must be one number, found shape {np.shape(number)}")
    for bound in limits:
        if not (number is None or isinstance(number, Tracer) or bound.holds(float(number))):
            raise ValueError(f"{name}: {bound.problem}, found {float(number)}")


def check_numbers(name: str, settings: Any) -> None:
    """Refuse a tuple of settings (`NoiseModel`, `InitialStd`, `ConsideredStd`) with a number
    outside the bounds of its field."""
    for field, hint, value in named(settings, f"{name}."):
        for number in value if isinstance(value, tuple | list) else (value,):
            check_bounds(field, number, bounds(hint))


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
    """The arguments that every run takes, checked and in the state's precision. The values of the
    caller's own measurements are not checked: NaN is no measurement."""
    state = checked_state(state, config, noise)
    dtype, n = state.offset.dtype, config.samples_per_clone
    samples = jnp.shape(gyro)[0] if jnp.ndim(gyro) else 0
    if samples < n or samples % n:
        raise ValueError(
            f"gyro: the samples must be a multiple of samples_per_clone = {n}, found {samples}"
        )
    if imu_valid is not None:
        imu_valid = checked_shape("imu_valid", imu_valid, (samples,))
        if imu_valid.dtype != jnp.bool_:
            raise ValueError(f"imu_valid: must be booleans, found {imu_valid.dtype}")

    def checked_signal(name: str, value: Any, largest: float, unit: str) -> jax.Array:
        """The signal, which must be finite if there is no mask, and within the range of an IMU
        where a sample is present."""
        value = checked_array(name, value, (samples, 3), config, finite=imu_valid is None)
        if not isinstance(imu_valid, Tracer):
            there = True if imu_valid is None else np.asarray(imu_valid)
            problem = f"are beyond {largest:g} {unit}"
            check_rows(name, value, lambda rows: (np.abs(rows) > largest).any(1) & there, problem)
        return value.astype(dtype)

    gyro = checked_signal("gyro", gyro, FASTEST_TURN, "rad/s")
    accel = checked_signal("accel", accel, STRONGEST_FORCE, "m/s²")

    def checked_rows(path: Any, value: Any) -> jax.Array:
        shape = (samples // n, *np.shape(value)[1:])
        value = checked_shape(f"measurements{keystr(path)}", value, shape)
        return value.astype(dtype) if jnp.issubdtype(value.dtype, jnp.floating) else value

    measurements = tree_map_with_path(checked_rows, measurements)
    return Inputs(state, gyro, accel, imu_valid, measurements, checked_noise(noise, dtype))


def checked_noise(noise: NoiseModel, dtype: Any) -> NoiseModel:
    """`noise` in one precision."""
    check_numbers("noise", noise)
    if len(noise.std_factor) != 3:
        raise ValueError("noise.std_factor: must be three numbers, for x, y and z")
    return jax.tree.map(lambda value: jnp.asarray(value, dtype), noise)


def checked_state(state: FilterState, config: FilterConfig, noise: NoiseModel) -> FilterState:
    """`state` in one precision, with the shapes that `config` and `noise` need.

    A state without a temporally correlated error gets one where `noise` has one.
    """
    if noise.correlation is not None:
        state = with_correlated_error(state)
    elif len(state.correlated):
        problem = "the state has a correlated error, but noise.correlation is None"
        raise ValueError(f"state.correlated: {problem}")
    wanted = state_shapes(config, noise, jnp.float32 if config.allow_float32 else jnp.float64)

    def checked_leaf(path: Any, value: Any, like: jax.ShapeDtypeStruct) -> jax.Array:
        name = f"state{keystr(path)}"
        if not jnp.issubdtype(like.dtype, jnp.floating):
            return checked_shape(name, value, like.shape).astype(like.dtype)
        # The memory of the IMU may hold anything.
        finite = not name.startswith("state.imu")
        return checked_array(name, value, like.shape, config, finite).astype(state.offset.dtype)

    state = tree_map_with_path(checked_leaf, state, wanted)
    check_rotation("state.rotation", state.rotation)
    if not isinstance(state.core_covariance, Tracer):
        core = np.asarray(state.core_covariance, np.float64)
        scale = np.sqrt(np.abs(np.diag(core))) + 1e-150
        least = np.linalg.eigvalsh(core / np.outer(scale, scale))[0]
        if least < -1e-5 or (np.diag(core) < 0).any():
            raise ValueError("state.core_covariance: is not positive definite")
    return state


def checked_displacements(
    displacement: Any, covariance: Any, inputs: Inputs, config: FilterConfig
) -> tuple[jax.Array, jax.Array]:
    """A displacement and its covariance for every clone interval of a run, in its precision. Those
    with a NaN are not checked."""
    dtype, count = inputs.gyro.dtype, len(inputs.gyro) // config.samples_per_clone

    def improper(matrices: np.ndarray) -> np.ndarray:
        known = np.isfinite(matrices).all((1, 2), keepdims=True)
        clean = np.where(known, matrices, np.eye(3))
        skew = np.abs(clean - clean.transpose(0, 2, 1)).max((1, 2))
        asymmetric = skew > 1e-6 * np.abs(clean).max((1, 2))
        return asymmetric | (np.linalg.eigvalsh(clean)[:, 0] <= 0)

    displacement = checked_array("displacement", displacement, (count, 3), config, finite=False)
    covariance = checked_array("covariance", covariance, (count, 3, 3), config, finite=False)
    check_rows("covariance", covariance, improper, "are not symmetric and positive definite")
    return displacement.astype(dtype), covariance.astype(dtype)
