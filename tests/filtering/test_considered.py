"""Errors that are considered and not estimated: their sensitivity against filters that have them,
and whether the covariance with them is that of the errors of simulated walks."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from gnio_jax.filtering.considered import disturbed
from tests.support.walks import errors, simulate

N, CLONES, STRIDES, DT, SIGMA, RUNS = 5, 4, 100, 0.02, 0.03, 24
CONFIG = filtering.FilterConfig(
    DT, N, CLONES, measurement_scale=2.0, gate_threshold=1e9, history="core"
)
NOISE = filtering.NoiseModel(2e-3, 2e-2, 1e-6, 1e-4, std_factor=(0.5, 0.5, 0.5**0.5))
START = filtering.InitialStd(gyro_bias=1e-4, velocity=0.1)
STD = filtering.ConsideredStd(gyro_bias=0.02, scale=0.1, heading=0.08, slope=0.05)


@functools.cache
def walks():
    """Runs as the filter assumes them, told with the σ that comes out after the scaling."""
    runs = simulate(7, RUNS, STRIDES, N, CLONES, DT, NOISE, START, SIGMA)
    root_scale = np.sqrt(2.0) * np.array(NOISE.std_factor)
    return runs, np.broadcast_to(SIGMA / root_scale, (RUNS, STRIDES, 3))


def run(c, more, rotation, velocity, position, gyro, accel, displacement, std):
    """A filter that is disturbed by `c` and then by `more`: its start and its history."""
    bias = c[:3] + more[:3]
    start = filtering.initial_state(CONFIG, rotation, velocity, position, bias, std=START)
    told = disturbed(disturbed(displacement, c), more), std
    _, history = filtering.repeat_odometry(start, gyro, accel, *told, CONFIG, NOISE)
    return start, history


def run_and_sensitivity(c, more, *given):
    start, history = run(c, more, *given)
    return history, filtering.sensitivity(start, *given[3:5], history, CONFIG, NOISE)


@functools.cache
def filtered():
    """All runs, each with errors drawn from `STD`: history and sensitivity, and the history as a
    function of more errors."""
    runs, std = walks()
    wide = np.array([*[STD.gyro_bias] * 3, STD.scale, STD.heading, STD.slope])
    drawn = wide * np.random.default_rng(1).standard_normal((RUNS, 6))
    given = (runs.rotation0, runs.velocity0, runs.position0, runs.gyro, runs.accel)
    both, alone = jax.jit(jax.vmap(run_and_sensitivity)), jax.jit(jax.vmap(run))
    given = (*given, runs.displacement, std)
    found = both(drawn, np.zeros((RUNS, 6)), *given)
    return found, lambda more: alone(drawn, more, *given)[1]


def core_error(estimate, other, r=0):
    """Of one run against another: θ, v, p, b_g, b_a."""
    turn = np.asarray(estimate.rotation[r]) @ np.swapaxes(np.asarray(other.rotation[r]), 1, 2)
    names = ("velocity", "position", "gyro_bias", "accel_bias")
    rest = [np.asarray(getattr(estimate, n)[r] - getattr(other, n)[r]) for n in names]
    return np.concatenate([Rotation.from_matrix(turn).as_rotvec(), *rest], axis=1)


def test_the_sensitivity_is_the_change_of_the_filter():
    (_, found), run_with = filtered()
    found = np.asarray(found)
    for entry, step in enumerate([1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4]):
        c = np.zeros((RUNS, 6))
        c[:, entry] = step
        ahead, behind = (run_with(sign * c) for sign in (1.0, -1.0))
        wanted = core_error(ahead, behind) / (2 * step)
        size = np.abs(wanted).max(axis=0)
        assert size[[6, 7, 8]].max() > 1e-2, entry
        np.testing.assert_allclose(
            found[0, :, :, entry] / (size + 1e-6), wanted / (size + 1e-6), atol=1e-5
        )


def test_a_gradient_that_is_cut_leaves_the_sensitivity_whole():
    runs, std = walks()
    pose = runs.rotation0[0], runs.velocity0[0], runs.position0[0]
    state = filtering.initial_state(CONFIG, *pose, std=START)
    signals = runs.gyro[0, : 20 * N], runs.accel[0, : 20 * N]
    told = runs.displacement[0, :20], std[0, :20]
    cut = dataclasses.replace(CONFIG, truncate_every=5)

    @jax.jit
    def sensitivities(state):
        _, history = filtering.repeat_odometry(state, *signals, *told, CONFIG, NOISE)
        sensitivity = functools.partial(filtering.sensitivity, state, *signals, history)
        return sensitivity(CONFIG, NOISE), sensitivity(cut, NOISE)

    whole, found = sensitivities(state)
    assert np.abs(whole).max() > 0
    np.testing.assert_array_equal(found, whole)


def test_the_covariance_with_them_is_that_of_the_errors():
    runs, _ = walks()
    (history, found), _ = filtered()
    added = jax.jit(jax.vmap(lambda s: filtering.considered_covariance(s, STD)))(found)

    def nees(covariance):
        error = errors(runs, history)[:, CLONES:, 6:9]
        chosen = np.asarray(covariance)[:, CLONES:, 6:9, 6:9]
        squares = np.einsum("rki,rkij,rkj->rk", error, np.linalg.inv(chosen), error)
        return squares[:, ::10].mean() / 3

    assert nees(history.covariance) > 5
    assert nees(history.covariance + added) == pytest.approx(1, abs=0.35)


def test_displacements_are_disturbed_as_they_are_said_to_be():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((5, 3))
    u[2], u[3, :2] = np.nan, 0.0
    c = np.array([9.0, 9.0, 9.0, 0.2, -0.3, 0.1])
    wanted = np.exp(0.2) * Rotation.from_euler("z", -0.3).apply(np.nan_to_num(u))
    wanted[:, 2] += 0.1 * np.hypot(u[:, 0], u[:, 1])
    np.testing.assert_allclose(disturbed(u, c), np.where(np.isnan(u), np.nan, wanted), atol=2e-7)
    slope = jax.jit(jax.jacfwd(lambda c: disturbed(u, c)))(c)
    assert np.isfinite(np.asarray(slope)[[0, 1, 3, 4]]).all()


def test_nothing_considered_adds_nothing():
    ones = np.ones((2, 15, 6))
    assert not np.any(filtering.considered_covariance(ones, filtering.ConsideredStd()))
    only = filtering.considered_covariance(ones, filtering.ConsideredStd(slope=2.0))
    np.testing.assert_array_equal(only, np.full((2, 15, 15), 4.0))
