"""`gnio live`: the trajectory of a stream is that of the tracker, and nonsense is refused."""

import dataclasses
import importlib.util
import signal
import socket
import sys
import time
import weakref

import numpy as np
import pytest

from gnio_jax import networks
from gnio_jax.apps import live, rerun
from gnio_jax.commands import app, console
from gnio_jax.config import DataConfig, FilterSettings, ModelConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation.trajectory import read_tum
from gnio_jax.filtering import ConsideredStd, Pose, Tracker
from gnio_jax.filtering import tracker as trackers
from tests.support import known_walk, tiny_run
from tests.support.filter_settings import changed
from tests.support.rerun_files import columns_of

CONFIG = TrainConfig(
    data=DataConfig(rate=50.0),
    model=ModelConfig(name="tiny"),
    filter=FilterSettings(measurements={"zero_velocity": {"std": 0.02}}),
)
RATE = 50.0
PATIENCE = 120
"""s, after which a test waits for what never comes."""


@pytest.fixture(autouse=True)
def patience():
    def give_up(*_):
        pytest.fail(f"nothing has come for {PATIENCE} s")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(PATIENCE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    with tiny_run.known():
        yield tiny_run.save(tmp_path_factory.mktemp("home") / "run", CONFIG)


@pytest.fixture(scope="module", autouse=True)
def programs():
    """Trackers of the one run that take the same steps share what is compiled."""
    compiled, compile_programs = {}, trackers.compile_programs

    def once(predict, core, *settings):
        if repr(settings) not in compiled:
            compiled[repr(settings)] = compile_programs(predict, core, *settings)
        return compiled[repr(settings)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trackers, "compile_programs", once)
        yield


def walked(rate=RATE, seconds=5.0):
    """(time, gyro, accel) of a second of rest and four of walking."""
    time = np.arange(0, seconds, 1 / rate)
    gyro, accel = known_walk.rate(time), known_walk.force(time)
    still = time < 1.0
    down = known_walk.force(np.array([1.0]))
    gyro[still], accel[still] = 0.0, 9.81 * down / np.linalg.norm(down)
    return time, gyro, accel


@pytest.fixture(scope="module")
def recorded():
    return walked()


@pytest.fixture
def follow(gnio, run):
    """What `gnio live` prints of lines on standard input."""
    return lambda lines, *words: gnio("live", *words, "--network", run, lines=lines)


def as_lines(recorded):
    rows = np.column_stack(recorded).tolist()
    return [",".join(map(repr, row)) for row in rows]


def test_a_stream_gives_the_trackers_poses(follow, run, recorded, monkeypatch, tmp_path):
    """In the file of the trajectory and in that for Rerun, whose path comes in pieces."""
    monkeypatch.setattr(rerun, "LINE_EVERY", 3)
    monkeypatch.setattr(rerun, "LONGEST_PIECE", 9)
    shown = ["--rerun", tmp_path / "live.rrd"] if importlib.util.find_spec("rerun") else []
    out, lines = tmp_path / "live.txt", as_lines(recorded)
    # A header, noise on the line and a repeated sample are refused and counted.
    lines = ["time,gx,gy,gz,ax,ay,az", *lines[:70], "\udcff\udcfe", lines[69], *lines[70:]]
    told = follow(lines, "--out", out, *shown)
    assert {path.name for path in tmp_path.iterdir()} == {"live.txt", *(["live.rrd"] * bool(shown))}
    assert "\x1b" not in told and "warning: 3 lines refused, the first: is no sample" in told
    # A line a second, the last one repeated at the end.
    assert sum(line.lstrip()[0].isdigit() for line in told.splitlines()) == 6

    tracker, expected = live.create_tracker(networks.load(run), RATE), []
    for sample in zip(*recorded, strict=True):
        pose = tracker.push(*sample)
        expected += [] if pose is None else [pose]
    path = read_tum(out)
    np.testing.assert_allclose(path.time, [pose.time for pose in expected], atol=1e-8)
    np.testing.assert_allclose(path.position, [p.position for p in expected], atol=1e-8)
    if not shown:
        return
    found = columns_of(tmp_path / "live.rrd")
    moved = np.array(found["/live/pose"]["Transform3D:translation"])[:, 0]
    np.testing.assert_allclose(moved, path.position, atol=1e-5)
    seconds = [each.total_seconds() for each in found["/live/pose"]["time"]]
    np.testing.assert_allclose(seconds, path.time - path.time[0], atol=1e-6)
    pieces = [
        found[f"/live/estimate/{number:04d}"]["LineStrips3D:strips"][-1][0] for number in range(5)
    ]
    # Each begins where the one before ended.
    line = np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])
    np.testing.assert_allclose(line, path.position, atol=1e-5)
    assert len(found["/live/ellipsoid"]["Ellipsoids3D:half_sizes"]) == len(path.time)


def test_the_tracker_of_a_calibrated_run_considers_what_its_track_does(run, monkeypatch):
    options = changed(considered={"scale": 0.1, "heading": np.pi / 2})
    found = networks.load(run)
    calibrated = found._replace(config=dataclasses.replace(found.config, filter=options))
    passed = []

    def noted(_, ekf, **__):
        passed.append(ekf.considered)
        return Tracker.__new__(Tracker)

    monkeypatch.setattr(live, "Tracker", noted)
    live.create_tracker(calibrated, RATE)
    live.create_tracker(found, RATE)
    assert passed == [ConsideredStd(0.0, 0.1, np.pi / 2, 0.0), None]


def pose_at(time, place, healthy=True):
    zero, covariance = np.zeros(3), np.eye(15) * (1.0 if healthy else -1.0)
    return Pose(time, np.eye(3), zero, np.array(place), zero, zero, covariance, 1.0, 1.0, healthy)


def test_a_stream_of_nonsense_or_of_one_sensor_ends_with_one_line():
    source, found = live.lines_of(["HTTP/1.1 400"] * 500, "udp:5555"), live.Followed()
    with pytest.raises(InputError, match=r"udp:5555: has no sample in its first 100.*is no sample"):
        live.follow(Clocked().push, source, found, print)
    assert found.refused == 100 and found.pose is None
    lines = [f"{k / 100},0,0,0.1,,," for k in range(1200)]
    source, found = live.lines_of(lines, "udp:5555"), live.Followed()
    with pytest.raises(InputError, match=r"udp:5555: has no sample with both sensors in its first"):
        live.follow(Clocked().push, source, found, print)
    assert found.last == pytest.approx(10.0, abs=0.2)
    whole = [f"{k / 100},0,0,0.1,0,0,9.8" for k in range(900, 1200)]
    live.follow(Clocked().push, live.lines_of([*lines[:900], *whole]), live.Followed(), print)


class Clocked:
    """A tracker that wants stamps that increase, and keeps them."""

    def __init__(self):
        self.stamps = []

    def push(self, time, gyro, accel):
        if self.stamps and time <= self.stamps[-1]:
            raise ValueError(f"time: must increase, found {time}")
        self.stamps.append(time)


def test_a_clock_that_is_set_back_ends_the_stream():
    """After a glitch the samples are taken again; where no later one can be, nothing waits."""
    lines = [f"{time},0,0,0,0,0,9.81" for time in np.arange(50) / 100]
    lines = [*lines[:30], *lines[:20], *lines[30:], *lines * 100]
    found, tracker = live.Followed(), Clocked()
    live.follow(tracker.push, live.lines_of(lines), found, print)
    assert tracker.stamps == [k / 100 for k in range(50)] and found.lost
    assert found.in_a_row == 1000 and found.refused == 1020
    assert found.reasons[1].startswith("time: must increase")


def test_gaps_are_told_and_a_stamp_in_the_future_costs_its_sample_alone(follow, recorded):
    """Also rows that are empty are missing; before the start none is missed."""
    lines = as_lines(recorded)
    empty = [f"{line.split(',')[0]},,,,,," for line in lines[100:115]]
    told = follow([*lines[:20], *lines[50:100], *empty, *lines[115:150], *lines[151:]])
    assert "warning: gaps: 1, the longest of 0.32 s: samples are missing" in told
    assert "warning: start: it moved while it should lie still" in told  # as a track tells it
    time, values = lines[150].split(",", 1)
    whole = follow(lines)
    told = follow([*lines[:150], f"{float(time) + 30},{values}", *lines[151:]])
    assert "gaps" not in told and "refused" not in told and "it moved" not in told
    assert told.splitlines()[-1].split()[0] == whole.splitlines()[-1].split()[0]  # s
    gyro, accel = np.degrees(recorded[1]), recorded[2] / 9.80665
    units = ("--gyro-unit", "deg/s", "--accel-unit", "g")
    assert follow(as_lines((recorded[0], gyro, accel)), *units) == whole


def rate_of(lines, imu_rate=None, name="udp:5"):
    """What is measured of a stream, whose samples all come through."""
    rates = []
    source = live.measured(live.lines_of(lines, name), rates.append, imu_rate)
    assert len(list(source.samples)) == len(lines)
    return rates[0] if rates else None


@pytest.mark.parametrize("rate", [25, 200])
def test_the_rate_is_measured_over_the_first_second(rate):
    """Also where a tenth of the samples is lost, and where the stamps jitter. Milliseconds are
    told: to the tracker they are none of its gaps, and nothing would ever come."""
    random = np.random.default_rng(0)
    stamps = np.arange(3 * rate) / rate + 1.7e9
    stamps = stamps[random.random(len(stamps)) > 0.1]
    stamps += random.uniform(-0.1, 0.1, len(stamps)) / rate
    lines = [f"{stamp!r},0,0,0,0,0,9.81" for stamp in stamps.tolist()]
    assert rate_of(lines) == pytest.approx(rate, rel=0.05)
    assert rate_of(lines, 1.2 * rate) == 1.2 * rate
    with pytest.raises(InputError, match=r"Hz by their stamps; leave out --imu-rate .*measured"):
        rate_of(lines, 2.0 * rate)
    lines = [f"{10 * k},0,0,0,0,0,9.81" for k in range(100)]
    with pytest.raises(InputError, match=r"udp:5: its samples come 10 s apart.*seconds, not in ms"):
        rate_of(lines)
    # A pause is none.
    assert rate_of([f"{k / 100 + 30 * (k > 5)},0,0,0,0,0,9.81" for k in range(100)]) is not None


def test_a_stream_slower_than_the_network_is_followed(follow, tmp_path):
    """Its poses are those of the same walk at the network's own rate, as far as lines can be."""
    found = {}
    for each in (25, 50):
        told = follow(as_lines(walked(each)), "--out", tmp_path / "live.txt")
        assert f"samples come at {each} Hz" in told
        assert ("trained at 50 Hz" in told) == (each < 50)
        found[each] = read_tum(tmp_path / "live.txt")
    rows = np.searchsorted(found[50].time, found[25].time - 1e-3)
    error = found[25].position - found[50].position[rows]
    assert len(rows) > 35 and np.abs(error).max() < 0.3


SPARSE = [line for k, line in enumerate(as_lines(walked())[:200]) if k % 40 > 2]
"""Every second lacks three samples."""


@pytest.mark.parametrize(
    ("lines", "arguments", "problem"),
    [
        ([], ["udp:²"], "udp:²: names no port; write udp:5555"),
        ([], ["udp:203.0.113.1:5555"], "udp:203.0.113.1:5555: cannot listen there"),
        ([], ["udp:5555", "--silence", "-1"], "--silence: must be a time to wait"),
        ([], ["nowhere.csv", "--speed", "-1"], "--speed: must be finite and not negative"),
        ([], ["--rerun", "live.txt"], "--rerun"),
        ([], ["--out", "file/x/y.txt"], "file"),
        (["0,0,0,0,0,0,1.01"] * 30, [], "standard input: its accelerometer reads 1.01"),
        ([], [], "standard input: ended without a single sample; check that"),
        (as_lines(walked())[:30], [], "ended after 30 samples in 0.6 s, before 1 s of rest"),
        (SPARSE, [], "standard input: has no 1 s without a"),
    ],
)
def test_mistakes_are_one_line(mistake, run, monkeypatch, tmp_path, lines, arguments, problem):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    told = mistake("live", *arguments, "--network", run, lines=lines)
    assert problem in told and ("standard input" in told) == (not arguments)


def test_a_recording_played_gives_the_track_of_it(
    gnio, undrawn, follow, run, monkeypatch, tmp_path
):
    """A second and a half of rest with a biased gyro, and a walk that lacks half a second: as long
    as those of the tests of tracks. Only while the rest is not yet seen there is no pose."""
    _, gyro, accel = walked(seconds=5.5)
    noise = np.random.default_rng(0).normal(0, 1e-3, (2, 75, 3))
    gyro = np.concatenate([noise[0], gyro[50:]]) + np.array([0.03, -0.02, 0.01])
    accel = np.concatenate([accel[0] + noise[1], accel[50:]])
    walk = tmp_path / "walk.csv"
    rows = np.column_stack([np.arange(len(gyro)) / RATE, gyro, accel])
    rows = np.delete(rows, np.s_[150:175], axis=0)
    header = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    np.savetxt(walk, rows, delimiter=",", header=header, comments="", fmt="%.12f")
    given = ("--gyro-unit", "rad/s")
    told = follow([], walk, "--speed", "0", "--out", tmp_path / "live.txt", *given)
    monkeypatch.chdir(tmp_path)
    gnio("track", walk, "--out", "track", "--network", run, *given)
    followed, tracked = read_tum(tmp_path / "live.txt"), read_tum(tmp_path / "track/trajectory.txt")
    assert told.startswith(f"following {walk} with run") and "walked" in told
    assert "lacks samples 1 times" in told and "in the quietest second" in told
    assert "warning: gaps: 1, the longest of 0.52 s" in told
    rows = np.searchsorted(tracked.time, followed.time - 1e-4)
    assert rows[0] == round(1.0 / 0.1) and (np.diff(rows[:-1]) == 1).all()
    both = rows < len(tracked.time)  # a track ends with the stamp of its last sample
    assert (~both).sum() <= 1 and both.sum() > 35
    for name in ("position", "orientation"):
        found, wanted = getattr(followed, name)[both], getattr(tracked, name)[rows[both]]
        np.testing.assert_allclose(found, wanted, atol=1e-7)
    assert np.ptp(tracked.position, axis=0).max() > 0.3


@pytest.mark.parametrize(
    ("number", "status", "said"), [(signal.SIGTERM, 143, ""), (signal.SIGINT, 130, "interrupted\n")]
)
def test_a_signal_ends_the_stream_and_nothing_is_lost(
    request, capsys, run, recorded, monkeypatch, tmp_path, number, status, said
):
    lines, out = as_lines(recorded), tmp_path / "live.txt"
    # A shell starts background jobs with Ctrl-C ignored; this one is to hear it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))

    for samples in (10, 155):

        def stream(samples=samples):
            yield from lines[:samples]
            signal.raise_signal(number)
            yield from lines[samples:]

        assert list(tmp_path.iterdir()) == []
        monkeypatch.setattr(sys, "stdin", stream())
        with pytest.raises(SystemExit, match=str(status)):
            console.run(lambda: app.main(["live", "--network", str(run), "--out", str(out)]))
        assert capsys.readouterr().err == said
    # 31 whole intervals of 0.1 s; the first pose is that of the end of the rest.
    time = read_tum(out).time
    np.testing.assert_allclose(time, np.arange(10, 32) / 10, atol=1e-6)


def test_a_gyro_that_turns_gravity_as_degrees_would_is_told():
    time = np.arange(0, 12, 0.02)
    walk = time, np.degrees(known_walk.rate(time)), known_walk.force(time)
    with pytest.raises(InputError, match=r"udp:5: its gyro looks like deg/s.*state the unit"):
        rate_of(as_lines(walk))
    source = live.lines_of(as_lines(walk), "udp:5", ("deg/s", "m/s2"))
    found = list(live.measured(source, print).samples)
    np.testing.assert_allclose([s.gyro for s in found], known_walk.rate(time), atol=1e-9)


class Diverging:
    """A tracker whose filter diverges with the sixth pose, and stays finite: all since is void."""

    def __init__(self):
        self.time = 0

    def push(self, time, gyro, accel):
        self.time += 1
        return pose_at(self.time, [self.time, 0.0, 0.0], healthy=self.time < 6)


@pytest.mark.filterwarnings("error")
def test_what_a_diverged_filter_says_is_not_kept(follow, recorded, monkeypatch, tmp_path):
    monkeypatch.setattr(live, "create_tracker", lambda *_, **__: Diverging())
    told = follow(as_lines(recorded)[:9], "--out", tmp_path / "live.txt")
    assert "THE FILTER DIVERGED" in told and "nan" not in told
    np.testing.assert_allclose(read_tum(tmp_path / "live.txt").position[:, 0], np.arange(1, 6))


def test_a_diverged_filter_is_not_shown(tmp_path, monkeypatch):
    """Of the others all are drawn, the last ones too. What the viewer is sent goes into a file."""
    sdk = pytest.importorskip("rerun", reason="needs rerun-sdk")
    path = tmp_path / "live.rrd"
    monkeypatch.setattr(sdk.RecordingStream, "spawn", lambda recording: recording.save(path))
    tracker = Diverging()
    with rerun.streaming("viewer") as stream:
        for _ in range(9):
            stream.add(tracker.push(None, None, None))
    found = columns_of(path)
    moved = found["/live/pose"]["Transform3D:translation"]
    np.testing.assert_allclose(np.array(moved)[:, 0, 0], np.arange(1, 6))
    drawn = found["/live/estimate/0000"]["LineStrips3D:strips"][-1][0]
    np.testing.assert_allclose(np.array(drawn)[:, 0], np.arange(1, 6))


# --- datagrams


@pytest.fixture
def port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def datagrams(port):
    inbox = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    inbox.bind(("127.0.0.1", port))
    return live.Datagrams(inbox, f"udp:{port}")


def send(port, messages):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for message in messages:
            sender.sendto(message, ("127.0.0.1", port))
    time.sleep(0.1)  # until the thread has them


def test_datagrams_keep_their_order_and_end_with_the_silence(port):
    """What comes before the source is asked for is kept."""
    listening = datagrams(port)
    lines = [[f"{k + j / 10},0,0,0,0,0,9.81" for j in range(3)] for k in range(5)]
    send(port, [*("\n".join(each).encode() for each in lines), b"\xff\xfe"])
    found = list(listening.source(silence=0.3, at_rest=lambda samples: True).samples)
    assert [s.time for s in found[:-1]] == [k + j / 10 for k in range(5) for j in range(3)]
    assert found[-1] is None


@pytest.mark.parametrize("turns", [0.0, 3.0])
def test_what_came_before_counts_where_it_rests(run, port, turns):
    """A phone that is carried about until one is told to hold it still begins anew."""
    stamps, said = np.arange(100) / 50, []
    lines = [f"{t},{turns * np.sin(9 * t)},0,0,{turns * np.sin(9 * t)},0,9.81" for t in stamps]
    listening = datagrams(port)
    send(port, [line.encode() for line in lines])
    at_rest = live.begins_at_rest(networks.load(run))
    source = listening.source(silence=0.2, say=said.append, at_rest=at_rest)
    send(port, [b"2.0,0,0,0,0,0,9.81"])
    assert len(list(source.samples)) == (1 if turns else 101)
    assert said == ["100 datagrams came before the device was still and are left out"] * bool(turns)


def test_it_is_said_where_nothing_comes_and_silence_counts_from_the_first_datagram(
    port, monkeypatch
):
    """However late that comes."""
    monkeypatch.setattr(live, "QUIET_SECONDS", 0.2)
    said = []

    def say(line):
        said.append(line)
        if len(said) == 1:
            send(port, [b"0.0,0,0,0,0,0,9.81"])

    found = list(datagrams(port).source(silence=0.1, say=say).samples)
    assert len(found) == 1 and all(f"nothing has come on udp:{port} for" in each for each in said)


def test_what_is_sent_while_it_compiles_is_not_lost(follow, port, monkeypatch, tmp_path):
    """It listens before it compiles: the rest that it starts from may be over by then."""
    create = live.create_tracker
    lines = [f"{k / RATE},0,0,0,0,0,9.81".encode() for k in range(round(2 * RATE))]

    def meanwhile(*given, **options):
        send(port, lines)
        return create(*given, **options)

    monkeypatch.setattr(live, "create_tracker", meanwhile)
    given = ("--silence", "0.5", "--out", tmp_path / "live.txt")
    told = follow([], f"udp:{port}", *given)
    assert "ready: hold still now, for 1 s" in told
    assert read_tum(tmp_path / "live.txt").time[0] == pytest.approx(1.0, abs=1.5 / RATE)


def test_the_way_is_that_of_a_track():
    """Horizontal, through points 1 s apart, and up to the newest pose, of which no zero is
    negative. Of the others the path alone is kept, or a day would fill the memory with
    covariances."""
    found = live.Followed()
    for k in range(26):  # to and fro within each second, and up
        pose = pose_at(k / 10, [k / 10, 0.3 * (k % 10 == 4) - 1e-3, k / 10])
        first = weakref.ref(pose.covariance) if k == 0 else first
        live._add(found, pose)
    assert "walked 2.5 m" in live.line(found) and "y    +0.00" in live.line(found)
    assert first() is None and len(found.trajectory.time) == 26
