"""The filter's clock: samples with irregular stamps, brought to a uniform grid as they come."""

from __future__ import annotations

import math
from typing import NamedTuple

from gnio_jax.filtering.intake import rounding

MISSING = (math.nan,) * 6 + (0.0,)
"""A grid sample that is missing."""

GridSample = tuple[float, ...]
"""gyro rad/s, accel m/s², and 1, or 0 where it is missing."""


class Clock(NamedTuple):
    """Where resampling stands: sample `count` of the grid, at origin + count·dt, is the next to
    come."""

    origin: float
    """Stamp of the first sample, s."""
    count: int
    """Grid samples so far."""
    newest: float
    """The newest stamp, s."""
    stamp: float
    """The newest stamp of a sample that was not missing, s; −inf before there was one."""
    sample: tuple[float, ...]
    """That sample: gyro rad/s, accel m/s²."""


def advance_clock(
    clock: Clock | None, time: float, sample: tuple[float, ...], dt: float, hole: float
) -> tuple[Clock, list[GridSample]]:
    """The clock after one sample (gyro, accel; any NaN: missing), and the grid samples that are
    known now.

    Causal linear interpolation between the sample and the last that was there. Grid samples
    strictly between two that are more than `hole` seconds apart are missing. A missing sample says
    that time goes by: what no later sample can fill any more is missing at once.
    """
    if clock is None:
        clock = Clock(time, 0, -math.inf, -math.inf, (math.nan,) * 6)
    slack = rounding(dt, time, clock.origin)
    elapsed, count, rows = time - clock.origin, clock.count, []
    present = all(map(math.isfinite, sample))
    too_far = time - clock.stamp > hole
    if not present and not too_far:
        return clock._replace(newest=time), rows
    before = clock.stamp - clock.origin
    while (target := count * dt) <= elapsed + slack:
        if present and target >= elapsed - slack:
            rows.append((*sample, 1.0))
        elif too_far:
            rows.append(MISSING)
        else:
            share = (target - before) / (elapsed - before)
            rows.append((*_between(clock.sample, sample, share), 1.0))
        count += 1
    clock = clock._replace(count=count, newest=time)
    return (clock._replace(stamp=time, sample=sample) if present else clock), rows


def _between(
    before: tuple[float, ...], after: tuple[float, ...], share: float
) -> tuple[float, ...]:
    return tuple(a + share * (b - a) for a, b in zip(before, after, strict=True))
