"""What is a sample and what is not; where lines come from; the drawing in the terminal."""

import math
import socket

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnio_jax import live
from gnio_jax.errors import InputError

SAMPLE = live.Sample(1.5, (0.1, -0.2, 0.3), (0.0, 1.0, 9.81))


@pytest.mark.parametrize(
    "line",
    [
        "1.5,0.1,-0.2,0.3,0,1,9.81\n",
        " 1.5; 0.1; -0.2; 0.3; 0; 1; 9.81",
        "1.5\t0.1\t-0.2\t0.3\t0\t1\t9.81\r\n",
        "1.5 0.1 -0.2 0.3 0 1 9.81",
        '{"time": 1.5, "gyro": [0.1, -0.2, 0.3], "accel": [0, 1, 9.81], "temperature": 20}',
    ],
)
def test_a_sample_may_be_written_in_several_ways(line):
    assert live.parse_line(line) == SAMPLE


def test_what_is_missing_is_nan():
    for line in ("2,,0,0,1,1,nan", '{"time": 2, "gyro": [null, 0, 0], "accel": [1, 1, null]}'):
        found = live.parse_line(line)
        assert found is not None and math.isnan(found.gyro[0]) and math.isnan(found.accel[2])


@pytest.mark.parametrize(
    "line",
    [
        "",
        "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z",
        "1,2,3",
        "1,2,3,4,5,6,7,8",
        ",0,0,0,0,0,9.81",
        "nan,0,0,0,0,0,9.81",
        "1,300,0,0,0,0,9.81",  # deg/s
        "1,0,0,0,0,0,9810",  # mg
        '{"time": 1, "gyro": [0, 0], "accel": [0, 0, 9.81]}',
        '{"time": true, "gyro": [0, 0, 0], "accel": [0, 0, 9.81]}',
        '{"time": 1}',
        "{" * 4000,
        "[" * 2000,
        f'{{"time": 1, "gyro": [0, 0, {"9" * 400}], "accel": [0, 0, 9.81]}}',
        '{"time": Infinity, "gyro": [0, 0, 0], "accel": [0, 0, 9.81]}',
        '{"time": 1, "gyro": {"0": 0}, "accel": "009"}',
        "1" * 5000,
        "\x00\xff garbage",
    ],
)
def test_what_is_no_sample(line):
    assert live.parse_line(line) is None


@given(st.text(max_size=200))
@settings(max_examples=200, deadline=None)
def test_no_text_at_all_is_an_error(text):
    found = live.parse_line(text)
    assert found is None or math.isfinite(found.time)


def test_datagrams_keep_their_order_and_end_with_the_silence():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        with pytest.raises(InputError, match=rf"udp:{port}: cannot listen on 127.0.0.1"):
            live.datagrams(port)
    source = live.datagrams(port, silence=0.3)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for k in range(5):
            lines = "\n".join(f"{k + j / 10},0,0,0,0,0,9.81" for j in range(3))
            sender.sendto(lines.encode(), ("127.0.0.1", port))
        sender.sendto(b"\xff\xfe", ("127.0.0.1", port))
    found = list(source.samples)
    assert [s.time for s in found[:-1]] == [k + j / 10 for k in range(5) for j in range(3)]
    assert found[-1] is None


def dots(text):
    """Set dots of a drawing, (row, column) from the top left."""
    bits = {0: (0, 0), 1: (1, 0), 2: (2, 0), 3: (0, 1), 4: (1, 1), 5: (2, 1), 6: (3, 0), 7: (3, 1)}
    found = set()
    for row, line in enumerate(text.split("\n")):
        for column, character in enumerate(line):
            if 0x2800 <= ord(character) <= 0x28FF:
                for bit, (down, across) in bits.items():
                    if ord(character) - 0x2800 >> bit & 1:
                        found.add((4 * row + down, 2 * column + across))
    return found


def test_the_drawing_has_one_scale_and_y_up():
    corner = np.array([[0.0, 0, 0]] * 3 + [[k, 0, 0] for k in range(30)])
    corner = np.concatenate([corner, [[29.0, k, 0] for k in range(30)]])
    text = live.drawing(corner, 40, 20)
    assert [len(line) for line in text.split("\n")] == [40] * 20
    row, column = next(
        (r, line.index("●")) for r, line in enumerate(text.split("\n")) if "●" in line
    )
    found = dots(text)
    lowest, leftmost = max(down for down, _ in found), min(across for _, across in found)
    # From the bottom left to the right, then up to the marker; as high as it is wide.
    assert (lowest, leftmost) in found
    assert 4 * row < lowest - 60 and 2 * column > leftmost + 60
    assert abs((2 * column - leftmost) - (lowest - 4 * row)) <= 6


def test_a_drawing_of_nothing_is_empty_and_standing_is_a_point():
    assert live.drawing(np.full((3, 3), np.nan), 10, 4).strip() == ""
    still = live.drawing(np.random.default_rng(0).normal(0, 0.01, (50, 3)), 40, 20)
    assert still.count("●") == 1 and len(dots(still)) <= 8
