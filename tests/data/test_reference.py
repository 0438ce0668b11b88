"""A noisy tracker's poses on the clock of an IMU, against a walk in closed form."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import numerics
from gnio_jax.data.reference import Poses, reference_at, smooth_positions
from gnio_jax.numerics import rotations
from tests.support import known_walk as walk

CLOCK = np.arange(0.0, 30.0, 0.01)
LEVER = np.array([0.05, -0.1, 0.2])


def tracked(stamps):
    """Poses of a point from which the IMU lies `LEVER` away."""
    attitude = walk.attitude(stamps)
    position = walk.position(stamps) - attitude.apply(LEVER)
    return Poses(stamps, attitude, position, lever=LEVER, noisy=True)


def test_a_loss_and_a_flip_of_a_second_do_not_reach_their_surroundings():
    """A tracker that was lost before the first sample and came back after the last gives none."""
    stamps = np.arange(0.0, 30.0, 1.0 / 60.0)
    poses = tracked(stamps[(stamps < 10.0) | (stamps > 12.0)])
    flip = Rotation.from_euler("x", 120, degrees=True)
    poses.attitude[780:840] = poses.attitude[780:840] * flip
    lost = (CLOCK > 10.0) & (CLOCK < 12.0)
    flipped = (CLOCK > 15.05) & (CLOCK < 15.95)
    reference = reference_at(CLOCK, walk.rate(CLOCK), poses)
    assert not reference.valid[lost | flipped].any()
    beside = ~numerics.within(lost, 3) & ~numerics.within(flipped, 25)
    assert reference.valid[beside][20:-20].all()
    inner = reference.valid & (CLOCK > 0.2) & (CLOCK < 29.8)
    clock = CLOCK[inner]
    assert np.abs(reference.position[inner] - walk.position(clock)).max() < 2e-3
    error = rotations(reference.orientation[inner]) * walk.attitude(clock).inv()
    assert np.degrees(error.magnitude()).max() < 0.5
    off = reference.velocity[inner] - walk.velocity(clock)
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.05
    far = np.concatenate([np.arange(-10.0, -5.0, 1 / 60.0), np.arange(35.0, 40.0, 1 / 60.0)])
    assert not reference_at(CLOCK, walk.rate(CLOCK), tracked(far)).valid.any()


@pytest.mark.parametrize("rate", [100.0, 500.0, 1000.0, 2000.0])
def test_holes_in_fast_recordings_are_bridged(rate):
    """The smoothest motion through a hole of half a second, at every rate of an IMU: the positions
    on either side do not change, and the bridge is near the walk."""
    time = np.arange(round(6 * rate)) / rate
    axes = 30 + 1.2 * time, 0.3 * np.sin(2.0 * time) - 20, 0.02 * np.sin(9.0 * time) + 5
    truth = np.stack(axes, axis=1)
    usable = np.abs(time - 3.0) > 0.25
    smoothed, velocity, used = smooth_positions(truth, usable, 1 / rate)
    assert (used == usable).all()
    np.testing.assert_allclose(smoothed[usable], truth[usable], atol=2e-3)
    assert np.abs(smoothed - truth).max() < 0.05  # 5 mm at 200 Hz
    expected = np.stack(
        [1.2 + 0 * time, 0.6 * np.cos(2.0 * time), 0.18 * np.cos(9.0 * time)], axis=1
    )
    near = (np.abs(time - 3.0) > 0.5) & (time > 0.5) & (time < 5.5)
    np.testing.assert_allclose(velocity[near], expected[near], atol=0.02)


def test_a_recording_of_a_kilohertz_without_a_usable_position_is_zero():
    smoothed, _, used = smooth_positions(np.ones((3000, 3)), np.zeros(3000, bool), 1e-3)
    assert not used.any() and not smoothed.any()


@pytest.mark.parametrize("rate", [100, 1000])
def test_smoothed_positions_do_not_depend_on_the_distance_from_the_origin(rate: int) -> None:
    time = np.arange(4 * rate) / rate
    walk = np.stack([np.sin(time), 0.5 * time, np.cos(time)], axis=1)
    velocity = np.stack([np.cos(time), np.full_like(time, 0.5), -np.sin(time)], axis=1)
    usable = (time < 2.0) | (time > 2.2)
    position, rate_of_change, used = smooth_positions(walk + 1e6, usable, 1 / rate)
    inner = slice(rate // 2, -rate // 2)
    np.testing.assert_allclose((position - 1e6)[inner], walk[inner], atol=0.01)
    np.testing.assert_allclose(rate_of_change[inner], velocity[inner], atol=0.1)
    assert used[usable].all()
