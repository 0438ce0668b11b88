"""One simulated hour at 200 Hz: float32 stays positive definite and beside float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from tests.support.compiling import as_usual, optimised

N, CLONES, DT, SIGMA = 10, 20, 1 / 200, 0.05
MEASUREMENTS = 72_000
# What is claimed rests on the rounding of float32; float64 is what it is compared with.
FILTER = {
    np.float64: optimised(filtering.run_filter, static_argnums=5),
    np.float32: as_usual(filtering.run_filter, static_argnums=5),
}


def hour():
    """A person walking and turning with a swinging phone, sensors with the filter's noise."""
    rng = np.random.default_rng(0)
    t = np.arange(MEASUREMENTS * N + 1) * DT
    yaw = 0.5 * np.sin(2 * np.pi * t / 37) + 0.05 * t
    pitch, roll = 0.2 * np.sin(2 * np.pi * t / 3.1), 0.3 + 0.15 * np.sin(2 * np.pi * t / 2.3)
    attitude = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], 1))
    speed = 1.2 + 0.3 * np.sin(2 * np.pi * t / 53)
    velocity = np.stack(
        [speed * np.cos(yaw), speed * np.sin(yaw), 0.1 * np.sin(2 * np.pi * 1.8 * t)], 1
    )
    position = np.concatenate(
        [np.zeros((1, 3)), np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * DT, 0)]
    )
    back, forth = attitude[:-1].inv(), attitude[1:]
    noise = filtering.NoiseModel()
    gyro = (back * forth).as_rotvec() / DT + 1e-4 * np.array([1, -1, 0.5])
    accel = back.apply((velocity[1:] - velocity[:-1]) / DT + [0, 0, 9.81]) + 0.02 * np.array(
        [1, -1, 0.5]
    )
    gyro += noise.gyro_density / np.sqrt(DT) * rng.standard_normal(gyro.shape)
    accel += noise.accel_density / np.sqrt(DT) * rng.standard_normal(accel.shape)
    ends = np.arange(1, MEASUREMENTS + 1) * N
    displacement = np.full((MEASUREMENTS, 3), np.nan)
    start = ends[CLONES:] - CLONES * N
    displacement[CLONES:] = (
        Rotation.from_euler("z", yaw[start][:, None])
        .inv()
        .apply(position[ends[CLONES:]] - position[start])
    )
    displacement += SIGMA * rng.standard_normal(displacement.shape)
    return attitude[0].as_matrix(), velocity[0], gyro, accel, displacement, position[ends]


@pytest.mark.slow
def test_float32_holds_for_an_hour():
    rotation, velocity, gyro, accel, displacement, truth = hour()
    found = {}
    for dtype in (np.float64, np.float32):
        config = filtering.FilterConfig(
            DT, N, CLONES, history="core", allow_float32=dtype == np.float32
        )
        given = [jnp.asarray(x, dtype) for x in (rotation, velocity, np.zeros(3))]
        spread = jnp.tile(jnp.asarray(SIGMA**2 * np.eye(3), dtype)[None], (len(truth), 1, 1))
        signals = [jnp.asarray(x, dtype) for x in (gyro, accel, displacement)]
        final, history = FILTER[dtype](
            filtering.initial_state(config, *given),
            *signals,
            spread,
            config,
            filtering.NoiseModel(),
        )
        history = jax.tree.map(np.asarray, history)
        assert history.position.dtype == dtype and (history.healthy == 1).all()
        found[dtype] = (history, np.sqrt(((history.position - truth) ** 2).sum(1).mean()))
        state = jax.tree.map(np.asarray, final)
        assert np.abs(state.rotation @ state.rotation.T - np.eye(3)).max() < 1e-6
        np.testing.assert_array_equal(state.core_covariance, state.core_covariance.T)

    (double, ate), (single, single_ate) = found[np.float64], found[np.float32]
    assert ate > 1  # a variance of the position that has grown is what breaks the plain form
    assert np.sqrt(double.covariance_diagonal[-1, 6:8]).max() > 2
    assert abs(single_ate / ate - 1) < 0.05
    assert np.abs(np.sqrt(single.covariance_diagonal / double.covariance_diagonal) - 1).max() < 0.05
    for spread in single.covariance[::500].astype(np.float64):
        sigma = np.sqrt(spread.diagonal())
        assert np.linalg.eigvalsh(spread / np.outer(sigma, sigma))[0] > 0
    np.testing.assert_array_equal(single.accepted, double.accepted)
