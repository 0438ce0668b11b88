"""OxIOD: known walks written as native files, traps included, must come back."""

import functools
import pickle

import loky
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.alignment import body
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.loading import read_recording
from gnio_jax.data.readers import oxiod
from gnio_jax.data.self_check import self_check
from gnio_jax.numerics import rotations
from tests.support import oxiod_files as files
from tests.support.sequences import assert_same_arrays


def dataset(tmp_path, scene, folder):
    return tmp_path / "downloaded" / "Oxford Inertial Odometry Dataset" / scene / folder


def read_back(tmp_path, write, kind, truth, session=("handheld", "data1"), seconds=25):
    """(the sequence of one walk that `write` wrote, the stamps of the known walk)."""
    write(dataset(tmp_path, *session), 3, truth, seconds=seconds)
    (walk,) = oxiod.find_walks(tmp_path)
    (sequence,) = oxiod.build(walk, kind)
    start = sequence.attributes["start_time"] - (files.EPOCH if kind == "raw" else 0.0)
    return sequence, sequence.time + start


def compare(sequence, truth, time):
    """Reference, IMU and what the fit has found; the world's yaw and origin are Vicon's own."""
    keep, a, walk = sequence.valid, sequence.attributes, truth.walk
    off = np.linalg.norm(sequence.position - walk.position(time), axis=1)[keep]
    assert np.quantile(off, 0.95) < 2e-3 and off.max() < 4e-3  # beside the flip and the jump
    speed = np.linalg.norm(sequence.velocity - walk.velocity(time), axis=1)[keep]
    assert np.sqrt((speed**2).mean()) < 0.01
    turn = rotations(sequence.orientation[keep]) * walk.attitude(time[keep]).inv()
    assert np.degrees(turn.magnitude()).max() < 0.5
    # The flip and the jump of the tracker are found out.
    assert 0.97 < keep.mean() < 1.0
    gyro = sequence.gyro - truth.gyro_bias
    for measured, signal in ((gyro, walk.rate), (sequence.accel, walk.force)):
        # Stamps of 10 ms place the clock to a fraction of a millisecond only.
        slope = np.abs(signal(time + 1e-3) - signal(time - 1e-3)) / 2e-3
        assert (np.abs(measured - signal(time)) < 3e-3 + 3e-3 * slope).all()
    assert a["accel_delay_removed"] == pytest.approx(truth.accel_delay, abs=3e-3)
    lever, bias = ([a[f"{name}_{axis}"] for axis in "xyz"] for name in ("lever", "gyro_bias"))
    assert lever == pytest.approx(truth.lever, abs=0.01)
    assert bias == pytest.approx(truth.gyro_bias, abs=1e-3)
    assert [a["tilt_x"], a["tilt_y"]] == pytest.approx(truth.up[:2] / truth.up[2], abs=2e-3)
    yaw = a["extrinsic_yaw_degrees"] - truth.extrinsic.as_euler("ZXY", degrees=True)[0]
    assert (yaw + 180) % 360 - 180 == pytest.approx(0, abs=0.5)
    assert self_check(sequence).failures == ()
    # The field is in the phone's axes, on its clock.
    field, start = sequence.readings["magnetometer"], time[0] - sequence.time[0]
    stamps = field.time + start
    before, expected, after = (
        walk.attitude(stamps + shift).inv().apply(files.FIELD) for shift in (-1e-3, 0.0, 1e-3)
    )
    assert len(field.time) > 0.95 * len(time) and np.isnan(field.std).all()
    # Two milliseconds off at the most: rows that changed places are ten.
    assert (np.abs(field.values - expected) < 0.02 + np.abs(after - before)).all()


def check_delay(tmp_path, sequence, truth, kind):
    """The rows that the accelerometer had not yet, or no longer, measured are gone."""
    delay = truth.accel_delay
    assert sequence.attributes["accel_delay_removed"] == pytest.approx(delay, abs=1e-3)
    (walk,) = oxiod.find_walks(tmp_path)
    phone = oxiod.read_phone(walk.files[kind][0], kind)
    first = sequence.attributes["start_time"] - phone.start + delay
    stamps = phone.accel.time
    assert first > stamps[0] - 2e-3 and first + sequence.time[-1] < stamps[-1] + 2e-3


def test_raw_walk_comes_back(tmp_path):
    truth = files.Truth(skew=-480e-6, accel_delay=0.05)
    sequence, time = read_back(tmp_path, files.write_raw, "raw", truth, seconds=40)
    compare(sequence, truth, time)
    check_delay(tmp_path, sequence, truth, "raw")
    a = sequence.attributes
    assert np.allclose(np.diff(sequence.time), 0.01)
    # Vicon stamps an event at offset + (1 + skew) t.
    middle = 0.5 * (time[0] + time[-1])
    assert a["lag"] == pytest.approx(-truth.offset - truth.skew * middle, abs=4e-3)
    assert a["lag_drift"] == pytest.approx(-truth.skew * 45, abs=6e-3)
    # The device's own attitude is right but for its yaw.
    turn = rotations(sequence.device_orientation) * truth.walk.attitude(time).inv()
    expected = np.broadcast_to([0, 0, 1.1], (len(time) - 100, 3))
    np.testing.assert_allclose(turn.as_rotvec()[50:-50], expected, atol=5e-3)
    # CoreMotion has taken off its own estimate of the bias: tables of results say so.
    assert a["imu_compensated"] == "CoreMotion's gyro bias"


def test_syn_walk_comes_back(tmp_path):
    truth, session = files.Truth(lag_rows=-12.4, accel_delay=-0.03), ("pocket", "data1")
    sequence, time = read_back(tmp_path, files.write_syn, "syn", truth, session, 40)
    compare(sequence, truth, time)
    check_delay(tmp_path, sequence, truth, "syn")
    # Vicon's row i shows what the phone's row i + lag does.
    a = sequence.attributes
    assert a["lag"] * 100 == pytest.approx(truth.lag_rows, abs=0.3)
    assert (a["placement"], a["session"]) == ("pocket", "pocket/data1")


def test_a_walk_that_repeats_its_turns_comes_back(tmp_path):
    # Rates of turning correlate best five seconds off, where every turn goes to the other side.
    truth = files.Truth(files.eight(9.66), offset=1.9)
    sequence, time = read_back(tmp_path, files.write_raw, "raw", truth, seconds=38)
    compare(sequence, truth, time)
    a = sequence.attributes
    assert a["lag"] == pytest.approx(-1.9, abs=3e-3) and a["runner_up"] < 0.05
    assert a["gyro_unexplained"] < 1e-3 and a["accel_unexplained"] < 1e-2


def test_nexus_events_come_back(tmp_path):
    extrinsic = Rotation.from_euler("ZXY", [-173, 2, 1], degrees=True)
    truth, session = files.Truth(accel_delay=0.0, extrinsic=extrinsic), ("multi devices", "nexus 5")
    sequence, time = read_back(tmp_path, files.write_nexus_raw, "raw", truth, session, 40)
    compare(sequence, truth, time)
    assert sequence.device_orientation is None
    assert sequence.attributes["device"] == "nexus 5"
    assert sequence.attributes["imu_compensated"] == "no"


def test_readings_of_a_field_leave_out_zeros_gaps_and_repeats_and_what_is_not_the_earths():
    time, turn = np.arange(8) * 0.01, np.linspace(0, 1, 8)
    field = 20 * np.stack([np.cos(turn), np.sin(turn), -2 * np.ones(8)], axis=1)
    dirty = field.copy()
    dirty[0], dirty[3], dirty[5, 1] = 0.0, dirty[2], np.nan
    readings = oxiod.field_readings(np.where(np.arange(8) == 7, 0.06, time), dirty)
    time, values, std = readings["magnetometer"]
    np.testing.assert_array_equal(time, [0.01, 0.02, 0.04, 0.06])
    np.testing.assert_array_equal(values, field[[1, 2, 4, 6]])
    assert std.shape == values.shape and np.isnan(std).all()
    # A trolley's: the vertical part is missing.
    assert oxiod.field_readings(np.arange(8.0), field * [0.7, 0.7, 0.05]) == {}
    assert oxiod.field_readings(np.arange(8.0), np.zeros((8, 3))) == {}


def refused(tmp_path):
    """The one line with which the walk 'handheld/data1/1' is refused."""
    (walk,) = oxiod.find_walks(tmp_path)
    with pytest.raises(Refusal) as caught:
        oxiod.build(walk, "raw")
    assert str(caught.value).startswith(str(walk.files["raw"][1]))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_truth_of_another_walk_or_one_that_fits_at_two_lags_is_refused_by_name(tmp_path):
    truth = files.Truth()
    folder = dataset(tmp_path, "handheld", "data1")
    files.write_raw(folder, 1, truth._replace(walk=truth.walk.paced(1.3)), seconds=30)
    other = (folder / "raw" / "vi1.csv").read_text()
    files.write_raw(folder, 1, truth, seconds=30)
    (folder / "raw" / "vi1.csv").write_text(other)
    message = refused(tmp_path)
    assert "does not move as the phone does" in message
    assert "check that both files are of one walk" in message
    truth = files.Truth(files.eight(40 / 9))  # gait and rounds repeat together
    files.write_raw(folder, 1, truth, seconds=40)
    assert "about as well at a second lag" in refused(tmp_path)


def test_what_no_phone_on_a_marker_body_can_be_is_refused_by_name(tmp_path, monkeypatch):
    files.write_raw(dataset(tmp_path, "handheld", "data1"), 1, files.Truth(), seconds=25)
    (walk,) = oxiod.find_walks(tmp_path)
    phone = oxiod.read_phone(walk.files["raw"][0], "raw")
    fit = body.align(phone, oxiod.read_vicon(walk.files["raw"][1], "raw", phone.start))
    for change, message in (
        ({"lever": np.array([0.1, 0.5, -0.2])}, "the lever arm would be 0.548 m"),
        ({"accel_delay": 0.2}, "the accel's delay would be 0.2 s"),
        ({"up": np.array([np.sin(0.15), 0.0, np.cos(0.15)])}, "the world's tilt would be 8.59"),
        ({"lag": fit.lag - 6.0}, "s, at most 5 s is plausible"),
    ):
        monkeypatch.setattr(body, "align", lambda *_, c=change, **__: fit._replace(**c))
        assert message in refused(tmp_path)
    walk = walk._replace(files={"syn": walk.files["raw"]})  # whose rows the authors have matched
    monkeypatch.setattr(body, "align", lambda *_, **__: fit._replace(lag=fit.lag - 2.5))
    with pytest.raises(Refusal, match="s, at most 1 s is plausible"):
        oxiod.build(walk, "syn")


def test_large_scale_takes_positions_of_tango_and_attitude_of_gyro(tmp_path):
    truth = files.Truth()
    folder = dataset(tmp_path, "large scale", "floor1")
    files.write_large_scale(folder, 1, truth, seconds=36)
    files.write_large_scale(folder, 2, truth, broken=True, seconds=36)
    with pytest.warns(UserWarning, match=r"floor1_2: left out.*out of step"):
        (sequence,) = data.load("oxiod", tmp_path, "large_scale")
    assert sequence.attributes["truth"] == "tango"
    # Without a second sensor on the tablet the accelerometer's own delay cannot be told from the
    # lag.
    assert sequence.attributes["lag"] == pytest.approx(truth.accel_delay - 0.2, abs=0.03)
    time = sequence.time + (sequence.attributes["start_time"] - files.EPOCH)
    turned = Rotation.from_euler("z", 40, degrees=True) * truth.walk.attitude(time)
    error = np.degrees((rotations(sequence.orientation) * turned.inv()).magnitude())
    assert np.median(error) < 1.5 and error.max() < 6
    position = Rotation.from_euler("z", 40, degrees=True).apply(truth.walk.position(time))
    assert np.median(np.linalg.norm(sequence.position - position, axis=1)) < 0.04


def test_same_walk_twice_counts_once_and_a_ruined_raw_file_leaves_syn(tmp_path):
    truth = files.Truth()
    folder = dataset(tmp_path, "handheld", "data1")
    files.write_raw(folder, 1, truth, seconds=25)
    files.write_syn(folder, 1, truth, seconds=25)
    (walk,) = oxiod.find_walks(tmp_path)
    assert set(walk.files) == {"raw", "syn"}
    (sequence,) = read_recording(oxiod.recording_of(walk)).sequences
    assert sequence.attributes["kind"] == "raw"
    # Some published stamps are rounded to 1e4 s.
    path = walk.files["raw"][0]
    rows = [line.split(",", 1) for line in path.read_text().splitlines()]
    rounded = (f"{round(float(stamp), -4):.2f},{cells}" for stamp, cells in rows)
    path.write_text("\n".join(rounded) + "\n")
    reading = read_recording(oxiod.recording_of(walk))
    assert reading.sequences[0].attributes["kind"] == "syn" and reading.refusals == ()
    (note,) = map(str, reading.notes)
    assert note.startswith("handheld_data1_1: syn is used: ")
    assert "imu1.csv" in note and "field 'time' is" in note


def test_reading_again_uses_the_cache_and_another_process_can_read(tmp_path, monkeypatch):
    """What a process is sent of a recording reads the same."""
    folder = dataset(tmp_path, "handheld", "data5")
    files.write_syn(folder, 1, files.Truth(), seconds=15)
    (folder.parent / "Test.txt").write_text("data5")
    with monkeypatch.context() as patch:
        patch.setattr(loky, "ProcessPoolExecutor", lambda *_: pytest.fail("unasked"))
        (alone,) = data.load("oxiod", tmp_path, "test")
        built_again = functools.wraps(oxiod.build)(lambda *_: pytest.fail("built again"))
        patch.setattr(oxiod, "build", built_again)  # of the same module, which is part of the key
        (again,) = data.load("oxiod", tmp_path, "test")
    (recording,) = data.get("oxiod").recordings(tmp_path, "test")
    (sent,) = pickle.loads(pickle.dumps(recording)).read()
    assert_same_arrays(again, alone)
    assert_same_arrays(sent, alone)
