"""TLIO's golden layout, written here with its traps, and read from the real recordings where they
are."""

import json

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.readers import tlio
from gnio_jax.errors import InputError
from tests.support.tlio_files import (
    COLUMNS,
    N,
    body_values,
    spoil,
    write_sequence,
)

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
    assert (
        sequence.attributes["imu_compensated"] == "reference"
        and sequence.attributes["licence"] == "CC BY-NC 4.0"
    )
    assert data.self_check(sequence).failures == ()


def test_lists_name_splits_and_absent_sequences_are_counted(tmp_path):
    for name in ("a", "b", "c"):
        write_sequence(tmp_path / name)
    (tmp_path / "train_list.txt").write_text("a\nnot_here\nb\nnor_this")  # no newline at the end
    (tmp_path / "test_list.txt").write_text("c\n\n")
    (tmp_path / "val_list.txt").write_text("gone\n")
    (tmp_path / "all_ids.txt").write_text("a\nb\nc\n")
    (tmp_path / "spline_metrics.csv").write_text("id,error\n")
    with pytest.warns(
        UserWarning,
        match=r"train_list\.txt: 2 of 4 listed sequences are absent: not_here, nor_this",
    ):
        assert [sequence.name for sequence in data.load("tlio", tmp_path, "train")] == ["a", "b"]
    assert [sequence.name for sequence in data.load("tlio", tmp_path, "test")] == ["c"]
    with pytest.raises(
        InputError, match=r"val_list\.txt: none of its 1 sequences is below .*expected layout"
    ):
        data.load("tlio", tmp_path, "val")
    (tmp_path / "val_list.txt").unlink()
    with pytest.raises(InputError, match=r"val_list\.txt: the list cannot be read"):
        data.load("tlio", tmp_path, "val")


def test_an_implausible_sequence_is_left_out_by_name(tmp_path):
    write_sequence(tmp_path / "good")
    write_sequence(
        tmp_path / "tilted",
        spoil=lambda parts: parts.update(
            acc_compensated_rotated_in_World=np.tile([3.0, 0, 9.3], (N, 1))
        ),
    )
    (tmp_path / "test_list.txt").write_text("good\ntilted")
    with pytest.warns(UserWarning, match=r"tilted: left out by the self-check"):
        assert [sequence.name for sequence in data.load("tlio", tmp_path, "test")] == ["good"]


def scale(name, factor):
    def change(parts):
        parts[name] = parts[name] * factor

    return change


@pytest.mark.parametrize(
    ("change", "field", "problem"),
    [
        (scale("acc_compensated_rotated_in_World", 1 / 9.81), "'accel'", "looks like G"),
        (scale("gyr_compensated_rotated_in_World", 100.0), "'gyro'", "looks like deg/s"),
        (
            spoil("gyr_compensated_rotated_in_World", (5, 1), np.nan),
            "'gyr_compensated_rotated_in_World'",
            "row 6",
        ),
        (
            spoil("acc_compensated_rotated_in_World", (6, 1), np.inf),
            "'acc_compensated_rotated_in_World'",
            "row 7",
        ),
        (spoil("ts_us", 7, 0.0), "'time'", "does not increase"),
        (spoil("ts_us", 7, np.nan), "'ts_us'", "row 8"),
        (
            spoil("ts_us", slice(1000, None), np.arange(1400)[:, None] * 5e3 + 9e6),
            "'time'",
            "gap of",
        ),
        (scale("ts_us", 2.0), "'time'", "runs at 100 Hz"),
        (scale("ts_us", 1e3), "'time'", "expected about 200 Hz"),
        (spoil("qxyzw_World_Device", 8, 0.0), "'qxyzw_World_Device'", "row 9"),
        (spoil("qxyzw_World_Device", 8, np.nan), "'qxyzw_World_Device'", "row 9"),
        (spoil("pos_World_Device", (9, 2), np.nan), "'pos_World_Device'", "row 10"),
        (spoil("vel_World", 9, np.inf), "'vel_World'", "row 10"),
    ],
)
def test_a_bad_table_is_refused_by_file_and_field(tmp_path, change, field, problem):
    folder = write_sequence(tmp_path / "walk", spoil=change)
    with pytest.raises(InputError) as error:
        tlio.read(folder)
    text = str(error.value)
    assert (
        text.startswith(str(folder / "imu0_resampled.npy"))
        and field in text
        and problem in text
        and "\n" not in text
    )


def test_a_damaged_file_is_refused(tmp_path):
    folder = write_sequence(tmp_path / "walk")
    table, description = folder / "imu0_resampled.npy", folder / "imu0_resampled_description.json"

    def fails(path, *words):
        with pytest.raises(InputError) as error:
            tlio.read(folder)
        assert str(error.value).startswith(f"{path}: ") and all(
            word in str(error.value) for word in words
        )

    whole = table.read_bytes()
    for size in (0, 40, len(whole) // 2, len(whole) - 8):
        table.write_bytes(whole[:size])
        fails(table, "cut short")
    np.save(table, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    fails(table, "NumPy array")
    np.save(table, np.zeros((N, 16)))
    fails(table, "shape (2400, 16), expected floats (N, 17)")
    np.save(table, np.zeros((0, 17)))
    fails(table, "shape (0, 17)")
    table.unlink()
    fails(table, "cannot be read")
    table.write_bytes(whole)

    description.write_text("{")
    fails(description, "is no JSON")
    description.write_text("{}")
    fails(description, "'columns_name(width)'")
    description.write_text(json.dumps({"columns_name(width)": ["ts_us 1", *COLUMNS[1:]]}))
    fails(description, "ts_us 1")
    description.write_text(json.dumps({"columns_name(width)": COLUMNS[:-1]}))
    fails(description, "'vel_World' is missing")
    description.write_text(
        json.dumps(
            {
                "columns_name(width)": [
                    "ts_us(1)",
                    *COLUMNS[2:],
                    "gyr_compensated_rotated_in_World(4)",
                ]
            }
        )
    )
    fails(description, "width 4, expected 3")
    description.unlink()
    fails(description, "cannot be read")


def test_float32_tables_are_read_as_float64(tmp_path):
    # Stamps of a short recording survive float32 to some tens of µs only when they are small.
    (sequence,) = tlio.read(write_sequence(tmp_path / "walk", dtype=np.float32))
    assert sequence.gyro.dtype == np.float64


@pytest.mark.recordings
@pytest.mark.parametrize(
    ("split", "names"),
    [
        ("train", ["room1", "room2", "V1_01_easy", "V1_02_medium"]),
        ("val", ["room3", "V2_01_easy"]),
        ("test", ["room4", "MH_04_difficult"]),
    ],
)
def test_real_recordings_are_physical(recordings, split, names):
    sequences = data.load("tlio", recordings / "tlio_layout", split)
    assert sorted(sequence.name for sequence in sequences) == sorted(names)
    for sequence in sequences:
        check = data.self_check(sequence)
        assert 80 < check.duration < 150 and check.rate == pytest.approx(200.0, rel=1e-3)
        np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=0.08)
        assert check.gyro_consistency_degrees < 1.0 and 0.3 < check.median_speed < 1.3
        assert check.accel_correlation_horizontal > (
            0.65 if sequence.name == "MH_04_difficult" else 0.8
        )
        assert data.resample(sequence, 200.0) is sequence
        slower = data.self_check(data.resample(sequence, 100.0))
        assert slower.rate == pytest.approx(100.0) and slower.failures == ()
        assert slower.gyro_consistency_degrees == pytest.approx(
            check.gyro_consistency_degrees, abs=0.1
        )


def test_missing_rows_leave_a_uniform_clock_and_a_stretch_that_is_not_valid(tmp_path):
    folder = write_sequence(tmp_path / "walk")
    (whole,) = tlio.read(folder)
    table = np.load(folder / "imu0_resampled.npy")
    first, last = N // 2, N // 2 + 40  # 0.2 s
    np.save(folder / "imu0_resampled.npy", np.delete(table, slice(first, last), axis=0))
    (holed,) = tlio.read(folder)
    np.testing.assert_allclose(holed.time, whole.time, atol=1e-9)
    assert not holed.valid[first:last].any()
    assert holed.valid[: first - 1].all() and holed.valid[last + 1 :].all()
    np.testing.assert_allclose(holed.gyro[: first - 1], whole.gyro[: first - 1], atol=1e-9)
