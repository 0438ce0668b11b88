"""Many simulated runs at once, exactly as the filter assumes them to be: what comes of it must
agree with its own covariances."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

GRAVITY = np.array([0.0, 0.0, -9.81])


class Runs(NamedTuple):
    """r runs of K clone intervals of n samples."""

    rotation0: np.ndarray
    """(r, 3, 3), velocity0 (r, 3), position0 (r, 3): the filter's start, off the truth by the
    prior."""
    velocity0: np.ndarray
    position0: np.ndarray
    gyro: np.ndarray
    """(r, K·n, 3), accel likewise."""
    accel: np.ndarray
    displacement: np.ndarray
    """(r, K, 3), NaN before there is a window."""
    rotation: np.ndarray
    """The truth at the end of each interval: (r, K, 3, 3), and (r, K, 3) of velocity, position,
    gyro bias, accel bias."""
    velocity: np.ndarray
    position: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray


def yaw_matrix(rotation):
    yaw = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
    return Rotation.from_euler("z", yaw.reshape(-1, 1)).as_matrix().reshape(rotation.shape)


def simulate(seed, runs, intervals, n, clones, dt, noise, std, measurement_std):
    """Truth from smooth random rates and accelerations; sensors, biases, start and displacements
    disturbed as `noise` and `std` say."""
    rng = np.random.default_rng(seed)
    samples = intervals * n
    t = np.arange(samples) * dt

    def smooth(amplitude, lowest, highest):
        out = np.zeros((runs, samples, 3))
        for _ in range(3):
            size, rate = rng.normal(size=(runs, 3)), rng.uniform(lowest, highest, (runs, 3))
            phase = rng.uniform(0, 2 * np.pi, (runs, 3))
            angle = 2 * np.pi * rate[:, None] * t[None, :, None] + phase[:, None]
            out += amplitude * size[:, None] * np.sin(angle)
        return out

    rate, force = smooth(0.4, 0.05, 1.0), smooth(1.5, 0.2, 1.5)
    angles = rng.uniform(-1, 1, (runs, 3)) * [3.0, 0.3, 0.5]
    turns = Rotation.from_rotvec((rate * dt).reshape(-1, 3)).as_matrix()
    turns = turns.reshape(runs, samples, 3, 3)
    rotation = Rotation.from_euler("ZYX", angles).as_matrix()
    velocity, position = np.tile([1.0, 0.5, 0.0], (runs, 1)), rng.normal(size=(runs, 3))
    start = rng.normal(size=(runs, 9)) * np.repeat(
        [std.tilt, std.yaw, std.velocity, std.position], [2, 1, 3, 3]
    )
    first = (
        Rotation.from_rotvec(-start[:, :3]).as_matrix() @ rotation,
        velocity - start[:, 3:6],
        position - start[:, 6:9],
    )
    gyro_bias, accel_bias = (
        size * rng.normal(size=(runs, 3)) for size in (std.gyro_bias, std.accel_bias)
    )
    walk, white = (
        np.reshape(pair, (2, 1, 1, 1)) * rng.normal(size=(2, runs, samples, 3))
        for pair in (
            (noise.gyro_bias_walk, noise.accel_bias_walk),
            (noise.gyro_density, noise.accel_density),
        )
    )
    walk, white = walk * np.sqrt(dt), white / np.sqrt(dt)
    gyro, accel, ends = np.empty((runs, samples, 3)), np.empty((runs, samples, 3)), []
    for k in range(samples):
        gyro[:, k] = rate[:, k] + gyro_bias + white[0, :, k]
        accel[:, k] = (
            np.einsum("rji,rj->ri", rotation, force[:, k] - GRAVITY) + accel_bias + white[1, :, k]
        )
        position = position + velocity * dt + 0.5 * force[:, k] * dt**2
        velocity, rotation = velocity + force[:, k] * dt, rotation @ turns[:, k]
        gyro_bias, accel_bias = gyro_bias + walk[0, :, k], accel_bias + walk[1, :, k]
        if (k + 1) % n == 0:
            ends.append((rotation, velocity, position, gyro_bias, accel_bias))
    truth = [np.stack(column, 1) for column in zip(*ends, strict=True)]
    moved = truth[2][:, clones:] - truth[2][:, :-clones]
    displacement = np.full((runs, intervals, 3), np.nan)
    displacement[:, clones:] = np.einsum("rkji,rkj->rki", yaw_matrix(truth[0][:, :-clones]), moved)
    displacement += measurement_std * rng.normal(size=displacement.shape)
    return Runs(*first, gyro, accel, displacement, *truth)


def with_correlated_errors(runs, clones, sigma, correlation, interval):
    """The runs with displacements whose errors, of standard deviation `sigma`, are as the model
    has correlated ones; interval: s of a clone interval."""
    rng, shape = np.random.default_rng(3), runs.velocity.shape
    share, decay = correlation.share, np.exp(-interval / correlation.seconds)
    displacement, state = np.full(shape, np.nan), rng.normal(size=shape[::2])
    for k in range(shape[1]):
        state = decay * state + np.sqrt(1 - decay**2) * rng.normal(size=state.shape)
        if k >= clones:
            moved = runs.position[:, k] - runs.position[:, k - clones]
            displacement[:, k] = np.einsum(
                "rji,rj->ri", yaw_matrix(runs.rotation[:, k - clones]), moved
            )
        white = np.sqrt(1 - share**2) * rng.normal(size=state.shape)
        displacement[:, k] += sigma * (share * state + white)
    return runs._replace(displacement=displacement)


def errors(runs, history):
    """(r, K, 15): the truth's θ, v, p, b_g, b_a minus the filter's, θ such that truth = exp(θ)
    estimate."""
    turn = runs.rotation @ np.swapaxes(np.asarray(history.rotation), 2, 3)
    turn = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(runs.velocity.shape)
    differences = [
        getattr(runs, name) - np.asarray(getattr(history, name))
        for name in ("velocity", "position", "gyro_bias", "accel_bias")
    ]
    return np.concatenate([turn, *differences], axis=-1)
