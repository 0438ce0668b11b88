"""Samples in the order of their stamps, and rows of one sensor alone."""

import math

import numpy as np
import pytest

from gnio_jax.apps.live.pairing import DISORDER, LONGEST_WAIT, in_order
from gnio_jax.apps.live.samples import MISSING, Arrival, Sample
from tests.support.live_streams import (
    PULL,
    SPIN,
    accel,
    arrivals,
    by_stamp,
    gyro,
    of_lines,
    samples_of,
    texts_of,
)


def paired(rows):
    """The samples, and None for each row that is refused."""
    stage = in_order(arrivals(rows))
    return [None if arrival.refusal else arrival.sample for arrival in stage]


def whole(rows):
    return [row for row in rows if row and all(map(math.isfinite, (*row.gyro, *row.accel)))]


def at_100_hz(seconds=3.0):
    """Rows of both sensors, the gyro 3 ms behind the accelerometer."""
    times = np.arange(0.0, seconds, 0.01)
    return [accel(t) for t in times], [gyro(t + 0.003) for t in times]


@pytest.mark.parametrize("kind", ["neighbours", "random"])
def test_samples_that_come_a_little_late_lose_nothing(kind):
    """Every 60th pair swapped, or each late by up to 45 ms: 1.7 % and 90 % out of order."""
    rows = [Sample(k / 100, SPIN, PULL) for k in range(600)]
    delays = np.random.default_rng(0).uniform(0, 0.045, len(rows)) * (kind == "random")
    delays[::60] += 0.0101 * (kind == "neighbours")
    order = np.argsort([row.time + delay for row, delay in zip(rows, delays, strict=True)])
    assert (np.diff(order) < 0).sum() >= 10
    assert paired([rows[k] for k in order]) == rows


def test_a_sample_that_comes_twice_or_too_late_is_refused():
    rows = [Sample(k / 100, SPIN, PULL) for k in range(100)]
    stage = in_order(arrivals([*rows[:50], rows[49], rows[30], *rows[50:]]))
    stage = list(stage)
    assert samples_of(stage) == rows
    twice, delay_refusal = texts_of(stage, "refusal")
    assert twice.endswith("it came twice") and delay_refusal.endswith("0.19 s late")


def test_samples_wait_no_longer_than_the_disorder():
    inputs = []
    rows = [Sample(k / 100, SPIN, PULL) for k in range(100)]
    for arrival in in_order(arrivals(inputs.append(row) or row for row in rows)):
        assert inputs[-1].time - arrival.sample.time < DISORDER + 0.011 or inputs[-1] is rows[-1]


@pytest.mark.parametrize(("start", "rate"), [(0.0, 60), (1.7e9, 10)])
def test_the_accelerometer_is_interpolated_at_the_stamps_of_the_gyro(start, rate):
    """Two clocks, that of the gyro with 100 Hz; rows as they were measured."""
    random = np.random.default_rng(2)
    turned, pulled = start + np.arange(0.02, 1.0, 0.01), start + np.arange(0, 1.2, 1 / rate)
    forces = random.normal(size=(len(pulled), 3))
    rows = [gyro(t, (t, 0.0, -t)) for t in turned]
    rows += [accel(t, tuple(f)) for t, f in zip(pulled, forces.tolist(), strict=True)]
    samples = whole(paired(by_stamp(rows)))
    assert [sample.time for sample in samples] == list(turned)
    assert [sample.gyro for sample in samples] == [(t, 0.0, -t) for t in turned]
    for axis in range(3):
        expected = np.interp(turned, pulled, forces[:, axis])
        np.testing.assert_allclose([sample.accel[axis] for sample in samples], expected, atol=1e-6)


def test_other_arrivals_pass_at_once():
    ticks = [Arrival(1.0, notice="hear"), Arrival(2.0, refusal="no"), Arrival(3.0)]
    stage = in_order(iter([*arrivals([Sample(0.0, SPIN, PULL)]), *ticks]))
    assert [next(stage) for _ in ticks] == ticks and len(list(stage)) == 1


@pytest.mark.parametrize(
    "rows, samples",
    [
        ([(0.0, 0.2, 0.29), (0.05, 0.25)], [(0.05, MISSING), (0.25, PULL)]),
        ([(0.0, 0.5), (0.5,)], [(0.5, PULL)]),
    ],
)
def test_few_rows_by_hand(rows, samples):
    """Readings that are far apart enclose nothing, and one at the same stamp needs no other."""
    for gyro_first in (True, False):
        readings = by_stamp(map(gyro, rows[1]), map(accel, rows[0]))
        readings.sort(key=lambda row: (row.time, math.isnan(row.gyro[0]) == gyro_first))
        pairs = [(row.time, row.accel) for row in paired(readings) if row.gyro == SPIN]
        assert repr(pairs) == repr(samples)  # NaN is not NaN


def test_without_the_accelerometer_the_gyro_waits_no_longer_than_it_must():
    """Its samples then are a gap."""
    rows = [gyro(0.02 * k) for k in range(10)]
    inputs = []
    stage = in_order(arrivals(inputs.append(row) or row for row in rows))
    assert next(stage).sample == rows[0] and inputs[-1].time <= 2 * LONGEST_WAIT
    assert [arrival.sample.time for arrival in stage] == [row.time for row in rows[1:]]


@pytest.mark.parametrize("delay", [0.0, 0.09, -0.006, -0.09])
@pytest.mark.parametrize("between", [None, 0.02])
def test_either_sensor_may_come_late(delay, between):
    """In the order of arrival, the gyro `delay` s after the accelerometer: where rows of it are
    missing, and where empty ones come between, as of a third sensor, none is overtaken."""
    pulled, turned = at_100_hz()
    turned = [*turned[:200], *turned[203:]]
    rows = [(row.time, row) for row in pulled] + [(row.time + delay, row) for row in turned]
    if between:
        times = np.arange(1.001, 3.0, between)  # once the gyro has rows of its own
        rows += [(time, Sample(time, MISSING, MISSING)) for time in times]
    arrived = [row for _, row in sorted(rows, key=lambda pair: pair[0])]
    samples = paired(arrived)
    times = [row.time for row in samples if row]
    assert times == sorted(set(times)) and None not in samples
    assert [row.time for row in whole(samples)] == [row.time for row in turned[:-1]]


def test_where_the_gyro_falls_silent_time_passes():
    pulled, turned = at_100_hz(2.0)
    samples = paired(by_stamp(pulled, turned[:100]))
    silent = samples[-1]
    assert silent.time == pytest.approx(1.99) and math.isnan(silent.gyro[0])
    assert len(samples) == pytest.approx(100 + 90, abs=2)
    assert len(paired(pulled)) == pytest.approx(190, abs=2)


def test_rows_without_values_pass_where_both_sensors_share_rows():
    lines = [f"{k / 100},{'0,0,0,0,0,9.8' if k % 10 else ',,,,,'}" for k in range(100)]
    samples = samples_of(in_order(of_lines(lines)))
    assert len(samples) == 100 and sum(row.whole for row in samples) == 90
