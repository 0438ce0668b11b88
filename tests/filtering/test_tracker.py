"""The tracker against `run_odometry`'s scan, its clock against a slow resampler, its poses between
clones against a plain NumPy filter."""

import dataclasses
import functools
import importlib.util
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import config as configuration
from gnio_jax import filtering
from gnio_jax.commands import console
from gnio_jax.errors import InputError
from gnio_jax.filtering import Tracker
from gnio_jax.filtering import tracker as online
from gnio_jax.filtering.clock import advance_clock
from gnio_jax.types import Prediction
from tests.support import drawn_run, scekf_numpy

N, CLONES, INTERVALS, DT = 4, 4, 70, 0.02
CONFIG = filtering.FilterConfig(DT, N, CLONES, convergence_seconds=0.6, bridge_seconds=0.05)
NOISE = filtering.NoiseModel(2e-3, 2e-2, measurement_scale=2.0)
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
    jacobians="first",
    gap_gyro_std=0.05,
    gap_accel_std=0.2,
)


@functools.cache
def compiled(config=CONFIG):
    """One tracker a configuration, for its programs: compiling takes most of the time of these
    tests."""
    return Tracker(predict, start(config), config, NOISE)


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
    ready = compiled()._programs
    monkeypatch.setattr(online, "compile_programs", lambda *_: ready)


@pytest.fixture
def tracker(built):
    return Tracker(predict, start(), CONFIG, NOISE)


def feed(tracker, gyro, accel, time):
    return [
        pose
        for row in zip(time, gyro, accel, strict=True)
        if (pose := tracker.push(*row)) is not None
    ]


@pytest.mark.parametrize(
    "config, missing",
    [(CONFIG, ()), (OTHER, (*range(50, 52), *range(100, 105), *range(130, 170), 277))],
    ids=["complete", "gaps, rest"],
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
    for name in (
        "rotation",
        "velocity",
        "position",
        "gyro_bias",
        "accel_bias",
        "covariance",
        "accepted",
        "nis",
    ):
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
        stamps[300:] += 3.0
    elif kind == "uniform":
        stamps = 100.0 + np.arange(400) * 0.01
    elif kind.startswith("missing"):
        values[rng.integers(0, 400, 60), rng.integers(0, 6, 60)] = np.nan
        values[200:240] = np.inf
        if kind.endswith("start"):
            values[:30, 2] = np.nan
    clock, rows, known = None, [], []
    for time, row in zip(stamps.tolist(), values.tolist(), strict=True):
        clock, new = advance_clock(clock, time, tuple(row), 0.01, hole)
        rows += new
        known.append(len(rows))
    wanted = oracle(stamps, values, 0.01, hole)
    np.testing.assert_allclose(np.array(rows), wanted, atol=1e-9)
    assert (clock.count, clock.newest) == (len(rows), stamps[-1])
    assert (wanted[:, 6] == 0).any() == (kind.startswith("missing") or kind == "holes")
    if not kind.startswith(
        "missing"
    ):  # at most one sample late: all of the grid that the stamps have reached is there
        np.testing.assert_array_equal(
            known, np.floor((stamps - stamps[0]) / 0.01 + 1e-6).astype(int) + 1
        )


def test_irregular_stamps_reach_the_filter_resampled(tracker):
    rng = np.random.default_rng(1)
    gyro, accel = recording()
    time = 5.0 + np.arange(len(gyro)) * DT + rng.uniform(-0.2, 0.2, len(gyro)) * DT
    grid = oracle(time, np.concatenate([gyro, accel], 1), DT, 1.5 * DT)
    grid = grid[: len(grid) // N * N]
    _, wanted = scan(start(), grid[:, :3], grid[:, 3:6], grid[:, 6] > 0)
    found = feed(tracker, gyro, accel, time)
    assert len(found) == len(grid) // N > 60
    np.testing.assert_allclose(
        [p.position for p in found], wanted.position[: len(found)], atol=1e-7
    )
    np.testing.assert_allclose([p.nis for p in found], wanted.nis[: len(found)], rtol=1e-6)


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
            state, NOISE, DT, gyro[samples], accel[samples], *none, n=m, clones=9
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


@pytest.mark.parametrize("split", [0, 1, 57, 186])
def test_goes_on_from_a_file_to_the_bit(tracker, tmp_path, monkeypatch, split):
    gyro, accel = recording()
    time = (
        3.0
        + np.arange(len(gyro)) * DT
        + np.random.default_rng(2).uniform(-0.3, 0.3, len(gyro)) * DT
    )
    gyro = np.where(np.arange(len(gyro))[:, None] == 100, np.nan, gyro)
    feed(tracker, gyro[:split], accel[:split], time[:split])
    tracker.save(tmp_path / "state.npz")
    if split == 57:
        monkeypatch.undo()  # once with programs of its own, as in another process
    again = Tracker.restore(tmp_path / "state.npz", predict, CONFIG, NOISE)
    jax.tree.map(np.testing.assert_array_equal, again.state, tracker.state)
    jax.tree.map(np.testing.assert_array_equal, again.pose(), tracker.pose())
    rest = [feed(t, gyro[split:], accel[split:], time[split:]) for t in (tracker, again)]
    assert len(rest[0]) >= 23
    jax.tree.map(np.testing.assert_array_equal, *rest)
    assert [p.name for p in tmp_path.iterdir()] == ["state.npz"]


def test_files_that_do_not_fit_are_refused(tracker, tmp_path):
    path = tmp_path / "state.npz"
    tracker.save(path)

    def refusal(config=CONFIG, noise=NOISE, path=path):
        with pytest.raises(InputError) as refused:
            Tracker.restore(path, predict, config, noise)
        assert str(refused.value).startswith(str(path)) and "\n" not in str(refused.value)
        return str(refused.value)

    assert "FilterConfig.gate_threshold = 11.345, not 9.0" in refusal(
        dataclasses.replace(CONFIG, gate_threshold=9.0)
    )
    assert "NoiseModel.gyro_density = 0.002, not 0.001" in refusal(
        noise=NOISE._replace(gyro_density=1e-3)
    )
    assert "no such file" in refusal(path=tmp_path / "none.npz")
    whole = path.read_bytes()
    for content in (b"", b"text", whole[: len(whole) // 2]):
        path.write_bytes(content)
        assert "is no file of Tracker.save, or damaged" in refusal()
    np.savez(path, about=np.array(json.dumps({"format": "another"})))
    assert "is not a 'gnio-jax tracker" in refusal()
    np.savez(path, about=np.array({"format": 1}, dtype=object))
    assert "is no file of Tracker.save" in refusal()


def test_a_file_says_nothing_of_considered_errors_where_there_are_none(tracker, tmp_path):
    tracker.save(tmp_path / "state.npz")
    with np.load(tmp_path / "state.npz") as file:
        about = json.loads(str(file["about"]))
        assert "considered" not in about and about["format"] == "gnio-jax tracker 4"
        assert not [name for name in file.files if name.startswith("tangents")]


def test_a_failed_save_leaves_the_old_file(tracker, tmp_path, monkeypatch):
    tracker.save(tmp_path / "state.npz")
    before = (tmp_path / "state.npz").read_bytes()

    def full(file, **_):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError):
        tracker.save(tmp_path / "state.npz")
    assert (tmp_path / "state.npz").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    "arguments, words",
    [
        ((1.0, np.zeros(3), np.zeros(3)), r"^time: must increase, found 1\.0 after 1\.0"),
        ((0.5, np.zeros(3), np.zeros(3)), r"^time: must increase"),
        ((float("nan"), np.zeros(3), np.zeros(3)), r"^time: must be a finite number"),
        (("soon", np.zeros(3), np.zeros(3)), r"^time: must be a finite number"),
        ((1020.0, np.zeros(3), np.zeros(3)), r"^time: .* more than 60 s; stamps are in seconds"),
        ((1.1, np.zeros(4), np.zeros(3)), r"^gyro: must be three numbers, found shape \(4,\)"),
        ((1.1, np.zeros(3), "up"), r"^accel: must be three numbers"),
    ],
)
def test_mistakes_change_nothing(tracker, arguments, words):
    feed(
        tracker, np.zeros((6, 3)), np.tile([0, 0, 9.81], (6, 1)), [0.9, 0.92, 0.94, 0.96, 0.98, 1.0]
    )
    before = tracker.state
    with pytest.raises(ValueError, match=words):
        tracker.push(*arguments)
    jax.tree.map(np.testing.assert_array_equal, tracker.state, before)


def test_mistakes_at_the_start():
    with pytest.raises(ValueError, match=r"^hole: must be a time of at least dt"):
        Tracker(predict, start(), CONFIG, NOISE, hole=0.001)
    with pytest.raises(ValueError, match=r"^noise\.gyro_density"):
        Tracker(predict, start(), CONFIG, NOISE._replace(gyro_density=-1.0))
    with pytest.raises(ValueError, match=r"^predict: "):
        Tracker(lambda windows: windows, start(), CONFIG, NOISE)
    with pytest.raises(ValueError, match=r"^state"):
        Tracker(predict, start(), dataclasses.replace(CONFIG, clones_per_window=5), NOISE)
    with pytest.raises(ValueError, match=r"^seconds: "):
        Tracker.from_rest(predict, CONFIG, NOISE, seconds=0.01)
    with pytest.raises(ValueError, match=r"^std\.tilt"):
        Tracker.from_rest(predict, CONFIG, NOISE, std=filtering.InitialStd(tilt=-1.0))


def test_from_rest(built, tmp_path):
    """The first second without a hole makes the state, and is filtered from its first sample on."""
    gyro, accel = recording()
    gyro, accel = (
        np.concatenate([gyro[-80:], gyro[: 10 - 80]]),
        np.concatenate([accel[-80:], accel[: 10 - 80]]),
    )
    time = 7.0 + np.arange(len(gyro)) * DT
    tracker = Tracker.from_rest(
        predict, CONFIG, NOISE, seconds=0.9
    )  # 45 samples: no whole number of intervals
    assert tracker.pose() is None and tracker.filter_state() is None
    early = [
        tracker.push(time[k], gyro[k] * (np.nan if k == 9 else 1), accel[k]) for k in range(40)
    ]
    assert early == [None] * 40 and tracker.pose() is None
    tracker.save(tmp_path / "waiting.npz")
    first = 10
    state = filtering.level_state(CONFIG, gyro[first : first + 45], accel[first : first + 45])
    intervals = (len(gyro) - first) // N
    used = slice(first, first + intervals * N)
    _, wanted = scan(state, gyro[used], accel[used], np.ones(intervals * N, bool))
    for each in (tracker, Tracker.restore(tmp_path / "waiting.npz", predict, CONFIG, NOISE)):
        found = feed(each, gyro[40:], accel[40:], time[40:])
        assert (
            len(found) == intervals - 45 // N + 1
        )  # the first stands for all intervals of the rest
        np.testing.assert_allclose(found[0].time, time[first] + 45 // N * N * DT)
        np.testing.assert_allclose(
            [p.position for p in found], wanted.position[45 // N - 1 :], atol=1e-9
        )
        np.testing.assert_allclose([p.nis for p in found], wanted.nis[45 // N - 1 :], rtol=1e-7)


# The example
# ------------------------------------------------------------------------------------------------

ROOT = Path(__file__).parents[2]
TRAINED = configuration.TrainConfig(
    data=configuration.DataConfig(rate=50.0),
    model=configuration.ModelConfig(width=2, bank_size=4),
)


@pytest.fixture(scope="module")
def workdir(tmp_path_factory):
    return drawn_run.save(
        tmp_path_factory.mktemp("trained") / "run",
        TRAINED,
        lambda random, kind, shape: random.uniform(0.05, 0.2, shape),
    )


@pytest.fixture
def replay(monkeypatch, tmp_path):
    """examples/replay_csv.py's own main: (arguments) -> None, in an empty folder."""
    spec = importlib.util.spec_from_file_location("replay_csv", ROOT / "examples" / "replay_csv.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "replay_csv", module)
    spec.loader.exec_module(module)
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
    replay("--workdir", workdir, "--csv", "walk.csv", "--out", tmp_path / "out" / "found.txt")
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


def test_a_faster_recording_is_replayed_through_the_low_pass(workdir, replay, tmp_path, capsys):
    time = write_walk(tmp_path / "walk.csv", rate=120)
    replay("--workdir", workdir, "--csv", "walk.csv")
    out, err = capsys.readouterr()
    assert err == "" and "DIVERGED" not in out and "Hz to 50 Hz: poses come 433 ms later" in out
    found = np.loadtxt(tmp_path / "walk_trajectory.txt")
    # The hole at 1.4 s drains the low-pass before the first pose has come: several steps at once.
    assert (
        found[0, 0] - time[0] == pytest.approx(1.4, abs=1e-3)
        and 0.4 < time[-1] - found[-1, 0] < 0.56
    )


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--cvs", "walk.csv"], "--cvs: unknown option; did you mean --csv?"),
        ([], "--csv: is missing"),
        (["--csv", "none.csv"], "none.csv: cannot be read"),
        (["--csv", "walk.csv", "--workdir", "nowhere"], "nowhere: holds no run"),
        (["--csv", "backward.csv"], "backward.csv: field 'time' does not increase"),
        (["--csv", "ms.csv"], "ms.csv row 2: time: "),
        (["--csv", "short.csv"], "short.csv: ends before the device was still for 1 s"),
        (
            ["--csv", "walk.csv", "--rest-seconds", "0"],
            "--rest-seconds: seconds: must be a time of at least two samples",
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
        replay(*(arguments if "--workdir" in arguments else [*arguments, "--workdir", workdir]))
    out, err = capsys.readouterr()
    assert left.value.code == 2 and out == "" and len(err.splitlines()) == 1 and words in err
    assert sorted(tmp_path.rglob("*")) == before


def test_help_of_the_replay_teaches(replay, capsys):
    with pytest.raises(SystemExit) as left:
        replay("--help")
    shown = " ".join(capsys.readouterr().out.split())
    assert not left.value.code
    for word in (
        "--csv",
        "--realtime",
        "--rest-seconds",
        "gyro_x..z (rad/s)",
        "still for the first second",
        "TUM",
    ):
        assert word in shown, word
