"""The non-holonomic constraint: its update against finite differences, squared errors of simulated
rides, a slide, and its singular points."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import config as configuration
from gnio_jax import filtering
from gnio_jax.errors import InputError
from gnio_jax.filtering.checks import checked_state
from gnio_jax.filtering.gaps import Gap, Imu
from gnio_jax.filtering.nonholonomic import THRESHOLD, NonHolonomic, car_axes
from gnio_jax.types import Prediction
from tests.support import manifold
from tests.support.cars import drive
from tests.support.checks import unchecked
from tests.support.compiling import optimised, quick
from tests.support.random_walk import random_walk
from tests.support.walks import errors
from tests.support.whole_covariance import covariance

N, DT, RUNS, INTERVALS = 5, 0.02, 100, 200
MOUNTED = NonHolonomic(0.05, 0.1, 0.4, -0.3, 0.2, 1.2, -0.3, -0.8, 0.006, 0.002)
NOISE = filtering.NoiseModel(5e-4, 5e-3, 1e-5, 1e-4)
STD = filtering.InitialStd(0.02, 0.02, 0.5, 1e-3, 2e-3, 0.05)
CONFIG = filtering.FilterConfig(DT, N, 1, history="core")


@pytest.mark.parametrize("angles", [(0.4, -0.3, 0.2), (3.0, 1.2, -2.0), (0.0, np.pi / 2, 0.0)])
def test_the_axes_of_the_car_are_those_of_its_mounting(angles):
    expected = Rotation.from_euler("ZYX", angles).as_matrix().T
    np.testing.assert_allclose(car_axes(*angles), expected, atol=1e-12)


def predicted(poses, gyro, accel, car=MOUNTED):
    """Velocity of the point ahead, and across to the direction in which it goes, to the left and
    up, in NumPy, for poses with axes in front."""
    rotation, velocity, _, gyro_bias, accel_bias = poses
    in_body = np.einsum("...ji,...j->...i", rotation, velocity)
    in_body = in_body + np.cross(gyro - gyro_bias, np.array(car.lever))
    mounting = Rotation.from_euler("ZYX", car[2:5]).as_matrix()
    ahead, leftward, upward = np.moveaxis(in_body @ mounting, -1, 0)
    force_ahead, force_left, _ = np.moveaxis((accel - accel_bias) @ mounting, -1, 0)
    leftward = leftward + MOUNTED.sideslip_gradient * force_left * abs(ahead)
    upward = upward + MOUNTED.pitch_gradient * force_ahead * ahead
    return np.stack([ahead, leftward, upward], axis=-1)


def wheels(speeds):
    """Rows of a car with the same mounting, with one speed at every stamp."""
    time = np.linspace(0.0, 1.0, 11)
    return filtering.speeds_on_intervals(time, speeds * np.ones(11), 5, CONFIG, MOUNTED)


@pytest.mark.parametrize("sensor", ["constraint", "wheels"])
def test_an_update_is_the_textbooks_with_the_derivatives_by_finite_differences(sensor):
    config = dataclasses.replace(CONFIG, clones_per_window=4, error="additive")
    start, *signals = random_walk(5, n=N, clones=4, intervals=12, dt=DT, nan_rows=range(12))
    std = filtering.InitialStd(0.1, 0.1, 3.0, 1.0, 0.01, 0.1)
    ekf = filtering.Filter(config, NOISE, std)
    state, _ = filtering.run_filter(ekf, filtering.initial_state(ekf, *start), *signals)
    gyro, accel = np.random.default_rng(0).normal(size=(2, N, 3))
    accel = 3 * accel + [0.0, 0.0, 9.81]
    last = gyro[-1], accel.mean(axis=0)
    poses = [np.asarray(part) for part in state.mean]
    axes = slice(1, 3) if sensor == "constraint" else slice(0, 1)
    jacobian = manifold.differences(
        lambda errors: predicted(manifold.plus(poses, errors), *last)[..., axes], 15
    )
    residual, stds, measurement = -predicted(poses, *last)[axes], MOUNTED[:2], MOUNTED
    if sensor == "wheels":
        stds, at_end = [0.3], wheels(predicted(poses, *last)[0] + 0.4)
        residual, measurement = np.array([0.4]), jax.tree.map(lambda leaf: leaf[-1], at_end)
    before = np.asarray(covariance(state))
    rows = np.pad(jacobian, ((0, 0), (0, len(before) - 15)))
    spread = rows @ before @ rows.T + np.diag(np.square(stds))
    gain = np.linalg.solve(spread, rows @ before).T

    @quick
    def updated(state, gyro, accel):
        step = filtering.Step(Imu(gyro, accel, None), 0, 1, config, NOISE)
        return measurement.update(state, step)[:2]

    after, outcome = updated(state, gyro, accel)
    assert bool(outcome.accepted)
    np.testing.assert_allclose(outcome.residual, residual, atol=1e-12)
    nis = residual @ np.linalg.solve(spread, residual)
    np.testing.assert_allclose(outcome.nis, nis, rtol=1e-6)
    np.testing.assert_allclose(covariance(after), before - gain @ rows @ before, atol=1e-8)
    moved = manifold.plus(poses, (gain @ residual)[:15])
    for value, expected in zip(after.mean, moved, strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-7)


@optimised
def run(rides, constraint, speeds=None):
    def one(rotation, velocity, position, gyro, accel, displacement, speeds):
        ekf = filtering.Filter(CONFIG, NOISE, STD, measurements=(constraint,))
        state = filtering.initial_state(ekf, rotation, velocity, position)
        spread = jnp.tile(jnp.eye(3)[None], (len(displacement), 1, 1))
        rows = () if speeds is None else (speeds,)
        signals = ekf, state, gyro, accel, displacement, spread
        return filtering.run_filter(*signals, measurements=rows)[1]

    return jax.vmap(one)(*rides[:6], speeds)


def test_squared_errors_of_rides_are_as_the_covariance_says():
    """By degree of freedom, of 100 rides of 20 s; the mean of three components over 100 rides has a
    standard deviation of 0.08. Without the constraint the velocity would be off by metres."""
    rides = drive(2, RUNS, INTERVALS, N, DT, NOISE, STD, MOUNTED, *MOUNTED[:2])
    history = run(rides, MOUNTED)
    error, spread = errors(rides, history), np.asarray(history.covariance)
    parts = {
        "θ": [0, 1, 2],
        "v": [3, 4, 5],
        "p": [6, 7, 8],
        "b_g": [9, 10, 11],
        "b_a": [12, 13, 14],
    }
    for row in (9, 49, INTERVALS - 1):
        for name, index in parts.items():
            e, p = error[:, row][:, index], spread[:, row][:, index][:, :, index]
            nees = np.einsum("ri,ri->r", e, np.linalg.solve(p, e[:, :, None])[:, :, 0]) / 3
            assert 0.7 < nees.mean() < 1.35, (row, name, nees.mean())
    accepted = np.asarray(history.outcomes["nonholonomic"].accepted)
    assert 0.995 < accepted.mean() < 1.0
    moved = np.einsum("rkji,rkj->rki", history.rotation, history.velocity)
    moved = moved - np.einsum("rkji,rkj->rki", rides.rotation, rides.velocity)
    across = moved[:, -1] @ Rotation.from_euler("ZYX", MOUNTED[2:5]).as_matrix()[:, 1:]
    assert np.sqrt(np.mean(across**2)) < 0.15


def test_the_gradients_take_away_what_springs_and_tyres_do():
    """With a trust in the constraint that a car on springs breaks: squared errors of the velocity
    are several times those that the covariance says without the gradients, and right with them."""
    tight = MOUNTED._replace(lateral_std=0.05, vertical_std=0.05)
    rides = drive(5, 20, INTERVALS, N, DT, NOISE, STD, tight, 0.05, 0.05)
    rigid = tight._replace(pitch_gradient=0.0, sideslip_gradient=0.0)
    nees = {}
    for name, constraint in (("rigid", rigid), ("sprung", tight)):
        history = run(rides, constraint)
        error = errors(rides, history)[:, 49:, 3:6]
        spread = np.asarray(history.covariance)[:, 49:, 3:6, 3:6]
        whitened = np.linalg.solve(spread, error[..., None])[..., 0]
        nees[name] = np.mean(np.sum(error * whitened, axis=-1)) / 3
    assert nees["sprung"] < 1.5 < 3 < nees["rigid"]


ESTIMATED = MOUNTED._replace(mounting_std=0.1, lever_std=0.7)
SMALL = 0.1, 0.1
"""Standard deviations of the constraint that show a mounting, m/s."""


def with_errors(turn, step):
    """ESTIMATED with the errors ε and λ in its angles and its lever, by SciPy."""
    axes = Rotation.from_rotvec(turn) * Rotation.from_euler("ZYX", MOUNTED[2:5]).inv()
    return ESTIMATED._replace(
        **dict(zip(("yaw", "pitch", "roll"), axes.inv().as_euler("ZYX"), strict=True)),
        **dict(zip(("lever_x", "lever_y", "lever_z"), MOUNTED.lever + step, strict=True)),
    )


def test_an_update_of_the_mounting_is_the_textbooks_with_derivatives_by_finite_differences():
    """From errors that are far from zero, and correlated with the others."""
    rng = np.random.default_rng(3)
    ekf = filtering.Filter(CONFIG, NOISE, STD, measurements=(ESTIMATED,))
    rotation = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    velocity = rotation @ Rotation.from_euler("ZYX", MOUNTED[2:5]).as_matrix() @ [9.0, 0.3, -0.2]
    state = filtering.initial_state(ekf, rotation, velocity, np.ones(3))
    errors, half = rng.normal(size=6), rng.normal(size=(27, 27)) / 20
    state = state._replace(
        correlated=jnp.asarray(errors),
        core_covariance=jnp.asarray(half @ half.T),
        cross_covariance=jnp.zeros((27, 12)),
    )
    gyro, accel = rng.normal(size=(2, N, 3))
    accel = 3 * accel + [0.0, 0.0, 9.81]
    parts = [np.asarray(part) for part in state.mean]

    def predict(delta):
        """For changes (…, 21) of the pose with its biases, and of b."""
        rows = []
        for row in delta.reshape(-1, 21):
            turn, step = np.split((errors + row[15:]) * np.repeat([0.1, 0.7], 3), 2)
            poses = manifold.plus(parts, row[:15])
            car = with_errors(turn, step)
            rows.append(predicted(poses, gyro[-1], accel.mean(axis=0), car)[1:])
        return np.reshape(rows, (*delta.shape[:-1], 2))

    # In the state: θ, v, o, b_g, b_a, a, s, b. The position is not measured.
    columns = np.r_[0:15, 21:27]
    jacobian = np.zeros((2, 27))
    jacobian[:, columns] = manifold.differences(predict, 21)
    residual = -predict(np.zeros(21))
    before = np.asarray(state.core_covariance)
    spread = jacobian @ before @ jacobian.T + np.diag(np.square(MOUNTED[:2]))
    gain = np.linalg.solve(spread, jacobian @ before).T

    @quick
    def updated(state, gyro, accel):
        step = filtering.Step(Imu(gyro, accel, None), 0, 1, additive, NOISE)
        return ESTIMATED.update(state, step)[:2]

    additive = dataclasses.replace(CONFIG, error="additive")
    after, outcome = updated(state, gyro, accel)
    np.testing.assert_allclose(outcome.residual, residual, atol=1e-12)
    nis = residual @ np.linalg.solve(spread, residual)
    np.testing.assert_allclose(outcome.nis, nis, rtol=1e-6)
    assert bool(outcome.accepted)
    np.testing.assert_allclose(after.core_covariance, before - gain @ jacobian @ before, atol=1e-8)
    np.testing.assert_allclose(after.correlated, errors + (gain @ residual)[21:], atol=1e-8)
    with pytest.raises(ValueError, match="no errors of the mounting yet; take the final state"):
        ESTIMATED.mounting_at(state._replace(correlated=jnp.zeros(3)))
    axes, lever = ESTIMATED.mounting_at(state)
    car = with_errors(*np.split(errors * np.repeat([0.1, 0.7], 3), 2))
    np.testing.assert_allclose(axes, car_axes(car.yaw, car.pitch, car.roll), atol=1e-12)
    np.testing.assert_allclose(lever, car.lever, atol=1e-12)


def test_the_mounting_is_found_while_driving_with_the_covariance_that_the_errors_have():
    """60 cars with angles off by 0.05 rad and levers off by 0.7 m. Their roll hardly shows. With
    constants that are as wrong, the velocity errs by several times as much."""
    rng, stds = np.random.default_rng(7), (0.05, 0.7)
    true = rng.normal(size=(60, 6))
    runs = [
        drive(seed, 1, INTERVALS, N, DT, NOISE, STD, with_errors(*np.split(scaled, 2)), *SMALL)
        for seed, scaled in enumerate(true * np.repeat(stds, 3))
    ]
    rides = jax.tree.map(lambda *parts: np.concatenate(parts), *runs)
    constraint = MOUNTED._replace(
        **dict(zip(("lateral_std", "vertical_std"), SMALL, strict=True)),
        **dict(zip(("mounting_std", "lever_std"), stds, strict=True)),
    )

    @optimised
    def last_states(rides):
        def one(rotation, velocity, position, gyro, accel, displacement):
            ekf = filtering.Filter(CONFIG, NOISE, STD, measurements=(constraint,))
            state = filtering.initial_state(ekf, rotation, velocity, position)
            spread = jnp.tile(jnp.eye(3)[None], (len(displacement), 1, 1))
            signals = ekf, state, gyro, accel, displacement, spread
            return *filtering.run_filter(*signals), filtering.smooth(*signals)

        return jax.vmap(one)(*rides[:6])

    state, history, smoothed = last_states(rides)
    index = np.r_[22:27]  # without the roll
    error = (np.asarray(state.correlated) - true)[:, 1:]
    spread = np.asarray(state.core_covariance)[:, index][:, :, index]
    nees = np.einsum("ri,ri->r", error, np.linalg.solve(spread, error[..., None])[..., 0]) / 5
    assert 0.7 < nees.mean() < 1.4
    assert (np.sqrt(np.mean(error**2, axis=0)) < [0.15, 0.3, 0.6, 0.9, 1.1]).all()
    last, middle = INTERVALS - 1, INTERVALS // 2
    sizes = {}
    for name, estimate, row in (
        ("filtered", history, last),
        ("filtered before", history, middle),
        ("smoothed", smoothed, middle),
    ):
        error = errors(rides, estimate)[:, row, 3:9]
        spread = np.asarray(estimate.covariance)[:, row, 3:9, 3:9]
        nees = np.einsum("ri,ri->r", error, np.linalg.solve(spread, error[..., None])[..., 0]) / 6
        assert 0.7 < nees.mean() < 1.45, (name, nees.mean())
        sizes[name] = np.sqrt(np.mean(error[:, :3] ** 2))
    assert sizes["smoothed"] < 0.7 * sizes["filtered before"]
    unmoved = errors(rides, run(rides, MOUNTED))[:, last, 3:6]
    assert np.sqrt(np.mean(unmoved**2)) > 3 * sizes["filtered"]


def test_errors_of_the_mounting_forget_within_their_time_and_those_of_the_lever_never():
    """Without a measurement the variance stays as it is, and a known error is forgotten."""
    constraint = ESTIMATED._replace(mounting_seconds=2.0)
    ekf = filtering.Filter(CONFIG, NOISE, STD, measurements=(constraint,))
    seconds = CONFIG.clone_seconds
    decay = np.repeat([np.exp(-seconds / 2.0), 1.0], 3)
    np.testing.assert_allclose(ekf.decay(np.float64), decay)
    start = filtering.initial_state(ekf, np.eye(3), np.array([9.0, 0.0, 0.0]), np.zeros(3))
    begin = checked_state(start, ekf)
    np.testing.assert_array_equal(begin.core_covariance[21:, 21:], np.eye(6))
    begin = begin._replace(
        correlated=jnp.ones(6), core_covariance=begin.core_covariance.at[21:, 21:].set(0.0)
    )
    held = jnp.tile(jnp.asarray([[0.0, 0.0, 9.81]]), (N, 1))
    none = jnp.full((1, 3), jnp.nan), jnp.eye(3)[None]
    huge = constraint._replace(lateral_std=1e9, vertical_std=1e9)
    ekf = dataclasses.replace(ekf, measurements=(huge,))
    after, _ = filtering.run_filter(ekf, begin, jnp.zeros((N, 3)), held, *none)
    np.testing.assert_allclose(after.correlated, decay, atol=1e-9)
    spread = np.diag(1 - decay**2)
    np.testing.assert_allclose(after.core_covariance[21:, 21:], spread, atol=1e-9)


@pytest.mark.parametrize("speed", [8.0, -8.0])
def test_tyres_slip_outwards_in_either_direction_and_springs_bend_with_the_direction(speed):
    """On a hill of 10 % at constant speed, in a bend to the left of 2 m/s²."""
    car = NonHolonomic(pitch_gradient=0.005, sideslip_gradient=0.01)
    force = np.array([0.981, 2.0, 9.76])
    true = np.array([speed, -0.01 * 2.0 * abs(speed), -0.005 * 0.981 * speed])
    state = filtering.initial_state(filtering.Filter(CONFIG), np.eye(3), true, np.zeros(3))
    imu = Imu(jnp.zeros((N, 3)), jnp.tile(force, (N, 1)), None)
    _, outcome, _ = car.update(state, filtering.Step(imu, 0, 1, CONFIG, NOISE))
    np.testing.assert_allclose(outcome.residual, 0.0, atol=1e-12)


def test_samples_that_are_missing_have_no_part_in_the_force():
    force = np.tile([2.0, 1.0, 9.81], (N, 1))
    missing = np.array([True, False, True, False, False])
    state = filtering.initial_state(
        filtering.Filter(CONFIG), np.eye(3), np.array([9.0, 0.4, -0.3]), np.zeros(3)
    )
    residuals = []
    for samples in (force, np.where(missing[:, None], 1e3, force)):
        gap = Gap(*jnp.zeros((2, N)), jnp.ones(N), jnp.asarray(missing))
        step = filtering.Step(Imu(jnp.zeros((N, 3)), samples, gap), 0, 1, CONFIG, NOISE)
        residuals.append(MOUNTED.update(state, step)[1].residual)
    np.testing.assert_array_equal(*residuals)


def test_a_car_that_slides_is_not_believed_to_go_straight():
    """It drifts aside with up to 4 m/s for two seconds."""
    tight = MOUNTED._replace(lateral_std=0.1)
    seconds = np.arange(INTERVALS * N + 1) * DT
    slide = np.where(abs(seconds - 11) < 1, 2 + 2 * np.cos(np.pi * (seconds - 11)), 0.0)
    rides = drive(4, 1, INTERVALS, N, DT, NOISE, STD, tight, 0.02, 0.02, slide)
    history = run(rides, tight)
    accepted = np.asarray(history.outcomes["nonholonomic"].accepted[0])
    assert not accepted[107:114].any() and accepted[:99].mean() > 0.98 and accepted[-50:].all()
    lateral_axis = Rotation.from_euler("ZYX", tight[2:5]).as_matrix()[:, 1]
    rate = rides.gyro[0, 110 * N - 1] - history.gyro_bias[0, 109]
    velocity = history.rotation[0, 109].T @ history.velocity[0, 109]
    assert abs(lateral_axis @ (velocity + np.cross(rate, np.array(tight.lever))) - 4.0) < 0.3
    error = np.asarray(history.velocity[0]) - rides.velocity[0]
    assert np.abs(error[-1]).max() < 0.5


def test_wheels_show_the_speed_ahead():
    """Of 100 rides without the constraint; a speed of a kilometre a second is refused."""
    rides = drive(2, RUNS, INTERVALS, N, DT, NOISE, STD, MOUNTED, 0.05, 0.1)
    body = np.einsum("rkji,rkj->rki", rides.rotation, rides.velocity)
    body = body + np.cross(rides.gyro[:, N - 1 :: N] - rides.gyro_bias, np.array(MOUNTED.lever))
    ahead = Rotation.from_euler("ZYX", MOUNTED[2:5]).as_matrix()[:, 0]
    speed = body @ ahead + 0.3 * np.random.default_rng(0).normal(size=(RUNS, INTERVALS))
    speed[:, 100] = 1000.0
    speed[:, 110:120] = np.nan
    shape = RUNS, INTERVALS
    rows = jax.tree.map(lambda leaf: np.broadcast_to(leaf[0], shape + leaf.shape[1:]), wheels(0.0))
    free = MOUNTED._replace(lateral_std=1e6, vertical_std=1e6)
    history = run(rides, free, rows._replace(speed=speed))
    error, spread = errors(rides, history), np.asarray(history.covariance)
    forward = rides.rotation[:, -1] @ ahead
    errors_ahead = np.einsum("ri,ri->r", error[:, -1, 3:6], forward)
    outcome = history.outcomes["wheel_speed"]
    assert not np.asarray(outcome.accepted)[:, 100:101].any()
    assert not np.asarray(outcome.present)[:, 110:120].any()
    assert np.asarray(outcome.accepted)[:, 150:].mean() > 0.97
    v, p = error[:, -1, 3:6], spread[:, -1, 3:6, 3:6]
    nees = np.einsum("ri,ri->r", v, np.linalg.solve(p, v[:, :, None])[:, :, 0]) / 3
    assert nees.mean() < 1.5 and np.std(errors_ahead) < 1.0


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda time, speed: (time, 3.6 * speed), "108 m/s is beyond a car; divide km/h by 3.6"),
        (lambda time, speed: (time + 1e9, speed), "no two stamps are within the 0.5 s of the IMU"),
        (lambda time, speed: (time[::-1], speed), "time: does not increase"),
        (lambda time, speed: (time, speed[1:]), r"must be \(f,\), found"),
        (lambda time, speed: (time[:0], speed[:0]), "no two stamps are within"),
    ],
)
def test_a_speed_that_cannot_be_is_refused(change, words):
    rows = change(np.linspace(0.0, 1.0, 11), np.full(11, 30.0))
    with pytest.raises(InputError, match=rf"^wheel speed: .*{words}"):
        filtering.speeds_on_intervals(*rows, 5, CONFIG, MOUNTED)


@pytest.mark.parametrize(
    "numbers, words",
    [
        ({"std": 0.0}, "std: found 0; it must be positive and finite"),
        ({"std": -1.0}, "std: found -1; it must be"),
        ({"std": np.nan}, "std: found nan; it must be"),
        ({"mounting": MOUNTED._replace(yaw=np.nan)}, "yaw: found nan; it must be finite"),
        ({"mounting": MOUNTED._replace(lever_z=np.inf)}, "lever_z: found inf; it must be finite"),
        ({"intervals": 0}, "intervals: found 0; give"),
        ({"intervals": 5.0}, "intervals: found 5.0; give"),
        ({"config": filtering.Filter(CONFIG)}, "config: .* found Filter; give ekf.config"),
        (
            {"mounting": filtering.Mounting(0.1, 0.0, 0.0, 0.01)},
            r"mounting: .* found Mounting; write NonHolonomic\(yaw=mount",
        ),
        ({"mounting": None}, "mounting: must be a NonHolonomic, found NoneType"),
    ],
)
def test_numbers_with_which_no_speed_would_be_measured_are_refused(numbers, words):
    rows = np.linspace(0.0, 1.0, 11), np.full(11, 30.0)
    arguments = {"intervals": 5, "config": CONFIG, "mounting": MOUNTED, **numbers}
    with unchecked(), pytest.raises(InputError, match=f"^wheel speed: {words}"):
        filtering.speeds_on_intervals(*rows, **arguments)


def test_a_speed_of_which_a_number_is_missing_is_none_and_has_derivatives():
    row = filtering.WheelSpeed(9.0, 0.3, np.array([1.0, 0.0, 0.0]), np.array([0.5, 0.1, 0.2]))
    ekf = filtering.Filter(CONFIG)
    step = filtering.Step(Imu(jnp.ones((N, 3)), jnp.zeros((N, 3)), None), 0, 1, CONFIG, NOISE)

    @quick
    @functools.partial(jax.value_and_grad, has_aux=True)
    def loss(velocity, row):
        state = filtering.initial_state(ekf, jnp.eye(3), velocity, jnp.zeros(3))
        after, outcome, _ = row.update(state, step)
        return jnp.sum(after.velocity**2) + outcome.nis, outcome.present

    velocity = np.array([8.0, 0.2, 0.1])
    assert bool(loss(velocity, row)[0][1])
    for field in row._fields:
        lacking = row._replace(**{field: np.nan * getattr(row, field)})
        (_, present), slope = loss(velocity, lacking)
        assert not bool(present), field
        np.testing.assert_allclose(slope, 2 * velocity, err_msg=field)


def test_no_velocity_is_measured_where_the_rate_is_missing():
    gap = Gap(*jnp.zeros((2, N)), jnp.ones(N), jnp.zeros(N, bool))
    imu = Imu(jnp.zeros((N, 3)), jnp.zeros((N, 3)), gap)
    held = imu._replace(gap=gap._replace(missing=jnp.arange(N) == N - 1))
    ekf = filtering.Filter(CONFIG)
    state = filtering.initial_state(ekf, np.eye(3), np.ones(3), np.zeros(3))
    for samples, present in ((imu, True), (held, False)):
        step = filtering.Step(samples, 0, 1, CONFIG, NOISE)
        after, outcome, _ = MOUNTED.update(state, step)
        assert bool(outcome.present) == bool(outcome.accepted) == present
        assert np.array_equal(after.velocity, state.velocity) != present


def test_derivatives_are_finite_at_rest_and_with_the_axis_ahead_upright():
    """Also where the measurement is refused, and where the rate is missing."""
    ekf = filtering.Filter(CONFIG)

    def loss(numbers, velocity, missing=False):
        state = filtering.initial_state(ekf, jnp.eye(3), velocity, jnp.zeros(3))
        gap = Gap(*jnp.zeros((2, N)), jnp.ones(N), jnp.full(N, missing))
        imu = Imu(jnp.zeros((N, 3)), jnp.zeros((N, 3)), gap)
        step = filtering.Step(imu, 0, 1, CONFIG, NOISE)
        after, outcome, _ = NonHolonomic(*numbers).update(state, step)
        return jnp.sum(after.velocity**2) + outcome.nis

    gradient = quick(jax.grad(loss, (0, 1)))
    for velocity in (np.zeros(3), np.array([0.0, 100.0, 0.0]), np.array([10.0, 0.5, -0.2])):
        for pitch in (0.0, np.pi / 2, np.pi):
            numbers = np.array([*MOUNTED[:3], pitch, *MOUNTED[4:10]])
            for missing in (False, True):
                slopes = gradient(numbers, velocity, missing)
                assert all(np.isfinite(slope).all() for slope in slopes)


def test_a_network_gives_the_factors_of_both_standard_deviations():
    """Where it says nothing, the constants remain."""
    gyro = np.random.default_rng(1).normal(size=(N, 3))
    ekf = filtering.Filter(CONFIG)
    state = filtering.initial_state(ekf, np.eye(3), np.array([9.0, 0.4, -0.3]), np.zeros(3))

    def updated(constraint, factors=None):
        says = {} if factors is None else {"nonholonomic_log_factor": jnp.log(jnp.array(factors))}
        imu = Imu(jnp.asarray(gyro), jnp.zeros((N, 3)), None)
        step = filtering.Step(imu, 0, 1, CONFIG, NOISE, diagnostics=says)
        return constraint.update(state, step)[:2]

    wider = MOUNTED._replace(lateral_std=4 * MOUNTED[0], vertical_std=0.5 * MOUNTED[1])
    for factors, same in (([4.0, 0.5], wider), ([np.nan, 1.0], MOUNTED), ([1.0, 1.0], MOUNTED)):
        result, expected = updated(MOUNTED, factors), updated(same)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-6), result, expected)
    assert abs(updated(wider)[1].nis - updated(MOUNTED)[1].nis) > 0.5


def test_the_derivative_by_a_factor_is_finite_at_rest_and_where_there_is_none():
    ekf = filtering.Filter(CONFIG)

    def loss(log_factor, velocity):
        state = filtering.initial_state(ekf, jnp.eye(3), velocity, jnp.zeros(3))
        imu = Imu(jnp.zeros((N, 3)), jnp.zeros((N, 3)), None)
        says = {"nonholonomic_log_factor": log_factor}
        step = filtering.Step(imu, 0, 1, CONFIG, NOISE, diagnostics=says)
        after, outcome, _ = MOUNTED.update(state, step)
        return jnp.sum(after.velocity**2) + outcome.volume

    gradient = quick(jax.grad(loss))
    for velocity in (np.zeros(3), np.array([9.0, 0.02, -0.03])):
        assert np.isfinite(gradient(jnp.zeros(2), velocity)).all()
        assert np.abs(gradient(jnp.zeros(2), velocity)).min() > 0
        np.testing.assert_array_equal(gradient(jnp.array([jnp.nan, 0.0]), velocity), 0.0)


@functools.cache
def ride_with_factors():
    """A ride with a long hole, a filter that undoes a low-pass, and a network that says factors and
    no displacement: the arguments of a run after the network, and the compiled run."""
    config = dataclasses.replace(CONFIG, low_pass_seconds=0.05, bridge_seconds=2 * DT)
    config = dataclasses.replace(config, clones_per_window=3)
    ekf = filtering.Filter(config, NOISE, STD, measurements=(MOUNTED,))
    time = DT * np.arange(40 * N)[:, None]
    gyro = 0.1 * np.sin(time * [[1.0, 1.4, 0.6]])
    accel = np.cos(time * [[0.7, 1.1, 0.4]]) + np.array([0.0, 0.0, 9.81])
    valid = np.ones(len(time), bool)
    valid[17 * N + 1 : 18 * N + 3] = valid[52] = False
    start = filtering.initial_state(ekf, np.eye(3), np.array([8.0, 0.1, 0.0]), np.zeros(3))

    def predict(windows):
        factor = jnp.tanh(windows[:, -1, :2]) - 0.5
        nothing = jnp.full((len(windows), 3), jnp.nan, jnp.float32)
        diagnostics = {"nonholonomic_log_factor": factor}
        return Prediction(nothing, jnp.zeros_like(nothing), diagnostics)

    run = jax.jit(lambda *signals: filtering.run_odometry(predict, ekf, *signals))
    return (start, gyro, accel, valid), ekf, predict, run


def test_no_factors_come_from_a_window_in_which_the_filter_coasted():
    (start, *signals), ekf, _, run = ride_with_factors()
    _, history = run(start, *signals)
    present = np.isfinite(history.diagnostics["nonholonomic_log_factor"]).all(axis=1)
    # The third sample of the hole, 88, is the first that is not held, and 92 the last one.
    for k in range(40):
        first, stop = (k - 2) * N, (k + 1) * N
        assert present[k] == (k >= ekf.config.first_measured and not (first < 93 and stop > 88)), k


def test_with_factors_the_tracker_is_the_run_and_so_are_two_calls():
    (start, gyro, accel, valid), ekf, predict, run = ride_with_factors()
    final, history = run(start, gyro, accel, valid)
    tracker = filtering.Tracker(predict, ekf, start)
    broken = np.where(valid[:, None], gyro, np.nan)
    pushed = [
        tracker.push(*row) for row in zip(DT * np.arange(len(gyro)), broken, accel, strict=True)
    ]
    poses = [pose for pose in pushed if pose is not None]
    assert len(poses) == 40
    for name in ("rotation", "velocity", "position"):
        rows = np.array([getattr(pose, name) for pose in poses])
        np.testing.assert_allclose(rows, getattr(history, name), rtol=1e-9, atol=1e-9)
    state = start
    for rows in (slice(0, 18 * N), slice(18 * N, None)):
        state, _ = run(state, gyro[rows], accel[rows], valid[rows])
    np.testing.assert_allclose(state.position, final.position, atol=1e-9)


def test_a_run_with_factors_is_repeated_and_smoothed_without_its_network():
    """And without its factors it is another run."""
    signals, ekf, _, run = ride_with_factors()
    final, history = run(*signals)
    rows = (ekf, *signals[:3], *history.unscaled_displacements(NOISE), signals[3], "own")
    factors = {"diagnostics": history.diagnostics}
    again = filtering.run_filter(*rows, **factors)[1]
    np.testing.assert_allclose(again.position, history.position, atol=1e-9)
    other = filtering.run_filter(*rows)[1]
    assert np.abs(other.position - history.position).max() > 1e-4
    smoothed = filtering.smooth(*rows, **factors)
    np.testing.assert_allclose(smoothed.position[-1], final.position, atol=1e-9)


def test_it_is_a_measurement_of_the_settings():
    text = "filter: {measurements: {nonholonomic: {pitch: -0.01, lateral_std: 0.5}}}"
    settings = configuration.parse(text, "text")
    (constraint,) = filtering.make_filter(settings.data, settings.filter).measurements
    assert constraint == NonHolonomic(lateral_std=0.5, pitch=-0.01)
    assert not constraint.estimates_mounting
    text = "filter: {measurements: {nonholonomic: {mounting_std: 0.01, mounting_seconds: 20}}}"
    settings = configuration.parse(text, "text")
    (constraint,) = filtering.make_filter(settings.data, settings.filter).measurements
    assert constraint == NonHolonomic(mounting_std=0.01, mounting_seconds=20.0)
    text = "filter: {measurements: {nonholonomic: {mounting_seconds: 20}}}"
    settings = configuration.parse(text, "text")
    problem = "mounting_seconds' has no effect alone; write mounting_std: NUMBER, too"
    with pytest.raises(InputError, match=problem):
        filtering.make_filter(settings.data, settings.filter)
    assert THRESHOLD == pytest.approx(-2 * np.log(0.001), abs=1e-3)
