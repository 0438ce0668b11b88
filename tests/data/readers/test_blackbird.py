"""Blackbird: a known flight written in its layout, in a z-up and in a z-down world, must come back;
the real one must be physical."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.readers import blackbird
from gnio_jax.data.self_check import self_check
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations
from tests.support import known_walk
from tests.support.blackbird_files import FLIP, START, write
from tests.support.changes import one, put


@pytest.mark.parametrize("text", [11, 8, 0])
@pytest.mark.parametrize("down", [False, True])
def test_a_flight_comes_back_in_a_world_whose_z_points_up(tmp_path, down, text):
    (sequence,) = blackbird.read(write(tmp_path / "flight", down, text))
    time = sequence.time
    np.testing.assert_allclose(time, np.arange(1200) / 100, atol=1e-6)
    # The body stays as it is; which way is up is told by the orientation.
    np.testing.assert_allclose(sequence.gyro, known_walk.rate(time) @ FLIP, atol=1e-5)
    np.testing.assert_allclose(sequence.accel, known_walk.force(time) @ FLIP, atol=1e-5)
    known = Rotation.from_matrix(known_walk.attitude(time).as_matrix() @ FLIP)
    assert np.degrees((rotations(sequence.orientation) * known.inv()).magnitude()).max() < 1e-3
    np.testing.assert_allclose(sequence.position, known_walk.position(time), atol=1e-6)
    np.testing.assert_allclose(
        sequence.velocity, known_walk.velocity(time), atol=1e-6 if text == 11 else 0.01
    )
    assert sequence.valid.all() and self_check(sequence, pedestrian=False).failures == ()
    assert sequence.attributes["native_world"] == ("z-down, turned" if down else "z-up")
    assert sequence.attributes["start_time"] == pytest.approx(START, abs=1e-6)


def test_lists_with_comments_absent_entries_and_no_last_newline(tmp_path):
    for split in ("train", "val", "test"):
        write(tmp_path / "clover" / "yawForward" / "maxSpeed5p0" / split)
    entry = "clover/yawForward/maxSpeed5p0"
    (tmp_path / "train.txt").write_text(
        f"# clover\n{entry}/train\nstar/yawForward/maxSpeed1p0/train"
    )
    (tmp_path / "test.txt").write_text(f"# clover\n\n{entry}/test\n")
    (tmp_path / "val.txt").write_text("# nothing is here\nstar/yawForward/maxSpeed1p0/val\n")
    with pytest.warns(
        UserWarning, match=r"train\.txt: 1 of 2 listed sequences are absent: star/yawForward"
    ):
        (sequence,) = data.load("blackbird", tmp_path, "train")
    assert (
        sequence.name == "clover_yawForward_maxSpeed5p0_train"
        and sequence.attributes["session"] == entry
    )
    assert [s.name for s in data.load("blackbird", tmp_path, "test")] == [
        "clover_yawForward_maxSpeed5p0_test"
    ]
    with pytest.raises(InputError, match=r"val\.txt: none of its 1 sequences is below"):
        data.load("blackbird", tmp_path, "val")
    with pytest.raises(InputError, match="unknown split 'unseen'"):
        data.load("blackbird", tmp_path, "unseen")


def test_a_flight_that_contradicts_itself_is_left_out(tmp_path):
    def mirror(fields):
        fields["traj_target"][:, 1] *= -1

    write(tmp_path / "good")
    write(tmp_path / "bad", spoil=mirror)
    (tmp_path / "test.txt").write_text("good\nbad")
    with pytest.warns(
        UserWarning, match="bad: left out by the self-check: horizontal acceleration"
    ):
        assert [s.name for s in data.load("blackbird", tmp_path, "test")] == ["good"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda fields: fields.pop("gyro_calib"), ("field 'gyro_calib' is missing", "accel_calib")),
        (put("traj_target", lambda p: p[:, :6]), ("field 'traj_target'", "(1200, 6)", "(1200, 7)")),
        (put("accel_calib", lambda a: a[:-1]), ("field 'accel_calib'", "(1199, 3)")),
        (put("gyro_calib", one((5, 1), np.nan)), ("field 'gyro_calib'", "row 6")),
        (put("traj_target", one((6, 0), np.inf)), ("field 'traj_target'", "row 7")),
        (put("traj_target", one((7, slice(3, 7)), 0.5001 + np.zeros(4) * 1e-9)), None),
        (
            put("traj_target", one((7, slice(3, 7)), 0.0)),
            ("field 'traj_target'", "not a unit quaternion", "row 8"),
        ),
        (put("ts", one(8, START)), ("field 'time'", "does not increase", "row 9")),
        (
            put("ts", lambda t: START + (t - START) * 2),
            ("field 'time'", "50 Hz, expected about 100 Hz"),
        ),
        (
            put("ts", lambda t: np.where(np.arange(1200) < 600, t, t + 2)),
            ("field 'time'", "gap of 2.01"),
        ),
        (put("accel_calib", lambda a: a / 9.81), ("field 'accel'", "looks like G")),
        (put("gyro_calib", lambda g: g * 180 / np.pi), ("field 'gyro'", "looks like deg/s")),
    ],
)
def test_a_bad_table_is_refused_by_file_and_field(tmp_path, change, words):
    folder = write(tmp_path / "flight", spoil=change, text=0)
    if words is None:  # rounding is mended
        norm = np.linalg.norm(blackbird.read(folder)[0].orientation, axis=1)
        np.testing.assert_allclose(norm, 1.0, atol=1e-9)
        return
    with pytest.raises(InputError) as error:
        blackbird.read(folder)
    text = str(error.value)
    assert (
        text.startswith(f"{folder / 'data.hdf5'}: ")
        and "\n" not in text
        and all(word in text for word in words)
    ), text


def test_damaged_files_are_refused(tmp_path):
    folder = write(tmp_path / "flight")
    table, truth = folder / "data.hdf5", folder / "stamped_groundtruth_imu.txt"

    def refused(path, *words):
        with pytest.raises(InputError) as error:
            blackbird.read(folder)
        assert str(error.value).startswith(f"{path}: ") and all(
            word in str(error.value) for word in words
        ), error.value

    lines = truth.read_text().splitlines()
    truth.write_text("\n".join(lines[:-5]))
    refused(truth, "'ts'", "1195 and 1200 rows")
    truth.write_text("\n".join([lines[0], *lines[2:], lines[1]]))
    refused(truth, "'ts'")
    truth.write_text("\n".join([lines[0], *(line.rsplit(" ", 1)[0] for line in lines[1:])]))
    refused(truth, "has 10 columns")
    truth.write_text("\n".join([*lines[:5], lines[5].rsplit(" ", 1)[0] + " nan", *lines[6:]]))
    refused(truth, "column '10' is NaN", "row 6")
    truth.write_text("\n".join(lines))

    whole = table.read_bytes()
    for size in (0, 100, len(whole) // 2, len(whole) - 100):
        table.write_bytes(whole[:size])
        refused(table, "cut short")


@pytest.mark.recordings
@pytest.mark.parametrize(("split", "seconds"), [("train", 91.0), ("val", 30.0), ("test", 30.0)])
def test_the_real_flight_is_physical(recordings, split, seconds):
    if not (recordings / "blackbird").is_dir():
        pytest.skip("real recordings: no blackbird/")
    (sequence,) = data.load("blackbird", recordings / "blackbird", split)
    check = self_check(sequence, pedestrian=False)
    assert check.duration == pytest.approx(seconds, abs=0.1) and check.rate == pytest.approx(100.0)
    assert (
        sequence.attributes["native_world"] == "z-up" and sequence.accel[:, 2].mean() < -9.0
    )  # the body's z points down
    np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=0.3)
    assert (
        check.gyro_consistency_degrees < 1.5
        and check.accel_correlation_horizontal > 0.99
        and 2.0 < check.median_speed < 3.5
    )
