"""What waits for the filter, and the lines of streams and datagrams."""

import contextlib
import io
import os
import socket
import time

import numpy as np
import pytest

from gnio_jax.apps.live import inbox as inboxes
from gnio_jax.apps.live.inbox import Inbox, read_stream
from gnio_jax.apps.live.samples import NO_SAMPLE, SI, Sample, parse_lines
from gnio_jax.apps.live.sources import Stated, open_source
from tests.support.live_streams import STILL, samples_of, texts_of


def test_messages_keep_their_order_and_end_with_the_silence():
    """What comes before the source is read is kept, and silence counts from the first message."""
    inbox = Inbox("udp:5")
    for first in (0, 3):
        message = "\n".join(f"{first + k},{STILL}" for k in range(3)).encode()
        assert inbox.put(message, len(message))
    inbox.put(b"\xff\xfe", 2)
    begin = time.monotonic()
    arrivals = list(inbox.arrivals(parse_lines, 0.3))
    assert 0.25 < time.monotonic() - begin < 5
    assert [sample.time for sample in samples_of(arrivals)] == [0, 1, 2, 3, 4, 5]
    assert texts_of(arrivals, "refusal") == [NO_SAMPLE]


def test_without_messages_time_passes_and_nothing_ends():
    stage = Inbox("udp:5").arrivals(parse_lines, 0.01)
    waiting = [next(stage).waiting for _ in range(5)]
    assert waiting[-1] == "samples: nothing has come on udp:5 for 0 s"


@pytest.mark.parametrize("bound", ["MOST_MESSAGES", "MOST_BYTES"])
def test_what_waits_is_bounded_and_what_is_lost_is_said(monkeypatch, bound):
    monkeypatch.setattr(inboxes, bound, 5 if bound == "MOST_MESSAGES" else 100)
    inbox, line = Inbox("udp:5", "datagrams"), f"1,{STILL}".encode()
    count = sum(inbox.put(line, 20) for _ in range(12))
    stage = inbox.arrivals(parse_lines, 0.05)
    assert count == 5
    assert next(stage).notice.startswith("7 datagrams are lost: they came faster than")
    arrivals = list(stage)
    assert len(samples_of(arrivals)) == 5 and texts_of(arrivals, "notice") == []  # it is said once
    assert inbox.put(line, 20)  # what was read makes place


def test_datagrams_of_the_largest_size_do_not_fill_the_memory():
    """100,000 of them would be 6 GB."""
    inbox, message = Inbox("udp:5", "datagrams"), bytes(60_000)
    assert sum(inbox.put(message, len(message)) for _ in range(2000)) == 533


@pytest.fixture
def port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_datagrams_are_received_before_they_are_read(port):
    source = open_source(f"udp:{port}", Stated(silence=0.3))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for k in range(50):
            sender.sendto(f"{k},{STILL}\n".encode(), ("127.0.0.1", port))
    time.sleep(0.2)
    read = time.monotonic()
    arrivals = list(source.arrivals)
    source.close()
    assert [sample.time for sample in samples_of(arrivals)] == list(range(50))
    assert all(arrival.clock < read for arrival in arrivals if arrival.sample)


def test_the_datagrams_of_a_second_machine_are_refused(port):
    """Two IMUs at one port, in turn; what is no sample makes nobody the first."""
    source = open_source(f"udp:{port}", Stated(silence=0.3))
    with contextlib.ExitStack() as sockets:
        senders = []
        for machine in ("127.0.0.2", "127.0.0.1"):
            sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            senders.append(sockets.enter_context(sender))
            sender.bind((machine, 0))
        senders[0].sendto(b"time,gyro,accel\n", ("127.0.0.1", port))
        for k in range(1, 21):
            senders[k % 2].sendto(f"{k},{STILL}\n".encode(), ("127.0.0.1", port))
        arrivals = list(source.arrivals)
    source.close()
    assert [sample.time for sample in samples_of(arrivals)] == list(range(1, 21, 2))
    refusals = texts_of(arrivals, "refusal")
    assert len(refusals) == 11 and refusals[0].startswith("is not a sample")
    problem = "comes from 127.0.0.2, and the samples before it from 127.0.0.1"
    assert set(refusals[1:]) == {problem}


def test_a_machine_that_was_silent_may_have_another_address(monkeypatch):
    clock = iter([0.0, 1.0, 2.5, 4.0, 7.0, 8.0])
    monkeypatch.setattr(inboxes.time, "monotonic", lambda: next(clock))
    reader = inboxes.Datagrams(SI)
    senders = ["first", "first", "second", "first", "second", "first"]
    accepted = [
        isinstance(next(reader.decode((f"{k},{STILL}\n".encode(), machine, 9))), Sample)
        for k, machine in enumerate(senders)
    ]
    assert accepted == [True, True, False, True, True, False]


def sent_from(port, lines):
    """What is read of lines that come from the sockets of this number; None: a new one each."""
    source = open_source(f"udp:{port}", Stated(silence=0.3))
    with contextlib.ExitStack() as sockets:
        senders = {}
        for number, line in lines:
            sender = senders.get(number)
            if sender is None:
                sender = sockets.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                sender.bind(("127.0.0.1", 0))
            if number is not None:
                senders[number] = sender
            sender.sendto(line.encode(), ("127.0.0.1", port))
        arrivals = list(source.arrivals)
    source.close()
    return arrivals


def test_two_senders_of_one_machine_make_no_path_of_both(port):
    arrivals = sent_from(port, [(k % 2, f"{k},{STILL}") for k in range(200)])
    times = [sample.time for sample in samples_of(arrivals)]
    assert times == [*range(7), *range(8, 200, 2)]
    refusals = texts_of(arrivals, "refusal")
    assert (
        len(refusals) == 97 and " of 127.0.0.1, and the samples before it from port" in refusals[0]
    )


@pytest.mark.parametrize(
    "lines",
    [
        [(None, f"{k},{STILL}") for k in range(100)],
        [(k // 50, f"{k},{STILL}") for k in range(200)],
        [(k % 2, f'{{"time": {k}, "{("gyro", "accel")[k % 2]}": [0, 0, 1]}}') for k in range(100)],
    ],
    ids=["a port for each sample", "started again", "a port for each sensor"],
)
def test_one_sender_may_have_several_ports(port, lines):
    arrivals = sent_from(port, lines)
    assert len(samples_of(arrivals)) == len(lines) and not texts_of(arrivals, "refusal")


def decoded(monkeypatch, arrivals):
    """Of the rows (time s, port, line) from one machine: whether each is taken."""
    clock = iter([seconds for seconds, *_ in arrivals])
    monkeypatch.setattr(inboxes.time, "monotonic", lambda: next(clock))
    reader = inboxes.Datagrams(SI)
    return [
        isinstance(next(reader.decode((line.encode(), "phone", port))), Sample)
        for _, port, line in arrivals
    ]


def test_a_sender_that_took_turns_is_followed_after_a_silence(monkeypatch):
    times, ports = [*(k / 100 for k in range(10)), 1.0, 3.2, 3.3], [1, 2] * 5 + [2, 2, 2]
    rows = [
        (now, port, f"{k},{STILL}\n")
        for k, (now, port) in enumerate(zip(times, ports, strict=True))
    ]
    accepted = decoded(monkeypatch, rows)
    assert accepted == [True] * 7 + [False, True, False, False, True, True]


def rows_of_sensors(ports, seconds):
    """A row of the gyro and one of the accelerometer a hundred times a second, from two ports."""
    for k in range(100 * seconds):
        for port, name in zip(ports, ("gyro", "accel"), strict=True):
            yield k / 100, port, f'{{"time": {k / 100}, "{name}": [0, 0, 9.8]}}\n'


def test_a_second_sender_with_a_row_for_each_sensor_is_refused(monkeypatch):
    first, second = (list(rows_of_sensors(ports, 1)) for ports in ((1, 1), (3, 3)))
    turns = [row for k in range(0, 200, 2) for rows in (first, second) for row in rows[k : k + 2]]
    accepted = np.array(decoded(monkeypatch, turns))
    of_first = np.array([port == 1 for _, port, _ in turns])
    assert accepted[of_first].all() and not accepted[~of_first][8:].any()


def test_a_second_sender_is_followed_when_the_first_has_ended(monkeypatch):
    """Although its accelerometer has a port of its own, whose rows nobody can tell apart."""
    whole = [(k / 100, 1, f"{k / 100},{STILL}\n") for k in range(100)]
    sensors = list(rows_of_sensors((3, 4), 5))
    turns = sorted(whole + sensors, key=lambda row: row[0])
    accepted = decoded(monkeypatch, turns)
    times, ports, _ = map(np.array, zip(*turns, strict=True))
    refused = times[(ports == 3) & ~np.array(accepted)]
    assert np.all(np.array(accepted)[times > 3.1]) and 2.9 < refused.max() < 3.1


def test_many_ports_and_those_before_a_silence_are_no_second_sender(monkeypatch):
    rows = [(k / 100, 1 + k % 6, f"{k / 100},{STILL}\n") for k in range(60)]
    assert all(decoded(monkeypatch, rows))
    # Seven runs of two ports, a silence, and as many again.
    times = [*(k / 100 for k in range(7)), *(5 + k / 100 for k in range(7))]
    rows = [(now, 1 + k % 2, f"{now},{STILL}\n") for k, now in enumerate(times)]
    assert all(decoded(monkeypatch, rows))


def lines_of(content):
    return list(read_stream(io.BytesIO(content), "standard input", SI))


def test_a_stream_is_read_line_by_line():
    """Its last line needs no end, empty ones do not count, and chunks cut nothing."""
    content = "".join(f"{k / 100},{STILL}\r\n\n" for k in range(20_000)).encode()
    arrivals = lines_of(content + f"200,{STILL}".encode())
    assert [sample.time for sample in samples_of(arrivals)] == [k / 100 for k in range(20_001)]
    assert texts_of(arrivals, "refusal") == []


def test_a_line_without_an_end_is_refused_again_and_again():
    """And its memory is bounded; the line after it is read."""
    number = 40
    content = bytes(number * inboxes.CHUNK) + f"\n1,{STILL}\n".encode()
    arrivals = lines_of(content)
    assert number <= len(texts_of(arrivals, "refusal")) <= number + 2
    assert [sample.time for sample in samples_of(arrivals)] == [1.0]


def test_a_stream_that_is_silent_says_so(monkeypatch):
    monkeypatch.setattr(inboxes, "TICK", 0.01)
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as stream:
        stage = read_stream(stream, "standard input", SI)
        assert next(stage).waiting == "samples: nothing has come on standard input for 0 s"
        os.write(writing, f"1,{STILL}\n2,0".encode())
        assert next(arrival for arrival in stage if arrival.sample).sample.time == 1.0
        os.write(writing, b",0,0,0,0,9.81\n")
        assert next(arrival for arrival in stage if arrival.sample).sample.time == 2.0
        os.close(writing)
        assert samples_of(stage) == []
