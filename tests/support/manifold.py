"""Poses with their biases, x = (R, v, p, b_g, b_a), and small changes of them. They may have any
axes in front, those of differences among them."""

import numpy as np
from scipy.spatial.transform import Rotation

from tests.support import scekf_numpy


def rotated(rotvec):
    return Rotation.from_rotvec(rotvec.reshape(-1, 3)).as_matrix().reshape(*rotvec.shape, 3)


def plus(x, delta):
    """x and δ (…, 15): exp(δθ) R, the rest adds."""
    theta, *increments = np.split(delta, 5, axis=-1)
    return rotated(theta) @ x[0], *[part + d for part, d in zip(x[1:], increments, strict=True)]


def minus(x, y):
    turn = x[0] @ np.swapaxes(y[0], -1, -2)
    theta = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(turn.shape[:-1])
    return np.concatenate([theta, *[a - b for a, b in zip(x[1:], y[1:], strict=True)]], axis=-1)


def integrate(x, gyro, accel, dt, disturbance=None):
    """x over some samples; disturbance (…, samples, 12) of the readings and of the steps of the
    biases."""
    R, v, p, bg, ba = x
    none = np.zeros((len(gyro), 12)) if disturbance is None else disturbance
    for j in range(len(gyro)):
        w, a, wg, wa = np.split(none[..., j, :], 4, axis=-1)
        dv = (R @ (accel[j] - a - ba)[..., None])[..., 0] * dt
        p = p + v * dt + 0.5 * dv * dt + 0.5 * scekf_numpy.G * dt**2
        v, R = v + dv + scekf_numpy.G * dt, R @ rotated((gyro[j] - w - bg) * dt)
        bg, ba = bg + wg, ba + wa
    return R, v, p, bg, ba


def differences(function, size, step=1e-6):
    """Central ones of a function of (…, size), for all columns at once."""
    return (function(step * np.eye(size)) - function(-step * np.eye(size))).T / (2 * step)
