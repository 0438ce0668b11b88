"""Readings of other sensors stay with a sequence on every way, and impossible ones are named."""

import h5py
import numpy as np
import pytest

from gnio_jax.data.assembly import Streams, assemble
from gnio_jax.data.hdf5 import Reading, read_hdf5, read_reading, write_hdf5, write_reading
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import validate
from gnio_jax.errors import InputError
from gnio_jax.types import Readings
from tests.support.circle import circle
from tests.support.sequences import assert_same_arrays

TIME = np.arange(0.0, 30.0, 0.7)
FIELD = Readings(TIME, np.tile([20.0, 5.0, -40.0], (43, 1)), np.full((43, 3), np.nan))
PRESSURE = Readings(TIME, np.full((43, 1), 101325.0), np.full((43, 1), np.nan))
PLACE = Readings(TIME, np.tile([45.2, 5.7, np.nan], (43, 1)), np.tile([4.0, 4.0, np.nan], (43, 1)))
READINGS = {"magnetometer": FIELD, "barometer": PRESSURE, "gnss": PLACE}
WALK = circle()._replace(readings=READINGS)


def test_readings_are_written_to_files_and_to_the_cache_and_come_back_to_the_bit(tmp_path):
    write_hdf5(tmp_path / "walk.h5", WALK)
    assert_same_arrays(read_hdf5(tmp_path / "walk.h5"), WALK)
    write_reading(tmp_path / "walk-0.h5", Reading([WALK, circle()]))
    cached = read_reading(tmp_path / "walk-0.h5")
    assert cached is not None
    assert_same_arrays(cached.sequences[0], WALK)
    assert cached.sequences[1].readings == {}


def test_a_field_of_readings_that_is_missing_in_a_file_is_named(tmp_path):
    write_hdf5(tmp_path / "walk.h5", WALK)
    with h5py.File(tmp_path / "walk.h5", "a") as file:
        del file["readings/gnss/std"]
    with pytest.raises(InputError, match="field 'readings/gnss/std' is missing; convert"):
        read_hdf5(tmp_path / "walk.h5")


def test_resampling_keeps_readings_on_their_own_stamps():
    for sensor, readings in resample(WALK, 50.0).readings.items():
        np.testing.assert_array_equal(readings.time, READINGS[sensor].time)
        np.testing.assert_array_equal(readings.values, READINGS[sensor].values)


def test_a_recording_that_is_cut_shifts_the_stamps_of_readings_and_leaves_out_others():
    """The IMU begins 5 s after the clock's zero and ends at 20 s."""
    time = 5.0 + np.arange(1500) / 100
    streams = Streams.of_imu("walk", "walk.csv", time, WALK.gyro[:1500], WALK.accel[:1500])
    after = Readings(TIME + 100.0, *PRESSURE[1:])
    readings = {"magnetometer": FIELD, "barometer": after}
    (sequence,) = assemble(streams._replace(readings=readings), whole=True)
    assert set(sequence.readings) == {"magnetometer"}
    inside = (TIME >= 4.0) & (TIME <= 20.99)
    np.testing.assert_allclose(sequence.readings["magnetometer"].time, TIME[inside] - 5.0)
    assert len(sequence.readings["magnetometer"].values) == inside.sum()


def with_readings(sensor, **changes):
    return circle()._replace(readings={sensor: READINGS[sensor]._replace(**changes)})


@pytest.mark.parametrize(
    ("sequence", "words"),
    [
        (with_readings("magnetometer", values=FIELD.values / 100), "multiply by 100"),
        (with_readings("magnetometer", values=FIELD.values * 1e-6), "multiply by 1e\\+06"),
        (with_readings("magnetometer", values=FIELD.values * 1e9), "expected 15 to 150 µT; leave"),
        (with_readings("magnetometer", values=FIELD.values[:, :2]), r"expected \(f,\), \(f, 3\)"),
        (with_readings("barometer", values=PRESSURE.values / 100), "multiply by 100"),
        (with_readings("barometer", time=TIME[::-1]), "do not increase"),
        (with_readings("barometer", time=TIME + 1e9), "by the clock of the IMU"),
        (with_readings("barometer", values=np.full((43, 1), np.nan)), "is NaN or Inf in row 1"),
        (with_readings("gnss", values=PLACE.values[:, [1, 2, 0]]), "'gnss' is NaN or Inf in row 1"),
        (with_readings("gnss", values=PLACE.values * 3), "column 'latitude' of field 'gnss' reach"),
        (with_readings("gnss", std=-PLACE.std), "a std of field 'gnss' is not above 0"),
        (
            circle()._replace(readings={"odour": FIELD}),
            "not a known sensor; known: magnetometer, ba",
        ),
    ],
)
def test_impossible_readings_are_named_with_a_remedy(sequence, words):
    with pytest.raises(InputError, match=f"^walk.csv: .*{words}") as caught:
        validate(sequence, "walk.csv")
    assert "\n" not in str(caught.value)
