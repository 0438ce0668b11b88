"""Magnetometer and barometer: updates against finite differences, squared errors of simulated
walks, rows from readings, and readings that cannot be."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from gnio_jax.errors import InputError
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.state import Shift
from tests.support import manifold
from tests.support.compiling import optimised, quick
from tests.support.random_walk import random_walk
from tests.support.walks import errors, simulate
from tests.support.whole_covariance import covariance

N, DT, RUNS, INTERVALS = 5, 0.02, 60, 200
NOISE = filtering.NoiseModel(5e-4, 5e-3, 2e-4, 1e-4)
STD = filtering.InitialStd(0.01, 0.2, 0.2, 1e-3, 1e-3, 0.05)
CONFIG = filtering.FilterConfig(DT, N, 1, history="core")
CLONES, SIGMA = 10, 0.05
WORLD = np.array([15.0, 12.0, -40.0])
"""Field of the world, µT."""
DIRECTION, STRENGTH = np.arctan2(WORLD[1], WORLD[0]), np.linalg.norm(WORLD)
DIP = np.arcsin(-WORLD[2] / STRENGTH)
ENDS = 0.1 * np.arange(1, INTERVALS + 1)


def predicted_azimuth(poses, field):
    east_north_up = np.einsum("...ij,j->...i", poses[0], field)
    return np.arctan2(east_north_up[..., 1], east_north_up[..., 0])[..., None]


@pytest.mark.parametrize("sensor", ["magnetometer", "barometer"])
def test_an_update_is_the_textbooks_with_the_derivatives_by_finite_differences(sensor):
    config = dataclasses.replace(CONFIG, clones_per_window=4, error="additive")
    start, *signals = random_walk(5, n=N, clones=4, intervals=12, dt=DT, nan_rows=range(12))
    ekf = filtering.Filter(config, NOISE, filtering.InitialStd(0.1, 0.1, 3.0, 1.0, 0.01, 0.1))
    state, _ = filtering.run_filter(ekf, filtering.initial_state(ekf, *start), *signals)
    poses = [np.asarray(part) for part in state.mean]
    if sensor == "magnetometer":
        # The filter errs by a turn of a tenth of a radian, across the jump of the azimuth.
        field = poses[0].T @ Rotation.from_euler("z", np.pi - DIRECTION - 0.02).apply(WORLD)
        direction = -np.pi + 0.08
        measurement = filtering.Magnetometer(field, direction, STRENGTH, DIP, 0.2)
        function, std, residual = lambda x: predicted_azimuth(x, field), 0.2, np.array([0.1])
    else:
        measurement = filtering.Barometer(poses[2][2] + 0.7, 0.5, 0.3)
        function, std, residual = lambda x: x[2][..., 2:], 0.5, np.array([1.0])
    jacobian = manifold.differences(lambda error: function(manifold.plus(poses, error)), 15)
    before = np.asarray(covariance(state))
    rows = np.pad(jacobian, ((0, 0), (0, len(before) - 15)))
    spread = rows @ before @ rows.T + std**2
    gain = np.linalg.solve(spread, rows @ before).T

    @quick
    def updated(state):
        step = filtering.Step(Imu(jnp.zeros((N, 3)), jnp.zeros((N, 3)), None), 0, 1, config, NOISE)
        return measurement.update(state, step)[:2]

    after, outcome = updated(state)
    assert bool(outcome.accepted)
    np.testing.assert_allclose(outcome.residual, residual, atol=1e-12)
    np.testing.assert_allclose(outcome.nis, residual**2 / spread[0], rtol=1e-6)
    np.testing.assert_allclose(covariance(after), before - gain @ rows @ before, atol=1e-7)
    moved = manifold.plus(poses, (gain @ residual)[:15])
    for value, expected in zip(after.mean, moved, strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-7)


def test_a_height_is_no_measurement_of_a_yaw_that_nobody_knows():
    """It is the same update as that of a quantity of the world, without its second linearisation,
    though the displacement before it has moved the estimate and the yaw is uncertain by a turn."""
    config = dataclasses.replace(CONFIG, clones_per_window=4)
    start, *signals = random_walk(5, n=N, clones=4, intervals=12, dt=DT)
    ekf = filtering.Filter(config, NOISE, filtering.InitialStd(0.05, 2.0, 3.0, 1.0, 0.01, 0.1))
    state, _ = filtering.run_filter(ekf, filtering.initial_state(ekf, *start), *signals)
    moved = state.clone_shift[0] + np.array([0.5, -0.3, 0.1])
    state = state._replace(shift=Shift(moved, 2.0 * moved))
    sensor = filtering.Barometer(state.position[2] + 2.0, 0.5, 0.0)

    @quick
    def updated(state):
        step = filtering.Step(Imu(jnp.zeros((N, 3)), jnp.zeros((N, 3)), None), 0, 1, config, NOISE)
        linear = filtering.linearise(state, [2.0], [[0.25]], position=[[0.0, 0.0, 1.0]])
        of_world = filtering.measure(state, linear, step, np.inf, frame="world")
        return sensor.update(state, step)[:2], of_world[:2]

    (after, outcome), (expected, of_world) = updated(state)
    assert bool(outcome.accepted) and abs(after.position[2] - state.position[2]) > 1.0
    np.testing.assert_allclose(outcome.nis, of_world.nis, rtol=1e-12)
    np.testing.assert_allclose(outcome.volume, of_world.volume, rtol=1e-12)
    for value, other, before in zip(after.mean, expected.mean, state.mean, strict=True):
        np.testing.assert_allclose(value, other, atol=1e-3 + 0.01 * np.abs(other - before).max())
    np.testing.assert_allclose(covariance(after), covariance(expected), rtol=0.01, atol=1e-3)


def test_squared_errors_of_walks_are_as_the_covariance_says():
    """By degree of freedom, of 60 walks of 20 s with an uncertain yaw; a mean over the walks has a
    standard deviation of 0.18."""
    noise = NOISE._replace(measurement_scale=1.0)
    config = dataclasses.replace(CONFIG, clones_per_window=CLONES, gate_threshold=1e9)
    walks = simulate(1, RUNS, INTERVALS, N, CLONES, DT, noise, STD, SIGMA)
    rng = np.random.default_rng(3)
    turned = Rotation.from_euler("z", rng.normal(0, 0.1, (RUNS * INTERVALS, 1))).apply(WORLD)
    field = np.einsum("rkji,rkj->rki", walks.rotation, turned.reshape(RUNS, INTERVALS, 3))
    height = walks.position[:, :, 2] - walks.position0[:, None, 2]
    height = height + 0.5 * rng.normal(size=height.shape)
    # A reading that jumps by a kilometre, and a field that a magnet has turned or enlarged.
    height[:, 50], field[:, 60] = 1000.0, -field[:, 60]
    field[:, 61] *= 1.5
    shape = np.ones((RUNS, INTERVALS))
    sensors = (
        filtering.Magnetometer(
            field, DIRECTION * shape, STRENGTH * shape, DIP * shape, 0.1 * shape
        ),
        filtering.Barometer(height, 0.5 * shape, walks.position0[:, 2:] * shape),
    )

    def run(rotation, velocity, position, gyro, accel, displacement, measurements):
        ekf = filtering.Filter(config, noise, STD)
        state = filtering.initial_state(ekf, rotation, velocity, position)
        spread = jnp.tile(SIGMA**2 * jnp.eye(3)[None], (INTERVALS, 1, 1))
        signals = ekf, state, gyro, accel, displacement, spread
        return filtering.run_filter(*signals, measurements=measurements)[1]

    history = optimised(jax.vmap(run))(*walks[:6], sensors)
    error, spread = errors(walks, history), np.asarray(history.covariance)
    for row in (29, 99, INTERVALS - 1):
        for name, axis in (("yaw", 2), ("climb", 5), ("height", 8), ("bias", 11)):
            nees = np.mean(error[:, row, axis] ** 2 / spread[:, row, axis, axis])
            assert 0.5 < nees < 1.6, (row, name, nees)
    assert error[:, -1, 2].std() < 0.06 and error[:, -1, 8].std() < 0.3
    refused = np.asarray(history.outcomes["barometer"].accepted)
    assert not refused[:, 50].any() and refused.mean() > 0.98
    magnet = history.outcomes["magnetometer"]
    assert not np.asarray(magnet.present)[:, 60:62].any()
    assert np.asarray(magnet.accepted).mean() > 0.97


def rotations(count):
    time = 0.1 * np.arange(1, count + 1)
    angles = np.stack([0.8 * time, 0.3 * np.sin(time), 0.2 * np.cos(0.7 * time)], axis=1)
    return Rotation.from_euler("ZYX", angles)


def readings(iron=0.0):
    time = 0.02 * np.arange(5 * INTERVALS + 10)
    angles = np.stack([0.8 * time, 0.3 * np.sin(time), 0.2 * np.cos(0.7 * time)], axis=1)
    field = Rotation.from_euler("ZYX", angles).inv().apply(WORLD) + iron
    return time + 7.0, field + 0.3 * np.random.default_rng(0).normal(size=field.shape)


def test_the_first_turns_show_the_phones_own_field():
    iron = np.array([20.0, -35.0, 10.0])
    time, field = readings(iron)
    field[301:339] = np.nan
    attitude = rotations(INTERVALS).as_matrix()
    rows = filtering.magnetometer_on_intervals(time, field, attitude, CONFIG, 7.0, 0.2)
    missing = np.isnan(rows.field[:, 0])
    assert (np.flatnonzero(missing) == np.arange(60, 67)).all()
    expected = rotations(INTERVALS).inv().apply(WORLD)
    assert np.abs(rows.field - expected)[~missing].max() < 1.5
    assert abs(rows.direction[0] - DIRECTION) < 0.02 and abs(rows.dip[0] - DIP) < 0.02
    assert abs(rows.strength[0] - STRENGTH) < 1.0 and (rows.std == 0.2).all()


def pressure_at(height):
    """The barometric formula with a constant gradient of temperature."""
    return 101325.0 * (1 - 0.0065 * height / 288.15) ** (9.80665 / (287.053 * 0.0065))


def test_pressures_become_heights_above_the_start():
    time = 3.0 + np.arange(0, 25.0, 0.2)
    height = 200.0 + 0.5 * (time - 3.0)
    pressure = pressure_at(height)
    rows = filtering.barometer_on_intervals(time, pressure, INTERVALS, CONFIG, 3.0, 1.0, 0.5, 4.0)
    # The air at 200 m is 0.5 % thinner.
    np.testing.assert_allclose(rows.height, 0.5 * ENDS, rtol=0.01)
    np.testing.assert_allclose(rows.std**2, 1 + 0.25 * ENDS)
    assert (rows.start == 4.0).all()


@pytest.mark.parametrize("first", [0.0, 2.1, 4.9])
def test_heights_are_above_the_start_also_where_the_pressures_begin_later(first):
    """The carrier climbs, and two of the first pressures are wrong."""
    time = np.arange(first, 25.0, 0.1)
    pressure = pressure_at(0.5 * time)
    pressure[[0, 7]] += 1000.0
    height = filtering.barometer_on_intervals(time, pressure, INTERVALS, CONFIG).height
    inside = (ENDS > first + 1.0) & (ENDS < 24.0)
    np.testing.assert_allclose(height[inside], 0.5 * ENDS[inside], atol=0.05)


def test_pressures_of_once_a_second_are_interpolated():
    for spacing in (1.0, 2.9):
        time = np.arange(0.0, 28.0, spacing)
        pressure = np.full(len(time), 101325.0)
        height = filtering.barometer_on_intervals(time, pressure, INTERVALS, CONFIG).height
        assert np.isfinite(height).all()


def readings_of_a_drifting_run(samples_per_clone, seconds):
    """Readings with errors of two seconds, and attitudes of a run whose gyro is off by 0.05 rad/s
    about the vertical."""
    config = dataclasses.replace(CONFIG, samples_per_clone=samples_per_clone)
    time = config.clone_seconds * np.arange(1, round(seconds / config.clone_seconds) + 1)
    angles = np.stack([0.1 * time, 0.1 * np.sin(time), 0.1 * np.cos(0.7 * time)], axis=1)
    truth = Rotation.from_euler("ZYX", angles)
    drift = 0.05 * np.cumsum(truth.as_matrix()[:, 2, 2]) * config.clone_seconds
    white = np.random.default_rng(4).normal(size=(round(seconds / 2.0) + 2, 3))
    knots = 2.0 * np.arange(len(white))
    errors = np.stack([np.interp(time, knots, column) for column in white.T], axis=1)
    field = truth.inv().apply(WORLD) + errors
    return time, field, (Rotation.from_euler("z", drift[:, None]) * truth).as_matrix(), config


def test_the_time_of_the_fit_is_doubled_until_the_bias_of_the_gyro_is_known():
    time, field, attitude, config = readings_of_a_drifting_run(N, 60.0)
    short = slice(round(8.0 / config.clone_seconds))
    options = {"first_seconds": 8.0, "bias_std": 0.1}
    few = filtering.fit_field(time[short], field[short], attitude[short], config, **options)
    fit = filtering.fit_field(time, field, attitude, config, **options)
    assert few.gyro_bias_std > 2 * fit.gyro_bias_std
    assert abs(fit.gyro_bias[2] - 0.05) < 4 * fit.gyro_bias_std
    assert fit.gyro_bias_std < 2.5e-3


def test_more_readings_of_one_error_show_no_more():
    """Errors of a building last for seconds: readings twice as often have as much information."""
    options = {"first_seconds": 16.0, "bias_std": 0.1}
    stds = [
        filtering.fit_field(*readings_of_a_drifting_run(count, 16.0), **options).gyro_bias_std
        for count in (N, 2 * N)
    ]
    assert stds[0] == pytest.approx(stds[1], rel=0.1)


MAGNETIC = [
    (lambda time, field: (time, field / 100), "is 0.444 µT.*; multiply by 100"),
    (lambda time, field: (time, field * 1e-6), "is 4.44e-05 µT.*; multiply by 1e\\+06"),
    (lambda time, field: (time, field * 1e3), "multiply by 0.001"),
    (lambda time, field: (time + 1e9, field), "0 of the first 30 s have a reading; give it stamps"),
    (lambda time, field: (time[::-1], field), "time: does not increase; sort"),
    (lambda time, field: (time, field[:-1]), r"must be \(f,\), \(f, 3\) and \(K, 3, 3\), found"),
    (lambda time, field: (time, np.nan * field), "0 of the first 30 s have a reading"),
    (lambda time, field: (time[:0], field[:0]), "0 of the first 30 s have a reading"),
]
BAROMETRIC = [
    (lambda time, pressure: (time, pressure / 100), "the median is 1013.2 Pa.*; multiply by 100"),
    (lambda time, pressure: (time, pressure * 10), "leave it out"),
    (lambda time, pressure: (time - 1e9, pressure), "no two stamps are within the 20 s of the IMU"),
    (lambda time, pressure: (time[::20], pressure[::20]), "more than 3 s apart; record it more"),
    (lambda time, pressure: (np.zeros_like(time), pressure), "time: does not increase"),
    (lambda time, pressure: (time, pressure[:-1]), r"must be \(f,\), found"),
    (lambda time, pressure: (time, np.nan * pressure), "no two stamps are within"),
    (lambda time, pressure: (time[:0], pressure[:0]), "no two stamps are within"),
    (
        lambda time, pressure: (time + 6.0, pressure),
        r"begins 5\.9 s after the IMU.*; let it begin at",
    ),
]


@pytest.mark.parametrize("change, words", MAGNETIC)
def test_a_field_that_cannot_be_is_refused(change, words):
    attitude = rotations(INTERVALS).as_matrix()
    with pytest.raises(InputError, match=rf"^magnetometer: .*{words}"):
        filtering.magnetometer_on_intervals(*change(*readings()), attitude, CONFIG, 7.0)


@pytest.mark.parametrize("change, words", BAROMETRIC)
def test_a_pressure_that_cannot_be_is_refused(change, words):
    time = np.arange(0, 25.0, 0.2)
    with pytest.raises(InputError, match=rf"^barometer: .*{words}"):
        rows = change(time, np.full(len(time), 101325.0))
        filtering.barometer_on_intervals(*rows, INTERVALS, CONFIG)


@pytest.mark.parametrize(
    "numbers, words",
    [
        ({"std": 0.0}, "std: found 0; it must be positive and finite"),
        ({"std": -2.0}, "std: found -2; it must be positive"),
        ({"std": np.nan}, "std: found nan; it must be positive"),
        ({"std": np.inf}, "std: found inf; it must be positive"),
        ({"walk": -0.1}, "walk: found -0.1; it must be finite and not negative"),
        ({"walk": np.nan}, "walk: found nan; it must be"),
        ({"start_height": np.nan}, "start_height: found nan; it must be finite"),
        ({"intervals": 0}, "intervals: found 0; give"),
    ],
)
def test_numbers_with_which_no_height_would_be_measured_are_refused(numbers, words):
    time = np.arange(0.0, 25.0, 0.2)
    arguments = {"intervals": INTERVALS, "config": CONFIG, **numbers}
    with pytest.raises(InputError, match=f"^barometer: {words}"):
        filtering.barometer_on_intervals(time, np.full(len(time), 101325.0), **arguments)


def test_numbers_with_which_no_heading_would_be_measured_are_refused():
    attitude = rotations(INTERVALS).as_matrix()
    for numbers, words in (
        *(({"std": std}, "std: found .*; it must be positive") for std in (0.0, -0.3, np.nan)),
        *(({"bias_std": std}, "bias_std: found .*; it must be") for std in (-0.01, np.nan)),
    ):
        with pytest.raises(InputError, match=f"^magnetometer: {words}"):
            filtering.fit_field(*readings(), attitude, CONFIG, 7.0, **numbers)


def test_attitudes_that_are_not_finite_take_no_part_in_the_fit():
    """Those of the beginning are needed. A run may have failed later."""
    attitude = rotations(INTERVALS).as_matrix()
    whole = filtering.fit_field(*readings(), attitude[:150], CONFIG, 7.0, first_seconds=10.0)
    attitude[150:] = np.nan
    fit = filtering.fit_field(*readings(), attitude, CONFIG, 7.0, first_seconds=10.0)
    np.testing.assert_allclose(fit.rows.direction[0], whole.rows.direction[0], rtol=1e-12)
    longer = filtering.fit_field(*readings(), attitude, CONFIG, 7.0, 0.3, 10.0, bias_std=0.1)
    assert np.isfinite(longer.gyro_bias).all()
    with pytest.raises(InputError, match=r"^magnetometer: rotation: not all attitudes"):
        filtering.fit_field(*readings(), attitude, CONFIG, 7.0, first_seconds=18.0)


def test_derivatives_are_finite_where_there_is_no_heading_or_no_reading():
    ekf = filtering.Filter(CONFIG)

    def loss(field, numbers, pressure):
        state = filtering.initial_state(ekf, jnp.eye(3), jnp.ones(3), jnp.zeros(3))
        step = filtering.Step(Imu(jnp.zeros((N, 3)), jnp.zeros((N, 3)), None), 0, 1, CONFIG, NOISE)
        state, magnet, _ = filtering.Magnetometer(field, *numbers).update(state, step)
        state, height, _ = filtering.Barometer(*pressure).update(state, step)
        return jnp.sum(state.rotation**3) + state.position[2] + magnet.nis + height.nis

    gradient = quick(jax.grad(loss, (0, 1, 2)))
    usual = np.array([DIRECTION, STRENGTH, DIP, 0.2]), np.array([1.0, 0.5, 0.0])
    for field in (WORLD, [0.0, 0.0, -40.0], [0.0, 0.0, 0.0], [np.nan, 1.0, 1.0], [1e9, 0.0, 0.0]):
        slopes = gradient(np.array(field), *usual)
        assert all(np.isfinite(slope).all() for slope in slopes), field
    for numbers, pressure in (
        (np.array([np.nan, 45.0, DIP, 0.2]), np.array([np.nan, 0.5, 0.0])),
        (np.array([DIRECTION, 45.0, DIP, 0.0]), np.array([1.0, 0.0, 0.0])),
    ):
        slopes = gradient(WORLD, numbers, pressure)
        assert all(np.isfinite(slope).all() for slope in slopes)
