"""A random walk and its measurements."""

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import scekf_numpy


def random_walk(seed, *, n, clones, intervals, dt, nan_rows=(), outliers=(), pitch=0.2, bias=True):
    """Smooth random motion with noisy measurements of its true displacements; raw gyro and accel,
    and the state at the start."""
    rng = np.random.default_rng(seed)
    samples = n * intervals
    t = np.arange(samples) * dt
    wave = [
        rng.uniform(0.5, 1.0, 3)
        * np.sin(2 * np.pi * rng.uniform(0.3, 1.5, 3) * t[:, None] + rng.uniform(0, 6, 3))
        for _ in range(2)
    ]
    gyro, accel_world = wave[0], 2 * wave[1]
    bg = 5e-4 * rng.standard_normal(3) if bias else np.zeros(3)
    ba = 0.02 * rng.standard_normal(3) if bias else np.zeros(3)
    R = Rotation.from_euler("xyz", [0.3, pitch, 2.0]).as_matrix()
    v, p = np.array([1.0, -0.5, 0.1]), np.array([2.0, 1.0, -1.0])
    start, poses, accel = (R, v, p), [], np.empty((samples, 3))
    for k in range(samples):
        accel[k] = R.T @ (accel_world[k] - scekf_numpy.G)
        R, v, p = scekf_numpy.step_mean(R, v, p, 0, 0, gyro[k], accel[k], dt)
        if (k + 1) % n == 0:
            poses.append((R, p))
    displacement, covariance = np.full((intervals, 3), np.nan), np.full((intervals, 3, 3), np.nan)
    for k in range(clones, intervals):
        root = 0.03 * (np.eye(3) + 0.3 * rng.standard_normal((3, 3)))
        (Ri, pi), (_, pj) = poses[k - clones], poses[k]
        displacement[k] = scekf_numpy.yaw_matrix(Ri).T @ (pj - pi) + root @ rng.standard_normal(3)
        covariance[k] = root @ root.T
        if k in outliers:
            displacement[k] += 4.0
        if k in nan_rows:
            displacement[k, rng.integers(3)] = np.nan
    gyro = gyro + bg + 1e-3 * rng.standard_normal(gyro.shape)
    accel = accel + ba + 1e-2 * rng.standard_normal(gyro.shape)
    return start, gyro, accel, displacement, covariance
