"""Propagation and update against central differences of an independent mean; safe branches."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from gnio_jax.filtering.displacement import scaled_displacement
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.propagation import integrate as integrate_samples
from gnio_jax.filtering.update import Step
from tests.support.comparing import assert_close_in_size
from tests.support.compiling import quick
from tests.support.manifold import differences, integrate, minus, plus

CONFIG = filtering.FilterConfig(0.01, 6, 2)
POSE = (
    Rotation.from_euler("xyz", [0.4, -0.7, 2.5]).as_matrix(),
    np.array([1.0, 0.2, -0.3]),
    np.array([3.0, -2.0, 0.5]),
    np.array([0.02, -0.01, 0.03]),
    np.array([0.1, -0.2, 0.05]),
)


def test_interval_against_differences_of_the_mean():
    """Φ by differences in the state at the start, Q by differences in every sample's noise and
    every step of the biases."""
    rng = np.random.default_rng(0)
    # Long steps and fast turns, so that J_r is far from the identity.
    n, dt = CONFIG.samples_per_clone, 0.05
    gyro, accel = 8 * rng.standard_normal((n, 3)), 10 * rng.standard_normal((n, 3))
    noise = filtering.NoiseModel(0.03, 0.2, 0.04, 0.5)
    state = filtering.initial_state(filtering.Filter(CONFIG), *POSE)
    motion = jax.jit(integrate_samples, static_argnames="dt")(
        state.mean, Imu(jnp.asarray(gyro), jnp.asarray(accel), None), noise, dt=dt
    )

    end = integrate(POSE, gyro, accel, dt)
    np.testing.assert_allclose(
        minus((motion.rotation, motion.velocity, motion.position, *POSE[3:]), end), 0, atol=1e-13
    )
    transition = differences(
        lambda d: minus(integrate(plus(POSE, d), gyro, accel, dt), end), 15, 1e-5
    )
    np.testing.assert_allclose(motion.transition, transition[:9], atol=2e-8)
    np.testing.assert_array_equal(transition[9:].round(9), np.eye(15)[9:])  # biases are constant

    reach = differences(
        lambda w: minus(integrate(POSE, gyro, accel, dt, w.reshape(-1, n, 12)), end), 12 * n, 1e-5
    )
    root = np.sqrt(dt)
    spread = np.tile(np.repeat([0.03 / root, 0.2 / root, 0.04 * root, 0.5 * root], 3), n)
    expected = (reach * spread**2) @ reach.T
    assert_close_in_size(motion.noise, expected, 1e-8)
    np.testing.assert_allclose(motion.noise, motion.noise.T, atol=1e-15)


@functools.partial(quick, static_argnums=3)
@functools.partial(jax.grad, argnums=(0, 1, 2), allow_int=True, has_aux=True)
def update_gradient(state, displacement, covariance, frame):
    noise, no_imu = filtering.NoiseModel(), Imu(np.zeros((1, 3)), np.zeros((1, 3)), None)
    measurement = scaled_displacement(displacement, covariance, noise, frame)
    new, outcome, _ = measurement.update(state, Step(no_imu, 2, 0, CONFIG, noise))
    floating = [x for x in jax.tree.leaves((new, outcome)) if jnp.issubdtype(x.dtype, jnp.floating)]
    felt = (jnp.sum(x * (1 + jnp.arange(x.size).reshape(x.shape))) for x in floating)
    return sum(felt), (new, outcome)


@pytest.mark.parametrize(
    "frame, pitch, distance, accepted",
    [
        ("given", np.pi / 2, 1.0, False),
        ("given", np.pi / 2 - 0.9e-5, 1.0, False),  # gimbal lock begins at 1e-5
        ("given", np.pi / 2 - 1.1e-5, 1.0, True),
        ("own", np.pi / 2, 1.0, True),
        ("given", 0.0, 0.0, True),
    ],
    ids=["gimbal lock", "almost", "close by", "own frame, never locked", "coincident clones"],
)
def test_update_has_finite_derivatives_everywhere(frame, pitch, distance, accepted):
    rotation = Rotation.from_euler("y", pitch).as_matrix()
    state = filtering.initial_state(
        filtering.Filter(CONFIG), rotation, np.zeros(3), np.zeros(3)
    )._replace(
        clone_rotation=np.tile(rotation, (3, 1, 1)),
        clone_offset=np.array([[-distance, 0, 0], [0, 0, 0], [0, 0, 0]]),
        clone_covariance=0.1 * np.eye(18),
        step=jnp.int32(5),
        gate=filtering.GateState(jnp.bool_(True), jnp.int32(25), jnp.int32(0)),
    )
    inputs = state, np.array([distance + 0.1, 0, 0]), 0.01 * np.eye(3)
    gradients, (new, outcome) = update_gradient(*inputs, frame)
    floats = [leaf for leaf in jax.tree.leaves(gradients) if leaf.dtype == jnp.float64]
    assert len(floats) == 18 and all(np.isfinite(leaf).all() for leaf in floats)
    assert bool(outcome.accepted) == accepted and outcome.present
    assert (new.clone_offset != state.clone_offset).any() == accepted
