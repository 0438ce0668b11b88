"""The velocity at rest as a measurement."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering.gaps import Gap, Imu
from gnio_jax.filtering.state import additive_errors
from gnio_jax.filtering.zero_velocity import ZeroVelocity, detect_rest

N, CLONES, DT, INTERVALS = 5, 4, 0.02, 60
CONFIG = filtering.FilterConfig(DT, N, CLONES, rest_seconds=0.3, convergence_seconds=1.0)
NOISE = filtering.NoiseModel(measurement_scale=2.0)


STILL = Imu(jnp.zeros((N, 3)), jnp.tile(jnp.array([[0.0, 0.0, 9.81]]), (N, 1)), None)


@functools.partial(jax.jit, static_argnums=2)
def at_rest(state, tried, test_seconds):
    """The state after an interval at rest, and what became of that measurement."""
    settings = dict(rest_seconds=0.0, rest_test_seconds=test_seconds, convergence_seconds=10.0)
    config = dataclasses.replace(CONFIG, **settings)
    scalar, no = jnp.zeros(()), jnp.bool_(False)
    displacement = filtering.Outcome(tried, tried, jnp.zeros(3), scalar, scalar, scalar, no)
    step = filtering.Step(
        STILL, 0, 1, config, filtering.NoiseModel(), {"displacement": displacement}
    )
    new, outcome, _ = ZeroVelocity(0.05).update(state, step)
    return new, outcome


def run(rotation, velocity, gyro, accel, displacement):
    """With no more certainty of the start than a twentieth of a metre a second."""
    std, zero_velocity = filtering.InitialStd(velocity=0.05), filtering.ZeroVelocity(0.02)
    ekf = filtering.Filter(CONFIG, NOISE, std, measurements=(zero_velocity,))
    spread = np.tile(0.02**2 * np.eye(3), (INTERVALS, 1, 1))
    state = filtering.initial_state(ekf, rotation, velocity, np.zeros(3))
    return filtering.run_filter(ekf, state, gyro, accel, displacement, spread)[1]


@pytest.mark.parametrize("seconds, intervals", [(0.0, 1), (0.1, 1), (0.11, 2), (0.3, 3), (0.35, 4)])
def test_rest_counts_only_after_its_time(seconds, intervals):
    """Intervals of 0.1 s: as many as `rest_seconds` needs, and anew after each that is not quiet,
    in one of three ways."""
    config = dataclasses.replace(CONFIG, rest_seconds=seconds)
    turning = STILL._replace(gyro=STILL.gyro.at[2, 1].set(1.01 * config.rest_gyro))
    shaken = STILL._replace(accel=STILL.accel.at[3, 2].add(-1.01 * config.rest_accel))
    held = STILL._replace(gap=Gap(*jnp.zeros((2, N)), jnp.ones(N), jnp.arange(N) == N - 1))
    state = filtering.initial_state(filtering.Filter(config), np.eye(3), np.zeros(3), np.zeros(3))
    decisions, expected, count = [], [], 0
    for imu in [*5 * [STILL], turning, *5 * [STILL], shaken, *5 * [STILL], held, *5 * [STILL]]:
        state, quiet = detect_rest(state, imu, config)
        count = count + 1 if imu is STILL else 0
        decisions.append(bool(quiet))
        expected.append(count >= intervals)
    assert decisions == expected and sum(decisions) == 4 * (6 - intervals)


def test_a_shaken_imu_is_quiet_by_its_means_unless_it_turns():
    """An engine: every sample is beyond both bounds, with changing signs. A mean beyond either of
    them is no rest."""
    signs = jnp.array([1.0, -1.0, 0.0, 1.0, -1.0])[:, None]
    shaken = STILL._replace(
        gyro=signs * jnp.array([[0.0, 0.2, -0.1]]),
        accel=STILL.accel + signs * jnp.array([[0.0, 0.0, 2.0]]),
    )
    turning = shaken._replace(gyro=shaken.gyro + jnp.array([[0.0, 0.0, 0.051]]))
    braking = shaken._replace(accel=shaken.accel - jnp.array([[0.0, 0.0, 0.31]]))
    slow = shaken._replace(gyro=shaken.gyro + jnp.array([[0.0, 0.0, 0.049]]))
    state = filtering.initial_state(filtering.Filter(CONFIG), np.eye(3), np.zeros(3), np.zeros(3))
    for by, expected in (("samples", [False] * 4), ("means", [True, False, False, True])):
        config = dataclasses.replace(CONFIG, rest_seconds=0.0, rest_by=by)
        quiet = [detect_rest(state, imu, config)[1] for imu in (shaken, turning, braking, slow)]
        assert [bool(flag) for flag in quiet] == expected


def test_rest_is_seen_without_the_biases():
    """Which are larger than the bounds of rest; and not with them."""
    gyro_bias, accel_bias = 2 * CONFIG.rest_gyro, 2 * CONFIG.rest_accel
    biases = np.array([gyro_bias, 0.0, 0.0]), np.array([0.0, 0.0, accel_bias])
    config = dataclasses.replace(CONFIG, rest_seconds=0.0)
    biased = STILL._replace(gyro=STILL.gyro + biases[0][None], accel=STILL.accel + biases[1][None])
    for gyro, accel, imu, quiet in (
        (*biases, biased, True),
        (0.0, biases[1], biased, False),
        (biases[0], 0.0, biased, False),
        (0.0, biases[1], STILL, False),
    ):
        state = filtering.initial_state(
            filtering.Filter(config), np.eye(3), np.zeros(3), np.zeros(3), gyro, accel
        )
        assert bool(detect_rest(state, imu, config)[1]) == quiet


def resting(
    now, converged=True, last_success=100, pause_end=0, tried=True, speed=1.0, test_seconds=0.0
):
    """The state before and after the IMU is quiet at sample `now`, with a velocity of `speed` known
    to 0.1 m/s per axis, and what the filter made of it. `tried`: there was a displacement, too."""
    std, velocity = filtering.InitialStd(velocity=0.1), speed * np.array([0.6, 0.0, -0.8])
    state = filtering.initial_state(
        filtering.Filter(CONFIG, start=std), np.eye(3), velocity, np.zeros(3)
    )
    gate = filtering.GateState(jnp.bool_(converged), jnp.int32(last_success), jnp.int32(pause_end))
    state = state._replace(gate=gate, step=jnp.int32(now // N))
    new, outcome = at_rest(state, np.bool_(tried), test_seconds)
    return state, new, outcome


@pytest.mark.parametrize(
    "seconds, test_seconds, refused",
    [
        *((0.3, 0.0, 0), (0.3, 0.05, 1), (0.3, 0.1, 1), (0.3, 0.3, 3), (0.3, 0.35, 4)),
        *((0.0, 0.1, 1), (0.0, 0.3, 3), (0.05, 0.05, 1), (0.25, 0.05, 1)),
    ],
)
def test_a_young_rest_at_a_speed_that_the_filter_knows_is_refused(seconds, test_seconds, refused):
    """Intervals of 0.1 s, at 11 m/s and without displacements: a smooth road. A rest that counts
    within an interval is tested as long as one that counts later. As slow as the filter's
    uncertainty, every rest is taken, and so is one beside a displacement while the gate is open."""
    config = dataclasses.replace(CONFIG, rest_seconds=seconds, rest_test_seconds=test_seconds)
    waiting = {0.0: 0, 0.05: 0, 0.25: 2, 0.3: 2}[seconds]
    no, nothing = jnp.bool_(False), jnp.zeros(())
    ekf = filtering.Filter(config, start=filtering.InitialStd(velocity=0.1))

    @jax.jit
    def update(state, presence):
        displacement = filtering.Outcome(
            presence, presence, jnp.zeros(3), nothing, nothing, nothing, no
        )
        step = filtering.Step(
            STILL, 0, 1, config, filtering.NoiseModel(), {"displacement": displacement}
        )
        return ZeroVelocity(0.05).update(state, step)[:2]

    for speed, presence, count in ((11.0, False, refused), (0.1, False, 0), (11.0, True, 0)):
        state = filtering.initial_state(ekf, np.eye(3), np.array([speed, 0, 0]), np.zeros(3))
        accepted, present = [], []
        for _ in range(8):
            state, outcome = update(state, np.bool_(presence))
            accepted.append(bool(outcome.accepted))
            present.append(bool(outcome.present))
        assert present == [False] * waiting + [True] * (8 - waiting)
        assert accepted == [False] * (waiting + count) + [True] * (8 - waiting - count)
        np.testing.assert_allclose(state.velocity, 0, atol=0.2 * speed)


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
        (dict(now=110, tried=False, test_seconds=1.0), 1.001 * EDGE, False),
        (dict(now=110, converged=False, test_seconds=1.0), 3.0, True),
        (dict(now=110, test_seconds=1.0), 1.001 * EDGE, False),
    ],
)
def test_rest_passes_a_chi_square_test_where_the_gate_is_active(gate, speed, accepted):
    state, new, outcome = resting(speed=speed, **gate)
    np.testing.assert_allclose(outcome.nis, speed**2 / (0.1**2 + 0.05**2), rtol=1e-12)
    assert bool(outcome.accepted) == accepted and bool(outcome.present)
    jax.tree.map(np.testing.assert_array_equal, new.gate, state.gate)
    expected_velocity = np.asarray(state.velocity) * (
        0.05**2 / (0.1**2 + 0.05**2) if accepted else 1.0
    )
    np.testing.assert_allclose(new.velocity, expected_velocity, rtol=1e-12)
    variance = 1 / (1 / 0.1**2 + accepted / 0.05**2)
    diagonal = np.diag(additive_errors(new).core_covariance)
    np.testing.assert_allclose(diagonal[3:6], variance, rtol=1e-12)


def test_a_quiet_ride_is_no_rest_and_a_wrong_start_is_corrected_by_rest():
    """A carriage that glides at 1 m/s, as the filter knows by displacements; and a device at rest
    that starts with 3 m/s, so sure of it that it would not pass the test."""
    gliding, samples = 30, N * INTERVALS
    gyro, still = np.zeros((samples, 3)), np.tile([0, 0, 9.81], (samples, 1))
    rattling = still.copy()
    rattling[: N * gliding, 2] += np.where(np.arange(N * gliding) % 2, -1.0, 1.0)
    moved = np.tile([CLONES * N * DT, 0.0, 0.0], (INTERVALS, 1))
    history = run(np.eye(3), np.array([1.0, 0.0, 0.0]), gyro, rattling, moved)
    quiet = np.arange(INTERVALS) >= gliding + 2
    outcome = history.outcomes["zero_velocity"]
    np.testing.assert_array_equal(outcome.present, quiet)
    np.testing.assert_array_equal(outcome.residual[~quiet], 0)
    assert (np.asarray(outcome.nis)[quiet] > 100).all() and not np.any(outcome.accepted)
    np.testing.assert_allclose(history.velocity[:, 0], 1.0, atol=0.02)

    wrong = np.array([3.0, 0.0, 0.0])
    history = run(np.eye(3), wrong, gyro, still, np.full((INTERVALS, 3), np.nan))
    outcome = history.outcomes["zero_velocity"]
    assert outcome.nis[2] > 1000 and np.asarray(outcome.accepted)[2:].all()
    assert np.abs(history.velocity[2:, 0]).max() < 0.5 and abs(history.velocity[-1, 0]) < 0.02
