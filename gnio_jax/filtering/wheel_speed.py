"""The speed of a car's wheels as a measurement (ours): the velocity of a point of the car along its
axis ahead.

With the axis ahead a and the lever l from the IMU to the point, both in the body,

    s = aᵀ (Rᵀ v + (ω − b_g) × l) + w,   w ~ N(0, σ²).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.config.schema import ABOVE_ZERO, FINITE
from gnio_jax.errors import InputError
from gnio_jax.filtering.nonholonomic import NonHolonomic, car_axes, velocity_of_point
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
from gnio_jax.geometry import hat, matmul
from gnio_jax.types import Array

FASTEST_CAR = 100.0
"""m/s."""


class WheelSpeed(NamedTuple):
    """A row for each of K clone intervals: an entry of `measurements` of a run."""

    speed: Float[Array, "*k"]
    """s at the end of the interval, m/s, negative backwards; NaN: none."""
    std: Float[Array, "*k"]
    """σ, m/s."""
    ahead: Float[Array, "*k 3"]
    """a, a unit vector in the body."""
    lever: Float[Array, "*k 3"]
    """l, m."""
    name = "wheel_speed"

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]:
        dtype = state.offset.dtype
        row = [jnp.asarray(part, dtype) for part in self]
        present = jnp.isfinite(jnp.hstack(row)).all() & (row[1] > 0)
        # No NaN may enter the arithmetic, because otherwise the derivatives would be NaN too.
        speed, std, ahead, lever = (jnp.where(present, part, 1.0) for part in row)
        ahead = ahead[None]
        velocity, measured = velocity_of_point(state, step, lever)
        residual = speed - matmul(ahead, velocity[:, None])[0, 0]
        of_velocity = matmul(ahead, state.rotation.T)
        linear = linearise(
            state,
            jnp.where(present & measured, residual, jnp.nan)[None],
            (std**2)[None, None],
            velocity=of_velocity,
            rotation=matmul(of_velocity, hat(state.velocity)),
            gyro_bias=matmul(ahead, hat(lever)),
        )
        return measure(state, linear, step, ONE_DEGREE)


def speeds_on_intervals(
    time: Any,
    speed: Any,
    intervals: int,
    config: FilterConfig,
    mounting: NonHolonomic,
    start: float = 0.0,
    std: float = 0.3,
) -> WheelSpeed:
    """Readings of the wheels' speed as a row for each clone interval.

    Args:
        time: (f,) increasing stamps, s, on the clock of `start`.
        speed: (f,) m/s. Those that are not finite are none.
        intervals: Number K of clone intervals.
        config: The settings of the filter, for the length of an interval.
        mounting: The constraint of the same car, for its angles and its lever. What the filter
            finds of their errors is not used here.
        start: Stamp of the first IMU sample, s.
        std: Standard deviation, m/s, with the slip and the radius of the wheels, whose errors last.

    Raises:
        InputError: Shapes do not fit, no car is so fast, stamps do not increase, no reading is
            within the recording, `std` is not above 0, or `mounting` is no `NonHolonomic` or has a
            number that is not finite.
    """
    time, speed = np.asarray(time, np.float64), np.asarray(speed, np.float64)
    if time.ndim != 1 or speed.shape != time.shape:
        problem = f"time and speed must be (f,), found {time.shape} and {speed.shape}"
        raise InputError("wheel speed", problem, "pass one speed for each stamp")
    if not isinstance(mounting, NonHolonomic):
        problem = f"mounting: must be a NonHolonomic, found {type(mounting).__name__}"
        remedy = "write NonHolonomic(yaw=mounting.yaw, pitch=mounting.pitch, roll=mounting.roll)"
        raise InputError("wheel speed", problem, remedy)
    check_numbers("wheel speed", ABOVE_ZERO, std=std)
    numbers = {name: value for name, value in mounting._asdict().items() if value is not None}
    check_numbers("wheel speed", FINITE, **numbers)
    time, speed = finite_readings("wheel speed", time, speed)
    ends = interval_ends("wheel speed", intervals, config, start)
    at_ends = scalars_at("wheel speed", ends, time, speed, start)
    if not (fastest := np.abs(speed).max()) <= FASTEST_CAR:
        problem = f"speed: {fastest:.4g} m/s is beyond a car"
        raise InputError("wheel speed", problem, "divide km/h by 3.6")
    ahead = np.asarray(car_axes(mounting.yaw, mounting.pitch, mounting.roll))[0]
    rows = (np.tile(vector, (intervals, 1)) for vector in (ahead, np.array(mounting.lever)))
    return WheelSpeed(at_ends, np.full(intervals, float(std)), *rows)
