"""IDOL: a known walk written in the authors' layout, traps included, must come back as the phone's,
not the rig's."""

from __future__ import annotations

import json
import sys
import warnings

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.readers import idol
from gnio_jax.data.self_check import check_sequence
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations
from tests.support import known_walk as walk
from tests.support.idol_files import BIAS, EPOCH, frame, write
from tests.support.refusals import refused


def read_whole(path):
    """A recording that is not divided."""
    (sequence,) = idol.read(path)
    return sequence


def compare(sequence, degrees=0.5):
    """What is measured to 1e-3, what is estimated to `degrees` and 1 cm + 1 % of the way."""
    time = sequence.time + (sequence.attributes["start_time"] - EPOCH)
    inner, valid = slice(20, -20), sequence.valid
    np.testing.assert_allclose(np.diff(sequence.time), 0.01, rtol=1e-4)  # unix seconds hold 0.2 µs
    np.testing.assert_allclose((sequence.gyro - BIAS)[inner], walk.rate(time)[inner], atol=1e-3)
    np.testing.assert_allclose(sequence.accel[inner], walk.force(time)[inner], atol=1e-3)
    error = rotations(sequence.orientation[valid]) * walk.attitude(time[valid]).inv()
    assert np.degrees(error.magnitude()).max() < degrees
    known = walk.position(time)
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(known, axis=0), axis=1))])
    first = int(np.argmax(valid))
    moved, walked = sequence.position - sequence.position[first], known - known[first]
    off = np.linalg.norm(moved - walked, axis=1)
    assert (off < 0.01 + 0.01 * gone)[valid].all()
    np.testing.assert_allclose(
        sequence.velocity[inner][valid[inner]], walk.velocity(time)[inner][valid[inner]], atol=0.05
    )
    apart = (rotations(sequence.device_orientation) * walk.attitude(time).inv()).as_rotvec()
    np.testing.assert_allclose(apart, np.broadcast_to([0, 0, 0.9], (len(time), 3)), atol=1e-3)
    assert data.self_check(sequence).failures == ()
    return time


@pytest.mark.parametrize(
    ("lag", "degrees"),
    [(0.0, 6.0), (0.19, 8.4), (-0.05, 0.0)],
    ids=lambda value: f"{value:g}",
)
def test_a_walk_comes_back_level_in_the_phones_frame_and_on_its_clock(tmp_path, lag, degrees):
    tilt = Rotation.from_rotvec(np.radians(degrees) * np.array([0.8, -0.6, 0.0]))
    sequence = read_whole(write(tmp_path, frame(lag=lag, tilt=tilt)))
    compare(sequence)
    a = sequence.attributes
    assert a["lag"] == pytest.approx(lag, abs=3e-3) and a["rate_correlation"] > 0.99
    assert a["tilt_degrees"] == pytest.approx(degrees, abs=0.5)
    assert sequence.valid.all() and sequence.name == "building1_known_3"
    assert (a["building"], a["imu_compensated"], a["licence"]) == ("building1", "no", "CC BY 4.0")


def test_an_attitude_that_is_the_phones_already_is_refused(tmp_path):
    """It turns the other way about x and y than a rig's."""
    path = write(tmp_path, frame(mount=Rotation.identity()))
    words = r"3\.feather: columns 'orient' do not turn as 'iphoneGyro' does"
    with pytest.raises(Refusal, match=words):
        read_whole(path)


def test_poses_that_are_later_than_the_search_goes_are_refused(tmp_path):
    with pytest.raises(Refusal, match="out of step with 'iphoneGyro'"):
        read_whole(write(tmp_path, frame(lag=0.43)))


def test_columns_are_found_by_name_among_strays_and_rows_put_in_order(tmp_path):
    table = frame()
    table.insert(3, "level_0", np.arange(len(table))[::-1])
    table = table[list(np.random.default_rng(0).permutation(table.columns))]
    rows = np.arange(len(table))
    rows[[100, 101]] = rows[[101, 100]]
    compare(read_whole(write(tmp_path, table.iloc[np.insert(rows, 500, [500, 500])])))


def test_a_piece_shorter_than_a_window_is_lost_and_the_other_keeps_the_name(tmp_path):
    table = frame(seconds=12.0, lag=0.1).iloc[:13]
    table = pd.concat([table, frame(seconds=walk.SECONDS, lag=0.1, start=16.02)])
    message = r"14\.feather: .*\(1, up to 15\.9 s\); kept: 35\.9 of 51\.9 s, 1 of 2 pieces"
    with pytest.warns(UserWarning, match=message):
        sequence = read_whole(write(tmp_path, table, "building3/known", 14))
    time = compare(sequence)
    assert sequence.attributes["start_time"] - EPOCH == pytest.approx(16.02, abs=0.02)
    assert len(time) > 3550
    assert sequence.name == "building3_known_14"


def test_a_hole_of_two_seconds_costs_two_seconds(tmp_path):
    """Nothing of the hole is left for a filter to integrate."""
    table = frame(seconds=38.0, lag=0.15)
    time = table["timestamp"] - EPOCH
    path = write(tmp_path, table[(time < 19.0) | (time > 21.3)])
    words = r"field 'time' has gaps longer than 1 s \(1, up to 2\.3 s\); kept: 35\."
    with pytest.warns(UserWarning, match=words):
        pieces = idol.read(path)
    assert sum(piece.valid.sum() for piece in pieces) / 100.0 >= 35.0
    assert [piece.name for piece in pieces] == [f"building1_known_3_piece{k}" for k in (1, 2)]
    for piece in pieces:
        # The level is the mean of R·accel, of which what was gained in speed in the hole is
        # missing.
        compare(piece, degrees=0.8)
        assert piece.attributes["lag"] == pytest.approx(0.15, abs=3e-3)
    assert pieces[1].attributes["start_time"] - EPOCH == pytest.approx(21.3, abs=0.02)


def test_rows_without_a_pose_are_marked(tmp_path):
    table = frame()
    table.loc[1000:1049, "processedPosY"] = np.nan
    table.loc[2000:2049, ["orientW", "orientX"]] = np.nan
    table.loc[3000:3049, ["orientW", "orientX", "orientY", "orientZ"]] = 0.0
    sequence = read_whole(write(tmp_path, table))
    for middle in (10.25, 20.25, 30.25):
        assert not sequence.valid[np.abs(sequence.time - middle) < 0.2].any()
    assert sequence.valid.mean() > 0.95
    compare(sequence)


def test_smoothed_positions_are_no_reason_to_leave_a_walk_out(tmp_path):
    """The authors' positions hold no gait: they do not correlate with the accelerometer, as little
    as a wrong time would."""
    table = frame()
    time = table["timestamp"] - EPOCH
    for axis, place in zip("XYZ", (0.9 * time, 0.3 * np.sin(time / 4.0), 1.0), strict=True):
        table[f"processedPos{axis}"] = place
    check = check_sequence(read_whole(write(tmp_path, table)), idol.DATASET)
    assert check.failures == () and check.accel_correlation_horizontal < 0.3


def test_without_core_motion_there_is_no_device_orientation(tmp_path):
    table = frame()
    path = write(tmp_path, table.drop(columns="iphoneOrientX"))
    assert read_whole(path).device_orientation is None
    table[[f"iphoneOrient{axis}" for axis in "WXYZ"]] = 0.0
    sequence = read_whole(write(tmp_path, table))
    assert sequence.device_orientation is None and sequence.valid.all()


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_rows_without_core_motion_are_bridged(tmp_path, value):
    """The field is optional: a row that lacks it is no reason to refuse a walk."""
    table = frame()
    table.loc[100:102, [f"iphoneOrient{axis}" for axis in "WXYZ"]] = value
    compare(read_whole(write(tmp_path, table)))


# --- splits


@pytest.fixture
def copy(tmp_path):
    """A copy of which nothing is read: people of two walks each in the training set."""
    root = tmp_path / "downloaded" / "IDOL"
    for folder, people in {
        "building1/train": {number: number // 2 for number in range(10)},
        "building1/known": {0: 1},
        "building2/known": {10: 2, 9: 2},
        "building3/unknown": {0: 14},
    }.items():
        (root / folder).mkdir(parents=True)
        about = {k: {"subjectID": who, "calibration": "start"} for k, who in people.items()}
        (root / folder / "metadata.json").write_text(json.dumps(about))
        for number in people:
            (root / folder / f"{number}.feather").touch()
    return tmp_path


def names(sequences):
    return [sequence.name for sequence in sequences]


def test_splits(copy):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        splits = {split: idol.recordings(copy, split) for split in idol.DATASET.splits}
    known = ["building1_known_0", "building2_known_9", "building2_known_10"]
    assert names(splits["known"]) == names(splits["seen"]) == names(splits["test"]) == known
    assert names(splits["unknown"]) == names(splits["unseen"]) == ["building3_unknown_0"]
    about = splits["unseen"][0].attributes
    assert about["subject"] == about["group"] == "subject14"
    train, val = splits["train"], splits["val"]
    assert {*names(train), *names(val)} == {f"building1_train_{number}" for number in range(10)}
    people, others = ({each.attributes["subject"] for each in part} for part in (val, train))
    assert len(val) == 2 and len(people) == 1 and not people & others
    assert {each.attributes["held_out"] for each in [*train, *val]} == people
    assert {each.attributes["calibration"] for each in train} == {"start"}
    assert all(each.slow and each.files for each in train)  # what is aligned is kept in the cache


def test_recordings_without_a_named_subject_count_as_people_of_their_own(copy):
    (copy / "downloaded" / "IDOL" / "building1" / "train" / "metadata.json").unlink()
    nameless = r"metadata\.json does not name the subject of 10 recordings, e\.g\. .*0\.feather"
    with pytest.warns(UserWarning, match=nameless):
        (val,) = idol.recordings(copy, "val")
    assert val.attributes["subject"] == val.name


def test_a_map_that_lies_on_its_side_is_refused(tmp_path):
    tilted = frame(seconds=14.0, tilt=Rotation.from_euler("x", 40, degrees=True))
    with pytest.raises(Refusal, match="40° off the vertical"):
        read_whole(write(tmp_path, tilted))


def test_copies_gone_wrong(copy):
    root = copy / "downloaded" / "IDOL"
    for path in sorted((root / "building1" / "train").glob("*.feather"))[2:]:
        path.unlink()
    with pytest.raises(InputError, match="split 'val' would be empty"):
        idol.recordings(copy, "val")
    (root / "building3" / "unknown" / "metadata.json").write_text("{")
    with pytest.raises(InputError, match=r"metadata\.json: is no JSON"):
        idol.recordings(copy, "unseen")
    nothing = r"holds no recording in building\*/known; get it from .*expected layout"
    with pytest.raises(InputError, match=nothing):
        idol.recordings(root / "building3", "known")


# --- mistakes


def setting(name, row, value):
    def change(table):
        table.loc[row, name] = value
        return table

    return change


def scaling(prefix, factor):
    def change(table):
        return table.assign(
            **{name: table[name] * factor for name in table if name.startswith(prefix)}
        )

    return change


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            lambda table: table.assign(timestamp=EPOCH),
            "field 'timestamp' holds only 1 different stamps",
        ),
        (
            lambda table: table.assign(timestamp=EPOCH + 10.0 * (table["timestamp"] - EPOCH)),
            "expected about 100 Hz",
        ),
        (
            scaling("iphoneAcc", 9.8),
            "columns 'iphoneAcc' have a median length of 9.94, expected about 1 (G)",
        ),
        (setting("orientW", 60, 3.0), "not a unit quaternion in 1 rows"),
        (scaling("processedPosX", np.nan), "hold a pose in only 0 of 1500 rows"),
        (scaling("stencilAcc", np.nan), "columns 'stencilAcc' hold numbers in only 0 rows"),
    ],
)
def test_a_bad_table_is_refused_by_file_and_column(tmp_path, change, problem):
    path = write(tmp_path, change(frame(seconds=15.0)))
    refused(lambda: idol.read(path), path, problem)


def test_without_pyarrow_it_says_what_to_install(tmp_path, monkeypatch):
    path = write(tmp_path, frame(seconds=15.0))
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(
        InputError, match=r"3\.feather: needs the package pyarrow.*pip install 'gnio-jax\[idol\]'"
    ):
        read_whole(path)


def test_one_wild_stamp_costs_one_row(tmp_path):
    """A stamp of 0 among unix seconds is a gap of decades, which nothing may span."""
    table = frame()
    first = table.iloc[:1].assign(timestamp=0.0)  # has no pose near it, and is cut off as such
    piece = read_whole(write(tmp_path, pd.concat([first, table], ignore_index=True)))
    compare(piece)
    assert piece.attributes["lag"] == pytest.approx(0.0, abs=3e-3)
