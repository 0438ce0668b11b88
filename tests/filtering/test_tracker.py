"""The tracker against `run_odometry`'s scan, its clock against a slow resampler, its poses between
clones against a plain NumPy filter."""

import dataclasses
import functools
import importlib.util
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import config as configuration
from gnio_jax import filtering
from gnio_jax.apps import packages
from gnio_jax.commands import console
from gnio_jax.filtering import Tracker
from gnio_jax.filtering import tracker as online
from gnio_jax.filtering.resampler import Stream, create_grid
from gnio_jax.filtering.state import Mean
from gnio_jax.filtering.tracker import compile_programs
from gnio_jax.types import Prediction
from tests.support import drawn_run, scekf_numpy

N, CLONES, INTERVALS, DT = 4, 4, 70, 0.02
CONFIG = filtering.FilterConfig(DT, N, CLONES, convergence_seconds=0.6, bridge_seconds=0.05)
NOISE = filtering.NoiseModel(
    2e-3, 2e-2, measurement_scale=2.0, correlation=filtering.CorrelatedError(0.5, 0.3)
)
WEIGHTS = np.random.default_rng(5).standard_normal((6, 3)) * 0.02
HIT = slice(180, 184)
"""Samples of a knock that the network takes for a leap: its measurement is rejected."""


def predict(windows):
    ramp = jnp.linspace(0.5, 1.5, windows.shape[1], dtype=jnp.float32)[None, :, None]
    pooled = jnp.mean(ramp * windows, axis=1) @ jnp.asarray(WEIGHTS, jnp.float32)
    leap = jnp.where(jnp.max(jnp.abs(windows)) > 50, 40.0, 0.0).astype(jnp.float32)
    return Prediction(pooled + leap, -2.0 + 0.1 * pooled, {"gate": jnp.tanh(pooled)})


@functools.cache
def recording():
    """Movement, from sample 200 on rest."""
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
    return filtering.initial_state(config, rotation, velocity, position, gyro_bias, 0.1)


OTHER = dataclasses.replace(
    CONFIG,
    context_samples=6,
    window_rotation="single",
    zero_velocity_std=0.02,
    rest_seconds=0.3,
    gap_gyro_std=0.05,
    gap_accel_std=0.2,
)


@functools.cache
def compiled(config=CONFIG):
    """One tracker a configuration, for its programs: compiling takes most of the time of these
    tests."""
    return Tracker(predict, config, NOISE, start(config))


@functools.cache
def program(config):
    config = dataclasses.replace(config, history="core")
    return jax.jit(
        lambda *given: filtering.run_odometry(predict, *given[:3], config, NOISE, given[3])
    )


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
    """Trackers take their programs from `compiled`."""
    ready = compiled()._advance, compiled()._look_ahead
    monkeypatch.setattr(online, "compile_programs", lambda *_: ready)


@pytest.fixture
def tracker(built):
    return Tracker(predict, CONFIG, NOISE, start())


def feed(tracker, gyro, accel, time):
    return [
        pose
        for row in zip(time, gyro, accel, strict=True)
        if (pose := tracker.push(*row)) is not None
    ]


@pytest.mark.parametrize(
    "config, missing",
    [
        (CONFIG, ()),
        (OTHER, (*range(50, 52), *range(100, 105), *range(130, 170), 277)),
        (dataclasses.replace(CONFIG, window_rotation="tlio"), range(100, 104)),
    ],
    ids=["complete", "gaps, rest", "as TLIO cuts"],
)
def test_equals_the_scan(config, missing):
    gyro, accel = recording()
    valid = ~np.isin(np.arange(len(gyro)), missing)
    state = start(config)
    final, wanted = scan(state, gyro, accel, valid, config)
    tracker = compiled(config)
    tracker._start(state)
    time = 1.7e9 + np.arange(len(gyro)) * DT  # as a phone stamps them
    broken = np.where(valid[:, None], gyro, np.nan)
    made = [
        (k, pose)
        for k in range(len(gyro))
        if (pose := tracker.push(time[k], broken[k], accel[k])) is not None
    ]
    found = [pose for _, pose in made]
    # a missing sample is known as such one sample later, or with the next that is there
    assert [k for k, _ in made if k % N != N - 1] == [] if not missing else len(made) == INTERVALS
    np.testing.assert_allclose(
        [p.time for p in found], time[0] + np.arange(1, INTERVALS + 1) * N * DT, atol=1e-6
    )
    for name in (*Mean._fields, "covariance", "accepted", "nis"):
        rows = np.array([getattr(pose, name) for pose in found])
        np.testing.assert_allclose(rows, getattr(wanted, name), rtol=1e-9, atol=1e-9, err_msg=name)
    assert all(pose.healthy for pose in found)
    assert (wanted.gate_passed == 0).any() and (wanted.gate_passed == 1).sum() > 20
    assert (np.asarray(wanted.at_rest) == 1).any() == (config is OTHER)
    assert np.isnan(np.asarray(wanted.nis)[CLONES:]).any() == bool(missing)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9),
        tracker.filter_state(),
        final,
    )
    jax.tree.map(np.asarray, state)  # the caller's own start is still his


@pytest.mark.parametrize("window_rotation, last", [("per_sample", 34), ("tlio", 35)])
def test_windows_with_a_long_hole_are_no_measurements(window_rotation, last):
    """Coasting are samples 122 … 127, in intervals 30 and 31: in the windows that end with
    intervals 30 … 34, and in that which begins a sample early. The short hole is bridged."""
    gyro, accel = recording()
    config = dataclasses.replace(CONFIG, window_rotation=window_rotation)
    valid = ~np.isin(np.arange(len(gyro)), [*range(120, 128), 170, 171])
    _, history = scan(start(config), gyro, accel, valid, config)
    missing = np.flatnonzero(np.isnan(np.asarray(history.accepted)))
    np.testing.assert_array_equal(missing, [*range(4), *range(30, last + 1)])
    assert np.isfinite(history.position).all()


def test_unhealthy_once_is_unhealthy_for_good(tracker):
    """A knock to some 140 m/s and back: the filter comes back, so nothing but memory can tell. What
    begins with its state is unhealthy, too."""
    gyro, accel = (signal.copy() for signal in recording())
    accel[98:106] += [900.0, 0, 0]
    accel[106:114] -= [900.0, 0, 0]
    final, history = scan(start(), gyro, accel, np.ones(len(gyro), bool))
    speed = np.linalg.norm(history.velocity, axis=1)
    bad = int(np.argmax(speed > CONFIG.speed_limit))
    assert 0 < bad < 30 and np.isfinite(speed).all()
    np.testing.assert_array_equal(history.healthy, np.arange(len(speed)) < bad)
    found = feed(tracker, gyro, accel, np.arange(len(gyro)) * DT)
    np.testing.assert_array_equal([p.healthy for p in found], np.asarray(history.healthy) > 0)
    assert not final.healthy and not tracker.filter_state().healthy
    tracker._start(tracker.filter_state())
    assert tracker.pose().healthy is False
    _, again = scan(final, *recording(), np.ones(len(gyro), bool))
    assert (np.asarray(again.healthy) == 0).all()


def oracle(stamps, values, dt, hole):
    """The grid by its definition: every point on its own, looking for its neighbours among the
    samples that are there."""
    there = np.isfinite(values).all(1)
    known, rows = stamps[there], values[there]
    grid = []
    for k in range(int(np.floor((stamps[-1] - stamps[0]) / dt + 1e-9)) + 1):
        point = stamps[0] + k * dt
        equal = np.flatnonzero(np.abs(known - point) < 1e-9)
        before, after = np.flatnonzero(known < point), np.flatnonzero(known > point)
        if len(equal):
            grid.append((*rows[equal[0]], 1.0))
        elif len(before) and len(after) and known[after[0]] - known[before[-1]] <= hole:
            grid.append((*[np.interp(point, known, column) for column in rows.T], 1.0))
        elif len(before) and not len(after) and stamps[-1] - known[before[-1]] <= hole:
            break  # a sample to come may still fill it
        else:
            grid.append((*[np.nan] * 6, 0.0))
    return np.array(grid)


@pytest.mark.parametrize(
    "kind", ["jitter", "fast", "slow", "holes", "missing", "missing from the start", "uniform"]
)
def test_clock_against_a_slow_resampler(kind):
    rng = np.random.default_rng(len(kind))
    spacing = {"fast": 0.004, "slow": 0.027}.get(kind, 0.01)
    stamps = 100.0 + np.cumsum(spacing * (1 + rng.uniform(-0.3, 0.3, 400)))
    values = rng.standard_normal((400, 6))
    hole = 0.05 if kind == "slow" else 0.015
    if kind == "holes":
        stamps[50:] += 0.2
        stamps[51:] += 0.012
        stamps[300:] += 0.9
    elif kind == "uniform":
        stamps = 100.0 + np.arange(400) * 0.01
    elif kind.startswith("missing"):
        values[rng.integers(0, 400, 60), rng.integers(0, 6, 60)] = np.nan
        values[200:240] = np.inf
        if kind.endswith("start"):
            values[:30, 2] = np.nan
    if kind == "fast":  # so fast an IMU is refused after a second
        stamps, values = stamps[:240], values[:240]
    stream, rows, known = Stream(create_grid(0.01, hole)), [], []
    assert stream.grid.delay == 0
    for time, row in zip(stamps.tolist(), values.tolist(), strict=True):
        stream.push(time, tuple(row))
        new = stream.known
        rows += list(stream.rows(new))
        stream.take(new)
        known.append(len(rows))
    wanted = oracle(stamps, values, 0.01, hole)
    np.testing.assert_allclose(np.array(rows), wanted, atol=1e-9)
    assert stream.taken == len(rows)
    assert (wanted[:, 6] == 0).any() == (kind.startswith("missing") or kind == "holes")
    if not kind.startswith(
        "missing"
    ):  # at most one sample late: all of the grid that the stamps have reached is there
        np.testing.assert_array_equal(
            known, np.floor((stamps - stamps[0]) / 0.01 + 1e-6).astype(int) + 1
        )


def test_a_stop_of_the_stream_is_caught_up_in_one_push(tracker):
    gyro, accel = recording()
    time = np.arange(len(gyro)) * DT
    keep = ~np.isin(np.arange(len(gyro)), np.arange(90, 121))
    found = [
        pose
        for k in np.flatnonzero(keep)
        if (pose := tracker.push(time[k], gyro[k], accel[k])) is not None
    ]
    _, wanted = scan(start(), gyro, accel, keep)
    steps = [round(p.time / (N * DT)) - 1 for p in found]
    assert set(range(INTERVALS)) - set(steps) == set(
        range(22, 29)
    )  # of those that one push made it returns the last
    np.testing.assert_allclose(
        [p.position for p in found], wanted.position[np.array(steps)], atol=1e-9
    )


def test_between_clones_it_integrates_the_imu(tracker):
    gyro, accel = recording()
    state = start()
    assert np.isnan(tracker.pose().time) and np.array_equal(tracker.pose().position, state.position)
    for m in range(1, N):
        assert tracker.push(m * DT, gyro[m], accel[m]) is None
        pose = tracker.pose()
        samples, none = slice(1, m + 1), (np.full((1, 3), np.nan), np.zeros((1, 3, 3)))
        wanted = scekf_numpy.run_from(
            state, NOISE, CONFIG, gyro[samples], accel[samples], *none, n=m, clones=9
        )
        assert pose.time == pytest.approx((m + 1) * DT)
        for name in ("rotation", "velocity", "position", "covariance"):
            np.testing.assert_allclose(
                getattr(pose, name), wanted[name][0], atol=1e-12, rtol=1e-9, err_msg=name
            )
    # and from clones in the middle of the run on, with updates behind them, whether it is asked at
    # every sample or only now and then
    made = tracker.push(N * DT, gyro[N], accel[N])
    for k in range(N + 1, 120):
        mean = [made.rotation, made.velocity, made.position] if (k - 1) % N == 0 else mean
        mean = scekf_numpy.step_mean(*mean, made.gyro_bias, made.accel_bias, gyro[k], accel[k], DT)
        after = tracker.push(k * DT, gyro[k], accel[k])
        if after is not None:
            made = after
            jax.tree.map(np.testing.assert_array_equal, tracker.pose(), made)
        elif k % 3:
            pose = tracker.pose()
            for name, value in zip(("rotation", "velocity", "position"), mean, strict=True):
                np.testing.assert_allclose(getattr(pose, name), value, atol=1e-11, err_msg=name)
            assert pose.time == pytest.approx(k * DT + DT)
            np.testing.assert_array_equal([pose.accepted, pose.nis], [made.accepted, made.nis])
    assert made.accepted == 1


def test_between_clones_it_coasts_through_a_gap(tracker):
    gyro, accel = recording()
    for k in range(N):
        made = tracker.push(k * DT, gyro[k], accel[k])
    bias = np.asarray(made.gyro_bias), np.asarray(made.accel_bias)
    tracker.push(
        (N + 2) * DT, gyro[5], np.full(3, np.nan)
    )  # grid samples 4, 5, 6 are missing; two are bridged, the third is not
    pose = tracker.pose()
    mean = [made.rotation, made.velocity, made.position]
    for _ in range(2):
        mean = scekf_numpy.step_mean(*mean, *bias, gyro[N - 1], accel[N - 1], DT)
    mean = [*mean[:2], mean[2] + mean[1] * DT]
    for name, value in zip(("rotation", "velocity", "position"), mean, strict=True):
        np.testing.assert_allclose(getattr(pose, name), value, atol=1e-12, err_msg=name)
    assert (np.diag(pose.covariance)[:9] > np.diag(made.covariance)[:9] * 1.0001).all()
    assert pose.time == pytest.approx((N + 3) * DT)


@pytest.mark.parametrize(
    "arguments, words",
    [
        ((1.0, np.zeros(3), np.zeros(3)), r"^time: must increase, found 1\.0 after 1\.0"),
        ((float("nan"), np.zeros(3), np.zeros(3)), r"^time: must be a finite number"),
        (("soon", np.zeros(3), np.zeros(3)), r"^time: must be a finite number"),
        ((1020.0, np.zeros(3), np.zeros(3)), r"^time: .* more than 60 s; stamps must be"),
        ((1.1, np.zeros(4), np.zeros(3)), r"^gyro: must be three numbers"),
        ((1.1, np.zeros(3), "up"), r"^accel: must be three numbers"),
        ((1.1, np.full(3, 1e6), np.zeros(3)), r"^gyro: no IMU measures more than 100 rad/s"),
    ],
)
def test_mistakes_change_nothing(tracker, arguments, words):
    """Neither now nor for the samples that come after them."""
    time, (gyro, accel) = 0.9 + np.arange(20) * DT, recording()
    other = Tracker(predict, CONFIG, NOISE, start())
    for each in (tracker, other):
        feed(each, gyro[:6], accel[:6], time[:6])
    with pytest.raises(ValueError, match=words):
        tracker.push(*arguments)
    jax.tree.map(np.testing.assert_array_equal, tracker.pose(), other.pose())
    after = [feed(each, gyro[6:20], accel[6:20], time[6:]) for each in (tracker, other)]
    assert len(after[0]) == 4
    jax.tree.map(np.testing.assert_array_equal, *after)


@pytest.mark.parametrize("leap", [1.5, 30.0, 59.0])
def test_a_stamp_that_leaps_is_believed_once_a_second_one_agrees(tracker, leap):
    """One stamp in the future costs its sample, and a stop of the stream none."""
    gyro, accel = recording()
    wrong, time = 100, np.arange(len(gyro)) * DT
    alone = np.where(np.arange(len(gyro)) == wrong, time + leap, time)
    found = feed(tracker, gyro, accel, alone)
    _, wanted = scan(start(), gyro, accel, np.arange(len(gyro)) != wrong)
    assert len(found) == INTERVALS
    np.testing.assert_allclose([p.position for p in found], wanted.position, atol=1e-9)

    stopped = Tracker(predict, CONFIG, NOISE, start())
    keep, gap = 120, round(leap / DT)  # the samples before the stop, and those that it costs
    feed(stopped, gyro[:keep], accel[:keep], time[:keep])
    assert stopped.push(time[keep] + leap, gyro[keep], accel[keep]) is None
    assert stopped.pose().time == pytest.approx(keep * DT)
    made = stopped.push(time[keep + 1] + leap, gyro[keep + 1], accel[keep + 1])
    samples = keep + gap + 2
    assert made.time == pytest.approx(samples // N * N * DT)
    assert stopped.pose().time == pytest.approx(samples * DT)


def test_stamps_that_leap_apart_are_not_believed(tracker):
    """Each of them waits for one that agrees, and the old clock goes on."""
    gyro, accel = recording()
    feed(tracker, gyro[:8], accel[:8], np.arange(8) * DT)
    for time in (20.0, 40.0, 5.0, 30.0):
        assert tracker.push(time, gyro[8], accel[8]) is None
    assert tracker.pose().time == pytest.approx(8 * DT)
    tracker.push(8 * DT, gyro[8], accel[8])
    assert tracker.pose().time == pytest.approx(9 * DT)


def test_mistakes_at_the_start():
    with pytest.raises(ValueError, match=r"^hole: must be a number of at least"):
        Tracker(predict, CONFIG, NOISE, start(), hole=0.001)
    for rate in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match=r"^imu_rate: must be a number"):
            Tracker(predict, CONFIG, NOISE, start(), imu_rate=rate)
    with pytest.raises(ValueError, match=r"^noise\.gyro_density"):
        Tracker(predict, CONFIG, NOISE._replace(gyro_density=-1.0), start())
    with pytest.raises(ValueError, match=r"^predict: "):
        Tracker(lambda windows: windows, CONFIG, NOISE, start())
    with pytest.raises(ValueError, match=r"^state"):
        Tracker(predict, dataclasses.replace(CONFIG, clones_per_window=5), NOISE, start())
    with pytest.raises(ValueError, match=r"^rest_seconds: "):
        Tracker(predict, CONFIG, NOISE, rest_seconds=0.01)
    with pytest.raises(ValueError, match=r"^std\.tilt"):
        Tracker(predict, CONFIG, NOISE, std=filtering.InitialStd(tilt=-1.0))


def resting():
    """The last 80 samples of the recording, at rest, and then its first ones."""
    return (np.concatenate([signal[-80:], signal[: 10 - 80]]) for signal in recording())


@pytest.mark.parametrize("lost", ["missing", "without acceleration"])
def test_from_rest(built, lost):
    """The first 0.9 s without a hole make the state, and are filtered from their first sample on.
    A sensor that does not run yet reads zero."""
    gyro, accel = resting()
    time = 7.0 + np.arange(len(gyro)) * DT
    # 45 samples: no whole number of intervals
    tracker = Tracker(predict, CONFIG, NOISE, rest_seconds=0.9)
    assert tracker.pose() is None and tracker.filter_state() is None
    given_gyro, given_accel = gyro.copy(), accel.copy()
    if lost == "missing":
        given_gyro[9] = np.nan
    else:
        given_accel[:10] = 0.0
    early = [tracker.push(*row) for row in zip(time[:40], given_gyro, given_accel, strict=False)]
    assert early == [None] * 40 and tracker.pose() is None
    first = 10
    state = filtering.level_state(CONFIG, gyro[first : first + 45], accel[first : first + 45])
    intervals = (len(gyro) - first) // N
    used = slice(first, first + intervals * N)
    _, wanted = scan(state, gyro[used], accel[used], np.ones(intervals * N, bool))
    found = feed(tracker, gyro[40:], accel[40:], time[40:])
    assert len(found) == intervals - 45 // N + 1  # the first stands for all intervals of the rest
    np.testing.assert_allclose(found[0].time, time[first] + 45 // N * N * DT)
    later = slice(45 // N - 1, len(wanted.position))
    np.testing.assert_allclose([p.position for p in found], wanted.position[later], atol=1e-9)
    np.testing.assert_allclose([p.nis for p in found], wanted.nis[later], rtol=1e-7)


def test_a_rest_without_gravity_is_told_once_and_another_starts(built):
    """Such as in units of gravity, until somebody mends it."""
    gyro, accel = resting()
    time = np.arange(len(gyro)) * DT
    tracker, problems, found = Tracker(predict, CONFIG, NOISE), [], []
    for k, stamp in enumerate(time):
        try:
            pose = tracker.push(stamp, gyro[k], accel[k] / (9.81 if k < 50 else 1))
        except ValueError as error:
            problems.append((k, str(error)))
        else:
            found += [] if pose is None else [pose]
    ((k, problem),) = problems
    assert k == 49 and problem.startswith("accel: shows no gravity, its mean is 1 m/s²")
    # The first pose stands for all intervals of the rest.
    assert len(found) == (len(time) - 50) // N - 50 // N + 1 and found[0].healthy
    with pytest.raises(ValueError, match=r"^time: must increase"):
        tracker.push(time[-1], gyro[0], accel[0])


# The example
# ------------------------------------------------------------------------------------------------

ROOT = Path(__file__).parents[2]
TRAINED = configuration.TrainConfig(
    data=configuration.DataConfig(rate=50.0), model=configuration.ModelConfig(width=2, bank_size=4)
)


@pytest.fixture(scope="module")
def workdir(tmp_path_factory):
    return drawn_run.save(
        tmp_path_factory.mktemp("trained") / "run",
        TRAINED,
        lambda random, kind, shape: random.uniform(0.05, 0.2, shape),
    )


COMPILED = []


def compile_once(*arguments):
    """All replays are of one network and filter."""
    if not COMPILED:
        COMPILED.append(compile_programs(*arguments))
    return COMPILED[0]


@pytest.fixture
def replay(monkeypatch, tmp_path):
    """examples/replay_csv.py's own main: (arguments) -> None, in an empty folder."""
    spec = importlib.util.spec_from_file_location("replay_csv", ROOT / "examples" / "replay_csv.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "replay_csv", module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(online, "compile_programs", compile_once)
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["replay_csv.py", *map(str, arguments)])
        console.run(module.main)

    return call


def write_walk(path, seconds=6.0, rate=50):
    """Two seconds of rest, then a walk, on irregular stamps with an empty row and a hole."""
    rng = np.random.default_rng(0)
    count = np.arange(int(seconds * rate))
    time = 1.7e9 + count / rate + rng.uniform(-0.002, 0.002, len(count)) * 50 / rate
    moving = (count > 2 * rate)[:, None]
    imu = np.concatenate(
        [rng.normal(0, 0.01, (len(time), 3)), rng.normal([0, 0, 9.81], 0.05, (len(time), 3))], 1
    )
    imu += moving * np.sin(12 * (time - time[0]))[:, None] * [0.3, 0.1, 0.2, 1.0, 1.0, 2.0]
    rows = [
        f"{t:.6f}," + ",".join("" if k == 150 else f"{value:.6f}" for value in row)
        for k, (t, row) in enumerate(zip(time, imu, strict=True))
        if not 170 <= k < 173
    ]
    path.write_text("time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n" + "\n".join(rows) + "\n")
    return time


def test_a_recording_is_replayed(workdir, replay, tmp_path, capsys):
    time = write_walk(tmp_path / "walk.csv")
    replay("--weights", workdir, "--csv", "walk.csv", "--out", tmp_path / "out" / "found.txt")
    out, err = capsys.readouterr()
    assert (
        err == "" and "real-time factor" in out and out.count("p99") == 2 and "DIVERGED" not in out
    )
    found = np.loadtxt(tmp_path / "out" / "found.txt")
    # a pose every 0.1 s from the end of the first second on; one step of the two with the hole may
    # stand for both
    assert found.shape[1] == 8 and 49 <= len(found) <= 52
    assert 0.9 < found[0, 0] - time[0] <= 1.1 and abs(found[-1, 0] - time[-1]) < 0.13
    np.testing.assert_allclose(np.linalg.norm(found[:, 4:], axis=1), 1, atol=1e-6)
    assert (tmp_path / "out" / "found.png").read_bytes()[:4] == b"\x89PNG"
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["found.png", "found.txt"]


def test_a_faster_recording_is_replayed_with_the_default_weights(
    workdir, replay, tmp_path, monkeypatch, capsys
):
    """Through the low-pass; with those of gnio-jax, else the newest run, as every command."""
    asked, load = [], packages.load_pretrained
    monkeypatch.setattr(
        packages, "load_pretrained", lambda which: asked.append(which) or load(workdir)
    )
    time = write_walk(tmp_path / "walk.csv", rate=120)
    replay("--csv", "walk.csv")
    out, err = capsys.readouterr()
    assert asked == [None]
    assert err == "" and "DIVERGED" not in out and "Hz to 50 Hz: poses come 433 ms later" in out
    found = np.loadtxt(tmp_path / "walk_trajectory.txt")
    # Of the steps of the rest the last one counts; the poses are behind by the low-pass.
    assert found[0, 0] - time[0] == pytest.approx(1.0, abs=1e-3)
    assert 0.4 < time[-1] - found[-1, 0] < 0.56


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--cvs", "walk.csv"], "--cvs: unknown option; did you mean"),
        ([], "--csv: is missing"),
        (["--csv", "backward.csv"], "backward.csv: field 'time' does not increase"),
        (["--csv", "ms.csv"], "ms.csv row 2: time: "),
        (["--csv", "short.csv"], "short.csv: ends before the device was still for 1 s"),
        (
            ["--csv", "walk.csv", "--rest-seconds", "0"],
            "--rest-seconds: rest_seconds: must be a number of at least 0.03 s",
        ),
    ],
)
def test_mistakes_of_a_replay_are_one_line(workdir, replay, tmp_path, capsys, arguments, words):
    write_walk(tmp_path / "walk.csv")
    lines = (tmp_path / "walk.csv").read_text().splitlines()
    (tmp_path / "short.csv").write_text("\n".join(lines[:30]))
    (tmp_path / "backward.csv").write_text("\n".join([lines[0], *lines[:0:-1]]))
    (tmp_path / "ms.csv").write_text(
        "\n".join(
            [
                lines[0],
                *(f"{100000 * k}," + line.split(",", 1)[1] for k, line in enumerate(lines[1:])),
            ]
        )
    )
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as left:
        replay(*arguments, "--weights", workdir)
    out, err = capsys.readouterr()
    assert left.value.code == 2 and out == "" and len(err.splitlines()) == 1 and words in err
    assert sorted(tmp_path.rglob("*")) == before
