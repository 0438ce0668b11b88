"""Readings of a sensor beside the IMU, at the ends of the clone intervals (ours)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gnio_jax.config.schema import Bound
from gnio_jax.errors import InputError
from gnio_jax.filtering.settings import FilterConfig

LONGEST_STEP = 0.5
"""Time between readings beyond which none is interpolated, s."""
ONE_DEGREE = 6.635
"""99 % of χ² with one degree of freedom."""


def check_numbers(sensor: str, limit: Bound, **numbers: float) -> None:
    """Raises `InputError` naming the sensor for the first number beyond the limit: in its rows it
    would mean that there is no measurement."""
    for name, number in numbers.items():
        if not limit.holds(number):
            raise InputError(sensor, f"{name}: found {number:g}", f"it {limit.problem}")


def interval_ends(
    sensor: str, intervals: int, config: FilterConfig, start: float
) -> Float[np.ndarray, "k"]:
    """Stamps of the ends of the clone intervals, s; `start` is that of the first IMU sample. Raises
    `InputError` naming the sensor if there is no interval, or if one of the two is something
    else."""
    if not isinstance(config, FilterConfig):
        problem = f"config: must be a FilterConfig, found {type(config).__name__}"
        raise InputError(sensor, problem, "give ekf.config")
    if not isinstance(intervals, int | np.integer) or not intervals > 0:
        remedy = "give the number of clone intervals of the run, at least 1"
        raise InputError(sensor, f"intervals: found {intervals}", remedy)
    return start + config.clone_seconds * np.arange(1, intervals + 1)


def finite_readings(
    sensor: str, time: Float[np.ndarray, "f"], values: Float[np.ndarray, "f *w"]
) -> tuple[Float[np.ndarray, "g"], Float[np.ndarray, "g *w"]]:
    """The readings that are finite. Raises `InputError` naming the sensor if their stamps do not
    increase."""
    finite = np.isfinite(time) & np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    if not (np.diff(time[finite]) > 0).all():
        raise InputError(sensor, "time: does not increase", "sort its rows by their stamps")
    return time[finite], values[finite]


def scalars_at(
    sensor: str,
    ends: Float[np.ndarray, "k"],
    time: Float[np.ndarray, "f"],
    values: Float[np.ndarray, "f"],
    start: float,
    longest: float = LONGEST_STEP,
) -> Float[np.ndarray, "k"]:
    """`readings_at` of one number each. Raises `InputError` naming the sensor if none is within the
    recording."""
    at_ends = readings_at(ends, time, values[:, None], longest)[:, 0]
    if not np.isfinite(at_ends).any():
        inside = np.flatnonzero((time >= start) & (time <= ends[-1]))
        if len(inside) > 1:
            problem = f"time: its stamps are more than {longest:g} s apart"
            raise InputError(sensor, problem, "record it more often, or leave it out")
        problem = f"time: no two stamps are within the {ends[-1] - start:.4g} s of the IMU"
        raise InputError(sensor, problem, "give it stamps on the clock of the IMU")
    return at_ends


def readings_at(
    ends: Float[np.ndarray, "k"],
    time: Float[np.ndarray, "f"],
    values: Float[np.ndarray, "f w"],
    longest: float = LONGEST_STEP,
) -> Float[np.ndarray, "k w"]:
    """Readings between two stamps by lines; NaN outside of them, and where the stamps on both sides
    are more than `longest` (s) apart."""
    if len(time) < 2:
        return np.full((len(ends), values.shape[1]), np.nan)
    after = np.clip(np.searchsorted(time, ends), 1, len(time) - 1)
    near = (time[after] - time[after - 1] <= longest) & (time[0] <= ends) & (ends <= time[-1])
    lines = np.stack([np.interp(ends, time, column) for column in values.T], axis=1)
    return np.where(near[:, None], lines, np.nan)
