"""Rows of several sensors that come in batches, as apps for phones send them: samples at the stamps
of the gyro, with the accelerometer interpolated linearly."""

from __future__ import annotations

import bisect
import math
import statistics
from collections.abc import Iterator

import numpy as np

from gnio_jax.apps.live.pairing import LONGEST_WAIT, ROUNDING
from gnio_jax.apps.live.samples import MISSING, SI, Sample, Units, Vector, sample_of
from gnio_jax.numerics import interpolate

PARTS = (("accel",), ("linear", "gravity"), ("raw",))
"""Kinds of rows that add up to the accelerometer's reading, the best ones first, by the names of an
import: accel (with gravity), linear (without) and gravity, raw (with gravity)."""
PATIENCE = 2.0
"""A sensor that is behind the gyro by more is not waited for, s (ours)."""
RESTART = 1.0
"""A batch of the gyro that is behind the last sample by more begins anew, s (ours): the clock was
set back."""
LONGEST_BATCH, MOST_ROWS = 60.0, 100_000
"""Rows of a batch that are further from its middle, s, have wrong stamps; number of rows of a
sensor that wait, at most (ours)."""


class Batches:
    """The rows of all sensors that wait for those of the others."""

    def __init__(self, stated: Units = SI):
        self._stated = stated
        self._rows: dict[str, list[tuple[float, Vector]]] = {}
        self._kinds = set[str]()
        """Kinds of rows that have come."""
        self._last = -math.inf
        """Stamp of the last sample, s."""

    @property
    def parts(self) -> tuple[str, ...]:
        """Kinds of which the accelerometer's reading is the sum; empty if some are missing."""
        for parts in PARTS:
            if self._kinds & set(parts):
                return parts if self._kinds >= set(parts) else ()
        return ()

    def add(self, kind: str, rows: list[tuple[float, Vector]]) -> int:
        """Add rows (stamp in s, values) of a sensor, in any order, and return the number of those
        that are left out, because their stamps are far from the others."""
        middle = statistics.median_low(stamp for stamp, _ in rows)
        near = [row for row in rows if abs(row[0] - middle) <= LONGEST_BATCH]
        if kind == "gyro" and max(near)[0] < self._last - RESTART:
            for waiting in self._rows.values():
                waiting.clear()
            self._last = -math.inf
        self._kinds.add(kind)
        waiting = self._rows.setdefault(kind, [])
        waiting += near
        waiting.sort()
        del waiting[:-MOST_ROWS]
        return len(rows) - len(near)

    def samples(self) -> Iterator[Sample | str]:
        """The samples up to the newest stamp that all sensors have reached, or the reason why a row
        is refused. A sensor that is `PATIENCE` behind is missing in them."""
        gyro, parts = self._rows.get("gyro", []), self.parts
        needed = [self._rows[kind] for kind in parts]
        if not gyro and needed and needed[0]:
            count = self._before(needed[0], needed[0][-1][0] - PATIENCE)
            silent = [Sample(stamp, MISSING, force) for stamp, force in needed[0][:count]]
            del needed[0][:count]
            self._last = max([self._last, *(sample.time for sample in silent)])
            yield from silent
        if not gyro:
            return
        newest = min((rows[-1][0] if rows else -math.inf for rows in needed), default=math.inf)
        count = self._before(gyro, max(newest, gyro[-1][0] - PATIENCE))
        leaving = gyro[:count]
        del gyro[:count]
        accel = self._accelerations(np.array([stamp for stamp, _ in leaving]), parts)
        for (stamp, rate), force in zip(leaving, accel, strict=True):
            if stamp <= self._last:
                words = "twice" if stamp == self._last else "too late"
                yield f"time: must increase, found {stamp!r} after {self._last!r}: it came {words}"
                continue
            self._last = stamp
            sample = sample_of(stamp, rate, force, self._stated)
            yield sample or "is not a sample: its values are beyond the range of an IMU"
        for rows in needed:
            del rows[: max(self._before(rows, self._last) - 1, 0)]

    @staticmethod
    def _before(rows: list[tuple[float, Vector]], stamp: float) -> int:
        """Number of rows up to a stamp."""
        return bisect.bisect_right(rows, stamp, key=lambda row: row[0])

    def _accelerations(self, time: np.ndarray, parts: tuple[str, ...]) -> list[Vector]:
        """The accelerometer's reading at some stamps, missing between readings that are too far
        apart."""
        total, is_known = np.zeros((len(time), 3)), np.full(len(time), bool(parts))
        for kind in parts:
            stamps = np.array([stamp for stamp, _ in self._rows[kind]])
            if not len(stamps):
                return [MISSING] * len(time)
            values = np.array([vector for _, vector in self._rows[kind]])
            total += interpolate(time, stamps, values)
            after = np.searchsorted(stamps, time).clip(0, len(stamps) - 1)
            before = (np.searchsorted(stamps, time, side="right") - 1).clip(0)
            is_known &= (stamps[before] <= time) & (time <= stamps[after])
            is_known &= stamps[after] - stamps[before] <= LONGEST_WAIT + ROUNDING
        rows = zip(total.tolist(), is_known.tolist(), strict=True)
        return [(x, y, z) if valid else MISSING for (x, y, z), valid in rows]
