"""Drop-outs of the IMU: bridged, coasted through, and what they cost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering import gaps
from tests.support.short_walk import CLONES, CONFIG, DT, INTERVALS, NOISE, WALK, N, run, start

# One program in place of one for every operation.
bridge = jax.jit(gaps.bridge, static_argnums=4)


def gap_of(valid, memory, limit):
    """By hand, one sample after the other: age, index held (−1 the memory, None nothing), the extra
    variance in units of the gap's."""
    ages, held, variances, age, last, before = (
        [],
        [],
        [],
        memory[0],
        (-1 if memory[1] else None),
        0.0,
    )
    for j, good in enumerate(valid):
        age = 0 if good else age + 1
        last = j if good else last
        error = lambda a: min(a / limit, 1.0)  # noqa: E731
        total = sum(error(a) for a in range(1, age + 1))
        before = sum(error(a) for a in range(1, age))
        ages.append(age)
        held.append(last)
        variances.append(total**2 - before**2)
    return ages, held, variances


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
    ages, held, variances = gap_of(good, (missing_before, True), 3)
    np.testing.assert_allclose(age, np.array(ages) * DT)
    for found, signal, remembered in ((imu.gyro, gyro, 5.0), (imu.accel, accel, 6.0)):
        np.testing.assert_array_equal(
            found, [signal[j] if j >= 0 else np.full(3, remembered) for j in held]
        )
    np.testing.assert_allclose(imu.gap.gyro_variance, np.array(variances) * CONFIG.gap_gyro_std**2)
    np.testing.assert_allclose(
        imu.gap.accel_variance, np.array(variances) * CONFIG.gap_accel_std**2
    )
    np.testing.assert_array_equal(imu.gap.used, np.array(ages) <= 3)
    assert after.missing == 1 and (after.gyro == gyro[28]).all()


def test_nothing_held_before_the_first_sample():
    ones, valid = np.ones((4, 3)), np.array([False, False, True, False])
    imu, _, after = bridge(ones, ones, valid, start().imu, CONFIG)
    np.testing.assert_array_equal(imu.gap.used, [0, 0, 1, 1])
    assert np.isfinite(after.gyro).all()
    _, _, never = bridge(ones, ones, np.zeros(4, bool), start().imu, CONFIG)
    assert np.isnan(never.gyro).all() and never.missing == 4


def test_all_samples_there_is_the_plain_filter():
    plain, found = run(), run(valid=np.ones(N * INTERVALS, bool))
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-10, rtol=1e-9)
    assert (np.asarray(plain[1].imu_gap) == 0).all() and (np.asarray(plain[1].healthy) == 1).all()


def test_a_short_hole_is_bridged_a_long_one_costs_certainty():
    gyro = WALK[1]
    valid = np.ones(N * INTERVALS, bool)
    valid[100:103] = False
    valid[200:240] = False
    broken = gyro.copy()
    broken[~valid] = np.nan
    config = filtering.FilterConfig(DT, N, CLONES, bridge_seconds=0.06, history="core")
    _, whole = run(config)
    _, found = run(config, valid, gyro=broken)
    gap = np.asarray(found.imu_gap)
    np.testing.assert_allclose(gap[[19, 20, 21]], [0, 0.06, 0])
    np.testing.assert_allclose(gap[39:49], [0, *(0.1 * np.arange(1, 9)), 0], atol=1e-12)
    sigma, before = (np.sqrt(np.asarray(h.covariance_diagonal)) for h in (found, whole))
    assert (sigma[20, :6] > before[20, :6]).all() and (sigma[47, :6] > 5 * before[47, :6]).all()
    assert (np.asarray(found.healthy) == 1).all() and np.isfinite(found.position).all()
    # what it says of itself holds: off by no more than four of its own sigmas in the gap and after
    # it
    off = np.abs(np.asarray(found.velocity) - np.asarray(whole.velocity))
    assert (off[39:] < 4 * np.sqrt(sigma[39:, 3:6] ** 2 + before[39:, 3:6] ** 2)).all()


def test_the_filter_coasts_where_nothing_is_known():
    """No turn, no change of velocity: constant velocity for the whole gap, whatever the attitude is
    believed to be."""
    (R, v, p), gyro, accel, _, c = WALK
    valid, missing = np.zeros(N * INTERVALS, bool), np.full((INTERVALS, 3), np.nan)
    _, history = filtering.run_filter(start(), gyro, accel, missing, c, CONFIG, NOISE, valid)
    history = jax.tree.map(lambda leaf: np.asarray(leaf)[:6], history)
    np.testing.assert_allclose(history.velocity, np.tile(v, (6, 1)), atol=1e-12)
    np.testing.assert_allclose(history.rotation, np.tile(R, (6, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(history.position[-1], p + v * 6 * N * DT, atol=1e-12)
    # Nothing was there to hold, so every sample has the variance of one just beyond the limit: e_4
    # = 1, Σ e = 3, of which 3² − 2² is its.
    growth = history.covariance_diagonal[-1, 0] - np.radians(1.0) ** 2
    np.testing.assert_allclose(
        growth,
        30 * DT**2 * ((3**2 - 2**2) * CONFIG.gap_gyro_std**2 + NOISE.gyro_density**2 / DT),
        rtol=1e-6,
    )


def test_a_gap_across_two_runs_is_one_gap():
    valid = np.ones(N * INTERVALS, bool)
    half = INTERVALS // 2
    valid[N * half - 4 : N * half + 8] = False
    _, together = run(valid=valid)
    state, first = run(valid=valid, rows=slice(0, half))
    _, second = run(valid=valid, rows=slice(half, INTERVALS), state=state)
    for name in ("position", "velocity", "covariance_diagonal", "imu_gap"):
        both = np.concatenate([getattr(first, name), getattr(second, name)])
        np.testing.assert_allclose(
            both, getattr(together, name), atol=1e-9, rtol=1e-8, err_msg=name
        )
