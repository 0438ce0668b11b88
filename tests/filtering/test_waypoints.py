"""Poses of a computed walk that is known at a few moments, against the truth between these."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from gnio_jax.errors import InputError
from gnio_jax.filtering import waypoints as smoothing
from gnio_jax.filtering.state import Mean
from gnio_jax.types import GRAVITY, Prediction, Sequence, Waypoints
from tests.support import manifold
from tests.support.surveyor import survey

RATE, N, SECONDS, LEGS = 50.0, 10, 25.6, 4
BEGIN, YAW = 50.0, 0.4
EKF = filtering.Filter(
    filtering.FilterConfig(1 / RATE, N, 5),
    filtering.NoiseModel(3e-3, 3e-2, measurement_scale=1.0),
    filtering.InitialStd(),
)


def predict(windows):
    """A network that has learnt only that people walk at a metre a second where the phone's y axis
    points, and that there is no bounce where they rest."""
    bounce = jnp.std(windows[:, :, 2], axis=1)[:, None]
    ahead = jnp.clip(bounce / 1.5, 0, 1) * jnp.array([[0.0, 1.0, 0.0]], jnp.float32)
    return Prediction(ahead, jnp.broadcast_to(jnp.log(jnp.array([[0.3, 0.1, 0.1]])), ahead.shape))


@functools.cache
def walk():
    """Legs at speeds of 0.6 to 1.4 m/s with a second of rest and a turn before and after each; the
    phone before the body sways with the steps. The truth, with what an IMU measures of it."""
    rng = np.random.default_rng(0)
    time, duration = np.arange(0, SECONDS, 1 / RATE), SECONDS / LEGS
    leg, seconds = np.divmod(time, duration)
    leg = leg.astype(int)
    pace = rng.uniform(0.6, 1.4, LEGS)[leg]
    pace = pace * np.clip((np.minimum(seconds, duration - seconds) - 1.0) / 0.7, 0, 1)
    turns = np.cumsum([0.0, 1.2, -1.5, 0.8, 1.0])
    share = np.clip(seconds, 0, 1)
    yaw = YAW + turns[leg] + (turns[leg + 1] - turns[leg]) * share**2 * (3 - 2 * share)
    sway = 0.05 * np.sin(2 * np.pi * 1.8 * time)
    rotation = Rotation.from_euler("ZXY", np.column_stack([yaw, 0.3 + sway, 0.5 * sway]))
    velocity = pace[:, None] * np.stack([-np.sin(yaw), np.cos(yaw), 0 * yaw], axis=1)
    velocity[:, 2] = 4 * sway * (pace > 0.3)
    force = np.diff(velocity, axis=0, append=velocity[-1:]) * RATE + [0, 0, GRAVITY]
    steps = np.cumsum(0.5 * (velocity[:-1] + velocity[1:]) / RATE, axis=0)
    position = np.array([20.0, -7.0, 0.0]) + np.pad(steps, ((1, 0), (0, 0)))
    turn = (rotation[:-1].inv() * rotation[1:]).as_rotvec() * RATE
    gyro = np.concatenate([turn, turn[-1:]]) + 2e-3 * rng.normal(size=3)
    gyro = gyro + 0.02 * rng.normal(size=gyro.shape)
    accel = rotation.inv().apply(force) + 0.1 * rng.normal(size=gyro.shape)
    attitude, valid = np.roll(rotation.as_quat(), 1, axis=1), np.ones(len(time), bool)
    return Sequence("walk", BEGIN + time, gyro, accel, attitude, position, velocity, valid)


def tapped(numbers, wrong=None):
    """The walk with waypoints at the ends of legs and at two moments within each, tapped up to 0.3
    s too early or too late; those of `numbers`, of which `wrong` is a place 9 m off."""
    truth, rng = walk(), np.random.default_rng(1)
    moment = np.linspace(0, truth.time[-1] - BEGIN, 3 * LEGS + 1)
    columns = [np.interp(BEGIN + moment, truth.time, x) for x in truth.position.T[:2]]
    position = np.stack(columns, axis=1)
    moment[1:-1] += 0.3 * rng.uniform(-1, 1, len(moment) - 2)
    if wrong is not None:
        position[wrong] += [9.0, 0.0]
    return unknown(truth, Waypoints(BEGIN + moment[numbers], position[numbers]))


def unknown(truth, waypoints):
    empty = np.full_like(truth.position, np.nan)
    attitude, valid = np.full_like(truth.orientation, np.nan), np.zeros_like(truth.valid)
    poses = {"orientation": attitude, "position": empty, "velocity": empty, "valid": valid}
    return truth._replace(**poses, waypoints=waypoints)


def rms(error):
    return float(np.sqrt((error**2).sum(1).mean()))


def attitudes(sequence):
    return Rotation.from_quat(np.roll(sequence.orientation, -1, axis=1))


ALL = np.arange(3 * LEGS + 1)


@functools.cache
def smoothed_walk():
    """With all waypoints."""
    return filtering.waypoint_poses(tapped(ALL), predict, EKF, 0.1, 0.2)


@pytest.mark.parametrize("numbers, wrong", [(ALL[ALL % 3 != 1], None), (ALL, 5)])
def test_truer_than_curves_between_the_waypoints(numbers, wrong):
    """In place and speed, of legs whose waypoints within are left out, and with one waypoint in a
    wrong place, which loses its weight. The attitude is that of the map."""
    truth, sequence = walk(), tapped(numbers, wrong)
    poses, smoothed, weight = filtering.waypoint_poses(sequence, predict, EKF, 0.1, 0.2)
    stamps, target = sequence.waypoints
    line = np.stack([np.interp(truth.time, stamps, x) for x in target.T], axis=1)
    paths = [poses.position[:, :2], PchipInterpolator(stamps, target)(truth.time), line]
    error, *others = (rms(path - truth.position[:, :2]) for path in paths)
    assert error < 0.6 * min(others)
    # Over a second, as training asks.
    second = round(RATE)
    moves = [path[second:] - path[:-second] for path in (*paths, truth.position[:, :2])]
    error, *others = (rms(move - moves[-1]) for move in moves[:-1])
    assert error < 0.4 * min(others)
    angle = (attitudes(poses) * attitudes(truth).inv()).magnitude()
    assert np.degrees(angle).max() < 10
    far = np.arange(len(weight)) == (wrong if wrong is not None else -1)
    assert (weight[far] < 0.05).all() and (weight[~far] > 0.5).all()
    # The weights are those of Student's t with four degrees of freedom on the plane.
    for number, stamp in enumerate(stamps):
        point, speed = (
            np.array([np.interp(stamp, poses.time, x) for x in part.T[:2]])
            for part in (poses.position, poses.velocity)
        )
        spread = 0.1**2 * np.eye(2) + 0.2**2 * np.outer(speed, speed)
        error = target[number] - point
        square = error @ np.linalg.solve(spread, error)
        np.testing.assert_allclose(weight[number], 6 / (4 + square), rtol=1e-9)
    # What every sample has is what the clones have, and position and velocity are of one motion.
    np.testing.assert_allclose(poses.position[N::N], smoothed.position[:-1], atol=1e-9)
    np.testing.assert_allclose(poses.velocity[N::N], smoothed.velocity[:-1], atol=1e-9)
    # Where a tap moves the filter far, both are corrected by different amounts in second order.
    slope = np.gradient(poses.position, 1 / RATE, axis=0)[1:-1]
    difference = np.abs(slope - poses.velocity[1:-1])
    assert np.quantile(difference, 0.99) < 0.05 and difference.max() < 0.1
    inside = (truth.time >= stamps[0]) & (truth.time <= stamps[-1])
    np.testing.assert_array_equal(poses.valid, inside)
    assert poses.waypoints is None


# Walks that are refused
# ------------------------------------------------------------------------------------------------


def changed(array, row, value):
    array = np.array(array, float)
    array[row] = value
    return array


def waypoint_changes():
    """Waypoints that cannot be, with a part of what is said of them."""
    time, position = tapped(ALL).waypoints
    swapped = time[[0, 2, 1, *range(3, 13)]]
    yield None, "has no waypoints; leave out the walk"
    for waypoints, problem in (
        (Waypoints(time[:1], position[:1]), "are 1, at least 2 are needed"),
        (Waypoints(time[:0], position[:0]), "are 0, at least 2 are needed"),
        (Waypoints(changed(time, 4, np.nan), position), "are not all finite"),
        (Waypoints(time, changed(position, (4, 1), np.nan)), "are not all finite"),
        (Waypoints(time, changed(position, (4, 1), np.inf)), "are not all finite"),
        (Waypoints(swapped, position), "do not increase in time"),
        (Waypoints(time[::-1], position), "do not increase in time"),
        (Waypoints(changed(time, 4, time[3]), position), "do not increase in time"),
        (Waypoints(time[[0, 12, 12]], position[[0, 11, 12]]), "do not increase in time"),
        (Waypoints(changed(time, 12, 99.0), position), "are not all on the IMU's clock"),
        (Waypoints(changed(time, 0, 49.7), position), "are not all on the IMU's clock"),
    ):
        yield waypoints, f"field 'waypoints' .*{problem}.*; repair or leave out the walk"


@pytest.mark.parametrize(("waypoints", "text"), list(waypoint_changes()))
def test_waypoints_that_cannot_be_are_refused_in_one_line(waypoints, text):
    with pytest.raises(InputError, match=f"^walk: {text}$"):
        filtering.waypoint_poses(tapped(ALL)._replace(waypoints=waypoints), predict, EKF)


def shorten(sequence, stop):
    """The first samples of a walk, and the waypoints before the last of them."""
    fields = ("time", "gyro", "accel", "orientation", "position", "velocity", "valid")
    arrays = {name: getattr(sequence, name)[:stop] for name in fields}
    earlier = sequence.waypoints.time < sequence.time[stop - 1]
    waypoints = Waypoints(*(part[earlier] for part in sequence.waypoints))
    return sequence._replace(**arrays, waypoints=waypoints)


def test_an_imu_that_cannot_be_is_refused_in_one_line():
    sequence, samples = tapped(ALL), len(walk().time)
    jump = changed(sequence.time, slice(700, None), sequence.time[700:] + 0.5)
    rows = np.arange(samples)
    for spoilt, text in (
        (shorten(sequence, 49), "has 49 samples, at least 50 are needed"),
        (shorten(sequence, 1), "has 1 samples, at least 50 are needed"),
        (sequence._replace(time=rows / 100.0), r"its stamps are not uniform at 50 Hz \(median 100"),
        (sequence._replace(time=jump), r"its stamps are not uniform at 50 Hz \(median 50"),
        (sequence._replace(time=changed(sequence.time, 9, np.nan)), "its stamps are not uniform"),
        (
            sequence._replace(gyro=changed(sequence.gyro, 8, np.nan)),
            "field 'gyro' is not finite in",
        ),
        (sequence._replace(accel=changed(sequence.accel, 8, np.inf)), "field 'accel' is .* row 9;"),
        (sequence._replace(accel=0.01 * sequence.accel), "has no level start: .*shows no gravity"),
        (sequence._replace(imu_valid=rows < 49), "49 of its samples were measured, at least 50"),
        (
            sequence._replace(accel=changed(sequence.accel, 400, 1e200)),
            "the filter fails on it; leave",
        ),
        (  # 200 m/s for a moment: finite, but no filter that is healthy
            sequence._replace(accel=changed(sequence.accel, 400, 1e4)),
            "the filter fails on it; leave",
        ),
    ):
        with pytest.raises(InputError, match=f"^walk: {text}") as caught:
            filtering.waypoint_poses(spoilt, predict, EKF)
        assert "\n" not in str(caught.value) and "; " in str(caught.value)


def test_a_filter_without_float64_is_no_fault_of_the_walk():
    """Its remedy is a setting of JAX, or a filter in float32, and not to leave out the walk."""
    with jax.enable_x64(False), pytest.raises(ValueError, match=r"^gyro: the filter ru") as caught:
        filtering.waypoint_poses(tapped(ALL), predict, EKF)
    assert not isinstance(caught.value, InputError)
    assert str(caught.value).endswith(
        "found float32; call jax.config.update('jax_enable_x64', True) first, or ask for "
        "FilterConfig(allow_float32=True)"
    )


def test_waypoints_too_near_each_other_are_refused():
    """In one place, and in two places half a metre and three metres apart, between which the path
    errs by more."""
    sequence = tapped(ALL)
    time, position = sequence.waypoints
    for numbers, metres, text in (
        ([0, 6, 12], 0.0, "104°"),
        ([0, 12], 0.5, "104°"),
        ([0, 12], 3.0, "[4-9][0-9]°"),
    ):
        line = position[:1] + np.linspace(0, metres, len(numbers))[:, None] * [[0.6, 0.8]]
        waypoints = Waypoints(time[numbers], line)
        problem = f"^walk: its waypoints show its yaw to {text} only; add waypoints"
        with pytest.raises(InputError, match=problem):
            filtering.waypoint_poses(sequence._replace(waypoints=waypoints), predict, EKF, 0.1, 0.2)


def test_a_second_tap_at_one_place_changes_little():
    """It comes 20 ms before the other: the leg between both shows no speed, and the start, which is
    one against two, is no outlier."""
    sequence = tapped(ALL[[0, 12]])
    time, position = sequence.waypoints
    time = np.insert(time, 1, time[1] - 1 / RATE)
    for metres in (0.0, 0.5):
        places = np.insert(position, 1, position[1] + [metres, 0.0], axis=0)
        twice = sequence._replace(waypoints=Waypoints(time, places))
        _, smoothed, weight = filtering.waypoint_poses(twice, predict, EKF, 0.1, 0.2)
        _, once, _ = filtering.waypoint_poses(sequence, predict, EKF, 0.1, 0.2)
        np.testing.assert_allclose(smoothed.position, once.position, atol=2.5)
        variances = [part.covariance_diagonal[:, 6:8].sum(axis=1) for part in (smoothed, once)]
        assert np.sqrt(np.max(variances[0]) / np.max(variances[1])) < 1.5
        assert weight[0] > 1.0 and weight.min() > 0.3


def follow(windows):
    """A network that has learnt only that people walk at a metre a second where the phone's y axis
    points, and that follows it through corners."""
    yaw = jnp.cumsum(windows[:, :, 5], axis=1) / RATE
    ahead = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw), 0 * yaw], axis=2).mean(axis=1)
    return Prediction(ahead, jnp.broadcast_to(jnp.log(jnp.array([[0.3, 0.1, 0.1]])), ahead.shape))


@pytest.mark.parametrize("numbers", [[0, 2, 3], [0, 3]])
def test_few_waypoints_show_yaw_and_place_as_well_as_the_covariance_says(numbers):
    """On ten walks of 13 to 25 s with corners."""
    squares = []
    for seed in range(10):
        rng, (truth, ends) = np.random.default_rng([7, seed]), survey(seed, legs=3)
        time = ends + 0.2 * rng.normal(size=4)
        rows = np.searchsorted(truth.time, ends)
        position = truth.position[rows, :2] + 0.1 * rng.normal(size=(4, 2))
        taps = Waypoints(np.maximum(time, 0.0)[numbers], position[numbers])
        poses, smoothed, _ = filtering.waypoint_poses(unknown(truth, taps), follow, EKF, 0.1, 0.2)
        variance = smoothed.covariance_diagonal[: (len(truth.time) - 1) // N]
        clones = N * (1 + np.arange(len(variance)))
        yaw = (attitudes(poses) * attitudes(truth).inv()).as_rotvec()[clones, 2]
        error = (poses.position - truth.position)[clones, :2]
        squares.append([(yaw**2 / variance[:, 2]).mean(), (error**2 / variance[:, 6:8]).mean()])
    consistency = np.mean(squares, axis=0)
    assert (consistency > 0.4).all() and (consistency < 1.6).all()


def test_a_walk_whose_waypoints_lose_their_weight_is_refused():
    """Its gyro turns at 9° a second."""
    sequence = tapped(ALL)
    sequence = sequence._replace(gyro=sequence.gyro - np.array([0.0, 0.0, 0.15]))
    problem = "^walk: [0-9]+ of its 13 waypoints are far from the smoothed path; check"
    with pytest.raises(InputError, match=problem):
        filtering.waypoint_poses(sequence, predict, EKF, 0.1, 0.2)


def test_the_covariance_without_a_prior_of_the_yaw_has_the_information_of_the_rest():
    rng = np.random.default_rng(6)
    root = rng.normal(size=(15, 15))
    information, prior_std = root @ root.T + 15 * np.eye(15), 0.2
    information[2] *= 0.5
    information[:, 2] *= 0.5  # of the yaw, which the rest shows less well
    prior = np.zeros((15, 15))
    prior[2, 2] = 1 / prior_std**2
    covariance = np.linalg.inv(information + prior)[None]
    zero = np.zeros((1, 3))
    variance = np.diagonal(covariance, 0, 1, 2)
    history = filtering.SmoothedHistory(
        np.eye(3)[None], zero, zero, zero, zero, variance, covariance, np.ones(1)
    )
    honest = smoothing._without_yaw_prior(history, prior_std)
    expected = np.linalg.inv(information)
    assert expected[2, 2] > 1.5 * covariance[0, 2, 2]
    np.testing.assert_allclose(honest.covariance[0], expected, rtol=1e-9)
    np.testing.assert_allclose(honest.covariance_diagonal[0], np.diag(expected), rtol=1e-9)
    # Where nothing else shows the yaw, it is that of an angle of which nothing is known.
    alone = history._replace(covariance=np.eye(15)[None] * prior_std**2)
    honest = smoothing._without_yaw_prior(alone, prior_std)
    np.testing.assert_allclose(honest.covariance[0, 2, 2], np.pi**2 / 3)


def test_the_aligned_yaw_is_no_second_measurement(monkeypatch):
    """It comes from the waypoints. With a prior of half its standard deviation the yaw is as
    uncertain as with the whole one."""
    sequence = tapped(ALL[[0, 3, 6, 12]])
    _, whole, _ = filtering.waypoint_poses(sequence, predict, EKF, 0.3, 0.2)
    monkeypatch.setitem(smoothing.START_STD, "yaw", 0.1)
    _, half, _ = filtering.waypoint_poses(sequence, predict, EKF, 0.3, 0.2)
    variances = [part.covariance_diagonal[:, 2] for part in (half, whole)]
    np.testing.assert_allclose(*variances, rtol=0.2)
    assert variances[1].min() > 0.1**2


# The ends of a walk, and its gaps
# ------------------------------------------------------------------------------------------------


def test_the_factors_of_the_noise_count_once():
    """A network that is three times as uncertain is one whose covariance has a factor of 9. Both
    are trusted less than that without a factor."""

    def unsure(windows):
        prediction = predict(windows)
        return Prediction(prediction.displacement, prediction.log_std + jnp.log(3.0))

    factors = {"measurement_scale": 2.25, "std_factor": (2.0, 2.0, 2.0)}
    less = dataclasses.replace(EKF, noise=EKF.noise._replace(**factors))
    smoothed, other = (
        filtering.waypoint_poses(tapped(ALL), network, ekf, 0.1, 0.2).smoothed
        for network, ekf in ((predict, less), (unsure, EKF))
    )
    np.testing.assert_allclose(smoothed.position, other.position, atol=1e-5)
    np.testing.assert_allclose(smoothed.covariance_diagonal, other.covariance_diagonal, rtol=1e-4)
    variances = (part.covariance_diagonal[:, 6:8] for part in (smoothed, smoothed_walk().smoothed))
    assert np.divide(*(part.mean() for part in variances)) > 1.02


def test_a_raw_gyro_and_taps_beside_the_first_and_the_last_stamp():
    """The uniform clock begins up to a sample of the phone after the tap that began the recording,
    and ends before the one that ended it; a raw gyro starts with the wide prior of its bias, and
    another one does not."""
    sequence, variances = tapped(ALL), smoothed_walk().smoothed.covariance_diagonal
    ends = sequence.time[0] - 2.5 / RATE, sequence.time[-1] + 2.5 / RATE
    stamps = np.concatenate([ends[:1], sequence.waypoints.time[1:-1], ends[1:]])
    beyond = sequence._replace(waypoints=sequence.waypoints._replace(time=stamps))
    _, smoothed, _ = filtering.waypoint_poses(beyond, predict, EKF, 0.1, 0.2)
    np.testing.assert_allclose(smoothed.position, smoothed_walk().smoothed.position, atol=0.05)
    wide, bias = dataclasses.replace(EKF, raw_gyro_bias=0.05), 11  # of the gyro about z
    for compensated, least, most in (("no", 1.5, np.inf), ("Android's gyro bias", 1.0, 1.0)):
        phone = sequence._replace(attributes={"imu_compensated": compensated})
        _, smoothed, _ = filtering.waypoint_poses(phone, predict, wide, 0.1, 0.2)
        ratio = smoothed.covariance_diagonal[0, bias] / variances[0, bias]
        assert least - 1e-9 <= ratio <= most + 1e-9


def with_gap(sequence, rows):
    """The walk without these samples, which are interpolated as `resampled` does it."""
    arrays = {}
    for name in ("gyro", "accel"):
        values = np.array(getattr(sequence, name))
        edges = [rows[0] - 1, rows[-1] + 1]
        columns = [np.interp(rows, edges, column) for column in values[edges].T]
        values[rows] = np.stack(columns, axis=1)
        arrays[name] = values
    mask = ~np.isin(np.arange(len(sequence.time)), rows)
    return sequence._replace(**arrays, imu_valid=mask)


def test_a_gap_at_the_start_is_no_rest():
    """The first sample is measured, and then none for more than a second in which the phone turns
    evenly: a line between equal samples, quieter than a table."""
    sequence, truth = tapped(ALL), walk()
    sequence = sequence._replace(
        gyro=changed(sequence.gyro, 0, sequence.gyro[60]),
        accel=changed(sequence.accel, 0, sequence.accel[60]),
    )
    sequence = with_gap(sequence, np.arange(1, 60))
    assert np.abs(sequence.gyro[30]).max() > 0.2  # rad/s
    poses, smoothed, weight = filtering.waypoint_poses(sequence, predict, EKF, 0.1, 0.2)
    assert rms(poses.position[:, :2] - truth.position[:, :2]) < 0.3
    assert np.abs(smoothed.gyro_bias).max() < 0.02 and weight.min() > 0.5
    angle = (attitudes(poses) * attitudes(truth).inv())[60:].magnitude()
    assert np.degrees(angle).max() < 20


def test_without_a_window_that_was_measured_there_are_no_poses():
    sequence = tapped(ALL)._replace(imu_valid=np.arange(len(walk().time)) % 50 < 20)
    with pytest.raises(InputError, match=r"^walk: has no 1 s that were measured without a gap; l"):
        filtering.waypoint_poses(sequence, predict, EKF, 0.1, 0.2)


CUT, WHOLE = 827, 82
"""Samples of a walk that ends in the middle of a leg and of a clone interval, and its intervals."""


def test_a_walk_ends_with_its_samples():
    """No estimate is made with samples behind the end: those that follow the last whole interval
    change nothing before them, and their poses are integrated from the last estimate."""
    sequence = shorten(tapped(ALL), CUT)
    poses, smoothed, _ = filtering.waypoint_poses(sequence, predict, EKF, 0.1, 0.2)
    whole = shorten(tapped(ALL), WHOLE * N)
    assert len(whole.waypoints.time) == len(sequence.waypoints.time)
    expected = filtering.waypoint_poses(whole, predict, EKF, 0.1, 0.2)
    for part, other in zip(smoothed, expected.smoothed, strict=True):
        if part is not None:
            assert len(part) == WHOLE
            np.testing.assert_allclose(part, other, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(poses.position[: WHOLE * N], expected.sequence.position, atol=1e-9)
    last = {
        name: np.asarray(part[-1]) for name, part in smoothed._asdict().items() if part is not None
    }
    rotation, velocity, position = last["rotation"], last["velocity"], last["position"]
    for row in range(WHOLE * N, CUT):
        np.testing.assert_allclose(attitudes(poses)[row].as_matrix(), rotation, atol=1e-9)
        np.testing.assert_allclose(poses.velocity[row], velocity, atol=1e-9)
        np.testing.assert_allclose(poses.position[row], position, atol=1e-9)
        force = rotation @ (sequence.accel[row] - last["accel_bias"]) - [0.0, 0.0, GRAVITY]
        position = position + velocity / RATE + 0.5 * force / RATE**2
        velocity = velocity + force / RATE
        turn = (sequence.gyro[row] - last["gyro_bias"]) / RATE
        rotation = rotation @ Rotation.from_rotvec(turn).as_matrix()


def test_a_tap_after_the_last_whole_interval_is_taken():
    """It is the only one in the last five seconds: with it the end is where it was tapped."""
    truth, sequence = walk(), shorten(tapped(ALL), CUT)
    time, position = (part[:-3] for part in sequence.waypoints)
    row = CUT - 2
    taps = Waypoints(
        np.append(time, sequence.time[row]), np.vstack([position, truth.position[row, :2]])
    )
    moved = taps._replace(position=changed(taps.position, -1, taps.position[-1] + 0.5))
    ends = [
        filtering.waypoint_poses(sequence._replace(waypoints=waypoints), predict, EKF, 0.1, 0.0)
        for waypoints in (taps, moved)
    ]
    end, shifted = (poses.sequence.position[row, :2] for poses in ends)
    assert np.linalg.norm(end - truth.position[row, :2]) < 0.1
    np.testing.assert_allclose(shifted - end, 0.5, atol=0.15)


def test_taps_become_fixes_that_no_test_refuses():
    """In the intervals that the walk fills, behind which there is no rest; a small weight is a
    large covariance."""
    sequence = shorten(tapped(ALL), CUT)
    weight = np.linspace(0.1, 1.4, len(sequence.waypoints.time))
    walk_imu = smoothing._filled_walk(sequence, EKF.config)
    behind = np.linalg.norm(walk_imu.gyro[CUT:], axis=1)
    assert len(behind) == 128 * N - CUT and (behind > EKF.config.rest_gyro).all()
    fixes = smoothing._fixes(sequence, sequence.waypoints, weight, 0.1, 0.2, walk_imu, EKF.config)
    rows = np.flatnonzero(np.isfinite(fixes.position).all(axis=1))
    assert len(fixes.position) == len(walk_imu.gyro) // N == 128 and walk_imu.count == WHOLE
    assert len(rows) == len(weight) and rows[-1] < WHOLE
    assert np.isinf(fixes.threshold).all()
    np.testing.assert_array_equal(fixes.position[rows], sequence.waypoints.position)
    np.testing.assert_allclose(fixes.covariance[rows, 0, 0], 0.1**2 / weight)
    np.testing.assert_allclose(fixes.covariance[rows, 0, 1], 0.0)
    np.testing.assert_allclose(fixes.time_std[rows], 0.2 / np.sqrt(weight))
    stamps = sequence.time[0] + (rows + 1) * N / RATE - fixes.before_end[rows]
    np.testing.assert_allclose(stamps, sequence.waypoints.time, atol=1e-9)


def test_the_error_of_the_path_is_horizontal_and_no_displacement_is_of_samples_behind_the_walk():
    config, sequence = dataclasses.replace(EKF.config, history="core"), tapped(ALL)
    ekf = dataclasses.replace(EKF, config=config)
    imu = smoothing._filled_walk(shorten(sequence, CUT), config)
    level = smoothing._level_start(sequence, ekf)
    _, history = smoothing._odometry(predict, ekf, level, *imu[:2], None)
    displacement, covariance = smoothing._displacements(history, 0.4, imu.count, config)
    measured = np.arange(config.first_measured, WHOLE)
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(displacement[:, 0])), measured)
    np.testing.assert_array_equal(displacement[measured], history.displacement[measured])
    variances = np.exp(2 * np.log([0.3, 0.1, 0.1])) + np.array([0.4, 0.4, 0.0]) ** 2
    for row in measured:
        np.testing.assert_allclose(covariance[row], np.diag(variances), rtol=1e-6)


def test_between_estimates_lies_the_cubic_of_their_positions_and_velocities():
    """Where the IMU measures gravity alone; and from the end of the last whole interval on, a
    straight line."""
    rng, count, rows = np.random.default_rng(2), 5, 8
    rotation = Rotation.from_rotvec(rng.normal(size=(rows, 1)) * [[0.0, 0.0, 0.2]]).as_matrix()
    velocity, position = rng.normal(size=(2, rows, 3))
    ends = Mean(rotation, velocity, position, np.zeros((rows, 3)), np.zeros((rows, 3)))
    accel = np.tile([0.0, 0.0, GRAVITY], (rows * N, 1))
    poses = smoothing._between_clones(ends, np.zeros((rows * N, 3)), accel, count, EKF.config)
    time = np.arange(rows * N) / RATE
    stamps = (np.arange(rows) + 1) * N / RATE
    cubic = CubicHermiteSpline(stamps[:count], position[:count], velocity[:count])
    inside = slice(N, count * N)
    np.testing.assert_allclose(poses[2][inside], cubic(time[inside]), atol=1e-10)
    np.testing.assert_allclose(poses[1][inside], cubic(time[inside], 1), atol=1e-10)
    tail = slice(count * N, (count + 1) * N)
    line = position[count - 1] + (time[tail] - stamps[count - 1])[:, None] * velocity[count - 1]
    np.testing.assert_allclose(poses[2][tail], line, atol=1e-10)
    np.testing.assert_allclose(poses[1][tail], np.tile(velocity[count - 1], (N, 1)), atol=1e-10)
    for k in range(count):
        np.testing.assert_allclose(poses[0][(k + 1) * N], rotation[k], atol=1e-10)


def test_between_estimates_of_one_motion_lies_that_motion():
    """From the start on, which is before the first estimate."""
    rng, count = np.random.default_rng(3), 6
    gyro, accel = 2 * rng.normal(size=(count * N, 3)), 5 * rng.normal(size=(count * N, 3))
    rotation = Rotation.from_euler("xyz", [0.3, -0.4, 2.0]).as_matrix()
    state = rotation, np.array([1.0, -0.5, 0.2]), np.array([3.0, -2.0, 1.0])
    state = *state, np.array([0.1, -0.2, 0.15]), np.array([0.1, 0.05, -0.08])
    motion = [state]
    for k in range(count * N):
        motion.append(manifold.integrate(motion[-1], gyro[k : k + 1], accel[k : k + 1], 1 / RATE))
    ends = Mean(*(np.stack(part) for part in zip(*motion[N::N], strict=True)))
    poses = smoothing._between_clones(ends, gyro, accel, count, EKF.config)
    for part, expected in zip(poses, zip(*motion[:-1], strict=True), strict=False):
        np.testing.assert_allclose(part, np.stack(expected), atol=1e-9)


@pytest.mark.slow
def test_what_is_behind_the_end_is_no_rest():
    ekf = dataclasses.replace(EKF, measurements=(filtering.ZeroVelocity(0.02),))
    cut = shorten(tapped(ALL), CUT)
    poses, _, _ = filtering.waypoint_poses(cut, predict, ekf, 0.1, 0.2)
    np.testing.assert_allclose(poses.velocity[-1, :2], walk().velocity[CUT - 1, :2], atol=0.2)
