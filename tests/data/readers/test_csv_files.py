"""One's own recordings: CSV and HDF5 folders must tell of the known walk again."""

from __future__ import annotations

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.hdf5 import write_hdf5
from gnio_jax.data.readers import csv_files as csv
from gnio_jax.data.self_check import self_check
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations
from tests.support import known_walk
from tests.support.csv_writers import SECONDS, compare_imu, write_native
from tests.support.refusals import refused

G = 9.80665


def compare_reference(sequence, start=0.0):
    known_walk.compare(sequence, sequence.time + start, speed=0.015)


@pytest.mark.parametrize("rate", [50.0, 100.0, 202.3])
@pytest.mark.parametrize("velocity", [False, True])
def test_a_recording_with_a_reference_comes_back_at_its_own_rate(tmp_path, rate, velocity):
    jitter = np.random.default_rng(0).uniform(-1e-4, 1e-4, round(SECONDS * rate))
    time = np.arange(round(SECONDS * rate)) / rate + jitter
    (sequence,) = csv.read(write_native(tmp_path / "walk.csv", time, velocity=velocity))
    intervals = np.diff(sequence.time)
    assert np.ptp(intervals) < 1e-9
    assert 1 / intervals[0] == pytest.approx(rate, rel=2e-2)
    assert sequence.name == "walk"
    start = sequence.attributes["start_time"]
    assert sequence.time[0] == 0.0 and start == pytest.approx(100.0 + time[0], abs=1e-8)
    compare_imu(sequence, start=start - 100.0)
    compare_reference(sequence, start=start - 100.0)
    assert sequence.valid.all() and self_check(sequence).failures == ()


def test_a_recording_without_a_reference_is_read_and_passes_no_check(tmp_path):
    write_native(tmp_path / "bare.csv", reference=False)
    write_native(tmp_path / "turned.csv", drop=("px", "py", "pz"))
    bare, turned = data.load("csv", tmp_path, "test")
    for sequence in (bare, turned):
        compare_imu(sequence, start=0.0)
        assert not sequence.valid.any()
        assert np.isnan(sequence.position).all()
        assert np.isnan(sequence.velocity).all()
    # An attitude alone is no reference, but the device's own.
    assert bare.device_orientation is None and turned.device_orientation is not None
    turn = rotations(turned.device_orientation).inv() * known_walk.attitude(turned.time)
    assert np.degrees(turn.magnitude()).max() < 0.1
    assert bare.attributes["truth"] == "none"


def test_rows_without_a_reference_are_not_valid(tmp_path):
    def hole(columns):
        for name in ("px", "py", "pz"):
            columns[name][500:620] = np.nan

    (sequence,) = csv.read(write_native(tmp_path / "walk.csv", spoil=hole))
    assert not sequence.valid[500:620].any()
    assert sequence.valid[:500].all()
    assert sequence.valid[620:].all()
    compare_reference(sequence, start=0.0)


def test_lists_name_files_with_or_without_suffix(tmp_path):
    for name in ("a.csv", "b.csv", "c.csv"):
        write_native(tmp_path / name)
    write_hdf5(tmp_path / "d.h5", csv.read(tmp_path / "a.csv")[0]._replace(name="e"))
    (tmp_path / "notes.md").write_text("# mine")
    assert [s.name for s in data.load("csv", tmp_path, "test")] == ["a", "b", "c", "d"]
    with pytest.raises(
        InputError,
        match=r"has no list train\.txt; without lists every recording is in split 'test'",
    ):
        data.load("csv", tmp_path, "train")

    (tmp_path / "train.txt").write_text("# mine\na\nb.csv\ngone.csv")
    (tmp_path / "test.txt").write_text("d\n")
    with pytest.warns(
        UserWarning, match=r"train\.txt: 1 of 3 listed sequences are absent: gone\.csv"
    ):
        assert [s.name for s in data.load("csv", tmp_path, "train")] == ["a", "b"]
    (from_hdf5,) = data.load("csv", tmp_path, "test")
    compare_imu(from_hdf5, start=0.0)
    compare_reference(from_hdf5, start=0.0)
    with pytest.raises(InputError, match=r"val\.txt: the list cannot be read"):
        data.load("csv", tmp_path, "val")
    with pytest.raises(InputError, match="unknown split 'seen'"):
        data.load("csv", tmp_path, "seen")


def set_value(name, row, value):
    def change(columns):
        columns[name] = columns[name].astype(
            object if isinstance(value, str) else columns[name].dtype
        )
        columns[name][row] = value

    return change


def times(factor):
    def change(columns):
        columns["time"] = columns["time"] * factor

    return change


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"drop": ("qx",)}, ("column 'qx' is missing while 'qw' is there",)),
        ({"drop": ("pz",)}, ("column 'pz' is missing",)),
        ({"spoil": set_value("time", 7, 0.0)}, ("field 'time'", "does not increase", "row 8")),
        (
            {"spoil": set_value("qw", 8, 3.0)},
            ("columns 'qw', 'qx', 'qy', 'qz'", "not a unit quaternion", "row 10"),
        ),
        (
            {"spoil": times(1e3)},
            ("field 'time'", "not in seconds", "looks like ms: divide it by 1000"),
        ),
        ({"spoil": times(1e9)}, ("field 'time'", "looks like ns: divide it by 1e+09")),
        (
            {"spoil": times(20.0)},
            ("field 'time'", "not in seconds", "an IMU runs at 10 to 2000 Hz"),
        ),
    ],
)
def test_a_bad_file_is_refused_by_name_and_field(tmp_path, options, words):
    path = write_native(tmp_path / "walk.csv", **options)
    refused(lambda: csv.read(path), path, *words)


def test_an_empty_folder_is_refused(tmp_path):
    refused(lambda: data.load("csv", tmp_path, "test"), tmp_path, "holds no recording")


def test_a_comment_above_the_header_is_a_comment(tmp_path):
    path = write_native(tmp_path / "walk.csv", reference=False)
    (plain,) = csv.read(path)
    text = path.read_text()
    path.write_text("# recorded by a friend, on a bus\n" + text)
    (sequence,) = csv.read(path)
    np.testing.assert_array_equal(sequence.gyro, plain.gyro)
    header, rows = text.split("\n", 1)
    path.write_text(f"# recorded by a friend\n# {header}\n{rows}")
    (sequence,) = csv.read(path)
    np.testing.assert_array_equal(sequence.gyro, plain.gyro)


def test_rows_are_those_that_an_editor_shows(tmp_path):
    """Behind comments, the header, a blank line and a comment among the rows, whatever is wrong."""
    path = write_native(tmp_path / "walk.csv")
    header, *rows = path.read_text().splitlines()
    names = header.split(",")
    for column, value in (("gyro_y", ""), ("gyro_y", "inf"), ("gyro_y", "three"), ("qw", "5")):
        cells = rows[41].split(",")
        cells[names.index(column)] = value
        lines = ["# mine", "", header, *rows[:20], "", "# pause", *rows[20:41], ",".join(cells)]
        path.write_text("\n".join([*lines, *rows[42:]]))
        with pytest.raises(InputError, match=rf"row {len(lines)}\b"):
            csv.read(path)


def test_a_text_that_names_no_recording_is_no_list(tmp_path):
    write_native(tmp_path / "walk.csv")
    (tmp_path / "readme.txt").write_text("walk through the park, phone in the hand\n")
    assert csv.list_splits(tmp_path) == ("test",)
    assert [s.name for s in data.load("csv", tmp_path, "test")] == ["walk"]
    (tmp_path / "winter.txt").write_text("walk\n")
    assert csv.list_splits(tmp_path) == ("winter",)
    assert [s.name for s in data.load("csv", tmp_path, "winter")] == ["walk"]


def test_all_columns_that_are_missing_are_told_with_the_command(tmp_path):
    path = tmp_path / "robot.csv"
    path.write_text("timestamp_ms,wx,wy,wz,Acc X (g),acc_y,what\n1,2,3,4,5,6,7\n2,2,3,4,5,6,7\n")
    with pytest.raises(InputError) as caught:
        csv.read(path)
    assert str(caught.value) == (
        f"{path}: columns 'time', 'gyro_x', 'gyro_y', 'gyro_z', 'accel_x', 'accel_y', 'accel_z' "
        "are missing; found: timestamp_ms, wx, wy, wz, Acc X (g), acc_y, what; name them: "
        "gnio data import robot.csv --out own/robot.h5 --columns time=timestamp_ms gyro_x=wx "
        "gyro_y=wy gyro_z=wz accel_x='Acc X (g)' accel_y=acc_y accel_z=COLUMN"
    )
