"""The computed pedestrians obey physics, differ widely, and show what a network shall learn."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.simulated import walks
from gnio_jax.data.simulated.walker import CARRYING


@pytest.fixture(scope="module")
def val():
    return data.load("synthetic", split="val")


def strap_down(sequence):
    """Positions from integrating the IMU alone, sample by sample: R exp((gyro) dt), v + (R accel +
    g) dt."""
    dt, gravity = sequence.time[1] - sequence.time[0], np.array([0, 0, -9.81])
    rotation = Rotation.from_quat(sequence.orientation[0], scalar_first=True).as_matrix()
    velocity, position = sequence.velocity[0], sequence.position[0]
    turns = Rotation.from_rotvec(sequence.gyro * dt).as_matrix()
    positions = np.empty_like(sequence.position)
    for k in range(len(sequence.time)):
        positions[k] = position
        change = (rotation @ sequence.accel[k] + gravity) * dt
        position = position + velocity * dt + 0.5 * change * dt
        velocity, rotation = velocity + change, rotation @ turns[k]
    return positions


@pytest.mark.parametrize("placement", list(CARRYING))
def test_the_error_free_imu_integrates_to_the_trajectory(placement):
    sequence = walks.pedestrian(5, 3, placement, 60.0, imu_errors=False)
    assert np.abs(strap_down(sequence) - sequence.position).max() < 1e-3


@pytest.mark.parametrize("rate", [50.0, 100.0, 400.0])
def test_a_walk_is_the_same_at_every_rate(rate):
    usual, resampled = (
        walks.pedestrian(3, 5, "pocket", 20.0, r, imu_errors=False) for r in (200.0, rate)
    )
    shared = min(rate, 200.0)
    usual_rows, rows = (slice(None, None, round(r / shared)) for r in (200.0, rate))
    for field in ("position", "velocity", "orientation"):
        expected = getattr(usual, field)[usual_rows]
        np.testing.assert_allclose(getattr(resampled, field)[rows], expected, atol=1e-9)
    # Samples of a lower rate are means over longer intervals, so they are no larger.
    strongest, strongest_resampled = (abs(walk.accel).max() for walk in (usual, resampled))
    assert strongest_resampled < 1.02 * strongest


def test_every_walk_is_physical(val):
    for sequence in val:
        data.validate(sequence, sequence.name)
        check = data.self_check(sequence)
        assert check.failures == ()
        np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=0.15)
        assert check.rate == pytest.approx(200.0) and 0.5 < check.median_speed < 2.0
        assert check.gyro_consistency_degrees < 1.0 and check.accel_correlation_horizontal > 0.99
        difference = (sequence.position[2:] - sequence.position[:-2]) * (check.rate / 2)
        np.testing.assert_allclose(difference, sequence.velocity[1:-1], atol=0.02)
    assert {walk.attributes["placement"] for walk in val} == set(CARRYING)


def test_the_stated_biases_and_noise_are_the_true_ones():
    ideal = walks.pedestrian(11, 1, "bag", 60.0, imu_errors=False)
    sequence = walks.pedestrian(11, 1, "bag", 60.0)
    np.testing.assert_array_equal(ideal.position, sequence.position)
    for field, density, bounds in (
        ("gyro", walks.PHONE.gyro_density, walks.PHONE.gyro_bias),
        ("accel", walks.PHONE.accel_density, walks.PHONE.accel_bias),
    ):
        error = getattr(sequence, field) - getattr(ideal, field)
        stated = np.array([sequence.attributes[f"{field}_bias_{axis}"] for axis in "xyz"])
        sigma = density * np.sqrt(200.0)
        tolerance = 5 * sigma / np.sqrt(len(error)) + 5e-3 * bounds[1]
        np.testing.assert_allclose(error.mean(axis=0), stated, atol=tolerance)
        noise = np.diff(error, axis=0).std(axis=0) / np.sqrt(2)
        np.testing.assert_allclose(noise, sigma, rtol=0.05)
        assert bounds[0] <= np.linalg.norm(stated) <= bounds[1]


def test_a_seed_is_a_walk_and_splits_share_neither_seeds_nor_people(val):
    once, (again,) = val[0], walks.SYNTHETIC.recordings(None, "val")[0].read()
    np.testing.assert_array_equal(once.accel, again.accel)
    assert once.attributes == again.attributes
    splits = ("train", "val", "test")
    pair_sets = [
        {recording.read.args[1:3] for recording in walks.SYNTHETIC.recordings(None, split)}
        for split in splits
    ]
    for values in zip(*(map(set, zip(*pairs, strict=True)) for pairs in pair_sets), strict=True):
        assert len(set.union(*values)) == sum(map(len, values))  # seeds, then people


def test_a_seed_is_the_walk_that_it_has_always_been():
    """Published figures are of these walks: where this one ends (m), and the sums of |accel| and
    |gyro| over its samples."""
    walk = walks.pedestrian(3001, 201, "pocket", 20.0)
    end = [8.268985122117613, -22.153815669098634, 3.3990187167441333]
    accel = [6570.717909661941, 43481.49970855106, 8982.95660633462]
    gyro = [2304.07557312174, 2838.0901640423767, 3220.1150007217034]
    np.testing.assert_allclose(walk.position[-1], end, rtol=1e-9)
    np.testing.assert_allclose(np.abs(walk.accel).sum(axis=0), accel, rtol=1e-9)
    np.testing.assert_allclose(np.abs(walk.gyro).sum(axis=0), gyro, rtol=1e-9)
