"""Every field that a consumer relies on is checked, and named when it is wrong."""

import numpy as np
import pytest

from gnio_jax.data.validation import check_gaps, validate
from gnio_jax.errors import InputError
from tests.support.circle import changed, circle

GOOD = circle(seconds=2.0)

BAD = [
    (GOOD._replace(gyro=GOOD.gyro[:-1]), "'gyro'", "shape"),
    (GOOD._replace(velocity=GOOD.velocity[:, :2]), "'velocity'", "shape"),
    (GOOD._replace(time=GOOD.time[:1]), "'time'", "two stamps"),
    (GOOD._replace(valid=GOOD.valid.astype(float)), "'valid'", "booleans"),
    (GOOD._replace(imu_valid=GOOD.valid[1:]), "'imu_valid'", "booleans"),
    (changed(GOOD, "time", 7, GOOD.time[6]), "'time'", "row 8"),
    (changed(GOOD, "time", 7, np.nan), "'time'", "row 8"),
    (changed(GOOD, "gyro", 9, np.nan), "'gyro'", "row 10"),
    (changed(GOOD, "accel", (9, 2), np.inf), "'accel'", "row 10"),
    (GOOD._replace(accel=GOOD.accel / 9.81), "'accel'", "looks like G"),
    (GOOD._replace(accel=GOOD.accel - np.array([0, 0, 9.81])), "'accel'", "no gravity"),
    (GOOD._replace(accel=GOOD.accel * 1e3), "'accel'", "not in m/s²"),
    (GOOD._replace(gyro=GOOD.gyro * 180 / np.pi), "'gyro'", "looks like deg/s"),
    (changed(GOOD, "orientation", 5, [0.9, 0, 0, 0]), "'orientation'", "row 6"),
    (changed(GOOD, "orientation", 5, np.nan), "'orientation'", "row 6"),
    (changed(GOOD, "position", 5, np.nan), "'position'", "mark these rows invalid"),
    (changed(GOOD, "velocity", 5, 400.0), "'velocity'", "in 1 rows, first 0.050 s after"),
    (changed(GOOD, "position", 5, 1e9), "'position'", "in 1 rows, first 0.050 s after"),
    (changed(GOOD, "position", 5, 12.0), "'position'", "jumps in 2 rows, first 0.050 s after"),
    (
        changed(GOOD._replace(device_orientation=GOOD.orientation), "device_orientation", 5, 2.0),
        "'device_orientation'",
        "row 6",
    ),
]


@pytest.mark.parametrize(
    ("sequence", "field", "problem"), BAD, ids=[f"{bad[1]}-{bad[2]}" for bad in BAD]
)
def test_validate_names_file_field_and_problem_in_one_line(sequence, field, problem):
    if "deg/s" in problem:
        sequence = sequence._replace(gyro=sequence.gyro * 10)
    with pytest.raises(InputError) as error:
        validate(sequence, "walk.csv")
    text = str(error.value)
    assert text.startswith("walk.csv: ") and field in text and problem in text and "\n" not in text


def test_validate_lets_the_reference_be_missing_and_normalizes_rounded_quaternions():
    """Exact ones are kept bit for bit. What is missing is marked invalid."""
    sequence = changed(GOOD, "valid", 5, False)
    for field in ("position", "velocity", "orientation"):
        sequence = changed(sequence, field, 5, np.nan)
    assert validate(sequence, "walk.csv").valid.sum() == len(GOOD.time) - 1
    assert validate(GOOD, "walk.csv").orientation is GOOD.orientation
    rounded = validate(GOOD._replace(orientation=np.round(GOOD.orientation, 4)), "walk.csv")
    np.testing.assert_allclose(np.linalg.norm(rounded.orientation, axis=1), 1.0, atol=1e-14)


def test_a_gap_longer_than_a_window_is_refused():
    time = np.arange(100) / 202.3
    check_gaps(time, "walk.csv")
    time[50:] += 1.2
    with pytest.raises(InputError, match=r"walk\.csv: field 'time' .* 1\.205 s after row 50"):
        check_gaps(time, "walk.csv")
