"""Simulated rides of a car as the filter assumes them to be: a point of it moves ahead, and by
white noise to the left and up."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support.walks import GRAVITY, Runs

ROUNDS = 12
"""A force to the left turns the direction of motion, which takes a force again: so often, until
nothing changes."""


def drive(seed, runs, intervals, n, dt, noise, std, constraint, left_std, up_std, slide=0.0):
    """Rides with turns, hills, speeds of 2 to 18 m/s and the mounting and gradients of a
    `NonHolonomic`. Sensors, biases and start are disturbed as `noise` and `std` say, and velocities
    of the point to the left and up at the ends of intervals have the given standard deviations.
    `slide` is added to the one to the left, m/s at every sample."""
    rng = np.random.default_rng(seed)
    samples = intervals * n
    t = np.arange(samples + 1)[None] * dt
    phases = rng.uniform(0, 2 * np.pi, (6, runs, 1))
    speed = 10 + 5 * np.sin(0.35 * t + phases[0]) + 3 * np.sin(0.9 * t + phases[1])
    yaw = 1.2 * np.sin(0.2 * t + phases[2]) + 0.3 * np.sin(0.7 * t + phases[3])
    pitch, roll = 0.05 * np.sin(0.5 * t + phases[4]), 0.03 * np.sin(0.8 * t + phases[5])
    mounting = Rotation.from_euler("ZYX", [constraint.yaw, constraint.pitch, constraint.roll])
    car = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], -1).reshape(-1, 3)).as_matrix()
    body = (car @ mounting.as_matrix().T).reshape(runs, samples + 1, 3, 3)
    turns = np.swapaxes(body[:, :-1], 2, 3) @ body[:, 1:]
    rate = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(runs, samples, 3) / dt

    white = rng.normal(size=(runs, intervals + 1, 2)) * [left_std, up_std]
    lever = np.array([constraint.lever_x, constraint.lever_y, constraint.lever_z])
    rate_before = np.concatenate([rate[:, :1], rate], axis=1)
    gradients = np.array([constraint.sideslip_gradient, constraint.pitch_gradient])
    angles = np.zeros((runs, intervals + 1, 2))
    rows = np.arange(samples + 1)
    for _ in range(ROUNDS if gradients.any() else 1):
        at_ends = white - angles * speed[:, ::n, None]
        of_point = np.stack([[np.interp(rows, rows[::n], row) for row in run.T] for run in at_ends])
        of_point[:, 0] += slide
        of_point = np.concatenate([speed[:, :, None], np.moveaxis(of_point, 1, 2)], axis=2)
        in_body = of_point @ mounting.as_matrix().T - np.cross(rate_before, lever)
        velocity = np.einsum("rkij,rkj->rki", body, in_body)
        force = np.diff(velocity, axis=1) / dt
        of_body = np.einsum("rkji,rkj->rki", body[:, :-1], force - GRAVITY)
        of_car = of_body @ mounting.as_matrix()
        ahead_left = of_car.reshape(runs, intervals, n, 3)[..., :2].mean(axis=2)
        angles[:, 1:] = gradients * ahead_left[..., ::-1]
    position = np.cumsum(0.5 * dt * (velocity[:, 1:] + velocity[:, :-1]), axis=1)

    start = rng.normal(size=(runs, 9)) * np.repeat(
        [std.tilt, std.yaw, std.velocity, std.position], [2, 1, 3, 3]
    )
    first = (
        Rotation.from_rotvec(-start[:, :3]).as_matrix() @ body[:, 0],
        velocity[:, 0] - start[:, 3:6],
        -start[:, 6:9],
    )
    biases, readings = [], []
    for size, walk, density, signal in (
        (std.gyro_bias, noise.gyro_bias_walk, noise.gyro_density, rate),
        (
            *(std.accel_bias, noise.accel_bias_walk, noise.accel_density),
            np.einsum("rkji,rkj->rki", body[:, :-1], force - GRAVITY),
        ),
    ):
        steps = walk * np.sqrt(dt) * rng.normal(size=(runs, samples, 3))
        bias = size * rng.normal(size=(runs, 1, 3)) + np.cumsum(steps, axis=1)
        white = density / np.sqrt(dt) * rng.normal(size=(runs, samples, 3))
        readings.append(signal + bias - steps + white)
        biases.append(bias[:, n - 1 :: n])
    rows = slice(n, None, n)
    return Runs(
        *first,
        *readings,
        np.full((runs, intervals, 3), np.nan),
        body[:, rows],
        velocity[:, rows],
        position[:, n - 1 :: n],
        *biases,
    )


SECONDS, RATE = 70.0, 100.0
"""Length of `city_drive`, s, and its rate, Hz."""
BIAS = np.array([0.02, -0.03, 0.015])
"""Bias of the gyro in `city_drive`, rad/s."""
ENGINE = 0.05, 0.8
"""Amplitudes with which an engine shakes gyro and accelerometer, rad/s and m/s²."""


def city_drive(mounting=(0.5, 0.1, -0.2), first=0.0):
    """A car that stands for 8 s, drives through bends, stands from 40 to 46 s and drives on, from
    `first` s on: `(time, gyro, accel, orientation, position)`. The angles of the mounting are yaw,
    pitch and roll, and an engine shakes every sample."""
    t = np.arange(0.0, SECONDS, 1 / RATE)
    ramps = [(8, 14, 11.0), (25, 29, -4.0), (36, 40, -7.0), (46, 53, 13.0), (60, 64, -3.0)]
    smooth = [np.clip((t - a) / (b - a), 0, 1) for a, b, _ in ramps]
    speed = sum(change * x**2 * (3 - 2 * x) for x, (*_, change) in zip(smooth, ramps, strict=True))
    speed = np.where((t < 8) | ((t > 40) & (t < 46)), 0.0, np.maximum(speed, 0.0))
    turning = 0.03 * speed * np.sin(0.25 * t) + 0.002 * speed * np.sin(1.3 * t)
    yaw = np.cumsum(turning) / RATE
    pitch = 0.02 * np.sin(0.15 * np.cumsum(speed) / RATE / 10)
    car = Rotation.from_euler("ZYX", np.stack([yaw, pitch, 0 * t], axis=1))
    body = car * Rotation.from_euler("ZYX", mounting).inv()
    velocity = speed[:, None] * car.as_matrix()[:, :, 0]
    position = np.cumsum(velocity, axis=0) / RATE
    turns = (body[:-1].inv() * body[1:]).as_rotvec() * RATE
    force = body[:-1].inv().apply(np.diff(velocity, axis=0) * RATE - GRAVITY)
    shake = np.array([1.0, -1.0, 0.5, -0.5])[np.arange(len(t) - 1) % 4][:, None]
    gyro = turns + BIAS + ENGINE[0] * shake * [1.0, 0.3, -0.5]
    accel = force + ENGINE[1] * shake * [0.2, -0.4, 1.0]
    rows = slice(round(first * RATE), -1)
    imu_rows = slice(rows.start, None)
    orientation = body.as_quat(scalar_first=True)
    return t[rows] - t[rows][0], gyro[imu_rows], accel[imu_rows], orientation[rows], position[rows]
