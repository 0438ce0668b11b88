"""What is a sample and what is not."""

import math

import numpy as np
import pytest

from gnio_jax.apps.live.samples import NO_SAMPLE, Sample, Units, parse_line, parse_lines

KEYS = ('"time"', '"gyro"', '"accel"', "null", "true", "Infinity", "nan", "[0, 0, 0]")


@pytest.mark.parametrize(
    "line",
    [
        "1.5,0.1,-0.2,0.3,0,1,9.81\n",
        "1.5\t0.1\t-0.2\t0.3\t0\t1\t9.81\r\n",
        "+1.5e0; .1;-2e-1;0.3;0;1;9.81",
        '{"time": 1.5, "gyro": [0.1, -0.2, 0.3], "accel": [0, 1, 9.81], "temperature": 20}',
    ],
)
def test_a_sample_may_be_written_in_several_ways(line):
    assert parse_line(line) == Sample(1.5, (0.1, -0.2, 0.3), (0.0, 1.0, 9.81))


def test_a_missing_value_is_nan():
    for line in ("2,,0,0,1,1,nan", '{"time": 2, "gyro": [null, 0, 0], "accel": [1, 1, null]}'):
        sample = parse_line(line)
        assert sample is not None and math.isnan(sample.gyro[0]) and math.isnan(sample.accel[2])
    sample = parse_line('{"time": 0, "accel": [0, 0, 9]}')
    assert sample is not None and math.isnan(sample.gyro[0]) and sample.accel == (0, 0, 9)


@pytest.mark.parametrize(
    "line",
    [
        "",
        "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z",
        ",0,0,0,0,0,9.81",
        "1,300,0,0,0,0,9.81",  # deg/s
        "1,0,0,0,0,0,9810",  # mg
        "1,1_0,0,0,0,0,9.81",
        "1,\uff11\uff12,0,0,0,0,9.81",
        "1,\u0661,0,0,0,0,9.81",
        "1,0x1,0,0,0,0,9.81",
        '{"time": 1, "gyro": [0, 0], "accel": [0, 0, 9.81]}',
        '{"time": true, "gyro": [0, 0, 0], "accel": [0, 0, 9.81]}',
        '{"time": \uff11, "gyro": [0, 0, 0], "accel": [0, 0, 9.81]}',
        '{"time": "1", "gyro": [0, 0, 0], "accel": [0, 0, 9.81]}',
        "[" * 4000,
        f'{{"time": 1, "gyro": [0, 0, {"9" * 400}], "accel": [0, 0, 9.81]}}',
        '{"time": 1, "gyro": {"0": 0}, "accel": "009"}',
        "1" * 5000,
    ],
)
def test_a_line_that_is_no_sample(line):
    assert parse_line(line) is None


def test_no_text_at_all_is_an_error():
    random, signs = np.random.default_rng(0), [*'0123456789.,;:+-eE{}[]" \t\x00\xff\u20ac', *KEYS]
    for length in random.integers(0, 20, 3000):
        sample = parse_line("".join(random.choice(signs, length)))
        assert sample is None or math.isfinite(sample.time)


def test_empty_lines_do_not_count():
    message = b"\n" * 1000 + b" \r\n1,0,0,0,0,0,1\nx\n\n"
    samples = list(parse_lines(message, Units("deg/s", "g")))
    assert samples == [Sample(1.0, (0, 0, 0), (0, 0, 9.80665)), NO_SAMPLE]
