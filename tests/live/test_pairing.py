"""Rows of one sensor alone."""

import math

import numpy as np
import pytest

from gnio_jax.live.pairing import LONGEST_WAIT, paired
from gnio_jax.live.samples import MISSING, Sample
from gnio_jax.live.sources import lines_of

SPIN, PULL = (0.1, 0.2, 0.3), (0.0, 1.0, 9.8)


def gyro(time, values=SPIN):
    return Sample(time, values, MISSING)


def accel(time, values=PULL):
    return Sample(time, MISSING, values)


def test_the_accelerometer_is_interpolated_at_the_stamps_of_the_gyro():
    """Two clocks, 100 and 60 Hz; rows as they were taken."""
    random = np.random.default_rng(2)
    turned, pulled = np.arange(0.02, 1.0, 0.01), np.arange(0.0, 1.02, 1 / 60)
    forces = random.normal(size=(len(pulled), 3))
    rows = [gyro(t, (t, 0.0, -t)) for t in turned]
    rows += [accel(t, tuple(f)) for t, f in zip(pulled, forces.tolist(), strict=True)]
    found = list(paired(sorted(rows, key=lambda row: row.time)))
    assert [sample.time for sample in found] == list(turned)
    assert [sample.gyro for sample in found] == [(t, 0.0, -t) for t in turned]
    for axis in range(3):
        wanted = np.interp(turned, pulled, forces[:, axis])
        np.testing.assert_allclose([sample.accel[axis] for sample in found], wanted, atol=1e-12)


def test_whole_rows_come_at_once_and_as_they_are():
    rows = [Sample(0.1 * k, SPIN, PULL) for k in range(3)]
    rows += [None, Sample(0.3, MISSING, MISSING), Sample(0.4, (math.nan, 0.0, 0.0), PULL)]
    taken = []

    def stream():
        for row in rows:
            yield row
            taken.append(len(given))

    given = []
    for sample in paired(stream()):
        given.append(sample)
    assert repr(given) == repr(rows)  # NaN is not NaN
    assert taken == list(range(1, len(rows) + 1))


def test_a_value_that_one_row_lacks_lies_between_its_neighbours():
    rows = [Sample(0.0, SPIN, (0.0, 0.0, 9.0)), gyro(0.01), Sample(0.02, SPIN, (0.0, 2.0, 10.0))]
    found = list(paired(rows))
    assert found[1].accel == pytest.approx((0.0, 1.0, 9.5)) and len(found) == 3


def test_without_the_accelerometer_the_gyro_waits_no_longer_than_it_must():
    """What it gets then is a gap."""
    rows = [gyro(0.02 * k) for k in range(10)]
    seen, given = [], paired(seen.append(row) or row for row in rows)
    assert next(given) == rows[0] and seen[-1].time <= 2 * LONGEST_WAIT
    assert [sample.time for sample in given] == [row.time for row in rows[1:]]
    # Readings that are far apart enclose nothing either.
    rows = [accel(0.0), gyro(0.05), accel(0.2), gyro(0.25), accel(0.29)]
    found = list(paired(rows))
    assert [np.isfinite(sample.accel).all() for sample in found] == [False, True]


def test_a_reading_that_comes_twice_or_late_is_no_sample():
    found = list(paired([accel(0.0), accel(0.0), gyro(0.01), accel(0.02), accel(0.01)]))
    assert [sample and sample.time for sample in found] == [None, 0.01, None]


def test_lines_of_either_sensor_make_a_stream():
    lines = [
        '{"time": 0, "accel": [0, 0, 9]}',
        '{"time": 0.01, "gyro": [1, 2, 3]}',
        "0.02,,,,0,0,10",
    ]
    found = list(lines_of(lines).samples)
    assert found == [Sample(0.01, (1.0, 2.0, 3.0), (0.0, 0.0, 9.5))]
