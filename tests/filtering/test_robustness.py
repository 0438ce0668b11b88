"""Any stream: holes, knocks, wrong units; and what the filter says of itself."""

import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gnio_jax import filtering
from tests.support.compiling import quick
from tests.support.random_walk import random_walk

DT = 0.02
ROWS = 60
PLAIN = filtering.FilterConfig(DT, 5, 4, convergence_seconds=1.0, rest_seconds=0.2)
CONFIGS = [PLAIN, dataclasses.replace(PLAIN, allow_float32=True)]
WALK = random_walk(21, n=5, clones=4, intervals=ROWS, dt=DT, bias=False)
FILTER = quick(filtering.run_filter)


def disturbed(config, gap, knock, size, leap, away, missing, units, still):
    """A run over the walk with a gap, a knock of `size` m/s² and displacements wrong by `away` m,
    each (first, how many); and its speeds.

    `missing`: the gap's windows are no measurements. `units` are factors on gyro, accel and
    displacement. The last `still` samples are at rest."""
    begin, gyro, accel, displacement, covariance = WALK
    gyro, accel, displacement = gyro.copy(), accel.copy(), displacement.copy()
    if still:
        gyro[-still:], accel[-still:] = 0.0, [0.0, 0.0, 9.81]
    valid = ~np.isin(np.arange(len(gyro)), range(gap[0], sum(gap)))
    accel[knock[0] : sum(knock)] += size
    displacement[leap[0] : sum(leap)] += [0.6 * away, -0.7 * away, 0.4 * away]
    if missing:
        whole = [valid[5 * (k - 3) : 5 * (k + 1)].all() for k in range(4, ROWS)]
        displacement[4:][np.logical_not(whole)] = np.nan
    dtype = np.float32 if config.allow_float32 else np.float64
    state = filtering.initial_state(
        filtering.Filter(config), *(part.astype(dtype) for part in begin)
    )
    signals = [
        (signal * unit).astype(dtype)
        for signal, unit in zip((gyro, accel, displacement), units, strict=True)
    ]
    noise = filtering.NoiseModel(2e-3, 2e-2, measurement_scale=2.0)
    ekf = filtering.Filter(config, noise, measurements=(filtering.ZeroVelocity(0.02),))
    final, history = FILTER(ekf, state, *signals, covariance.astype(dtype), valid)
    return final, history, np.linalg.norm(np.asarray(history.velocity, np.float64), axis=1)


def span(end, longest):
    return st.tuples(st.integers(0, end - 1), st.integers(0, longest))


RUN_AWAY = dict(
    config=CONFIGS[0],
    gap=(88, 15),
    knock=(36, 3),
    size=(15.6, 15.6, 15.6),
    leap=(20, 3),
    away=84.0,
    missing=True,
    units=(1.0, 1.0, 1.0),
    still=0,
)
"""A gap, a knock and displacements that are wrong by 84 m."""
UNITS = st.sampled_from([1.0, 1.0, 1e-3, 9.81, 1 / 9.81, 57.3, 1e3, 1e30])


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@example(**RUN_AWAY)
@example(**{**RUN_AWAY, "config": CONFIGS[1]})
@example(**{**RUN_AWAY, "units": (1.0, 1.0, 1e30)})
@given(
    config=st.sampled_from(CONFIGS),
    gap=span(5 * ROWS, 80),
    knock=span(5 * ROWS, 4),
    size=st.tuples(*3 * [st.floats(-100, 100)]),
    leap=span(ROWS, 4),
    away=st.floats(0, 100),
    missing=st.booleans(),
    units=st.just((1.0, 1.0, 1.0)) | st.tuples(UNITS, UNITS, UNITS),
    still=st.integers(0, 200),
)
def test_errors_do_not_feed_themselves_and_what_is_implausible_is_not_called_healthy(
    **disturbances,
):
    """What is put in is up to 100 m wrong in a window of 0.4 s; what comes out is of that order,
    unless the units are wrong."""
    final, history, speed = disturbed(**disturbances)
    if disturbances["units"] == (1.0, 1.0, 1.0):
        assert np.isfinite(speed).all() and speed.max() < 5000, speed.max()
    plausible = np.isfinite(speed) & (speed <= 100.0)
    healthy = np.asarray(history.healthy) == 1
    assert not healthy[~plausible].any()
    np.testing.assert_array_equal(healthy, np.logical_and.accumulate(healthy))
    assert bool(final.healthy) == healthy[-1]


def test_a_negative_variance_is_not_healthy():
    """Inside `jit`, where the start is not checked. All else is finite and slow."""
    begin, gyro, accel, displacement, covariance = WALK
    ekf = filtering.Filter(PLAIN)
    state = filtering.initial_state(ekf, *begin)
    negative = np.diag(state.core_covariance).copy()
    negative[10] = -1e-6  # of the gyro's bias
    state = state._replace(core_covariance=np.diag(negative))
    nothing = np.full_like(displacement, np.nan)
    final, history = FILTER(ekf, state, gyro, accel, nothing, covariance)
    assert np.isfinite(history.covariance_diagonal).all() and np.isfinite(history.velocity).all()
    assert (np.delete(history.covariance_diagonal, 10, axis=1) >= 0).all()
    assert not np.any(history.healthy) and not final.healthy


@pytest.mark.parametrize("fail_scale", [0.0, 10.0])
@pytest.mark.parametrize("leap", [60.0, 1e9, 1e200, 1e308])
def test_a_displacement_that_nothing_makes_is_rejected_before_the_gate_begins_too(leap, fail_scale):
    """A network that has learnt little may say anything. 0.4 s at 100 m/s are 40 m."""
    config = dataclasses.replace(
        PLAIN, convergence_seconds=100.0, mahalanobis_fail_scale=fail_scale
    )
    begin, gyro, accel, displacement, covariance = WALK
    state, ekf = filtering.initial_state(filtering.Filter(config), *begin), filtering.Filter(config)
    rows = slice(10, 14)
    without, leaping = displacement.copy(), displacement.copy()
    without[rows], leaping[rows, 1] = np.nan, leap
    _, reference = FILTER(ekf, state, gyro, accel, without, covariance)
    _, history = FILTER(ekf, state, gyro, accel, leaping, covariance)
    for name in ("position", "velocity", "covariance_diagonal", "healthy"):
        np.testing.assert_array_equal(getattr(history, name), getattr(reference, name))
    assert (history.accepted[rows] == 0).all() and history.healthy.all()
    no_covariance = covariance.copy()
    no_covariance[rows] = -np.eye(3)  # which spoils the state only where it is used
    _, history = FILTER(ekf, state, gyro, accel, leaping, no_covariance)
    np.testing.assert_array_equal(history.position, reference.position)
    believed = displacement.copy()
    believed[rows, 1] += 30.0
    _, history = FILTER(ekf, state, gyro, accel, believed, covariance)
    assert (history.accepted[rows] == 1).all()


def test_displacements_that_nothing_makes_do_not_open_the_gate():
    """They say nothing about the filter, as none would. After a second of them the gate refuses a
    displacement that is wrong by 5 m, which it would take if the last success were old."""
    begin, gyro, accel, displacement, covariance = WALK
    ekf = filtering.Filter(PLAIN)
    state = filtering.initial_state(ekf, *begin)
    rows, runs = slice(30, 40), []
    for leap in (np.nan, 1e6):
        changed = displacement.copy()
        changed[rows], changed[40:42] = leap, displacement[40:42] + 5.0
        runs.append(FILTER(ekf, state, gyro, accel, changed, covariance))
    (final, history), (of_leaps, leaping) = runs
    np.testing.assert_array_equal(leaping.accepted[rows], 0.0)
    assert np.isnan(history.accepted[rows]).all()
    for name in ("position", "covariance_diagonal"):
        np.testing.assert_array_equal(getattr(leaping, name), getattr(history, name))
    np.testing.assert_array_equal(leaping.accepted[40:], history.accepted[40:])
    np.testing.assert_array_equal(leaping.accepted[40:42], 0.0)
    assert leaping.accepted[42:].all()
    assert jax.tree.all(jax.tree.map(np.array_equal, of_leaps.gate, final.gate))


@pytest.mark.parametrize("leap", [60.0, 1e9, 1e100])
def test_a_displacement_that_nothing_makes_has_no_gradient_in_training(leap):
    """With the gate's slope, open and active; the other gradients are those without it."""
    begin, gyro, accel, displacement, covariance = WALK
    ekf = filtering.Filter(dataclasses.replace(PLAIN, gate_softness=2.0))
    state = filtering.initial_state(ekf, *begin)
    rows = [8, 9, 40]
    without, leaping = displacement.copy(), displacement.copy()
    without[rows], leaping[rows, 1] = np.nan, leap

    def loss(measured, covariance):
        _, history = filtering.run_filter(ekf, state, gyro, accel, measured, covariance)
        return (history.position**2).sum()

    gradients = quick(jax.value_and_grad(loss, argnums=(0, 1)))
    expected_value, expected = gradients(without, covariance)
    value, gradient = gradients(leaping, covariance)
    assert value == expected_value
    for one, other in zip(gradient, expected, strict=True):
        assert not np.any(one[np.array(rows)]) and np.any(one)
        others = np.setdiff1d(np.arange(ROWS), rows)
        np.testing.assert_allclose(one[others], other[others], rtol=1e-9, atol=1e-12)
