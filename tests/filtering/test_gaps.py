"""Drop-outs of the IMU: bridged, coasted through, and what they cost."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering import gaps
from gnio_jax.filtering.propagation import integrate
from gnio_jax.filtering.state import Mean
from tests.support import manifold
from tests.support.random_walk import random_walk

N, CLONES, DT, INTERVALS = 5, 4, 0.02, 60
CONFIG = filtering.FilterConfig(DT, N, CLONES, bridge_seconds=0.06, history="core")
NOISE = filtering.NoiseModel(measurement_scale=2.0)
WALK = random_walk(11, n=N, clones=CLONES, intervals=INTERVALS, dt=DT, bias=False)


def start():
    return filtering.initial_state(filtering.Filter(CONFIG), *WALK[0])


THERE = np.ones(N * INTERVALS, bool)


def run(valid=THERE, gyro=WALK[1], displacement=WALK[3]):
    signals = gyro, WALK[2], displacement, WALK[4], valid
    return filtering.run_filter(filtering.Filter(CONFIG, NOISE), start(), *signals)


bridge = jax.jit(gaps.bridge, static_argnums=4)


def gap_of(valid, missing_before, limit):
    """By hand, one sample after the other: age, index held (−1: the memory), the extra variance in
    units of the gap's."""
    rows, age, last = [], missing_before, -1
    for j, good in enumerate(valid):
        age, last = (0, j) if good else (age + 1, last)
        errors = [min(a / limit, 1.0) for a in range(1, age + 1)]
        rows.append((age, last, sum(errors) ** 2 - sum(errors[:-1]) ** 2))
    return zip(*rows, strict=True)


@pytest.mark.parametrize("missing_before", [0, 2])
def test_holes_are_filled_with_the_last_sample(missing_before):
    rng = np.random.default_rng(0)
    gyro, accel = rng.normal(size=(2, 30, 3))
    valid = np.ones(30, bool)
    valid[[0, 1, 7, 12, 13, 14, 15, 16, 17, 18, 29]] = False
    gyro[7], accel[13, 2] = np.nan, np.inf
    gyro[22, 1], accel[23, 0] = np.nan, np.inf  # not named, but not finite either
    good = valid.copy()
    good[[22, 23]] = False
    memory = start().imu._replace(
        gyro=jnp.full(3, 5.0), accel=jnp.full(3, 6.0), missing=jnp.int32(missing_before)
    )
    imu, age, after = bridge(gyro, accel, valid, memory, CONFIG)
    ages, held, variances = gap_of(good, missing_before, 3)
    np.testing.assert_allclose(age, np.array(ages) * DT)
    for values, signal, remembered in ((imu.gyro, gyro, 5.0), (imu.accel, accel, 6.0)):
        np.testing.assert_array_equal(
            values, [signal[j] if j >= 0 else np.full(3, remembered) for j in held]
        )
    np.testing.assert_allclose(imu.gap.gyro_variance, np.array(variances) * CONFIG.gap_gyro_std**2)
    np.testing.assert_allclose(
        imu.gap.accel_variance, np.array(variances) * CONFIG.gap_accel_std**2
    )
    np.testing.assert_array_equal(imu.gap.used, np.array(ages) <= 3)
    np.testing.assert_array_equal(imu.gap.missing, ~good)
    assert after.missing == 1 and (after.gyro == gyro[28]).all()
    # A gap across two streams is one gap.
    first, age_of_first, between = bridge(gyro[:15], accel[:15], valid[:15], memory, CONFIG)
    second, age_of_second, end = bridge(gyro[15:], accel[15:], valid[15:], between, CONFIG)
    parts = jax.tree.map(
        lambda *x: np.concatenate(x), (first, age_of_first), (second, age_of_second)
    )
    jax.tree.map(np.testing.assert_array_equal, parts, (imu, age))
    jax.tree.map(np.testing.assert_array_equal, end, after)


def test_a_sample_is_held_for_as_many_samples_as_the_setting_says():
    """0.3 s are three samples of 0.1 s, although 0.3 / 0.1 is a little below 3."""
    config = filtering.FilterConfig(0.1, N, CLONES, bridge_seconds=0.3)
    ones, valid = np.ones((5, 3)), np.array([True, False, False, False, False])
    imu, _, _ = bridge(ones, ones, valid, start().imu, config)
    np.testing.assert_array_equal(imu.gap.used, [1, 1, 1, 1, 0])


def test_nothing_held_before_the_first_sample():
    ones, valid = np.ones((4, 3)), np.array([False, False, True, False])
    imu, _, after = bridge(ones, ones, valid, start().imu, CONFIG)
    np.testing.assert_array_equal(imu.gap.used, [0, 0, 1, 1])
    assert np.isfinite(after.gyro).all()
    _, _, never = bridge(ones, ones, np.zeros(4, bool), start().imu, CONFIG)
    assert np.isnan(never.gyro).all() and never.missing == 4


def undone(gyro, accel, valid, memory, config):
    """By hand, one sample after the other: x + τ dx/dt, with the last sample that was there."""
    (last, age), rows = memory, []
    for g, a, good in zip(gyro, accel, valid, strict=True):
        if good:
            sample = np.concatenate([g, a])
            slope = 0.0 if last is None else (sample - last) / ((1 + age) * config.dt)
            rows.append(sample + config.low_pass_seconds * slope)
            last, age = sample, 0
        else:
            rows.append(np.zeros(6) if last is None else last)
            age += 1
    return np.array(rows)


def test_the_low_pass_of_the_imu_is_undone():
    """Also after a hole, across two streams, and where there was no sample before."""
    config = dataclasses.replace(CONFIG, low_pass_seconds=0.07)
    gyro, accel = np.random.default_rng(3).normal(size=(2, 20, 3))
    valid = np.ones(20, bool)
    valid[[0, 6, 11, 12]] = False
    memory = start().imu
    expected = undone(gyro, accel, valid, (None, 0), config)
    imu, _, after = bridge(gyro, accel, valid, memory, config)
    np.testing.assert_allclose(np.hstack([imu.gyro, imu.accel]), expected, atol=1e-12)
    np.testing.assert_array_equal(after.gyro, gyro[-1])  # the memory is raw
    behind, _, _ = bridge(gyro, accel, valid, memory, CONFIG)
    jax.tree.map(np.testing.assert_array_equal, imu.output, (behind.gyro, behind.accel))
    first, _, between = bridge(gyro[:12], accel[:12], valid[:12], memory, config)
    second, _, _ = bridge(gyro[12:], accel[12:], valid[12:], between, config)
    np.testing.assert_allclose(np.concatenate([first.accel, second.accel]), imu.accel, atol=1e-12)
    remembered = memory._replace(gyro=jnp.full(3, 5.0), accel=jnp.full(3, 6.0))
    imu, _, _ = bridge(gyro, accel, None, remembered, config)
    before = np.repeat([5.0, 6.0], 3), 0
    expected = undone(gyro, accel, np.ones(20, bool), before, config)
    np.testing.assert_allclose(np.hstack([imu.gyro, imu.accel]), expected, atol=1e-12)


def test_a_signal_behind_a_low_pass_comes_back():
    """Of the step response of a first-order low-pass, 1 − exp(−t/τ), the step remains."""
    config = filtering.FilterConfig(1e-4, 1, 1, low_pass_seconds=0.06)
    time = 1e-4 * np.arange(1, 3000)[:, None]
    signal = np.tile(1 - np.exp(-time / 0.06), (1, 3))
    imu, _, _ = bridge(signal, signal, None, start().imu, config)
    np.testing.assert_allclose(imu.gyro[1:], 1.0, atol=2e-3)


def test_a_short_hole_is_bridged_a_long_one_costs_certainty():
    valid, broken = THERE.copy(), WALK[1].copy()
    valid[[*range(100, 103), *range(200, 240)]] = False
    broken[~valid] = np.nan
    (_, whole), (_, history) = run(), run(valid=valid, gyro=broken)
    gap = np.asarray(history.imu_gap)
    assert not np.any(whole.imu_gap) and np.all(whole.healthy)
    np.testing.assert_allclose(gap[[19, 20, 21]], [0, 0.06, 0])
    np.testing.assert_allclose(gap[39:49], [0, *(0.1 * np.arange(1, 9)), 0], atol=1e-12)
    sigma, before = (np.sqrt(np.asarray(h.covariance_diagonal)) for h in (history, whole))
    assert (sigma[20, :6] > before[20, :6]).all() and (sigma[47, :6] > 5 * before[47, :6]).all()
    assert (np.asarray(history.healthy) == 1).all() and np.isfinite(history.position).all()
    # what it says of itself holds: off by no more than four of its own sigmas in the gap and after
    # it
    off = np.abs(np.asarray(history.velocity) - np.asarray(whole.velocity))
    assert (off[39:] < 4 * np.sqrt(sigma[39:, 3:6] ** 2 + before[39:, 3:6] ** 2)).all()


def test_a_held_sample_measures_nothing_where_a_hole_adds_no_uncertainty():
    """A carrier at 2 m/s sideways, whose last sample is quiet, neither rests nor is measured in the
    hole, whatever variance the settings give its samples."""
    config = dataclasses.replace(CONFIG, gap_gyro_std=0.0, gap_accel_std=0.0)
    constraints = filtering.ZeroVelocity(), filtering.NonHolonomic()
    ekf = filtering.Filter(config, NOISE, measurements=constraints)
    state = filtering.initial_state(ekf, np.eye(3), np.array([0.0, 2.0, 0.0]), np.zeros(3))
    accel = np.tile([0.0, 0.0, 9.81], (10 * N, 1))
    accel[:N, 0] = 4.0
    no_rows = np.full((10, 3), np.nan), np.tile(np.eye(3), (10, 1, 1))
    valid = np.arange(10 * N) < N
    _, history = filtering.run_filter(ekf, state, np.zeros_like(accel), accel, *no_rows, valid)
    assert not np.any(history.outcomes["zero_velocity"].present)
    np.testing.assert_array_equal(history.outcomes["nonholonomic"].present, np.arange(10) == 0)


def test_the_error_coasts_with_the_mean():
    """Φ by differences of a mean that neither turns nor accelerates at the samples that are not
    used, whatever the biases are."""
    rng, used = np.random.default_rng(4), np.array([1.0, 0.0, 1.0, 0.0, 0.0])
    gyro, accel = 3 * rng.standard_normal((N, 3)), 10 * rng.standard_normal((N, 3))
    pose = *WALK[0], np.array([0.02, -0.01, 0.03]), np.array([0.1, -0.2, 0.05])

    def coasted(x):
        for sample, use in enumerate(used):
            rows = slice(sample, sample + 1)
            moved = manifold.integrate(x, gyro[rows], accel[rows], DT)
            x = moved if use else (*x[:2], x[2] + x[1] * DT, *x[3:])
        return x

    gap = gaps.Gap(np.zeros(N), np.zeros(N), used, used == 0)
    interval = jax.jit(integrate, static_argnames="dt")(
        Mean(*pose), gaps.Imu(gyro, accel, gap), NOISE, dt=DT
    )
    end = coasted(pose)
    estimate = interval.rotation, interval.velocity, interval.position, *pose[3:]
    np.testing.assert_allclose(manifold.minus(estimate, end), 0, atol=1e-12)
    transition = manifold.differences(
        lambda change: manifold.minus(coasted(manifold.plus(pose, change)), end), 15, 1e-5
    )
    np.testing.assert_allclose(interval.transition, transition[:9], atol=2e-8)


def test_the_filter_coasts_where_nothing_is_known():
    """No turn, no change of velocity: constant velocity for the whole gap, whatever the attitude is
    believed to be."""
    R, v, p = WALK[0]
    _, history = run(np.zeros(N * INTERVALS, bool), displacement=np.full((INTERVALS, 3), np.nan))
    history = jax.tree.map(lambda leaf: np.asarray(leaf)[:6], history)
    np.testing.assert_allclose(history.velocity, np.tile(v, (6, 1)), atol=1e-12)
    np.testing.assert_allclose(history.rotation, np.tile(R, (6, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(history.position[-1], p + v * 6 * N * DT, atol=1e-12)
    # Nothing was there to hold, so every sample has the variance of one just beyond the limit: e_4
    # = 1, Σ e = 3, of which 3² − 2² is its.
    growth = history.covariance_diagonal[-1, 0] - np.radians(1.0) ** 2
    sample_variance = (3**2 - 2**2) * CONFIG.gap_gyro_std**2 + NOISE.gyro_density**2 / DT
    np.testing.assert_allclose(growth, 30 * DT**2 * sample_variance, rtol=1e-6)
