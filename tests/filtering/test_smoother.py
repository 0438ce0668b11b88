"""Smoothing against batch least squares over all states at once."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from tests.support import scekf_numpy
from tests.support.compiling import quick
from tests.support.manifold import differences, integrate, minus, plus
from tests.support.walks import yaw_matrix

N, CLONES, INTERVALS, DT = 4, 3, 14, 0.05
SMALL = 3e-5
"""Of all noises together, so that what is not linear hardly counts: the deviations below shrink in
proportion."""
STD = filtering.InitialStd(*(SMALL * np.array([2.0, 1.0, 10.0, 1.0, 1.0, 10.0])))
WHITE, WALK = SMALL * np.array([0.5, 2.0]), SMALL * np.array([0.3, 1.0])  # of a sample; of a second
PRIOR = np.repeat(
    [STD.tilt, STD.yaw, STD.velocity, STD.position, STD.gyro_bias, STD.accel_bias],
    [2, 1, 3, 3, 3, 3],
)


def displaced(past, now):
    return np.einsum("...ji,...j->...i", yaw_matrix(past[0]), now[2] - past[2])


def walk(seed, still=0):
    """The truth (start and the end of every interval), the filter's start, gyro, accel,
    displacements and their covariances.

    The first `still` intervals are at rest."""
    rng = np.random.default_rng(seed)
    samples = N * INTERVALS
    moving = (np.arange(samples) >= still * N)[:, None]
    rate, force = (moving * rng.normal(0, size, (samples, 3)) for size in (1.0, 2.0))
    x = (
        Rotation.from_euler("xyz", [0.3, -0.4, 2.0]).as_matrix(),
        np.array([1.0, -0.5, 0.2]) * (still == 0),
        np.array([3.0, -2.0, 1.0]),
        np.array([0.01, -0.02, 0.015]),
        np.array([0.1, 0.05, -0.08]),
    )
    truth, gyro, accel = [x], np.empty((samples, 3)), np.empty((samples, 3))
    for j in range(samples):
        gyro[j], accel[j] = rate[j] + x[3], x[0].T @ (force[j] - scekf_numpy.G) + x[4]
        steps = np.r_[np.zeros(6), np.repeat(WALK * np.sqrt(DT), 3)] * rng.normal(size=12)
        x = integrate(x, gyro[j : j + 1], accel[j : j + 1], DT, steps[None])
        if (j + 1) % N == 0:
            truth.append(x)
    gyro = gyro + WHITE[0] * rng.normal(size=gyro.shape)
    accel = accel + WHITE[1] * rng.normal(size=gyro.shape)
    displacement, covariance = np.full((INTERVALS, 3), np.nan), np.full((INTERVALS, 3, 3), np.nan)
    for k in range(CLONES, INTERVALS):
        root = SMALL * (np.eye(3) + 0.3 * rng.normal(size=(3, 3)))
        past, now = truth[k + 1 - CLONES], truth[k + 1]
        displacement[k] = displaced(past, now) + root @ rng.normal(size=3)
        covariance[k] = root @ root.T
    start = plus(truth[0], PRIOR * rng.normal(size=15))
    return truth, start, gyro, accel, displacement, covariance


def most_probable(start, gyro, accel, measurements, stops, fixes=()):
    """Gauss-Newton over all states: those at the end of every interval, and their covariances.

    measurements: {k: (displacement, covariance)} as they are to be applied; stops: {k: standard
    deviation of a velocity of zero}; fixes: (k, position (m,), covariance, seconds before the end
    of interval k).
    """
    x = [start]
    for k in range(INTERVALS):
        x.append(integrate(x[-1], gyro[k * N : (k + 1) * N], accel[k * N : (k + 1) * N], DT))
    factors = [((0,), lambda x: minus(x, start), np.diag(PRIOR**2))]
    spread = np.tile(np.repeat([*WHITE, *(WALK * np.sqrt(DT))], 3), N)
    for k in range(INTERVALS):
        signals = gyro[k * N : (k + 1) * N], accel[k * N : (k + 1) * N], DT
        ideal = integrate(x[k], *signals)

        def missed(w, x=x[k], s=signals, ideal=ideal):
            return minus(integrate(x, *s, w.reshape(-1, N, 12)), ideal)

        def step(past, now, s=signals):
            return minus(now, integrate(past, *s))

        reach = differences(missed, 12 * N)
        factors.append(((k, k + 1), step, (reach * spread**2) @ reach.T))
    for k, (d, R) in measurements.items():
        ends = k + 1 - CLONES, k + 1
        factors.append((ends, lambda past, now, d=d: d - displaced(past, now), R))
    for k, std in stops.items():
        factors.append(((k + 1,), lambda now: now[1], std**2 * np.eye(3)))
    for k, z, R, before in fixes:

        def off(now, z=z, before=before):
            return z - (now[2] - before * now[1])[..., : len(z)]

        factors.append(((k + 1,), off, R))

    for _ in range(4):
        information, gradient = np.zeros((15 * len(x), 15 * len(x))), np.zeros(15 * len(x))
        for index, residual, spread in factors:
            states = [x[i] for i in index]
            slope = differences(
                lambda e, r=residual, h=states: r(*map(plus, h, np.split(e, len(h), axis=-1))),
                15 * len(index),
            )
            at = np.concatenate([np.arange(15 * i, 15 * i + 15) for i in index])
            weighted = np.linalg.solve(spread, slope).T
            information[np.ix_(at, at)] += weighted @ slope
            gradient[at] += weighted @ residual(*states)
        scale = np.sqrt(np.diag(information))
        covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
        step = -covariance @ gradient
        x = [plus(one, e) for one, e in zip(x, step.reshape(-1, 15), strict=True)]
    assert (np.abs(step) / np.sqrt(np.diag(covariance))).max() < 1e-5
    blocks = covariance.reshape(len(x), 15, len(x), 15)
    return x[1:], np.stack([blocks[k, :, k] for k in range(1, len(x))])


def rows_of(history):
    return [
        tuple(np.asarray(part)[k] for part in history[:5]) for k in range(len(history.position))
    ]


REJECTED, MISSING, FAR = 9, (6, 7), 11
GATED = filtering.FilterConfig(
    DT,
    N,
    CLONES,
    convergence_seconds=0.0,
    success_seconds=5.0,
    history="core",
    mahalanobis_fail_scale=7.0,
)
WEIGHTED = filtering.FilterConfig(
    DT,
    N,
    CLONES,
    convergence_seconds=0.0,
    success_seconds=5.0,
    gate_softness=3.0,
    gate_threshold=4.0,
    rest_seconds=0.5,
)
NOISE = filtering.NoiseModel.per_sample(*WHITE, DT, *WALK)._replace(measurement_scale=2.0)


def drawn_fixes(truth):
    """(k, position, covariance, seconds before the end of interval k) of some intervals, before
    there is a window too; the one of interval `FAR` is a metre off."""
    rng, fixes = np.random.default_rng(8), []
    for k, before in [(1, 0.03), (4, -0.08), (8, 0.0), (FAR, 0.05), (12, 0.09)]:
        root = SMALL * (np.eye(2) + 0.3 * rng.normal(size=(2, 2)))
        z = (truth[k + 1][2] - before * truth[k + 1][1])[:2] + root @ rng.normal(size=2)
        fixes.append((k, z + (k == FAR), root @ root.T, before))
    return fixes


def fix_measurements(fixes):
    rows, position, covariance, before = (np.stack(column) for column in zip(*fixes, strict=True))
    time = (rows + 1) * GATED.clone_seconds - before
    return (filtering.fixes_on_intervals(time, position, covariance, INTERVALS, GATED),)


def assert_most_probable(filtered, smoothed, expected, spread):
    """The smoothed states are the expected ones, and those of the filter are not, but for the last
    row: what agreed was no trifle."""
    sigma = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    error = (
        np.stack([minus(x, y) for x, y in zip(rows_of(smoothed), expected, strict=True)]) / sigma
    )
    assert np.abs(error).max() < 1e-3
    np.testing.assert_allclose(smoothed.covariance_diagonal, sigma**2, rtol=1e-3)
    if smoothed.covariance is not None:
        scale = sigma[:, :, None] * sigma[:, None, :]
        np.testing.assert_allclose(smoothed.covariance / scale, spread / scale, atol=1e-3)
    before = (
        np.stack([minus(x, y) for x, y in zip(rows_of(filtered), expected, strict=True)]) / sigma
    )
    assert (np.abs(before[:-CLONES]).max(0) > 0.1).all()
    assert (np.abs(before[:-CLONES]).max(0)[3:9] > 0.3).all()
    assert (np.asarray(filtered.covariance_diagonal)[CLONES] > 1.5 * sigma[CLONES] ** 2)[3:6].all()
    assert (smoothed.covariance_diagonal <= filtered.covariance_diagonal * (1 + 1e-9)).all()
    for name in smoothed._fields:
        if getattr(smoothed, name) is not None:
            np.testing.assert_allclose(
                getattr(smoothed, name)[-1], getattr(filtered, name)[-1], rtol=1e-10, atol=1e-20
            )


def test_equals_least_squares_over_all_states():
    """With missing rows, one applied with scaled covariance, and fixes of position, one of which
    is refused."""
    truth, start, gyro, accel, displacement, covariance = walk(3)
    displacement[list(MISSING), 1] = np.nan
    displacement[REJECTED] += 12 * SMALL
    state, fixes = (
        filtering.initial_state(filtering.Filter(GATED, start=STD), *start),
        drawn_fixes(truth),
    )
    ekf, others = filtering.Filter(GATED, NOISE), fix_measurements(fixes)
    arguments = ekf, state, gyro, accel, displacement, covariance
    _, filtered = filtering.run_filter(*arguments, measurements=others)
    smoothed = filtering.smooth(*arguments, measurements=others)

    weight = np.asarray(filtered.gate_passed)
    present = np.flatnonzero(np.isfinite(weight))
    assert [k for k in range(CLONES, INTERVALS) if k not in present] == list(MISSING)
    assert [k for k in present if not weight[k]] == [REJECTED]
    factor = np.where(weight > 0, 1.0, 7.0)
    outcome = filtered.outcomes["fix"]
    applied = np.flatnonzero(outcome.accepted)
    assert [k for k, *_ in fixes if k not in applied] == [FAR]
    measurements = {k: (displacement[k], 2.0 * factor[k] * covariance[k]) for k in present}
    fixes = [fix for fix in fixes if fix[0] in applied]
    optimum = most_probable(start, gyro, accel, measurements, {}, fixes)
    assert_most_probable(filtered, smoothed, *optimum)


def test_goes_on_from_a_state_with_clones():
    """What is known of the second half of a run does not depend on where the filter was stopped
    before it, nor on what comes after it without a measurement."""
    _, start, *signals = walk(5)
    measurements = fix_measurements(
        [(0, np.full(2, np.nan), np.eye(2), 0.0)]
    )  # the programs of the test above
    half = INTERVALS // 2
    state = filtering.initial_state(filtering.Filter(GATED, start=STD), *start)
    reference = filtering.smooth(
        filtering.Filter(GATED, NOISE), state, *signals, measurements=measurements
    )
    counts = N * half, N * half, half, half
    early = [x[:count] for x, count in zip(signals, counts, strict=True)]
    state, _ = filtering.run_filter(filtering.Filter(GATED, NOISE), state, *early)
    # Filled up to the length of the first run.
    second_half = [np.roll(x, -count, axis=0) for x, count in zip(signals, counts, strict=True)]
    second_half[2][half:] = np.nan
    continuation = filtering.smooth(
        filtering.Filter(GATED, NOISE), state, *second_half, measurements=measurements
    )
    sigma = np.sqrt(np.asarray(reference.covariance_diagonal)[half:])
    for name in reference._fields[:5]:
        np.testing.assert_allclose(
            getattr(continuation, name)[:half], getattr(reference, name)[half:], atol=1e-7 * SMALL
        )
    scale = sigma[:, :, None] * sigma[:, None, :]
    np.testing.assert_allclose(
        continuation.covariance[:half] / scale, reference.covariance[half:] / scale, atol=1e-8
    )


def test_a_gate_with_a_slope_and_rest_and_the_gradient_through_them():
    """Against least squares, and of a smoothed position and variance in a measurement and in a
    noise against central differences."""
    _, start, gyro, accel, displacement, covariance = walk(3, still=5)
    displacement[list(MISSING), 1] = np.nan

    @quick
    @functools.partial(jax.value_and_grad, has_aux=True)
    def loss(x):
        noise = NOISE._replace(accel_density=NOISE.accel_density * (1 + x[1]))
        zero_velocity = filtering.ZeroVelocity(5 * SMALL)
        ekf = filtering.Filter(WEIGHTED, noise, STD, measurements=(zero_velocity,))
        state = filtering.initial_state(ekf, *start)
        moved = jnp.asarray(displacement).at[8, 0].add(x[0] * SMALL)
        arguments = ekf, state, gyro, accel, moved, covariance
        _, filtered = filtering.run_filter(*arguments)
        smoothed = filtering.smooth(*arguments)
        position = (smoothed.position[5, 0] - start[2][0]) / SMALL
        return position + smoothed.covariance_diagonal[6, 4] / SMALL**2, (filtered, smoothed)

    (_, histories), _ = loss(np.zeros(2))
    filtered, smoothed = jax.device_get(histories)
    weight = filtered.gate_passed
    present = np.flatnonzero(np.isfinite(weight))
    stops = np.flatnonzero(filtered.outcomes["zero_velocity"].accepted)
    assert len(stops) >= 2 and weight[present].min() < 0.9 and smoothed.covariance is None
    measurements = {k: (displacement[k], 2.0 / weight[k] * covariance[k]) for k in present}
    stops = {k: 5 * SMALL for k in stops}
    optimum = most_probable(start, gyro, accel, measurements, stops)
    assert_most_probable(filtered, smoothed, *optimum)

    x = np.array([0.1, 0.2])
    (value, _), gradient = loss(x)
    assert np.isfinite(value) and (np.abs(gradient) > 1e-3).all()
    expected = [(loss(x + e)[0][0] - loss(x - e)[0][0]) / 2e-3 for e in 1e-3 * np.eye(2)]
    np.testing.assert_allclose(gradient, expected, rtol=1e-4)


def test_a_smoothed_run_says_where_its_filter_was_not_healthy():
    """Beyond the largest speed, and from a state that was not healthy."""
    _, start, *signals = walk(5)
    config = dataclasses.replace(GATED, speed_limit=3.0)
    ekf = filtering.Filter(config, NOISE)
    state = filtering.initial_state(filtering.Filter(config, start=STD), *start)
    fast = signals[1].copy()
    fast[6 * N : 7 * N] += 30.0
    ends = []
    for first, accel in ((state, signals[1]), (state, fast)):
        arguments = ekf, first, signals[0], accel, *signals[2:]
        end, filtered = filtering.run_filter(*arguments)
        np.testing.assert_array_equal(filtering.smooth(*arguments).healthy, filtered.healthy)
        ends.append((end, int(np.sum(filtered.healthy))))
    assert [count for _, count in ends] == [INTERVALS, 6]
    smoothed = filtering.smooth(ekf, ends[1][0], *signals)
    assert not np.any(smoothed.healthy) and np.isfinite(smoothed.position).all()
