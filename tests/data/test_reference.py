"""A tracker's poses on the clock of an IMU, against a walk in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import numerics
from gnio_jax.data.reference import Poses, reference_at
from gnio_jax.numerics import rotations
from tests.support import known_walk as walk

CLOCK = np.arange(0.0, 30.0, 0.01)
LEVER = np.array([0.05, -0.1, 0.2])


def tracked(stamps, **options):
    """Poses of a point from which the IMU lies `LEVER` away."""
    attitude = walk.attitude(stamps)
    arm = attitude.apply(LEVER)
    return Poses(stamps, attitude, walk.position(stamps) - arm, lever=LEVER, **options)


def point_velocity(stamps):
    turning = np.cross(walk.rate(stamps), LEVER)
    return walk.velocity(stamps) - walk.attitude(stamps).apply(turning)


def compare(found, metres, degrees, speed, edge=20):
    valid = found.valid.copy()
    valid[:edge] = valid[-edge:] = False
    clock = CLOCK[valid]
    assert np.abs(found.position[valid] - walk.position(clock)).max() < metres
    error = rotations(found.orientation[valid]) * walk.attitude(clock).inv()
    assert np.degrees(error.magnitude()).max() < degrees
    off = found.velocity[valid] - walk.velocity(clock)
    assert np.sqrt((off**2).sum(axis=1).mean()) < speed


@pytest.mark.parametrize("rate", [200.0, 30.0])
@pytest.mark.parametrize("kind", ["with a velocity", "smooth", "noisy"])
def test_poses_of_every_kind_and_rate_come_to_the_imus_place(kind, rate):
    stamps = np.arange(0.0, 30.0, 1.0 / rate) + 0.003
    options = {
        "with a velocity": {"velocity": point_velocity(stamps)},
        "smooth": {},
        "noisy": {"noisy": True},
    }
    found = reference_at(CLOCK, walk.rate(CLOCK), tracked(stamps, **options[kind]))
    assert found.valid[20:-20].all()
    compare(found, 2e-3, 0.5, 0.05)


@pytest.mark.parametrize("kind", ["smooth", "noisy", "with a velocity, drifts are looked for"])
def test_a_loss_is_not_valid_and_does_not_reach_its_surroundings(kind):
    stamps = np.arange(0.0, 30.0, 1.0 / 60.0)
    stamps = stamps[(stamps < 10.0) | (stamps > 12.0)]
    poses, most = tracked(stamps, noisy=kind == "noisy"), np.inf
    if "velocity" in kind:
        poses, most = poses._replace(velocity=point_velocity(stamps)), 1e3
    found = reference_at(CLOCK, walk.rate(CLOCK), poses, max_drift=most)
    lost = (CLOCK > 10.0) & (CLOCK < 12.0)
    assert not found.valid[lost].any()
    assert found.valid[~numerics.within(lost, 3)][20:-20].all()
    compare(found, 2e-3, 0.5, 0.05)


def test_a_flip_of_a_second_is_not_valid_and_turns_nothing_around_it():
    poses = tracked(np.arange(0.0, 30.0, 1.0 / 60.0), noisy=True)
    poses.attitude[600:660] = poses.attitude[600:660] * Rotation.from_euler("x", 120, degrees=True)
    found = reference_at(CLOCK, walk.rate(CLOCK), poses)
    assert not found.valid[(CLOCK > 10.05) & (CLOCK < 10.95)].any()
    assert found.valid[(CLOCK < 9.8) | (CLOCK > 11.2)][20:-20].all()
    error = rotations(found.orientation[20:-20]) * walk.attitude(CLOCK[20:-20]).inv()
    assert np.degrees(error.magnitude()).max() < 0.5


def test_a_tracker_that_saw_nothing_of_the_imu_gives_no_reference():
    """It was lost before the first sample and came back after the last."""
    stamps = np.concatenate([np.arange(-10.0, -5.0, 1 / 60.0), np.arange(35.0, 40.0, 1 / 60.0)])
    for options in ({"noisy": True}, {}):
        found = reference_at(CLOCK, walk.rate(CLOCK), tracked(stamps, **options))
        assert not found.valid.any()
