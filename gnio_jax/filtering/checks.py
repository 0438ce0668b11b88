"""What the filter's public functions refuse, each with a `ValueError` that names the argument.

Values are only known outside `jax.jit`; inside it shapes and precisions are checked alone, and
`FilterHistory.healthy` tells of bad values. chex's assertions raise AssertionError and name no
argument, so they serve the tests and not these checks.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gnio_jax.config import CorrelatedError
from gnio_jax.filtering.config import FilterConfig

BATCH_REMEDY = "for a batch of sequences use jax.vmap"


def checked_array(name: str, value: Any, shape: tuple[int, ...], config: FilterConfig) -> jax.Array:
    """`value` as a JAX array of this shape and of the precision that `config` asks for."""
    value = on_device(value)
    if value.shape != shape:
        raise ValueError(f"{name}: the shape must be {shape}, found {value.shape}; {BATCH_REMEDY}")
    single = value.dtype == jnp.float32
    if value.dtype == jnp.float64 or (single and config.allow_float32):
        return value
    remedy = "call jax.config.update('jax_enable_x64', True) first"
    if jax.config.read("jax_enable_x64"):
        remedy = "cast it"
    if single:
        remedy += ", or ask for FilterConfig(allow_float32=True)"
    raise ValueError(f"{name}: the filter runs in float64, found {value.dtype}; {remedy}")


def on_device(value: Any) -> jax.Array:
    """`value` as a JAX array, which shares no memory with it. `jnp.asarray` would compile a program
    for each shape of NumPy's arrays."""
    if isinstance(value, np.ndarray):
        return jax.device_put(np.array(value))
    return jnp.asarray(value)


def check_finite(name: str, value: jax.Array, remedy: str = "") -> None:
    """Refuse rows that are not finite, naming the first."""
    if isinstance(value, Tracer):
        return
    bad = ~np.isfinite(np.asarray(value)).reshape(len(value), -1).all(1)
    if bad.any():
        problem = f"{bad.sum()} of {len(bad)} rows are not finite, the first is row {bad.argmax()}"
        raise ValueError(f"{name}: {problem}" + (f"; {remedy}" if remedy else ""))


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


def check_positive(name: str, value: jax.Array) -> None:
    """Refuse rows with a number that is zero or negative, naming the first; NaN passes."""
    if isinstance(value, Tracer):
        return
    bad = (np.asarray(value) <= 0).reshape(len(value), -1).any(1)
    if bad.any():
        problem = f"{bad.sum()} of {len(bad)} rows are not positive"
        raise ValueError(f"{name}: {problem}, the first is row {bad.argmax()}")


def check_correlation(name: str, errors: CorrelatedError) -> None:
    """Refuse a share of a window's error that is all of it, and a time that is zero."""
    share, seconds = errors
    if not isinstance(seconds, Tracer) and not float(seconds) > 0:
        raise ValueError(f"{name}.seconds: must be positive, found {float(seconds)}")
    if not isinstance(share, Tracer) and not float(share) < 1:
        raise ValueError(f"{name}.share: must be below 1, found {float(share)}")


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
    if bad.any():
        raise ValueError(
            f"{name}: {bad.sum()} of {len(bad)} are not symmetric and positive definite, "
            f"the first is row {bad.argmax()}"
        )
