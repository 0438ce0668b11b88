"""Resampling against signals whose values are known in closed form."""

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.resampling import resample
from gnio_jax.data.validation import validate
from gnio_jax.errors import InputError
from gnio_jax.types import Waypoints
from tests.support.checks import unchecked
from tests.support.circle import changed, circle


def test_resampling_what_is_uniform_already_changes_nothing():
    sequence = circle(200.0, 2.0)
    assert resample(sequence, 200.0) is sequence
    # µs stamps of a clock off by 10 ppm, as TLIO's
    stamped = sequence._replace(time=np.round(sequence.time * 0.99999, 6))
    assert resample(stamped, 200.0) is stamped
    slow = sequence._replace(time=sequence.time * 1.0005)  # half a per mille of every displacement
    assert resample(slow, 200.0) is not slow


@pytest.mark.parametrize(("native", "rate"), [(202.3, 200.0), (100.0, 200.0), (250.0, 100.0)])
def test_resampling_returns_the_signal_at_the_new_stamps(native, rate):
    sequence = circle(native, 4.0)
    start = 12.5  # stamps need not start at zero
    result = resample(sequence._replace(time=sequence.time + start), rate)
    np.testing.assert_allclose(np.diff(result.time), 1 / rate, rtol=1e-9)
    assert result.time[0] == start
    assert result.time[-1] <= sequence.time[-1] + start < result.time[-1] + 1 / rate + 1e-9
    truth = circle(stamps=result.time - start)
    edge = slice(round(0.3 * rate), -round(0.3 * rate))  # the FIR mirrors the signal at its ends
    np.testing.assert_allclose(result.accel[edge], truth.accel[edge], atol=3e-3)
    np.testing.assert_allclose(result.gyro[edge], truth.gyro[edge], atol=1e-4)
    for field, tolerance in (("position", 1e-6), ("velocity", 1e-4), ("orientation", 1e-12)):
        np.testing.assert_allclose(getattr(result, field), getattr(truth, field), atol=tolerance)
    assert result.valid.all()
    assert result.name == "circle" and result.attributes == sequence.attributes


def test_what_the_new_rate_cannot_carry_does_not_fold_into_the_gait_band():
    sequence = circle(200.0, 10.0)
    # Taken at 100 Hz it would look like 30 Hz.
    vibration = 5.0 * np.sin(2 * np.pi * 70.0 * sequence.time)[:, None]
    shaken = sequence._replace(accel=sequence.accel + vibration, gyro=sequence.gyro + vibration)
    result = resample(shaken, 100.0)
    truth, edge = circle(stamps=result.time), slice(50, -50)
    for field in ("accel", "gyro"):  # 60 dB down, and no delay of the gait
        off = getattr(result, field)[edge] - getattr(truth, field)[edge]
        assert np.abs(off).max() < 5e-3
    # What the new rate can carry is kept, up to the ends.
    time = result.time
    expected, tones = (
        np.stack([np.sin(2 * np.pi * 35.0 * t), 0.1 * t, 1.0 + 0.02 * t], axis=1)
        for t in (time, sequence.time)
    )
    gyro = resample(sequence._replace(gyro=tones), 100.0).gyro
    np.testing.assert_allclose(gyro[50:-50, 0], expected[50:-50, 0], atol=5e-3)
    np.testing.assert_allclose(gyro[:, 1:], expected[:, 1:], atol=1e-4)
    # The spline's image of 205 Hz, at 621 Hz, would alias to 21 Hz at 600 Hz.
    sequence = circle(416.0, 4.0)
    tone = np.sin(2 * np.pi * 205.0 * sequence.time[:, None] + [0.0, 1.0, 2.0])
    result = resample(sequence._replace(gyro=tone), 200.0)
    assert np.abs(result.gyro[50:-50]).max() < 1e-3


def test_attitudes_are_slerped_whatever_the_signs_of_the_quaternions():
    rng, time = np.random.default_rng(1), np.arange(300) / 100
    axis = np.array([1.0, 2.0, -2.0]) / 3.0

    def attitude(t):
        half = 1.5 * t[:, None]
        return np.concatenate([np.cos(half), np.sin(half) * axis], axis=1)

    flipped = attitude(time) * rng.choice([-1.0, 1.0], size=(300, 1))
    sequence = circle(stamps=time)._replace(orientation=flipped, device_orientation=flipped)
    result = resample(sequence, 330.0)
    for got in (result.orientation, result.device_orientation):
        along = (got * attitude(result.time)).sum(axis=1)
        np.testing.assert_allclose(np.abs(along), 1.0, atol=1e-12)


@pytest.mark.parametrize("value", [np.nan, 1e4])
def test_what_is_marked_invalid_does_not_reach_its_valid_neighbours(value):
    gone, fields = slice(200, 210), ("position", "velocity", "orientation")
    sequence = changed(circle(100.0, 4.0), "valid", gone, False)
    for field in fields if np.isnan(value) else fields[:2]:
        sequence = changed(sequence, field, gone, value)
    result = resample(sequence, 130.0)
    near = (result.time > 1.99 + 1e-6) & (result.time < 2.10 - 1e-6)
    np.testing.assert_array_equal(result.valid, ~near)
    off = result.position - circle(stamps=result.time).position
    np.testing.assert_allclose(off[result.valid], 0.0, atol=1e-5)
    if np.isnan(value):
        for field in fields:
            finite_rows = np.isfinite(getattr(result, field)).all(axis=1)
            np.testing.assert_array_equal(finite_rows, result.valid)
    assert np.isfinite(result.accel).all()
    validate(result, "walk")


def test_what_lies_across_a_gap_is_no_measurement():
    """Samples strictly between two that are more than 0.1 s apart, and around one that was none."""
    stamps = np.delete(np.arange(400) / 100, np.s_[101:125])  # from 1.0 to 1.25 s
    stamps = np.delete(stamps, stamps.searchsorted(2.0))  # a single sample is no gap
    result = resample(circle(stamps=stamps), 200.0)
    inside = (result.time > 1.0 + 1e-6) & (result.time < 1.25 - 1e-6)
    np.testing.assert_array_equal(result.imu_valid, ~inside)
    np.testing.assert_array_equal(result.valid, ~inside)
    again = resample(result, 100.0)
    np.testing.assert_array_equal(again.imu_valid, ~((again.time > 1.001) & (again.time < 1.249)))
    assert resample(circle(stamps=np.arange(400) / 101), 200.0).imu_valid is None
    ends = circle(stamps=np.array([1.0, 1.25])).accel
    line = ends[0] + (result.time[inside, None] - 1.0) / 0.25 * (ends[1] - ends[0])
    np.testing.assert_allclose(result.accel[inside], line, atol=1e-9)


def test_a_rate_that_is_none_is_refused():
    for rate in (0, -100.0, np.nan, np.inf, None, "100"):
        with (
            unchecked(),
            pytest.raises(InputError, match=r"^rate: found .*; give a number"),
        ):
            resample(circle(), rate)


@pytest.mark.parametrize("count, words", [(0, "0 samples"), (1, "1 sample")])
def test_a_recording_without_a_rate_is_refused(count, words, tmp_path):
    """And nothing is written that could not be read."""
    walk = circle(stamps=np.arange(count) / 100)
    taps = Waypoints(np.array([0.0, 5.0]), np.zeros((2, 2)))
    refused = rf"circle: has {words}, at least two are needed; leave it out$"
    for use in (
        lambda: resample(walk, 100.0),
        lambda: resample(walk, 50.0),
        lambda: data.self_check(walk),
        lambda: data.with_poses(walk._replace(waypoints=taps)),
        lambda: data.write_hdf5(tmp_path / "walk.h5", walk),
    ):
        with pytest.raises(InputError, match=refused):
            use()
    assert not list(tmp_path.iterdir())
    two = circle(stamps=np.arange(2) / 100)
    assert len(resample(two, 200.0).time) == 3 and data.self_check(two).rate == 100.0
    data.write_hdf5(tmp_path / "walk.h5", two)
    assert len(data.read_hdf5(tmp_path / "walk.h5").time) == 2
