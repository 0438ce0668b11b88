"""OxIOD: known walks written as native files, traps included, must come back; real recordings must
be physically plausible."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data import loading
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.loading import read_recording
from gnio_jax.data.readers import oxiod
from gnio_jax.data.self_check import self_check
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations
from tests.support import oxiod_files as files
from tests.support.sequences import assert_same_arrays


def dataset(tmp_path, scene, folder):
    return tmp_path / "downloaded" / "Oxford Inertial Odometry Dataset" / scene / folder


def read_back(tmp_path, write, kind, truth, place=("handheld", "data1"), seconds=25):
    """(the sequence of one walk that `write` wrote, the stamps of the known walk)."""
    write(dataset(tmp_path, *place), 3, truth, seconds=seconds)
    (walk,) = oxiod.find_walks(tmp_path)
    (sequence,) = oxiod.build(walk, kind)
    start = sequence.attributes["start_time"] - (files.EPOCH if kind == "raw" else 0.0)
    return sequence, sequence.time + start


def compare(sequence, truth, time):
    """Reference, accelerometer and what the fit has found; the world's yaw and origin are Vicon's
    own."""
    keep, a = sequence.valid, sequence.attributes
    known = files.position(time, truth)
    off = np.linalg.norm(sequence.position - known, axis=1)[keep]
    walked = np.linalg.norm(np.diff(known, axis=0), axis=1).sum()
    assert off.max() < 0.01 + 0.01 * walked and np.median(off) < 0.01
    turn = rotations(sequence.orientation[keep]) * files.attitude(time, truth)[keep].inv()
    assert np.degrees(turn.magnitude()).max() < 0.5
    # The flip and the jump of the tracker are found out.
    assert 0.97 < keep.mean() < 1.0
    for measured, known in (
        (sequence.gyro - truth.gyro_bias, files.rate),
        (sequence.accel, files.force),
    ):
        rms, shift = imu_error(measured, known, time, truth)
        assert rms < 1e-3 and shift < 2e-3
    assert a["accel_delay_removed"] == pytest.approx(truth.accel_delay, abs=3e-3)
    lever, bias = ([a[f"{name}_{axis}"] for axis in "xyz"] for name in ("lever", "gyro_bias"))
    assert lever == pytest.approx(truth.lever, abs=0.01)
    assert bias == pytest.approx(truth.gyro_bias, abs=1e-3)
    assert [a["tilt_x"], a["tilt_y"]] == pytest.approx(truth.up[:2] / truth.up[2], abs=2e-3)
    yaw = a["extrinsic_yaw_degrees"] - truth.extrinsic.as_euler("ZXY", degrees=True)[0]
    assert (yaw + 180) % 360 - 180 == pytest.approx(0, abs=0.5)
    assert self_check(sequence).failures == ()


def imu_error(values, known, time, truth):
    """(rms after the best shift in time, the shift): stamps of 10 ms place the clock to a fraction
    of a millisecond only.

    The shift is piecewise linear in three knots, as the restored clock is.
    """
    expected = known(time, truth)
    slope = (known(time + 1e-3, truth) - known(time - 1e-3, truth)) / 2e-3
    inner = slice(50, -50)
    difference, slope = (values - expected)[inner], slope[inner]
    place = np.linspace(0, 2, len(slope))
    basis = np.stack([np.clip(1 - np.abs(place - knot), 0, 1) for knot in range(3)], axis=1)
    columns = (slope[:, :, None] * basis[:, None, :]).reshape(-1, 3)
    shift, *_ = np.linalg.lstsq(columns, difference.reshape(-1), rcond=None)
    rest = difference.reshape(-1) - columns @ shift
    return np.sqrt((rest**2).mean()), np.abs(shift).max()


@pytest.mark.parametrize("skew", [0.0, -480e-6])
def test_raw_walk_comes_back(tmp_path, skew):
    truth = files.Truth(skew=skew)
    sequence, time = read_back(tmp_path, files.write_raw, "raw", truth, seconds=60)
    compare(sequence, truth, time)
    a = sequence.attributes
    assert np.allclose(np.diff(sequence.time), 0.01)
    # Vicon stamps an event at offset + (1 + skew) t.
    middle = 0.5 * (time[0] + time[-1])
    assert a["lag"] == pytest.approx(-truth.offset - skew * middle, abs=3e-3 + abs(skew) * 2)
    assert a["lag_drift"] == pytest.approx(abs(skew) * 65, abs=6e-3)
    # Over one second, what a network learns from.
    step = sequence.position[100:] - sequence.position[:-100]
    known = files.position(time[100:], truth) - files.position(time[:-100], truth)
    whole = sequence.valid[100:] & sequence.valid[:-100]
    assert np.linalg.norm(step - known, axis=1)[whole].max() < 0.015
    off = np.abs(sequence.velocity - files.velocity(time, truth))[sequence.valid]
    assert off.max() < 0.06 and np.median(off) < 0.01 and np.sqrt((off**2).mean()) < 0.02
    # The device's own attitude is right but for its yaw.
    turn = rotations(sequence.device_orientation) * files.attitude(time, truth).inv()
    expected = np.broadcast_to([0, 0, 1.1], (len(time) - 100, 3))
    np.testing.assert_allclose(turn.as_rotvec()[50:-50], expected, atol=5e-3)
    # CoreMotion has taken off its own estimate of the bias: tables of results say so.
    assert a["imu_compensated"] == "CoreMotion's gyro bias"


@pytest.mark.parametrize(("kind", "delay"), [("raw", 0.05), ("syn", -0.03)])
def test_the_accelerometers_delay_is_taken_out(tmp_path, kind, delay):
    truth = files.Truth(accel_delay=delay)
    write = files.write_raw if kind == "raw" else files.write_syn
    sequence, time = read_back(tmp_path, write, kind, truth)
    assert sequence.attributes["accel_delay_removed"] == pytest.approx(delay, abs=1e-3)
    error = np.abs(sequence.accel - files.force(time, truth))  # first and last row too
    slope = np.abs(files.force(time + 1e-3, truth) - files.force(time - 1e-3, truth)) / 2e-3
    assert (error < 3e-3 + 3e-3 * slope).all()
    # The rows that the accelerometer had not yet, or no longer, measured are gone.
    (walk,) = oxiod.find_walks(tmp_path)
    phone = oxiod.read_phone(walk.files[kind][0], kind)
    first = sequence.attributes["start_time"] - phone.start + delay
    stamps = phone.accel.time
    assert first > stamps[0] - 2e-3 and first + sequence.time[-1] < stamps[-1] + 2e-3


def test_a_walk_that_repeats_its_turns_comes_back(tmp_path):
    # Rates of turning correlate best five seconds off, where every turn goes to the other side.
    truth = files.Truth(eight=9.66, offset=1.9)
    sequence, time = read_back(tmp_path, files.write_raw, "raw", truth, seconds=38)
    compare(sequence, truth, time)
    assert sequence.attributes["lag"] == pytest.approx(-1.9, abs=3e-3)
    assert sequence.attributes["gyro_unexplained"] < 1e-3
    assert sequence.attributes["accel_unexplained"] < 1e-2
    assert sequence.attributes["runner_up"] < 0.05


def test_syn_walk_comes_back(tmp_path):
    truth, place = files.Truth(lag_rows=-12.4), ("pocket", "data1")
    sequence, time = read_back(tmp_path, files.write_syn, "syn", truth, place, 40)
    compare(sequence, truth, time)
    # Vicon's row i shows what the phone's row i + lag does.
    a = sequence.attributes
    assert a["lag"] * 100 == pytest.approx(truth.lag_rows, abs=0.3)
    assert (a["placement"], a["session"]) == ("pocket", "pocket/data1")


def test_nexus_events_come_back(tmp_path):
    extrinsic = Rotation.from_euler("ZXY", [-173, 2, 1], degrees=True)
    truth, place = files.Truth(accel_delay=0.0, extrinsic=extrinsic), ("multi devices", "nexus 5")
    sequence, time = read_back(tmp_path, files.write_nexus_raw, "raw", truth, place, 40)
    compare(sequence, truth, time)
    assert sequence.device_orientation is None
    assert sequence.attributes["device"] == "nexus 5"
    assert sequence.attributes["imu_compensated"] == "no"


def refused(tmp_path, kind="raw"):
    """The one line with which the walk 'handheld/data1/1' is refused."""
    (walk,) = oxiod.find_walks(tmp_path)
    with pytest.raises(Refusal) as caught:
        oxiod.build(walk, kind)
    assert str(caught.value).startswith(str(walk.files[kind][1])) and "\n" not in str(caught.value)
    return str(caught.value)


def test_the_truth_of_another_walk_is_refused_by_name(tmp_path):
    truth = files.Truth()
    folder = dataset(tmp_path, "handheld", "data1")
    files.write_raw(folder, 1, truth._replace(pace=1.3), seconds=30)
    other = (folder / "raw" / "vi1.csv").read_text()
    files.write_raw(folder, 1, truth, seconds=30)
    (folder / "raw" / "vi1.csv").write_text(other)
    message = refused(tmp_path)
    assert "does not move as the phone does" in message
    assert "check that both files are of one walk" in message


def test_a_walk_that_fits_at_two_lags_is_refused_by_name(tmp_path):
    truth = files.Truth(eight=40 / 9)  # gait and rounds repeat together
    files.write_raw(dataset(tmp_path, "handheld", "data1"), 1, truth, seconds=40)
    assert "about as well at a second lag" in refused(tmp_path)


def test_what_no_phone_on_a_marker_body_can_be_is_refused_by_name(tmp_path, monkeypatch):
    files.write_raw(dataset(tmp_path, "handheld", "data1"), 1, files.Truth(), seconds=25)
    (walk,) = oxiod.find_walks(tmp_path)
    phone = oxiod.read_phone(walk.files["raw"][0], "raw")
    fit = oxiod.align(phone, oxiod.read_vicon(walk.files["raw"][1], "raw", phone.start))
    for change, message in (
        ({"lever": np.array([0.1, 0.5, -0.2])}, "the lever arm would be 0.548 m"),
        ({"accel_delay": 0.2}, "the accel's delay would be 0.2 s"),
        ({"up": np.array([np.sin(0.15), 0.0, np.cos(0.15)])}, "the world's tilt would be 8.59"),
        ({"gyro_bias": np.array([0.1, -0.1, 0.1])}, "the gyro's bias would be 0.17"),
        ({"lag": fit.lag - 6.0}, "s, at most 5 s is plausible"),
    ):
        monkeypatch.setattr(oxiod, "align", lambda *_, c=change, **__: fit._replace(**c))
        assert message in refused(tmp_path)
    walk = walk._replace(files={"syn": walk.files["raw"]})  # whose rows the authors have matched
    monkeypatch.setattr(oxiod, "align", lambda *_, **__: fit._replace(lag=fit.lag - 2.5))
    with pytest.raises(Refusal, match="s, at most 1 s is plausible"):
        oxiod.build(walk, "syn")


def test_large_scale_takes_positions_of_tango_and_attitude_of_gyro(tmp_path):
    truth = files.Truth()
    folder = dataset(tmp_path, "large scale", "floor1")
    files.write_large_scale(folder, 1, truth, offset=0.2, seconds=36)
    files.write_large_scale(folder, 2, truth, broken=True, seconds=36)
    with pytest.warns(UserWarning, match=r"floor1_2: left out.*out of step"):
        (sequence,) = data.load("oxiod", tmp_path, "large_scale")
    assert sequence.attributes["truth"] == "tango"
    # Without a second sensor on the tablet the accelerometer's own delay cannot be told from the
    # lag.
    assert sequence.attributes["lag"] == pytest.approx(truth.accel_delay - 0.2, abs=0.03)
    time = sequence.time + (sequence.attributes["start_time"] - files.EPOCH)
    turned = Rotation.from_euler("z", 40, degrees=True) * files.attitude(time, truth)
    error = np.degrees((rotations(sequence.orientation) * turned.inv()).magnitude())
    assert np.median(error) < 1.5 and error.max() < 4
    known = Rotation.from_euler("z", 40, degrees=True).apply(files.position(time, truth))
    assert np.median(np.linalg.norm(sequence.position - known, axis=1)) < 0.04


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
    path.write_text(
        "\n".join(f"{round(float(stamp), -4):.2f},{rest}" for stamp, rest in rows) + "\n"
    )
    reading = read_recording(oxiod.recording_of(walk))
    assert reading.sequences[0].attributes["kind"] == "syn" and reading.refusals == ()
    (note,) = map(str, reading.notes)
    assert note.startswith("handheld_data1_1: syn is used: ")
    assert "imu1.csv" in note and "field 'time' is" in note


@pytest.fixture
def copy(tmp_path):
    """Three walks of two scenes, of which nothing is read, and lists as published: no newline at
    the end, and naming what is not there."""
    for place in ("handheld/data1/syn/*2", "handheld/data5/syn/*1", "running/data1/syn/*7"):
        for name in ("imu", "vi"):
            path = dataset(tmp_path, *place.split("/", 1))
            path = path.with_name(path.name.replace("*", name) + ".csv")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    for scene, train, test in (
        ("handheld", "data1\ndata2", "data5"),
        ("running", "data1/imu1.csv", "data1/imu7.csv"),
    ):
        place = dataset(tmp_path, scene, "data1").parent
        (place / "Train.txt").write_text(train)
        (place / "Test.txt").write_text(test)
    return tmp_path


def names(root, split):
    return [recording.name for recording in oxiod.recordings(root, split)]


def test_lists(copy):
    with pytest.warns(UserWarning, match="2 entries of the lists Train.txt are not in this copy"):
        assert names(copy, "train") == ["handheld_data1_2"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        test = ["handheld_data5_1", "running_data1_7"]
        assert names(copy, "test") == names(copy, "seen") == test
    with pytest.raises(InputError, match="no recording of split 'unseen'"):
        names(copy, "unseen")


def test_lists_gone_wrong(copy):
    place = dataset(copy, "handheld", "data1").parent
    for text, words in (("data1/vi3.csv", "entry 'data1/vi3.csv'"), ("\n", "the list is empty")):
        (place / "Train.txt").write_text(text)
        with pytest.raises(InputError, match=f"Train.txt: {words}"):
            names(copy, "train")
    for scene in ("handheld", "running"):
        (dataset(copy, scene, "data1").parent / "Test.txt").unlink()
    with pytest.raises(InputError, match=r"no scene has its list Test.txt"):
        names(copy, "test")


def walks(*names):
    """Walks without files, by their "scene/session/number"."""
    parts = [name.split("/") for name in names]
    return [oxiod.Walk(scene, folder, int(number), {}, "") for scene, folder, number in parts]


ROOM = walks(
    *(f"handheld/data{n}/{k}" for n in range(1, 6) for k in (1, 2)),
    *("pocket/data1/1", "handbag/data2/4", "trolley/data1/7", "trolley/data2/3", "running/data1/6"),
    *(f"multi users/user{n}/4" for n in range(2, 6)),
    *(f"multi devices/{device}/1" for device in ("iPhone 5", "iPhone 6", "nexus 5")),
)


def sessions(split, made, root):
    return {walk.session for walk in oxiod.select(made, split, root)}


def test_sessions_are_shared_out_whole(tmp_path):
    parts = [sessions(f"sessions_{split}", ROOM, tmp_path) for split in ("train", "val", "test")]
    assert set.union(*parts) == {walk.session for walk in ROOM}
    assert sum(map(len, parts)) == len(set.union(*parts))
    train, val, test = parts
    scenes = {session.partition("/")[0] for session in train}
    assert {"handheld", "trolley", "multi users", "multi devices"} <= scenes
    assert val == {"multi users/user4", "handheld/data4"}
    assert {"multi users/user2", "multi devices/nexus 5", "trolley/data1"} < test


def test_what_is_held_out_does_not_depend_on_what_a_copy_holds(tmp_path):
    place = tmp_path / "handheld"
    place.mkdir()
    (place / "Train.txt").write_text("data1\ndata2\ndata3\ndata4")
    for split in ("sessions_train", "sessions_val", "sessions_test", "train", "val"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            whole = {walk.name for walk in oxiod.select(ROOM, split, tmp_path)}
            for part in (ROOM[::2], ROOM[1::2], ROOM[:7], ROOM[7:]):
                here = {walk.name for walk in oxiod.select(part, split, tmp_path)}
                assert here == whole & {walk.name for walk in part}, split


def test_validation_holds_out_whole_sessions_of_the_training_lists(tmp_path):
    for scene, entries in (("handheld", "data1\ndata4"), ("trolley", "data1/imu7.csv\ndata2")):
        (tmp_path / scene).mkdir()
        (tmp_path / scene / "Train.txt").write_text(entries)
    assert sessions("val", ROOM, tmp_path) == {"handheld/data4", "trolley/data1"}
    assert sessions("train", ROOM, tmp_path) == {"handheld/data1", "trolley/data2"}


def scaled(columns, factor):
    """Cells `columns` of every line times `factor`."""

    def change(lines):
        rows = np.array([line.split(",") for line in lines])
        rows[:, columns] = np.char.mod("%.5f", rows[:, columns].astype(float) * factor)
        return [",".join(row) for row in rows]

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: [line.rsplit(",", 1)[0] for line in lines], "has 15 columns, expected 16"),
        (
            lambda lines: ["time" + ",name" * 15, *lines],
            "'time' holds 'time' in its row 1, no number",
        ),
        (scaled(slice(7, 13), 9.8), "'gravity' has length 9.8, expected 1 G"),
        (scaled(slice(4, 7), 57.3), "'gyro' looks like deg/s"),
        (lambda lines: lines[:300], "holds 300 rows"),
    ],
)
def test_damaged_phone_files_are_refused_by_name_and_reason(tmp_path, change, message):
    files.write_syn(dataset(tmp_path, "pocket", "data1"), 1, files.Truth(), seconds=13)
    path = dataset(tmp_path, "pocket", "data1") / "syn" / "imu1.csv"
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    (walk,) = oxiod.find_walks(tmp_path)
    with pytest.raises(Refusal, match=message) as caught:
        oxiod.build(walk, "syn")
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_damaged_truth_is_refused_by_its_reason(tmp_path):
    path = tmp_path / "vi1.csv"
    time = np.arange(2000) / 100
    rows = np.column_stack([0 * time, 0 * time, files.vicon_columns(time, files.Truth())[:, -7:]])
    for column, value, message in (
        (2, 1e3 * rows[:, 2], "looks like mm"),
        (8, 0.3 * rows[:, 8], "hold a pose"),
    ):
        wrong = rows.copy()
        wrong[:, column] = value
        np.savetxt(path, wrong, delimiter=",")
        with pytest.raises(InputError, match=message):
            oxiod.read_vicon(path, "syn", 0.0)
    np.savetxt(path, rows[:, :8], delimiter=",")
    with pytest.raises(InputError, match="has 8 columns, expected 9"):
        oxiod.read_vicon(path, "syn", 0.0)


def test_reading_again_uses_the_cache_and_spawned_workers_agree(tmp_path, monkeypatch):
    for number in (1, 2):
        files.write_syn(dataset(tmp_path, "handheld", "data5"), number, files.Truth(), seconds=20)
    (dataset(tmp_path, "handheld", "data5").parent / "Test.txt").write_text("data5")
    with monkeypatch.context() as patch:
        patch.setattr(loading, "ProcessPoolExecutor", lambda *_: pytest.fail("unasked"))
        alone = data.load("oxiod", tmp_path, "test")
        patch.setattr(oxiod, "build", lambda *_: pytest.fail("built again"))
        again = data.load("oxiod", tmp_path, "test")
    monkeypatch.setenv("GNIO_CACHE", str(tmp_path / "other"))
    shares = []
    spawned = data.load("oxiod", tmp_path, "test", workers=2, progress=shares.append)
    assert shares == [0.5, 1.0]
    for first, *others in zip(alone, again, spawned, strict=True):
        for other in others:
            assert_same_arrays(other, first)
