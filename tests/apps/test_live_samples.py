"""What is a sample and what is not, rows of one sensor alone, and the drawing in the terminal."""

import itertools
import math

import numpy as np
import pytest

from gnio_jax.apps.live import LONGEST_WAIT, MISSING, Sample, drawing, lines_of, paired, parse_line

SPIN, PULL = (0.1, 0.2, 0.3), (0.0, 1.0, 9.8)
KEYS = ('"time"', '"gyro"', '"accel"', "null", "true", "Infinity", "nan", "[0, 0, 0]")


def gyro(time, values=SPIN):
    return Sample(time, values, MISSING)


def accel(time, values=PULL):
    return Sample(time, MISSING, values)


def by_stamp(*rows):
    return sorted(itertools.chain(*rows), key=lambda row: row.time)


def at_100_hz(seconds=3.0):
    """Rows of both sensors, the gyro 3 ms behind the accelerometer."""
    times = np.arange(0.0, seconds, 0.01)
    return [accel(t) for t in times], [gyro(t + 0.003) for t in times]


def whole(found):
    return [row for row in found if row and all(map(math.isfinite, (*row.gyro, *row.accel)))]


def taken_by_a_tracker(rows):
    """What comes out, less what comes too late for a tracker, which wants increasing stamps."""
    found, newest = [], -math.inf
    for row in paired(rows):
        if row is not None and row.time > newest:
            found.append(row)
            newest = row.time
    return found


@pytest.mark.parametrize(("start", "rate"), [(0.0, 60), (1.7e9, 10)])
def test_the_accelerometer_is_interpolated_at_the_stamps_of_the_gyro(start, rate):
    """Two clocks, that of the gyro with 100 Hz; rows as they were taken. Whole rows stay as they
    are, and come at once."""
    random = np.random.default_rng(2)
    turned, pulled = start + np.arange(0.02, 1.0, 0.01), start + np.arange(0, 1.2, 1 / rate)
    forces = random.normal(size=(len(pulled), 3))
    rows = [gyro(t, (t, 0.0, -t)) for t in turned]
    rows += [accel(t, tuple(f)) for t, f in zip(pulled, forces.tolist(), strict=True)]
    found = whole(paired(by_stamp(rows)))
    assert [sample.time for sample in found] == list(turned)
    assert [sample.gyro for sample in found] == [(t, 0.0, -t) for t in turned]
    for axis in range(3):
        wanted = np.interp(turned, pulled, forces[:, axis])
        np.testing.assert_allclose([sample.accel[axis] for sample in found], wanted, atol=1e-6)
    taken = []
    odd = [None, Sample(0.3, MISSING, MISSING), Sample(0.4, (math.nan, 0.0, 0.0), PULL)]
    rows = [*(Sample(0.1 * k, SPIN, PULL) for k in range(3)), *odd]
    given = paired(taken.append(row) or row for row in rows)
    assert [(repr(next(given)), len(taken)) for _ in rows] == [  # NaN is not NaN
        (repr(row), number) for number, row in enumerate(rows, 1)
    ]


@pytest.mark.parametrize(
    "rows, samples",
    [
        ([(0.0, 0.2, 0.29), (0.05, 0.25)], [(0.05, MISSING), (0.25, PULL)]),
        ([(0.0, 0.5), (0.5,)], [(0.5, PULL)]),
    ],
)
def test_few_rows_by_hand(rows, samples):
    """Readings that are far apart enclose nothing, and one at the same stamp needs no other."""
    rows = by_stamp(map(gyro, rows[1]), map(accel, rows[0]))
    found = [(each.time, each.accel) for each in paired(rows)]
    assert repr(found) == repr(samples)  # NaN is not NaN


def test_a_row_that_comes_twice_or_late_is_no_sample():
    found = list(paired([accel(0.0), accel(0.0), gyro(0.01), accel(0.02), accel(0.01)]))
    assert found == [None, None, Sample(0.01, SPIN, PULL)]


def test_without_the_accelerometer_the_gyro_waits_no_longer_than_it_must():
    """What it gets then is a gap."""
    rows = [gyro(0.02 * k) for k in range(10)]
    seen, given = [], paired(seen.append(row) or row for row in rows)
    assert next(given) == rows[0] and seen[-1].time <= 2 * LONGEST_WAIT
    assert [sample.time for sample in given] == [row.time for row in rows[1:]]


@pytest.mark.parametrize("late", [0.0, 0.09, -0.006, -0.09])
@pytest.mark.parametrize("between", [None, 0.02])
def test_either_sensor_may_come_late(late, between):
    """In the order of arrival, the gyro `late` s after the accelerometer: where rows of it are
    missing, and where empty ones come between, as of a third sensor, none is overtaken."""
    pulled, turned = at_100_hz()
    turned = [*turned[:200], *turned[203:]]
    rows = [(row.time, row) for row in pulled] + [(row.time + late, row) for row in turned]
    if between:
        times = np.arange(1.001, 3.0, between)  # once the gyro has rows of its own
        rows += [(time, Sample(time, MISSING, MISSING)) for time in times]
    arrived = [row for _, row in sorted(rows, key=lambda pair: pair[0])]
    found = whole(taken_by_a_tracker(arrived))
    assert [row.time for row in found] == [row.time for row in turned[:-1]]


@pytest.mark.parametrize("sensor", [gyro, accel])
@pytest.mark.parametrize("off", [1e6, -5.0])
def test_one_wrong_stamp_holds_nothing_up(sensor, off):
    """What a tracker makes of one that comes through is its own matter."""
    pulled, turned = at_100_hz()
    wrong, rows = sensor(2.0 + off), by_stamp(pulled, turned)
    rows.insert(400, wrong)
    taken, found = [], []
    for row in paired(taken.append(row) or row for row in rows):
        found.append(row)
        assert len(taken) - 2 * len(found) < 50
    assert len([row for row in whole(found) if row.time != wrong.time]) > len(turned) - 25


@pytest.mark.parametrize("then", [gyro(1.0), Sample(1.0, MISSING, MISSING)])
def test_a_clock_that_stands_still_gives_no_samples(then):
    assert list(paired([gyro(1.0), *[then] * 999])).count(None) >= 998


def test_where_the_gyro_falls_silent_time_passes():
    """Also after a clock that was set back, and after a first stamp that was wrong."""
    pulled, turned = at_100_hz(2.0)
    rows = by_stamp(pulled, turned[:100])
    found = taken_by_a_tracker(rows)
    silent = found[-1]
    assert silent.time == pytest.approx(1.88, abs=0.02) and math.isnan(silent.gyro[0])
    assert len(found) == pytest.approx(100 + 79, abs=2)
    assert len(list(paired(pulled))) == pytest.approx(179, abs=2)
    assert len(list(paired([accel(1e6), *pulled]))) == pytest.approx(189, abs=2)
    back = [row._replace(time=row.time - 50.0) for row in pulled]
    assert len(list(paired([*rows, *back]))) == pytest.approx(len(found) + 189, abs=3)


@pytest.mark.parametrize(
    "line",
    [
        "1.5,0.1,-0.2,0.3,0,1,9.81\n",
        "1.5\t0.1\t-0.2\t0.3\t0\t1\t9.81\r\n",
        '{"time": 1.5, "gyro": [0.1, -0.2, 0.3], "accel": [0, 1, 9.81], "temperature": 20}',
    ],
)
def test_a_sample_may_be_written_in_several_ways(line):
    assert parse_line(line) == Sample(1.5, (0.1, -0.2, 0.3), (0.0, 1.0, 9.81))


def test_what_is_missing_is_nan():
    for line in ("2,,0,0,1,1,nan", '{"time": 2, "gyro": [null, 0, 0], "accel": [1, 1, null]}'):
        found = parse_line(line)
        assert found is not None and math.isnan(found.gyro[0]) and math.isnan(found.accel[2])
    lines = ['{"time": 0, "accel": [0, 0, 9]}', '{"time": 0.01, "gyro": [1, 2, 3]}']
    (found,) = lines_of([*lines, "0.02,,,,0,0,10"]).samples
    assert found == Sample(0.01, (1.0, 2.0, 3.0), (0.0, 0.0, 9.5))


@pytest.mark.parametrize(
    "line",
    [
        "",
        "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z",
        ",0,0,0,0,0,9.81",
        "1,300,0,0,0,0,9.81",  # deg/s
        "1,0,0,0,0,0,9810",  # mg
        '{"time": 1, "gyro": [0, 0], "accel": [0, 0, 9.81]}',
        '{"time": true, "gyro": [0, 0, 0], "accel": [0, 0, 9.81]}',
        "[" * 4000,
        f'{{"time": 1, "gyro": [0, 0, {"9" * 400}], "accel": [0, 0, 9.81]}}',
        '{"time": 1, "gyro": {"0": 0}, "accel": "009"}',
        "1" * 5000,
    ],
)
def test_what_is_no_sample(line):
    assert parse_line(line) is None


def test_no_text_at_all_is_an_error():
    random, signs = np.random.default_rng(0), [*'0123456789.,;:+-eE{}[]" \t\x00\xff\u20ac', *KEYS]
    for length in random.integers(0, 20, 3000):
        found = parse_line("".join(random.choice(signs, length)))
        assert found is None or math.isfinite(found.time)


def test_the_drawing_has_one_scale_and_y_up():
    """From the bottom left to the right, then up to the marker; as high as it is wide."""
    side = np.arange(30.0)
    path = np.array([[k, 0, 0] for k in side] + [[29.0, k, 0] for k in side])
    lines = drawing(path, 40, 20).split("\n")
    assert [len(line) for line in lines] == [40] * 20
    drawn = np.array([[sign not in " \u2800" for sign in line] for line in lines])
    rows, columns = np.flatnonzero(drawn.any(1)), np.flatnonzero(drawn.any(0))
    assert abs(2 * np.ptp(rows) - np.ptp(columns)) <= 2 and np.ptp(rows) > 15
    assert drawn[rows[-1]].sum() == len(columns) and drawn[:, columns[-1]].sum() == len(rows)
    assert lines[rows[0]][columns[-1]] == "●" and drawn[rows[5]].sum() == 1
    assert drawing(np.full((3, 3), np.nan), 10, 4).strip() == ""
    still = drawing(np.random.default_rng(0).normal(0, 0.01, (50, 3)), 40, 20)
    assert still.count("●") == 1 and sum(sign not in " \u2800\n" for sign in still) <= 4
