"""The low-pass of a stream: pure tones, a slow resampler of SciPy's parts, the trajectory of the
batch path, the rate of the IMU."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import firwin

from gnio_jax import filtering, geometry
from gnio_jax.data.resampling import resample
from gnio_jax.data.simulated import walks as simulated
from gnio_jax.filtering import Tracker
from gnio_jax.filtering import tracker as online
from gnio_jax.filtering.resampler import Stream, create_grid
from gnio_jax.types import Prediction
from tests.support.checks import checked_at_first

DT = 0.005
CONFIG = filtering.FilterConfig(DT, samples_per_clone=20, clones_per_window=10)
NOISE = filtering.NoiseModel()
WEIGHTS = np.random.default_rng(5).standard_normal((6, 3)) * 0.02


def through(stamps, values, imu_rate, dt=DT, hole=None):
    """The rows (gyro, accel, valid) that the filter gets, and the newest stamp when each came."""
    stream, rows, known = Stream(create_grid(dt, hole, float(imu_rate))), [], []
    samples = zip(stamps.tolist(), values.tolist(), strict=True)
    for time, row in checked_at_first(samples, 60):  # 400 Hz: a row from 46 on
        stream.push(time, tuple(row))
        new = stream.known
        rows += list(stream.rows(new))
        stream.take(new)
        known += [time] * new
    return np.array(rows).reshape(-1, 7), np.array(known)


def linear(stamps, values, dt=DT):
    """The grid by interpolation alone, without a low-pass: gyro, accel."""
    grid = np.arange(int((stamps[-1] - stamps[0]) / dt)) * dt
    return np.stack([np.interp(grid, stamps - stamps[0], column) for column in values.T], axis=1)


def stamps_of(rate, seconds, jitter=0.0):
    """As a phone gives them, s; jitter in intervals."""
    count = np.arange(round(rate * seconds))
    off = jitter * np.random.default_rng(3).uniform(-1, 1, len(count)) * (count > 0)
    return 1.7e9 + (count + off) / rate


def tones(frequency, time):
    """(n, 6): one frequency in six phases, of amplitude 1."""
    return np.sin(2 * np.pi * frequency * time[:, None] + np.arange(6))


def pairs(frequencies, time):
    """(n, 6): three frequencies, each as cosine and sine of amplitude 1."""
    angles = 2 * np.pi * np.asarray(frequencies) * time[:, None]
    return np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(time), 6)


def amplitudes(columns):
    """(n, 3): how large columns like those of `pairs` can become at any phase."""
    return np.linalg.norm(columns.reshape(len(columns), 3, 2), axis=2)


@pytest.mark.parametrize(
    "rate, dt, jitter, highest",
    [
        (400, 0.005, 0, 80),
        (416, 0.005, 0, 80),
        (1000, 0.005, 0, 80),
        (250, 0.005, 0, 55),
        (208, 0.01, 0, 40),
        (400, 0.01, 0.2, 40),
    ],
)
def test_pure_tones(rate, dt, jitter, highest):
    """The pass band within 1 %, without delay against the stamps; the stop band 40 dB down."""
    stamps = stamps_of(rate, 1.2, jitter)
    delay = create_grid(dt, imu_rate=float(rate)).delay
    assert 21 * dt < delay < 22.01 * dt
    inside = slice(round(0.3 / dt), None)  # at the start the FIR's reach is filled by reflection
    for passed in np.reshape([0.0, 1.0, *np.linspace(0.25, 1, 4) * highest], (2, 3)):
        rows, known = through(stamps, pairs(passed, stamps - stamps[0]), rate, dt)
        grid = np.arange(len(rows)) * dt
        off = amplitudes(rows[:, :6] - pairs(passed, grid))
        assert off[inside].max() < 0.01, passed
        np.testing.assert_array_equal(rows[:, 6], 1.0)
        late = known - stamps[0] - grid - delay
        assert -1e-6 < late.min() and late.max() < 1.5 / rate
    # Where stamps jitter, no interpolation can read tones near the IMU's own Nyquist frequency.
    stopped = np.linspace(0.5 / dt, (0.2 if jitter else 0.49) * rate, 6)
    for three in stopped.reshape(2, 3):
        vibration = pairs(three, stamps - stamps[0])
        rows, _ = through(stamps, vibration, rate, dt)
        assert amplitudes(rows[inside, :6]).max() < 0.01, three
        assert (amplitudes(linear(stamps, vibration, dt)[inside]).max(axis=0) > 0.1).all()


def slow(stamps, values, rate, factor, half):
    """The rows by definition, each run with SciPy's spline and FIR on the whole of it.

    Lines between samples more than 1.75 of the IMU's intervals apart; the first run goes on before
    its start by odd reflection, all else beyond the ends has no weight."""
    taps = firwin(2 * half + 1, 0.9 / factor, window=("kaiser", 6.75526))
    step, elapsed, there = DT / factor, stamps - stamps[0], np.isfinite(values).all(axis=1)
    grid = np.arange(int(np.floor(elapsed[-1] / DT + 1e-6)) + 1)
    rows = np.tile([*[np.nan] * 6, 0.0], (len(grid), 1))
    elapsed, values = elapsed[there], values[there]
    for run in np.split(np.arange(len(elapsed)), np.flatnonzero(np.diff(elapsed) > 1.5 * DT) + 1):
        time, samples = elapsed[run], values[run]
        first, last = int(np.ceil(time[0] / step - 1e-4)), int(np.floor(time[-1] / step + 1e-4))
        points = np.clip(np.arange(first, last + 1) * step, time[0], time[-1])
        fine = np.stack([np.interp(points, time, column) for column in samples.T], axis=1)
        if len(run) >= 4:
            curve, line = CubicSpline(time, samples)(points), np.zeros(len(points), bool)
            for left, right in itertools.pairwise(time):
                line |= (left <= points) & (points < right) & (right - left > 1.75 / rate)
            fine = np.where(line[:, None], fine, curve)
        known = {first + j: row for j, row in enumerate(fine)}
        if first == 0:
            known |= {-j: 2 * fine[0] - fine[j] for j in range(1, len(fine))}
        for k in grid[(grid * factor >= first) & (grid * factor <= last)]:
            near = [
                (tap, known[k * factor + j])
                for tap, j in zip(taps, range(-half, half + 1), strict=True)
                if k * factor + j in known
            ]
            weights, around = (np.array(part) for part in zip(*near, strict=True))
            rows[k] = [*(weights @ around / weights.sum()), 1.0]
    return rows


@pytest.mark.parametrize(
    "kind",
    ["multiple", "no multiple", "jitter", "holes", "missing", "missing at first", "short runs"],
)
def test_against_a_slow_resampler(kind):
    """Holes, ends and starts of runs, grid samples that are missing, and when each is known."""
    rate, factor, half = (416, 6, 131) if kind == "no multiple" else (400, 2, 44)
    stamps = stamps_of(rate, 1.5, 0.3 if kind in ("jitter", "short runs") else 0.0)
    random = np.random.default_rng(2)
    values = random.normal([0, 0, 0, 0, 0, 9.81], 1.0, (len(stamps), 6))
    keep = np.ones(len(stamps), bool)
    if kind == "holes":
        # Gaps of 5, 7.5, 15 and 152.5 ms, of which the last two are holes.
        keep[[100, 200, 201, *range(300, 305), *range(400, 460)]] = False
    elif kind == "short runs":
        for first in range(100, 500, 20):
            keep[first : first + 19 - (first // 20) % 8] = False  # runs of one to eight samples
    elif kind.startswith("missing"):
        values[300:340, 1] = np.nan
        values[random.integers(0, len(stamps), 20), 4] = np.inf
        if kind == "missing at first":
            values[:31] = np.nan
    stamps, values = stamps[keep], values[keep]
    rows, known = through(stamps, values, rate)
    wanted = slow(stamps, values, rate, factor, half)
    assert 20 < len(wanted) - len(rows) < 25  # the last wait for the FIR's reach
    wanted = wanted[: len(rows)]
    np.testing.assert_array_equal(rows[:, 6], wanted[:, 6])
    # Between samples the end of the spline is felt: the taps are 1e-4 there, the noise up to 4.
    np.testing.assert_allclose(rows, wanted, rtol=0, atol=1e-6 if kind == "multiple" else 2e-3)
    assert (wanted[:, 6] == 0).any() == (kind not in ("multiple", "no multiple", "jitter"))
    late = known - stamps[0] - np.arange(len(rows)) * DT
    assert late.min() > -1e-6 and late[rows[:, 6] == 1].max() < 0.11 + 0.16


def test_two_stamps_almost_alike_do_no_harm():
    """A spline through the noise of both would swing by thousands of its size."""
    stamps = stamps_of(400, 1.0, 0.2)
    stamps = np.sort(np.append(stamps, stamps[100:300:20] + 1e-6))
    values = np.random.default_rng(0).standard_normal((len(stamps), 6))
    rows, _ = through(stamps, values, 400)
    assert len(rows) == 178 and np.abs(rows[:, :6]).max() < 4


@pytest.mark.parametrize("share, most", [(0.01, 0.13), (0.03, 0.22)])
def test_a_lost_sample_of_a_slower_imu_is_no_hole(share, most):
    """250 Hz: 8 ms between two samples, and a hole is 7.5 ms. What is missing holds the last row.

    A sample of a vibration that is lost cannot be known: 0.06 and 0.10 rms remain of 140 Hz where
    zero is put in its place, which takes it for granted that the signal is nothing but vibration.
    """

    def both(time):
        """140 Hz and 10 Hz, each in three phases."""
        return np.concatenate([tones(140.0, time)[:, ::2], tones(10.0, time)[:, ::2]], axis=1)

    off = []
    for seed in range(2):
        stamps = stamps_of(250, 5.0)
        lost = np.random.default_rng(seed).uniform(size=len(stamps)) < share
        lost[[0, -1]] = False
        alone = lost & ~np.roll(lost, 1) & ~np.roll(lost, -1)
        rows, _ = through(stamps[~lost], both(stamps - stamps[0])[~lost], 250)
        assert int((rows[:, 6] == 0).sum()) <= 2 * (lost & ~alone).sum()
        last = np.maximum.accumulate(np.where(rows[:, 6] == 1, np.arange(len(rows)), 0))
        wanted = both(np.arange(len(rows)) * DT) * [0, 0, 0, 1, 1, 1]
        off.append((rows[last, :6] - wanted)[60:])
    squares = np.concatenate(off).reshape(-1, 2, 3) ** 2
    vibration, gait = np.sqrt(squares.mean(axis=(0, 2)))
    assert vibration < most and gait < 0.02


# The tracker --------------------------------------------------------------------------------------


def predict(windows):
    pooled = jnp.mean(windows, axis=1) @ jnp.asarray(WEIGHTS, jnp.float32)
    return Prediction(pooled, -2.0 + 0.1 * pooled, {})


@functools.cache
def walk(rate):
    """17 s on foot, shaken at 180, 188 and 199 Hz: at 200 Hz aliases to 20, 12 and 1 Hz."""
    made = simulated.pedestrian(4, 4, seconds=17.0, rate=float(rate))
    shake = np.sin(2 * np.pi * made.time[:, None] * [188.0, 199.0, 180.0] + [1.0, 2.0, 0.5])
    return made._replace(gyro=made.gyro + 2.0 * shake, accel=made.accel + 15.0 * shake[:, ::-1])


def start(walked):
    rotation = geometry.matrix_from_quaternion(jnp.asarray(walked.orientation[0]))
    return filtering.initial_state(CONFIG, rotation, walked.velocity[0], walked.position[0])


@functools.cache
def program():
    def history(state, gyro, accel):
        return filtering.run_odometry(predict, state, gyro, accel, CONFIG, NOISE)[1]

    return jax.jit(history)


def feed(tracker, walked, rows=slice(None)):
    """(stamp with which it came, pose)"""
    columns = walked.time[rows], walked.gyro[rows], walked.accel[rows]
    samples = checked_at_first(zip(*columns, strict=True))
    pushed = [(sample[0], tracker.push(*sample)) for sample in samples]
    return [(time, pose) for time, pose in pushed if pose is not None]


@functools.cache
def compiled():
    tracker = Tracker(predict, CONFIG, NOISE, start(walk(400)), imu_rate=400.0)
    return tracker._advance, tracker._look_ahead


@pytest.fixture
def built(monkeypatch):
    """Trackers take their programs from `compiled`."""
    ready = compiled()
    monkeypatch.setattr(online, "compile_programs", lambda *_: ready)


@pytest.mark.parametrize("rate", [400, 416])
def test_a_faster_imu_gives_the_trajectory_of_the_batch_path(built, rate):
    """To 1 µm at a multiple of the filter's rate, else 1 mm; mere interpolation is 10 cm off."""
    walked, state, steps = walk(rate), start(walk(rate)), 150
    n = 20 * steps
    even = resample(walked, 200.0)
    wanted = np.asarray(program()(state, even.gyro[:n], even.accel[:n]).position)
    tracker = Tracker(predict, CONFIG, NOISE, state, imu_rate=float(rate))
    found = feed(tracker, walked)
    assert 0.105 < tracker.delay < 0.1101
    times = [pose.time for _, pose in found[:steps]]
    np.testing.assert_allclose(times, np.arange(1, steps + 1) * 0.1, atol=1e-9)
    for stamp, pose in found:  # the last sample of its interval is stamped DT before its time
        assert -1e-6 < stamp - (pose.time - DT) - tracker.delay < 1.01 / rate
    off = np.abs(np.array([pose.position for _, pose in found[:steps]]) - wanted).max()
    assert off < (1e-6 if rate == 400 else 1e-3)
    rows = linear(walked.time, np.concatenate([walked.gyro, walked.accel], axis=1))[:n]
    aliased = np.asarray(program()(state, rows[:, :3], rows[:, 3:]).position)
    assert np.linalg.norm(aliased - wanted, axis=1).max() > 0.1


def test_an_imu_faster_than_told_is_refused_before_it_aliases_for_long(built):
    tracker = Tracker(predict, CONFIG, NOISE, start(walk(400)))
    feed(tracker, walk(400), slice(200))
    before = tracker.pose()
    words = r"^imu_rate: the samples come at 400 Hz, .* for 200 Hz: .* make it with imu_rate=400"
    for _ in range(2):
        with pytest.raises(ValueError, match=words):
            tracker.push(0.5, np.zeros(3), np.zeros(3))
        jax.tree.map(np.testing.assert_array_equal, tracker.pose(), before)


@pytest.mark.parametrize("hole", [0.3, 0.04])
def test_no_hole_hides_that_the_imu_is_faster(built, hole):
    """400 Hz for 0.1 s, nothing, then 400 Hz again; or so with a hole after every 0.1 s. The time
    in the holes does not count: half a second of samples is enough."""
    count = np.arange(400)
    stops = np.minimum(count // 40, 1) if hole == 0.3 else count // 40
    stamps = 1.7e9 + count / 400 + stops * hole
    tracker, still = Tracker(predict, CONFIG, NOISE, start(walk(400))), (np.zeros(3), [0, 0, 9.81])
    taken = 0
    with pytest.raises(ValueError, match=r"^imu_rate: the samples come at 400 Hz"):
        for time in stamps:
            tracker.push(time, *still)
            taken += 1
    assert 0.49 < (taken - len(np.unique(stops[:taken]))) / 400 < 0.5


@pytest.mark.parametrize("kind", ["jitter", "a slower IMU", "lost", "a change"])
def test_the_rate_is_measured_as_long_as_the_stream_lasts(built, kind):
    tracker, random = Tracker(predict, CONFIG, NOISE, start(walk(400))), np.random.default_rng(0)
    stamps = np.arange(1000) * DT
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
            tracker.push(time, np.zeros(3), [0, 0, 9.81])
        except ValueError as error:
            assert kind == "a change" and str(error).startswith("imu_rate") and 300 < k < 520
            return
    assert kind != "a change"
