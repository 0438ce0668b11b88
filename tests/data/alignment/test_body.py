"""An IMU on a tracked body: known mountings must come back, whatever the rates of its sensors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.data.alignment import body
from gnio_jax.data.assembly import Poses, Samples, Streams
from gnio_jax.data.dataset import Refusal
from tests.support import known_walk as walk
from tests.support.idol_files import BIAS

EXTRINSIC = Rotation.from_euler("ZXY", [-170.0, 3.0, 2.0], degrees=True)
LEVER = np.array([-0.02, 0.08, 0.01])
TILT = np.array([0.02, -0.01])


UP = np.array([*TILT, 1.0]) / np.linalg.norm([*TILT, 1.0])


def imu(gyro_hz=100.0, accel_hz=100.0, lag=0.0, delay=0.0, bias=0.0, start=-2.0, stop=42.0):
    """An IMU whose clock is `lag` (s) ahead of the tracker's, and whose accelerometer reports an
    event `delay` (s) late."""
    gyro, accel = (np.arange(start, stop, 1.0 / rate) for rate in (gyro_hz, accel_hz))
    return Streams(
        "walk",
        "walk",
        Samples(gyro + lag, walk.rate(gyro) + bias, "gyro"),
        Samples(accel + lag, walk.force(accel - delay), "accel"),
    )


def tracked(hz=100.0):
    """The marker body of that IMU, in a tilted world."""
    time = np.arange(0.0, 40.0, 1.0 / hz)
    tilted = Rotation.align_vectors(UP[None], [[0.0, 0.0, 1.0]])[0]
    attitude = tilted * walk.attitude(time) * EXTRINSIC.inv()
    position = tilted.apply(walk.position(time)) - attitude.apply(LEVER)
    return Poses(time, attitude, position, noisy=True)


@pytest.mark.parametrize(
    ("gyro_hz", "accel_hz", "track_hz"), [(90.3, 107.1, 60.0), (10.0, 10.0, 40.0)]
)
def test_a_known_mounting_is_found_on_a_late_clock(gyro_hz, accel_hz, track_hz):
    bias = np.array([0.01, -0.005, 0.02])
    streams = imu(gyro_hz, accel_hz, lag=0.7, delay=0.02, bias=bias)
    track = tracked(track_hz)
    fit = body.align(streams, track)
    assert np.degrees((fit.extrinsic * EXTRINSIC.inv()).magnitude()) < 0.1
    np.testing.assert_allclose(fit.lever, LEVER, atol=5e-3)
    np.testing.assert_allclose(fit.up, UP, atol=2e-3)
    np.testing.assert_allclose(fit.gyro_bias, bias, atol=1e-3)
    np.testing.assert_allclose(fit.lag, 0.7, atol=3e-3)
    assert fit.accel_delay == pytest.approx(0.02, abs=3e-3)
    assert fit.gyro_unexplained < 0.01 and fit.accel_unexplained < 0.01
    assert fit.runner_up < 0.5 and np.degrees(fit.turn_std) < 0.1
    # The poses are those of the IMU, in a level world, on its clock.
    poses = fit.poses
    assert poses.noisy and len(poses.time) == len(track.time)
    event = poses.time - 0.7
    turned = poses.attitude * walk.attitude(event).inv()
    yaw = Rotation.from_euler("z", turned.mean().as_euler("ZXY")[0])
    assert np.degrees((turned * yaw.inv()).magnitude()).max() < 0.3
    positions = poses.position + poses.attitude.apply(poses.lever)
    np.testing.assert_allclose(positions, yaw.apply(walk.position(event)), atol=0.02)


def test_jumps_and_drop_outs_and_repeated_rows_bend_nothing():
    """The poses of a jump are left out, what the IMU did not measure is no evidence, and rows may
    be out of order or there twice."""
    streams, track, sensors = imu(), tracked(), []
    jumped = (track.time > 22.5) & (track.time < 22.8)
    track.position[jumped] += [0.4, 0.2, 0.1]
    for sensor in (streams.gyro, streams.accel):
        rows = np.flatnonzero((sensor.time % 4.0 > 1.9) | (sensor.time < 1.0)).repeat(2)
        rows[100:120] = rows[100:120][::-1]
        sensors.append(sensor._replace(time=sensor.time[rows], values=sensor.values[rows]))
    fit = body.align(streams._replace(gyro=sensors[0], accel=sensors[1]), track)
    np.testing.assert_allclose(fit.lever, LEVER, atol=5e-3)
    np.testing.assert_allclose(fit.lag, 0.0, atol=3e-3)
    assert fit.gyro_unexplained < 0.001 and fit.accel_unexplained < 0.001
    times = fit.poses.time - fit.lag.mean()
    assert np.abs(times[:, None] - [22.5, 22.8]).min() > 0.05
    assert len(track.time) - 150 < len(times) < len(track.time) - 20
    # Of a fit the worst tenth of the rows is not asked.
    error = np.full((100, 3), 0.1)
    error[:9] = 100.0
    assert body.unexplained_share(error, np.ones((100, 3))) == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("streams", "problem", "rows"),
    [
        (imu(lag=60.0), "less than 10 s of the track overlap", slice(None)),
        (imu(stop=7.0), "less than 10 s are recorded in gyro", slice(None)),
        (imu(), "poses in a row", np.flatnonzero(np.arange(4000) % 40 < 4)),
    ],
)
def test_too_little_is_refused(streams, problem, rows):
    with pytest.raises(body.TooLittle, match=problem):
        body.align(streams, tracked().rows(rows))


@pytest.mark.parametrize("strength", [0.5, 0.0])
@pytest.mark.filterwarnings("error")
def test_a_mounting_that_the_motion_does_not_tell_is_uncertain(strength):
    """A body that turns about the vertical alone on its place, or rests: all is explained, whatever
    the yaw of the mounting."""
    time, axis = np.arange(0.0, 40.0, 0.01), np.array([0.0, 0.0, 1.0])
    attitude = Rotation.from_rotvec(np.multiply.outer(strength * np.sin(3.0 * time), axis))
    gyro = np.multiply.outer(3.0 * strength * np.cos(3.0 * time), axis)
    noise = 1e-3 * np.random.default_rng(0).standard_normal((2, len(time), 3))
    up = np.array([0.0, 0.0, 9.81])
    streams = Streams.of_imu("still", "still", time, gyro + noise[0], up + noise[1])
    poses = Poses(time, attitude * EXTRINSIC.inv(), np.zeros((len(time), 3)), noisy=True)
    fit = body.align(streams, poses)
    assert np.degrees(fit.turn_std) > 10.0
    with pytest.raises(Refusal, match=r"mounting's uncertainty|does not move as"):
        body.check_fit(fit, "track", {"mounting's uncertainty": (2.0, "°")})


def test_poses_near_flips_and_jumps_are_dropped():
    time = np.arange(0.0, 5.0, 0.01)
    angles = np.zeros(len(time))
    angles[100:103] = np.radians(30.0)
    position = np.zeros((len(time), 3))
    position[300:] += [0.0, 0.5, 0.0]
    poses = Poses(time, Rotation.from_rotvec(angles[:, None] * [0.0, 1.0, 0.0]), position)
    steady_poses = body.without_jumps(poses, np.radians(600.0), 10.0)
    times = set(np.round(steady_poses.time, 2))
    lost = set(np.round(time, 2)) - times
    assert lost == {round(0.01 * i, 2) for i in (*range(89, 114), *range(289, 311))}
    untouched = body.without_jumps(poses._replace(time=time * 100), 1e3, 1e3)
    assert len(untouched.time) == len(time)


def test_the_jacobians_are_the_differences_of_the_errors():
    streams, tracker = imu(), body._tracker_signals(tracked())
    felt = body._inertial_signals(streams)
    knots = body.uniform_knots(tracker.time, 15.0)
    rows = slice(10, -10, 7)
    tracker, hats = tracker.rows(rows), body.hat_functions(tracker.time, knots)[rows]
    lag = np.array([0.01, -0.02, 0.03, 0.0])
    turn, biases = np.array([0.1, -0.2, 0.1]), np.array([0.01, -0.02, 0.005, 0.1, 0.05, -0.08])
    x = np.concatenate([turn, biases, LEVER + 0.03, [0.2, -0.1], [0.013], lag])
    problem = body.Problem(tracker, felt, hats, EXTRINSIC)
    jacobians = problem.jacobians(x)
    for column, step in enumerate(1e-5 * np.eye(len(x))):
        pairs = zip(jacobians, problem.errors(x + step), problem.errors(x - step), strict=True)
        for jacobian, after, before in pairs:
            expected = (after - before) / 2e-5
            tolerance = 2e-3 * np.abs(expected).max() + 1e-6
            np.testing.assert_allclose(jacobian[:, :, column], expected, atol=tolerance, rtol=0)


def test_whitened_errors_have_the_covariance_of_white_noise_with_shared_offsets():
    counts, spread, scale = np.array([3, 5]), np.array([0.9, 0.8]), 0.1
    noise = body._Noise(scale, np.array([0, 3]), counts, spread)
    blocks = [np.eye(n) + (s**2 - 1 / n) for n, s in zip(counts, spread, strict=True)]
    covariance = np.zeros((8, 8))
    covariance[:3, :3], covariance[3:, 3:] = scale**2 * blocks[0], scale**2 * blocks[1]
    errors = np.random.default_rng(0).standard_normal((8, 3))
    expected = np.einsum("ik,ij,jk->", errors, np.linalg.inv(covariance), errors)
    assert (noise.whiten(errors) ** 2).sum() == pytest.approx(expected, rel=1e-12)
    jacobian = np.random.default_rng(1).standard_normal((8, 3, 2))
    np.testing.assert_allclose(noise.whiten(jacobian)[:, 1], noise.whiten(jacobian[..., 1]))


@pytest.mark.parametrize(("lag", "hz"), [(-0.12, 100), (0.033, 60)])
def test_lag_from_noisy_rates_with_a_bias(lag, hz):
    noise = np.random.default_rng(1)
    time, stamps = np.arange(0, 60, 0.01), np.arange(0, 60, 1.0 / hz)
    gyro = walk.rate(time) + BIAS + noise.normal(0, 0.02, (len(time), 3))
    gyro[2000:2020] += 8.0  # a knock
    shaken = Rotation.from_rotvec(noise.normal(0, np.radians(0.05), (len(stamps), 3)))
    poses, keep = walk.attitude(stamps - lag) * shaken, (stamps < 30) | (stamps > 30.4)
    fit = body.pose_lag(time, gyro, stamps[keep], poses[keep])
    assert fit.lag == pytest.approx(lag, abs=3e-3) and fit.correlation > 0.5


def test_poses_of_another_time_or_of_what_stands_still_tell_nothing_of_a_lag():
    time = np.arange(0, 40, 0.01)
    for stamps in (time + 100.0, time[:1], np.zeros(2)):
        attitude = walk.attitude(stamps)
        assert body.pose_lag(time, walk.rate(time), stamps, attitude).correlation == 1.0
    gyro = 0.01 + np.random.default_rng(0).normal(0, 0.005, (len(time), 3))
    still = body.pose_lag(time, gyro, time, Rotation.identity(len(time)))
    assert still == body.PoseLag(0.0, 1.0)
