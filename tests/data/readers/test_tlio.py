"""TLIO's golden layout, written here with its traps."""

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.readers import tlio
from tests.support.tlio_files import COLUMNS, body_values, write_sequence

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
    time, attitude, gyro, accel, position, velocity = body_values()
    (sequence,) = tlio.read(write_sequence(tmp_path / "walk", columns))
    np.testing.assert_allclose(sequence.time, time - time[0], atol=1e-6)
    assert sequence.attributes["start_time"] == pytest.approx(time[0], abs=1e-6)
    np.testing.assert_allclose(sequence.gyro, attitude.inv().apply(gyro), atol=1e-12)
    np.testing.assert_allclose(sequence.accel, attitude.inv().apply(accel), atol=1e-12)
    wxyz = attitude.as_quat(scalar_first=True)
    np.testing.assert_allclose(np.abs((sequence.orientation * wxyz).sum(1)), 1.0, atol=1e-12)
    np.testing.assert_array_equal(sequence.position, position)
    np.testing.assert_array_equal(sequence.velocity, velocity)
    assert sequence.valid.all() and sequence.name == "walk"
    assert sequence.attributes["imu_compensated"] == "reference"
    assert data.self_check(sequence).failures == ()
