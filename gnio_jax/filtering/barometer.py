"""The height from a barometer as a measurement (ours).

Pressure p over the pressure p_0 at the start gives the height above the start in the standard
atmosphere,

    z = T_0/L (1 − (p / p_0)^(R L / g)) + w,   w ~ N(0, σ² + η² t).

p_0 is that of a line through the first pressures, because the carrier may climb in their time.
The weather, ventilation and doors move the offset of the height, which is a random walk η over the
time t since the start. The filter has no state for it: σ contains that an error of the offset
lasts, so the filter follows the barometer slowly. A jump of the pressure fails the χ² test.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.config.schema import ABOVE_ZERO, FINITE, NOT_NEGATIVE
from gnio_jax.errors import InputError
from gnio_jax.filtering.readings import (
    ONE_DEGREE,
    check_numbers,
    finite_readings,
    interval_ends,
    scalars_at,
)
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import FilterState
from gnio_jax.filtering.update import Correction, Outcome, Step, linearise, measure
from gnio_jax.types import Array

SCALE, EXPONENT = 288.15 / 0.0065, 287.053 * 0.0065 / 9.80665
"""T_0/L, m, and R L/g of the standard atmosphere (ISO 2533)."""
PRESSURES = 3.0e4, 1.1e5
"""Pressures on the earth's surface, Pa."""
LONGEST_STEP = 3.0
"""Time between pressures beyond which none is interpolated, s: iPhones give one a second."""
FIRST_SECONDS = 2.0
"""Time of the first pressures, through which a line shows p_0, s."""
LATEST = 5.0
"""Time after the start from which on the first pressure does not show p_0, s."""


class Barometer(NamedTuple):
    """A row for each of K clone intervals: an entry of `measurements` of a run."""

    height: Float[Array, "*k"]
    """Height above the start at the end of the interval, m; NaN: none."""
    std: Float[Array, "*k"]
    """Standard deviation, m."""
    start: Float[Array, "*k"]
    """Height of the start in the filter's world, m."""
    name = "barometer"

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]:
        dtype = state.offset.dtype
        height, std, start = (jnp.asarray(part, dtype) for part in self)
        sound = jnp.isfinite(height) & jnp.isfinite(std) & (std > 0) & jnp.isfinite(start)
        residual = jnp.where(sound, height + start, 0.0) - state.position[2]
        linear = linearise(
            state,
            jnp.where(sound, residual, jnp.nan)[None],
            jnp.where(sound, std**2, 1.0)[None, None],
            position=[[0.0, 0.0, 1.0]],
        )
        # The height is fixed to the world, but no yaw moves it. So the update needs neither the arc
        # of an uncertain yaw nor a second linearisation, for which frame="world" is.
        return measure(state, linear, step, ONE_DEGREE)


def barometer_on_intervals(
    time: Any,
    pressure: Any,
    intervals: int,
    config: FilterConfig,
    start: float = 0.0,
    std: float = 2.0,
    walk: float = 0.1,
    start_height: float = 0.0,
) -> Barometer:
    """Pressures as a row for each clone interval.

    The pressure p_0 at the start is that of a line through the rows of the first `FIRST_SECONDS`
    that have a pressure (Theil and Sen: the slope is the median of those of all pairs of rows, so
    single pressures that are wrong do not count). The line is also followed back to the start where
    the pressures begin up to `LATEST` s later. Later ones do not show the height of the start.

    Args:
        time: (f,) increasing stamps, s, on the clock of `start`.
        pressure: (f,) Pa. Those that are not finite are none.
        intervals: Number K of clone intervals.
        config: The settings of the filter, for the length of an interval.
        start: Stamp of the first IMU sample, s.
        std: Standard deviation σ of the height at the start, m, with its correlation in time.
        walk: Random walk η of the offset, m/√s.
        start_height: Height of the filter's start in its world, m.

    Raises:
        InputError: Shapes do not fit, the unit is not Pa, stamps do not increase, no pressure is
            within the recording, the pressures begin more than `LATEST` s after the start, or a
            number is impossible: `std` is not above 0, `walk` is below 0, or one is not finite.
    """
    time, pressure = np.asarray(time, np.float64), np.asarray(pressure, np.float64)
    if time.ndim != 1 or pressure.shape != time.shape:
        problem = f"time and pressure must be (f,), found {time.shape} and {pressure.shape}"
        raise InputError("barometer", problem, "pass one pressure for each stamp")
    check_numbers("barometer", ABOVE_ZERO, std=std)
    check_numbers("barometer", NOT_NEGATIVE, walk=walk)
    check_numbers("barometer", FINITE, start_height=start_height)
    time, pressure = finite_readings("barometer", time, pressure)
    ends = interval_ends("barometer", intervals, config, start)
    at_ends = scalars_at("barometer", ends, time, pressure, start, LONGEST_STEP)
    present = np.flatnonzero(np.isfinite(at_ends))
    middle = float(np.median(pressure))
    if not PRESSURES[0] <= middle <= PRESSURES[1]:
        factor = next((f for f in (100, 1e3, 1e5) if 8e4 <= f * middle <= 1.1e5), None)
        remedy = f"multiply by {factor:g}" if factor else "leave it out"
        problem = f"pressure: the median is {middle:.5g} Pa, expected 30000 to 110000"
        raise InputError("barometer", problem, remedy)
    if (delay := present[0] * config.clone_seconds) > LATEST:
        problem = f"time: begins {delay:.3g} s after the IMU and does not show the start's height"
        remedy = f"let it begin at most {LATEST:g} s after the IMU, or leave it out"
        raise InputError("barometer", problem, remedy)
    first = present[ends[present] <= ends[present[0]] + FIRST_SECONDS]
    seconds, pressures = ends[first] - start, at_ends[first]
    i, j = np.triu_indices(len(first), 1)
    slopes = (pressures[j] - pressures[i]) / (seconds[j] - seconds[i])
    slope = np.median(slopes) if len(slopes) else 0.0
    ratio = np.maximum(at_ends, 1.0) / np.median(pressures - slope * seconds)
    spread = np.sqrt(std**2 + walk**2 * (ends - start))
    return Barometer(SCALE * (1 - ratio**EXPONENT), spread, np.full(intervals, float(start_height)))
