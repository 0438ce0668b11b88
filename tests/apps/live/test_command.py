"""`gnio live`: the trajectory of a stream is that of the tracker, and nonsense is refused."""

import dataclasses
import errno
import importlib.util
import io
import shutil
import signal
import socket
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gnio_jax import networks
from gnio_jax.apps import rerun
from gnio_jax.apps.live import tracking
from gnio_jax.apps.live.checks import Nature
from gnio_jax.apps.live.samples import Arrival, parse_line
from gnio_jax.apps.live.session import Followed
from gnio_jax.apps.live.session import follow as follow_stream
from gnio_jax.apps.live.tracking import begins_at_rest, create_tracker, since_ready
from gnio_jax.commands import app, console
from gnio_jax.config import FilterSettings
from gnio_jax.evaluation.trajectory import read_tum
from gnio_jax.filtering import ConsideredStd, Pose, Tracker, make_filter
from tests.support.filter_settings import changed
from tests.support.live_streams import RATE, as_lines, of_lines, samples_of, texts_of, walked
from tests.support.rerun_files import columns_of


@pytest.fixture(autouse=True)
def handlers():
    """The signals' handlers as they were."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def recorded():
    return walked()


def test_a_stream_gives_the_trackers_poses(follow, run, recorded, monkeypatch, tmp_path):
    """In the file of the trajectory and in that for Rerun, whose path comes in pieces."""
    monkeypatch.setattr(rerun, "LINE_EVERY", 3)
    monkeypatch.setattr(rerun, "LONGEST_PIECE", 9)
    shown = ["--rerun", tmp_path / "live.rrd"] if importlib.util.find_spec("rerun") else []
    out, lines = tmp_path / "live.txt", as_lines(recorded)
    # A header, noise on the line and a repeated sample are refused and counted.
    lines = ["time,gx,gy,gz,ax,ay,az", *lines[:70], "\udcff\udcfe", lines[69], *lines[70:]]
    output = follow(lines, "--out", out, *shown)
    assert {path.name for path in tmp_path.iterdir()} == {"live.txt", *(["live.rrd"] * bool(shown))}
    assert "\x1b" not in output and "warning: 3 lines refused, the first: is not a sample" in output
    # A line a second, the last one repeated at the end.
    assert sum(line.lstrip()[0].isdigit() for line in output.splitlines()) == 6

    tracker, expected = create_tracker(networks.load(run), RATE), []
    for sample in zip(*recorded, strict=True):
        pose = tracker.push(*sample)
        expected += [] if pose is None else [pose]
    path = read_tum(out)
    np.testing.assert_allclose(path.time, [pose.time for pose in expected], atol=1e-8)
    np.testing.assert_allclose(path.position, [p.position for p in expected], atol=1e-8)
    if not shown:
        return
    columns = columns_of(tmp_path / "live.rrd")
    moved = np.array(columns["/live/pose"]["Transform3D:translation"])[:, 0]
    np.testing.assert_allclose(moved, path.position, atol=1e-5)
    seconds = [stamp.total_seconds() for stamp in columns["/live/pose"]["time"]]
    np.testing.assert_allclose(seconds, path.time - path.time[0], atol=1e-6)
    pieces = [
        columns[f"/live/estimate/{number:04d}"]["LineStrips3D:strips"][-1][0] for number in range(5)
    ]
    # Each begins where the one before ended.
    line = np.concatenate([pieces[0], *(piece[1:] for piece in pieces[1:])])
    np.testing.assert_allclose(line, path.position, atol=1e-5)
    assert len(columns["/live/ellipsoid"]["Ellipsoids3D:half_sizes"]) == len(path.time)


def test_the_tracker_of_a_calibrated_run_considers_what_its_track_does(run, monkeypatch):
    options = changed(considered={"scale": 0.1, "heading": np.pi / 2})
    network = networks.load(run)
    calibrated = network._replace(config=dataclasses.replace(network.config, filter=options))
    passed = []

    def noted(_, ekf, **__):
        passed.append(ekf.considered)
        return Tracker.__new__(Tracker)

    monkeypatch.setattr(tracking, "Tracker", noted)
    create_tracker(calibrated, RATE)
    create_tracker(network, RATE)
    assert passed == [ConsideredStd(0.0, 0.1, np.pi / 2, 0.0), None]


def test_gaps_are_said_and_a_stamp_in_the_future_costs_its_sample_alone(follow, recorded):
    """Also rows that are empty are missing; before the start none is missed."""
    lines = as_lines(recorded)
    empty = [f"{line.split(',')[0]},,,,,," for line in lines[100:115]]
    output = follow([*lines[:20], *lines[50:100], *empty, *lines[115:150], *lines[151:]])
    assert "warning: gaps: 1, the longest of 0.32 s: samples are missing" in output
    assert output.index("warning: start: it moved while it should lie still") < output.index(
        "0.0 s  x"
    )
    time, values = lines[150].split(",", 1)
    whole = follow(lines)
    output = follow([*lines[:150], f"{float(time) + 30},{values}", *lines[151:]])
    assert (
        "gaps" not in output and "warning: 1 lines refused" in output and "it moved" not in output
    )
    assert output.splitlines()[-1].split()[0] == whole.splitlines()[-1].split()[0]  # s
    gyro, accel = np.degrees(recorded[1]), recorded[2] / 9.80665
    units = ("--gyro-unit", "deg/s", "--accel-unit", "g")
    assert follow(as_lines((recorded[0], gyro, accel)), *units) == whole
    opposite = as_lines((recorded[0], recorded[1], -recorded[2]))
    output = follow(opposite, "--accel-sign", "ios")
    assert (
        "accel negated (iOS's sign)" in output and output.splitlines()[-1] == whole.splitlines()[-1]
    )


@pytest.mark.parametrize("spoilt", ["late", "lost", "set back", "wrong first"])
def test_streams_that_networks_and_clocks_spoil_are_followed(follow, recorded, tmp_path, spoilt):
    """A datagram a second that comes late or not at all, from the rest on; a clock that is set."""
    stamps, gyro, accel = (field.copy() for field in recorded)
    lines, words = as_lines(recorded), []
    if spoilt == "late":
        for k in range(10, len(lines) - 2, 25):
            lines[k : k + 3] = [lines[k + 2], lines[k], lines[k + 1]]
    elif spoilt == "lost":
        lines = [line for k, line in enumerate(lines) if k % 20 > 1]
    elif spoilt == "set back":
        stamps[120:] -= 1000.0
        lines = as_lines((stamps, gyro, accel))
        words = ["the clock of the samples was set back by", "goes on with a gap of 0.0"]
    else:
        lines.insert(0, "0,0,0,0,0,0,9.81".replace("0", "4000000", 1))
        words = ["warning: 1 lines refused, the first: time: must increase"]
    output = follow(lines, "--out", tmp_path / "spoilt.txt")
    assert all(text in output for text in words) and ("refused" in output) == (
        spoilt == "wrong first"
    )
    follow(as_lines(recorded), "--out", tmp_path / "whole.txt")
    path, expected = read_tum(tmp_path / "spoilt.txt"), read_tum(tmp_path / "whole.txt")
    assert (
        abs(path.time[0] - expected.time[0]) < 0.21
        and abs(path.time[-1] - expected.time[-1]) < 0.11
    )
    if spoilt in ("late", "wrong first"):
        np.testing.assert_allclose(path.position, expected.position, atol=1e-9)


def test_a_stream_slower_than_the_network_is_followed(follow, tmp_path):
    """Its poses are those of the same walk at the network's own rate, as far as lines can be."""
    paths = {}
    for rate in (25, 50):
        output = follow(as_lines(walked(rate)), "--out", tmp_path / "live.txt")
        assert f"samples come at {rate} Hz" in output
        assert ("trained at 50 Hz" in output) == (rate < 50)
        paths[rate] = read_tum(tmp_path / "live.txt")
    rows = np.searchsorted(paths[50].time, paths[25].time - 1e-3)
    error = paths[25].position - paths[50].position[rows]
    assert len(rows) > 35 and np.abs(error).max() < 0.3


EXAMPLE = Path(__file__).parents[3] / "examples" / "walk.csv"
SPARSE = [line for k, line in enumerate(as_lines(walked())[:200]) if k % 40 > 9]
"""Of every 0.8 s are missing 0.2 s, and the filter bridges 0.1 s."""


@pytest.mark.parametrize(
    ("lines", "arguments", "problem"),
    [
        ([], ["udp:²"], "udp:²: names no port; write udp:5555"),
        ([], ["udp:203.0.113.1:5555"], "udp:203.0.113.1:5555: cannot listen there"),
        ([], ["udp:5555", "--silence", "-1"], "--silence: must be a time to wait"),
        ([], ["http:0.0.0.0"], "http:0.0.0.0: names no port; write 8000"),
        ([], ["phyphox:"], "phyphox:: is not an address"),
        ([], ["--page", "x"], "--page x: names no port"),
        (
            [],
            ["walk.csv", "--out", "./walk.csv"],
            "--out: 'walk.csv' is the recording; name another file",
        ),
        (
            *([], [EXAMPLE, "--imu-rate", "10"]),
            "walk: its samples come at 100 Hz by their stamps; leave out --imu-rate 10",
        ),
        ([], ["nowhere.csv", "--speed", "-1"], "--speed: must be finite and not negative"),
        ([], ["--rerun", "live.txt"], "--rerun"),
        ([], ["--out", "file/x/y.txt"], "file"),
        (["0,0,0,0,0,0,1.01"] * 30, [], "standard input: ended after 1 samples in 0.0 s"),
        ([f"{k / 50},0,0,0,0,0,1.01" for k in range(60)], [], "standard input: its acc"),
        ([], [], "standard input: ended without a single sample; check that"),
        (as_lines(walked())[:30], [], "ended after 30 samples in 0.6 s, before 1 s of rest"),
        (SPARSE, [], "standard input: has no rest of 1 s in 3.8 s: samples are missing for 0.2 s"),
        ([f"{k / 50},0,0,0,999,999,-999" for k in range(10)], [], "standard input: ended after"),
    ],
)
def test_mistakes_are_one_line(mistake, run, monkeypatch, tmp_path, lines, arguments, problem):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    shutil.copy(EXAMPLE, tmp_path / "walk.csv")
    message = mistake("live", *arguments, "--network", run, lines=lines)
    assert problem in message and ("standard input" in message) == (not arguments)
    assert (tmp_path / "walk.csv").read_bytes() == EXAMPLE.read_bytes()


def test_a_standard_input_that_is_closed_is_one_line(run, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(SystemExit, match="2"):
        console.run(lambda: app.main(["live", "--network", str(run)]))
    assert "standard input: is closed; pipe samples into it" in capsys.readouterr().err


def test_a_recording_played_gives_the_track_of_it(
    gnio, undrawn, follow, run, monkeypatch, tmp_path
):
    """A second and a half of rest with a biased gyro, and a walk that lacks half a second: as long
    as those of the tests of tracks. Only before the rest is over there is no pose."""
    _, gyro, accel = walked(seconds=5.5)
    noise = np.random.default_rng(0).normal(0, 1e-3, (2, 75, 3))
    gyro = np.concatenate([noise[0], gyro[50:]]) + np.array([0.03, -0.02, 0.01])
    accel = np.concatenate([accel[0] + noise[1], accel[50:]])
    walk = tmp_path / "walk.csv"
    stamps = 1.7e9 + np.arange(len(gyro)) / RATE  # both have those of the recording's own clock
    rows = np.delete(np.column_stack([stamps, gyro, accel]), np.s_[150:175], axis=0)
    header = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    np.savetxt(walk, rows, delimiter=",", header=header, comments="", fmt="%.12f")
    units = ("--gyro-unit", "rad/s")
    output = follow([], walk, "--speed", "0", "--out", tmp_path / "live.txt", *units)
    monkeypatch.chdir(tmp_path)
    gnio("track", walk, "--out", "track", "--network", run, *units)
    followed, tracked = read_tum(tmp_path / "live.txt"), read_tum(tmp_path / "track/trajectory.txt")
    assert output.startswith(f"following {walk} with run") and "walked" in output
    assert "lacks samples 1 times" in output and "in the quietest second" in output
    assert "warning: gaps: 1, the longest of 0.52 s" in output
    rows = np.searchsorted(tracked.time, followed.time - 1e-4)
    assert followed.time[0] == pytest.approx(1.7e9 + 1.0, abs=1e-5)
    assert rows[0] == round(1.0 / 0.1) and (np.diff(rows[:-1]) == 1).all()
    overlap = rows < len(tracked.time)  # a track ends with the stamp of its last sample
    assert (~overlap).sum() <= 1 and overlap.sum() > 35
    for name in ("position", "orientation"):
        values, expected = getattr(followed, name)[overlap], getattr(tracked, name)[rows[overlap]]
        np.testing.assert_allclose(values, expected, atol=1e-7)
    assert np.ptp(tracked.position, axis=0).max() > 0.3


@pytest.mark.parametrize(
    ("number", "status", "message"),
    [(signal.SIGTERM, 143, ""), (signal.SIGINT, 130, "interrupted\n")],
)
def test_a_signal_ends_the_stream_and_nothing_is_lost(
    request, capsys, run, recorded, monkeypatch, tmp_path, number, status, message
):
    content, out = "\n".join(as_lines(recorded)).encode(), tmp_path / "live.txt"
    # A shell starts background jobs with Ctrl-C ignored; this one is to hear it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    push = Tracker.push

    for samples in (10, 155):
        pushed = []

        def push_and_signal(*row, pushed=pushed, samples=samples):
            pushed.append(row)
            pose = push(*row)
            if len(pushed) == samples + 1:
                signal.raise_signal(number)
            return pose

        assert list(tmp_path.iterdir()) == []
        monkeypatch.setattr(Tracker, "push", push_and_signal)
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content)))
        with pytest.raises(SystemExit, match=str(status)):
            console.run(lambda: app.main(["live", "--network", str(run), "--out", str(out)]))
        assert capsys.readouterr().err == message
    # 31 whole intervals of 0.1 s; the first pose is that of the end of the rest.
    time = read_tum(out).time
    np.testing.assert_allclose(time, np.arange(10, 32) / 10, atol=1e-6)


def test_a_terminal_that_is_closed_loses_nothing(run, recorded, monkeypatch, tmp_path):
    """Nothing can be shown any more, and the trajectory is written nevertheless."""
    content, out = "\n".join(as_lines(recorded)).encode(), tmp_path / "live.txt"
    push, say, pushed = Tracker.push, console.say, []

    def push_and_hang_up(*row):
        pushed.append(row)
        if len(pushed) == 156:
            signal.raise_signal(signal.SIGHUP)
        return push(*row)

    def say_or_fail(text):
        if len(pushed) >= 156:
            raise OSError(errno.EIO, "Input/output error")
        say(text)

    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    monkeypatch.setattr(Tracker, "push", push_and_hang_up)
    monkeypatch.setattr(console, "say", say_or_fail)
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content)))
    with pytest.raises(SystemExit):
        console.run(lambda: app.main(["live", "--network", str(run), "--out", str(out)]))
    np.testing.assert_allclose(read_tum(out).time, np.arange(10, 32) / 10, atol=1e-6)


class Diverging:
    """A tracker whose filter diverges with the pose `first`, and stays finite: all since is
    void."""

    hindrance = ""

    def __init__(self, first=6):
        self.time, self.first = 0, first

    def set_rate(self, *_):
        pass

    def push(self, time, gyro, accel):
        self.time += 1
        zero, healthy = np.zeros(3), self.time < self.first
        covariance = np.eye(15) * (1.0 if healthy else -1.0)
        position = np.array([self.time, 0.0, 0.0])
        poses = (np.eye(3), zero, position, zero, zero, covariance, 1.0, 1.0, healthy)
        return Pose(float(self.time), *poses, "" if healthy else "a speed of 700 m/s")


@pytest.mark.filterwarnings("error")
def test_what_a_diverged_filter_says_is_not_kept(follow, recorded, monkeypatch, tmp_path):
    monkeypatch.setattr(tracking, "create_tracker", lambda *_, **__: Diverging())
    output = follow(as_lines(recorded)[:9], "--out", tmp_path / "live.txt")
    assert "THE FILTER DIVERGED" in output and "nan" not in output
    np.testing.assert_allclose(read_tum(tmp_path / "live.txt").position[:, 0], np.arange(1, 6))


def test_a_filter_that_diverges_at_once_is_one_line(
    gnio, run, recorded, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(tracking, "create_tracker", lambda *_, **__: Diverging(first=0))
    words = ("live", "--network", run, "--out", tmp_path / "live.txt")
    with pytest.raises(SystemExit, match="2"):
        gnio(*words, lines=as_lines(recorded)[:90])
    output = capsys.readouterr()
    assert output.err.count("\n") == 1
    assert "standard input: the filter diverged at once (a speed of 700 m/s); hold" in output.err
    assert "THE FILTER DIVERGED (a speed" in output.out and list(tmp_path.iterdir()) == []


def test_a_diverged_filter_is_not_shown(tmp_path, monkeypatch):
    """Of the others all are drawn, the last ones too. What the viewer is sent goes into a file."""
    sdk = pytest.importorskip("rerun", reason="needs rerun-sdk")
    path = tmp_path / "live.rrd"
    monkeypatch.setattr(sdk.RecordingStream, "spawn", lambda recording: recording.save(path))
    tracker = Diverging()
    with rerun.streaming("viewer") as stream:
        for _ in range(9):
            stream.add(tracker.push(None, None, None))
    columns = columns_of(path)
    moved = columns["/live/pose"]["Transform3D:translation"]
    np.testing.assert_allclose(np.array(moved)[:, 0, 0], np.arange(1, 6))
    drawn = columns["/live/estimate/0000"]["LineStrips3D:strips"][-1][0]
    np.testing.assert_allclose(np.array(drawn)[:, 0], np.arange(1, 6))


# --- before it is ready


@pytest.mark.parametrize("turns", [0.0, 3.0])
def test_what_came_before_it_is_ready_counts_if_it_rests(run, turns):
    """A phone that is carried about until one is told to hold it still begins anew."""
    stamps = np.arange(100) / 50
    lines = [f"{t},{turns * np.sin(9 * t)},0,0,{turns * np.sin(9 * t)},0,9.81" for t in stamps]
    config = networks.load(run).config
    ekf = make_filter(config.data, config.filter)
    later = Arrival(6.0, parse_line("2.0,0,0,0,0,0,9.81"))
    stage = list(since_ready(iter([*of_lines(lines), later]), 5.0, ekf))
    assert len(samples_of(stage)) == (1 if turns else 101)
    notice = "100 samples came before the device was still and are left out"
    assert texts_of(stage) == [notice] * bool(turns)
    weightless = [parse_line(f"{t},0,0,0,0,0,1.0") for t in stamps]  # in g: it is said later
    assert begins_at_rest(weightless, ekf)


def test_what_is_sent_while_it_compiles_is_not_lost(follow, monkeypatch, tmp_path):
    """It listens before it compiles: the rest that it starts from may be over by then."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    create = tracking.create_tracker
    lines = [f"{k / RATE},0,0,0,0,0,9.81".encode() for k in range(round(2 * RATE))]

    def meanwhile(*arguments, **options):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for line in lines:
                sender.sendto(line, ("127.0.0.1", port))
        time.sleep(0.1)
        return create(*arguments, **options)

    monkeypatch.setattr(tracking, "create_tracker", meanwhile)
    output = follow([], f"udp:{port}", "--silence", "0.5", "--out", tmp_path / "live.txt")
    assert "ready: hold still now, for 1 s" in output
    assert read_tum(tmp_path / "live.txt").time[0] == pytest.approx(1.0, abs=1.5 / RATE)


@pytest.mark.parametrize("holds", [True, False])
def test_a_filter_that_does_not_hold_the_rest_says_so(run, follow, recorded, monkeypatch, holds):
    """Its poses say that the device is quiet nevertheless."""
    network = networks.load(run)
    config = dataclasses.replace(network.config, filter=FilterSettings())
    trained = network if holds else network._replace(config=config)
    monkeypatch.setattr(networks, "load", lambda _: trained)
    output = follow(as_lines(recorded))
    assert ("does not hold the position while the device rests" in output) != holds
    result, tracker = Followed(), create_tracker(trained, RATE)
    still = [f"{k / RATE},0,0,0,0,0,9.81" for k in range(150)]
    nature = Nature("udp:5")
    follow_stream(tracker, of_lines(still), nature, result, lambda _: None, print)
    assert result.pose.quiet
