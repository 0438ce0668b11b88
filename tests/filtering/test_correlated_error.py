"""Temporally correlated errors of the windows: against a plain NumPy filter and simulated walks,
and through smoother and tracker."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering import CorrelatedError
from gnio_jax.filtering.propagation import correlation_decay
from gnio_jax.filtering.state import CORRELATED
from gnio_jax.types import Prediction
from tests.support import scekf_numpy
from tests.support.compiling import optimised, quick
from tests.support.random_walk import random_walk
from tests.support.walks import errors, simulate

N, CLONES, INTERVALS, DT = 4, 4, 40, 0.02
CONFIG = filtering.FilterConfig(DT, N, CLONES, convergence_seconds=0.6, history="core")
ERRORS = CorrelatedError(0.8, 0.3)
NOISE = filtering.NoiseModel(2e-3, 2e-2, 1e-6, 1e-4, measurement_scale=2.0, correlation=ERRORS)


@functools.cache
def walk():
    return random_walk(
        3, n=N, clones=CLONES, intervals=INTERVALS, dt=DT, nan_rows=[12], outliers=[25]
    )


@functools.cache
def program(config):
    return quick(functools.partial(filtering.run_filter, config=config))


@functools.cache
def filtered(config=CONFIG, errors=ERRORS):
    start, gyro, accel, displacement, spread = walk()
    state = filtering.initial_state(config, *start)
    given = (state, gyro, accel, displacement, spread)
    return program(config)(*given, noise=NOISE._replace(correlation=errors))


@pytest.mark.parametrize("fail_scale", [0.0, 10.0])
def test_as_a_plain_filter_has_them(fail_scale):
    config = dataclasses.replace(CONFIG, mahalanobis_fail_scale=fail_scale)
    final, history = filtered(config)
    start, gyro, accel, displacement, spread = walk()
    state = filtering.initial_state(config, *start)
    wanted = scekf_numpy.run_from(state, NOISE, config, gyro, accel, displacement, spread)
    assert np.nansum(wanted["accepted"] == 0) == (fail_scale == 0)  # the outlier
    assert np.abs(wanted["correlated"][-1]).min() > 1e-3
    for name in ("accepted", "gate_passed"):
        np.testing.assert_array_equal(getattr(history, name), wanted[name])
    for name in ("rotation", "velocity", "position", "gyro_bias", "accel_bias", "innovation"):
        np.testing.assert_allclose(getattr(history, name), wanted[name], atol=1e-9, err_msg=name)
    np.testing.assert_allclose(final.correlated, wanted["correlated"][-1], atol=1e-9)
    np.testing.assert_allclose(history.nis, wanted["nis"], rtol=1e-7)
    np.testing.assert_allclose(history.covariance, wanted["covariance"], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(
        final.core_covariance[CORRELATED, CORRELATED],
        wanted["correlated_covariance"][-1],
        rtol=1e-7,
        atol=1e-12,
    )


def test_without_any_size_they_change_nothing():
    without, with_none = filtered(errors=None)
    final, with_zero = filtered(errors=CorrelatedError(0.0, 0.3))
    for name in with_none._fields:
        if name not in ("others", "diagnostics"):
            np.testing.assert_allclose(
                getattr(with_zero, name), getattr(with_none, name), atol=1e-12, err_msg=name
            )
    assert without.correlated.shape == (0,) and final.correlated.shape == (3,)


def test_they_are_as_large_at_all_times():
    """Their variance is 1 at the start, and stays so without measurements."""
    decay = correlation_decay(ERRORS, 0.7, np.dtype(float))
    np.testing.assert_allclose(decay, np.exp(-0.7 / np.array([0.3] * 3)), rtol=1e-14)
    start, gyro, accel, displacement, spread = walk()
    given = gyro, accel, np.full_like(displacement, np.nan), spread
    final, _ = program(CONFIG)(filtering.initial_state(CONFIG, *start), *given, noise=NOISE)
    np.testing.assert_allclose(final.core_covariance[CORRELATED, CORRELATED], np.eye(3), rtol=1e-12)


RUNS, SIGMA, LONG = 48, 0.05, 500
OF_WALK = CorrelatedError(0.9, 0.5)
MODEL = filtering.NoiseModel(5e-4, 5e-3, 1e-6, 2e-5, measurement_scale=1.0, correlation=OF_WALK)
STD = filtering.InitialStd(0.02, 0.01, 0.3, 1e-3, 1e-3, 0.02)


@functools.cache
def simulated():
    """Walks whose displacements have errors as the model has them, drawn in NumPy."""
    runs = simulate(2, RUNS, LONG, 10, 10, 0.01, MODEL, STD, 0.0)
    rng, (share, seconds) = np.random.default_rng(3), OF_WALK
    decay = np.exp(-0.1 / seconds)
    state, seen = rng.normal(size=(RUNS, 3)), np.array(runs.displacement)
    for k in range(LONG):
        state = decay * state + np.sqrt(1 - decay**2) * rng.normal(size=(RUNS, 3))
        white = np.sqrt(1 - share**2) * rng.normal(size=(RUNS, 3))
        seen[:, k] += SIGMA * (share * state + white)
    return runs._replace(displacement=seen)


@functools.cache
def batched():
    """(noise, start and signals of each run) -> their histories."""
    config = filtering.FilterConfig(0.01, 10, 10, gate_threshold=1e9, history="core")
    spread = np.tile(SIGMA**2 * np.eye(3), (LONG, 1, 1))

    def run(noise, rotation, velocity, position, *signals):
        state = filtering.initial_state(config, rotation, velocity, position, std=STD)
        return filtering.run_filter(state, *signals, spread, config, noise)[1]

    return optimised(jax.vmap(run, in_axes=(None, *6 * [0])))


@functools.cache
def estimated(errors_=OF_WALK):
    runs = simulated()
    history = batched()(MODEL._replace(correlation=errors_), *runs[:6])
    error, covariance = errors(runs, history), np.asarray(history.covariance)
    return error[:, 100:], covariance[:, 100:], np.asarray(history.nis)[:, 100:]


def normalised(error, covariance):
    squared = np.einsum("...i,...i", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    return squared.mean() / error.shape[-1]


def test_the_filter_is_as_certain_as_it_may_be():
    error, covariance, nis = estimated()
    assert 0.9 < nis.mean() / 3 < 1.1
    for part in (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)):
        assert 0.7 < normalised(error[..., part], covariance[..., part, part]) < 1.4, part


def test_taken_for_white_they_make_it_too_certain():
    """Without any size they change nothing, as above: one program for both filters."""
    error, covariance, _ = estimated(OF_WALK._replace(share=0.0))
    position = slice(6, 9)
    assert normalised(error[..., position], covariance[..., position, position]) > 4
    with_them, _, _ = estimated()
    squares = [np.mean(e[:, -1, position] ** 2) for e in (with_them, error)]
    assert squares[0] < squares[1]


@pytest.mark.slow
def test_the_smoother_is_consistent_with_them():
    config = filtering.FilterConfig(0.01, 10, 10, gate_threshold=1e9, history="core")
    runs, spread = simulated(), np.tile(SIGMA**2 * np.eye(3), (LONG, 1, 1))

    @optimised
    @jax.vmap
    def run(rotation, velocity, position, *signals):
        state = filtering.initial_state(config, rotation, velocity, position, std=STD)
        return filtering.smooth(state, *signals, spread, config, MODEL)

    smoothed = run(*runs[:6])
    error, covariance = errors(runs, smoothed), np.asarray(smoothed.covariance)
    middle = slice(100, 400)
    for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
        found = normalised(error[:, middle, part], covariance[:, middle, part, part])
        assert 0.7 < found < 1.4, part
    # at the end both are the same
    filtered, of_filter, _ = estimated()
    np.testing.assert_allclose(error[:, -1, :9], filtered[:, -1, :9], atol=1e-8)
    np.testing.assert_allclose(covariance[:, -1], of_filter[:, -1], rtol=1e-6, atol=1e-12)


def predict(windows):
    pooled = jnp.mean(windows, axis=1) @ jnp.full((6, 3), 0.01, jnp.float32)
    return Prediction(pooled, -2.0 + 0.1 * pooled)


def test_the_tracker_has_them_too():
    start, gyro, accel, _, _ = walk()
    state = filtering.initial_state(CONFIG, *start)
    tracker = filtering.Tracker(predict, CONFIG, NOISE, state)
    poses = [
        tracker.push(DT * k, *sample) for k, sample in enumerate(zip(gyro, accel, strict=True))
    ]
    found = [pose for pose in poses if pose is not None]
    run = quick(lambda state: filtering.run_odometry(predict, state, gyro, accel, CONFIG, NOISE))
    _, history = run(state)
    np.testing.assert_allclose(
        [pose.position for pose in found], history.position[: len(found)], atol=1e-9
    )


def evidence(errors=ERRORS, factor=(1.0, 1.0, 1.0), spread=None):
    """The log likelihood of the walk, from the program of `filtered`."""
    start, *signals, told = walk()
    state, noise = filtering.initial_state(CONFIG, *start), NOISE._replace(correlation=errors)
    given = state, *signals, told if spread is None else spread
    _, history = program(CONFIG)(*given, noise=noise._replace(std_factor=tuple(factor)))
    return np.nansum(history.log_likelihood)


@functools.cache
def gradient():
    """(errors, factors of the axes) -> derivatives of the log likelihood by both."""
    start, *signals = walk()

    def of(errors, factor):
        noise = NOISE._replace(correlation=errors, std_factor=tuple(factor))
        state = filtering.initial_state(CONFIG, *start)
        _, history = filtering.run_filter(state, *signals, CONFIG, noise)
        return jnp.nansum(history.log_likelihood)

    return quick(jax.grad(of, (0, 1)))


def test_their_derivatives_are_those_of_differences_and_finite_at_zero():
    for errors_ in (ERRORS, ERRORS._replace(share=0.0)):
        found, _ = gradient()(errors_, np.ones(3))
        assert all(np.isfinite(np.asarray(found)))
        for name in ("share", "seconds"):
            step = 1e-5
            value = getattr(errors_, name)
            ahead, behind = (
                evidence(errors_._replace(**{name: value + change})) for change in (step, -step)
            )
            np.testing.assert_allclose(
                getattr(found, name), (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-4
            )


def test_the_factor_of_each_axis_scales_the_covariance():
    """Its derivative is finite where there is no measurement, too."""
    *_, spread = walk()
    factor = np.array([1.5, 0.7, 2.0])
    scaled = spread * factor[:, None] * factor
    np.testing.assert_allclose(
        evidence(factor=factor.tolist()), evidence(spread=scaled), rtol=1e-12
    )
    _, found = gradient()(ERRORS, factor)
    step = 1e-6 * np.eye(3)[1]
    ahead, behind = (evidence(factor=(factor + sign * step).tolist()) for sign in (1, -1))
    np.testing.assert_allclose(found[1], (ahead - behind) / 2e-6, rtol=1e-5)
    assert np.isfinite(found).all()


@pytest.mark.parametrize(
    ("field", "value"), [("share", 1.0), ("share", -0.1), ("seconds", 0.0), ("seconds", -1.0)]
)
def test_sizes_that_make_no_sense_are_refused(field, value):
    start, *signals = walk()
    noise = NOISE._replace(correlation=ERRORS._replace(**{field: value}))
    with pytest.raises(ValueError, match=rf"^noise\.correlation\.{field}: must be"):
        filtering.run_filter(filtering.initial_state(CONFIG, *start), *signals, CONFIG, noise)


def test_a_state_that_has_them_goes_on_with_them():
    start, gyro, accel, displacement, spread = walk()
    config = dataclasses.replace(CONFIG, samples_per_clone=N)
    state, rows = filtering.initial_state(config, *start), []
    for part in (slice(0, 15), slice(15, INTERVALS)):
        samples = slice(part.start * N, part.stop * N)
        given = (state, gyro[samples], accel[samples], displacement[part], spread[part])
        state, history = program(config)(*given, noise=NOISE)
        rows.append(history.position)
    np.testing.assert_allclose(np.concatenate(rows), filtered()[1].position, atol=1e-9)
    with pytest.raises(ValueError, match=r"state\.correlated: "):
        given = (state, gyro, accel, displacement, spread)
        filtering.run_filter(*given, config, NOISE._replace(correlation=None))
