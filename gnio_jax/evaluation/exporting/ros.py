"""A trajectory as an MCAP of ROS 2 messages, which Foxglove, rviz and `ros2 bag play` read.

Topics: `/odometry` (nav_msgs/Odometry) and `/tf` (tf2_msgs/TFMessage) at every pose, `/path`
(nav_msgs/Path) with the whole trajectory at the first stamp. The schemas are embedded (`ros2msg`),
so that no message package is needed. Frames by REP 105: `odom`, fixed and z-up, in which the path
drifts, and `imu`, the recording's body.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.errors import InputError
from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.numerics import rotations

LAST_STAMP = 2.0**31
"""s, builtin_interfaces/Time."""
WORLD, BODY = "odom", "imu"
ODOMETRY, PATH, TRANSFORMS = "/odometry", "/path", "/tf"
_TYPES = {
    ODOMETRY: "nav_msgs/msg/Odometry",
    PATH: "nav_msgs/msg/Path",
    TRANSFORMS: "tf2_msgs/msg/TFMessage",
}


class _Message(NamedTuple):
    topic: str
    stamp: int
    """ns."""
    content: Any


def write_mcap(
    path: Path, poses: Trajectory, covariance: Float[np.ndarray, "n 3 3"] | None = None
) -> None:
    """Write poses that `check_stamps` accepts.

    `covariance` of the positions, m²; zeros stand where nothing is known (ours).
    """
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="gnio-jax")
        channels = {}
        for topic, name in _TYPES.items():
            text, _ = store.generate_msgdef(name, ros_version=2)
            schema = writer.register_schema(name, "ros2msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for message in _messages(poses, covariance, store.types):
            data = bytes(store.serialize_cdr(message.content, _TYPES[message.topic]))
            writer.add_message(channels[message.topic], message.stamp, data, message.stamp)
        writer.finish()


def check_stamps(path: Path, poses: Trajectory) -> None:
    """Raise `InputError` for stamps (s) below 0 or beyond ROS's 32 bits."""
    if poses.time[0] < 0.0:
        raise InputError(path, f"stamps begin at {poses.time[0]:g} s", "ROS has none below 0")
    if poses.time[-1] >= LAST_STAMP:
        remedy = "ROS counts seconds in 32 bits: give stamps in s"
        raise InputError(path, f"stamps end at {poses.time[-1]:g} s", remedy)


def _messages(
    poses: Trajectory, covariance: Float[np.ndarray, "n 3 3"] | None, types: dict[str, Any]
) -> Iterator[_Message]:
    """The path, and odometry and transform of each pose, in order."""
    make = _Maker(types)
    stamps = np.round(poses.time * 1e9).astype(np.int64).tolist()
    velocity, rate = _body_motion(poses)
    rows = list(zip(poses.position.tolist(), poses.orientation.tolist(), strict=True))
    path = [make.stamped(stamp, *row) for stamp, row in zip(stamps, rows, strict=True)]
    yield _Message(PATH, stamps[0], make("nav_msgs/msg/Path", make.header(stamps[0]), path))
    for number, (stamp, row) in enumerate(zip(stamps, rows, strict=True)):
        spread = np.zeros((6, 6))
        if covariance is not None and np.isfinite(covariance[number]).all():
            spread[:3, :3] = covariance[number]
        twist = velocity[number].tolist(), rate[number].tolist()
        yield _Message(ODOMETRY, stamp, make.odometry(stamp, row, spread, twist))
        yield _Message(TRANSFORMS, stamp, make.transforms(stamp, row))


def _body_motion(
    poses: Trajectory,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Velocity (m/s) and angular rate (rad/s) in the body, by differences of the poses."""
    count = len(poses.time)
    if count < 2:
        return np.zeros((count, 3)), np.zeros((count, 3))
    attitude = rotations(poses.orientation)
    velocity = np.gradient(poses.position, poses.time, axis=0)
    turn = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / np.diff(poses.time)[:, None]
    return attitude.inv().apply(velocity), np.concatenate([turn, turn[-1:]])


class _Maker:
    """Messages of the types of one store."""

    def __init__(self, types: dict[str, Any]):
        self._types = types

    def __call__(self, name: str, *fields: Any) -> Any:
        return self._types[name](*fields)

    def header(self, stamp: int, frame: str = WORLD) -> Any:
        time = self("builtin_interfaces/msg/Time", stamp // 10**9, stamp % 10**9)
        return self("std_msgs/msg/Header", time, frame)

    def vector(self, values: list[float]) -> Any:
        return self("geometry_msgs/msg/Vector3", *values)

    def quaternion(self, wxyz: list[float]) -> Any:
        return self("geometry_msgs/msg/Quaternion", *wxyz[1:], wxyz[0])

    def pose(self, position: list[float], wxyz: list[float]) -> Any:
        point = self("geometry_msgs/msg/Point", *position)
        return self("geometry_msgs/msg/Pose", point, self.quaternion(wxyz))

    def stamped(self, stamp: int, position: list[float], wxyz: list[float]) -> Any:
        pose = self.pose(position, wxyz)
        return self("geometry_msgs/msg/PoseStamped", self.header(stamp), pose)

    def odometry(
        self,
        stamp: int,
        row: tuple[list[float], list[float]],
        spread: Float[np.ndarray, "6 6"],
        twist: tuple[list[float], list[float]],
    ) -> Any:
        pose = self("geometry_msgs/msg/PoseWithCovariance", self.pose(*row), spread.ravel())
        motion = self("geometry_msgs/msg/Twist", *(self.vector(values) for values in twist))
        moving = self("geometry_msgs/msg/TwistWithCovariance", motion, np.zeros(36))
        return self("nav_msgs/msg/Odometry", self.header(stamp), BODY, pose, moving)

    def transforms(self, stamp: int, row: tuple[list[float], list[float]]) -> Any:
        moved = self("geometry_msgs/msg/Transform", self.vector(row[0]), self.quaternion(row[1]))
        one = self("geometry_msgs/msg/TransformStamped", self.header(stamp), BODY, moved)
        return self("tf2_msgs/msg/TFMessage", [one])
