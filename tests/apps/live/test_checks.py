"""Rate, units and sign of a stream, and sensors that contradict each other."""

from pathlib import Path

import numpy as np
import pytest

from gnio_jax.apps.live import checks, samples
from gnio_jax.apps.live.checks import Nature, with_measured_rate
from gnio_jax.data.simulated.walks import pedestrian
from gnio_jax.errors import InputError
from tests.support import known_walk
from tests.support.checks import unchecked
from tests.support.live_streams import STILL, arrivals, as_lines, of_lines, samples_of, texts_of

EXAMPLE = Path(__file__).parents[3] / "examples" / "walk.csv"
WALK = pedestrian(30, 330, seconds=60.0, rate=100.0)


def rate_of(lines, imu_rate=None):
    """What is measured of a stream, whose samples all come through."""
    rates = []
    stage = with_measured_rate(of_lines(lines), Nature("udp:5", imu_rate), rates.append)
    assert len(samples_of(stage)) == len(lines)
    return rates[0] if rates else None


@pytest.mark.parametrize("rate", [25, 200])
def test_the_rate_is_measured_over_the_first_second(rate):
    """Also where a tenth of the samples is lost, and where the stamps jitter."""
    random = np.random.default_rng(0)
    stamps = np.arange(3 * rate) / rate + 1.7e9
    stamps = stamps[random.random(len(stamps)) > 0.1]
    stamps += random.uniform(-0.1, 0.1, len(stamps)) / rate
    lines = [f"{stamp!r},{STILL}" for stamp in stamps.tolist()]
    assert rate_of(lines) == pytest.approx(rate, rel=0.05)
    assert rate_of(lines, 1.2 * rate) == 1.2 * rate
    with pytest.raises(InputError, match=r"Hz by their stamps; leave out --imu-rate .*measured"):
        rate_of(lines, 2.0 * rate)


@pytest.mark.parametrize(
    ("second", "problem"), [(60, "6000 Hz"), (86400, "8.64e.06 Hz"), (0.05, "5 Hz")]
)
def test_a_rate_that_no_imu_has_is_refused(second, problem):
    """Stamps in minutes and days: the first second of a day would be held for a day."""
    reads = []
    lines = (f"{k / 100 / second!r},{STILL}" for k in range(10**6))
    stage = with_measured_rate(
        of_lines(reads.append(0) or line for line in lines), Nature("udp:5"), print
    )
    with pytest.raises(InputError, match=rf"udp:5: its samples come at {problem}.*10 to 2000 Hz"):
        with unchecked():
            list(stage)
    assert len(reads) <= checks.MOST_HELD


def test_until_the_rate_is_measured_it_says_what_it_waits_for():
    lines = [f"{k / 50},{STILL}" for k in range(100)]
    stage = list(with_measured_rate(of_lines(lines), Nature("udp:5"), print))
    waiting = texts_of(stage, "waiting")
    assert len(waiting) == 50 and waiting[30] == "a second of samples: 0.6 s have come"
    lines = [f"{k / 50},0,0,0.1,,," for k in range(700)]
    waiting = texts_of(with_measured_rate(of_lines(lines), Nature("udp:5"), print), "waiting")
    assert waiting[-1].startswith("the accelerometer: send the gyro (gyro) and the accel")
    assert len(waiting) == 500  # after ten seconds it is an error of its own


@pytest.mark.parametrize(
    ("size", "remedy"), [(1.01, "give --accel-unit g;"), (990, "unit mg;"), (3.0, "unit: m/s2, g")]
)
def test_an_accelerometer_that_reads_no_gravity_is_refused(size, remedy):
    lines = [f"{k / 50},0,0,0,0,0,{size}" for k in range(100)]
    with pytest.raises(InputError, match=rf"reads {size:.3g} m/s².*{remedy}"):
        rate_of(lines)


def test_samples_pass_as_they_come():
    """Those of the first second at its end, later ones at once."""
    reads = []
    lines = [f"{k / 50},{STILL}" for k in range(150)]
    stage = with_measured_rate(
        of_lines(reads.append(0) or one for one in lines), Nature("udp:5"), print
    )
    counts = [len(reads) for arrival in stage if arrival.sample]
    assert counts == [51] * 51 + list(range(52, 151))


def test_wrong_stamps_before_the_first_second_cost_no_memory():
    """The units are checked of the samples that count: here they are apart by 50 days."""
    lines = [f"0,{STILL}", *(f"{4.3e6 + k / 50!r},{STILL}" for k in range(100))]
    stage = with_measured_rate(of_lines(lines), Nature("udp:5"), print)
    assert len(samples_of(stage)) == 101


def walk(change=lambda gyro, accel: (gyro, accel), seconds=30):
    time, gyro, accel = (part[: seconds * 100] for part in (WALK.time, WALK.gyro, WALK.accel))
    return as_lines((time, *change(gyro, accel)))


SWAP = [1, 0, 2]
FLIP = np.array([-1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda g, a: (-g, a), "gravity turns against the gyro"),
        (lambda g, a: (g[:, SWAP], a[:, SWAP]), "against the gyro.*two axes of both sensors$"),
        (lambda g, a: (FLIP * g, FLIP * a), "gravity turns against the gyro"),
        (
            lambda g, a: (np.degrees(g).clip(-90, 90), a),
            "its gyro looks like deg/s.*--gyro-unit deg/s$",
        ),
        (lambda g, a: (g[:, [1, 2, 0]], a), "not turn as the gyro says.*the same axes$"),
    ],
    ids=[
        "gyro negated",
        "x and y exchanged",
        "x mirrored",
        "degrees",
        "axes of the gyro turned",
    ],
)
def test_sensors_that_contradict_each_other_end_the_stream(change, problem):
    """Nine seconds after its begin, or with the next look at it, as a recording is refused."""
    stage = with_measured_rate(of_lines(walk(change)), Nature("udp:5"), print)
    times = []
    with pytest.raises(InputError, match=rf"udp:5: .*{problem}"):
        times += (arrival.sample.time for arrival in stage if arrival.sample)
        raise AssertionError(f"followed for {len(times) / 100} s")


@pytest.mark.parametrize(
    ("remedy", "ending"),
    [
        ("the clock is wrong: give --time-unit (s per stamp) or --sample-rate (Hz)", "in seconds"),
        ("state the unit of the gyro, as by --gyro-unit 131/deg/s", "or send it in rad/s"),
        ("state the unit of the gyro, as by --gyro-unit deg/s", "--gyro-unit deg/s"),
        ("give both sensors the same axes, as by --columns gyro_x=gyro_y", "the same axes"),
    ],
)
def test_a_remedy_names_no_option_that_a_stream_lacks(remedy, ending):
    assert checks._for_streams(remedy).endswith(ending)


def test_the_walk_as_it_is_passes_without_a_word():
    assert texts_of(with_measured_rate(of_lines(walk()), Nature("udp:5"), print)) == []


@pytest.mark.parametrize("sign", [None, "android", "ios", "detect"])
@pytest.mark.parametrize("platform", ["android", "ios"])
def test_the_sign_of_ios_is_named_or_warned_of(sign, platform):
    """Where it is not stated and gravity reads on −z; detect finds it."""
    negative = -1.0 if platform == "ios" else 1.0
    lines = walk(lambda gyro, accel: (gyro, negative * accel), seconds=3)
    stage = list(with_measured_rate(of_lines(lines), Nature("udp:5", None, sign), print))
    expected = WALK.accel[:300]
    right = sign == "detect" or (sign or "android") == platform
    forces = np.array([sample.accel for sample in samples_of(stage)])
    np.testing.assert_allclose(forces, expected if right else -expected)
    warned = any("iOS's sign and the path is wrong: compare with --accel-sign ios" in text
                 for text in texts_of(stage))  # fmt: skip
    assert warned == (sign is None and platform == "ios")


def test_a_gyro_that_turns_gravity_as_degrees_would_is_said():
    time = np.arange(0, 12, 0.02)
    lines = as_lines((time, np.degrees(known_walk.rate(time)), known_walk.force(time)))
    with pytest.raises(InputError, match=r"udp:5: its gyro looks like deg/s.*state the unit"):
        rate_of(lines)
    parsed = [samples.parse_line(line, samples.Units("deg/s")) for line in lines]
    converted_samples = samples_of(with_measured_rate(arrivals(parsed), Nature("udp:5"), print))
    np.testing.assert_allclose(
        [s.gyro for s in converted_samples], known_walk.rate(time), atol=1e-9
    )


@pytest.mark.parametrize(
    ("read_as", "factor", "words"),
    [("rad/s", 180 / np.pi, "deg/s"), ("deg/s", 65.5, "raw counts, 131 or 65.5 in 1 deg/s,")],
)
def test_degrees_are_not_taken_for_raw_counts(read_as, factor, words):
    """Read as rad/s, degrees are too large by about as much as 65.5 counts read as deg/s. The walk
    begins with a rest, so it shows little in its first 8 s."""
    rows = np.loadtxt(EXAMPLE, delimiter=",", skiprows=1)
    lines = as_lines((rows[:, 0], factor * rows[:, 1:4], rows[:, 4:]))
    nature = Nature("udp:5", gyro_unit=read_as)
    with pytest.raises(InputError, match=rf"its gyro looks like {words} by the turning"):
        list(with_measured_rate(of_lines(lines), nature, print))


def ride_and_walk():
    """A minute in a vehicle, whose engine shakes and whose road turns it, and then a minute of the
    known walk."""
    time, random = np.arange(0, 60, 0.02), np.random.default_rng(4)
    turn, push = 0.05 * np.sin(0.3 * time), 0.8 * np.sin(0.2 * time)
    noise = random.normal(0, [0.01] * 3 + [0.4] * 3, (len(time), 6))
    ride = np.stack([0 * time, 0 * time, turn, push, 20 * turn, 9.81 + 0 * time], axis=1) + noise
    steps = np.hstack([known_walk.rate(time), known_walk.force(time)])
    rows = np.column_stack([np.arange(0, 120, 0.02), np.vstack([ride, steps])])
    return [",".join(map(repr, row)) for row in rows.tolist()]


def test_a_ride_is_no_walk_until_there_are_steps():
    notices = texts_of(with_measured_rate(of_lines(ride_and_walk()), Nature("udp:5"), print))
    ride, *again = [notice for notice in notices if "steps" in notice]
    assert ride.startswith("warning: no walk: no steps in the last 40 s")
    assert again == ["there are steps again"]


def test_a_device_at_rest_is_no_ride():
    values = np.random.default_rng(2).normal([0, 0, 0, 0, 0, 9.81], 0.005, (3000, 6))
    rows = np.column_stack([np.arange(3000) / 50, values])
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    assert texts_of(with_measured_rate(of_lines(lines), Nature("udp:5"), print)) == []
