"""Samples in the order of their stamps, with both sensors at once.

Networks deliver late, and many phones send each sensor in its own rows. All times are ours.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator

from gnio_jax.apps.live.samples import Arrival, Sample, is_finite, is_missing

DISORDER = 0.05
"""Time that samples wait for late ones, s, by their stamps."""
LONGEST_WAIT = 0.1
"""The same if rows have one sensor alone. Two readings of the accelerometer are interpolated if
they are no further apart."""
ROUNDING = 1e-6
"""Error of differences of stamps, s: Unix time in float64 has steps of 2e-7 s."""
Held = tuple[float, int, Sample, float]
"""Stamp, number, sample and time of arrival of a row that waits."""


def in_order(arrivals: Iterator[Arrival]) -> Iterator[Arrival]:
    """The samples in the order of their stamps. Those of the gyro have the accelerometer
    interpolated linearly where a row has none.

    Rows wait for `DISORDER`, and for `LONGEST_WAIT` from the first row on that has one sensor
    alone. Such a row of the gyro gets the accelerometer from the readings around it. A row without
    the gyro makes no sample, except if there is no gyro for longer than `LONGEST_WAIT`: then it is
    passed on, so that time advances. A row that comes later than it is waited for, or twice, is
    refused.
    """
    held: list[Held] = []
    keys = set[tuple[float, bool, bool]]()
    """Stamps and sensors of the rows that wait."""
    newest = passed = -math.inf
    """The newest stamp that came, and that was passed on."""
    reading: Sample | None = None
    """The last row with the accelerometer that was passed on."""
    turned = math.nan
    """The last stamp of the gyro that was passed on, or the start of the stream."""
    is_split, number = False, 0

    def leaving(patience: float) -> Iterator[Arrival]:
        nonlocal reading, turned, passed
        while held and newest - held[0][0] > patience:
            passed, _, row, clock = heapq.heappop(held)
            keys.discard(_key(row))
            if not is_missing(row.gyro):
                turned = row.time
                yield Arrival(clock, _with_accelerometer(row, reading, held))
            elif not is_split or row.time - turned > LONGEST_WAIT:
                if not held or held[0][0] > row.time:
                    yield Arrival(clock, row)
            reading = row if is_finite(row.accel) else reading

    for arrival in arrivals:
        row = arrival.sample
        if row is None:
            yield arrival
            continue
        turned = row.time if math.isnan(turned) else turned
        if row.time <= passed or _key(row) in keys:
            words = "it came twice" if _key(row) in keys else f"{newest - row.time:.3g} s late"
            refusal = f"time: must increase, found {row.time!r} after {newest!r}: {words}"
            yield Arrival(arrival.clock, refusal=refusal)
            continue
        is_split = is_split or is_missing(row.gyro) != is_missing(row.accel)
        newest, number = max(newest, row.time), number + 1
        keys.add(_key(row))
        heapq.heappush(held, (row.time, number, row, arrival.clock))
        yield from leaving((LONGEST_WAIT if is_split else DISORDER) + ROUNDING)
    yield from leaving(-1.0)


def _key(row: Sample) -> tuple[float, bool, bool]:
    return row.time, is_missing(row.gyro), is_missing(row.accel)


def _with_accelerometer(row: Sample, before: Sample | None, held: list[Held]) -> Sample:
    """A row of the gyro with the accelerometer interpolated between the reading before and the next
    one that is held. The row is unchanged if it has the accelerometer, or if the readings do not
    enclose it."""
    if not is_missing(row.accel):
        return row
    if before is not None and before.time == row.time:
        return row._replace(accel=before.accel)
    after = min((entry for entry in held if is_finite(entry[2].accel)), default=None)
    if after is None:
        return row
    stamp, _, reading, _ = after
    if stamp == row.time:
        return row._replace(accel=reading.accel)
    if before is None or stamp - before.time > LONGEST_WAIT + ROUNDING:
        return row
    share = (row.time - before.time) / (stamp - before.time)
    x, y, z = (a + share * (b - a) for a, b in zip(before.accel, reading.accel, strict=True))
    return row._replace(accel=(x, y, z))
