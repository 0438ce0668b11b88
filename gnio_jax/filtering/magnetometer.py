"""The heading from a magnetometer as a measurement (ours): the horizontal direction of the earth's
field stays as it is.

With the field m in the body, without the phone's own field, and h = R m, the azimuth of h is that
of the world's field,

    α_0 = atan2(h_y, h_x) + w,   w ~ N(0, σ²).

The field of a building differs from the earth's for metres, so w is the same for many intervals,
and σ must be several times its size. Where strength or dip of the field are not those of the
beginning, there is no measurement.

The world's yaw is that of the filter's start, so α_0 is the direction at the beginning, and not the
north. `magnetometer_on_intervals` fits it there, with the phone's own field (hard iron).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.errors import InputError
from gnio_jax.filtering.readings import (
    ONE_DEGREE,
    finite_readings,
    interval_ends,
    readings_at,
)
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import FilterState
from gnio_jax.filtering.update import Correction, Outcome, Step, linearise, measure
from gnio_jax.geometry import matmul
from gnio_jax.types import Array

STRENGTH_RATIO = 1.25
"""Largest ratio of the strength of a field to that of the beginning, and of its inverse."""
LARGEST_DIP = np.radians(15.0)
"""Largest difference of the dip from that of the beginning, rad."""
LEAST_LEVEL = 5.0
"""Horizontal field below which there is no heading, µT. The earth's is 15 to 40 µT but for the
polar regions."""
FIELDS = 15.0, 150.0
"""Strengths of which the median of a recording must be, µT: the earth's is 22 to 67 µT, and the
phone's own field may be as large."""
IRON_STD, FIELD_STD = 30.0, 2.0
"""Standard deviations of a component of the phone's own field and of a reading, µT."""


class Magnetometer(NamedTuple):
    """A row for each of K clone intervals: an entry of `measurements` of a run."""

    field: Float[Array, "*k 3"]
    """Field in the body at the end of the interval, without the phone's own, µT; NaN: none."""
    direction: Float[Array, "*k"]
    """α_0, the azimuth of the world's field, from x counter-clockwise, rad."""
    strength: Float[Array, "*k"]
    """Strength of the world's field, µT."""
    dip: Float[Array, "*k"]
    """Angle of the world's field below the horizontal, rad."""
    std: Float[Array, "*k"]
    """σ, rad."""
    name = "magnetometer"

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]:
        """The azimuth turns with the world as δθ_z does, so its Jacobian does not depend on the
        estimate of any position, and the update is that of a measurement in the carrier's frame."""
        dtype = state.offset.dtype
        magnet = [jnp.asarray(part, dtype) for part in self]
        present = jnp.isfinite(jnp.stack([*magnet[0], *magnet[1:]])).all()
        # No NaN may enter the arithmetic, because otherwise the derivatives would be NaN too.
        field, direction, strength, dip, std = (jnp.where(present, part, 1.0) for part in magnet)
        x, y, z = matmul(state.rotation, field[:, None])[:, 0]
        level = jnp.sqrt(jnp.maximum(x**2 + y**2, 1e-12))
        size = jnp.sqrt(level**2 + z**2)
        usual = (size < STRENGTH_RATIO * strength) & (STRENGTH_RATIO * size > strength)
        usual = usual & (jnp.abs(jnp.arctan2(-z, level) - dip) < LARGEST_DIP)
        present = present & usual & (level > LEAST_LEVEL) & (std > 0)
        # A safe branch for the derivative of atan2 where the field is vertical.
        x, y = (jnp.where(present, part, safe) for part, safe in ((x, 1.0), (y, 0.0)))
        difference = direction - jnp.arctan2(y, x)
        residual = jnp.arctan2(jnp.sin(difference), jnp.cos(difference))
        squared = jnp.where(present, level**2, 1.0)
        turn = jnp.stack([-x * z / squared, -y * z / squared, jnp.ones_like(z)])
        linear = linearise(
            state,
            jnp.where(present, residual, jnp.nan)[None],
            jnp.where(present, std**2, 1.0)[None, None],
            rotation=turn[None],
        )
        return measure(state, linear, step, ONE_DEGREE)


def magnetometer_on_intervals(
    time: Any,
    field: Any,
    rotation: Any,
    config: FilterConfig,
    start: float = 0.0,
    std: float = 0.3,
    first_seconds: float = 30.0,
) -> Magnetometer:
    """Readings of a magnetometer as a row for each clone interval.

    The world's field h and the phone's own b are the least-squares solution of m_t = b + R_tᵀ h
    over the first seconds, with the prior b ~ N(0, `IRON_STD`²). If the phone turns only about the
    vertical, the vertical part of b is not known, and has no effect.

    Args:
        time: (f,) increasing stamps, s, on the clock of `start`.
        field: (f, 3) readings in the body, µT. Those that are not finite are none.
        rotation: (K, 3, 3) attitudes at the ends of the intervals, of a run without a magnetometer.
        config: The settings of the filter, for the length of an interval.
        start: Stamp of the first IMU sample, s.
        std: Standard deviation σ of the direction, rad, with its correlation in time.
        first_seconds: Length of the beginning, s, in which the gyro has not yet drifted.

    Raises:
        InputError: Shapes do not fit, the unit is not µT, stamps do not increase, or hardly any
            reading is within the recording.
    """
    time, field, rotation = (np.asarray(part, np.float64) for part in (time, field, rotation))
    if time.ndim != 1 or field.shape != (len(time), 3) or rotation.shape[1:] != (3, 3):
        shapes = f"found {time.shape}, {field.shape} and {rotation.shape}"
        problem = "time, field and rotation must be (f,), (f, 3) and (K, 3, 3)"
        raise InputError("magnetometer", f"{problem}, {shapes}", "pass one row for each stamp")
    time, field = finite_readings("magnetometer", time, field)
    ends = interval_ends(len(rotation), config, start)
    at_ends = readings_at(ends, time, field)
    present = np.isfinite(at_ends[:, 0])
    first = present & (ends <= start + first_seconds)
    if first.sum() < 10:
        problem = f"time: only {first.sum()} of the first {first_seconds:g} s have a reading"
        raise InputError("magnetometer", problem, "give it stamps on the clock of the IMU")
    strength = float(np.median(np.linalg.norm(field, axis=1)))
    if not FIELDS[0] <= strength <= FIELDS[1]:
        factor = next((f for f in (100, 1e6, 1e-3, 1e-1) if 20 <= f * strength <= 70), None)
        remedy = f"multiply by {factor:g}" if factor else "leave it out"
        problem = f"field: the median strength is {strength:.3g} µT, and the earth's is 22 to 67"
        raise InputError("magnetometer", problem, remedy)
    back = np.swapaxes(rotation[first], 1, 2).reshape(-1, 3)
    rows = np.concatenate([np.tile(np.eye(3), (first.sum(), 1)), back], axis=1) / FIELD_STD
    prior = np.diag(np.repeat([1 / IRON_STD, 1e-6], 3))
    rows = np.concatenate([rows, prior])
    values = np.concatenate([at_ends[first].ravel() / FIELD_STD, np.zeros(6)])
    iron, world = np.split(np.linalg.lstsq(rows, values)[0], 2)
    intervals = np.ones(len(rotation))
    return Magnetometer(
        at_ends - iron,
        np.arctan2(world[1], world[0]) * intervals,
        np.linalg.norm(world) * intervals,
        np.arctan2(-world[2], np.hypot(world[0], world[1])) * intervals,
        std * intervals,
    )
