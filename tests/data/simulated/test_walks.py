"""The computed pedestrians obey physics, differ widely, and show in their IMU what a network shall
learn."""

import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.simulated import walks
from gnio_jax.data.simulated.walker import CARRYING, MANY_PEOPLE, draw_motion

RATE = 100.0


@pytest.fixture(scope="module")
def val():
    return data.load("synthetic", split="val")


@pytest.fixture(scope="module")
def randomised():
    return [walks.random_walk(seed, 40.0) for seed in range(12)]


@functools.cache
def error_free(seed, placement):
    rng = np.random.default_rng(seed)
    time = np.arange(round(40.0 * RATE) + 1) / RATE
    motion = draw_motion(rng, MANY_PEOPLE, placement, time, 1 / RATE)
    return walks.walk_sequence(rng, "walk", motion, 1 / RATE, walks.PHONE, {}, imu_errors=False)


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


def test_every_walk_is_physical(val, randomised):
    for sequence in [*val, *randomised]:
        data.validate(sequence, sequence.name)
        check = data.self_check(sequence)
        assert check.failures == () and check.accel_correlation_horizontal > 0.9
    for sequence in val:  # by far
        check = data.self_check(sequence)
        np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=0.15)
        assert check.rate == pytest.approx(200.0) and 0.5 < check.median_speed < 2.0
        assert check.gyro_consistency_degrees < 1.0 and check.accel_correlation_horizontal > 0.99
        difference = (sequence.position[2:] - sequence.position[:-2]) * (check.rate / 2)
        np.testing.assert_allclose(difference, sequence.velocity[1:-1], atol=0.02)
    for some in (val, randomised):
        assert {walk.attributes["placement"] for walk in some} == set(CARRYING)
    assert sum(each.share for each in CARRYING.values()) == pytest.approx(1.0)


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
    found = [
        {each.read.args[1:3] for each in walks.SYNTHETIC.recordings(None, split)}
        for split in splits
    ]
    for values in zip(*(map(set, zip(*pairs, strict=True)) for pairs in found), strict=True):
        assert len(set.union(*values)) == sum(map(len, values))  # seeds, then people
    names = [{each.name for each in walks.RANDOMISED.recordings(None, split)} for split in splits]
    assert sum(map(len, names)) == len(set.union(*names)) == 600 + 40 + 24


# seed -> where the walk of 20 s ends (m), and the sums of |accel| and |gyro| over its samples.
KNOWN = {
    200000: (
        [-15.987564707673124, 2.143442584612825, -0.031023060489223764],
        [2188.972821880198, 19507.96905872019, 2362.0737368805467],
        [674.5280856928983, 1185.0200491000644, 700.2600224902284],
    ),
    3001: (  # of `synthetic`, a pocket
        [8.268985122117613, -22.153815669098634, 3.3990187167441333],
        [6570.717909661941, 43481.49970855106, 8982.95660633462],
        [2304.07557312174, 2838.0901640423767, 3220.1150007217034],
    ),
}


@pytest.mark.parametrize("seed", KNOWN)
def test_a_seed_is_the_walk_that_it_has_always_been(seed):
    """Published networks were trained on these walks."""
    if seed == 3001:
        walk = walks.pedestrian(seed, 201, "pocket", 20.0)
    else:
        walk = walks.random_walk(seed, 20.0)
    end, accel, gyro = KNOWN[seed]
    np.testing.assert_allclose(walk.position[-1], end, rtol=1e-9)
    np.testing.assert_allclose(np.abs(walk.accel).sum(axis=0), accel, rtol=1e-9)
    np.testing.assert_allclose(np.abs(walk.gyro).sum(axis=0), gyro, rtol=1e-9)


def surge_and_force(sequence):
    """(velocity against the walker's own along the direction of travel, vertical force, speed), the
    first by integrating the IMU's horizontal force over a second."""
    force = Rotation.from_quat(sequence.orientation, scalar_first=True).apply(sequence.accel)
    second = round(RATE)
    travel = (sequence.position[second:] - sequence.position[:-second])[:, :2]
    speed = np.linalg.norm(travel, axis=1)
    surge = np.cumsum(force[:, :2], axis=0) / RATE
    box = np.ones(second + 1) / (second + 1)
    surge = surge - np.apply_along_axis(np.convolve, 0, surge, box, mode="same")
    middle = slice(second // 2, -second // 2)
    direction = travel / np.maximum(speed, 1e-6)[:, None]
    return np.einsum("ni,ni->n", surge[middle], direction), force[middle, 2], speed


@pytest.mark.parametrize("placement", ["handheld", "pocket"])
def test_forward_is_told_from_backward_by_the_same_rule_for_nearly_all_walkers(placement):
    """The bounce at one speed differs widely between them."""
    found, bounces = [], []
    for seed in range(12):
        surge, vertical, speed = surge_and_force(error_free(seed, placement))
        # Runs, which are told by their force, follow the opposite rule.
        walking = (speed > 0.6) & (speed < 1.7)
        force = np.convolve(np.abs(vertical - 9.81), np.ones(200) / 200, mode="same")
        walking &= force < 3.0
        if walking.sum() > 500:
            found.append(np.corrcoef(surge[walking], vertical[walking])[0, 1])
        steady = (speed > 0.9) & (speed < 1.3)
        if steady.sum() > 200:
            bounces.append(vertical[steady].std())
    assert len(found) >= 8
    assert np.mean(np.array(found) > 0) >= 0.8 and np.mean(found) > 0.15
    assert len(bounces) >= 5 and max(bounces) > 1.6 * min(bounces)
