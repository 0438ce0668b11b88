"""From a recording as people have it to a folder with a trajectory, its picture and its limits.

All recordings last six seconds and lack some samples, so that they share one compiled filter.
"""

import dataclasses
import importlib.util
import json

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.apps.importing import Imported, import_recording
from gnio_jax.apps.sensors import SensorUse
from gnio_jax.apps.summary import (
    Summary,
    _warnings_of_errors,
    _warnings_of_gait,
    _warnings_of_gaps,
    _warnings_of_walk,
    summarise,
)
from gnio_jax.apps.track import estimate_recording, track
from gnio_jax.config import DataConfig, EvaluateConfig, FilterSettings, ModelConfig, TrainConfig
from gnio_jax.data.gait import Gait
from gnio_jax.data.hdf5 import write_hdf5
from gnio_jax.data.resampling import resample
from gnio_jax.evaluation import evaluate
from gnio_jax.evaluation.trajectory import read_tum
from gnio_jax.filtering import make_filter
from gnio_jax.networks import read_network
from gnio_jax.types import Sequence, Waypoints
from tests.support import bag_files, known_walk, logger_files, tiny_run
from tests.support.filter_settings import changed

CONFIG = TrainConfig(data=DataConfig(rate=50.0), model=ModelConfig(name="tiny"))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """`walker` says something of each window, `mute` nothing: zero, give or take a metre."""
    folder = tmp_path_factory.mktemp("home") / "runs"
    with tiny_run.registry_entry():
        settings = changed(considered={"raw_gyro_bias": 0.02})
        settings = dataclasses.replace(settings, measurements={"zero_velocity": {"std": 0.02}})
        tiny_run.save(folder / "mute", dataclasses.replace(CONFIG, filter=settings), size=0.0)
        tiny_run.save(folder / "walker", CONFIG)
        yield folder


@pytest.fixture(autouse=True)
def home(monkeypatch, runs):
    monkeypatch.chdir(runs.parent)


def csv(path, time, gyro=None, accel=None, start=0.0):
    """By default of the known walk."""
    header = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    gyro = known_walk.rate(time) if gyro is None else gyro
    accel = known_walk.force(time) if accel is None else accel
    rows = np.column_stack([time + start, gyro, accel])
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9f")
    return path


def summary_of(folder):
    return json.loads((folder / "summary.json").read_text())


def test_a_bag_with_a_reference(gnio, runs, tmp_path):
    one = (Rotation.identity(), np.zeros(3))
    make = bag_files.Maker("mcap")
    imu = bag_files.imu(make)
    del imu[300:320]
    entries = imu + bag_files.poses(make, "Odometry", one, child="imu_link")
    walk = bag_files.write(tmp_path, "mcap", entries)
    out = tmp_path / "track"
    arguments = ["track", walk, "--network", runs / "walker", "--out", out, "--format", "csv"]
    rerun = tmp_path / "walk.rrd"
    if importlib.util.find_spec("rerun"):
        arguments += ["--rerun", rerun]
    output = gnio(*arguments)
    assert rerun.exists() == ("--rerun" in arguments)
    names = "reference.txt report.html summary.json track.png trajectory.csv trajectory.txt"
    assert sorted(path.name for path in out.iterdir()) == names.split()
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "expected error at the end" in page and f"--out {out}" in page
    assert (out / "track.png").read_bytes().startswith(b"\x89PNG")
    path, summary = read_tum(out / "trajectory.txt"), summary_of(out)
    # In the recording's own clock, from its first sample on, to whole strides.
    np.testing.assert_allclose(path.time[0], bag_files.EPOCH * 1e-9, atol=1e-6)
    np.testing.assert_allclose(np.diff(path.time), 0.1, atol=1e-6)
    assert len(path.time) == 60
    np.testing.assert_allclose(path.position[0], 0.0, atol=1e-9)
    seconds = path.position[[*range(0, 60, 10), 59], :2]
    length = np.linalg.norm(np.diff(seconds, axis=0), axis=1).sum()
    np.testing.assert_allclose(summary["path_length"], length, atol=1e-6)
    np.testing.assert_allclose(summary["from_start"], np.hypot(*path.position[-1, :2]), atol=1e-6)
    assert summary["climb"] == pytest.approx(np.ptp(path.position[:, 2]), abs=1e-6)
    assert summary["running"] == 0.0 and "gyro: raw" not in output
    reference = read_tum(out / "reference.txt")
    expected = known_walk.position(reference.time - bag_files.EPOCH * 1e-9)
    np.testing.assert_allclose(reference.position, expected, atol=5e-3)
    # The error with the starts aligned, by hand.
    rows = np.isin(np.round(path.time, 3), np.round(reference.time, 3))
    moved = path.position[rows] - path.position[rows][0]
    firsts = [reference.orientation[0], path.orientation[np.flatnonzero(rows)[0]]]
    true, estimate = Rotation.from_quat(firsts, scalar_first=True).as_matrix()
    turn = true @ estimate.T
    angle = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    moved = Rotation.from_euler("z", angle).apply(moved)
    error = (moved - (reference.position - reference.position[0]))[:, :2]
    ate = np.sqrt((error**2).sum(axis=1).mean())
    np.testing.assert_allclose(summary["errors"]["ate_2d"], ate, rtol=1e-3)
    assert f"{ate:.2f} m" in output and "against the reference" in output
    assert "warning: calibration: the filter's covariances were not calibrated" in output
    assert "network walker: its error was not measured (gnio evaluate)" in output
    assert f"expected error at the end {summary['expected_error']:.1f} m" in " ".join(
        output.split()
    )
    assert summary["steps"] == 1.0 and "time with steps" in output
    assert "IMU /imu/data" in output and f"results: {out}" in output


def test_a_phone_on_a_table_stays_there(gnio, runs, tmp_path):
    """Its accelerometer is wrong by 3 cm/s²: half a metre in six seconds. The network is mute."""
    time = np.arange(600) / 100
    random = np.random.default_rng(0)
    gyro = random.normal([0.01, -0.02, 0.015], 1e-3, (600, 3))
    accel = random.normal([0.0, 0.0, 9.81], 0.01, (600, 3))
    accel[100:, 0] += 0.03  # after the second that levels it
    rows = np.delete(np.arange(600), np.s_[560:580])
    table = csv(tmp_path / "table.csv", time[rows], gyro[rows], accel[rows])
    out = tmp_path / "track"
    output = gnio("track", table, "--network", runs / "mute", "--out", out, "--gyro-unit", "rad/s")
    path = read_tum(out / "trajectory.txt")
    assert np.linalg.norm(path.position, axis=1).max() < 0.05
    turned = Rotation.from_quat(path.orientation[-1], scalar_first=True).magnitude()
    assert turned < np.radians(0.5)  # the bias, 1.5° in this time, is that of the rest
    assert "warning: rest: it lies still" in output and "it moves" not in output
    assert "gyro bias: mean of 5 s of rest" in output
    assert "warning: calibration: " in output  # its gyro does not count as raw
    assert output.startswith("warning: no walk: there are no steps")
    assert "expected error" not in output + (out / "report.html").read_text(encoding="utf-8")
    assert "expected_error" not in summary_of(out)


def test_the_newest_run_a_slow_logger_and_our_own_file(gnio, undrawn, runs, tmp_path, monkeypatch):
    time = np.delete(np.arange(120), np.s_[60:70]) / 20
    slow = csv(tmp_path / "slow.csv", time)
    monkeypatch.setattr("gnio_jax.networks.find.SHIPPED", tmp_path)
    output = gnio("track", slow)
    folder = runs.parent / "tracks" / "slow"
    assert summary_of(folder)["network"] == "walker"
    assert "lacks samples 1 times, for up to 0.55 s" in output and "warning: gaps:" in output
    rate = "rate: recorded at 20 Hz, the network was trained at 50 Hz: the content above 10 Hz"
    assert f"warning: {rate}" in output
    assert "warning: start: it moves in its first second" in output
    assert "gyro bias: no rest at the start (quieter than a hand)" in output
    gnio("data", "import", slow, "--out", tmp_path / "slow.h5")
    again = gnio("track", tmp_path / "slow.h5", "--out", tmp_path / "again")
    of_gaps = [line for line in output.splitlines() if "lacks samples" in line or "gaps" in line]
    assert len(of_gaps) == 3 and set(of_gaps) <= set(again.splitlines())
    assert summary_of(tmp_path / "again")["notes"] == summary_of(folder)["notes"]
    ours, theirs = (read_tum(x / "trajectory.txt").position for x in (tmp_path / "again", folder))
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    # What was resampled to a higher rate has no more in it.
    gnio("data", "import", slow, "--rate", "100", "--out", tmp_path / "fast.h5")
    assert f"warning: {rate}" in gnio("track", tmp_path / "fast.h5", "--out", tmp_path / "fast")


def test_the_name_of_a_file_may_have_bytes_that_are_no_text(gnio, undrawn, runs, tmp_path):
    """As an archive of another system unpacks them: it is tracked, and imported."""
    walk = csv(tmp_path / "walk\udcff.csv", np.delete(np.arange(600), np.s_[200:270]) / 100)
    weights = ("--network", runs / "walker")
    gnio("track", walk, *weights, "--out", tmp_path / "track")
    assert summary_of(tmp_path / "track")["recording"] == "walk\udcff"
    gnio("data", "import", walk, "--out", tmp_path / "walk.h5")
    again = gnio("track", tmp_path / "walk.h5", *weights, "--out", tmp_path / "again")
    assert r"walk\udcff.csv: accel taken as m/s2" in again


def test_what_is_refused(mistake, runs, tmp_path, monkeypatch):
    """Also what cannot be written, stamps that ROS cannot hold among it: before the work."""
    monkeypatch.setattr("gnio_jax.apps.track.prepare", lambda *_, **__: pytest.fail("too late"))
    weights = ("--network", runs / "walker")
    time = np.arange(300) / 100
    for start, words in ((-5.0, "stamps begin at -5 s"), (3e9, "ROS counts seconds in 32 bits")):
        odd = csv(tmp_path / "odd.csv", time, start=start)
        assert words in mistake("track", odd, *weights, "--format", "mcap", "--time-unit", "s")
    short = csv(tmp_path / "short.csv", np.arange(50) / 100)
    assert "were recorded for 0.49 s" in mistake("track", short, *weights)
    members = logger_files.sensor_logger()
    walk = logger_files.zipped(tmp_path / "walk.zip", members)
    arguments = ("track", walk, *weights)
    thesis = tmp_path / "mine" / "thesis.txt"
    thesis.parent.mkdir()
    thesis.write_text("mine")
    (thesis.parent / "summary.json").write_text("{}")
    assert "is not an earlier track" in mistake(*arguments, "--out", thesis.parent)
    assert "is not an earlier track" in mistake(*arguments, "--out", thesis)
    assert thesis.read_text() == "mine"
    assert f"{walk}: " in mistake(*arguments, "--out", walk / "track")
    assert "no such network" in mistake("track", walk, "--network", "walkr2")
    del members["TotalAcceleration.csv"], members["Accelerometer.csv"]
    del members["AccelerometerUncalibrated.csv"], members["Gravity.csv"]
    deaf = logger_files.zipped(tmp_path / "deaf.zip", members)
    assert "deaf.zip" in mistake("track", deaf, *weights)
    assert not list(runs.parent.glob("tracks/.*"))


def without_poses(name, time):
    nothing = np.full((len(time), 3), np.nan)
    level, valid = np.full((len(time), 4), np.nan), np.zeros(len(time), bool)
    rate, force = known_walk.rate(time), known_walk.force(time)
    return Sequence(name, time, rate, force, level, nothing, nothing, valid)


def test_our_own_file_with_holes(gnio, undrawn, mistake, runs, tmp_path):
    """It comes to the tracker as it is: nobody has looked for holes yet."""
    arguments = ("track", tmp_path / "walk.h5", "--network", runs / "walker")
    for lost, name in ((70, "../../walk"), (320, "walk")):
        time = np.delete(np.arange(900), np.s_[200 : 200 + lost])[:530] / 100
        sequence = without_poses(name, time)
        write_hdf5(tmp_path / "walk.h5", sequence)
        if lost == 70:
            # Whatever the file says of itself, the folder lies in tracks/.
            output = gnio(*arguments)
            assert "warning: gaps: samples are missing, and nothing shows the turn" in output
            assert (runs.parent / "tracks" / "_.._walk" / "summary.json").is_file()
        else:
            message = mistake(*arguments)
            assert (
                "walk: field 'time' has a gap of 3.210 s after row 200, longer than 1 s" in message
            )
            # The same on a clock that runs through the hole.
            write_hdf5(tmp_path / "walk.h5", resample(sequence, 100.0))
            assert "walk: field 'time' has a gap of 3.210 s" in mistake(*arguments)


def test_a_recording_with_waypoints_is_compared_with_them(gnio, runs, tmp_path):
    time = np.delete(np.arange(620), np.s_[560:580]) / 100
    taps = Waypoints(time[[0, 200, 400, 599]], known_walk.position(time[[0, 200, 400, 599]])[:, :2])
    write_hdf5(tmp_path / "mall.h5", without_poses("mall", time)._replace(waypoints=taps))
    options = ("--network", runs / "walker", "--out", tmp_path / "t")
    output = gnio("track", tmp_path / "mall.h5", *options)
    errors = summary_of(tmp_path / "t")["errors"]
    # By hand: the lengths of the legs do not depend on the alignment.
    path = read_tum(tmp_path / "t" / "trajectory.txt")
    coordinates = [
        np.interp(taps.time, path.time - path.time[0], path.position[:, k]) for k in (0, 1)
    ]
    ours, true = (
        np.linalg.norm(np.diff(x, axis=0), axis=1) for x in (np.array(coordinates).T, taps[1])
    )
    assert errors["leg_path_ratio"] == pytest.approx(ours.sum() / true.sum(), rel=1e-3)
    shown = f"waypoint rms (against the reference) {errors['waypoint_rms']:.2f} m"
    assert shown in " ".join(output.split())
    assert "ate" not in errors and "ATE" not in output
    page = (tmp_path / "t" / "report.html").read_text(encoding="utf-8")
    assert "at waypoints" in page and "one turn and one shift" in page


def test_a_reference_of_a_part_is_no_figure_of_the_whole(gnio, runs, tmp_path, monkeypatch):
    """The page has the length of the track, and says of how much the errors are.

    The recording has a raw gyro and shakes as a runner's after its first second.
    """
    shown = []
    monkeypatch.setattr(
        "gnio_jax.evaluation.page.write", lambda *arguments: shown.extend(arguments[2])
    )
    time = np.delete(np.arange(620), np.s_[560:580]) / 100
    coverage = (time >= 2.0) & (time < 3.5)
    position, level = known_walk.position(time), np.tile([1.0, 0, 0, 0], (len(time), 1))
    poses = {"position": position, "velocity": known_walk.velocity(time), "orientation": level}
    poses = {name: np.where(coverage[:, None], values, np.nan) for name, values in poses.items()}
    walk = without_poses("part", time)._replace(valid=coverage, **poses)
    shaken = walk.accel * (1 + 0.9 * np.sin(18.0 * time) * (time > 1.0))[:, None]
    walk = walk._replace(accel=shaken, attributes={"imu_compensated": "no"})
    write_hdf5(tmp_path / "part.h5", walk)
    options = ("--network", runs / "walker", "--out", tmp_path / "t")
    output = gnio("track", tmp_path / "part.h5", *options)
    assert "warning: gyro: raw, and without a rest that shows its bias" in output
    assert "warning: running: in 83% of the seconds it is shaken as in a run" in output
    summary = summary_of(tmp_path / "t")
    assert summary["running"] == pytest.approx(5 / 6)
    figures = shown[0].figures["part"]
    assert figures["ate"] == summary["errors"]["ate"]
    assert figures["path_length"] == summary["path_length"] != summary["errors"]["path_length"]
    assert shown[0].facts["reference"].startswith("known for 24% of the time")


def test_the_start_is_as_sure_as_the_filter_of_the_run_says(runs, tmp_path, monkeypatch):
    filters = []

    def prepare(_, windows, ekf, **options):
        filters.append(ekf)
        raise InterruptedError

    monkeypatch.setattr("gnio_jax.apps.track.prepare", prepare)
    network = read_network(runs / "walker")
    settings = dataclasses.replace(changed(start={"velocity": 0.7}), raw_gyro_bias=0.02)
    network = network._replace(config=dataclasses.replace(network.config, filter=settings))
    walk = Imported(without_poses("walk", np.arange(620) / 100), (), ())
    with pytest.raises(InterruptedError):
        track(walk, network, tmp_path / "t")
    assert filters[0].start.velocity == 0.7 and filters[0].raw_gyro_bias == 0.02


FIGURES = (0.0, 100.0, 80.0, 1.0, 2.0, 1.0, 0.0, 0.0, 0.5, 1.0)
SUMMARY = Summary("walk", "net", "walks", "", *FIGURES, {}, (), ())
FILTER = make_filter(DataConfig(), FilterSettings(measurements={"zero_velocity": {"std": 0.02}}))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, None),
        ({"accepted": 0.71}, "gate: the filter refused 29% of"),
        ({"at_rest": 0.97}, "rest: it lies still 97% of the time, and the filter holds"),
        ({"running": 0.94}, "running: in 94% of the seconds it is shaken as in a run"),
        ({"climb": 4.26}, "height: it changes by 4.3 m: that is drift unless"),
        ({"climb": 4.26, "sensors": (SensorUse("barometer", 9, 0.9, ""),)}, None),
        ({"path_length": 400.0}, "speed: 4.0 m/s in the mean"),
        ({"errors": {"nees_coverage_2d": 88.0}}, None),
        (
            {"errors": {"nees_coverage_2d": 100.0, "nees_coverage": 5.3}},
            "errors: larger than the filter says: its 95 % region of place and height holds the",
        ),
    ],
)
def test_what_is_worth_a_warning(changes, words):
    summary = SUMMARY._replace(**changes)
    warnings = _warnings_of_walk(summary, 1.0 / FILTER.config.dt, FILTER)
    warnings += _warnings_of_errors(summary)
    assert [line[: len(words)] for line in warnings] == [words] if words else warnings == []


def test_a_filter_that_does_not_measure_rest_is_not_said_to_hold_the_position():
    plain = make_filter(DataConfig(), FilterSettings())
    summary = SUMMARY._replace(at_rest=0.97)
    (warning,) = _warnings_of_walk(summary, 1.0 / plain.config.dt, plain)
    assert "rest: it lies still 97% of the time, and the filter does not measure this" in warning
    assert "holds" not in warning


@pytest.mark.parametrize(("std", "counted"), [(0.8, False), (0.0, True)])
def test_a_gap_that_the_filter_does_not_count_is_told(runs, std, counted):
    settings = dataclasses.replace(FilterSettings(), gap_gyro_std=std, gap_accel_std=std)
    time = np.delete(np.arange(620), np.s_[300:330]) / 100
    network = read_network(runs / "walker")
    config = dataclasses.replace(network.config, filter=settings)
    walk = without_poses("walk", time)
    _, ready, ekf, *_ = estimate_recording(walk, {}, network._replace(config=config))
    warnings = _warnings_of_gaps(ready, Imported(without_poses("walk", time), (), ()), ekf)
    (gaps,) = [warning for warning in warnings if warning.startswith("gaps: ")]
    assert ("more so than the filter says" in gaps) == counted


def test_a_track_that_diverged_has_no_expected_error(runs):
    walk = without_poses("walk", np.arange(620) / 100)
    network = read_network(runs / "walker")
    estimate, ready, ekf, *_ = estimate_recording(walk, {}, network)
    arguments = ({}, ready, Imported(walk, (), ()), network, ekf)
    assert summarise(estimate, *arguments).expected_error > 0
    path = estimate.trajectory
    early = np.arange(len(path.time))[:, None] < 2
    lost = path._replace(position=np.where(early, path.position, np.nan))
    note = "filter: diverged at 0.1 s (a cause)"
    summary = summarise(estimate._replace(trajectory=lost, notes=(note,)), *arguments)
    assert np.isnan(summary.expected_error) and summary.warnings[0] == note


def test_a_part_without_steps_is_named():
    walking = np.ones(100, bool)
    walking[20:25] = walking[40:70] = False
    quiet = np.zeros(100, bool)
    gait = Gait(walking, ~walking & quiet, quiet)
    (warning,) = _warnings_of_gait(gait, 0.65)
    assert warning.startswith("no walk in 35% of the time, the longest from 40 s to 70 s: it moves")
    assert _warnings_of_gait(gait._replace(quiet=~walking), 0.65) == []  # it lay on a table
    (none,) = _warnings_of_gait(gait._replace(walking=~walking & (np.arange(100) > 65)), 0.04)
    assert none.startswith("no walk: there are no steps in 96% of the time. The network")
    assert none.endswith("For a car, give --carrier car")


@pytest.mark.parametrize("network", ["mute", "walker"])
def test_evaluation_and_track_of_one_walk_are_equal_to_the_bit(runs, tmp_path, network):
    """From the same start: what is measured is what is tracked, with the measurements that the
    settings list."""
    time, folder = np.arange(0, 6.02, 0.02), tmp_path / "walks"
    folder.mkdir()
    orientation = known_walk.attitude(time).as_quat(scalar_first=True)
    columns = [time, known_walk.rate(time), known_walk.force(time), orientation]
    names = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z,qw,qx,qy,qz,px,py,pz"
    rows = np.column_stack([*columns, known_walk.position(time)])
    np.savetxt(folder / "walk.csv", rows, delimiter=",", header=names, comments="", fmt="%.9f")
    walk = import_recording(folder / "walk.csv")
    tracked = track(walk, read_network(runs / network), tmp_path / "t").estimate
    config = EvaluateConfig(
        network=str(runs / network),
        dataset="csv",
        data_root=str(folder),
        init="static",
        gyro_bias="rest",
        plots=False,
    )
    (evaluated,) = evaluate(config).estimates
    assert np.ptp(tracked.trajectory.position) > 0.01
    for part in ("trajectory", "filtered", "states"):
        jax.tree.map(
            np.testing.assert_array_equal, getattr(tracked, part), getattr(evaluated, part)
        )
