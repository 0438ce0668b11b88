"""Wandering trajectories and what may happen to them."""

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation.trajectory import Trajectory

STEP = 0.1


def quaternions(rotation):
    return np.roll(rotation.as_quat(), 1, axis=-1)


def walk(seed=0, n=900, tilt=0.0):
    """A wandering path at about 1.2 m/s whose yaw follows it, with a stop in the middle."""
    random, k = np.random.default_rng(seed), np.arange(n)
    heading = np.cumsum(random.normal(0, 0.08, n))
    speed = np.where((k > 400) & (k < 480), 0.0, 1.2 + 0.2 * np.sin(k * 0.3))
    velocity = [speed * np.cos(heading), speed * np.sin(heading), 0.1 * np.sin(k * 0.05)]
    position = np.cumsum(np.stack(velocity, 1) * STEP, 0)
    angles = np.stack([heading, tilt * np.sin(k * 0.07), tilt * np.cos(k * 0.11)], 1)
    return Trajectory(k * STEP + 5.0, position, quaternions(Rotation.from_euler("ZYX", angles)))


def perturbed(truth, seed=1, scale=0.05):
    random = np.random.default_rng(seed)
    n = len(truth.time)
    turn = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.004, (n, 3)), 0))
    moved = truth.position + np.cumsum(random.normal(0, scale, (n, 3)), 0)
    return Trajectory(truth.time, moved, turned(truth, turn))


def moved_by(trajectory, rotation, shift):
    position = rotation.apply(trajectory.position) + shift
    return Trajectory(trajectory.time, position, turned(trajectory, rotation))


def turned(trajectory, rotation):
    attitude = Rotation.from_quat(trajectory.orientation, scalar_first=True)
    return quaternions(rotation * attitude)


def masked(trajectory, rows):
    position = trajectory.position.copy()
    position[rows] = np.nan
    return trajectory._replace(position=position)


PITCHES = [0, 45, 84, 90]


def pitched(pitch, n=900):
    """A walk whose phone is held at a constant pitch (°), its body x axis vertical at 90."""
    path = walk(n=n)
    held = Rotation.from_euler("y", pitch, degrees=True)
    heading = Rotation.from_quat(path.orientation, scalar_first=True)
    return path._replace(orientation=quaternions(heading * held))


def lost(trajectory, row):
    """The trajectory, not finite from a row on."""
    finite = np.arange(len(trajectory.time))[:, None] < row
    return Trajectory(trajectory.time, *(np.where(finite, part, np.nan) for part in trajectory[1:]))
