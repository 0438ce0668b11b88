"""The randomised pedestrians obey physics, differ widely, and share what a network shall learn."""

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.simulated import walks as simulated
from gnio_jax.data.simulated.walker import CARRYING, MANY_PEOPLE, draw_motion
from tests.support.strap_down import matrices

RATE = 100.0


@pytest.fixture(scope="module")
def walks():
    return [simulated.random_walk(seed, 40.0) for seed in range(16)]


def error_free(seed, placement, seconds=60.0):
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE) + 1) / RATE
    walk = draw_motion(rng, MANY_PEOPLE, placement, time, 1 / RATE)
    phone = simulated.PHONE
    return simulated.walk_sequence(rng, "walk", walk, 1 / RATE, phone, {}, imu_errors=False)


def test_every_walk_passes_the_self_check(walks):
    for sequence in walks:
        data.validate(sequence, sequence.name)
        check = data.self_check(sequence)
        assert check.failures == ()
        assert check.accel_correlation_horizontal > 0.9


def test_splits_share_no_walk():
    names = [
        {r.name for r in simulated.RANDOMISED.recordings(None, split)}
        for split in ("train", "val", "test")
    ]
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
    200005: (
        [17.12432209650229, -16.86730792811519, -0.010144025394450723],
        [6223.273728834688, 14162.67213369514, 17453.21575709797],
        [530.6952463129243, 1902.1382035068507, 1480.27912035227],
    ),
}


@pytest.mark.parametrize("seed", list(KNOWN))
def test_a_seed_is_the_walk_that_it_has_always_been(seed):
    """Published networks were trained on these walks."""
    if seed == 3001:
        walk = simulated.pedestrian(seed, 201, "pocket", 20.0)
    else:
        walk = simulated.random_walk(seed, 20.0)
    end, accel, gyro = KNOWN[seed]
    np.testing.assert_allclose(walk.position[-1], end, rtol=1e-9)
    np.testing.assert_allclose(np.abs(walk.accel).sum(axis=0), accel, rtol=1e-9)
    np.testing.assert_allclose(np.abs(walk.gyro).sum(axis=0), gyro, rtol=1e-9)


def test_all_ways_of_carrying_occur(walks):
    assert {walk.attributes["placement"] for walk in walks} == set(CARRYING)
    assert sum(each.share for each in CARRYING.values()) == pytest.approx(1.0)


def surge_and_force(sequence):
    """(velocity against the walker's own along the direction of travel, vertical force, speed), the
    first by integrating the IMU's horizontal force over a second."""
    force = np.einsum("nij,nj->ni", matrices(sequence.orientation), sequence.accel)
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
    found = []
    for seed in range(12):
        surge, vertical, speed = surge_and_force(error_free(seed, placement, 40.0))
        # Runs, which are told by their force, follow the opposite rule.
        walking = (speed > 0.6) & (speed < 1.7)
        force = np.convolve(np.abs(vertical - 9.81), np.ones(200) / 200, mode="same")
        walking &= force < 3.0
        if walking.sum() > 500:
            found.append(np.corrcoef(surge[walking], vertical[walking])[0, 1])
    assert len(found) >= 8
    assert np.mean(np.array(found) > 0) >= 0.8 and np.mean(found) > 0.15


def test_bounce_at_one_speed_differs_widely_between_walkers():
    bounces = []
    for seed in range(16):
        _, vertical, speed = surge_and_force(error_free(seed, "handheld", 40.0))
        walking = (speed > 0.9) & (speed < 1.3)
        if walking.sum() > 200:
            bounces.append(vertical[walking].std())
    assert len(bounces) >= 6 and max(bounces) > 1.6 * min(bounces)
