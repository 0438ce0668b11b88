"""The units of a stream, which says nothing of itself: stated, or those of the package, and held
against gravity."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gnio_jax.data.parsing import units
from gnio_jax.errors import InputError
from gnio_jax.live.samples import Sample, Scale
from gnio_jax.live.sources import Source

FIRST_SAMPLES = 20
"""By which gravity tells the unit of the accelerometer; the device lies still (ours)."""
TURNING_SECONDS = 10.0
"""After which the turning of gravity is held against the gyro (ours)."""


def scale_of(gyro_unit: str | None, accel_unit: str | None) -> Scale:
    """rad/s and m/s² of one unit, of the names that an import knows; None: of the package's own."""
    return Scale(
        units.TO_RAD_PER_SECOND[gyro_unit or "rad/s"],
        units.TO_METRES_PER_SECOND_SQUARED[accel_unit or "m/s2"],
    )


def checked_units(source: Source) -> Source:
    """The same samples. Raises `InputError` on the way where the accelerometer of a device at rest
    does not read gravity, or the gyro does not turn it."""
    return Source(_checked(source), source.name)


def _checked(source: Source) -> Iterator[Sample | None]:
    kept: list[Sample] = []
    for sample in source.samples:
        yield sample
        if sample is None or not np.isfinite([*sample.gyro, *sample.accel]).all():
            continue
        kept.append(sample)
        if len(kept) == FIRST_SAMPLES:
            _check_gravity(kept, source.name)
        if sample.time - kept[0].time >= TURNING_SECONDS:
            units.check_rad_per_second(_joined(kept), Path(source.name))
            break
    yield from source.samples


def _check_gravity(samples: list[Sample], name: str) -> None:
    size = float(np.median(np.linalg.norm([sample.accel for sample in samples], axis=1)))
    ranges = units.GRAVITY_RANGES
    low, high = ranges["m/s2"]
    if low <= size <= high:
        return
    looks = [unit for unit, (least, most) in ranges.items() if least <= size <= most]
    problem = f"its accelerometer reads {size:.3g} m/s² at the start, and gravity is 9.81"
    known = ", ".join(units.TO_METRES_PER_SECOND_SQUARED)
    remedy = f"give --accel-unit {looks[0]}" if looks else f"give its --accel-unit: {known}"
    raise InputError(name, problem, f"{remedy}; gravity must be in it")


def _joined(samples: list[Sample]) -> units.Motion:
    """In order, as the check of a recording wants them."""
    rows = np.array([[sample.time, *sample.gyro, *sample.accel] for sample in samples])
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    time = rows[:, 0] - rows[0, 0]
    return units.Motion(time, rows[:, 1:4], rows[:, 4:7])
