"""One simulated hour at 200 Hz: float32 stays positive definite and beside float64."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from tests.support.compiling import as_usual, optimised

N, CLONES, DT, SIGMA = 10, 20, 1 / 200, 0.05
MEASUREMENTS = 72_000
# What is claimed rests on the rounding of float32; float64 is what it is compared with.
FILTER = {
    np.float64: optimised(filtering.run_filter),
    np.float32: as_usual(filtering.run_filter),
}


def hour():
    """A person walking and turning with a swinging phone, sensors with the filter's noise."""
    rng, wave = np.random.default_rng(0), lambda seconds: np.sin(2 * np.pi * t / seconds)
    t = np.arange(MEASUREMENTS * N + 1) * DT
    yaw, pitch, roll = 0.5 * wave(37) + 0.05 * t, 0.2 * wave(3.1), 0.3 + 0.15 * wave(2.3)
    attitude = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], 1))
    speed = 1.2 + 0.3 * wave(53)
    velocity = np.stack([speed * np.cos(yaw), speed * np.sin(yaw), 0.1 * wave(1 / 1.8)], 1)
    steps = np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * DT, 0)
    position, noise = np.concatenate([np.zeros((1, 3)), steps]), filtering.NoiseModel()
    bias, white = np.array([1, -1, 0.5]), rng.standard_normal((2, len(steps), 3)) / np.sqrt(DT)
    gyro = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / DT + 1e-4 * bias
    force = (velocity[1:] - velocity[:-1]) / DT + [0, 0, 9.81]
    accel = attitude[:-1].inv().apply(force) + 0.02 * bias
    signals = gyro + noise.gyro_density * white[0], accel + noise.accel_density * white[1]
    ends = np.arange(1, MEASUREMENTS + 1) * N
    displacement, start = np.full((MEASUREMENTS, 3), np.nan), ends[:-CLONES]
    turned = Rotation.from_euler("z", yaw[start][:, None]).inv()
    displacement[CLONES:] = turned.apply(position[ends[CLONES:]] - position[start])
    displacement += SIGMA * rng.standard_normal(displacement.shape)
    return attitude[0].as_matrix(), velocity[0], *signals, displacement, position[ends]


@pytest.mark.slow
def test_float32_holds_for_an_hour():
    rotation, velocity, *signals, truth = hour()
    spread = np.tile(SIGMA**2 * np.eye(3), (MEASUREMENTS, 1, 1))
    results = []
    for dtype in (np.float64, np.float32):
        single = dtype == np.float32
        config = filtering.FilterConfig(DT, N, CLONES, history="core", allow_float32=single)
        ekf = filtering.Filter(config)
        state = filtering.initial_state(ekf, *map(dtype, (rotation, velocity, np.zeros(3))))
        arguments = ekf, state, *map(dtype, (*signals, spread))
        state, history = jax.device_get(FILTER[dtype](*arguments))
        assert history.position.dtype == dtype and (history.healthy == 1).all()
        assert np.abs(state.rotation @ state.rotation.T - np.eye(3)).max() < 1e-6
        np.testing.assert_array_equal(state.core_covariance, state.core_covariance.T)
        results.append((history, np.sqrt(((history.position - truth) ** 2).sum(1).mean())))

    (double, ate), (single, single_ate) = results
    assert ate > 1  # a variance of the position that has grown is what breaks the plain form
    assert np.sqrt(double.covariance_diagonal[-1, 6:8]).max() > 2
    assert abs(single_ate / ate - 1) < 0.05
    assert np.abs(np.sqrt(single.covariance_diagonal / double.covariance_diagonal) - 1).max() < 0.05
    for spread in single.covariance[::500].astype(np.float64):
        sigma = np.sqrt(spread.diagonal())
        assert np.linalg.eigvalsh(spread / np.outer(sigma, sigma))[0] > 0
    np.testing.assert_array_equal(single.accepted, double.accepted)
