"""The IMU and the reference of a bag: topics, frames and stamps.

Conventions of ROS: `sensor_msgs/Imu` is in rad/s and m/s² with gravity (REP 145; a driver that
gives g is recognised by its magnitude), poses map the body to a z-up world (REP 103). A first
element of −1 in a covariance of `Imu` says that the quantity is not measured (sensor_msgs/Imu.msg).
Samples are stamped by their headers, the sensor's clock; where headers are empty, by the bag.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.apps.importing.bags import Bag, Topic, listed, opened
from gnio_jax.apps.importing.recording import Recording, Sensor, Track, Units
from gnio_jax.data.parsing.stamps import seconds
from gnio_jax.data.readers.euroc import SensorPose, moved_to
from gnio_jax.data.reference import SHORTEST_RUN, Poses
from gnio_jax.data.validation import check_unit_norm
from gnio_jax.errors import InputError
from gnio_jax.numerics import finite_rows, rotations

IMU = "sensor_msgs/msg/Imu"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
_TF1 = "tf/msg/tfMessage"
FAST_TRACKER = 20.0
"""Hz from which a tracker's noise is smoothed and the gyro carries its attitude; below it its poses
are taken as they are (ours)."""
SLOWEST = 4.0
"""Hz below which a reference says too little of a walk (ours)."""


class _Pose(NamedTuple):
    """One pose of a message."""

    stamp: int
    """ns, 0 where the message has none."""
    child: str
    """Frame of the body, "" where the message does not say."""
    values: tuple[float, ...]
    """Position m, quaternion wxyz."""


def _stamp(header: Any) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def _pose(position: Any, turn: Any) -> tuple[float, ...]:
    return position.x, position.y, position.z, turn.w, turn.x, turn.y, turn.z


def _plain(message: Any) -> list[_Pose]:
    return [_Pose(0, "", _pose(message.position, message.orientation))]


def _stamped(message: Any) -> list[_Pose]:
    pose = message.pose
    return [_Pose(_stamp(message.header), "", _pose(pose.position, pose.orientation))]


def _with_covariance(message: Any) -> list[_Pose]:
    pose, child = message.pose.pose, getattr(message, "child_frame_id", "")
    return [_Pose(_stamp(message.header), child, _pose(pose.position, pose.orientation))]


def _transform(message: Any) -> list[_Pose]:
    moved = message.transform
    values = _pose(moved.translation, moved.rotation)
    return [_Pose(_stamp(message.header), message.child_frame_id, values)]


def _transforms(message: Any) -> list[_Pose]:
    return [pose for one in message.transforms for pose in _transform(one)]


_POSES: dict[str, Callable[[Any], list[_Pose]]] = {
    "geometry_msgs/msg/Pose": _plain,
    "geometry_msgs/msg/PoseStamped": _stamped,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _with_covariance,
    "nav_msgs/msg/Odometry": _with_covariance,
    "geometry_msgs/msg/TransformStamped": _transform,
    TRANSFORMS: _transforms,
    _TF1: _transforms,
}
"""What each type of a reference says."""


# --- topics


class Topics(NamedTuple):
    """What the user names; None takes the only one."""

    imu: str | None = None
    """Of sensor_msgs/Imu."""
    accel: str | None = None
    """The accelerometer's, where it is another one."""
    reference: str | None = None
    """Of poses; "/tf:CHILD_FRAME" of transforms."""


def read_bag(path: Path, kind: str, topics: Topics) -> Recording:
    """The IMU of a bag, and its reference where there is one.

    One topic of `sensor_msgs/Imu` is taken without being named, and so is one of poses; of several
    the IMU must be named, and of the poses none is taken. Raises `InputError` that names the topics
    there are.
    """
    with opened(path, kind) as bag:
        imu = _imu_topic(bag, topics.imu)
        other = imu if topics.accel is None else _imu_topic(bag, topics.accel)
        reference, child, notes = _reference_topic(bag, topics.reference)
        static = [topic.name for topic in bag.topics if topic.name.endswith("tf_static")]
        found = _collected(bag, {imu.name, other.name}, reference, static)
    samples, forces = _samples(found, imu, "gyro", path), _samples(found, other, "accel", path)
    if samples.headers != forces.headers:
        raise InputError(
            path, f"topics {imu.name} and {other.name} have other clocks", "name other topics"
        )
    clock = "headers" if samples.headers else "bag: its headers have no time"
    named = f"{imu.name} ({imu.count} messages)"
    named += f", accel {other.name} ({other.count} messages)" if other != imu else ""
    notes.insert(0, f"{path.name}: IMU {named}, stamped by its {clock}")
    track = None
    if reference is not None:
        try:
            track = _track(found, reference.name, child, samples, path, notes)
            track = track._replace(named=topics.reference is not None)
        except InputError as error:
            if topics.reference is not None:
                raise
            notes.append(f"{path.name}: no reference is taken: {error}")
    return Recording(
        path,
        samples.sensor,
        forces.sensor,
        Units("ns", "rad/s", None, "android"),
        track,
        tuple(notes),
    )


def _imu_topic(bag: Bag, name: str | None) -> Topic:
    found = [topic for topic in bag.topics if topic.type == IMU and topic.count]
    if name is not None:
        chosen = _named(bag, name)
        if chosen.type != IMU:
            raise InputError(
                bag.path, f"topic {name} is {chosen.type}, no IMU", f"IMU topics: {listed(found)}"
            )
        return chosen
    if not found:
        raise InputError(
            bag.path, "has no topic of sensor_msgs/Imu", f"its topics: {listed(bag.topics)}"
        )
    if len(found) > 1:
        raise InputError(
            bag.path, f"has {len(found)} IMU topics", f"choose one by --imu-topic: {listed(found)}"
        )
    return found[0]


def _named(bag: Bag, name: str) -> Topic:
    for topic in bag.topics:
        if topic.name == name:
            return topic
    raise InputError(bag.path, f"has no topic '{name}'", f"its topics: {listed(bag.topics)}")


def _reference_topic(bag: Bag, name: str | None) -> tuple[Topic | None, str, list[str]]:
    """The topic, the child frame that is asked for ("" for any), and what was chosen."""
    found = [topic for topic in bag.topics if topic.type in _POSES and topic.count]
    if name is not None:
        topic, _, child = name.partition(":")
        chosen = _named(bag, topic)
        if chosen.type not in _POSES:
            raise InputError(
                bag.path, f"topic {topic} is {chosen.type}, no pose", f"poses: {listed(found)}"
            )
        return chosen, child, []
    own = [topic for topic in found if topic.type not in (TRANSFORMS, _TF1)]
    if len(own) == 1:
        return own[0], "", []
    if not found:
        return None, "", []
    note = f"{bag.path.name}: no reference is taken; --reference-topic may be {listed(found)}"
    return None, "", [note]


# --- messages


class _Collected(NamedTuple):
    """What is kept of a bag: numbers, since decoded messages take a kilobyte each."""

    imu: dict[str, list[tuple[int, int, tuple[float, ...]]]]
    """Topic -> stamp of the header and of the bag, ns; gyro rad/s and accel of each sample."""
    first: dict[str, Any]
    """Topic -> the first message of an IMU."""
    poses: list[tuple[int, _Pose]]
    """Stamp of the bag, ns, and pose of each pose of the reference."""
    mounted: dict[tuple[str, str], SensorPose]
    """(parent, child) -> the child in the parent, of static transforms."""


def _collected(bag: Bag, imus: set[str], reference: Topic | None, static: list[str]) -> _Collected:
    found = _Collected({name: [] for name in imus}, {}, [], {})
    names = {*imus, *static, *([reference.name] if reference else [])}
    for message in bag.messages(names):
        content = message.content
        if message.topic in imus:
            found.first.setdefault(message.topic, content)
            sample = _stamp(content.header), message.log_time, _sample(content)
            found.imu[message.topic].append(sample)
        if reference is not None and message.topic == reference.name:
            poses = _POSES[reference.type](content)
            found.poses.extend((message.log_time, pose) for pose in poses)
        if message.topic in static:
            found.mounted.update(_mounting(content))
    return found


def _sample(message: Any) -> tuple[float, ...]:
    rate, force = message.angular_velocity, message.linear_acceleration
    return rate.x, rate.y, rate.z, force.x, force.y, force.z


class _Samples(NamedTuple):
    """An IMU topic."""

    sensor: Sensor
    frame: str
    headers: bool
    """Stamped by its headers."""


def _samples(found: _Collected, topic: Topic, sensor: str, path: Path) -> _Samples:
    """The topic's samples, of which it must have the sensor."""
    if not found.imu[topic.name]:
        raise InputError(path, f"topic {topic.name} has no messages", "record it anew")
    first = found.first[topic.name]
    gyro, accel = first.angular_velocity_covariance, first.linear_acceleration_covariance
    if (gyro if sensor == "gyro" else accel)[0] == -1.0:
        raise InputError(
            path, f"topic {topic.name} says that it has no {sensor}", "name another topic"
        )
    stamps, logged, values = zip(*found.imu[topic.name], strict=True)
    headers = all(stamps)
    axes = slice(0, 3) if sensor == "gyro" else slice(3, 6)
    own = np.array(stamps if headers else logged, dtype=np.int64)
    measured = np.array(values, dtype=np.float64)[:, axes]
    return _Samples(Sensor(sensor, path, own, measured), first.header.frame_id, headers)


# --- reference


def _track(
    found: _Collected, topic: str, child: str, samples: _Samples, path: Path, notes: list[str]
) -> Track:
    """The poses of a topic, as those of the IMU."""
    rows = found.poses
    children = sorted({pose.child for _, pose in rows})
    if child:
        rows = [(time, pose) for time, pose in rows if pose.child == child]
    if not rows or (len(children) > 1 and not child):
        raise InputError(
            path,
            f"topic {topic} moves the frames {', '.join(children) or 'none'}",
            f"name one: --reference-topic {topic}:FRAME",
        )
    headers = samples.headers and all(pose.stamp for _, pose in rows)
    stamps = np.array([pose.stamp if headers else time for time, pose in rows], dtype=np.int64)
    if samples.headers and not headers:
        notes.append(
            f"{path.name}: {topic} has no stamps of its own and is stamped by the bag, the IMU by "
            "its headers: the reference is off by the delay between these two clocks"
        )
    start = int(stamps.min())
    values = np.array([pose.values for _, pose in rows], dtype=np.float64)
    name = f"{topic}:{child}" if child else topic
    poses = _poses(seconds(stamps, start), values, f"{path}: topic {name}")
    body, imu = rows[0][1].child, samples.frame
    place = _place(body, imu, found.mounted)
    if place is None:
        notes.append(
            f"{path.name}: {name} gives the poses of '{body or 'an unnamed frame'}', the IMU is in "
            f"'{imu}', and no static transform joins them: taken as one"
        )
    elif body != imu:
        notes.append(f"{path.name}: {name} moved from '{body}' to '{imu}' by /tf_static")
    return Track(name, moved_to(place or SensorPose(), poses), start)


def _poses(time: Float[np.ndarray, " n"], rows: Float[np.ndarray, "n 7"], source: str) -> Poses:
    """Poses from stamps (s) and rows of position (m) and quaternion wxyz, in any order; rows that
    are not finite are left out. Raises `InputError` where they are too few, too slow, or no unit
    quaternions."""
    seen = finite_rows(rows)
    time, rows = time[seen], rows[seen]
    if len(time) < SHORTEST_RUN:
        raise InputError(source, f"holds {len(time)} poses", "name another reference")
    rate = 1.0 / max(float(np.median(np.diff(np.sort(time)))), 1e-9)
    if rate < SLOWEST:
        remedy = f"a reference needs {SLOWEST:g} Hz"
        raise InputError(source, f"its poses come at {rate:.3g} Hz", remedy)
    wxyz = check_unit_norm(rows[:, 3:], np.ones(len(time), dtype=bool), "orientation", source)
    noisy = rate >= FAST_TRACKER
    return Poses(time, rotations(wxyz), rows[:, :3], noisy=noisy, source=source)


def _mounting(message: Any) -> dict[tuple[str, str], SensorPose]:
    """(parent, child) -> the child in the parent, of the transforms of a message."""
    mounted = {}
    for one in message.transforms:
        *place, w, x, y, z = _transform(one)[0].values
        pose = SensorPose(Rotation.from_quat([x, y, z, w]), np.array(place))
        mounted[_frame(one.header.frame_id), _frame(one.child_frame_id)] = pose
    return mounted


def _frame(name: str) -> str:
    return name.lstrip("/")


def _place(body: str, imu: str, mounted: dict[tuple[str, str], SensorPose]) -> SensorPose | None:
    """The frame `imu` in the frame `body`, along the static transforms; None where they do not
    join."""
    reached, todo = {_frame(body): SensorPose()}, [_frame(body)]
    while todo:
        here = todo.pop()
        for (parent, child), pose in mounted.items():
            for near, far, step in ((parent, child, pose), (child, parent, _inverse(pose))):
                if near == here and far not in reached:
                    reached[far] = _product(reached[here], step)
                    todo.append(far)
    return reached.get(_frame(imu))


def _inverse(pose: SensorPose) -> SensorPose:
    return SensorPose().seen_from(pose)


def _product(first: SensorPose, second: SensorPose) -> SensorPose:
    """`second`, given in the frame of `first`, in the frame of what `first` is given in."""
    place = first.translation + first.rotation.apply(second.translation)
    return SensorPose(first.rotation * second.rotation, place)
