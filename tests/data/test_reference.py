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
    """Nor does a flip of a second of a noisy tracker. One that was lost before the first sample and
    came back after the last gives no reference."""
    stamps = np.arange(0.0, 30.0, 1.0 / 60.0)
    stamps = stamps[(stamps < 10.0) | (stamps > 12.0)]
    poses, most = tracked(stamps, noisy=kind == "noisy"), np.inf
    if "velocity" in kind:
        poses, most = poses._replace(velocity=point_velocity(stamps)), 1e3
    lost, near = (CLOCK > 10.0) & (CLOCK < 12.0), 3
    if kind == "noisy":
        flip = Rotation.from_euler("x", 120, degrees=True)
        poses.attitude[780:840] = poses.attitude[780:840] * flip
        lost, near = lost | (CLOCK > 15.05) & (CLOCK < 15.95), 25
    found = reference_at(CLOCK, walk.rate(CLOCK), poses, max_drift=most)
    assert not found.valid[lost].any()
    assert found.valid[~numerics.within(lost, near)][20:-20].all()
    compare(found, 2e-3, 0.5, 0.05)
    far = np.concatenate([np.arange(-10.0, -5.0, 1 / 60.0), np.arange(35.0, 40.0, 1 / 60.0)])
    elsewhere = tracked(far, noisy=kind == "noisy")
    assert not reference_at(CLOCK, walk.rate(CLOCK), elsewhere).valid.any()
