"""Starts, biases and cuts of recordings against those of simulated walks."""

import dataclasses

import numpy as np
import pytest

from gnio_jax import evaluation
from gnio_jax.config import FilterSettings
from gnio_jax.data.simulated import walks as simulated
from gnio_jax.filtering import make_filter
from gnio_jax.filtering.state import GYRO_BIAS
from gnio_jax.numerics import yaw
from tests.support.estimators import CONFIG, RATE, ready, rotations
from tests.support.filter_settings import changed


def test_a_recording_starts_at_its_first_trusted_sample_or_at_its_first(walks):
    hidden = walks[0]._replace(valid=np.arange(len(walks[0].time)) >= 137)
    (recording,) = ready([hidden])
    assert recording.time[0] == walks[0].time[137]
    np.testing.assert_array_equal(recording.start.position, walks[0].position[137])
    attitude = rotations(walks[0].orientation[137]).as_matrix()
    np.testing.assert_allclose(recording.start.rotation, attitude, atol=1e-12)
    assert len(recording.gyro) == recording.strides * CONFIG.stride
    (recording,) = ready([hidden], init="static", from_first=True)
    assert recording.time[0] == walks[0].time[0] and not recording.start.position.any()
    trusted = np.isfinite(recording.reference.position).all(1)
    np.testing.assert_array_equal(trusted, recording.time >= walks[0].time[137])


BIAS = np.array([0.01, -0.02, 0.005])


@pytest.fixture(scope="module")
def swaying(clean):
    """The walk with a phone in a hand that is never as quiet as a table."""
    sway = 0.03 * np.sin(2 * np.pi * 1.5 * clean.time)
    return clean._replace(gyro=clean.gyro + sway[:, None])


def resting(walk, gyro, rows=120, noise=0.0):
    random, walk = np.random.default_rng(0), walk._replace(gyro=walk.gyro.copy())
    walk = walk._replace(accel=walk.accel.copy())
    walk.gyro[:rows] = gyro + random.normal(0, 0.1 * noise, (rows, 3))
    walk.accel[:rows] = walk.accel[:rows].mean(0) + random.normal(0, noise, (rows, 3))
    return walk


def test_static_start_is_level(clean):
    (recording,) = ready([clean], init="static")
    truth = rotations(clean.orientation[0]).as_matrix()
    assert np.degrees(np.arccos(recording.start.rotation[2] @ truth[2])) < 3.0  # it sways
    assert abs(np.arctan2(recording.start.rotation[1, 0], recording.start.rotation[0, 0])) < 1e-12
    assert not recording.start.velocity.any() and not recording.start.position.any()
    assert not recording.notes
    moving = clean._replace(valid=np.arange(len(clean.time)) > 600)
    (recording,) = ready([moving], init="static")
    assert "it moves, so the start is uncertain" in recording.notes[0]


def test_gyro_bias_from_reference_and_from_rest(walks, swaying):
    true = np.array([walks[0].attributes[f"gyro_bias_{axis}"] for axis in "xyz"])
    more = np.array([0.004, -0.02, 0.01])
    biased = walks[0]._replace(gyro=walks[0].gyro + more)
    (recording,) = ready([biased], gyro_bias="reference")
    np.testing.assert_allclose(recording.start.gyro_bias, true + more, atol=1e-4)
    assert "10 s against the reference" in recording.notes[0]
    biased = with_hole(biased, slice(100, 150))  # the gyro lacks rows that the reference has
    biased.gyro[100:150] += 3.0
    (recording,) = ready([biased], gyro_bias="reference")
    np.testing.assert_allclose(recording.start.gyro_bias, true + more, atol=1e-4)

    (recording,) = ready([swaying], gyro_bias="rest")
    assert not recording.start.gyro_bias.any() and "no rest" in recording.notes[0]
    (recording,) = ready([resting(swaying, BIAS, noise=0.01)], gyro_bias="rest")
    np.testing.assert_allclose(recording.start.gyro_bias, BIAS, atol=5e-4)
    assert "2 s of rest" in recording.notes[0]


def test_short_sequences_are_left_out_by_name(walks):
    short = walks[0]._replace(
        name="short", valid=np.arange(len(walks[0].time)) > len(walks[0].time) - 52
    )
    lost = with_hole(walks[0], slice(30, None))._replace(name="lost")
    prepared, left_out = evaluation.prepare([short, lost, walks[1]], CONFIG)
    assert [recording.name for recording in prepared] == [walks[1].name]
    assert left_out.keys() == {"short", "lost"}
    assert left_out["short"].startswith("1.02 s measured from its first trusted sample on, too ")
    assert left_out["lost"].startswith("0.60 s ")


@pytest.mark.parametrize("compensated", ["no", "Android's gyro bias"])
def test_a_raw_gyro_starts_with_a_wider_bias(walks, swaying, compensated):
    """It does not if the phone subtracts a bias, or if a rest has shown the bias."""
    attributes = {"imu_compensated": compensated, "placement": "unknown"}
    walk = walks[0]._replace(attributes=attributes)
    ekf = dataclasses.replace(make_filter(CONFIG, FilterSettings()), raw_gyro_bias=0.05)
    (recording,) = ready([walk], ekf=ekf)
    std = evaluation.prepare([walk], CONFIG)[0][0].start.level_gyro_bias
    expected = 0.05 if compensated == "no" else std
    assert recording.start.level_gyro_bias == expected and std < 0.01
    assert recording.start.std.gyro_bias == std
    state = recording.start.state(ekf)
    up, covariance = np.asarray(state.rotation)[2], state.core_covariance[GYRO_BIAS, GYRO_BIAS]
    assert 0.01 < up[2] < 0.99  # no axis of the phone is vertical
    spreads = np.sqrt(np.linalg.eigvalsh(covariance))
    np.testing.assert_allclose(spreads, [std, expected, expected], rtol=1e-6)
    np.testing.assert_allclose(up @ covariance @ up, std**2, rtol=1e-6)
    assert recording.start.raw_gyro == (compensated == "no") and recording.placement == ""
    resting_walk = resting(swaying, BIAS)._replace(attributes=attributes)
    (recording,) = ready([resting_walk], ekf=ekf, gyro_bias="rest")
    assert recording.start.level_gyro_bias == std


def test_sequences_of_another_rate_are_resampled():
    walk = simulated.pedestrian(1, 1, "handheld", 6.0, 200.0)
    (recording,) = ready([walk])
    assert np.diff(recording.time) == pytest.approx(CONFIG.stride / RATE)


def with_hole(sequence, rows):
    """The sequence with straight lines in the place of some rows of the IMU, which are marked."""
    measured, row = np.ones(len(sequence.time), bool), np.arange(len(sequence.time))
    measured[rows] = False
    gyro, accel = (
        np.column_stack([np.interp(row, row[measured], axis[measured]) for axis in signal.T])
        for signal in (sequence.gyro, sequence.accel)
    )
    return sequence._replace(gyro=gyro, accel=accel, imu_valid=measured)


def test_an_interpolated_gap_is_no_rest(clean):
    """A log that lacks its first second has no rest there."""
    shake = 3 * np.sin(np.arange(len(clean.time)))[:, None] * [0.0, 1.0, 1.0]
    shaken = clean._replace(accel=clean.accel + shake, gyro=clean.gyro + shake / 3)
    holed = with_hole(shaken, slice(1, round(RATE)))
    (recording,) = ready([holed], init="static", gyro_bias="rest")
    assert not recording.start.gyro_bias.any() and "no rest" in recording.notes[0]
    assert recording.start.std.velocity == 1.0 and recording.start.std.tilt > 0.01


def test_a_rest_may_lack_some_samples(swaying):
    second = round(RATE)
    holed = with_hole(resting(swaying, BIAS, second), slice(5, 5 + second // 3))
    holed.gyro[10:15] += 1.0
    (recording,) = ready([holed], init="static", gyro_bias="rest")
    np.testing.assert_allclose(recording.start.gyro_bias, BIAS, atol=1e-12)
    assert "mean of 1 s of rest" in recording.notes[0] and recording.start.std.velocity < 0.1


def test_the_tilt_of_a_static_start_has_the_uncertainty_of_the_accelerometer(clean):
    tilts = []
    for bias in (0.02, 0.2):
        ekf = make_filter(CONFIG, changed(start={"accel_bias": bias}))
        (recording,) = ready([clean], ekf=ekf, init="static")
        tilts.append(recording.start.std.tilt)
        assert recording.start.std.accel_bias == bias
    spread = np.sqrt(tilts[0] ** 2 - (0.02 / 9.81) ** 2)
    assert tilts[1] == pytest.approx(np.hypot(spread, 0.2 / 9.81), rel=1e-3)


def test_the_attitude_of_the_device_gets_the_yaw_of_the_start(walks):
    (recording,) = ready(walks[:1], orientation="device")
    device = rotations(walks[0].device_orientation[: len(recording.attitude)]).as_matrix()
    turn = recording.attitude[0] @ device[0].T
    np.testing.assert_allclose(turn[2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(recording.attitude, turn @ device, atol=1e-12)
    start = rotations(walks[0].orientation[:1]).as_matrix()
    np.testing.assert_allclose(yaw(recording.attitude[:1]), yaw(start), atol=1e-12)


def test_the_gyro_bridges_an_attitude_that_is_missing(walks):
    gap = walks[0]._replace(orientation=walks[0].orientation.copy(), valid=walks[0].valid.copy())
    gap.orientation[200:260], gap.valid[190:260] = np.nan, False
    (recording,) = ready([gap], orientation="reference")
    bridged = recording.attitude
    truth = rotations(walks[0].orientation[: len(bridged)]).as_matrix()
    np.testing.assert_allclose(bridged[:190], truth[:190], atol=1e-12)
    np.testing.assert_allclose(bridged[260:], truth[260:], atol=1e-12)
    # 1.4 s of gyro with its bias.
    np.testing.assert_allclose(bridged[190:260], truth[190:260], atol=0.03)
    zeros = gap._replace(orientation=walks[0].orientation.copy())
    zeros.orientation[200:260] = 0.0  # an untrusted row need not be a rotation
    (other,) = ready([zeros], orientation="reference")
    np.testing.assert_array_equal(other.attitude, bridged)
