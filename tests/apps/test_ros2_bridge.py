"""The logic of the ROS 2 node, without ROS."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.filtering import Pose
from gnio_jax.filtering.resampler import Stream, create_grid

PACKAGE = Path(__file__).parents[2] / "examples" / "ros2" / "gnio_odometry"
TURN = Rotation.from_euler("xyz", [0.3, -0.5, 1.2])
BIAS = np.array([0.01, -0.02, 0.03])
VELOCITY = np.array([1.0, 2.0, 3.0])
SQUARE = np.random.default_rng(0).normal(size=(15, 15))
COVARIANCE = SQUARE @ SQUARE.T


def load(name):
    spec = importlib.util.spec_from_file_location(name, PACKAGE / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def bridge():
    return load("bridge")


class Recorder:
    """A tracker that keeps what it is given and makes a pose of every second sample."""

    def __init__(self):
        self.samples = []

    def push(self, time, gyro, accel):
        if max(map(abs, gyro)) > 100:
            raise ValueError("gyro: no IMU measures more than 100 rad/s")
        if self.samples and not 0 < time - self.samples[-1][0] <= 60:
            raise ValueError(f"time: must increase, found {time}")
        self.samples.append((time, gyro, accel))
        if len(self.samples) % 2:
            return None
        moved = VELOCITY, np.array([4.0, 5.0, 6.0])
        remaining_fields = BIAS, np.zeros(3), COVARIANCE, 1.0, 1.0, True
        return Pose(time, TURN.as_matrix(), *moved, *remaining_fields)

    @property
    def newest(self):
        return self.samples[-1][0] if self.samples else np.nan

    def restart(self):
        self.samples = []


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


def at(seconds, **sensors):
    return message(int(seconds), round(seconds % 1 * 1e9), **sensors)


OLD, NEW = 100 + np.arange(20) / 100, np.arange(40) / 100


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (np.zeros(1), 1.7e9 + NEW, "1.7e+09 s after"),
        (OLD, 170 + NEW, "69.9 s after"),
        (OLD, 20 + NEW, "80.1 s before"),
    ],
    ids=["no stamp at first", "a pause", "set back"],
)
def test_stamps_that_go_on_elsewhere_start_the_tracker_anew(bridge, before, after, words):
    tracker = Recorder()
    relay = bridge.Bridge(tracker)
    for seconds in before:
        relay.take(at(seconds))
    published = [relay.take(at(seconds)) for seconds in after]
    assert relay.restarts == 1 and relay.refused == 10 and words in relay.reason
    assert not any(published[:11]) and all(published[11::2])
    # The stamps count from the first message of the new clock.
    times = [sample[0] for sample in tracker.samples]
    np.testing.assert_allclose(times, after[10:] - after[10], atol=1e-6)
    newest = published[39].stamp
    assert newest[0] + newest[1] / 1e9 == pytest.approx(after[39], abs=1e-6)


@pytest.mark.parametrize(
    "strays",
    [
        20 + NEW[:9],  # too few
        20 + np.zeros(30),  # one stamp again and again
        np.where(np.arange(30) % 2, 20, 5000) + NEW[:30],  # of two clocks
        100.1 + NEW[:9].repeat(2),  # late by less than 0.1 s
        100.1 + np.arange(30) / 1000,  # and each after the one before
    ],
)
def test_some_wrong_stamps_cost_their_messages_alone(bridge, strays):
    relay = bridge.Bridge(Recorder())
    for seconds in OLD:
        relay.take(at(seconds))
    assert not any(relay.take(at(seconds)) for seconds in strays)
    assert relay.refused == len(strays) and relay.restarts == 0
    assert relay.take(at(100.5)) is None and relay.take(at(100.51)) is not None


def test_messages_of_two_clocks_in_turn_do_not_start_the_tracker_anew(bridge):
    relay = bridge.Bridge(Recorder())
    for k in range(100):
        relay.take(at(100 + k / 100))
        relay.take(at(20 + k / 100))
    assert relay.restarts == 0 and relay.refused == 100


@pytest.mark.parametrize("alone", [[], [150.0], [150.0, 155.0]])
def test_a_message_alone_in_a_pause_does_not_count_as_the_newest(bridge, alone):
    """The stream of samples does not trust a stamp that jumps until the next one agrees with it."""

    class OfStream(Recorder):
        stream = Stream(create_grid(0.01, None, 100.0))
        newest = property(lambda self: self.stream.newest)

        def push(self, time, gyro, accel):
            self.stream.push(time, (*gyro, *accel))

    tracker = OfStream()
    relay = bridge.Bridge(tracker)
    for seconds in [*OLD, *alone]:
        relay.take(at(seconds))
    assert tracker.newest == pytest.approx(OLD[-1] - OLD[0]) and relay.refused == 0
    for seconds in 180 + NEW[:10]:
        relay.take(at(seconds))
    assert relay.restarts == 1 and relay.refused == 10


def test_impossible_values_are_no_other_clock(bridge):
    relay = bridge.Bridge(Recorder())
    for seconds in OLD:
        assert relay.take(at(seconds, gyro=(500.0, 0.0, 0.0))) is None
    assert relay.refused == len(OLD) and relay.restarts == 0 and "rad/s" in relay.reason


class RosNode:
    """What the node uses of `rclpy.node.Node`. The log keeps what ROS would not throttle."""

    def __init__(self, _):
        self.log, self.published = [], []

    def declare_parameter(self, _, default):
        return SimpleNamespace(value=default)

    def create_publisher(self, *_):
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, *_):
        pass

    def get_logger(self):
        def warning(text, throttle_duration_sec=None):
            if throttle_duration_sec is None:
                self.log.append(text)

        return SimpleNamespace(info=self.log.append, warning=warning)


class RosMessage:
    """A message of ROS: every field has fields."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        self.__dict__[name] = RosMessage()
        return self.__dict__[name]


def test_the_node_logs_once_that_it_starts_anew(bridge, monkeypatch):
    profile = {"QoSProfile": lambda **_: None, "ReliabilityPolicy": RosMessage()}
    broadcaster = {"TransformBroadcaster": lambda _: SimpleNamespace(sendTransform=id)}
    modules = {
        "rclpy": {},
        "rclpy.executors": {"ExternalShutdownException": Exception},
        "rclpy.node": {"Node": RosNode},
        "rclpy.qos": profile,
        "geometry_msgs.msg": {"TransformStamped": RosMessage},
        "nav_msgs.msg": {"Odometry": RosMessage},
        "sensor_msgs.msg": {"Imu": RosMessage},
        "tf2_ros": broadcaster,
        "gnio_odometry.bridge": vars(bridge),
    }
    for name, content in modules.items():
        module = SimpleNamespace(**content)
        monkeypatch.setitem(sys.modules, name.partition(".")[0], module)
        monkeypatch.setitem(sys.modules, name, module)
    node = load("node")
    network = SimpleNamespace(config=SimpleNamespace(data=None, filter=None))
    ekf = SimpleNamespace(config=SimpleNamespace(invariant=True))
    monkeypatch.setattr(node.networks, "load", lambda _: network)
    monkeypatch.setattr(node.filtering, "make_filter", lambda *_: ekf)
    monkeypatch.setattr(node, "create_tracker", lambda *_: Recorder())
    odometry = node.GnioOdometry()
    for seconds in (*OLD, *(20 + NEW)):
        content = at(seconds)
        content.header.frame_id = ""
        odometry._take(content)
    ready, anew = odometry.log
    assert ready == "ready with pedestrian; keep the device still for 1 s"
    assert "80.1 s before" in anew and anew.endswith("keep the device still for 1 s")
    assert len(odometry.published) == len(OLD) // 2 + (len(NEW) - 10) // 2
    assert odometry.published[-1].child_frame_id == "imu_link"
