"""Streams for `gnio live`: a known walk after a rest, as lines and as arrivals."""

import itertools

import numpy as np

from gnio_jax.apps.live.samples import MISSING, Arrival, Sample, parse_line
from tests.support import known_walk

RATE = 50.0
SPIN, PULL = (0.1, 0.2, 0.3), (0.0, 1.0, 9.8)
STILL = "0,0,0,0,0,9.81"
"""Values of a line at rest."""


def walked(rate=RATE, seconds=5.0):
    """(time, gyro, accel) of a second of rest and four of walking."""
    time = np.arange(0, seconds, 1 / rate)
    gyro, accel = known_walk.rate(time), known_walk.force(time)
    still = time < 1.0
    down = known_walk.force(np.array([1.0]))
    gyro[still], accel[still] = 0.0, 9.81 * down / np.linalg.norm(down)
    return time, gyro, accel


def as_lines(recorded):
    rows = np.column_stack(recorded).tolist()
    return [",".join(map(repr, row)) for row in rows]


def gyro(time, values=SPIN):
    return Sample(time, values, MISSING)


def accel(time, values=PULL):
    return Sample(time, MISSING, values)


def by_stamp(*rows):
    return sorted(itertools.chain(*rows), key=lambda row: row.time)


def arrivals(samples, clocks=None):
    """As they come from a source; None stands for a line that is none."""
    clocks = itertools.repeat(0.0) if clocks is None else map(float, clocks)
    for sample, clock in zip(samples, clocks, strict=False):
        yield (
            Arrival(clock, refusal="is not a sample") if sample is None else Arrival(clock, sample)
        )


def of_lines(lines, clocks=None):
    return arrivals(map(parse_line, lines), clocks)


def samples_of(stage):
    return [arrival.sample for arrival in stage if arrival.sample is not None]


def texts_of(stage, kind="notice"):
    return [text for arrival in stage if (text := getattr(arrival, kind))]
