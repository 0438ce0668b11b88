"""Samples with variances of their own, and a corrector before the filter."""

import dataclasses

import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.types import Prediction

DT, N, W = 0.02, 5, 4
CONFIG = filtering.FilterConfig(dt=DT, samples_per_clone=N, clones_per_window=W, history="core")
RNG = np.random.default_rng(8)


def predict(windows):
    mean = windows.mean(axis=1)
    return Prediction(0.1 * mean[:, :3], -2.0 + 0.0 * mean[:, 3:])


def samples(intervals):
    count = N * intervals
    gyro = RNG.normal(0, 0.4, (count, 3))
    return gyro, RNG.normal([0.0, 0.0, 9.81], 1.0, (count, 3))


def begin(ekf):
    return filtering.initial_state(ekf, np.eye(3), np.zeros(3), np.zeros(3))


def test_the_densities_as_variances_change_nothing():
    ekf = filtering.Filter(CONFIG)
    imu = samples(12)
    density = ekf.noise.accel_density, ekf.noise.gyro_density
    variance = np.tile(np.repeat(np.square(density) / DT, 3), (len(imu[0]), 1))
    plain, other = (
        filtering.run_odometry(predict, ekf, begin(ekf), *imu, variance=rows)[1]
        for rows in (None, variance)
    )
    np.testing.assert_allclose(other.position, plain.position, atol=1e-9)
    np.testing.assert_allclose(other.covariance, plain.covariance, atol=1e-12)


def test_the_variances_of_each_axis_spread_the_path_as_drawn_noise_does():
    """From a certain start without a displacement: 4000 paths with drawn errors."""
    nothing = filtering.NoiseModel(gyro_bias_walk=0.0, accel_bias_walk=0.0)
    zero = filtering.InitialStd(*[0.0] * 6)
    ekf = filtering.Filter(CONFIG, noise=nothing, start=zero)
    gyro, accel = samples(1)
    variance = np.exp(RNG.uniform(-9, -5, (N, 6)))
    rows = np.full((1, 3), np.nan), np.eye(3)[None]
    _, history = filtering.run_filter(ekf, begin(ekf), gyro, accel, *rows, variance=variance)
    drawn = np.sqrt(variance) * RNG.standard_normal((4000, N, 6))

    def path(gyro, accel):
        rotation, velocity, position = np.eye(3), np.zeros(3), np.zeros(3)
        for rate, force in zip(gyro, accel, strict=True):
            before = velocity
            velocity = velocity + DT * (rotation @ force - [0, 0, 9.81])
            position = position + 0.5 * DT * (before + velocity)
            angle = np.linalg.norm(rate) * DT
            axis = rate / np.linalg.norm(rate)
            cross = np.cross(np.eye(3), axis)
            cross = -cross.T
            turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
            rotation = rotation @ turn
        return np.concatenate([velocity, position])

    ends = np.array([path(gyro + error[:, 3:], accel + error[:, :3]) for error in drawn])
    np.testing.assert_allclose(path(gyro, accel)[3:], history.position[0], atol=1e-9)
    spread = np.cov(ends.T)
    covariance = np.asarray(history.covariance[0])[3:9, 3:9]
    scale = np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
    np.testing.assert_allclose(covariance / scale, spread / scale, atol=0.08)


def test_a_variance_that_is_none_is_refused():
    ekf = filtering.Filter(CONFIG)
    with pytest.raises(ValueError, match=r"variance: .* not above 0"):
        filtering.run_odometry(predict, ekf, begin(ekf), *samples(2), variance=np.zeros((2 * N, 6)))


class Averaging:
    """A corrector that takes a share of the mean of its samples off, and remembers one of them."""

    block, before, after = 3, 2, 4

    def begin(self):
        return np.zeros(6)

    def step(self, memory, window):
        added = -0.05 * window.mean(axis=0) + 0.01 * memory
        variance = 1e-4 * (1 + np.abs(window[2]))
        return window[2], np.tile(added, (3, 1)), np.tile(variance, (3, 1))


@pytest.mark.parametrize("missing", [[], [30, 31]])
def test_a_tracker_with_a_corrector_is_the_filter_over_corrected_samples(missing):
    """For the corrector a missing sample is the one before it."""
    ekf = dataclasses.replace(filtering.Filter(CONFIG))
    gyro, accel = samples(14)
    corrector, rows = Averaging(), np.hstack([accel, gyro])
    valid = ~np.isin(np.arange(len(rows)), missing)
    rows[~valid] = rows[29]
    gyro[~valid], accel[~valid] = np.nan, np.nan
    padded = np.concatenate([np.zeros((2, 6)), rows])
    memory, corrected, variance = corrector.begin(), rows.copy(), np.zeros_like(rows)
    for first in range(0, len(rows) - 4, 3):
        memory, added, spread = corrector.step(memory, padded[first : first + 7])
        corrected[first : first + 3] += added
        variance[first : first + 3] = spread
    count = N * ((len(rows) - 4) // 3 * 3 // N)
    tracker = filtering.Tracker(predict, ekf, begin(ekf), corrector=corrector)
    assert tracker.delay == pytest.approx(4 * DT)
    poses = [tracker.push(DT * k, gyro[k], accel[k]) for k in range(len(rows))]
    poses = [pose for pose in poses if pose is not None]
    assert len(poses) == count // N
    signals = corrected[:count, 3:], corrected[:count, :3]
    _, history = filtering.run_odometry(
        predict, ekf, begin(ekf), *signals, valid[:count], variance=variance[:count]
    )
    for row, pose in enumerate(poses):
        assert pose.time == pytest.approx(DT * N * (row + 1))
        np.testing.assert_allclose(pose.position, history.position[row], atol=1e-9)
        np.testing.assert_allclose(pose.covariance, history.covariance[row], atol=1e-12)
