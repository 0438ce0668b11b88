"""The tracker against `run_odometry`'s scan, its poses between clones against a plain NumPy filter,
with a faster IMU against the batch path."""

import dataclasses
import functools
import runpy
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering, geometry, networks
from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.data.resampling import resample
from gnio_jax.data.simulated import walks as simulated
from gnio_jax.filtering import Tracker, measurements
from gnio_jax.filtering import tracker as online
from gnio_jax.filtering.state import Mean, with_correlated_errors
from gnio_jax.types import Prediction
from tests.support import scekf_numpy, tiny_run
from tests.support.checks import checked_at_first

N, CLONES, INTERVALS, DT = 4, 4, 70, 0.02
CONFIG = filtering.FilterConfig(
    DT,
    N,
    CLONES,
    context_samples=6,
    convergence_seconds=0.6,
    bridge_seconds=0.05,
    rest_seconds=0.3,
)
AS_TLIO = dataclasses.replace(CONFIG, window_rotation="tlio", context_samples=0)
NOISE = filtering.NoiseModel(
    2e-3, 2e-2, measurement_scale=2.0, correlation=filtering.CorrelatedError(0.5, 0.3)
)
WEIGHTS = np.random.default_rng(5).standard_normal((6, 3)) * 0.02
HIT = slice(180, 184)
"""Samples of a knock that the network takes for a leap: its measurement is rejected."""


class Height(NamedTuple):
    """A user's own measurement: it is at the height 0, to `std` m, in every interval."""

    std: float
    name = "height"

    def update(self, state, step):
        residual = jnp.stack([-state.position[2]])
        spread = jnp.full((1, 1), self.std**2)
        linear = filtering.linearise(state, residual, spread, position=[[0.0, 0.0, 1.0]])
        return filtering.measure(state, linear, step)


CAR = filtering.NonHolonomic(2.0, 2.0, yaw=0.3, mounting_std=0.05, lever_std=0.5)
MEASUREMENTS = filtering.ZeroVelocity(0.02), CAR, Height(2.0)
"""One of each kind, each loose enough to be accepted."""


def filter_of(config=CONFIG, **parts):
    """As TLIO it measures the displacement alone."""
    kinds = () if config.window_rotation == "tlio" else MEASUREMENTS
    return filtering.Filter(config, NOISE, measurements=kinds, **parts)


def with_all_errors(state, config=CONFIG):
    """The state with the correlated errors of `filter_of`."""
    return with_correlated_errors(state, len(filter_of(config).correlation_times))


def predict(windows):
    ramp = jnp.linspace(0.5, 1.5, windows.shape[1], dtype=jnp.float32)[None, :, None]
    pooled = jnp.mean(ramp * windows, axis=1) @ jnp.asarray(WEIGHTS, jnp.float32)
    leap = jnp.where(jnp.max(jnp.abs(windows)) > 50, 40.0, 0.0).astype(jnp.float32)
    return Prediction(pooled + leap, -2.0 + 0.1 * pooled, {"gate": jnp.tanh(pooled)})


@functools.cache
def recording():
    rng = np.random.default_rng(0)
    t = np.arange(N * INTERVALS) * DT
    gyro = np.sin(t[:, None] * rng.uniform(2, 5, 3) + rng.uniform(0, 6, 3))
    accel = np.cos(t[:, None] * rng.uniform(2, 5, 3)) + np.array([0, 0, 9.81])
    gyro[200:], accel[200:] = [0.02, -0.01, 0.03], [0.1, 0.1, 9.91]
    accel[HIT] += [60.0, 0.0, 0.0]
    return gyro, accel


def start(config=CONFIG):
    rotation = Rotation.from_euler("xyz", [0.1, -0.2, 1.0]).as_matrix()
    velocity, position, gyro_bias = np.array(
        [[0.5, 0.0, 0.0], [3.0, -2.0, 1.0], [0.02, -0.01, 0.03]]
    )
    arguments = rotation, velocity, position, gyro_bias, 0.1
    return with_all_errors(filtering.initial_state(filtering.Filter(config), *arguments), config)


@functools.cache
def compiled(config=CONFIG):
    """One tracker a configuration, for its programs: compiling takes most of the time of these
    tests."""
    return Tracker(predict, filter_of(config), start(config))


@functools.cache
def program(config):
    config = dataclasses.replace(config, history="core")
    return jax.jit(lambda *inputs: filtering.run_odometry(predict, filter_of(config), *inputs))


def scan(state, gyro, accel, valid, config=CONFIG):
    """`run_odometry`, always over `INTERVALS`, so that it compiles once: what is added at the end
    changes nothing before it."""
    rows = N * INTERVALS - len(gyro)
    gyro, accel, valid = (
        np.concatenate([x, np.zeros((rows, *x.shape[1:]), x.dtype)]) for x in (gyro, accel, valid)
    )
    return program(config)(state, gyro, accel, valid)


@pytest.fixture
def built(monkeypatch):
    ready = compiled()._advance, compiled()._look_ahead
    monkeypatch.setattr(online, "compile_programs", lambda *_: ready)


@pytest.fixture
def tracker(built):
    return Tracker(predict, filter_of(), start())


def feed(tracker, gyro, accel, time):
    rows = checked_at_first(zip(time, gyro, accel, strict=True))
    return [pose for row in rows if (pose := tracker.push(*row)) is not None]


@pytest.mark.parametrize(
    "config, missing",
    [(CONFIG, (50, 51, *range(100, 105), *range(130, 170), 277)), (AS_TLIO, range(100, 104))],
    ids=["ours", "as TLIO cuts"],
)
def test_equals_run_odometry_with_every_measurement(config, missing):
    gyro, accel = recording()
    valid = ~np.isin(np.arange(len(gyro)), missing)
    state = start(config)
    final, history = scan(state, gyro, accel, valid, config)
    tracker = compiled(config)
    tracker._start(state)
    tracker.set_rate(1 / DT)  # a new stream
    time = 1.7e9 + np.arange(len(gyro)) * DT  # as a phone stamps them
    broken = np.where(valid[:, None], gyro, np.nan)
    pushed = [tracker.push(*row) for row in zip(time, broken, accel, strict=True)]
    poses = [pose for pose in pushed if pose is not None]
    assert len(poses) == INTERVALS
    ends = time[0] + np.arange(1, INTERVALS + 1) * N * DT
    np.testing.assert_allclose([p.time for p in poses], ends, atol=1e-6)
    for name in (*Mean._fields, "covariance", "accepted", "nis"):
        rows = np.array([getattr(pose, name) for pose in poses])
        np.testing.assert_allclose(rows, getattr(history, name), rtol=1e-9, atol=1e-9, err_msg=name)
    assert all(pose.healthy for pose in poses)
    assert (history.gate_passed == 0).any() and (history.gate_passed == 1).sum() > 20
    assert all(outcome.accepted.any() for outcome in history.outcomes.values())
    assert config is AS_TLIO or history.outcomes.keys() > set(measurements.names())
    assert np.isnan(np.asarray(history.nis)[config.first_measured :]).any()
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9),
        tracker.filter_state(),
        final,
    )
    jax.tree.map(np.asarray, state)  # the caller's own start is still his


def test_goes_on_from_a_state_that_a_run_left(tracker):
    """As a run from this state does, whose clones are held in another form inside a run."""
    gyro, accel = recording()
    everywhere = np.ones(len(gyro), bool)
    state, _ = scan(start(), gyro, accel, everywhere)
    assert np.abs(state.clone_covariance).max() > 0
    tracker._start(state)
    _, history = scan(state, gyro, accel, everywhere)
    poses = feed(tracker, gyro, accel, np.arange(len(gyro)) * DT)
    for name in (*Mean._fields, "covariance"):
        rows = np.array([getattr(pose, name) for pose in poses])
        np.testing.assert_allclose(rows, getattr(history, name), rtol=1e-9, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("config, last", [(CONFIG, 36), (AS_TLIO, 35)], ids=["ours", "TLIO's"])
def test_windows_with_a_long_hole_are_no_measurements(config, last):
    """Coasting are samples 122 … 127, in intervals 30 and 31: in the windows, with what is before
    them, that end with intervals 30 … `last`. The short hole is bridged."""
    gyro, accel = recording()
    valid = ~np.isin(np.arange(len(gyro)), [*range(120, 128), 170, 171])
    _, history = scan(start(config), gyro, accel, valid, config)
    missing = np.flatnonzero(np.isnan(np.asarray(history.accepted)))
    np.testing.assert_array_equal(missing, [*range(config.first_measured), *range(30, last + 1)])
    assert np.isfinite(history.position).all()


def test_unhealthy_once_is_unhealthy_for_good(tracker):
    """A knock to some 140 m/s and back: the filter comes back, so nothing but memory can tell."""
    gyro, accel = (signal.copy() for signal in recording())
    accel[98:106] += [900.0, 0, 0]
    accel[106:114] -= [900.0, 0, 0]
    final, history = scan(start(), gyro, accel, np.ones(len(gyro), bool))
    speed = np.linalg.norm(history.velocity, axis=1)
    bad = int(np.argmax(speed > CONFIG.speed_limit))
    assert 0 < bad < 30 and np.isfinite(speed).all()
    np.testing.assert_array_equal(history.healthy, np.arange(len(speed)) < bad)
    poses = feed(tracker, gyro, accel, np.arange(len(gyro)) * DT)
    np.testing.assert_array_equal([p.healthy for p in poses], np.asarray(history.healthy) > 0)
    assert not final.healthy and not tracker.filter_state().healthy
    tracker._start(tracker.filter_state())
    assert tracker.pose().healthy is False


def test_a_stop_of_the_stream_is_caught_up_in_one_push(tracker):
    gyro, accel = recording()
    time = np.arange(len(gyro)) * DT
    keep = ~np.isin(np.arange(len(gyro)), np.arange(90, 121))
    poses = feed(tracker, gyro[keep], accel[keep], time[keep])
    _, history = scan(start(), gyro, accel, keep)
    steps = [round(p.time / (N * DT)) - 1 for p in poses]
    # of those that one push made it returns the last
    assert set(range(INTERVALS)) - set(steps) == set(range(22, 29))
    expected = history.position[np.array(steps)]
    np.testing.assert_allclose([p.position for p in poses], expected, atol=1e-9)


def test_between_clones_it_integrates_the_imu(tracker):
    gyro, accel = recording()
    state = start()
    assert np.isnan(tracker.pose().time) and np.array_equal(tracker.pose().position, state.position)
    for m in range(1, N):
        assert tracker.push(m * DT, gyro[m], accel[m]) is None
        pose = tracker.pose()
        samples, none = slice(1, m + 1), (np.full((1, 3), np.nan), np.zeros((1, 3, 3)))
        reference = scekf_numpy.run_from(
            state, NOISE, CONFIG, gyro[samples], accel[samples], *none, n=m, clones=9
        )
        assert pose.time == pytest.approx((m + 1) * DT)
        for name in ("rotation", "velocity", "position", "covariance"):
            np.testing.assert_allclose(
                getattr(pose, name), reference[name][0], atol=1e-12, rtol=1e-9, err_msg=name
            )
    # and from clones in the middle of the run on, with updates behind them, whether it is asked at
    # every sample or only now and then
    clone_pose = tracker.push(N * DT, gyro[N], accel[N])
    for k in range(N + 1, 120):
        mean = (
            [clone_pose.rotation, clone_pose.velocity, clone_pose.position]
            if (k - 1) % N == 0
            else mean
        )
        mean = scekf_numpy.step_mean(
            *mean, clone_pose.gyro_bias, clone_pose.accel_bias, gyro[k], accel[k], DT
        )
        after = tracker.push(k * DT, gyro[k], accel[k])
        assert (after is not None) == (k % N == 0)
        if after is not None:
            clone_pose = after
            jax.tree.map(np.testing.assert_array_equal, tracker.pose(), clone_pose)
        elif k % 3:
            pose = tracker.pose()
            for name, value in zip(("rotation", "velocity", "position"), mean, strict=True):
                np.testing.assert_allclose(getattr(pose, name), value, atol=1e-11, err_msg=name)
            assert pose.time == pytest.approx(k * DT + DT)
            np.testing.assert_array_equal(
                [pose.accepted, pose.nis], [clone_pose.accepted, clone_pose.nis]
            )
    assert clone_pose.accepted == 1


def test_between_clones_it_coasts_through_a_gap(tracker):
    gyro, accel = recording()
    for k in range(N):
        clone_pose = tracker.push(k * DT, gyro[k], accel[k])
    bias = np.asarray(clone_pose.gyro_bias), np.asarray(clone_pose.accel_bias)
    # grid samples 4, 5, 6 are missing; two are bridged, the third is not
    tracker.push((N + 2) * DT, gyro[5], np.full(3, np.nan))
    pose = tracker.pose()
    mean = [clone_pose.rotation, clone_pose.velocity, clone_pose.position]
    for _ in range(2):
        mean = scekf_numpy.step_mean(*mean, *bias, gyro[N - 1], accel[N - 1], DT)
    mean = [*mean[:2], mean[2] + mean[1] * DT]
    for name, value in zip(("rotation", "velocity", "position"), mean, strict=True):
        np.testing.assert_allclose(getattr(pose, name), value, atol=1e-12, err_msg=name)
    assert (np.diag(pose.covariance)[:9] > np.diag(clone_pose.covariance)[:9] * 1.0001).all()
    assert pose.time == pytest.approx((N + 3) * DT)


def test_mistakes_change_nothing(tracker):
    """Neither now nor for the samples that come after them."""
    time, (gyro, accel), zeros = 0.9 + np.arange(20) * DT, recording(), np.zeros(3)
    other = Tracker(predict, filter_of(), start())
    for instance in (tracker, other):
        feed(instance, gyro[:6], accel[:6], time[:6])
    for arguments, words in (
        ((1.0, zeros, zeros), r"^time: must increase, found 1\.0 after 1\.0"),
        ((float("nan"), zeros, zeros), r"^time: must be a finite number"),
        (("soon", zeros, zeros), r"^time: must be a finite number"),
        ((1020.0, zeros, zeros), r"^time: .* more than 60 s; stamps must be"),
        ((1.1, np.zeros(4), zeros), r"^gyro: must be three numbers"),
        ((1.1, zeros, "up"), r"^accel: must be three numbers"),
        ((1.1, np.full(3, 1e6), zeros), r"^gyro: no IMU measures more than 100 rad/s"),
    ):
        with pytest.raises(ValueError, match=words):
            tracker.push(*arguments)
    jax.tree.map(np.testing.assert_array_equal, tracker.pose(), other.pose())
    after = [feed(instance, gyro[6:20], accel[6:20], time[6:]) for instance in (tracker, other)]
    assert len(after[0]) == 4
    jax.tree.map(np.testing.assert_array_equal, *after)


def test_a_stamp_that_leaps_is_believed_once_a_second_one_agrees(tracker):
    """One stamp in the future costs its sample, a stop of the stream none, and of stamps that leap
    apart none is believed: the old clock goes on."""
    gyro, accel = recording()
    wrong, keep, leap, time = 100, 120, 59.0, np.arange(len(gyro)) * DT
    alone = np.where(np.arange(len(gyro)) == wrong, time + leap, time)
    poses = feed(tracker, gyro, accel, alone)
    _, history = scan(start(), gyro, accel, np.arange(len(gyro)) != wrong)
    assert len(poses) == INTERVALS
    np.testing.assert_allclose([p.position for p in poses], history.position, atol=1e-9)

    stopped = Tracker(predict, filter_of(), start())
    feed(stopped, gyro[:keep], accel[:keep], time[:keep])
    for stamp in (20.0, 40.0, 5.0, 30.0):
        assert stopped.push(stamp, gyro[keep], accel[keep]) is None
    assert stopped.push(time[keep] + leap, gyro[keep], accel[keep]) is None
    assert stopped.pose().time == pytest.approx(keep * DT)
    pose = stopped.push(time[keep + 1] + leap, gyro[keep + 1], accel[keep + 1])
    samples = keep + round(leap / DT) + 2
    assert pose.time == pytest.approx(samples // N * N * DT)
    assert stopped.pose().time == pytest.approx(samples * DT)


def test_mistakes_at_the_start():
    arguments = {"predict": predict, "ekf": filter_of(), "state": start()}
    spoilt = filtering.Filter(CONFIG, NOISE._replace(gyro_density=-1.0))
    longer = filtering.Filter(dataclasses.replace(CONFIG, clones_per_window=5), NOISE)
    for change, words in (
        (dict(hole=0.001), r"hole: must be a number of at least"),
        (dict(imu_rate=0.0), r"imu_rate: must be a number"),
        (dict(imu_rate=float("nan")), r"imu_rate: must be a number"),
        (dict(ekf=spoilt), r"ekf\.noise\.gyro_density"),
        (dict(predict=lambda windows: windows), r"predict: "),
        (dict(ekf=longer), r"state"),
        (dict(state=None, rest_seconds=0.01), r"rest_seconds: "),
        (
            dict(state=None, ekf=filter_of(start=filtering.InitialStd(tilt=-1.0))),
            r"ekf\.start\.tilt",
        ),
    ):
        with pytest.raises(ValueError, match=f"^{words}"):
            Tracker(**arguments | change)


def resting():
    """The last 80 samples of the recording, at rest, and then its first ones."""
    return (np.concatenate([signal[-80:], signal[: 10 - 80]]) for signal in recording())


@pytest.mark.parametrize("lost", ["missing", "without acceleration"])
def test_from_rest(built, lost):
    """The first 0.9 s without a long hole make the state, and are filtered from their first sample
    on. A sensor that does not run yet reads zero."""
    gyro, accel = resting()
    time = 7.0 + np.arange(len(gyro)) * DT
    # 45 samples: no whole number of intervals
    tracker = Tracker(predict, filter_of(), rest_seconds=0.9)
    assert tracker.pose() is None and tracker.filter_state() is None
    first, signals = 10, (gyro[:40].copy(), accel[:40].copy())
    if lost == "missing":
        signals[0][first - 3 : first] = np.nan  # 60 ms, and the filter bridges 50
    else:
        signals[1][:first] = 0.0
    assert feed(tracker, *signals, time[:40]) == [] and tracker.pose() is None
    resting_samples = slice(first, first + 45)
    state = with_all_errors(
        filtering.level_state(
            filtering.Filter(CONFIG), gyro[resting_samples], accel[resting_samples]
        )
    )
    intervals = (len(gyro) - first) // N
    used = slice(first, first + intervals * N)
    _, history = scan(state, gyro[used], accel[used], np.ones(intervals * N, bool))
    poses = feed(tracker, gyro[40:], accel[40:], time[40:])
    assert len(poses) == intervals - 45 // N + 1  # the first stands for all intervals of the rest
    np.testing.assert_allclose(poses[0].time, time[first] + 45 // N * N * DT)
    later = slice(45 // N - 1, len(history.position))
    np.testing.assert_allclose([p.position for p in poses], history.position[later], atol=1e-9)
    np.testing.assert_allclose([p.nis for p in poses], history.nis[later], rtol=1e-7)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_a_rest_with_holes_is_a_rest(built, share):
    """Holes that the filter bridges: in the state they are interpolated, in the filter they are
    missing. Single lost rows are holes, because two intervals are more than 1.5."""
    gyro, accel = (signal[: N * INTERVALS] for signal in resting())
    random, time = np.random.default_rng(1), 7.0 + np.arange(len(gyro)) * DT
    lost = random.random(len(gyro)) < share
    lost[[0, 2, -1]], lost[1] = False, True
    for row in range(2, len(lost)):
        lost[row] &= not lost[row - 2 : row].all()  # never three in a row
    tracker = Tracker(predict, filter_of(), rest_seconds=0.9)
    poses = feed(tracker, gyro[~lost], accel[~lost], time[~lost])
    number, came = np.arange(45), ~lost[:45]
    resting_signals = [
        np.stack([np.interp(number, number[came], axis[:45][came]) for axis in signal.T], axis=1)
        for signal in (gyro, accel)
    ]
    state = with_all_errors(filtering.level_state(filtering.Filter(CONFIG), *resting_signals))
    _, history = scan(state, gyro, accel, ~lost)
    steps = [round((pose.time - 7.0) / (N * DT)) - 1 for pose in poses]
    assert 10 <= steps[0] <= 12 and len(steps) > 50 and tracker.hindrance == ""
    positions = history.position[np.array(steps)]
    np.testing.assert_allclose([p.position for p in poses], positions, atol=1e-9)
    assert any(pose.quiet for pose in poses) and not all(pose.quiet for pose in poses)


@pytest.mark.parametrize(
    ("missing", "hindrance", "start"),
    [
        ([*range(20, 24)], "samples are missing for 0.08 s", 24),
        ([0, 1], "its first sample is missing", 2),
        ([*range(1, 46, 3), *range(2, 46, 3)], "only 15 of its 45 samples have come", 12),
    ],
)
def test_what_is_no_rest_is_said(built, missing, hindrance, start):
    gyro, accel = (signal[:80] for signal in resting())
    time = np.arange(80) * DT
    broken = np.where(np.isin(np.arange(80), missing)[:, None], np.nan, gyro)
    tracker, hindrances = Tracker(predict, filter_of(), rest_seconds=0.9), set()
    for row in zip(time, broken, accel, strict=True):
        pose = tracker.push(*row)
        hindrances.add(tracker.hindrance)
        if pose is not None:
            break
    assert hindrance in hindrances and tracker.hindrance == ""
    assert tracker.pose().time == pytest.approx((start + 45) * DT, abs=N * DT)


def test_a_restarted_tracker_is_a_new_one(built):
    """On another clock, after samples of another walk, and after a start that was given."""
    gyro, accel = resting()
    time = 5.0 + np.arange(len(gyro)) * DT
    fresh = Tracker(predict, filter_of(), rest_seconds=0.9)
    expected = feed(fresh, gyro, accel, time)
    used = Tracker(predict, filter_of(), start(), rest_seconds=0.9)
    turned, pushed = recording()
    thrown = feed(
        used, turned, pushed + np.array([90.0, 0.0, 0.0]), 1.7e9 + np.arange(N * INTERVALS) * DT
    )
    assert not thrown[-1].healthy and thrown[-1].failure
    used.restart()
    assert used.pose() is None and used.filter_state() is None and np.isnan(used.newest)
    # A start that is none is forgotten, too.
    missing = np.where(np.arange(80)[:, None] % 50 > 20, np.nan, accel[:80])
    feed(used, gyro[:80], missing, time[:80])
    assert used.hindrance and used.newest == time[79]
    used.restart()
    assert used.hindrance == "" and np.isnan(used.newest)
    poses = feed(used, gyro, accel, time)
    assert len(poses) == len(expected) > 50
    for pose, like in zip(poses, expected, strict=True):
        jax.tree.map(np.testing.assert_array_equal, pose, like)
    jax.tree.map(np.testing.assert_array_equal, used.filter_state(), fresh.filter_state())


def test_a_restarted_tracker_keeps_its_precision():
    """The state that was given decides it, and not that JAX has float64."""
    config = dataclasses.replace(CONFIG, allow_float32=True)
    single = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf,
        start(config),
    )
    tracker = Tracker(predict, filter_of(config), single, rest_seconds=0.9)
    tracker.restart()
    gyro, accel = resting()
    poses = feed(tracker, gyro[:60], accel[:60], np.arange(60) * DT)
    assert poses and poses[-1].position.dtype == np.float32


def test_a_rest_without_gravity_is_told_once_and_another_starts(built):
    """Such as in units of gravity, until somebody mends it."""
    gyro, accel = resting()
    time = np.arange(len(gyro)) * DT
    tracker = Tracker(predict, filter_of())
    assert feed(tracker, gyro[:49], accel[:49] / 9.81, time[:49]) == []
    with pytest.raises(ValueError, match=r"^accel: shows no gravity, its mean is 1 m/s²"):
        tracker.push(time[49], gyro[49], accel[49] / 9.81)
    poses = feed(tracker, gyro[50:], accel[50:], time[50:])
    # The first pose stands for all intervals of the rest.
    assert len(poses) == (len(time) - 50) // N - 50 // N + 1 and poses[0].healthy
    with pytest.raises(ValueError, match=r"^time: must increase"):
        tracker.push(time[-1], gyro[0], accel[0])


@functools.cache
def walk(rate):
    """8 s on foot, shaken at 44, 49 and 40 Hz: at 50 Hz aliases to 6, 1 and 10 Hz. A start, and
    the walk."""
    sequence = simulated.pedestrian(4, 4, seconds=8.0, rate=float(rate))
    shake = np.sin(2 * np.pi * sequence.time[:, None] * [44.0, 49.0, 40.0] + [1.0, 2.0, 0.5])
    rotation = geometry.matrix_from_quaternion(jnp.asarray(sequence.orientation[0]))
    state = filtering.initial_state(
        filtering.Filter(CONFIG), rotation, sequence.velocity[0], sequence.position[0]
    )
    walked = sequence._replace(
        gyro=sequence.gyro + 2.0 * shake, accel=sequence.accel + 15.0 * shake[:, ::-1]
    )
    return with_all_errors(state), walked


@pytest.mark.parametrize("rate", [100, 104])
def test_a_faster_imu_gives_the_trajectory_of_the_batch_path(built, rate):
    """To 1 µm at a multiple of the filter's rate, else 1 mm; mere interpolation is 10 cm off."""
    (state, walked), n, valid = walk(rate), N * INTERVALS, np.ones(N * INTERVALS, bool)
    even = resample(walked, 1 / DT)
    positions = np.asarray(scan(state, even.gyro[:n], even.accel[:n], valid)[1].position)
    tracker, arrivals = (
        Tracker(predict, filter_of(), state, imu_rate=float(rate)),
        [],
    )
    for row in checked_at_first(zip(walked.time, walked.gyro, walked.accel, strict=True)):
        pose = tracker.push(*row)
        arrivals += [] if pose is None else [(row[0], pose)]
    assert 21 * DT < tracker.delay < 22.01 * DT
    for number, (stamp, pose) in enumerate(arrivals, start=1):
        assert pose.time == pytest.approx(number * N * DT)
        # the last sample of its interval is stamped DT before its time
        assert -1e-6 < stamp - (pose.time - DT) - tracker.delay < 1.01 / rate
    off = np.abs(np.array([pose.position for _, pose in arrivals[:INTERVALS]]) - positions).max()
    assert off < (1e-6 if rate == 100 else 1e-3)
    grid = np.arange(n) * DT
    rows = [
        np.stack([np.interp(grid, walked.time, column) for column in signal.T], axis=1)
        for signal in (walked.gyro, walked.accel)
    ]
    aliased = np.asarray(scan(state, *rows, valid)[1].position)
    assert np.linalg.norm(aliased - positions, axis=1).max() > 0.1


STILL = np.zeros(3), [0, 0, 9.81]


def test_an_imu_faster_than_told_is_refused_before_it_aliases_for_long(tracker):
    for time in np.arange(200) / 100:
        tracker.push(time, *STILL)
    before = tracker.pose()
    words = r"^imu_rate: the samples come at 100 Hz, .* for 50 Hz: .* make it with imu_rate=100"
    for _ in range(2):
        with pytest.raises(ValueError, match=words):
            tracker.push(2.0, *STILL)
        jax.tree.map(np.testing.assert_array_equal, tracker.pose(), before)


@pytest.mark.parametrize("hole", [0.9, 0.16])
def test_no_hole_hides_that_the_imu_is_faster(tracker, hole):
    """100 Hz for 0.4 s, nothing, then 100 Hz again; or so with a hole after every 0.4 s. The time
    in the holes does not count: two seconds of samples are enough."""
    count = np.arange(400)
    stops = np.minimum(count // 40, 1) if hole == 0.9 else count // 40
    sample_count = 0
    with pytest.raises(ValueError, match=r"^imu_rate: the samples come at 100 Hz"):
        for time in 1.7e9 + count / 100 + stops * hole:
            tracker.push(time, *STILL)
            sample_count += 1
    assert 196 < sample_count - len(np.unique(stops[:sample_count])) < 200


@pytest.mark.parametrize("kind", ["jitter", "a slower IMU", "lost", "a change"])
def test_the_rate_is_measured_as_long_as_the_stream_lasts(tracker, kind):
    random, stamps = np.random.default_rng(0), np.arange(600) * DT
    if kind == "jitter":
        stamps = stamps + DT * random.uniform(0, 0.99, len(stamps))
    elif kind == "lost":
        stamps = stamps[random.uniform(size=len(stamps)) > 0.3]
    elif kind == "a slower IMU":
        stamps = stamps[::7]
    else:
        stamps = np.append(stamps[:300], stamps[300] + np.arange(400) * DT / 2)
    for k, time in checked_at_first(enumerate(stamps)):
        try:
            tracker.push(time, *STILL)
        except ValueError as error:
            assert kind == "a change" and str(error).startswith("imu_rate") and 300 < k < 520
            return
    assert kind != "a change"


@pytest.mark.slow
def test_the_example_replays_a_recording(tmp_path, monkeypatch, capsys):
    """examples/replay_csv.py, through the low-pass of a faster IMU, with an empty row and a hole;
    with the network of gnio-jax, else the newest run, as by every command."""
    examples, requests, load = Path(__file__).parents[2] / "examples", [], networks.load
    with tiny_run.registry_entry():
        config = TrainConfig(data=DataConfig(rate=50.0), model=ModelConfig("tiny"))
        run = tiny_run.save(tmp_path / "run", config)
        answer = lambda which: requests.append(which) or load(run)  # noqa: E731
        monkeypatch.setattr(networks, "load", answer)
        lines = (examples / "walk.csv").read_text().splitlines()[:601]
        lines[150] = f"{lines[150].partition(',')[0]},,,,,,"
        (tmp_path / "walk.csv").write_text("\n".join(lines[:170] + lines[173:]) + "\n")
        words = ["replay_csv.py", "--csv", "walk.csv", "--out", str(tmp_path / "out" / "found.txt")]
        monkeypatch.setattr(sys, "argv", words)
        monkeypatch.chdir(tmp_path)
        runpy.run_path(str(examples / "replay_csv.py"), run_name="__main__")
    out, err = capsys.readouterr()
    assert requests == [None] and err == "" and "Hz to 50 Hz: poses come 4" in out
    assert out.count("p99") == 2 and "DIVERGED" not in out
    poses = np.loadtxt(tmp_path / "out" / "found.txt")
    # A pose every 0.1 s, but of the steps of the rest and of those with the hole the last ones;
    # they are behind by the low-pass.
    assert poses.shape[1] == 8 and 44 <= len(poses) <= 48
    assert poses[0, 0] == pytest.approx(1.0, abs=1e-3) and 5.4 < poses[-1, 0] < 5.6
    np.testing.assert_allclose(np.linalg.norm(poses[:, 4:], axis=1), 1, atol=1e-6)
    assert (tmp_path / "out" / "found.png").read_bytes()[:4] == b"\x89PNG"
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["found.png", "found.txt"]
