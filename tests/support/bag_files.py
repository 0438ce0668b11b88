"""Writes the known walk as robots record it, by the writers of `rosbags` and `mcap`.

`write(path, kind, topics)` takes rows (topic, type, ns, message); the makers below give them.
"""

import functools
from pathlib import Path

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from tests.support import known_walk

EPOCH = 1_600_000_000_500_000_000
SECONDS = 6.0
LOGGED = 40_000_000
"""ns by which the bag's stamps follow those of the headers."""
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
KINDS = ("rosbag1", "rosbag2", "db3", "bag of mcap", "mcap", "mcap of ros1")


def store_of(kind):
    return ROS1 if kind in ("rosbag1", "mcap of ros1") else ROS2


class Maker:
    """Messages of one ROS."""

    def __init__(self, kind="mcap", headers=True):
        self.store, self.headers = store_of(kind), headers

    def new(self, name, *fields):
        return self.store.types[name](*fields)

    def header(self, time, frame):
        stamp = EPOCH + round(time * 1e9) if self.headers else 0
        now = self.new("builtin_interfaces/msg/Time", stamp // 10**9, stamp % 10**9)
        first = (0,) if self.store is ROS1 else ()
        return self.new("std_msgs/msg/Header", *first, now, frame)

    def vector(self, values, name="Vector3"):
        return self.new(f"geometry_msgs/msg/{name}", *map(float, values))

    def pose(self, time, mount):
        """Of the body on which the IMU sits at `mount` (rotation, lever)."""
        quaternion, position = _body(time, tuple(mount[0].as_quat()), tuple(mount[1]))
        turn = self.new("geometry_msgs/msg/Quaternion", *quaternion)
        return self.new("geometry_msgs/msg/Pose", self.vector(position, "Point"), turn)

    def joined(self, header, child, position, turn):
        moved = self.new("geometry_msgs/msg/Transform", self.vector(position), turn)
        return self.new("geometry_msgs/msg/TransformStamped", header, child, moved)

    def transform(self, time, mount, frame, child):
        pose = self.pose(time, mount)
        position = [pose.position.x, pose.position.y, pose.position.z]
        return self.joined(self.header(time, frame), child, position, pose.orientation)

    def static(self, parent, child, rotation, lever):
        turn = self.new("geometry_msgs/msg/Quaternion", *rotation.as_quat().tolist())
        one = self.joined(self.header(0.0, parent), child, lever, turn)
        return self.new("tf2_msgs/msg/TFMessage", [one])


@functools.cache
def _body(time, turn, lever):
    attitude = known_walk.attitude(time) * Rotation.from_quat(turn).inv()
    return attitude.as_quat().tolist(), known_walk.position(time) - attitude.apply(lever)


def rows(topic, name, times, message):
    return [
        (topic, name, EPOCH + LOGGED + round(float(time) * 1e9), message(float(time)))
        for time in times
    ]


def clock(rate, seconds=SECONDS):
    return np.arange(round(seconds * rate)) / rate


def imu(make, topic="/imu/data", rate=100.0, seconds=SECONDS, frame="imu_link", unit=1.0, no=""):
    """sensor_msgs/Imu; `unit` scales the accelerometer, `no` says which sensor is not measured."""
    name, times = "sensor_msgs/msg/Imu", clock(rate, seconds)
    measured = zip(known_walk.rate(times), known_walk.force(times) * unit, strict=True)
    samples = dict(zip(times.tolist(), measured, strict=True))

    def message(time):
        turning, pull = samples[time]
        unknown = np.zeros(9)
        unknown[0] = -1.0
        return make.new(
            name,
            make.header(time, frame),
            make.new("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
            unknown,
            make.vector(turning),
            unknown if no == "gyro" else np.zeros(9),
            make.vector(pull),
            unknown if no == "accel" else np.zeros(9),
        )

    return rows(topic, name, times, message)


def poses(make, kind, mount, topic="/pose", rate=50.0, child="base_link", start=0.0):
    """A reference as each of the messages that hold one."""
    name = {"TFMessage": "tf2_msgs", "Odometry": "nav_msgs"}.get(kind, "geometry_msgs")
    name = f"{name}/msg/{kind}"

    def message(time):
        pose = make.pose(time, mount)
        header = make.header(time, "map")
        if kind == "Pose":
            return pose
        if kind == "PoseStamped":
            return make.new(name, header, pose)
        if kind == "TransformStamped":
            return make.transform(time, mount, "map", child)
        if kind == "TFMessage":
            other = make.transform(time + 9.0, mount, "map", "wheel")
            other.header.stamp = header.stamp
            return make.new(name, [make.transform(time, mount, "map", child), other])
        spread = make.new("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36))
        if kind == "PoseWithCovarianceStamped":
            return make.new(name, header, spread)
        still = make.vector([0, 0, 0])
        twist = make.new("geometry_msgs/msg/Twist", still, still)
        twist = make.new("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
        return make.new(name, header, child, spread, twist)

    return rows(topic, name, start + clock(rate), message)


def text(make, topic="/chatter"):
    message = make.new("std_msgs/msg/String", "hello")
    return rows(topic, "std_msgs/msg/String", [0.0], lambda _: message)


def write(folder: Path, kind, entries):
    """The recording as one of `KINDS`."""
    entries = sorted(entries, key=lambda row: row[2])
    if kind.startswith("mcap"):
        return write_mcap(folder / "walk.mcap", kind, entries)
    if kind == "rosbag1":
        path, writer = folder / "walk.bag", rosbag1.Writer(folder / "walk.bag")
    else:
        plugin = rosbag2.StoragePlugin
        storage = plugin.MCAP if kind == "bag of mcap" else plugin.SQLITE3
        path = folder / "walk"
        writer = rosbag2.Writer(path, version=9, storage_plugin=storage)
    store, connections = store_of(kind), {}
    with writer:
        for topic, name, stamp, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], stamp, _encoded(store, name, message))
    return path / "walk.db3" if kind == "db3" else path


def _encoded(store, name, message):
    encode = store.serialize_ros1 if store is ROS1 else store.serialize_cdr
    return bytes(encode(message, name))


def write_mcap(path, kind, entries, encoding=None):
    store, ids = store_of(kind), {}
    profile, schema, ros_version = (
        ("ros1", "ros1msg", 1) if store is ROS1 else ("ros2", "ros2msg", 2)
    )
    encoding = encoding or ("ros1" if store is ROS1 else "cdr")
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile=profile)
        for topic, name, stamp, message in entries:
            if topic not in ids:
                definition, _ = store.generate_msgdef(name, ros_version=ros_version)
                shown = name.replace("/msg/", "/") if store is ROS1 else name
                number = writer.register_schema(shown, schema, definition.encode())
                ids[topic] = writer.register_channel(topic, encoding, number)
            writer.add_message(ids[topic], stamp, _encoded(store, name, message), stamp)
        writer.finish()
    return path
