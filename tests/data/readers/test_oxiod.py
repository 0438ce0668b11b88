"""OxIOD: known walks written as native files, traps included, must come back; real recordings must
be physically plausible."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.loading import read_recording
from gnio_jax.data.readers import oxiod
from gnio_jax.data.self_check import self_check
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations
from tests.support import oxiod_files as files


def dataset(tmp_path, scene, folder):
    return tmp_path / "downloaded" / "Oxford Inertial Odometry Dataset" / scene / folder


def compare(sequence, truth, time):
    """(position error m, attitude error deg, m walked) where valid; the world's yaw and origin are
    Vicon's own."""
    keep = sequence.valid
    position = np.linalg.norm(sequence.position - files.position(time, truth), axis=1)[keep]
    known = files.attitude(time, truth)[keep]
    attitude = np.degrees((rotations(sequence.orientation[keep]) * known.inv()).magnitude())
    walked = np.linalg.norm(np.diff(files.position(time, truth), axis=0), axis=1).sum()
    return position, attitude, walked


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
    return float(np.sqrt(((difference.reshape(-1) - columns @ shift) ** 2).mean())), float(
        np.abs(shift).max()
    )


def check_estimates(sequence, truth, extrinsic_degrees=0.5):
    a = sequence.attributes
    assert a["accel_delay_removed"] == pytest.approx(truth.accel_delay, abs=3e-3)
    assert [a["lever_x"], a["lever_y"], a["lever_z"]] == pytest.approx(truth.lever, abs=0.01)
    assert [a["gyro_bias_x"], a["gyro_bias_y"], a["gyro_bias_z"]] == pytest.approx(
        truth.gyro_bias, abs=1e-3
    )
    assert [a["tilt_x"], a["tilt_y"]] == pytest.approx(truth.up[:2] / truth.up[2], abs=2e-3)
    expected = truth.extrinsic.as_euler("ZXY", degrees=True)[0]
    assert (a["extrinsic_yaw_degrees"] - expected + 180) % 360 - 180 == pytest.approx(
        0, abs=extrinsic_degrees
    )


@pytest.mark.parametrize("skew", [0.0, -480e-6])
def test_raw_walk_comes_back(tmp_path, skew):
    truth = files.Truth(skew=skew)
    files.write_raw(dataset(tmp_path, "handheld", "data1"), 3, truth)
    (walk,) = oxiod.find_walks(tmp_path)
    (sequence,) = oxiod.build(walk, "raw")
    a = sequence.attributes
    time = sequence.time + (a["start_time"] - files.EPOCH)

    assert np.allclose(np.diff(sequence.time), 0.01)
    # Vicon stamps an event at offset + (1 + skew) t.
    middle = 0.5 * (time[0] + time[-1])
    assert a["lag"] == pytest.approx(-truth.offset - skew * middle, abs=3e-3 + abs(skew) * 2)
    assert a["lag_drift"] == pytest.approx(abs(skew) * 65, abs=6e-3)
    check_estimates(sequence, truth)
    position, attitude, walked = compare(sequence, truth, time)
    assert position.max() < 0.01 + 0.01 * walked and np.median(position) < 0.01
    assert attitude.max() < 0.5
    # Over one second, what a network learns from.
    step = sequence.position[100:] - sequence.position[:-100]
    known = files.position(time[100:], truth) - files.position(time[:-100], truth)
    whole = sequence.valid[100:] & sequence.valid[:-100]
    assert np.linalg.norm(step - known, axis=1)[whole].max() < 0.015
    assert np.abs(sequence.velocity - files.velocity(time, truth))[sequence.valid].max() < 0.06
    off = np.abs(sequence.velocity - files.velocity(time, truth))[sequence.valid]
    assert np.median(off) < 0.01 and np.sqrt((off**2).mean()) < 0.02
    assert sequence.valid.mean() > 0.97

    rms, shift = imu_error(sequence.gyro - truth.gyro_bias, files.rate, time, truth)
    assert rms < 1e-3 and shift < 1e-3
    rms, shift = imu_error(sequence.accel, files.force, time, truth)
    assert rms < 1e-3 and shift < 1e-3
    # The device's own attitude is right but for its yaw.
    turn = rotations(sequence.device_orientation) * files.attitude(time, truth).inv()
    assert turn.as_rotvec()[50:-50] == pytest.approx(
        np.broadcast_to([0, 0, 1.1], (len(time) - 100, 3)), abs=5e-3
    )
    assert self_check(sequence).failures == ()
    # CoreMotion has taken off its own estimate of the bias: tables of results say so.
    assert a["imu_compensated"] == "CoreMotion's gyro bias"


@pytest.mark.parametrize("kind", ["raw", "syn"])
@pytest.mark.parametrize("delay", [0.02, 0.05, -0.03])
def test_the_accelerometers_delay_is_taken_out(tmp_path, kind, delay):
    truth = files.Truth(accel_delay=delay)
    write = files.write_raw if kind == "raw" else files.write_syn
    write(dataset(tmp_path, "handheld", "data1"), 1, truth, seconds=25)
    (walk,) = oxiod.find_walks(tmp_path)
    (sequence,) = oxiod.build(walk, kind)
    assert sequence.attributes["accel_delay_removed"] == pytest.approx(delay, abs=1e-3)
    start = sequence.attributes["start_time"]
    time = sequence.time + start - (files.EPOCH if kind == "raw" else 0.0)
    gyro = sequence.gyro - truth.gyro_bias
    for measured, known in ((gyro, files.rate), (sequence.accel, files.force)):
        error = np.abs(measured - known(time, truth))  # at the stamps, first and last row too
        slope = np.abs(known(time + 1e-3, truth) - known(time - 1e-3, truth)) / 2e-3
        assert (error < 3e-3 + 3e-3 * slope).all()
    # The rows that the accelerometer had not yet, or no longer, measured are gone.
    phone = oxiod.read_phone(walk.files[kind][0], kind)
    first, last = start - phone.start, start - phone.start + sequence.time[-1]
    time = phone.accel.time
    assert first + delay > time[0] - 2e-3 and last + delay < time[-1] + 2e-3


@pytest.mark.parametrize("offset", [1.2, 1.9])
def test_a_walk_that_repeats_its_turns_comes_back(tmp_path, offset):
    # Rates of turning correlate best five seconds off, where every turn goes to the other side.
    truth = files.Truth(eight=9.66, offset=offset)
    files.write_raw(dataset(tmp_path, "handheld", "data2"), 1, truth, seconds=38)
    (walk,) = oxiod.find_walks(tmp_path)
    (sequence,) = oxiod.build(walk, "raw")
    assert sequence.attributes["lag"] == pytest.approx(-offset, abs=3e-3)
    check_estimates(sequence, truth)
    time = sequence.time + (sequence.attributes["start_time"] - files.EPOCH)
    position, attitude, walked = compare(sequence, truth, time)
    assert position.max() < 0.01 + 0.01 * walked and np.median(position) < 0.01
    assert attitude.max() < 0.5
    # The flip and the jump of the tracker are found out.
    assert 0.97 < sequence.valid.mean() < 1.0
    assert sequence.attributes["gyro_unexplained"] < 1e-3
    assert sequence.attributes["accel_unexplained"] < 1e-2
    assert sequence.attributes["runner_up"] < 0.05


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
    assert "fits the phone at two lags alike" in refused(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lever": np.array([0.1, 0.5, -0.2])}, "the lever arm would be 0.5"),
        ({"accel_delay": 0.2}, "the accel's delay would be 0.2 s"),
        ({"up": np.array([np.sin(0.15), 0.0, np.cos(0.15)])}, "the world's tilt would be 8.6"),
        ({"gyro_bias": np.array([0.1, -0.1, 0.1])}, "the gyro's bias would be 0.17"),
    ],
    ids=["lever", "delay", "tilt", "bias"],
)
def test_what_no_phone_on_a_marker_body_can_be_is_refused_by_name(tmp_path, change, message):
    files.write_raw(dataset(tmp_path, "handheld", "data1"), 1, files.Truth(**change), seconds=30)
    assert message in refused(tmp_path)


def test_rows_that_the_authors_cannot_have_matched_are_refused_by_name(tmp_path):
    truth = files.Truth(lag_rows=-250.0)
    files.write_syn(dataset(tmp_path, "handheld", "data1"), 1, truth, seconds=25)
    assert "the lag would be 2.5 s, at most 1 s is plausible" in refused(tmp_path, "syn")


def test_syn_walk_comes_back(tmp_path):
    truth = files.Truth(lag_rows=-12.4)
    files.write_syn(dataset(tmp_path, "pocket", "data1"), 1, truth, seconds=40)
    (walk,) = oxiod.find_walks(tmp_path)
    (sequence,) = oxiod.build(walk, "syn")
    time = sequence.time + sequence.attributes["start_time"]
    # Vicon's row i shows what the phone's row i + lag does.
    assert sequence.attributes["lag"] * 100 == pytest.approx(truth.lag_rows, abs=0.3)
    check_estimates(sequence, truth)
    position, attitude, walked = compare(sequence, truth, time)
    assert position.max() < 0.01 + 0.01 * walked and np.median(position) < 0.01
    assert attitude.max() < 0.5
    rms, shift = imu_error(sequence.gyro - truth.gyro_bias, files.rate, time, truth)
    assert rms < 1e-3 and shift < 2e-3
    assert sequence.attributes["placement"] == "pocket"
    assert sequence.attributes["session"] == "pocket/data1"


def test_nexus_events_come_back(tmp_path):
    truth = files.Truth(
        accel_delay=0.0, extrinsic=Rotation.from_euler("ZXY", [-173, 2, 1], degrees=True)
    )
    files.write_nexus_raw(dataset(tmp_path, "multi devices", "nexus 5"), 7, truth, seconds=40)
    (sequence,) = data.load("oxiod", tmp_path, "unseen")
    time = sequence.time + (sequence.attributes["start_time"] - files.EPOCH)
    position, attitude, walked = compare(sequence, truth, time)
    assert position.max() < 0.01 + 0.01 * walked
    assert attitude.max() < 0.5
    rms, shift = imu_error(sequence.accel, files.force, time, truth)
    assert rms < 1e-3 and shift < 2e-4
    assert sequence.device_orientation is None and sequence.attributes["device"] == "nexus 5"
    assert sequence.attributes["imu_compensated"] == "no"
    check_estimates(sequence, truth)


def test_large_scale_takes_positions_of_tango_and_attitude_of_gyro(tmp_path):
    truth = files.Truth()
    folder = dataset(tmp_path, "large scale", "floor1")
    files.write_large_scale(folder, 1, truth, offset=0.2, seconds=50)
    files.write_large_scale(folder, 2, truth, broken=True, seconds=50)
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
    assert "imu1.csv" in note and "'time' is ruined" in note


@pytest.fixture
def copy(tmp_path):
    """Three walks of two scenes, and lists as published: no newline at the end, and naming what is
    not there."""
    truth = files.Truth()
    for scene, folder, number in (
        ("handheld", "data1", 2),
        ("handheld", "data5", 1),
        ("running", "data1", 7),
    ):
        files.write_syn(dataset(tmp_path, scene, folder), number, truth, seconds=20)
    for scene, train, test in (
        ("handheld", "data1\ndata2", "data5"),
        ("running", "data1/imu1.csv", "data1/imu7.csv"),
    ):
        place = dataset(tmp_path, scene, "data1").parent
        (place / "Train.txt").write_text(train)
        (place / "Test.txt").write_text(test)
    return tmp_path


def test_lists(copy):
    with pytest.warns(UserWarning, match="2 entries of the lists Train.txt are not in this copy"):
        train = data.load("oxiod", copy, "train")
    assert [sequence.name for sequence in train] == ["handheld_data1_2"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        test = data.load("oxiod", copy, "test")
        assert [sequence.name for sequence in data.load("oxiod", copy, "seen")] == [
            sequence.name for sequence in test
        ]
    assert [sequence.name for sequence in test] == ["handheld_data5_1", "running_data1_7"]
    with pytest.raises(InputError, match="no recording of split 'unseen'"):
        data.load("oxiod", copy, "unseen")
    with pytest.raises(InputError, match="known splits: train, val, test"):
        data.load("oxiod", copy, "testing")


def test_lists_gone_wrong(copy):
    place = dataset(copy, "handheld", "data1").parent
    (place / "Train.txt").write_text("data1/vi3.csv")
    with pytest.raises(InputError, match=r"Train.txt: entry 'data1/vi3.csv'"):
        data.load("oxiod", copy, "train")
    (place / "Train.txt").write_text("\n")
    with pytest.raises(InputError, match=r"Train.txt: the list is empty"):
        data.load("oxiod", copy, "train")
    for scene in ("handheld", "running"):
        (dataset(copy, scene, "data1").parent / "Test.txt").unlink()
    with pytest.raises(InputError, match=r"no scene has its list Test.txt"):
        data.load("oxiod", copy, "test")


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


def test_damaged_truth_is_refused_and_one_bad_recording_is_left_out(copy):
    path = dataset(copy, "handheld", "data5") / "syn" / "vi1.csv"
    rows = np.loadtxt(path, delimiter=",")
    np.savetxt(path, rows[:, :8], delimiter=",")
    with pytest.warns(
        UserWarning, match=r"handheld_data5_1: left out: .*vi1.csv: has 8 columns, expected 9"
    ):
        sequences = data.load("oxiod", copy, "test")
    assert [sequence.name for sequence in sequences] == ["running_data1_7"]

    for column, value, message in (
        (2, 1e3 * rows[:, 2], "looks like mm"),
        (8, 0.3 * rows[:, 8], "hold a pose"),
    ):
        wrong = rows.copy()
        wrong[:, column] = value
        np.savetxt(path, wrong, delimiter=",")
        with pytest.raises(InputError, match=message):
            oxiod.read_vicon(path, "syn", 0.0)
    # Another walk's truth fits nothing.
    files.write_rows(
        path,
        ["1.5e11"] * 2000,
        np.concatenate(
            [
                np.zeros((2000, 1)),
                files.vicon_columns(np.arange(2000) / -100, files.Truth(pace=1.3)),
            ],
            axis=1,
        ),
        "%.6f",
    )
    with pytest.warns(UserWarning, match="handheld_data5_1: left out"):
        data.load("oxiod", copy, "test")


def test_reading_again_uses_the_cache_and_spawned_workers_agree(copy, monkeypatch):
    alone = data.load("oxiod", copy, "test")
    with monkeypatch.context() as patch:
        patch.setattr(oxiod, "build", lambda *_: pytest.fail("built again"))
        again = data.load("oxiod", copy, "test")
    assert all(
        np.array_equal(a.position, b.position, equal_nan=True)
        for a, b in zip(alone, again, strict=True)
    )
    monkeypatch.setenv("GNIO_CACHE", str(copy / "other"))
    shares = []
    spawned = data.load("oxiod", copy, "test", workers=2, progress=shares.append)
    assert shares == [0.5, 1.0]
    assert all(
        np.allclose(a.position, b.position, atol=1e-9, equal_nan=True)
        for a, b in zip(alone, spawned, strict=True)
    )
