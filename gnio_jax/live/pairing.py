"""Streams whose gyro and accelerometer have rows of their own, as many phones send them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from gnio_jax.live.samples import MISSING, Sample

LONGEST_WAIT = 0.1
"""s that a row of the gyro waits for the accelerometer, and between two rows of the accelerometer
that are interpolated (ours)."""


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
    alone. One of the gyro waits until the accelerometer has been read at its time or later, at most
    `LONGEST_WAIT`; then it stays without. One of the accelerometer makes no sample; it is None,
    which is no sample, where it is not later than the one before. Other rows come through as they
    are, and None does.
    """
    waiting: deque[Sample] = deque()
    before = Reading(-math.inf, MISSING)
    for sample in samples:
        if sample is None:
            yield None
            continue
        read, alone = _is_whole(sample.accel), _is_missing(sample.gyro)
        if read and alone and sample.time <= before.time:
            yield None
            continue
        if read:
            reading = Reading(sample.time, sample.accel)
            while waiting and waiting[0].time <= reading.time:
                yield _between(waiting.popleft(), before, reading)
            before = reading
            if alone:
                continue
        waits = _is_whole(sample.gyro) and _is_missing(sample.accel)
        while waiting and not (waits and waiting[0].time >= sample.time - LONGEST_WAIT):
            yield waiting.popleft()
        if waits:
            waiting.append(sample)
        else:
            yield sample
    yield from waiting


def _is_whole(values: tuple[float, float, float]) -> bool:
    return all(map(math.isfinite, values))


def _is_missing(values: tuple[float, float, float]) -> bool:
    return all(map(math.isnan, values))


def _between(sample: Sample, before: Reading, after: Reading) -> Sample:
    """A row of the gyro with the accelerometer between two readings; without, where they do not
    enclose it or are far apart."""
    apart = after.time - before.time
    if not before.time <= sample.time <= after.time or not 0 < apart <= LONGEST_WAIT:
        return sample
    share = (sample.time - before.time) / apart
    first, last = np.asarray(before.accel), np.asarray(after.accel)
    x, y, z = (first + share * (last - first)).tolist()
    return sample._replace(accel=(x, y, z))
