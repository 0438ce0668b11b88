"""Wandering trajectories and what may happen to them."""

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation.trajectory import Trajectory

STEP = 0.1


def quaternions(rotation):
    return np.roll(rotation.as_quat(), 1, axis=-1)


def walk(seed=0, n=900, tilt=0.0):
    """A wandering path at about 1.2 m/s whose yaw follows it, with a stop in the middle."""
    random = np.random.default_rng(seed)
    heading = np.cumsum(random.normal(0, 0.08, n))
    speed = np.where(
        (np.arange(n) > 400) & (np.arange(n) < 480), 0.0, 1.2 + 0.2 * np.sin(np.arange(n) * 0.3)
    )
    steps = (
        np.stack(
            [speed * np.cos(heading), speed * np.sin(heading), 0.1 * np.sin(np.arange(n) * 0.05)], 1
        )
        * STEP
    )
    angles = np.stack(
        [heading, tilt * np.sin(np.arange(n) * 0.07), tilt * np.cos(np.arange(n) * 0.11)], 1
    )
    return Trajectory(
        np.arange(n) * STEP + 5.0,
        np.cumsum(steps, 0),
        quaternions(Rotation.from_euler("ZYX", angles)),
    )


def perturbed(truth, seed=1, scale=0.05):
    random = np.random.default_rng(seed)
    n = len(truth.time)
    turn = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.004, (n, 3)), 0))
    moved = truth.position + np.cumsum(random.normal(0, scale, (n, 3)), 0)
    return Trajectory(
        truth.time, moved, quaternions(turn * Rotation.from_quat(np.roll(truth.orientation, -1, 1)))
    )


def moved_by(trajectory, rotation, shift):
    return Trajectory(
        trajectory.time,
        rotation.apply(trajectory.position) + shift,
        quaternions(rotation * Rotation.from_quat(np.roll(trajectory.orientation, -1, 1))),
    )


def masked(trajectory, rows):
    position = trajectory.position.copy()
    position[rows] = np.nan
    return trajectory._replace(position=position)


PITCHES = [0, 45, 84, 90]


def pitched(pitch, n=900):
    """A walk whose phone is held at a constant pitch (°), its body x axis vertical at 90."""
    path = walk(n=n)
    held = Rotation.from_euler("y", pitch, degrees=True)
    heading = Rotation.from_quat(np.roll(path.orientation, -1, 1))
    return path._replace(orientation=quaternions(heading * held))


def lost(trajectory, row):
    """The trajectory, not finite from a row on."""
    there = np.arange(len(trajectory.time))[:, None] < row
    return Trajectory(trajectory.time, *(np.where(there, part, np.nan) for part in trajectory[1:]))
