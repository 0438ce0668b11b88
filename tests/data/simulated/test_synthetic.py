"""The computed pedestrians obey physics, and show in their IMU what a network shall learn."""

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.simulated import walks
from gnio_jax.data.simulated.walker import CARRYING
from gnio_jax.errors import InputError
from tests.support.strap_down import strap_down


@pytest.fixture(scope="module")
def val():
    return data.load("synthetic", split="val")


@pytest.mark.parametrize("placement", list(CARRYING))
def test_the_error_free_imu_integrates_to_the_trajectory(placement):
    sequence = walks.pedestrian(5, 3, placement, 60.0, imu_errors=False)
    assert np.abs(strap_down(sequence) - sequence.position).max() < 1e-3


def test_velocity_is_the_derivative_of_the_position(val):
    for sequence in val:
        dt = sequence.time[1] - sequence.time[0]
        difference = (sequence.position[2:] - sequence.position[:-2]) / (2 * dt)
        np.testing.assert_allclose(difference, sequence.velocity[1:-1], atol=0.02)


def test_every_sequence_passes_the_self_check_by_far(val):
    for sequence in val:
        data.validate(sequence, sequence.name)
        check = data.self_check(sequence)
        assert check.failures == () and check.rate == pytest.approx(200.0)
        np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=0.15)
        assert check.gyro_consistency_degrees < 1.0
        assert check.accel_correlation_horizontal > 0.99
        assert 0.5 < check.median_speed < 2.0


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
        np.testing.assert_allclose(
            error.mean(axis=0), stated, atol=5 * sigma / np.sqrt(len(error)) + 5e-3 * bounds[1]
        )
        np.testing.assert_allclose(
            np.diff(error, axis=0).std(axis=0) / np.sqrt(2), sigma, rtol=0.05
        )
        assert bounds[0] <= np.linalg.norm(stated) <= bounds[1]


def test_a_seed_is_a_walk_and_splits_share_neither_seeds_nor_people(val):
    once, (again,) = val[0], walks.SYNTHETIC.recordings(None, "val")[0].read()
    np.testing.assert_array_equal(once.accel, again.accel)
    assert once.attributes == again.attributes
    assert len({s.attributes["placement"] for s in val}) == len(CARRYING)
    found = [
        {each.read.args[1:3] for each in walks.SYNTHETIC.recordings(None, split)}
        for split in ("train", "val", "test")
    ]
    for values in zip(*(map(set, zip(*pairs, strict=True)) for pairs in found), strict=True):
        assert len(set.union(*values)) == sum(map(len, values))  # seeds, then people
    with pytest.raises(InputError, match="unknown split 'dev'; known splits: train, val, test"):
        data.load("synthetic", split="dev")
