"""TLIO's golden layout, written here with its traps, and read from the real recordings where they
are."""

import json

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.readers import tlio
from tests.support.refusals import refused
from tests.support.tlio_files import COLUMNS, N, body_values, spoil, write_sequence

SHUFFLED = [
    "vel_World(3)",
    "temperature(2)",
    "qxyzw_World_Device(4)",
    "ts_us(1)",
    "acc_compensated_rotated_in_World(3)",
    "pos_World_Device(3)",
    "gyr_compensated_rotated_in_World(3)",
]


@pytest.mark.parametrize("columns", [COLUMNS, SHUFFLED], ids=["native", "shuffled"])
def test_imu_comes_back_in_the_body_frame_and_attitude_wxyz(tmp_path, columns):
    time, rotation, wxyz, gyro, accel, position, velocity = body_values()
    (sequence,) = tlio.read(write_sequence(tmp_path / "walk", columns))
    np.testing.assert_allclose(sequence.time, time - time[0], atol=1e-6)
    assert sequence.attributes["start_time"] == pytest.approx(time[0], abs=1e-6)
    np.testing.assert_allclose(sequence.gyro, np.einsum("nji,nj->ni", rotation, gyro), atol=1e-12)
    np.testing.assert_allclose(sequence.accel, np.einsum("nji,nj->ni", rotation, accel), atol=1e-12)
    np.testing.assert_allclose(np.abs((sequence.orientation * wxyz).sum(1)), 1.0, atol=1e-12)
    np.testing.assert_array_equal(sequence.position, position)
    np.testing.assert_array_equal(sequence.velocity, velocity)
    assert sequence.valid.all() and sequence.name == "walk"
    assert sequence.attributes["imu_compensated"] == "reference"
    assert sequence.attributes["licence"] == "CC BY-NC 4.0"
    assert data.self_check(sequence).failures == ()


def test_lists_name_splits_and_absent_sequences_are_counted(tmp_path):
    for name in ("a", "b", "c"):
        write_sequence(tmp_path / name)
    (tmp_path / "train_list.txt").write_text("a\nnot_here\nb\nnor_this")  # no newline at the end
    (tmp_path / "test_list.txt").write_text("c\n\n")
    (tmp_path / "all_ids.txt").write_text("a\nb\nc\n")
    (tmp_path / "spline_metrics.csv").write_text("id,error\n")
    with pytest.warns(UserWarning, match=r"train_list\.txt: 2 of 4"):
        assert [sequence.name for sequence in data.load("tlio", tmp_path, "train")] == ["a", "b"]
    assert [sequence.name for sequence in data.load("tlio", tmp_path, "test")] == ["c"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (spoil("ts_us", 7, 0.0), ("'time'", "does not increase")),
        (spoil("qxyzw_World_Device", 8, 0.0), ("'qxyzw_World_Device'", "row 9")),
        (spoil("vel_World", 9, np.inf), ("'vel_World'", "row 10")),
    ],
)
def test_a_bad_table_is_refused_by_file_and_field(tmp_path, change, words):
    folder = write_sequence(tmp_path / "walk", spoil=change)
    refused(lambda: tlio.read(folder), folder / "imu0_resampled.npy", *words)


def test_a_table_that_is_not_as_described_is_refused(tmp_path):
    folder = write_sequence(tmp_path / "walk")
    table, description = folder / "imu0_resampled.npy", folder / "imu0_resampled_description.json"

    def fails(path, *words):
        refused(lambda: tlio.read(folder), path, *words)

    whole = table.read_bytes()
    np.save(table, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    fails(table, "NumPy array")
    np.save(table, np.zeros((N, 16)))
    fails(table, "shape (2400, 16), expected floats (N, 17)")
    np.save(table, np.zeros((0, 17)))
    fails(table, "shape (0, 17)")
    table.write_bytes(whole)
    repeated = ["ts_us(1)", *COLUMNS[2:], "gyr_compensated_rotated_in_World(4)"]
    for content, words in (
        ({}, "'columns_name(width)'"),
        ({"columns_name(width)": ["ts_us 1", *COLUMNS[1:]]}, "ts_us 1"),
        ({"columns_name(width)": COLUMNS[:-1]}, "'vel_World' is missing"),
        ({"columns_name(width)": repeated}, "width 4, expected 3"),
    ):
        description.write_text(json.dumps(content))
        fails(description, words)
    description.unlink()
    fails(description, "cannot be read")
