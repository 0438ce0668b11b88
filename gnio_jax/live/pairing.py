"""Streams whose gyro and accelerometer have rows of their own, as many phones send them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from gnio_jax.live.samples import Sample

LONGEST_WAIT = 0.1
"""s: a row of the gyro waits so long for the accelerometer, and may come so late after it. Two rows
of the accelerometer are interpolated if they are no further apart (ours)."""
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
    alone. One of the gyro gets the accelerometer if two readings of it enclose the stamp, at most
    `LONGEST_WAIT` apart. It waits for the later one until a row's stamp is `LONGEST_WAIT` away;
    then it comes without the accelerometer. Rows after it wait behind it. One of the accelerometer
    makes no sample, nor does an empty row once the gyro has rows of its own. Where the gyro is
    silent for longer than `LONGEST_WAIT`, they come through, so late that no row of the gyro is
    still expected: time passes. None, which is no sample, stands for a stamp of the accelerometer
    that is not later than the one before, and for one that is not later than a row that waits.
    Other rows come through as they are, and None does.
    """
    waiting: deque[Sample] = deque()
    readings: deque[Reading] = deque()
    quiet: deque[Sample] = deque()  # rows without the gyro
    newest = math.nan  # stamp of the newest row with it, or where the stream began
    apart = False
    for sample in samples:
        if sample is None:
            yield None
            continue
        if math.isnan(newest):
            newest = sample.time
        alone = _is_missing(sample.gyro)
        apart = apart or _waits(sample)
        late = False
        if _is_whole(sample.accel):
            if readings and readings[-1].time - sample.time > LONGEST_WAIT:
                # The clock was set back, or the newest stamp was wrong: begin anew.
                readings.clear()
                newest = min(newest, sample.time)
            late = not _keep(readings, Reading(sample.time, sample.accel))
        yield from _ready(waiting, readings, sample.time)
        yield from _passing(quiet, newest, sample.time)
        if alone and (_is_whole(sample.accel) or (apart and _is_missing(sample.accel))):
            if late:
                yield None
            elif not quiet or sample.time > quiet[-1].time:
                quiet.append(sample)
        elif waiting and sample.time <= waiting[-1].time:
            yield None
        else:
            newest = sample.time
            waiting.append(sample)
            yield from _ready(waiting, readings, sample.time)
    yield from waiting


def _passing(quiet: deque[Sample], newest: float, now: float) -> Iterator[Sample]:
    """The rows without the gyro that show at the stamp `now` that it is silent since `newest`. All
    that are as old leave `quiet`, and so do those whose stamps are too far ahead."""
    while quiet and abs(now - quiet[0].time) > LONGEST_WAIT:
        row = quiet.popleft()
        if newest + LONGEST_WAIT < row.time < now:
            yield row


def _keep(readings: deque[Reading], reading: Reading) -> bool:
    """Add a reading to those of the last moments; False where it comes late or twice."""
    if readings and reading.time <= readings[-1].time:
        return False
    readings.append(reading)
    # A row of the gyro may come LONGEST_WAIT late, and lie in an interval as long.
    while len(readings) > 2 and readings[1].time < reading.time - 2 * LONGEST_WAIT:
        readings.popleft()
    return True


def _ready(waiting: deque[Sample], readings: deque[Reading], now: float) -> Iterator[Sample]:
    """Rows at the head of `waiting` that are complete, or that no reading can complete any more
    when the stamp is `now`; they leave it."""
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
