"""What a stream may bring: holes, knocks, wrong units; and what the filter says of itself."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gnio_jax import filtering
from gnio_jax.filtering import Tracker
from gnio_jax.filtering.checks import checked_inputs
from gnio_jax.filtering.displacement import Displacement
from gnio_jax.filtering.state import OFFSET
from gnio_jax.filtering.update import Step
from gnio_jax.types import Prediction
from tests.support.compiling import quick
from tests.support.measured import NO_IMU
from tests.support.random_walk import random_walk

N, CLONES, DT = 4, 4, 0.02
CONFIG = filtering.FilterConfig(DT, N, CLONES, convergence_seconds=0.6, success_seconds=0.35)
"""A window is 0.32 s, and so a knock spoils no more than 0.35 s; a gap takes longer."""
NOISE = filtering.NoiseModel(2e-3, 2e-2, measurement_scale=2.0)
HIT = slice(180, 184)
"""Samples of the knock."""


def start():
    return filtering.initial_state(CONFIG, np.eye(3), np.array([1.0, 0.0, 0.0]), np.zeros(3))


def predict(windows):
    """1 m/s, and 40 m where there is a knock."""
    leap = jnp.where(jnp.max(jnp.abs(windows)) > 50, 40.0, 0.0).astype(jnp.float32)
    said = jnp.asarray([[N * CLONES * DT, 0.0, 0.0]], jnp.float32) + 0.01 * (
        jnp.mean(windows, axis=1)[:, :3] - jnp.asarray([[0, 0, 9.81]])
    )
    return Prediction((said + leap).astype(jnp.float32), jnp.full((1, 3), -4.0, jnp.float32))


@functools.cache
def recording(knock=60.0):
    """Straight on at 1 m/s, and a knock of so many m/s²."""
    rng = np.random.default_rng(0)
    gyro, accel = (
        0.01 * rng.standard_normal((280, 3)),
        [0.0, 0.0, 9.81] + 0.1 * rng.standard_normal((280, 3)),
    )
    accel[HIT] += [knock, 0.0, 0.0]
    return gyro, accel


@functools.cache
def program():
    return quick(
        lambda state, gyro, accel, valid: filtering.run_odometry(
            predict, state, gyro, accel, CONFIG, NOISE, valid
        )
    )


def run(gyro, accel, valid=None, state=None):
    final, history = program()(
        start() if state is None else state,
        gyro,
        accel,
        np.ones(len(gyro), bool) if valid is None else valid,
    )
    return final, history, np.linalg.norm(history.velocity, axis=1)


def intervals_of(samples):
    """Clone intervals whose windows reach one of the samples."""
    return np.unique([samples.start // N + i for i in range(CLONES)])


# The gate's memory --------------------------------------------------------------------------------


def test_a_gap_does_not_open_the_gate_for_the_knock_after_it():
    """0.8 s are missing, then comes a knock of 60 m/s²: 4.8 m/s by itself, 40 m to the network."""
    gyro, accel = recording()
    valid = ~np.isin(np.arange(len(gyro)), range(130, 170))
    _, history, speed = run(gyro, accel, valid)
    gate, nis = np.asarray(history.gate_passed), np.asarray(history.nis)
    first = np.flatnonzero(np.isnan(gate[CLONES:]))[-1] + CLONES + 1
    assert first in intervals_of(HIT)  # no measurement comes between gap and knock
    assert (nis[first] > 1000) and (gate[first : intervals_of(HIT)[-1] + 1] == 0).all()
    assert speed.max() < 8.0  # 194 where the gap opens the gate


def test_a_state_that_is_carried_on_keeps_its_gate():
    """The second run has no window in its first intervals, and a knock in its first window."""
    state, history, _ = run(*recording(0.0))
    assert history.gate_passed[-1] == 1 and bool(state.gate.converged)
    knock = slice(12, 16)
    gyro, accel = (np.roll(signal, knock.start - HIT.start, axis=0) for signal in recording())
    _, history, speed = run(gyro, accel, state=state)
    hit = [k for k in intervals_of(knock) if k >= CLONES]
    assert len(hit) == 3 and (np.asarray(history.nis)[hit] > 1000).all()
    np.testing.assert_array_equal(np.asarray(history.gate_passed)[hit], 0)
    assert speed.max() < 8.0


# Health -------------------------------------------------------------------------------------------


def leap():
    """The recording with a leap to some 140 m/s and back, long before its end."""
    gyro, accel = recording(0.0)
    accel = accel.copy()
    accel[98:106] += [900.0, 0, 0]
    accel[106:114] -= [900.0, 0, 0]
    return gyro, accel


def test_unhealthy_once_is_unhealthy_for_good():
    gyro, accel = leap()
    final, history, speed = run(gyro, accel)
    plausible = speed <= CONFIG.speed_limit
    bad = int(np.argmin(plausible))
    assert (
        bad == 100 // N and plausible[-1] and np.isfinite(speed).all()
    )  # it comes back, so nothing but memory can tell
    np.testing.assert_array_equal(history.healthy, np.arange(len(speed)) < bad)
    assert not final.healthy
    _, history, speed = run(*recording(0.0), state=final)
    assert (speed <= CONFIG.speed_limit).all() and (np.asarray(history.healthy) == 0).all()
    state, history, _ = run(*recording(0.0))
    assert bool(state.healthy) and (np.asarray(history.healthy) == 1).all()


def test_online_too():
    gyro, accel = leap()
    _, history, _ = run(gyro, accel)
    tracker = Tracker(predict, CONFIG, NOISE, start())
    found = [tracker.push(k * DT, gyro[k], accel[k]) for k in range(len(gyro))]
    np.testing.assert_array_equal(
        [pose.healthy for pose in found if pose is not None], np.asarray(history.healthy) > 0
    )
    assert tracker.pose().healthy is False and not tracker.filter_state().healthy
    tracker._start(tracker.filter_state())  # another one, from what this one left
    assert tracker.pose().healthy is False


@pytest.mark.parametrize("name, largest, unit", [("gyro", 100, "rad/s"), ("accel", 1000, "m/s²")])
def test_what_no_imu_measures_is_refused(name, largest, unit):
    """By a run, in a sample that is there, and by a tracker, which goes on without it."""
    signals = {"gyro": recording(0.0)[0].copy(), "accel": recording(0.0)[1].copy()}
    signals[name][57, 1] = -1.01 * largest
    words = rf"^{name}: is beyond {largest} {unit} in 1 of 280 rows, the first is row 57"
    there = np.arange(280) != 57
    for valid in (None, ~there):
        with pytest.raises(ValueError, match=words):
            filtering.run_odometry(predict, start(), *signals.values(), CONFIG, NOISE, valid)
    checked_inputs(
        start(), *signals.values(), there, (), CONFIG, NOISE
    )  # what is missing may be so
    _, history, _ = run(*signals.values(), there)
    tracker, poses = Tracker(predict, CONFIG, NOISE, start()), []
    for k, row in enumerate(zip(*signals.values(), strict=True)):
        if k == 57:
            words = rf"^{name}: no IMU measures more than {largest} {unit}, found"
            with pytest.raises(ValueError, match=words):
                tracker.push(k * DT, *row)
        elif (pose := tracker.push(k * DT, *row)) is not None:
            poses.append(pose)
    np.testing.assert_allclose([pose.position for pose in poses], history.position, atol=1e-9)


# Any input ----------------------------------------------------------------------------------------

ROWS = 60
PLAIN = filtering.FilterConfig(DT, 5, 4, convergence_seconds=1.0, rest_seconds=0.2)
CONFIGS = [
    dataclasses.replace(PLAIN, zero_velocity_std=0.02),
    PLAIN,
    dataclasses.replace(PLAIN, allow_float32=True),
    dataclasses.replace(PLAIN, zero_velocity_std=0.02, allow_float32=True),
]
WALK = random_walk(21, n=5, clones=4, intervals=ROWS, dt=DT, bias=False)
FILTER = quick(filtering.run_filter, static_argnums=5)


def disturbed(
    config,
    gap=(0, 0),
    knock=(0, 0),
    size=(0.0, 0.0, 0.0),
    leap=(0, 0),
    away=0.0,
    missing=True,
    units=(1.0, 1.0, 1.0),
    still=0,
):
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
    state = filtering.initial_state(config, *(part.astype(dtype) for part in begin))
    signals = [
        (signal * unit).astype(dtype)
        for signal, unit in zip((gyro, accel, displacement), units, strict=True)
    ]
    final, history = FILTER(
        state,
        *signals,
        covariance.astype(dtype),
        config,
        filtering.NoiseModel(2e-3, 2e-2, measurement_scale=2.0),
        valid,
    )
    return final, history, np.linalg.norm(np.asarray(history.velocity, np.float64), axis=1)


def span(end, longest):
    return st.tuples(st.integers(0, end - 1), st.integers(0, longest))


def runs(**more):
    return given(
        config=st.sampled_from(CONFIGS),
        gap=span(5 * ROWS, 80),
        knock=span(5 * ROWS, 4),
        size=st.tuples(*3 * [st.floats(-100, 100)]),
        leap=span(ROWS, 4),
        away=st.floats(0, 100),
        missing=st.booleans(),
        still=st.integers(0, 200),
        **more,
    )


RUN_AWAY = dict(
    config=CONFIGS[0],
    gap=(88, 15),
    knock=(36, 3),
    size=(15.6, 15.6, 15.6),
    leap=(20, 3),
    away=84.0,
    missing=True,
    still=0,
)
"""A gap, a knock and displacements that are wrong by 84 m."""


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@example(**RUN_AWAY)
@example(**{**RUN_AWAY, "config": CONFIGS[2]})
@runs()
def test_errors_do_not_feed_themselves(**disturbances):
    """What is put in is up to 100 m wrong in a window of 0.4 s; what comes out is of that order."""
    _, history, speed = disturbed(**disturbances)
    assert np.isfinite(speed).all() and speed.max() < 5000, speed.max()
    said(history, speed)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@example(**RUN_AWAY, units=(1.0, 1.0, 1e30))
@runs(units=st.tuples(*3 * [st.sampled_from([1.0, 1.0, 1e-3, 9.81, 1 / 9.81, 57.3, 1e3, 1e30])]))
def test_what_is_implausible_is_never_called_healthy(**disturbances):
    final, history, speed = disturbed(**disturbances)
    said(history, speed)
    assert bool(final.healthy) == (history.healthy[-1] == 1)


def said(history, speed):
    plausible = np.isfinite(speed) & (speed <= 100.0)
    healthy = np.asarray(history.healthy) == 1
    assert not healthy[~plausible].any()
    np.testing.assert_array_equal(healthy, np.logical_and.accumulate(healthy))


@pytest.mark.parametrize(
    "options, converged, accepted, corrected",
    [
        (dict(), True, False, False),
        (dict(), False, True, True),
        (dict(mahalanobis_fail_scale=2.0), True, True, True),
        (dict(mahalanobis_fail_scale=1e6), True, True, False),
        (dict(gate_softness=1.0), False, True, True),
        (dict(gate_softness=1.0), True, True, False),
    ],
    ids=["rejected", "gate open", "scaled", "scaled away", "weighted 1", "weighted 1e-6"],
)
def test_a_displacement_corrects_as_much_as_the_gate_lets_it(
    options, converged, accepted, corrected
):
    """Five metres of which the filter takes all, half, or nothing to speak of."""
    config = dataclasses.replace(PLAIN, convergence_seconds=10.0, **options)
    state = filtering.initial_state(config, *WALK[0])
    known = state.core_covariance.at[OFFSET, OFFSET].set(0.01 * jnp.eye(3))
    state = state._replace(core_covariance=known)
    gate = filtering.GateState(jnp.bool_(converged), jnp.int32(95), jnp.int32(0))
    state = state._replace(step=jnp.int32(20), gate=gate)
    measurement = Displacement(
        jnp.array([3.0, -4.0, 0.0]), 0.01 * jnp.eye(3), jnp.bool_(True), "given"
    )
    step = Step(NO_IMU, 0, 1, config, NOISE)
    _, outcome, made = measurement.update(state, step)
    assert float(outcome.nis) > 50 and bool(outcome.accepted) == accepted
    moved = float(jnp.linalg.norm((made.residual @ made.core)[OFFSET]))
    assert bool(outcome.tested) and (moved > 1.0 if corrected else moved < 0.01)
