"""What is not as it should be: drop-outs of the IMU, rest, starts without a reference, values that
cannot be."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from gnio_jax import filtering, geometry
from gnio_jax.filtering import gaps, zero_velocity
from gnio_jax.filtering.gaps import Gap, Imu
from gnio_jax.filtering.start import rest_at_start
from gnio_jax.filtering.zero_velocity import detect_rest
from gnio_jax.types import Prediction
from tests.support import scekf_numpy
from tests.support.random_walk import random_walk

N, CLONES, DT, INTERVALS = 5, 4, 0.02, 60
CONFIG = filtering.FilterConfig(DT, N, CLONES, bridge_seconds=0.06, history="core")
NOISE = filtering.NoiseModel(measurement_scale=2.0)

# One program in place of one for every operation.
bridge = jax.jit(gaps.bridge, static_argnums=4)
update_at_rest = jax.jit(zero_velocity.update_at_rest, static_argnums=4)
slope_of_level = jax.jit(jax.jacrev(geometry.level))


def start(config=CONFIG, walk=None):
    (R, v, p), *_ = walk or WALK
    return filtering.initial_state(config, R, v, p)


WALK = random_walk(11, n=N, clones=CLONES, intervals=INTERVALS, dt=DT, bias=False)


def run(config=CONFIG, valid=None, gyro=None, accel=None, walk=WALK, state=None, rows=slice(None)):
    _, g, a, d, c = walk
    samples = slice(
        None if rows.start is None else rows.start * N, None if rows.stop is None else rows.stop * N
    )
    state = start(config, walk) if state is None else state
    return filtering.run_filter(
        state,
        (g if gyro is None else gyro)[samples],
        (a if accel is None else accel)[samples],
        d[rows],
        c[rows],
        config,
        NOISE,
        None if valid is None else valid[samples],
    )


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


def test_windows_with_a_long_hole_are_no_measurements():
    _, gyro, accel, _, _ = WALK
    valid = np.ones(N * INTERVALS, bool)
    valid[150:160], valid[220:222] = False, False

    def predict(windows):
        return Prediction(
            jnp.mean(windows[:, :, :3], axis=1) * 0.01, jnp.full((1, 3), -1.0, jnp.float32)
        )

    @jax.jit
    def odometry(state):
        return filtering.run_odometry(predict, state, gyro, accel, CONFIG, NOISE, valid)

    _, history = odometry(start())
    missing = np.isnan(np.asarray(history.accepted))
    # Coasting are samples 153 … 159, in intervals 30 and 31: in the windows that end with intervals
    # 30 … 34. The short hole is bridged.
    np.testing.assert_array_equal(np.flatnonzero(missing), [0, 1, 2, 3, 30, 31, 32, 33, 34])
    assert np.isfinite(history.position).all()


def test_rest_is_a_measurement_if_wanted():
    """Standing still with biased sensors: without it the velocity wanders, with it it stays."""
    rng = np.random.default_rng(5)
    R = Rotation.from_euler("xyz", [0.2, -0.1, 1.0]).as_matrix()
    samples = N * INTERVALS
    gyro = 1e-3 * rng.standard_normal((samples, 3))
    accel = (
        np.tile(R.T @ [0, 0, 9.81], (samples, 1)) + 0.05 + 1e-2 * rng.standard_normal((samples, 3))
    )
    accel[150:160] += R.T @ [0, 0, 0.5]  # a knock
    nothing = np.full((INTERVALS, 3), np.nan), np.tile(np.eye(3), (INTERVALS, 1, 1))
    found = {}
    for std in (0.0, 0.02):
        config = filtering.FilterConfig(
            DT, N, CLONES, zero_velocity_std=std, rest_seconds=0.3, history="core"
        )
        state = filtering.initial_state(config, R, np.zeros(3), np.zeros(3))
        _, found[std] = filtering.run_filter(state, gyro, accel, *nothing, config, NOISE)
    assert (np.asarray(found[0.0].at_rest) == 0).all()
    expected = np.ones(INTERVALS)
    expected[[0, 1, 30, 31, 32, 33]] = (
        0  # three intervals of 0.1 s until it counts, and again after the knock
    )
    np.testing.assert_array_equal(found[0.02].at_rest, expected)
    speed = {std: np.linalg.norm(h.velocity, axis=1) for std, h in found.items()}
    assert speed[0.0][-1] > 0.3 and speed[0.02][-1] < 0.02
    # the same numbers from the textbook's update at the first rest
    k, h = 2, found[0.0]
    P, v = np.asarray(h.covariance)[k], np.asarray(h.velocity)[k]
    gain = P[:, 3:6] @ np.linalg.inv(P[3:6, 3:6] + 0.02**2 * np.eye(3))
    np.testing.assert_allclose(found[0.02].velocity[k], v - gain[3:6] @ v, atol=1e-12)
    np.testing.assert_allclose(found[0.02].covariance[k], P - gain @ P[3:6], atol=1e-12)
    np.testing.assert_allclose(
        found[0.02].accel_bias[k], np.asarray(h.accel_bias)[k] - gain[12:] @ v, atol=1e-12
    )


@pytest.mark.parametrize("seconds, intervals", [(0.0, 1), (0.1, 1), (0.11, 2), (0.3, 3), (0.35, 4)])
def test_rest_counts_only_after_its_time(seconds, intervals):
    """Intervals of 0.1 s: as many as `rest_seconds` needs, and anew after each that is not quiet,
    in one of three ways."""
    config = filtering.FilterConfig(DT, N, CLONES, zero_velocity_std=0.02, rest_seconds=seconds)
    still = Imu(jnp.zeros((N, 3)), jnp.tile(jnp.array([[0.0, 0.0, 9.81]]), (N, 1)), None)
    turning = still._replace(gyro=still.gyro.at[2, 1].set(1.01 * config.rest_gyro))
    shaken = still._replace(accel=still.accel.at[3, 2].add(-1.01 * config.rest_accel))
    held = still._replace(gap=Gap(jnp.zeros(N).at[-1].set(1e-6), jnp.zeros(N), jnp.ones(N)))
    state, found, expected, count = start(config), [], [], 0
    for imu in [*5 * [still], turning, *5 * [still], shaken, *5 * [still], held, *5 * [still]]:
        state, quiet = detect_rest(state, imu, config)
        count = count + 1 if imu is still else 0
        found.append(bool(quiet))
        expected.append(count >= intervals)
    assert found == expected and sum(found) == 4 * (6 - intervals)


def resting(
    now, converged=True, last_success=100, pause_end=0, tried=True, speed=1.0, config=CONFIG
):
    """The state before and after the IMU is quiet at sample `now`, with a velocity of `speed` known
    to 0.1 m/s per axis, and what the filter made of it. `tried`: there was a displacement, too."""
    config = dataclasses.replace(config, zero_velocity_std=0.05)
    (R, _, p), *_ = WALK
    std = filtering.InitialStd(velocity=0.1)
    state = filtering.initial_state(config, R, speed * np.array([0.6, 0.0, -0.8]), p, std=std)
    gate = filtering.GateState(jnp.bool_(converged), jnp.int32(last_success), jnp.int32(pause_end))
    state = state._replace(gate=gate, step=jnp.int32(now // N))
    if state.first is not None:
        state = state._replace(first=jax.tree.map(lambda part: part + 0.25, state.first))
    new, found, _ = update_at_rest(state, np.bool_(True), np.bool_(tried), 0, config)
    return state, new, found


EDGE = np.sqrt(CONFIG.gate_threshold * (0.1**2 + 0.05**2))
"""Speed at which the χ² test is just passed, m/s."""


@pytest.mark.parametrize(
    "gate, speed, accepted",
    [
        (dict(now=110), 1.001 * EDGE, False),
        (dict(now=110), 0.999 * EDGE, True),
        (dict(now=125), 3.0, False),
        (dict(now=130), 3.0, True),  # the last success is 0.5 s old, older
        (dict(now=110, converged=False), 3.0, True),
        (dict(now=110, last_success=-1), 3.0, False),
        (dict(now=110, pause_end=115), 3.0, True),
        (dict(now=115, pause_end=115), 3.0, False),
        (dict(now=110, tried=False), 3.0, True),
        (dict(now=110, tried=False), 0.999 * EDGE, True),
    ],
)
def test_rest_passes_a_chi_square_test_where_the_gate_is_active(gate, speed, accepted):
    state, new, found = resting(speed=speed, **gate)
    np.testing.assert_allclose(found.nis, speed**2 / (0.1**2 + 0.05**2), rtol=1e-12)
    assert bool(found.accepted) == accepted and new.gate == state.gate
    wanted = np.asarray(state.velocity) * (0.05**2 / (0.1**2 + 0.05**2) if accepted else 1.0)
    np.testing.assert_allclose(new.velocity, wanted, rtol=1e-12)
    variance = 1 / (1 / 0.1**2 + accepted / 0.05**2)
    np.testing.assert_allclose(np.diag(new.core_covariance)[3:6], variance, rtol=1e-12)


@pytest.mark.parametrize(
    "gate, speed, anew",
    [
        (dict(now=110, converged=False), 3.0, True),
        (dict(now=110, converged=False), 0.1, False),
        (dict(now=110), 3.0, False),
        (dict(now=110, tried=False), 3.0, True),
    ],
)
def test_rest_takes_first_estimates_anew_where_it_corrects_much(gate, speed, anew):
    """Not where it was refused, and not where it fits."""
    state, new, found = resting(
        speed=speed, config=filtering.FilterConfig(DT, N, CLONES, jacobians="first"), **gate
    )
    assert bool(found.accepted) == (speed == 0.1 or anew)
    wanted = state.first
    if anew:
        wanted = wanted._replace(
            velocity=new.velocity, offset=new.offset, move=new.move, clone_offset=new.clone_offset
        )
        assert np.abs(new.velocity).max() < 1.0
    jax.tree.map(np.testing.assert_array_equal, new.first, wanted)


RESTING = filtering.FilterConfig(
    DT,
    N,
    CLONES,
    zero_velocity_std=0.02,
    rest_seconds=0.3,
    convergence_seconds=1.0,
)


def test_rest_without_displacements_corrects_a_wrong_velocity():
    """Displacements until interval 38 and then none; a false knock of 4 m/s; then 38 s at rest. In
    pieces, for the program of the next test."""
    intervals, last, knock = 7 * INTERVALS, 38, 39 * N
    gyro, accel = np.zeros((N * intervals, 3)), np.tile([0, 0, 9.81], (N * intervals, 1))
    accel[knock, 0] += 4.0 / DT
    displacement = np.where(np.arange(intervals)[:, None] <= last, np.zeros(3), np.nan)
    spread = np.tile(0.02**2 * np.eye(3), (INTERVALS, 1, 1))
    final, parts = filtering.initial_state(RESTING, np.eye(3), np.zeros(3), np.zeros(3)), []
    for first in range(0, intervals, INTERVALS):
        rows = slice(first, first + INTERVALS)
        samples = slice(N * first, N * (first + INTERVALS))
        given = final, gyro[samples], accel[samples], displacement[rows], spread
        final, history = filtering.run_filter(*given, RESTING, NOISE)
        parts.append(history)
    history = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    assert bool(final.gate.converged) and int(final.gate.pause_end) <= 0  # it never became stale
    np.testing.assert_allclose(np.asarray(history.velocity)[39:41, 0], 4.0, atol=0.05)
    assert history.rest_nis[42] > 100 and (np.asarray(history.at_rest)[42:] == 1).all()
    speed = np.linalg.norm(history.velocity, axis=1)
    # The filter was sure of its velocity: each interval at rest takes a part of the error away.
    assert (np.diff(speed[41:52]) < -0.1).all() and speed[52] < 1.0 and speed[-1] < 0.05


def test_a_quiet_ride_is_no_rest_and_a_wrong_start_is_corrected_by_rest():
    """A carriage that glides at 1 m/s, as the filter knows by displacements; and a device at rest
    that starts with 3 m/s, so sure of it that it would not pass the test."""
    gliding, samples = 30, N * INTERVALS
    gyro, accel = np.zeros((samples, 3)), np.tile([0, 0, 9.81], (samples, 1))
    accel[: N * gliding : 2, 2] += 1.0  # rattles before
    accel[1 : N * gliding : 2, 2] -= 1.0
    spread = np.tile(0.02**2 * np.eye(3), (INTERVALS, 1, 1))

    def go(speed, accel, displacement):
        state = filtering.initial_state(
            RESTING,
            np.eye(3),
            np.array([speed, 0.0, 0.0]),
            np.zeros(3),
            std=filtering.InitialStd(velocity=0.05),
        )
        return filtering.run_filter(state, gyro, accel, displacement, spread, RESTING, NOISE)[1]

    history = go(1.0, accel, np.tile([CLONES * N * DT, 0.0, 0.0], (INTERVALS, 1)))
    quiet = np.arange(INTERVALS) >= gliding + 2
    np.testing.assert_array_equal(np.isfinite(history.rest_nis), quiet)
    assert (np.asarray(history.rest_nis)[quiet] > 100).all()
    assert (np.asarray(history.at_rest) == 0).all()
    np.testing.assert_allclose(history.velocity[:, 0], 1.0, atol=0.02)

    history = go(3.0, np.tile([0, 0, 9.81], (samples, 1)), np.full((INTERVALS, 3), np.nan))
    assert history.rest_nis[2] > 1000 and (np.asarray(history.at_rest)[2:] == 1).all()
    assert np.abs(history.velocity[2:, 0]).max() < 0.5 and abs(history.velocity[-1, 0]) < 0.02


@pytest.mark.parametrize("pitch", [0.0, 0.7, -np.pi / 2, np.pi / 2])
def test_level_state(pitch):
    rng = np.random.default_rng(1)
    R = Rotation.from_euler("ZYX", [0.0, pitch, 0.4]).as_matrix()
    accel = R.T @ [0, 0, 9.81] + 0.01 * rng.standard_normal((50, 3))
    state = filtering.level_state(CONFIG, 0.01 * rng.standard_normal((50, 3)), accel)
    np.testing.assert_allclose(
        state.rotation @ accel.mean(0) / np.linalg.norm(accel.mean(0)), [0, 0, 1], atol=1e-12
    )
    if abs(pitch) < 1:
        np.testing.assert_allclose(state.rotation, R, atol=2e-3)
    np.testing.assert_allclose(
        np.asarray(state.rotation) @ np.asarray(state.rotation).T, np.eye(3), atol=1e-12
    )
    assert np.linalg.det(state.rotation) > 0
    sigma = np.sqrt(np.diag(state.core_covariance))
    spread = np.sqrt(accel.var(0).sum())
    np.testing.assert_allclose(
        sigma[0], np.sqrt(0.02**2 + spread**2 / 2.0) / 9.81, rtol=1e-9
    )  # one second, two half seconds
    np.testing.assert_allclose(sigma[3:6], 0.05)
    shaken = filtering.level_state(
        CONFIG, np.zeros((50, 3)), accel + np.sin(np.arange(50))[:, None]
    )
    assert (
        np.sqrt(shaken.core_covariance[3, 3]) == 1.0
        and shaken.core_covariance[0, 0] > state.core_covariance[0, 0]
    )


@pytest.mark.parametrize("rate", [[0.3, -0.8, 0.5], [0.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
def test_level_state_of_a_phone_that_a_hand_turns(rate):
    """The attitude is that of the first sample, not of the second's middle, and not rough."""
    first = Rotation.from_euler("ZYX", [0.0, 0.4, -1.1])
    turned = first * Rotation.from_rotvec(np.outer(np.arange(50) * CONFIG.dt, rate))
    accel = turned.inv().apply([0, 0, 9.81])
    state = filtering.level_state(CONFIG, np.tile(rate, (50, 1)), accel)
    np.testing.assert_allclose(state.rotation, first.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(np.sqrt(state.core_covariance[0, 0]), 0.02 / 9.81, rtol=1e-6)


def test_level_state_says_how_far_the_velocity_can_be_from_zero():
    """1.5 s times the spread, between a table's and a walker's, with a slope everywhere."""

    shake = np.outer(np.sin(np.arange(50)), [1.0, 0, 0])

    def velocity_std(amplitude):
        shaken = np.tile([0, 0, 9.81], (50, 1)) + amplitude * shake
        state = filtering.level_state(CONFIG, np.zeros((50, 3)), shaken)
        return jnp.sqrt(state.core_covariance[3, 3])

    spread = np.sin(np.arange(50)).std()
    for amplitude, wanted in ((0.0, 0.05), (0.4, 1.5 * 0.4 * spread), (5.0, 1.0)):
        np.testing.assert_allclose(velocity_std(amplitude), wanted, rtol=1e-9)
        slope = 0 if amplitude != 0.4 else 1.5 * spread
        np.testing.assert_allclose(jax.grad(velocity_std)(amplitude), slope, rtol=1e-6)


def test_level_state_at_rest_takes_a_gyro_for_biased():
    """It does not turn what does not turn."""
    accel = np.tile([0.5, 1.0, 9.7], (50, 1))
    still, biased = (
        filtering.level_state(CONFIG, np.full((50, 3), bias), accel) for bias in (0.0, 0.05)
    )
    np.testing.assert_array_equal(still.rotation, biased.rotation)


@pytest.mark.parametrize("samples, gyro_std, accel_std", [(49, 0, 0), (50, 0.02, 0), (50, 0, 0.2)])
def test_level_state_takes_the_bias_of_a_second_on_a_table(samples, gyro_std, accel_std):
    """The mean of the gyro, and nothing of a shorter or a shaken rest."""
    rng, bias = np.random.default_rng(3), np.array([0.02, -0.01, 0.03])
    noise = rng.standard_normal((2, 50, 3))
    gyro, accel = bias + 0.002 * noise[0], [0, 0, 9.81] + 0.02 * noise[1]
    found = filtering.level_state(CONFIG, gyro, accel).gyro_bias
    np.testing.assert_allclose(found, gyro.mean(0), rtol=1e-12)
    np.testing.assert_allclose(found, rest_at_start(gyro, accel, CONFIG.dt).gyro_bias, rtol=1e-12)
    shaken = gyro + gyro_std * noise[0], accel + accel_std * noise[1]
    found = filtering.level_state(CONFIG, *(each[:samples] for each in shaken)).gyro_bias
    np.testing.assert_array_equal(found, 0)


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_level_state_refuses_accelerations_without_gravity(size):
    """Such as those of a sensor that does not run yet, or that are in units of gravity."""
    with pytest.raises(ValueError, match=rf"^accel: shows no gravity, its mean is {size:.2g} m/s²"):
        filtering.level_state(CONFIG, np.zeros((50, 3)), np.tile([0, 0, size], (50, 1)))


@pytest.mark.parametrize(
    "up", [[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0.3, -0.2, 0.9]]
)
def test_level_is_a_rotation_with_derivatives(up):
    up = np.asarray(up, float)
    rotation = np.asarray(jax.jit(geometry.level)(up))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rotation @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
    assert np.linalg.det(rotation) > 0
    if abs(up[0]) < 0.99:
        np.testing.assert_allclose(np.arctan2(rotation[1, 0], rotation[0, 0]), 0, atol=1e-12)
    assert np.isfinite(slope_of_level(up)).all()


def test_orthonormalize_is_the_nearest_rotation():
    rng = np.random.default_rng(2)
    R = Rotation.random(rng=rng).as_matrix() + 1e-5 * rng.standard_normal((3, 3))
    u, _, vt = np.linalg.svd(R)
    np.testing.assert_allclose(jax.jit(geometry.orthonormalize)(R), u @ vt, atol=1e-9)


def spoilt(name):
    _, gyro, accel, d, c = WALK
    given = dict(
        state=start(),
        gyro=gyro.copy(),
        accel=accel.copy(),
        displacement=d,
        covariance=c.copy(),
        config=CONFIG,
        noise=NOISE,
    )
    if name == "gyro":
        given["gyro"][7, 1] = np.nan
    elif name == "accel":
        given["accel"][9] = np.inf
    elif name == "covariance":
        given["covariance"][10] = -np.eye(3)
    elif name == "covariance skew":
        given["covariance"][10, 0, 1] += 1.0
    elif name == "imu_valid":
        given["imu_valid"] = np.ones(len(gyro), int)
    elif name == "imu_valid length":
        given["imu_valid"] = np.ones(3, bool)
    elif name == "state.core_covariance":
        given["state"] = start()._replace(core_covariance=start().core_covariance - jnp.eye(21))
    elif name == "state.rotation":
        given["state"] = start()._replace(rotation=2 * jnp.eye(3))
    elif name == "state.velocity":
        given["state"] = start()._replace(velocity=jnp.full(3, jnp.nan))
    elif name == "state: was made":
        given["config"] = filtering.FilterConfig(DT, N, CLONES, jacobians="first")
    elif name == "noise.accel_density":
        given["noise"] = NOISE._replace(accel_density=-1.0)
    elif name == "noise.gyro_bias_walk":
        given["noise"] = NOISE._replace(gyro_bias_walk=np.nan)
    return given


@pytest.mark.parametrize(
    "name",
    [
        "gyro",
        "accel",
        "covariance",
        "covariance skew",
        "imu_valid",
        "imu_valid length",
        "state.core_covariance",
        "state.rotation",
        "state.velocity",
        "state: was made",
        "noise.accel_density",
        "noise.gyro_bias_walk",
    ],
)
def test_impossible_values_are_refused_by_name(name):
    with pytest.raises(ValueError, match=f"^{name.split(' skew')[0].split(' length')[0]}"):
        filtering.run_filter(**spoilt(name))


@pytest.mark.parametrize(
    "field,value",
    [
        ("velocity", np.nan),
        ("position", np.inf),
        ("gyro_bias", np.nan),
        ("rotation", 2 * np.eye(3)),
        ("std.tilt", -1.0),
        ("std.yaw", np.nan),
    ],
)
def test_an_impossible_start_is_refused_by_name(field, value):
    given = dict(
        rotation=np.eye(3), velocity=np.zeros(3), position=np.zeros(3), gyro_bias=np.zeros(3)
    )
    if field.startswith("std."):
        given["std"] = filtering.InitialStd(**{field[4:]: value})
    else:
        given[field] = given[field] + value if field != "rotation" else value
    with pytest.raises(ValueError, match=f"^{field}:"):
        filtering.initial_state(CONFIG, **given)


@pytest.mark.parametrize("name", ["gyro", "covariance"])
def test_inside_jit_the_history_says_so(name):
    given = spoilt(name)
    config, rest = given.pop("config"), given
    _, history = jax.jit(lambda given: filtering.run_filter(config=config, **given))(rest)
    healthy = np.asarray(history.healthy)
    bad = 1 if name == "gyro" else 10
    assert (healthy[:bad] == 1).all() and (healthy[bad:] == 0).all()


def test_log_likelihood_is_that_of_the_innovation():
    (R, v, p), gyro, accel, d, c = WALK
    _, history = run()
    noise = filtering.NoiseModel()
    wanted = scekf_numpy.run(
        gyro,
        accel,
        d,
        c,
        R,
        v,
        p,
        dt=DT,
        n=N,
        clones=CLONES,
        sigma_gyro=noise.gyro_density / np.sqrt(DT),
        sigma_accel=noise.accel_density / np.sqrt(DT),
        scale=2.0,
    )
    found = np.asarray(history.log_likelihood)
    assert np.isnan(found[:CLONES]).all()
    for k in range(CLONES, INTERVALS):
        expected = multivariate_normal.logpdf(
            wanted["innovation"][k], cov=wanted["innovation_covariance"][k]
        )
        np.testing.assert_allclose(found[k], expected, rtol=1e-7)
