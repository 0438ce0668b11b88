"""The low-pass of a stream against pure tones and a slow resampler of SciPy's parts."""

import itertools

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import firwin

from gnio_jax.filtering.resampler import Stream, create_grid
from tests.support.checks import checked_at_first

DT = 0.005


def through(stamps, values, imu_rate, dt=DT, hole=None):
    """The rows (gyro, accel, valid) that the filter gets, and the newest stamp when each came."""
    stream, rows, arrivals = Stream(create_grid(dt, hole, imu_rate and float(imu_rate))), [], []
    samples = zip(stamps.tolist(), values.tolist(), strict=True)
    for time, row in checked_at_first(samples, 60):  # 400 Hz: a row from 46 on
        stream.push(time, tuple(row))
        new = stream.ready
        rows += list(stream.rows(new))
        stream.take(new)
        arrivals += [time] * new
    return np.array(rows).reshape(-1, 7), np.array(arrivals)


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
    [(416, 0.005, 0, 80), (1000, 0.005, 0, 80), (250, 0.005, 0, 55), (400, 0.01, 0.2, 40)],
)
def test_pure_tones(rate, dt, jitter, highest):
    """The pass band within 1 %, without delay against the stamps; the stop band 40 dB down."""
    stamps = stamps_of(rate, 0.8, jitter)
    delay = create_grid(dt, imu_rate=float(rate)).delay
    assert 21 * dt < delay < 22.01 * dt
    inside = slice(round(0.3 / dt), None)  # at the start the FIR's reach is filled by reflection
    passed = np.array([0.0, 0.5, 1.0]) * highest
    rows, arrivals = through(stamps, pairs(passed, stamps - stamps[0]), rate, dt)
    grid = np.arange(len(rows)) * dt
    assert amplitudes(rows[:, :6] - pairs(passed, grid))[inside].max() < 0.01
    np.testing.assert_array_equal(rows[:, 6], 1.0)
    excess_delay = arrivals - stamps[0] - grid - delay
    assert -1e-6 < excess_delay.min() and excess_delay.max() < 1.5 / rate
    # Where stamps jitter, no interpolation can read tones near the IMU's own Nyquist frequency.
    stopped = np.linspace(0.5 / dt, (0.2 if jitter else 0.49) * rate, 3)
    vibration = pairs(stopped, stamps - stamps[0])
    rows, _ = through(stamps, vibration, rate, dt)
    assert amplitudes(rows[inside, :6]).max() < 0.01
    assert (amplitudes(linear(stamps, vibration, dt)[inside]).max(axis=0) > 0.1).all()


def slow(stamps, values, rate, factor, half):
    """The rows by definition, each run with SciPy's spline and FIR on the whole of it.

    Lines between samples more than 1.75 of the IMU's intervals apart; the first run goes on before
    its start by odd reflection, all else beyond the ends has no weight."""
    taps = firwin(2 * half + 1, 0.9 / factor, window=("kaiser", 6.75526))
    step, elapsed, finite_rows = DT / factor, stamps - stamps[0], np.isfinite(values).all(axis=1)
    grid = np.arange(int(np.floor(elapsed[-1] / DT + 1e-6)) + 1)
    rows = np.tile([*[np.nan] * 6, 0.0], (len(grid), 1))
    elapsed, values = elapsed[finite_rows], values[finite_rows]
    for run in np.split(np.arange(len(elapsed)), np.flatnonzero(np.diff(elapsed) > 1.5 * DT) + 1):
        time, samples = elapsed[run], values[run]
        first, last = int(np.ceil(time[0] / step - 1e-4)), int(np.floor(time[-1] / step + 1e-4))
        points = np.clip(np.arange(first, last + 1) * step, time[0], time[-1])
        fine = np.stack([np.interp(points, time, column) for column in samples.T], axis=1)
        if len(run) >= 4:
            curve, line = CubicSpline(time, samples)(points), np.zeros(len(points), bool)
            for left_end, right in itertools.pairwise(time):
                line |= (left_end <= points) & (points < right) & (right - left_end > 1.75 / rate)
            fine = np.where(line[:, None], fine, curve)
        fine_rows = {first + j: row for j, row in enumerate(fine)}
        if first == 0:
            fine_rows |= {-j: 2 * fine[0] - fine[j] for j in range(1, len(fine))}
        for k in grid[(grid * factor >= first) & (grid * factor <= last)]:
            near = [
                (tap, fine_rows[k * factor + j])
                for tap, j in zip(taps, range(-half, half + 1), strict=True)
                if k * factor + j in fine_rows
            ]
            weights, around = (np.array(part) for part in zip(*near, strict=True))
            rows[k] = [*(weights @ around / weights.sum()), 1.0]
    return rows


@pytest.mark.parametrize(
    "kind", ["multiple", "no multiple", "jitter", "holes", "missing", "short runs"]
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
    elif kind == "missing":
        values[300:340, 1] = np.nan
        values[random.integers(0, len(stamps), 20), 4] = np.inf
        values[:31] = np.nan
    stamps, values = stamps[keep], values[keep]
    rows, arrivals = through(stamps, values, rate)
    reference = slow(stamps, values, rate, factor, half)
    assert 20 < len(reference) - len(rows) < 25  # the last wait for the FIR's reach
    reference = reference[: len(rows)]
    np.testing.assert_array_equal(rows[:, 6], reference[:, 6])
    # Between samples the end of the spline is felt: the taps are 1e-4 there, the noise up to 4.
    np.testing.assert_allclose(rows, reference, rtol=0, atol=1e-6 if kind == "multiple" else 2e-3)
    assert (reference[:, 6] == 0).any() == (kind not in ("multiple", "no multiple", "jitter"))
    delays = arrivals - stamps[0] - np.arange(len(rows)) * DT
    assert delays.min() > -1e-6 and delays[rows[:, 6] == 1].max() < 0.11 + 0.16


def interpolated(stamps, values, dt, hole):
    """The grid by its definition, without a low-pass: every point on its own, looking for its
    neighbours among the samples that are there."""
    finite_rows = np.isfinite(values).all(1)
    times, rows = stamps[finite_rows], values[finite_rows]
    grid = []
    for k in range(int(np.floor((stamps[-1] - stamps[0]) / dt + 1e-9)) + 1):
        point = stamps[0] + k * dt
        equal = np.flatnonzero(np.abs(times - point) < 1e-9)
        before, after = np.flatnonzero(times < point), np.flatnonzero(times > point)
        if len(equal):
            grid.append((*rows[equal[0]], 1.0))
        elif len(before) and len(after) and times[after[0]] - times[before[-1]] <= hole:
            grid.append((*[np.interp(point, times, column) for column in rows.T], 1.0))
        elif len(before) and not len(after) and stamps[-1] - times[before[-1]] <= hole:
            break  # a sample to come may still fill it
        else:
            grid.append((*[np.nan] * 6, 0.0))
    return np.array(grid)


@pytest.mark.parametrize("kind", ["fast", "slow", "holes", "missing", "uniform"])
def test_clock_without_a_low_pass(kind):
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
    elif kind == "missing":
        values[rng.integers(0, 400, 60), rng.integers(0, 6, 60)] = np.nan
        values[200:240] = np.inf
        values[:30, 2] = np.nan
    if kind == "fast":  # so fast an IMU is refused after a second
        stamps, values = stamps[:240], values[:240]
    assert create_grid(0.01, hole).delay == 0
    rows, arrivals = through(stamps, values, None, 0.01, hole)
    reference = interpolated(stamps, values, 0.01, hole)
    np.testing.assert_allclose(rows, reference, atol=1e-9)
    assert (reference[:, 6] == 0).any() == (kind in ("missing", "holes"))
    if kind != "missing":
        # at most one sample late: all of the grid that the stamps have reached is there
        points = stamps[0] + 0.01 * np.arange(len(rows)) - 1e-8
        np.testing.assert_array_equal(arrivals, stamps[np.searchsorted(stamps, points)])


def test_two_stamps_almost_alike_do_no_harm():
    """A spline through the noise of both would swing by thousands of its size."""
    stamps = stamps_of(400, 1.0, 0.2)
    stamps = np.sort(np.append(stamps, stamps[100:300:20] + 1e-6))
    values = np.random.default_rng(0).standard_normal((len(stamps), 6))
    rows, _ = through(stamps, values, 400)
    assert len(rows) == 178 and np.abs(rows[:, :6]).max() < 4


def test_a_lost_sample_of_a_slower_imu_is_no_hole():
    """250 Hz: 8 ms between two samples, and a hole is 7.5 ms. What is missing holds the last row.
    Of 140 Hz, which nobody can know where a sample is lost, 0.10 rms remain at best."""

    def mixture(time):
        """140 Hz and 10 Hz, each in three phases."""
        return np.concatenate([tones(140.0, time)[:, ::2], tones(10.0, time)[:, ::2]], axis=1)

    stamps = stamps_of(250, 3.0)
    lost = np.random.default_rng(0).uniform(size=len(stamps)) < 0.03
    lost[[0, -1]] = False
    alone = lost & ~np.roll(lost, 1) & ~np.roll(lost, -1)
    rows, _ = through(stamps[~lost], mixture(stamps - stamps[0])[~lost], 250)
    assert int((rows[:, 6] == 0).sum()) <= 2 * (lost & ~alone).sum()
    last = np.maximum.accumulate(np.where(rows[:, 6] == 1, np.arange(len(rows)), 0))
    expected = mixture(np.arange(len(rows)) * DT) * [0, 0, 0, 1, 1, 1]
    squares = (rows[last, :6] - expected)[60:].reshape(-1, 2, 3) ** 2
    vibration, gait = np.sqrt(squares.mean(axis=(0, 2)))
    assert vibration < 0.22 and gait < 0.02
