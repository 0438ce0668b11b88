"""Poses of a computed walk that is known at a few moments, against the truth between these."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from gnio_jax.errors import InputError
from gnio_jax.types import GRAVITY, Prediction, Sequence, Waypoints

RATE, N, SECONDS, LEGS = 50.0, 10, 25.6, 4
BEGIN, YAW = 50.0, 0.4
SETUP = filtering.FilterSetup(
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
    time, each = np.arange(0, SECONDS, 1 / RATE), SECONDS / LEGS
    leg, since = np.divmod(time, each)
    leg = leg.astype(int)
    pace = rng.uniform(0.6, 1.4, LEGS)[leg]
    pace = pace * np.clip((np.minimum(since, each - since) - 1.0) / 0.7, 0, 1)
    turns = np.cumsum([0.0, 1.2, -1.5, 0.8, 1.0])
    share = np.clip(since, 0, 1)
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


def tapped(taken, wrong=None):
    """The walk with waypoints at the ends of legs and at two moments within each, tapped up to 0.3
    s too early or too late; those of `taken`, of which number `wrong` is a place 9 m off."""
    truth, rng = walk(), np.random.default_rng(1)
    when = np.linspace(0, truth.time[-1] - BEGIN, 3 * LEGS + 1)
    place = np.stack([np.interp(BEGIN + when, truth.time, x) for x in truth.position.T[:2]], axis=1)
    when[1:-1] += 0.3 * rng.uniform(-1, 1, len(when) - 2)
    if wrong is not None:
        place[wrong] += [9.0, 0.0]
    return unknown(truth, Waypoints(BEGIN + when[taken], place[taken]))


def unknown(truth, waypoints):
    nothing = np.full_like(truth.position, np.nan)
    attitude, valid = np.full_like(truth.orientation, np.nan), np.zeros_like(truth.valid)
    poses = {"orientation": attitude, "position": nothing, "velocity": nothing, "valid": valid}
    return truth._replace(**poses, waypoints=waypoints)


def rms(error):
    return float(np.sqrt((error**2).sum(1).mean()))


ALL = np.arange(3 * LEGS + 1)


@pytest.mark.parametrize("taken, wrong", [(ALL[ALL % 3 != 1], None), (ALL, 5)])
def test_truer_than_curves_between_the_waypoints(taken, wrong):
    """In place and speed, of legs whose waypoints within are left out, and with one waypoint in a
    wrong place, which loses its weight. The attitude is that of the map."""
    truth, sequence = walk(), tapped(taken, wrong)
    found, smoothed, weight = filtering.waypoint_poses(sequence, predict, SETUP, 0.1, 0.2)
    stamps, place = sequence.waypoints
    line = np.stack([np.interp(truth.time, stamps, x) for x in place.T], axis=1)
    paths = [found.position[:, :2], PchipInterpolator(stamps, place)(truth.time), line]
    own, *others = (rms(path - truth.position[:, :2]) for path in paths)
    assert own < 0.6 * min(others)
    # Over a second, as training asks.
    second = round(RATE)
    moved = [path[second:] - path[:-second] for path in (*paths, truth.position[:, :2])]
    own, *others = (rms(each - moved[-1]) for each in moved[:-1])
    assert own < 0.4 * min(others)
    attitudes = [Rotation.from_quat(np.roll(x.orientation, -1, axis=1)) for x in (found, truth)]
    assert np.degrees((attitudes[0] * attitudes[1].inv()).magnitude()).max() < 10
    far = np.arange(len(weight)) == (wrong if wrong is not None else -1)
    assert (weight[far] < 0.05).all() and (weight[~far] > 0.5).all()
    # What every sample has is what the clones have, and position and velocity are of one motion.
    np.testing.assert_allclose(found.position[N::N], smoothed.position[:-1], atol=1e-9)
    np.testing.assert_allclose(found.velocity[N::N], smoothed.velocity[:-1], atol=1e-9)
    slope = np.gradient(found.position, 1 / RATE, axis=0)[1:-1]
    # Where a tap moves the filter far, both are corrected by different amounts in second order.
    off = np.abs(slope - found.velocity[1:-1])
    assert np.quantile(off, 0.99) < 0.05 and off.max() < 0.25
    inside = (truth.time >= stamps[0]) & (truth.time <= stamps[-1])
    np.testing.assert_array_equal(found.valid, inside)
    assert found.waypoints is None


@pytest.mark.parametrize(
    "change, text",
    [
        (dict(waypoints=Waypoints(np.array([51.0]), np.zeros((1, 2)))), "walk: has fewer than two"),
        (dict(time=np.arange(1280) / 100.0), "walk: has 1280 samples at 100 Hz, at least 50 at 50"),
        (dict(waypoints=Waypoints(np.array([51.0, 99.0]), np.eye(2))), "walk: has waypoints bef"),
    ],
)
def test_what_has_no_poses_is_refused_in_one_line(change, text):
    with pytest.raises(InputError, match=f"^{text}"):
        filtering.waypoint_poses(tapped(ALL)._replace(**change), predict, SETUP)


def test_less_trust_in_network_or_gyro_and_a_tap_beside_the_last_stamp():
    """The uniform clock ends up to a sample before the tap that ended the recording; a raw gyro
    starts with the wide prior of its bias."""
    sequence = tapped(ALL)
    _, smoothed, _ = filtering.waypoint_poses(sequence, predict, SETUP, 0.1, 0.2)
    variances = smoothed.covariance_diagonal
    late = np.append(sequence.waypoints.time[:-1], sequence.time[-1] + 0.5 / RATE)
    raw = sequence._replace(attributes={"imu_compensated": "no"})
    late = sequence._replace(waypoints=sequence.waypoints._replace(time=late))
    less = SETUP._replace(noise=SETUP.noise._replace(measurement_scale=9.0))
    horizontal, bias = slice(6, 8), 11  # of the position, and of the gyro about z
    _, smoothed, _ = filtering.waypoint_poses(late, predict, less, 0.1, 0.2)
    found = smoothed.covariance_diagonal[:, horizontal].mean()
    assert found > 1.02 * variances[:, horizontal].mean()
    wide = SETUP._replace(raw_gyro_bias=0.05)
    _, smoothed, _ = filtering.waypoint_poses(raw, predict, wide, 0.1, 0.2)
    assert smoothed.covariance_diagonal[0, bias] > 1.5 * variances[0, bias]


@pytest.mark.slow
def test_what_is_behind_the_end_is_no_rest():
    whole, end = tapped(ALL), 827  # in the middle of a leg
    fields = ("time", "gyro", "accel", "orientation", "position", "velocity", "valid")
    arrays = {name: getattr(whole, name)[:end] for name in fields}
    known = whole.waypoints.time < whole.time[end - 1]
    waypoints = Waypoints(whole.waypoints.time[known], whole.waypoints.position[known])
    setup = SETUP._replace(config=dataclasses.replace(SETUP.config, zero_velocity_std=0.02))
    cut = whole._replace(**arrays, waypoints=waypoints)
    found, _, _ = filtering.waypoint_poses(cut, predict, setup, 0.1, 0.2)
    np.testing.assert_allclose(found.velocity[-1, :2], walk().velocity[end - 1, :2], atol=0.2)
