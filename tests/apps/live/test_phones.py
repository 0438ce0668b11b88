"""Messages of Sensor Logger and rows of phyphox, late, repeated and broken."""

import json
import time

import numpy as np
import pytest

from gnio_jax.apps.live import sources as live_sources
from gnio_jax.apps.live.batches import Batches
from gnio_jax.apps.live.inbox import Inbox
from gnio_jax.apps.live.phyphox import Phyphox, PhyphoxRows
from gnio_jax.apps.live.samples import SI, Sample, Units
from gnio_jax.apps.live.sensor_logger import SensorLogger
from gnio_jax.errors import InputError
from tests.support.live_streams import walked
from tests.support.phones import EPOCH, Experiment, messages


def read(bodies, stated=SI, sign="android"):
    """(samples, refusals) of some messages."""
    phone, items = SensorLogger("http:8000", stated, sign), []
    for body in bodies:
        items += phone.decode(body)
    return (
        [one for one in items if isinstance(one, Sample)],
        [one for one in items if isinstance(one, str)],
    )


def assert_walk(samples, recorded, atol=1e-9, missing=0):
    stamps, gyro, accel = recorded
    count = len(stamps) - missing
    assert len(samples) == count
    times = np.array([sample.time for sample in samples])
    np.testing.assert_allclose(times - times[0], stamps[:count] - stamps[0], atol=1e-6)
    np.testing.assert_allclose([s.gyro for s in samples], gyro[:count], atol=atol)
    np.testing.assert_allclose([s.accel for s in samples], accel[:count], atol=atol)


@pytest.mark.parametrize("kind", ["sum", "total", "raw"])
@pytest.mark.parametrize("period", [0.1, 0.5])
def test_the_accelerometer_may_come_in_three_ways(kind, period):
    recorded = walked()
    bodies = messages(*recorded, period=period, kind=kind)
    samples, refusals = read(bodies, Units("rad/s", "g") if kind == "raw" else SI)
    assert_walk(samples, recorded)
    assert refusals == [] and samples[0].time == EPOCH / 1e9


def test_messages_may_be_late_and_repeated():
    """Late ones are waited for, repeated ones are refused."""
    recorded = walked()
    bodies = messages(*recorded, period=0.2)
    order = [0, 1, 3, 2, 2, 4, 7, 5, 6, 3, *range(8, len(bodies))]
    samples, refusals = read([bodies[k] for k in order])
    assert_walk(samples, recorded)
    assert refusals == [f"message {k} of Sensor Logger came twice or too late" for k in (2, 3)]


def test_a_lost_message_is_waited_for_and_then_a_gap():
    stamps, gyro, accel = recorded = walked()
    bodies = messages(*recorded, period=0.2)
    samples, refusals = read([*bodies[:5], *bodies[6:], bodies[5]])
    received_rows = (stamps < 0.999) | (stamps > 1.199)
    assert_walk(samples, (stamps[received_rows], gyro[received_rows], accel[received_rows]))
    assert len(refusals) == 1


def test_messages_of_other_sensors_do_not_stop_the_numbers():
    recorded = walked(seconds=2)
    bodies = messages(*recorded, period=0.2)
    location = {"messageId": 5, "sessionId": "one", "deviceId": "phone", "payload": [{"name": "x"}]}
    numbered = [json.loads(body) for body in bodies]
    for message in numbered[5:]:
        message["messageId"] += 1
    bodies = [json.dumps(one).encode() for one in [*numbered[:5], location, *numbered[5:]]]
    assert_walk(read(bodies)[0], recorded)
    phone = SensorLogger("http:8000", SI, "android")
    counts = [len(list(phone.decode(body))) for body in bodies]
    assert counts == [10] * 5 + [0] + [10] * 5  # none waits


def test_another_recording_of_the_phone_follows_and_late_messages_of_the_first_are_refused():
    stamps, gyro, accel = recorded = walked()
    half = len(stamps) // 2
    first = messages(stamps[:half], gyro[:half], accel[:half])
    second = messages(stamps[half:], gyro[half:], accel[half:], session="two")
    other = messages(*recorded, device="another")
    samples, refusals = read([*first, second[0], first[-1], other[0], *second[1:]])
    assert_walk(samples, recorded)
    assert len(refusals) == 2 and refusals[1] == "comes from another phone than the first message"


def test_the_gyro_that_the_phone_has_corrected_is_preferred():
    recorded = walked(seconds=2)
    bodies = []
    for body in messages(*recorded):
        message = json.loads(body)
        raw = [dict(row, name="gyroscopeuncalibrated", values={"x": 9, "y": 9, "z": 9})
               for row in message["payload"] if row["name"] == "gyroscope"]  # fmt: skip
        bodies.append(json.dumps(dict(message, payload=[*raw, *message["payload"]])).encode())
    assert_walk(read(bodies)[0], recorded)


def test_the_sign_must_be_stated_where_the_system_is_not_known():
    recorded = walked(seconds=2)
    assert_walk(read(messages(*recorded, kind="total"), sign=None)[0], recorded)
    with pytest.raises(InputError, match=r"http:8000: the sign of .*--accel-sign ios, or android"):
        read(messages(*recorded), sign=None)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"\xff",
        b"[" * 100_000,
        b'"text"',
        b"{}",
        b'{"payload": 5}',
        b'{"payload": [5]}',
        b'{"payload": [{"name": []}]}',
        b'{"payload": [{"name": "gyroscope"}], "messageId": "x"}',
        b'{"payload": [{"name": "gyroscope"}], "messageId": 1e999}',
    ],
)
def test_a_message_that_is_none_is_refused(body):
    samples, refusals = read([body])
    assert samples == [] and len(refusals) == 1 and refusals[0].startswith("is not a message")


def test_readings_that_are_none_cost_only_themselves():
    recorded = walked(seconds=2)
    bodies = messages(*recorded)
    message = json.loads(bodies[1])
    broken = [
        {"name": "gyroscope"},
        {"name": "gyroscope", "time": "1", "values": {"x": 0, "y": 0, "z": 0}},
        {"name": "gyroscope", "time": EPOCH, "values": {"x": "0", "y": 0, "z": 0}},
        {"name": "gravity", "time": EPOCH, "values": [0, 0, 0]},
        {"name": "gyroscope", "time": 10**400, "values": {"x": 0, "y": 0, "z": 0}},
        {"name": "gyroscope", "time": EPOCH * 3, "values": {"x": 0, "y": 0, "z": 0}},
    ]
    empty = {"name": "gravity", "time": EPOCH, "values": {"x": None, "y": 0, "z": 0}}
    message["payload"] += [*broken, empty]
    samples, refusals = read([bodies[0], json.dumps(message).encode(), *bodies[2:]])
    assert_walk(samples, recorded)
    assert len(refusals) == len(broken)


def test_a_sensor_that_is_missing_or_falls_silent_is_missing_in_the_samples():
    """Time passes nevertheless, and memory is bounded."""
    row = lambda t: (t, (0.0, 0.0, 1.0))  # noqa: E731
    for kind, other in (("gyro", "accel"), ("accel", "gyro")):
        batches, samples = Batches(), []
        for second in range(10):
            stamps = second + np.arange(100) / 100
            batches.add(kind, [row(t) for t in stamps.tolist()])
            if second < 5:
                batches.add(other, [row(t) for t in stamps.tolist()])
            samples += batches.samples()
        assert all(isinstance(one, Sample) for one in samples)
        assert sum(one.whole for one in samples) == 500 and samples[-1].time > 7.9
        assert sum(map(len, batches._rows.values())) < 300


def test_rows_with_far_stamps_are_left_out():
    """Also of two rows the one, and of a sensor that is far behind the others."""
    batches = Batches()
    assert batches.add("gyro", [(0.0, (0.0, 0.0, 1.0)), (1e9, (0.0, 0.0, 1.0))]) == 1
    assert batches.add("gyro", [(t / 100, (0.0, 0.0, 1.0)) for t in range(500)]) == 0
    batches.add("accel", [(0.0, (0.0, 0.0, 1.0))])
    count = len(list(batches.samples()))
    batches.add("accel", [(0.01, (0.0, 0.0, 1.0))])
    samples = list(batches.samples())
    assert count == 301 and samples == []  # one came twice, and none comes again


def test_a_clock_that_is_set_back_begins_anew():
    batches, rows = Batches(), []
    for begin in (100.0, 101.0, 50.0, 51.0):
        for kind in ("accel", "gyro"):
            stamps = (begin + np.arange(100) / 100).tolist()
            batches.add(kind, [(t, (0.0, 0.0, 1.0)) for t in stamps])
        rows += batches.samples()
    assert [one.time for one in rows[::100]] == [100.0, 101.0, 50.0, 51.0] and len(rows) == 400


# --- phyphox


def polled(experiment, seconds, act=lambda now: None):
    """(samples, notices) of an experiment that is asked for some seconds."""
    inbox, phone = Inbox("phyphox"), Phyphox(experiment.address, "phyphox")
    phone.run(inbox)
    arrivals, begin, decode = [], time.monotonic(), PhyphoxRows(SI).decode
    for arrival in inbox.arrivals(decode):
        act(time.monotonic() - begin)
        arrivals.append(arrival)
        if time.monotonic() - begin > seconds:
            break
    phone.close()
    assert not any(arrival.refusal for arrival in arrivals)
    notices = [arrival.notice for arrival in arrivals if arrival.notice]
    return [arrival.sample for arrival in arrivals if arrival.sample], notices


@pytest.mark.parametrize("sources", [("accelerometer", "gyroscope"),
                                     ("linear_acceleration", "gravity", "gyroscope")])  # fmt: skip
def test_an_experiment_of_phyphox_is_started_and_read(sources):
    """From the second sample on: the gyro begins later. Numbers have eight digits."""
    recorded = walked(seconds=5.0)
    experiment = Experiment(*recorded, speed=10, sources=sources)
    samples, notices = polled(experiment, 1.5)
    assert "/control?cmd=start" in experiment.requests
    assert experiment.begin is None  # it is stopped at the end
    assert_walk(samples, [field[1:] for field in recorded], atol=1e-5)
    assert notices == []


def test_an_experiment_that_runs_is_neither_started_nor_read_from_its_begin():
    recorded = walked(seconds=10.0)
    experiment = Experiment(*recorded, speed=2)
    experiment.control("start")
    time.sleep(1.0)
    samples, _ = polled(experiment, 1.0)
    assert not any("control" in path for path in experiment.requests)
    assert samples[0].time > 1.9 and experiment.begin is not None
    steps = np.diff([sample.time for sample in samples])
    np.testing.assert_allclose(steps, 0.02, atol=1e-5)


def test_a_pause_on_the_phone_is_a_gap():
    """Of which its stamps know nothing."""
    experiment = Experiment(*walked(seconds=10.0))
    acts = iter([(1.0, "stop"), (2.0, "start"), (99.0, "")])
    due = [next(acts)]

    def act(now):
        if now > due[0][0]:
            experiment.control(due[0][1])
            due[0] = next(acts)

    samples, notices = polled(experiment, 3.0, act)
    steps = np.diff([sample.time for sample in samples])
    assert notices == ["phyphox is paused: press play on the phone"]
    assert (steps > 0.1).sum() == 1 and steps.max() == pytest.approx(1.0, abs=0.4)


@pytest.mark.parametrize(
    ("address", "problem"),
    [
        ("", "is not an address; write phyphox:192.168.0.10:8080"),
        ("a/b:1", "is not an address"),
        ("127.0.0.1:9", "does not answer .*Allow remote access"),
    ],
)
def test_an_address_without_a_phone_is_one_line(address, problem):
    with pytest.raises(InputError, match=problem):
        Phyphox(address, f"phyphox:{address}")


def test_an_experiment_that_lacks_a_sensor_is_refused():
    experiment = Experiment(*walked(), sources=("linear_acceleration", "gyroscope"))
    with pytest.raises(
        InputError, match=r"lacks the gyroscope or the acc.*has linear, gyro.*simple"
    ):
        Phyphox(experiment.address, "phyphox")
    experiment.inputs = []
    with pytest.raises(InputError, match="has neither"):
        Phyphox(experiment.address, "phyphox")


def test_phyphox_gets_its_own_remedy_for_a_sensor_that_does_not_come():
    experiment = Experiment(*walked())
    of_phyphox = live_sources.phyphox(f"phyphox:{experiment.address}", live_sources.Stated())
    assert "in one experiment" in of_phyphox.nature.needs
