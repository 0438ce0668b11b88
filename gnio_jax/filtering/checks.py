"""Checks of the arguments of the filter's public functions, each with a `ValueError` that names the
argument, and conversion of the arguments of a run to one precision.

Values are only known outside `jax.jit`. Inside it only shapes and precisions are checked, and
`FilterHistory.healthy` reports bad values.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.tree_util import keystr, tree_map_with_path
from jaxtyping import Int

from gnio_jax.config import ConsideredStd, CorrelatedError, InitialStd, NoiseModel
from gnio_jax.config.files import bounds, iterate_settings
from gnio_jax.config.schema import Bound
from gnio_jax.filtering.barometer import Barometer
from gnio_jax.filtering.displacement import Displacement
from gnio_jax.filtering.filter import Filter
from gnio_jax.filtering.fix import THRESHOLDS, Fix, improper_covariances
from gnio_jax.filtering.magnetometer import Magnetometer
from gnio_jax.filtering.nonholonomic import NonHolonomic
from gnio_jax.filtering.settings import DisplacementFrame, FilterConfig
from gnio_jax.filtering.state import FilterState, state_shapes, with_correlated_errors
from gnio_jax.filtering.wheel_speed import WheelSpeed
from gnio_jax.numerics import finite_rows
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Array


class FilterInputs(NamedTuple):
    """The arguments of every run, checked and in one precision."""

    ekf: Filter
    state: FilterState
    gyro: Array
    """(K·n, 3), rad/s, raw, in the body frame."""
    accel: Array
    """(K·n, 3), m/s²."""
    imu_valid: Array | None
    """(K·n,) booleans: which samples are present; None: the stream is complete."""
    measurements: tuple[Any, ...]
    """Trees of arrays whose leading axis is K."""
    variance: Array | None = None
    """(K·n, 6) variances of [accel, gyro]; None: the filter's densities hold."""


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
    """`value` as a JAX array of this shape, which shares no memory with it."""
    value = as_array(name, value)
    if value.shape != shape:
        problem = f"the shape must be {shape}, found {value.shape}"
        batched = value.ndim == len(shape) + 1 and value.shape[1:] == shape
        remedy = "; for a batch of sequences use jax.vmap" if batched else ""
        raise ValueError(f"{name}: {problem}{remedy}")
    return value


def as_array(name: str, value: Any) -> jax.Array:
    """`value` as a JAX array, which shares no memory with it. `jnp.asarray` would compile a program
    for each shape of NumPy's arrays."""
    try:
        if isinstance(value, np.ndarray):
            return jax.device_put(np.array(value))
        return jnp.asarray(value)
    except (TypeError, ValueError):
        kind = type(value).__name__
        raise ValueError(f"{name}: must be an array of numbers, found {kind}") from None


def count_rows(value: jax.Array) -> int:
    """The number of samples (n, 3) of a sequence, or of each sequence of a batch (b, n, 3), which
    `checked_shape` then refuses."""
    return value.shape[-2] if value.ndim > 1 else value.size


def check_kind(name: str, value: Any, kind: type, example: str) -> None:
    """Refuse a value of another type; `example` is what to write."""
    if not isinstance(value, kind):
        problem = f"must be a {kind.__name__}, e.g. {example}, found {type(value).__name__}"
        raise ValueError(f"{name}: {problem}")


def check_rows(
    name: str, value: jax.Array, bad: Callable[[np.ndarray], np.ndarray], problem: str
) -> None:
    """Refuse an array of which some rows are `bad`, naming the first."""
    if not isinstance(value, Tracer):
        rows = bad(np.asarray(value, np.float64))
        if rows.any():
            count = f"{rows.sum()} of {len(rows)} rows {problem}"
            raise ValueError(f"{name}: {count}, the first is row {rows.argmax()}")


def check_rotation(name: str, value: jax.Array) -> None:
    """Refuse a matrix that is no rotation, up to the rounding of text files."""
    if not isinstance(value, Tracer):
        matrix = np.asarray(value, np.float64)
        if not (np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-3 and np.linalg.det(matrix) > 0):
            raise ValueError(f"{name}: is not a rotation matrix")


def check_covariance(name: str, value: jax.Array, kinds: Int[np.ndarray, " n"]) -> None:
    """Refuse a matrix that is not symmetric and positive semi-definite, up to rounding. `kinds` has
    the kind of each row; rows of one kind are scaled by the largest standard deviation among
    them."""
    if isinstance(value, Tracer):
        return
    matrix = np.asarray(value, np.float64)
    variance = np.diag(matrix)
    largest = np.zeros(kinds.max() + 1)
    np.maximum.at(largest, kinds, np.sqrt(np.abs(variance)))
    scale = largest[kinds] + 1e-150
    scaled = matrix / np.outer(scale, scale)
    tolerance = 1e-5 if value.dtype == jnp.float64 else 1e-4
    if np.abs(scaled - scaled.T).max() > tolerance:
        raise ValueError(f"{name}: is not symmetric")
    if np.linalg.eigvalsh(scaled)[0] < -tolerance:
        raise ValueError(f"{name}: is not positive definite")


def check_frame(frame: Any) -> None:
    """Refuse a name that is no `DisplacementFrame`."""
    if frame not in get_args(DisplacementFrame):
        names = " or ".join(map(repr, get_args(DisplacementFrame)))
        raise ValueError(f"frame: must be {names}, found {frame!r}")


def check_number(name: str, value: Any, least: float, unit: str) -> None:
    """Refuse a value that is not a finite Python number of at least `least`."""
    if not (isinstance(value, int | float) and least <= value < math.inf):
        raise ValueError(f"{name}: must be a number of at least {least:g} {unit}, found {value!r}")


def check_bounds(name: str, number: Any, limits: Iterable[Bound]) -> None:
    """Refuse anything but None, or one number within the limits."""
    if isinstance(number, str):
        raise ValueError(f"{name}: must be a number, found {number!r}")
    if np.shape(number) != ():
        raise ValueError(f"{name}: must be one number, found shape {np.shape(number)}")
    for bound in limits:
        if not (number is None or isinstance(number, Tracer) or bound.holds(float(number))):
            raise ValueError(f"{name}: {bound.problem}, found {float(number)}")


def check_numbers(name: str, settings: Any, bounded_only: bool = False) -> None:
    """Refuse a tuple of settings (`NoiseModel`, `InitialStd`, `ConsideredStd`) with a number
    outside the bounds of its field. With `bounded_only`, as for a measurement of anybody's, fields
    without bounds may hold anything."""
    try:
        fields = list(iterate_settings(settings, f"{name}."))
    except NameError:  # The types of a class that is local to a function may have no value here.
        if not bounded_only:
            raise
        return
    for field, hint, value in fields:
        limits = tuple(bounds(hint))
        if limits or not bounded_only:
            for number in value if isinstance(value, tuple | list) else (value,):
                check_bounds(field, number, limits)


# The arguments of a run
# ------------------------------------------------------------------------------------------------


def checked_inputs(
    ekf: Filter,
    state: FilterState,
    gyro: Any,
    accel: Any,
    imu_valid: Any,
    measurements: tuple[Any, ...],
    variance: Any = None,
) -> FilterInputs:
    """The arguments that every run takes, checked and in the state's precision. The values of
    measurements are not checked, because a NaN means that there is none; only those of a `Fix`
    are."""
    check_filter(ekf)
    config, state = ekf.config, checked_state(state, ekf)
    dtype, n = state.offset.dtype, config.samples_per_clone
    gyro, accel = as_array("gyro", gyro), as_array("accel", accel)
    samples = count_rows(gyro)
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
            present = True if imu_valid is None else np.asarray(imu_valid)
            problem = f"are beyond {largest:g} {unit}"
            check_rows(name, value, lambda rows: (np.abs(rows) > largest).any(1) & present, problem)
        return value.astype(dtype)

    gyro = checked_signal("gyro", gyro, FASTEST_TURN, "rad/s")
    accel = checked_signal("accel", accel, STRONGEST_FORCE, "m/s²")

    def checked_rows(path: Any, value: Any) -> jax.Array:
        name = f"measurements{keystr(path)}"
        if not np.ndim(value):
            remedy = "a measurement of single numbers is a part of the Filter"
            raise ValueError(f"{name}: must have a row for each of the clone intervals; {remedy}")
        value = checked_shape(name, value, (samples // n, *np.shape(value)[1:]))
        return value.astype(dtype) if jnp.issubdtype(value.dtype, jnp.floating) else value

    check_measurements("measurements", measurements, ekf.measurements)
    for number, measurement in enumerate(measurements):
        if _has_states(measurement):
            problem = "the mounting is estimated, so the constraint is a part of the Filter"
            raise ValueError(f"measurements[{number}]: {problem}; put it in ekf.measurements")
    measurements = tree_map_with_path(checked_rows, tuple(measurements))
    for number, measurement in enumerate(measurements):
        if isinstance(measurement, Fix):
            check_fix(f"measurements[{number}]", measurement)
    if variance is not None:
        variance = checked_array("variance", variance, (samples, 6), config).astype(dtype)
        check_rows("variance", variance, lambda rows: (rows <= 0).any(1), "are not above 0")
    ekf = converted_filter(ekf, dtype)
    return FilterInputs(ekf, state, gyro, accel, imu_valid, measurements, variance)


def check_measurements(argument: str, measurements: Any, others: tuple[Any, ...] = ()) -> None:
    """Refuse anything but a tuple of objects, each with a method `update` and a name that no other
    one of them and none of the `others` has. A single `Fix` is refused, because it is a tuple of
    arrays."""
    alone = isinstance(getattr(measurements, "name", None), str)
    if alone or not isinstance(measurements, tuple | list):
        kind = type(measurements).__name__
        remedy = f"write ({measurements.name},) for one" if alone else "write () for none"
        raise ValueError(f"{argument}: must be a tuple of measurements, found {kind}; {remedy}")
    names = {Displacement.name, *(measurement.name for measurement in others)}
    for number, measurement in enumerate(measurements):
        kind, name = type(measurement).__name__, getattr(measurement, "name", None)
        if isinstance(measurement, type):
            problem = f"is the class {measurement.__name__}"
            raise ValueError(f"{argument}[{number}]: {problem}; make a measurement of it")
        if not callable(getattr(measurement, "update", None)):
            raise ValueError(f"{argument}[{number}]: {kind} has no method update(state, step)")
        if not isinstance(name, str):
            problem = f"{kind} has no name; give the class one, e.g. name = '{kind.lower()}'"
            raise ValueError(f"{argument}[{number}]: {problem}")
        if name in names:
            remedy = f"give it another, e.g. class Second({kind}): name = 'second'"
            raise ValueError(f"{argument}[{number}]: the name '{name}' is taken; {remedy}")
        names.add(name)


def check_fix(name: str, fix: Fix) -> None:
    """Refuse fixes of wrong shapes or with impossible numbers: a covariance that is not symmetric
    and positive definite, or another number that is NaN or out of bounds. Rows without a component
    are not checked."""
    count = len(fix.position)
    axes = fix.position.shape[1] if fix.position.ndim == 2 else 0
    if axes not in THRESHOLDS:
        problem = f"the shape must be ({count}, 2) or ({count}, 3), found {fix.position.shape}"
        raise ValueError(f"{name}.position: {problem}")
    shapes = {"covariance": (count, axes, axes), "before_end": (count,)}
    for field, shape in {**shapes, "time_std": (count,), "threshold": (count,)}.items():
        if (value := getattr(fix, field)).shape != shape:
            raise ValueError(f"{name}.{field}: the shape must be {shape}, found {value.shape}")
    if isinstance(fix.position, Tracer):
        return
    present = np.isfinite(np.asarray(fix.position))
    used = present.any(axis=1)
    conditions = {
        "covariance": (
            lambda rows: improper_covariances(present, rows),
            "are not finite, symmetric and positive definite",
        ),
        "before_end": (lambda rows: ~np.isfinite(rows), "are not finite"),
        "time_std": (
            lambda rows: ~((rows >= 0) & (rows < np.inf)),
            "are not at least 0 and finite",
        ),
        "threshold": (lambda rows: ~(rows > 0), "are not above 0"),
    }
    for field, (bad, problem) in conditions.items():
        value = getattr(fix, field)
        check_rows(f"{name}.{field}", value, lambda rows, bad=bad: bad(rows) & used, problem)


def check_filter(ekf: Any) -> None:
    """Refuse anything but a `Filter`, and a filter with impossible parts."""
    check_kind("ekf", ekf, Filter, "Filter(FilterConfig(...))")
    check_kind("ekf.config", ekf.config, FilterConfig, "FilterConfig(dt=0.005, ...)")
    check_kind("ekf.noise", ekf.noise, NoiseModel, "NoiseModel()")
    check_kind("ekf.start", ekf.start, InitialStd, "InitialStd()")
    if ekf.considered is not None:
        check_kind("ekf.considered", ekf.considered, ConsideredStd, "ConsideredStd(scale=0.03)")
    if ekf.noise.correlation is not None:
        example = "CorrelatedError(share=0.8, seconds=0.5)"
        check_kind("ekf.noise.correlation", ekf.noise.correlation, CorrelatedError, example)
    factors = ekf.noise.std_factor
    if not (isinstance(factors, tuple | list) and len(factors) == 3):
        problem = f"must be a tuple of three numbers, for x, y and z, found {factors}"
        raise ValueError(f"ekf.noise.std_factor: {problem}")
    check_numbers("ekf.noise", ekf.noise)
    check_measurements("ekf.measurements", ekf.measurements)
    for number, measurement in enumerate(ekf.measurements):
        of_sensor = isinstance(measurement, Barometer | Fix | Magnetometer | WheelSpeed)
        if of_sensor and min(map(np.ndim, measurement)) > 0:
            problem = f"{type(measurement).__name__} has rows; pass it as `measurements` of the run"
            raise ValueError(f"ekf.measurements[{number}]: {problem}")
        if hasattr(measurement, "_fields"):
            check_numbers(f"ekf.measurements[{number}]", measurement, bounded_only=True)
        for field, other in getattr(measurement, "needs", {}).items():
            if getattr(measurement, other) is None and getattr(measurement, field) is not None:
                problem = f"{field}: has no effect alone; give {other}, too"
                raise ValueError(f"ekf.measurements[{number}].{problem}")
    if sum(map(_has_states, ekf.measurements)) > 1:
        problem = "a filter estimates the mounting of one constraint, and here are several"
        remedy = "leave mounting_std and lever_std out of the others"
        raise ValueError(f"ekf.measurements: {problem}; {remedy}")


def _has_states(measurement: Any) -> bool:
    return isinstance(measurement, NonHolonomic) and measurement.estimates_mounting


def converted_filter(ekf: Filter, dtype: Any) -> Filter:
    """The filter with all numbers that a run reads in one precision."""
    noise, measurements = jax.tree.map(
        lambda value: jnp.asarray(value, dtype), (ekf.noise, ekf.measurements)
    )
    return dataclasses.replace(ekf, noise=noise, measurements=measurements)


def checked_state(state: FilterState, ekf: Filter) -> FilterState:
    """`state` in one precision, with the shapes that the filter needs.

    A state without temporally correlated errors gets those that the filter has.
    """
    check_kind("state", state, FilterState, "initial_state(ekf, rotation, velocity, position)")
    config, count = ekf.config, len(ekf.correlation_times)
    state = with_correlated_errors(state, count)
    if len(state.correlated) != count:
        problem = f"the state has {len(state.correlated)} correlated errors, and the filter {count}"
        remedy = "the correlation of `ekf.noise` and the constraint must be those of the run before"
        raise ValueError(f"state.correlated: {problem}; {remedy}")
    dtype = jnp.float32 if config.allow_float32 else jnp.float64
    shapes = state_shapes(config, count, dtype)
    # Only the network knows the shapes of its memory (`network.first_memory`).
    memory, state = state.memory, state._replace(memory=None)
    if state.window is not None:
        shapes = shapes._replace(window=jax.ShapeDtypeStruct((config.reach, 7), dtype))

    def checked_leaf(path: Any, value: Any, like: jax.ShapeDtypeStruct) -> jax.Array:
        name = f"state{keystr(path)}"
        if not jnp.issubdtype(like.dtype, jnp.floating):
            return checked_shape(name, value, like.shape).astype(like.dtype)
        # The memory of the IMU may hold anything.
        finite = not name.startswith(("state.imu", "state.window"))
        return checked_array(name, value, like.shape, config, finite).astype(state.offset.dtype)

    state = tree_map_with_path(checked_leaf, state, shapes)
    check_rotation("state.rotation", state.rotation)
    # A clone at which the anchor moved has an offset of 0, up to the rounding of the others.
    core, clones = np.arange(len(state.core_covariance)), np.arange(len(state.clone_covariance))
    check_covariance("state.core_covariance", state.core_covariance, core)
    check_covariance("state.clone_covariance", state.clone_covariance, clones // 3 % 2)
    return state._replace(memory=memory)


def checked_displacements(
    displacement: Any, covariance: Any, inputs: FilterInputs
) -> tuple[jax.Array, jax.Array]:
    """A displacement and its covariance for every clone interval of a run, in its precision. Rows
    with a NaN are not checked."""
    config = inputs.ekf.config
    dtype, count = inputs.gyro.dtype, len(inputs.gyro) // config.samples_per_clone

    def improper(matrices: np.ndarray) -> np.ndarray:
        present = finite_rows(matrices.reshape(len(matrices), 9))
        return improper_covariances(np.repeat(present[:, None], 3, axis=1), matrices)

    displacement = checked_array("displacement", displacement, (count, 3), config, finite=False)
    covariance = checked_array("covariance", covariance, (count, 3, 3), config, finite=False)
    check_rows("covariance", covariance, improper, "are not symmetric and positive definite")
    return displacement.astype(dtype), covariance.astype(dtype)
