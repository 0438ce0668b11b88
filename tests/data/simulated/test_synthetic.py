"""The computed pedestrians obey physics, and show in their IMU what a network shall learn."""

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.simulated import walks
from gnio_jax.data.simulated.walker import CARRYING, FEW_PEOPLE, step_frequency
from gnio_jax.errors import InputError
from tests.support.strap_down import matrices, strap_down


@pytest.fixture(scope="module")
def val():
    return data.load("synthetic", split="val")


@pytest.fixture(scope="module")
def test():
    return data.load("synthetic", split="test")


@pytest.mark.parametrize("placement", list(CARRYING))
def test_the_error_free_imu_integrates_to_the_trajectory(placement):
    sequence = walks.pedestrian(5, 3, placement, 60.0, imu_errors=False)
    assert np.abs(strap_down(sequence) - sequence.position).max() < 1e-3


def test_the_imu_of_a_phone_alone_is_lost_within_two_minutes(test):
    sequence = test[0]
    assert np.linalg.norm(strap_down(sequence)[-1] - sequence.position[-1]) > 100.0


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


def test_a_seed_is_a_walk_and_splits_share_neither_seeds_nor_people(val, test):
    for once, again in zip(val, data.load("synthetic", split="val"), strict=True):
        np.testing.assert_array_equal(once.accel, again.accel)
        assert once.attributes == again.attributes
    used = {
        split: [(s.attributes["seed"], s.attributes["subject"]) for s in sequences]
        for split, sequences in (("val", val), ("test", test))
    }
    assert not {seed for seed, _ in used["val"]} & {seed for seed, _ in used["test"]}
    assert all(len({seed for seed, _ in pairs}) == len(pairs) for pairs in used.values())
    assert not {subject for _, subject in used["val"]} & {subject for _, subject in used["test"]}
    assert len({s.attributes["placement"] for s in val}) == len(CARRYING)
    with pytest.raises(InputError, match="unknown split 'dev'; known splits: train, val, test"):
        data.load("synthetic", split="dev")


def test_walks_hold_stops_strolls_runs_turns_and_stairs(test):
    speeds, climbs, turned = [], [], 0.0
    for sequence in test:
        second = sequence.position[200::200] - sequence.position[:-200:200]
        speeds.append(np.linalg.norm(second[:, :2], axis=1))
        climbs.append(second[:, 2])
        heading = np.unwrap(np.arctan2(second[:, 1], second[:, 0]))
        turned += np.abs(np.diff(heading[speeds[-1] > 0.4])).sum()
    speed, climb = np.concatenate(speeds), np.concatenate(climbs)
    assert (speed < 0.03).mean() > 0.02 and ((speed > 0.4) & (speed < 0.8)).mean() > 0.1
    assert ((speed > 1.0) & (speed < 1.7)).mean() > 0.3 and (speed > 2.2).mean() > 0.02
    assert (climb > 0.2).sum() > 10 and (climb < -0.2).sum() > 10 and turned > 10 * np.pi


def test_standing_is_standing_still(val):
    for sequence in val:
        start = sequence.time < 1.5
        assert np.linalg.norm(sequence.velocity[start], axis=1).max() < 0.03
        assert np.ptp(sequence.position[start], axis=0).max() < 0.03


def test_cadence_and_bounce_grow_with_the_speed():
    """Measured from the IMU: the strongest line of the vertical acceleration, and its strength."""
    found = {}
    for seed in range(20, 26):
        sequence = walks.pedestrian(seed, 4, "chest", 60.0)
        vertical = (
            np.einsum("nj,nj->n", matrices(sequence.orientation)[:, 2], sequence.accel) - 9.81
        )
        for start in range(1000, len(vertical) - 800, 400):
            window = slice(start, start + 800)
            second = (
                sequence.position[start + 200 : start + 801 : 200]
                - sequence.position[start : start + 601 : 200]
            )
            speed = np.linalg.norm(second[:, :2], axis=1)
            if np.ptp(speed) < 0.15 and abs(second[:, 2]).max() < 0.1 and speed.mean() > 0.4:
                spectrum = np.abs(np.fft.rfft(vertical[window] * np.hanning(800), 8192))
                found[speed.mean()] = (np.argmax(spectrum) * 200 / 8192, vertical[window].std())
    speed = np.array(sorted(found))
    cadence, bounce = np.array([found[value] for value in speed]).T
    assert len(speed) > 20 and np.ptp(speed) > 0.9
    assert np.corrcoef(speed, cadence)[0, 1] > 0.95 and np.corrcoef(speed, bounce)[0, 1] > 0.9
    # One walker has one gain of the cadence. A run has a cadence of its own.
    gain = (cadence / step_frequency(speed))[speed < 1.8]
    low, high = FEW_PEOPLE.cadence
    np.testing.assert_allclose(gain, np.median(gain), rtol=0.08)
    assert low - 0.05 < np.median(gain) < high + 0.05


def test_the_sign_of_the_direction_of_travel_shows_in_the_imu(test):
    """The walker surges while bouncing up, whoever walks and wherever the phone is: forward is not
    backward."""
    correlations = []
    for sequence in test:
        force = np.einsum("nij,nj->ni", matrices(sequence.orientation), sequence.accel)
        surge = np.cumsum(force[:, :2], axis=0) / 200
        surge = surge - np.apply_along_axis(np.convolve, 0, surge, np.ones(201) / 201, mode="same")
        travel = (sequence.position[200:] - sequence.position[:-200])[:, :2]
        speed = np.linalg.norm(travel, axis=1)
        walking = (speed > 0.9) & (speed < 1.8)
        forward = np.einsum("ni,ni->n", surge[100:-100], travel / np.maximum(speed, 1e-6)[:, None])
        correlations.append(np.corrcoef(forward[walking], force[100:-100, 2][walking])[0, 1])
    assert min(correlations) > 0.3


def test_the_phone_points_anywhere_and_its_own_attitude_drifts(val):
    offsets = []
    for sequence in val:
        rotation, own = matrices(sequence.orientation), matrices(sequence.device_orientation)
        yaw = np.unwrap(
            np.arctan2(own[:, 1, 0], own[:, 0, 0])
            - np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        )
        assert np.degrees(np.ptp(yaw)) > 0.5
        tilt = np.degrees(
            np.arccos(np.clip(np.einsum("nj,nj->n", rotation[:, 2], own[:, 2]), -1, 1))
        )
        assert tilt.max() < 5.0
        travel = (sequence.position[200:] - sequence.position[:-200])[:, :2]
        moving = np.linalg.norm(travel, axis=1) > 0.5
        heading = np.exp(
            1j
            * (
                np.arctan2(rotation[:-200, 1, 0], rotation[:-200, 0, 0])
                - np.arctan2(travel[:, 1], travel[:, 0])
            )
        )[moving]
        offsets.append(np.angle(heading.mean()))
    assert np.ptp(offsets) > 0.5
