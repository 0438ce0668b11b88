"""Starts without a reference."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering, geometry
from gnio_jax.filtering.start import rest_at_start

N, CLONES, DT = 5, 4, 0.02
CONFIG = filtering.FilterConfig(DT, N, CLONES)

level, slope_of_level = jax.jit(geometry.level), jax.jit(jax.jacrev(geometry.level))


def test_the_bias_of_a_raw_gyro_is_uncertain_where_it_is_level():
    """Also for a matrix that is a rotation up to the rounding of text files."""
    rotation = (1 + 4e-4) * Rotation.from_euler("ZYX", [0.3, 0.7, 0.4]).as_matrix()
    state = filtering.initial_state(
        filtering.Filter(CONFIG), rotation, np.zeros(3), np.zeros(3), level_gyro_bias=0.05
    )
    covariance = state.core_covariance[9:12, 9:12]
    std = np.sqrt(np.linalg.eigvalsh(covariance))
    np.testing.assert_allclose(std, [1e-4, 0.05, 0.05], rtol=1e-6)
    up = rotation[2] / np.linalg.norm(rotation[2])
    np.testing.assert_allclose(covariance @ up, 1e-8 * up, atol=1e-15)


@pytest.mark.parametrize("pitch", [0.7, -np.pi / 2])
def test_level_state(pitch):
    """Upright, at an uncertain tilt by what the second's halves differ by and by 0.02 m/s²; less
    certain where it is shaken."""
    rng = np.random.default_rng(1)
    R = Rotation.from_euler("ZYX", [0.0, pitch, 0.4]).as_matrix()
    accel = R.T @ [0, 0, 9.81] + 0.01 * rng.standard_normal((50, 3))
    state = filtering.level_state(
        filtering.Filter(CONFIG), 0.01 * rng.standard_normal((50, 3)), accel
    )
    up = accel.mean(0) / np.linalg.norm(accel.mean(0))
    np.testing.assert_allclose(state.rotation @ up, [0, 0, 1], atol=1e-12)
    if abs(pitch) < 1:
        np.testing.assert_allclose(state.rotation, R, atol=2e-3)
    np.testing.assert_allclose(state.rotation @ state.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(state.rotation) > 0
    sigma = np.sqrt(np.diag(state.core_covariance))
    tilt = np.sqrt(0.02**2 + accel.var(0).sum() / 2.0) / 9.81  # one second, two half seconds
    np.testing.assert_allclose(sigma[0], tilt, rtol=1e-9)
    np.testing.assert_allclose(sigma[3:6], 0.05)
    shaken = accel + np.sin(np.arange(50))[:, None]
    less = np.sqrt(
        np.diag(
            filtering.level_state(
                filtering.Filter(CONFIG), np.zeros((50, 3)), shaken
            ).core_covariance
        )
    )
    assert less[3] == 1.0 and less[0] > sigma[0]


@pytest.mark.parametrize("rate", [[0.3, -0.8, 0.5], [0.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
def test_level_state_of_a_phone_that_a_hand_turns(rate):
    """The attitude is that of the first sample, not of the second's middle, and not rough."""
    first = Rotation.from_euler("ZYX", [0.0, 0.4, -1.1])
    turned = first * Rotation.from_rotvec(np.outer(np.arange(50) * CONFIG.dt, rate))
    accel = turned.inv().apply([0, 0, 9.81])
    state = filtering.level_state(filtering.Filter(CONFIG), np.tile(rate, (50, 1)), accel)
    np.testing.assert_allclose(state.rotation, first.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(np.sqrt(state.core_covariance[0, 0]), 0.02 / 9.81, rtol=1e-6)


def test_small_turns_about_every_axis_are_no_rest():
    """Each rate is below the bound of rest, but not their sum in quadrature. The rates differ from
    sample to sample, and the attitude of a sample follows from those before it."""
    time = np.arange(50) * DT
    phases = 2 * np.pi * (time[:, None] + [0.0, 0.3, 0.6])
    gyro = 0.8 * CONFIG.rest_gyro * np.sqrt(2.0) * np.sin(phases)
    first = Rotation.from_euler("ZYX", [0.0, 0.4, -1.1])
    attitudes = [first]
    for rate in gyro[:-1]:
        attitudes.append(attitudes[-1] * Rotation.from_rotvec(rate * DT))
    accel = np.stack([attitude.inv().apply([0, 0, 9.81]) for attitude in attitudes])
    assert accel.var(axis=0).sum() < CONFIG.rest_accel**2
    assert (gyro.std(axis=0) < CONFIG.rest_gyro).all()
    state = filtering.level_state(filtering.Filter(CONFIG), gyro, accel)
    np.testing.assert_allclose(state.rotation, first.as_matrix(), atol=1e-9)
    # The mean alone would be off by:
    assert np.linalg.norm(first.apply(accel.mean(axis=0))[:2]) / 9.81 > 1e-3


def test_a_second_of_which_most_is_missing_is_no_rest():
    """Half of it is enough."""
    gyro, accel = np.tile([0.01, -0.02, 0.03], (100, 1)), np.tile([0, 0, 9.81], (100, 1))
    for present, seconds in ((24, 1.0), (25, 2.0)):
        broken = gyro.copy()
        broken[50 + present :] = np.nan
        standstill = rest_at_start(broken, accel, DT)
        assert standstill.seconds == seconds
        np.testing.assert_allclose(standstill.gyro_bias, gyro[0], rtol=1e-12)


def test_level_state_says_how_far_the_velocity_can_be_from_zero():
    """1.5 s times the spread, between a table's and a walker's, with a slope everywhere."""

    shake = np.outer(np.sin(np.arange(50)), [1.0, 0, 0])

    def velocity_std(amplitude):
        shaken = np.tile([0, 0, 9.81], (50, 1)) + amplitude * shake
        state = filtering.level_state(filtering.Filter(CONFIG), np.zeros((50, 3)), shaken)
        return jnp.sqrt(state.core_covariance[3, 3])

    spread = np.sin(np.arange(50)).std()
    for amplitude, expected_std in ((0.0, 0.05), (0.4, 1.5 * 0.4 * spread), (5.0, 1.0)):
        np.testing.assert_allclose(velocity_std(amplitude), expected_std, rtol=1e-9)
        slope = 0 if amplitude != 0.4 else 1.5 * spread
        np.testing.assert_allclose(jax.grad(velocity_std)(amplitude), slope, rtol=1e-6)


@pytest.mark.parametrize("samples, gyro_std, accel_std", [(49, 0, 0), (50, 0.02, 0), (50, 0, 0.2)])
def test_level_state_takes_the_bias_of_a_second_on_a_table(samples, gyro_std, accel_std):
    rng, bias = np.random.default_rng(3), np.array([0.02, -0.01, 0.03])
    noise = rng.standard_normal((2, 50, 3))
    gyro, accel = bias + 0.002 * noise[0], [0, 0, 9.81] + 0.02 * noise[1]
    gyro_bias = filtering.level_state(filtering.Filter(CONFIG), gyro, accel).gyro_bias
    np.testing.assert_allclose(gyro_bias, gyro.mean(0), rtol=1e-12)
    np.testing.assert_allclose(
        gyro_bias, rest_at_start(gyro, accel, CONFIG.dt).gyro_bias, rtol=1e-12
    )
    # What does not turn is not turned.
    still, biased = (
        filtering.level_state(filtering.Filter(CONFIG), x * gyro, accel).rotation for x in (0, 1)
    )
    np.testing.assert_array_equal(biased, still)
    shaken = gyro + gyro_std * noise[0], accel + accel_std * noise[1]
    gyro_bias = filtering.level_state(
        filtering.Filter(CONFIG), *(signal[:samples] for signal in shaken)
    ).gyro_bias
    np.testing.assert_array_equal(gyro_bias, 0)


def test_level_state_refuses_accelerations_without_gravity():
    with pytest.raises(ValueError, match=r"^accel: shows no gravity, its mean is 1 m/s²"):
        filtering.level_state(
            filtering.Filter(CONFIG), np.zeros((50, 3)), np.tile([0, 0, 1.0], (50, 1))
        )
    # Inside jit the values are not known, and the history says that the start is not healthy.
    start = jax.jit(functools.partial(filtering.level_state, filtering.Filter(CONFIG)))
    for force in (0.0, 1.0):
        assert np.isnan(start(np.zeros((50, 3)), np.tile([0, 0, force], (50, 1))).rotation).all()


def test_a_level_start_has_derivatives_where_nothing_shows_an_uncertain_tilt():
    """Without a bias of the accelerometer and without any spread of its samples."""

    def tilt_variance(bias_std, force):
        std = filtering.InitialStd(accel_bias=bias_std)
        ekf, accel = filtering.Filter(CONFIG, start=std), jnp.tile(force[None], (50, 1))
        return filtering.level_state(ekf, jnp.zeros((50, 3)), accel).core_covariance[0, 0]

    force = jnp.array([0.0, 0.0, 9.81])
    slopes = jax.grad(tilt_variance, (0, 1))(jnp.array(0.0), force)
    assert all(np.isfinite(slope).all() for slope in slopes)
    assert tilt_variance(0.0, force) < 1e-13


def test_level_is_a_rotation_with_derivatives():
    for up in ([0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0.3, -0.2, 0.9]):
        up = np.asarray(up, float)
        rotation = np.asarray(level(up))
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(rotation @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
        assert np.linalg.det(rotation) > 0
        if abs(up[0]) < 0.99:
            np.testing.assert_allclose(rotation[1, 0], 0, atol=1e-12)
            assert rotation[0, 0] > 0
        else:
            np.testing.assert_allclose(rotation[:, 1], [0, 1, 0], atol=1e-12)
        assert np.isfinite(slope_of_level(up)).all()
    np.testing.assert_array_equal(level(np.zeros(3)), np.eye(3))
    np.testing.assert_array_equal(slope_of_level(np.zeros(3)), 0)


def test_orthonormalize_is_the_nearest_rotation():
    rng = np.random.default_rng(2)
    R = Rotation.random(rng=rng).as_matrix() + 1e-5 * rng.standard_normal((3, 3))
    u, _, vt = np.linalg.svd(R)
    np.testing.assert_allclose(jax.jit(geometry.orthonormalize)(R), u @ vt, atol=1e-9)
