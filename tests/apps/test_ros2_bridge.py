"""The logic of the ROS 2 node, without ROS."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.filtering import Pose

BRIDGE = Path(__file__).parents[2] / "examples" / "ros2" / "gnio_odometry" / "bridge.py"
TURN = Rotation.from_euler("xyz", [0.3, -0.5, 1.2])
BIAS = np.array([0.01, -0.02, 0.03])
VELOCITY = np.array([1.0, 2.0, 3.0])
SQUARE = np.random.default_rng(0).normal(size=(15, 15))
COVARIANCE = SQUARE @ SQUARE.T


@pytest.fixture(scope="module")
def bridge():
    spec = importlib.util.spec_from_file_location("bridge", BRIDGE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Recorder:
    """A tracker that keeps what it is given and makes a pose of every second sample."""

    def __init__(self):
        self.samples = []

    def push(self, time, gyro, accel):
        if self.samples and time <= self.samples[-1][0]:
            raise ValueError(f"time: must increase, found {time}")
        self.samples.append((time, gyro, accel))
        if len(self.samples) % 2:
            return None
        moved = VELOCITY, np.array([4.0, 5.0, 6.0])
        remaining_fields = BIAS, np.zeros(3), COVARIANCE, 1.0, 1.0, True
        return Pose(time, TURN.as_matrix(), *moved, *remaining_fields)


def message(sec, nanosec, gyro=(0.1, 0.2, 0.3), accel=(0.0, 1.0, 9.8)):
    turned, pulled = (SimpleNamespace(**dict(zip("xyz", x, strict=True))) for x in (gyro, accel))
    header = SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec))
    return SimpleNamespace(header=header, angular_velocity=turned, linear_acceleration=pulled)


def in_body(error):
    """The velocity in the body for an error of the attitude (left, rad) and of the velocity."""
    return (Rotation.from_rotvec(error[:3]) * TURN).inv().apply(VELOCITY + error[3:])


def test_an_unknown_yaw_is_no_error_of_the_velocity_ahead(bridge):
    """A filter that has lost its yaw knows the velocity in the body as well as before."""
    recorder = Recorder()
    _, pose = (recorder.push(time, np.zeros(3), np.zeros(3)) for time in (0.0, 1.0))
    certain, turned = 0.1**2 * np.eye(15), np.zeros((15, 1))
    turned[2], turned[3:6, 0] = 1.0, np.cross([0.0, 0.0, 1.0], VELOCITY)
    level = np.append(VELOCITY[:2], 0.0)  # the lever of the yaw's arc, of second order
    first_order, arc = certain + turned @ turned.T, np.zeros((15, 15))
    arc[3:6, 3:6] = 0.75 * np.outer(level, level)

    def of_twist(covariance, invariant):
        relay = bridge.Bridge(Recorder(), invariant)
        relay.take(message(5, 0))
        return relay._odometry(pose._replace(covariance=covariance), np.zeros(3)).twist_covariance

    sure = of_twist(certain, False)
    np.testing.assert_allclose(of_twist(first_order, False), sure, atol=1e-12)
    np.testing.assert_allclose(of_twist(first_order + arc, True), sure, atol=1e-12)


def test_messages_become_odometry(bridge):
    tracker = Recorder()
    relay = bridge.Bridge(tracker, invariant=False)
    # Unix time in float64 would keep 0.24 µs.
    assert relay.take(message(1_700_000_000, 999_999_999)) is None
    odometry = relay.take(message(1_700_000_001, 4_999_999))
    first = (0.0, (0.1, 0.2, 0.3), (0.0, 1.0, 9.8))
    assert tracker.samples[0] == first and tracker.samples[1][0] == 5e-3
    assert odometry.stamp == (1_700_000_001, 4_999_999)
    assert odometry.position == (4.0, 5.0, 6.0)
    turned = Rotation.from_quat(odometry.orientation)
    np.testing.assert_allclose((turned * TURN.inv()).magnitude(), 0.0, atol=1e-12)
    np.testing.assert_allclose(TURN.apply(odometry.velocity), [1.0, 2.0, 3.0])
    pose = np.reshape(odometry.pose_covariance, (6, 6))
    np.testing.assert_array_equal(pose[:3, :3], COVARIANCE[6:9, 6:9])
    np.testing.assert_array_equal(pose[3:, 3:], COVARIANCE[:3, :3])
    np.testing.assert_array_equal(pose[:3, 3:], COVARIANCE[6:9, :3])
    twist = np.reshape(odometry.twist_covariance, (6, 6))
    slope = np.stack([(in_body(step) - in_body(-step)) / 2e-6 for step in 1e-6 * np.eye(6)], axis=1)
    expected = slope @ COVARIANCE[:6, :6] @ slope.T
    np.testing.assert_allclose(twist[:3, :3], expected, rtol=1e-6, atol=1e-6)
    assert twist[3, 3] == -1
    np.testing.assert_allclose(odometry.rate, [0.09, 0.22, 0.27])


def test_what_is_refused_and_what_diverged_is_not_published(bridge):
    relay = bridge.Bridge(Recorder())
    relay.take(message(5, 0))
    assert relay.take(message(5, 0)) is None
    assert relay.refused == 1 and relay.reason.startswith("time: must increase")
    assert relay.take(message(5, 10_000_000)) is not None
    tracker = Recorder()
    sound = tracker.push
    tracker.push = lambda *sample: (pose := sound(*sample)) and pose._replace(healthy=False)
    relay = bridge.Bridge(tracker)
    assert [relay.take(message(5, k)) for k in range(4)] == [None] * 4
    assert relay.refused == 2 and "diverged" in relay.reason
