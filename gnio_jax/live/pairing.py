"""Streams whose gyro and accelerometer have rows of their own, as many phones send them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from gnio_jax.live.samples import Sample

LONGEST_WAIT = 0.1
"""s that a row of the gyro waits for the accelerometer or comes after it, and between two rows of
the accelerometer that are interpolated (ours)."""


ROUNDING = 1e-6
"""s by which differences of stamps may be off: Unix time in float64 has steps of 2e-7 s."""


class Reading(NamedTuple):
    """Of the accelerometer."""

    time: float
    """s."""
    accel: tuple[float, float, float]
    """m/s²."""


def paired(samples: Iterable[Sample | None]) -> Iterator[Sample | None]:
    """Samples at the stamps of the gyro, with the accelerometer interpolated by a line where a row
    has none.

    A row that has every value of one sensor and none of the other is a reading of that sensor
    alone. One of the gyro gets the accelerometer if readings at most `LONGEST_WAIT` apart enclose
    it. It waits for the later one until a stamp is so far from its own, and so do the rows after
    it; then it stays without. One of the accelerometer makes no sample while the gyro is read: it
    comes through where the gyro has been silent for longer, so that time passes. A stamp that is
    not later than the one before of its sensor is None, which is no sample. Other rows come through
    as they are, and None does.
    """
    waiting: deque[Sample] = deque()
    readings: deque[Reading] = deque()
    newest = math.nan  # stamp of the newest row that is more than a reading of the accelerometer
    for sample in samples:
        if sample is None:
            yield None
            continue
        if math.isnan(newest):
            newest = sample.time
        read = _is_whole(sample.accel) and _keep(readings, Reading(sample.time, sample.accel))
        yield from _ready(waiting, readings, sample.time)
        if _is_whole(sample.accel) and _is_missing(sample.gyro):
            if not read:
                yield None
            elif len(readings) > 1 and readings[-2].time > newest + LONGEST_WAIT:
                yield sample  # two readings say so: one stamp may be wrong
        elif _waits(sample) and waiting and sample.time <= waiting[-1].time:
            yield None
        else:
            newest = sample.time
            waiting.append(sample)
            yield from _ready(waiting, readings, sample.time)
    yield from waiting


def _keep(readings: deque[Reading], reading: Reading) -> bool:
    """Add a reading to those of the last moments; False where it comes late or twice. One that is
    far behind the newest starts anew: the clock was set, or the stamp of the newest was wrong."""
    if readings and reading.time <= readings[-1].time:
        if readings[-1].time - reading.time <= LONGEST_WAIT:
            return False
        readings.clear()
    readings.append(reading)
    # A row of the gyro may come LONGEST_WAIT late, and lie in an interval as long.
    while len(readings) > 2 and readings[1].time < reading.time - 2 * LONGEST_WAIT:
        readings.popleft()
    return True


def _ready(waiting: deque[Sample], readings: deque[Reading], now: float) -> Iterator[Sample]:
    """The first rows that need not wait any longer at the stamp `now`; they leave `waiting`."""
    while waiting:
        row = _with_accelerometer(waiting[0], readings)
        if row is None:
            if abs(now - waiting[0].time) <= LONGEST_WAIT + ROUNDING:
                return
            row = waiting[0]
        waiting.popleft()
        yield row


def _with_accelerometer(sample: Sample, readings: deque[Reading]) -> Sample | None:
    """A row with the accelerometer between two readings; as it is where it has one or gets none;
    None where it was not read yet."""
    if not _waits(sample):
        return sample
    before = after = None
    for reading in reversed(readings):
        if reading.time < sample.time:
            before = reading
            break
        after = reading
    if after is None:
        return None
    if after.time == sample.time:
        return sample._replace(accel=after.accel)
    if before is None or after.time - before.time > LONGEST_WAIT + ROUNDING:
        return sample
    share = (sample.time - before.time) / (after.time - before.time)
    first, last = np.asarray(before.accel), np.asarray(after.accel)
    x, y, z = (first + share * (last - first)).tolist()
    return sample._replace(accel=(x, y, z))


def _waits(sample: Sample) -> bool:
    """Whether a row is a reading of the gyro alone."""
    return _is_whole(sample.gyro) and _is_missing(sample.accel)


def _is_whole(values: tuple[float, float, float]) -> bool:
    return all(map(math.isfinite, values))


def _is_missing(values: tuple[float, float, float]) -> bool:
    return all(map(math.isnan, values))
