"""RIDI: a known walk written in both of its layouts, traps included, must come back; a real
recording must be physically plausible."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.readers import ridi
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations
from tests.support import known_walk as walk
from tests.support.refusals import refused
from tests.support.ridi_files import BOOT, names, write_table, write_text


def read_whole(path):
    """A recording that is not divided."""
    (sequence,) = ridi.read(path)
    return sequence


def compare(sequence):
    """The sequence against the walk at its own stamps."""
    time = sequence.time + (sequence.attributes["start_time"] - BOOT * 1e-9)
    np.testing.assert_allclose(np.diff(sequence.time), 1 / 200, rtol=1e-6)
    walk.compare(sequence, time, edge=20)
    assert data.self_check(sequence).failures == ()
    return time


def check_device(sequence, begin=0.0):
    """The game rotation vector is right but for its yaw, and it begins as the reference does."""
    time = sequence.time + (sequence.attributes["start_time"] - BOOT * 1e-9)
    error = rotations(sequence.device_orientation) * walk.attitude(time).inv()
    assert np.degrees(error.magnitude()).max() < 0.1
    assert begin == pytest.approx(time[0], abs=0.02)


SHUFFLED = (
    "rv_z pos_z ori_y time acce_x gyro_z ori_w rv_w pos_x gyro_x acce_z acce_y gyro_y rv_x rv_y "
    "pos_y ori_x ori_z"
).split()


@pytest.mark.parametrize("order", [None, SHUFFLED], ids=["native", "shuffled"])
def test_table_comes_back(tmp_path, order):
    sequence = read_whole(write_table(tmp_path, "dan_bag1", order=order).parent.parent)
    compare(sequence)
    check_device(sequence)
    assert sequence.valid.all() and sequence.name == "dan_bag1"
    a = sequence.attributes
    assert (a["subject"], a["group"], a["placement"], a["imu_compensated"]) == (
        "dan",
        "dan",
        "bag",
        "no",
    )
    assert a["truth"] == "Tango VIO of the phone itself" and "not stated" in a["licence"]


def test_rows_late_or_twice_are_put_in_order(tmp_path):
    rows = np.arange(int(walk.SECONDS * 202.3))
    rows[[100, 101]] = rows[[101, 100]]
    rows[2000:2010] = rows[2000:2010][::-1]
    rows = np.insert(rows, 500, [500, 500])
    compare(read_whole(write_table(tmp_path, "dan_bag1", rows=rows).parent.parent))


def test_of_a_recording_with_a_gap_both_pieces_are_kept(tmp_path):
    time = np.arange(int(walk.SECONDS * 202.3)) / 202.3
    path = write_table(tmp_path, "huayi_bag2", time=time[(time < 9.0) | (time > 13.4)])
    with pytest.warns(UserWarning) as caught:
        pieces = ridi.read(path.parent.parent)
    (warning,) = caught
    assert str(path) in str(warning.message)
    assert "(1, up to 4.4 s); kept: 31.6 of 36.0 s, 2 of 2 pieces" in str(warning.message)
    assert [piece.name for piece in pieces] == ["huayi_bag2_piece1", "huayi_bag2_piece2"]
    for sequence, begin, seconds in zip(pieces, (0.0, 13.4), (9.0, 22.6), strict=True):
        time = compare(sequence)
        check_device(sequence, begin=begin)
        assert sequence.valid.all() and sequence.time[0] == 0.0
        assert len(time) == pytest.approx(seconds * 200, abs=3)
    assert [piece.name for piece in pieces] == ["huayi_bag2_piece1", "huayi_bag2_piece2"]
    assert {piece.attributes["group"] for piece in pieces} == {"huayi"}


def test_the_cache_is_keyed_by_the_files_that_are_read(tmp_path):
    write_text(tmp_path, "hang_leg1", "android_sensor_pose.txt")

    def read():
        (recording,) = ridi.recordings(tmp_path, "all")
        return {path.name for path in recording.files}

    sensors = {"acce.txt", "gyro.txt", "orientation.txt", "pose.txt"}
    assert read() == sensors | {"android_sensor_pose.txt"}
    write_table(tmp_path, "hang_leg1")  # once it is there, it is what is read
    assert read() == {"data.csv"}


@pytest.mark.parametrize("poses", ["pose.txt", "android_sensor_pose.txt"])
def test_text_files_come_back(tmp_path, poses):
    sequence = read_whole(write_text(tmp_path, "hang_leg_new3", poses))
    compare(sequence)
    check_device(sequence)
    assert sequence.valid.mean() > 0.999
    assert sequence.attributes["truth"].startswith(
        "ARCore" if poses.startswith("android") else "Tango"
    )


def test_a_lost_odometry_ends_a_piece_and_a_short_loss_is_marked(tmp_path):
    pose_time = np.arange(0.0, walk.SECONDS - 0.4, 1 / 30.0)
    pose_time = pose_time[
        ((pose_time < 24.0) | (pose_time > 25.6)) & ((pose_time < 10.0) | (pose_time > 10.4))
    ]
    with pytest.warns(
        UserWarning, match=r"hang_leg1: field 'time' has gaps longer than 1 s \(1, up to 1\.7 s\)"
    ):
        sequence, later = ridi.read(write_text(tmp_path, "hang_leg1", pose_time=pose_time))
    compare(sequence)
    compare(later)
    assert later.time[-1] == pytest.approx(walk.SECONDS - 0.4 - 25.6, abs=0.1)
    assert later.valid.mean() > 0.99
    assert sequence.time[-1] == pytest.approx(24.0, abs=0.05)
    assert not sequence.valid[(sequence.time > 10.01) & (sequence.time < 10.39)].any()
    assert sequence.valid[(sequence.time < 9.9) | (sequence.time > 10.5)].all()


def test_a_jump_of_the_odometry_is_marked(tmp_path):
    def jump(columns):
        columns["pos_x"][3000:] += 0.5

    sequence = read_whole(write_table(tmp_path, "dan_body1", spoil=jump).parent.parent)
    when = 3000 / 202.3
    assert not sequence.valid[np.abs(sequence.time - when) < 0.08].any()
    assert sequence.valid[np.abs(sequence.time - when) > 0.2].all()


# --- splits

TRAIN = (
    "dan_bag1 dan_body1 dan_leg2 hang_bag1 hang_handheld1 hao_bag1 hao_body1 ma_bag1 yajie_leg1 "
    "zhicheng_bag1"
).split()


@pytest.fixture
def copy(tmp_path):
    """A copy whose lists have no newline at the end, name what is not there, and leave out what is
    (`dan_bag9`). Nothing is read."""
    root = tmp_path / "downloaded" / "data_publish_v2"
    for name in [*TRAIN[:-1], "hang_leg7", "shali_bag1", "dan_bag9"]:
        (root / name / "processed").mkdir(parents=True)
        (root / name / "processed" / "data.csv").touch()
    for name, entries in (
        ("train_publish_v2", [f"{name},{name.split('_')[1][:-1]}" for name in TRAIN]),
        ("test_publish_v2", ["hang_leg7,leg", "hang_leg_new3,leg", "huayi_handheld_test1,bag"]),
        ("crosssubject", ["# others", "shali_bag1", "ruixuan_bag1"]),
    ):
        (root / f"list_{name}.txt").write_text("\n".join(entries))
    return tmp_path


def test_splits(copy):
    absent = r"list_train_publish_v2\.txt: 1 of 10 listed sequences are absent: zhicheng_bag1,bag"
    with pytest.warns(UserWarning, match=absent):
        train = ridi.recordings(copy, "train")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        val, *others = (ridi.recordings(copy, s) for s in ("val", "test", "seen", "unseen"))
    assert [names(other) for other in others] == [{"hang_leg7"}, {"hang_leg7"}, {"shali_bag1"}]
    assert names(train) | names(val) == set(TRAIN[:-1])
    # Whole people are held out, and every sequence says which.
    people, others = ({each.name.split("_")[0] for each in part} for part in (val, train))
    assert people and not people & others
    held = {each.attributes["held_out"] for each in [*train, *val]}
    assert held == {", ".join(sorted(people))}


def test_the_hold_out_depends_on_the_list_alone(tmp_path):
    path = tmp_path / "list_train_publish_v2.txt"
    path.write_text("\n".join(f"{name},bag" for name in TRAIN))
    held = ridi.held_out_of_train(path)
    path.write_text("\n".join(reversed(TRAIN)) + "\n\n")
    assert ridi.held_out_of_train(path) == held
    subjects = {name.split("_")[0] for name in held}
    assert held == {name for name in TRAIN if name.split("_")[0] in subjects}
    assert 1 <= len(held) <= 2
    path.write_text("\n".join(f"p{n // 2}_bag{n}" for n in range(20)))
    assert len({name.split("_")[0] for name in ridi.held_out_of_train(path)}) == 1
    # One person, many walks: whole walks then; too few to part with: none.
    path.write_text("\n".join(f"dan_bag{n}" for n in range(20)))
    assert len(ridi.held_out_of_train(path)) == 2
    path.write_text("dan_bag1\ndan_bag2\nhang_bag1")
    assert ridi.held_out_of_train(path) == set()


def test_a_list_too_short_to_hold_anybody_out_is_named(copy):
    (copy / "downloaded" / "data_publish_v2" / "list_train_publish_v2.txt").write_text("dan_bag1")
    with pytest.raises(InputError, match="split 'val' would be empty"):
        ridi.recordings(copy, "val")


def test_every_recording_below_the_root_needs_no_list(copy):
    for _ in range(2):
        assert names(ridi.recordings(copy, "all")) == {
            *TRAIN[:-1],
            "hang_leg7",
            "shali_bag1",
            "dan_bag9",
        }
        for path in copy.rglob("list_*.txt"):
            path.unlink()
    with pytest.raises(InputError, match=r"list_test_publish_v2\.txt: the list cannot be read"):
        ridi.recordings(copy, "test")
    (copy / "elsewhere").mkdir()
    with pytest.raises(InputError, match="elsewhere: holds no recording of RIDI; expected layout"):
        ridi.recordings(copy / "elsewhere", "all")


# --- mistakes


def setting(name, row, value):
    def change(columns):
        columns[name][row] = value

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (setting("time", slice(None), 7.0), ("'time'", "only 1 different stamps")),
        (setting("rv_x", 60, 3.0), ("'rv_x'", "not a unit quaternion", "row 62")),
        (lambda columns: columns.update(time=columns["time"] * 1e-6), ("about 202.3 Hz",)),
    ],
)
def test_a_bad_table_is_refused_by_file_and_field(tmp_path, change, words):
    path = write_table(tmp_path, "dan_bag1", time=np.arange(1000) / 202.3, spoil=change)
    refused(lambda: ridi.read(path.parent.parent), path, *words)


def columns_of(file, change):
    def apply(files):
        files[file] = change(*files[file])

    return apply


def with_value(time, values, row, column, value):
    values = values.copy()
    values[row, column] = value
    return [time, values]


@pytest.mark.parametrize(
    ("change", "file", "problem"),
    [
        (
            columns_of("pose.txt", lambda time, values: with_value(time, values, 90, 6, 2.0)),
            "pose.txt",
            "not a unit quaternion",
        ),
        (
            columns_of("gyro.txt", lambda time, values: [time * 1e-3, values]),
            "gyro.txt",
            "check the unit of the stamps",
        ),
        (lambda files: files.pop("acce.txt"), "acce.txt", "cannot be read"),
        (lambda files: files.pop("pose.txt"), "pose.txt", "cannot be read"),
    ],
)
def test_bad_text_files_are_refused_by_name(tmp_path, change, file, problem):
    folder = write_text(tmp_path, "dan_bag1", spoil=change)
    refused(lambda: ridi.read(folder), folder / file, problem)


def test_without_the_phones_own_filter_there_is_no_device_orientation(tmp_path):
    sequence = read_whole(
        write_text(tmp_path, "dan_bag1", spoil=lambda files: files.pop("orientation.txt"))
    )
    assert sequence.device_orientation is None
    compare(sequence)
