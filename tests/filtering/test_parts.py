"""Propagation and update against central differences of an independent mean; the doors; safe
branches."""

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
from tests.support import scekf_numpy
from tests.support.compiling import quick
from tests.support.manifold import differences, integrate, minus, plus
from tests.support.measured import NO_IMU, displacement_residual
from tests.support.whole_covariance import covariance

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
    state = filtering.initial_state(CONFIG, *POSE)
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
    np.testing.assert_allclose(motion.noise, expected, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(motion.noise, motion.noise.T, atol=1e-15)


@pytest.mark.parametrize(
    "angles", [(0.0, 0.0, 0.0), (0.3, 0.9, -2.0), (-2.0, -1.4, 3.1), (0.1, 1.5706, 1.0)]
)
def test_measurement_jacobian_against_differences(angles):
    Ri = Rotation.from_euler("xyz", angles).as_matrix()
    pi, pj, d = np.array([1.0, 2.0, 3.0]), np.array([2.5, 1.2, 3.3]), np.array([1.0, 0.3, 0.1])

    def residual(delta):
        R = Rotation.from_rotvec(delta[:3]).as_matrix() @ Ri
        return d - scekf_numpy.yaw_matrix(R).T @ (pj + delta[6:] - pi - delta[3:6])

    moved = jnp.asarray(pj - pi)
    found = displacement_residual(jnp.asarray(Ri), moved, jnp.asarray(d))
    np.testing.assert_allclose(found.innovation, residual(np.zeros(9)), atol=1e-12)
    assert bool(found.defined)
    step = 1e-7 if angles[1] > 1.5 else 1e-5
    expected = -np.stack([residual(step * e) - residual(-step * e) for e in np.eye(9)], 1) / (
        2 * step
    )
    np.testing.assert_allclose(
        found.jacobian, expected, rtol=1e-5, atol=1e-7 if angles[1] < 1.5 else 1e-2
    )


def test_gimbal_lock_begins_at_its_limit():
    for distance, defined in ((0.9e-5, False), (1.1e-5, True)):
        R = jnp.asarray(Rotation.from_euler("xyz", [0.2, np.pi / 2 - distance, 0.4]).as_matrix())
        found = displacement_residual(R, jnp.ones(3), jnp.ones(3))
        assert bool(found.defined) == defined


def at_singularity(kind):
    """A state with clones, and a measurement, at a point where a careless branch has no finite
    derivative."""
    rotation = (
        Rotation.from_euler("y", 90, degrees=True).as_matrix() if kind == "gimbal" else np.eye(3)
    )
    state = filtering.initial_state(CONFIG, rotation, np.zeros(3), np.zeros(3))
    apart = 0.0 if kind == "coincident clones" else 1.0
    state = state._replace(
        clone_rotation=jnp.tile(jnp.asarray(rotation)[None], (3, 1, 1)),
        step=jnp.int32(5),
        clone_offset=jnp.asarray([[-apart, 0, 0], [0, 0, 0], [0, 0, 0]]),
        gate=filtering.GateState(jnp.bool_(True), jnp.int32(25), jnp.int32(0)),
    )
    displacement = jnp.asarray(
        [np.nan, 0, 0]
        if kind == "missing"
        else [apart + (90.0 if kind == "rejected" else 0.1), 0, 0]
    )
    return state, displacement


@functools.partial(quick, static_argnums=3)
@functools.partial(jax.grad, argnums=(0, 1, 2), allow_int=True, has_aux=True)
def update_gradient(state, displacement, covariance, frame="given"):
    noise = filtering.NoiseModel()
    measurement = scaled_displacement(displacement, covariance, noise, frame)
    new, outcome, _ = measurement.update(state, Step(NO_IMU, 2, 0, CONFIG, noise))
    leaves = [
        leaf for leaf in jax.tree.leaves((new, outcome)) if jnp.issubdtype(leaf.dtype, jnp.floating)
    ]
    return sum(
        jnp.sum(leaf * (1 + jnp.arange(leaf.size).reshape(leaf.shape))) for leaf in leaves
    ), (new, outcome)


@pytest.mark.parametrize(
    "kind", ["plain", "gimbal", "missing", "rejected", "coincident clones", "no innovation"]
)
def test_update_has_finite_derivatives_everywhere(kind):
    state, displacement = at_singularity(kind)
    if kind == "no innovation":
        displacement = jnp.asarray([1.0, 0, 0])
    gradients, (new, outcome) = update_gradient(state, displacement, 0.01 * jnp.eye(3))
    floats = [leaf for leaf in jax.tree.leaves(gradients) if leaf.dtype == jnp.float64]
    assert len(floats) == 17 and all(np.isfinite(leaf).all() for leaf in floats)
    assert bool(outcome.accepted) == (kind in ("plain", "coincident clones", "no innovation"))
    assert bool(outcome.present) == (kind != "missing")
    if not outcome.present:
        np.testing.assert_array_equal(outcome.residual, 0)
    if not outcome.accepted:
        for name in state._fields[:12]:
            np.testing.assert_array_equal(getattr(new, name), getattr(state, name))


def test_in_its_own_frame_there_is_no_gimbal_lock():
    """On the nose the displacement is used as it is anywhere else, with finite derivatives."""
    for kind in ("gimbal", "plain"):
        state, displacement = at_singularity(kind)
        state = state._replace(clone_covariance=0.1 * jnp.eye(18))
        gradients, (new, outcome) = update_gradient(state, displacement, 0.01 * jnp.eye(3), "own")
        floats = [leaf for leaf in jax.tree.leaves(gradients) if leaf.dtype == jnp.float64]
        assert len(floats) == 17 and all(np.isfinite(leaf).all() for leaf in floats)
        assert bool(outcome.accepted) and outcome.weight == 1
        assert np.abs(gradients[1]).max() > 0 and (new.clone_offset != state.clone_offset).any()


def test_an_update_needs_both_clones():
    state, displacement = at_singularity("plain")
    state = state._replace(step=jnp.int32(2))
    _, (new, outcome) = update_gradient(state, displacement, 0.01 * jnp.eye(3))
    assert not outcome.present and not outcome.accepted
    np.testing.assert_array_equal(new.position, state.position)


def test_noise_densities():
    """White noise of σ per sample at dt has the density σ √dt; the defaults are TLIO's at 1 kHz."""
    found = filtering.NoiseModel.per_sample(1e-2, 10**-1.5, 1e-3)
    np.testing.assert_allclose(found[:2], filtering.NoiseModel()[:2], rtol=1e-3)
    state = filtering.initial_state(CONFIG, *POSE)
    gyro, accel = jnp.zeros((6, 3)), jnp.zeros((6, 3))
    sigmas = filtering.NoiseModel.per_sample(0.1, 0.2, 0.5)
    once = jax.jit(integrate_samples, static_argnames="dt")(
        state.mean, Imu(gyro[:1], accel[:1], None), sigmas, dt=0.5
    ).noise
    np.testing.assert_allclose(np.diag(once)[3:6], 0.2**2 * 0.5**2, rtol=1e-6)


def test_initial_state():
    state = filtering.initial_state(CONFIG, *POSE, std=filtering.InitialStd(*np.arange(1.0, 7.0)))
    core = np.asarray(covariance(state))[:15, :15]
    np.testing.assert_array_equal(
        np.diag(core), np.array([1, 1, 2, 3, 3, 3, 4, 4, 4, 5, 5, 5, 6, 6, 6.0]) ** 2
    )
    assert np.count_nonzero(core) == 15
    for found, wanted in zip((*state[:2], state.position, *state[3:5]), POSE, strict=True):
        np.testing.assert_array_equal(found, wanted)
    np.testing.assert_array_equal(
        filtering.initial_state(CONFIG, *POSE[:3], gyro_bias=0.5).gyro_bias, np.full(3, 0.5)
    )
    defaults = np.sqrt(np.diag(covariance(filtering.initial_state(CONFIG, *POSE))))[
        [0, 2, 3, 6, 9, 12]
    ]
    np.testing.assert_allclose(defaults, [np.pi / 180, np.pi / 1800, 1.0, 1e-3, 1e-4, 0.02])


def test_config_is_static():
    config = filtering.FilterConfig(
        np.array(0.01), np.array(6), np.int64(2), mahalanobis_fail_scale=0
    )
    assert config == CONFIG and hash(config) == hash(CONFIG) and config.window == 12
    assert (
        type(config.dt) is float
        and type(config.samples_per_clone) is int
        and type(config.mahalanobis_fail_scale) is float
    )
