"""The IMU and the reference of a robot's recording, from the messages of a bag.

Conventions of ROS: `sensor_msgs/Imu` is in rad/s and m/s² with gravity (REP 145; a driver that
gives g is recognised by its magnitude), poses map the body to a z-up world (REP 103). A first
element of −1 in a covariance of `Imu` says that the quantity is not measured (sensor_msgs/Imu.msg).
Samples have the stamps of their headers, the sensor's clock; if headers are empty, those of the
bag.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from gnio_jax.apps.importing.bags import Bag, Topic, open_bag
from gnio_jax.apps.importing.clocks import Sensor
from gnio_jax.apps.importing.readings import RawReadings
from gnio_jax.apps.importing.recording import RawRecording, Track
from gnio_jax.config import ImportOptions
from gnio_jax.data.parsing.stamps import FEW_SHARE, seconds
from gnio_jax.data.parsing.tables import shorten
from gnio_jax.data.readers.euroc import SensorPose, moved_to
from gnio_jax.data.reference import SHORTEST_RUN, Poses
from gnio_jax.data.sensors import BAROMETER, GNSS, MAGNETOMETER
from gnio_jax.data.validation import UNIT_NORM_TOLERANCE, check_unit_norm
from gnio_jax.errors import InputError
from gnio_jax.numerics import finite_rows, rotations

SLOWEST, FAST_TRACKER = 4.0, 20.0
"""Rates of a reference, Hz: below the first it describes a walk too coarsely; from the second on it
is a tracker, whose poses are smoothed and whose attitude is carried by the gyro (ours)."""
SAME_PACE, DELAY = 0.01, 0.1
"""Differences of two clocks that run alike: a share, and s, by which a bag may log late (ours)."""
IMU = "sensor_msgs/msg/Imu"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_GEOMETRY = ("Pose", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")
OTHERS = {
    "sensor_msgs/msg/MagneticField": MAGNETOMETER,
    "sensor_msgs/msg/FluidPressure": BAROMETER,
    "sensor_msgs/msg/NavSatFix": GNSS,
}
"""Type of a message → the sensor beside the IMU. Fields are in T and pressures in Pa; drivers that
write other units are recognised by the size."""
POSES = (*(f"geometry_msgs/msg/{name}" for name in _GEOMETRY), "nav_msgs/msg/Odometry")


def read_bag(path: Path, kind: str, options: ImportOptions) -> RawRecording:
    """The IMU of a bag of one of `KINDS`, and its reference if there is one. Of several topics of
    `sensor_msgs/Imu` one must be named, and of several topics of poses none is taken that is not;
    "/tf:CHILD_FRAME" names transforms. Raises `InputError` that names the existing topics."""
    notes, warnings = list[str](), list[str]()
    with open_bag(path, kind) as bag:
        imu = _imu_topic(bag, options.imu_topic)
        other = _imu_topic(bag, options.accel_topic) if options.accel_topic else imu
        reference = _reference_topic(bag, options.reference_topic, notes)
        topics = _other_topics(bag, notes)
        content = _collect(bag, {imu.name, other.name}, reference, topics)
    samples, poses, mounts, rows = content
    of_gyro, of_accel = samples[imu.name], samples[other.name]
    gyro, accel = of_gyro.sensor("gyro", imu.name, path), of_accel.sensor("accel", other.name, path)
    delay = abs(of_gyro.lead - of_accel.lead) * of_gyro.by_headers
    if of_gyro.by_headers != of_accel.by_headers or delay > DELAY:
        problem = f"topics {imu.name} and {other.name} are stamped by different clocks"
        raise InputError(path, problem, "name other topics")
    frames = of_gyro.frame, of_accel.frame
    accel = accel._replace(values=_turn(accel.values, *frames, other.name, mounts, path, notes))
    clock = "headers" if of_gyro.by_headers else "bag: its headers have no time"
    if of_gyro.has_headers and not of_gyro.by_headers:
        clock, problem = "bag", f"the headers of {imu.name} run {of_gyro.pace:.3g} times as fast as"
        warnings.append(f"clock: {path.name}: {problem} the bag's clock, whose stamps are taken")
    topic = f"{imu.name} ({imu.count} messages)"
    topic += f", accel {other.name} ({other.count} messages)" if other != imu else ""
    notes.insert(0, f"{path.name}: IMU {topic}, stamped by its {clock}")
    track = None
    if reference is not None:
        try:
            name = options.reference_topic or reference.name
            track = _track(name, poses, mounts, of_gyro, path, notes)
            track = track._replace(named=options.reference_topic is not None)
        except InputError as error:
            if options.reference_topic is not None:
                raise
            notes.append(f"{path.name}: no reference is taken: {error}")
    recording = RawRecording(path, gyro, accel, notes, warnings, "android", track=track)
    recording = recording._replace(by_columns=False)
    others = (
        _other_readings(topic, rows[topic.name], mounts, of_gyro, path, notes, warnings)
        for topic in topics
        if rows[topic.name]
    )
    return recording._replace(others=tuple(others))


# --- topics


def _other_topics(bag: Bag, notes: list[str]) -> list[Topic]:
    """The topic of each sensor beside the IMU: the one with the most messages."""
    topics = []
    for name, sensor in OTHERS.items():
        of_type = _topics(bag, None, (name,), sensor)
        if of_type:
            topics.append(max(of_type, key=lambda topic: topic.count))
        if len(of_type) > 1:
            problem = f"{bag.path.name}: of {len(of_type)} topics of {sensor}"
            notes.append(f"{problem} the one with the most messages is taken, {topics[-1].name}")
    return topics


def _other_readings(
    topic: Topic,
    rows: list[_Row],
    mounts: _Mounts,
    imu: _Imu,
    path: Path,
    notes: list[str],
    warnings: list[str],
) -> RawReadings:
    """The readings of a topic of one of `OTHERS`, a field turned to the axes of the IMU."""
    sensor = OTHERS[topic.type]
    headers, logged, values, std = (
        np.array(column) for column in list(zip(*rows, strict=True))[:4]
    )
    is_stamped = imu.by_headers and bool((headers > 0).all())
    delay = _lead(headers, logged) - imu.lead if is_stamped else 0.0
    if abs(delay) > DELAY:
        problem = f"clock: {path.name}: the headers of {topic.name} are {delay:+.2f} s from the"
        warnings.append(f"{problem} IMU's, by the bag's clock, whose stamps are taken for it")
        headers = logged + round(imu.lead * 1e9)
    stamps = headers if is_stamped else logged
    if sensor == MAGNETOMETER:
        frames = imu.frame, rows[0].frame.lstrip("/")
        values = _turn(values, *frames, topic.name, mounts, path, notes)
    file = path / topic.name.strip("/")
    return RawReadings(sensor, file, stamps, values.astype(float), std.astype(float), "ns")


def _turn(
    values: Float[np.ndarray, "n 3"],
    body: str,
    frame: str,
    topic: str,
    mounts: _Mounts,
    path: Path,
    notes: list[str],
) -> Float[np.ndarray, "n 3"]:
    """Vectors of a topic in the axes of `body`, the frame of the gyro, by the static transforms. If
    these do not join the frames, they are taken as one, with a note."""
    if body == frame:
        return values
    mount = _mount(body, frame, mounts)
    if mount is None:
        problem = f"{path.name}: {topic} is in '{frame}', the IMU in '{body}', and no"
        notes.append(f"{problem} static transform joins them: taken as one")
        return values
    notes.append(f"{path.name}: {topic} turned from '{frame}' to '{body}' by /tf_static")
    return mount.rotation.apply(values)


def _imu_topic(bag: Bag, name: str | None) -> Topic:
    topics = _topics(bag, name, (IMU,), "IMU")
    if not topics:
        remedy = f"its topics: {_spell_topics(bag.topics.values())}"
        raise InputError(bag.path, "has no topic of sensor_msgs/Imu", remedy)
    if len(topics) > 1:
        remedy = f"choose one by --imu-topic: {_spell_topics(topics)}"
        raise InputError(bag.path, f"has {len(topics)} IMU topics", remedy)
    return topics[0]


def _reference_topic(bag: Bag, name: str | None, notes: list[str]) -> Topic | None:
    """The topic of a reference, or of "topic:frame"; None if there is none, or none is chosen."""
    topic = name.partition(":")[0] if name else None
    topics = _topics(bag, topic, (*POSES, *TRANSFORMS), "pose")
    poses = topics if topic else [topic for topic in topics if topic.type in POSES]
    if topics and len(poses) != 1:
        remedy = f"--reference-topic may be {_spell_topics(topics)}"
        notes.append(f"{bag.path.name}: no reference is taken; {remedy}")
    return poses[0] if len(poses) == 1 else None


def _topics(bag: Bag, name: str | None, types: tuple[str, ...], what: str) -> list[Topic]:
    """The topics of these types that have messages, or the one of this name."""
    topics = [topic for topic in bag.topics.values() if topic.type in types and topic.count]
    if name is None:
        return topics
    if name not in bag.topics:
        remedy = f"its topics: {_spell_topics(bag.topics.values())}"
        raise InputError(bag.path, f"has no topic '{name}'", remedy)
    if bag.topics[name].type not in types:
        problem = f"topic {name} is {bag.topics[name].type}, no {what}"
        raise InputError(bag.path, problem, f"{what} topics: {_spell_topics(topics)}")
    return [bag.topics[name]]


def _spell_topics(topics: Iterable[Topic]) -> str:
    names = [f"{topic.name} ({topic.type.replace('/msg/', '/')})" for topic in topics]
    return shorten(", ".join(names) or "none", 400)


# --- messages


class _Pose(NamedTuple):
    """One pose of a message, whose frame of the body is "" if the message does not name it."""

    stamp: int  # of the message, ns; 0 if it has none
    logged: int  # the bag's, ns
    parent: str
    child: str
    values: tuple[float, ...]  # position m, quaternion wxyz


class _Imu(NamedTuple):
    """An IMU topic as arrays of numbers, because a decoded message takes a kilobyte."""

    first: Any  # its first message
    headers: Int[np.ndarray, " n"]  # stamps of the headers, ns
    logged: Int[np.ndarray, " n"]  # stamps of the bag, ns
    values: Float[np.ndarray, "n 6"]

    @property
    def pace(self) -> float:
        """Time that passes by the headers in a second of the bag, without the outermost stamps."""
        spans = [np.ptp(np.percentile(stamps, [5, 95])) for stamps in (self.headers, self.logged)]
        return float(spans[0] / max(spans[1], 1.0))

    @property
    def frame(self) -> str:
        """Name of the frame of the axes."""
        return self.first.header.frame_id.lstrip("/")

    @property
    def lead(self) -> float:
        """Time by which the headers are ahead of the bag's stamps, s."""
        return _lead(self.headers, self.logged)

    @property
    def has_headers(self) -> bool:
        """Whether the headers have stamps, all but a few."""
        return bool((self.headers == 0).mean() <= FEW_SHARE)

    @property
    def by_headers(self) -> bool:
        """Whether the headers have stamps that run as the bag's; otherwise these are used."""
        drift, burst = abs(self.pace - 1.0), np.diff(np.unique(self.logged)).max(initial=0)
        is_same = drift < SAME_PACE or drift * np.ptp(self.logged) < DELAY * 1e9 + burst
        return bool(self.has_headers and is_same)

    def sensor(self, name: str, topic: str, path: Path) -> Sensor:
        """The gyro or accel, which the topic must have."""
        first = self.first
        gyro, accel = first.angular_velocity_covariance, first.linear_acceleration_covariance
        if (gyro if name == "gyro" else accel)[0] == -1.0:
            problem = f"topic {topic} says that it has no {name}"
            raise InputError(path, problem, "name another topic")
        stamps = self.headers if self.by_headers else self.logged
        axes, unit = (slice(0, 3), "rad/s") if name == "gyro" else (slice(3, 6), None)
        return Sensor(name, path, stamps, self.values[:, axes], second="ns", unit=unit)


_Mounts = dict[tuple[str, str], SensorPose]
"""(parent, child) -> pose of the child in the parent, from static transforms."""


def _collect(
    bag: Bag, imus: set[str], reference: Topic | None, others: list[Topic]
) -> tuple[dict[str, _Imu], list[_Pose], _Mounts, dict[str, list[_Row]]]:
    """The IMU topics, the poses of the reference, the static transforms, and the messages of other
    sensors."""
    static = {name for name in bag.topics if name.endswith("tf_static")}
    of_poses = set() if reference is None else {reference.name}
    first, rows = dict[str, Any](), {name: list[tuple[Any, ...]]() for name in imus}
    poses, mounts = list[_Pose](), _Mounts()
    readings = {topic.name: list[_Row]() for topic in others}
    for topic, logged, message in bag.messages(imus | static | of_poses | readings.keys()):
        if topic in readings:
            readings[topic].append(_row(message, logged))
        if topic in imus:
            first.setdefault(topic, message)
            rate, force = message.angular_velocity, message.linear_acceleration
            values = rate.x, rate.y, rate.z, force.x, force.y, force.z
            rows[topic].append((_stamp(message), logged, *values))
        if topic in of_poses:
            poses.extend(_poses(message, logged))
        for pose in _poses(message, logged) if topic in static else ():
            lever, turn = np.array(pose.values[:3]), np.array(pose.values[3:])
            if abs(np.linalg.norm(turn) - 1.0) < UNIT_NORM_TOLERANCE:  # otherwise it is ignored
                frames = pose.parent.lstrip("/"), pose.child.lstrip("/")  # ROS 1 allows a slash
                mounts[frames] = SensorPose(rotations(turn), lever)
    samples = {}
    for topic in imus:
        if not rows[topic]:
            raise InputError(bag.path, f"topic {topic} has no messages", "record it again")
        headers, logged, *values = (np.array(column) for column in zip(*rows[topic], strict=True))
        samples[topic] = _Imu(first[topic], headers, logged, np.stack(values, axis=1).astype(float))
    return samples, poses, mounts, readings


class _Row(NamedTuple):
    """A message of a sensor beside the IMU."""

    stamp: int  # of the message, ns; 0 if it has none
    logged: int  # the bag's, ns
    values: tuple[float, ...]
    std: tuple[float, ...]
    frame: str


def _row(message: Any, logged: int) -> _Row:
    """A message of one of `OTHERS`. A NavSatFix without a fix is NaN, and covariances that are not
    known (type 0) are no standard deviation (sensor_msgs/NavSatFix.msg)."""
    std = (np.nan,) * 3
    if hasattr(message, "magnetic_field"):
        field = message.magnetic_field
        values = field.x, field.y, field.z
    elif hasattr(message, "fluid_pressure"):
        values, std = (message.fluid_pressure,), (np.nan,)
    else:
        values = message.latitude, message.longitude, message.altitude
        values = values if message.status.status >= 0 else (np.nan,) * 3
        variances = np.asarray(message.position_covariance, float)[[0, 4, 8]]
        if message.position_covariance_type > 0:
            std = tuple(np.sqrt(np.maximum(variances, 0.0)).tolist())
    return _Row(_stamp(message), logged, values, std, message.header.frame_id)


def _lead(headers: Int[np.ndarray, " n"], logged: Int[np.ndarray, " n"]) -> float:
    return float(np.median(headers - logged)) * 1e-9


def _stamp(message: Any) -> int:
    stamp = message.header.stamp if hasattr(message, "header") else None
    return stamp.sec * 10**9 + stamp.nanosec if stamp else 0


def _poses(message: Any, logged: int) -> Iterator[_Pose]:
    """The poses of a message of any type of `POSES` and `TRANSFORMS`."""
    if hasattr(message, "transforms"):
        for one in message.transforms:
            yield from _poses(one, logged)
        return
    parent = message.header.frame_id if hasattr(message, "header") else ""
    child = getattr(message, "child_frame_id", "")
    pose = message
    while hasattr(pose, "pose"):  # stamped, with covariance, or both
        pose = pose.pose
    pose = getattr(pose, "transform", pose)
    point = pose.translation if hasattr(pose, "translation") else pose.position
    turn = pose.rotation if hasattr(pose, "rotation") else pose.orientation
    values = point.x, point.y, point.z, turn.w, turn.x, turn.y, turn.z
    yield _Pose(_stamp(message), logged, parent, child, values)


# --- the reference


def _track(
    name: str, poses: list[_Pose], mounts: _Mounts, imu: _Imu, path: Path, notes: list[str]
) -> Track:
    """The poses of a "topic", or of a "topic:frame", converted to those of the IMU's frame."""
    topic, _, child = name.partition(":")
    rows = [pose for pose in poses if child in ("", pose.child)]
    children = sorted({pose.child for pose in poses})
    if not rows or (len(children) > 1 and not child):
        problem = f"topic {topic} moves the frames {', '.join(children) or 'none'}"
        raise InputError(path, problem, f"name one: --reference-topic {topic}:FRAME")
    is_stamped = imu.by_headers and all(pose.stamp for pose in rows)
    stamps = np.array([pose.stamp if is_stamped else pose.logged for pose in rows], dtype=np.int64)
    if imu.by_headers and not is_stamped:
        problem = (
            f"{path.name}: {topic} has no stamps in its headers, so those of the bag are taken"
        )
        delay = "The reference is off by the delay between both clocks"
        notes.append(f"{problem}. The IMU has its own. {delay}")
    source, start = f"{path}: topic {name}", int(stamps.min())
    values = np.array([pose.values for pose in rows], dtype=np.float64)
    valid = finite_rows(values)
    time, values = seconds(stamps[valid], start), values[valid]
    if len(time) < SHORTEST_RUN:
        raise InputError(source, f"holds {len(time)} poses", "name another reference")
    rate = 1.0 / max(float(np.median(np.diff(np.sort(time)))), 1e-9)
    if rate < SLOWEST:
        remedy = f"a reference needs {SLOWEST:g} Hz"
        raise InputError(source, f"its poses come at {rate:.3g} Hz", remedy)
    wxyz = check_unit_norm(values[:, 3:], True, "orientation", source)
    is_noisy = rate >= FAST_TRACKER
    track = Poses(time, rotations(wxyz), values[:, :3], noisy=is_noisy, source=source)
    body, frame = rows[0].child, imu.first.header.frame_id
    mount = _mount(body.lstrip("/"), frame.lstrip("/"), mounts)
    if mount is None:
        problem = f"{path.name}: {name} gives the poses of '{body or 'an unnamed frame'}', the IMU"
        notes.append(f"{problem} is in '{frame}', and no static transform joins them: taken as one")
    elif body != frame:
        notes.append(f"{path.name}: {name} moved from '{body}' to '{frame}' by /tf_static")
    return Track(name, moved_to(mount or SensorPose(), track), Fraction(start, 10**9))


def _mount(body: str, imu: str, mounts: _Mounts) -> SensorPose | None:
    """The pose of the frame `imu` in the frame `body`, along the static transforms; None if these
    do not connect the frames."""
    poses, frames = {body: SensorPose()}, [body]
    while frames:
        frame = frames.pop()
        for (parent, child), pose in mounts.items():
            inverse = SensorPose().seen_from(pose)
            for near, far, step in ((parent, child, pose), (child, parent, inverse)):
                if near == frame and far not in poses:
                    base = poses[frame]
                    lever = base.translation + base.rotation.apply(step.translation)
                    poses[far] = SensorPose(base.rotation * step.rotation, lever)
                    frames.append(far)
    return poses.get(imu)
