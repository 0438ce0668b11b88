"""Trajectories in the formats of other programs.

- `tum`: `t x y z qx qy qz qw`, as `gnio evaluate` writes it (evo).
- `csv`: with the columns of our own dataset `csv`.
- `mcap`: ROS 2 messages, which Foxglove, rviz and `ros2 bag play` read: `/odometry`
  (nav_msgs/Odometry) and `/tf` (tf2_msgs/TFMessage) at every pose, `/path` (nav_msgs/Path) with the
  whole trajectory at the first stamp. The schemas are embedded (`ros2msg`), so that no message
  package is needed. Frames by REP 105: `odom`, fixed and z-up, in which the path drifts, and `imu`,
  the recording's body.
- `geojson` (RFC 7946) and `gpx` (1.1): a line on the map, for a track that a receiver has placed.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from jaxtyping import Float

from gnio_jax.data.geodesy import Place, geodetic
from gnio_jax.errors import InputError, require_packages
from gnio_jax.evaluation.trajectory import Trajectory, write_tum
from gnio_jax.files import replacing, write_part
from gnio_jax.numerics import rotations, turns_between

SUFFIXES = {".tum": "tum", ".txt": "tum", ".csv": "csv", ".mcap": "mcap"}
FORMATS = tuple(dict.fromkeys(SUFFIXES.values()))
MAP_FORMATS = ("geojson", "gpx")
"""Formats of `export_map`."""
NO_XML = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
"""Characters that no XML may have."""
LAST_STAMP = 2.0**31
"""Largest stamp of builtin_interfaces/Time, s."""
EPOCHS = 1.0e9, 2.2e9
"""Stamps that are a time from 2001 to 2039, s since 1970."""
WORLD, BODY = "odom", "imu"
TOPICS = {
    "/odometry": "nav_msgs/msg/Odometry",
    "/path": "nav_msgs/msg/Path",
    "/tf": "tf2_msgs/msg/TFMessage",
}


def export(
    path: Path,
    trajectory: Trajectory,
    kind: str | None = None,
    covariance: Float[np.ndarray, "n 3 3"] | None = None,
) -> int:
    """Write a trajectory, whole or not at all, and return its number of poses.

    Rows that are not finite are left out. `kind` is one of `FORMATS`; None: the suffix decides.
    `covariance` is that of the positions, m² (mcap). Raises `InputError`.
    """
    kind = kind or SUFFIXES.get(path.suffix.lower())
    if kind not in FORMATS:
        raise InputError(
            path, "the ending of its name is not a known format", f"known: {', '.join(SUFFIXES)}"
        )
    finite = trajectory.known & np.isfinite(trajectory.time)
    if not finite.any():
        raise InputError(path, "the trajectory has no pose", "it may have diverged at its start")
    poses = Trajectory(*(field[finite] for field in trajectory))
    check(path, kind, poses.time)
    with replacing(path) as temporary:
        match kind:
            case "tum":
                write_tum(temporary, poses)
            case "csv":
                rows = np.column_stack([poses.time, poses.position, poses.orientation])
                names = "time,px,py,pz,qw,qx,qy,qz"
                options = {"fmt": "%.9f", "delimiter": ",", "header": names, "comments": ""}
                np.savetxt(temporary, rows, **options)
            case _:
                _write_mcap(temporary, poses, None if covariance is None else covariance[finite])
    return len(poses.time)


def check_map(formats: Iterable[str]) -> None:
    """Raise `InputError` for formats of a map, if the recording has no fixes."""
    for kind in formats:
        if kind in MAP_FORMATS:
            problem = f"{kind} needs the place of the start, and no receiver shows it"
            raise InputError("--format", problem, "switch on the location, or leave the format out")


def export_map(path: Path, trajectory: Trajectory, origin: Place, name: str) -> None:
    """Write the path on the map, one point a second, as the suffix says. `origin` is the place of
    the trajectory's origin, whose axes are east, north and up, and `name` that of the recording.

    A line of GeoJSON that crosses the antimeridian is a MultiLineString, and its `coordTimes` has a
    list for each part. A track of GPX is a list of points, and is not cut."""
    rows = np.flatnonzero(trajectory.known & np.isfinite(trajectory.time))
    seconds = np.floor(trajectory.time[rows] - trajectory.time[rows[0]] + 1e-6)
    rows = rows[np.unique(np.append(np.unique(seconds, return_index=True)[1], len(rows) - 1))]
    time, places = trajectory.time[rows], geodetic(trajectory.position[rows], origin)
    has_dates = EPOCHS[0] < time[0] < EPOCHS[1]
    with replacing(path) as temporary:
        if path.suffix == ".gpx":
            _write_gpx(temporary, name, places, _dates(time) if has_dates else [None] * len(time))
            return
        # Rounded first, so that no longitude is rounded onto the other side of its part.
        points = np.column_stack([places[:, [1, 0, 2]].round(7), time])
        parts = _cut_at_antimeridian(points)
        lines = [
            [
                [round(east, 7), round(north, 7), round(up, 2)]
                for east, north, up, _ in part.tolist()
            ]
            for part in parts
        ]
        dates = [_dates(part[:, 3]) for part in parts] if has_dates else []
        feature = {
            "type": "Feature",
            "properties": {"coordTimes": dates if len(parts) > 1 else dates[0]} if dates else {},
            "geometry": {"type": "MultiLineString", "coordinates": lines}
            if len(parts) > 1
            else {"type": "LineString", "coordinates": lines[0]},
        }
        text = json.dumps({"type": "FeatureCollection", "features": [feature]}, indent=1)
        write_part(temporary, text + "\n")


def _dates(time: Float[np.ndarray, "n"]) -> list[str]:
    """Stamps, s since 1970, as ISO 8601 writes them."""
    moments = (datetime.fromtimestamp(seconds, UTC) for seconds in time.tolist())
    return [moment.isoformat(timespec="milliseconds")[:23] + "Z" for moment in moments]


def _cut_at_antimeridian(points: Float[np.ndarray, "n w"]) -> list[Float[np.ndarray, "m w"]]:
    """The parts of a line on either side of the antimeridian (RFC 7946, 3.1.9).

    The first column has the longitudes, degrees. Where the line crosses the antimeridian, a point
    on it is the last one of a part and the first one of the next, with longitudes of 180 and -180.
    Where it only touches it, nothing is cut.
    """
    continuous, shift = points.copy(), np.zeros(points.shape[1])
    continuous[1:, 0] -= 360.0 * np.cumsum(np.round(np.diff(points[:, 0]) / 360.0))
    parts, part = [], [continuous[0]]
    for before, point in itertools.pairwise(continuous):
        longitude = point[0] - shift[0]
        if abs(longitude) > 180.0:
            meridian = shift[0] + math.copysign(180.0, longitude)
            share = (meridian - before[0]) / (point[0] - before[0])
            crossing = before + share * (point - before)
            crossing[0] = meridian
            parts.append(np.array([*part, crossing] if share > 0 else part) - shift)
            shift[0] += math.copysign(360.0, longitude)
            part = [crossing]
        part.append(point)
    parts.append(np.array(part) - shift)
    # A line that begins on the antimeridian may be cut behind its first point.
    return [part for part in parts if len(part) > 1] or parts


def _write_gpx(
    path: Path, name: str, places: Float[np.ndarray, "n 3"], stamps: list[str | None]
) -> None:
    lines = ['<?xml version="1.0" encoding="UTF-8"?>']
    lines += ['<gpx version="1.1" creator="gnio-jax" xmlns="http://www.topografix.com/GPX/1/1">']
    shown = NO_XML.sub(lambda match: match[0].encode("unicode_escape").decode(), name)
    lines += [f"<trk><name>{escape(shown)}</name><trkseg>"]
    for (latitude, longitude, altitude), stamp in zip(places, stamps, strict=True):
        longitude = (round(longitude, 7) + 180.0) % 360.0 - 180.0  # GPX has no 180
        time = f"<time>{stamp}</time>" if stamp else ""
        point = f'<trkpt lat="{latitude:.7f}" lon="{longitude:.7f}"><ele>{altitude:.2f}</ele>'
        lines += [f"{point}{time}</trkpt>"]
    write_part(path, "\n".join([*lines, "</trkseg></trk></gpx>\n"]))


def check(where: object, kind: str, time: Float[np.ndarray, "n"]) -> None:
    """Raise `InputError`, before any work, for a format whose packages are missing or that cannot
    have these stamps, s."""
    if kind != "mcap":
        return
    require_packages(where, "bags", "mcap", "rosbags")
    if time[0] < 0.0:
        raise InputError(where, f"stamps begin at {time[0]:g} s", "ROS has none below 0")
    if time[-1] >= LAST_STAMP:
        remedy = "ROS counts seconds in 32 bits: give stamps in s"
        raise InputError(where, f"stamps end at {time[-1]:g} s", remedy)


def _write_mcap(
    path: Path, poses: Trajectory, covariance: Float[np.ndarray, "n 3 3"] | None
) -> None:
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="gnio-jax")
        channels = {}
        for topic, name in TOPICS.items():
            text, _ = store.generate_msgdef(name, ros_version=2)
            schema = writer.register_schema(name, "ros2msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for topic, stamp, message in _messages(poses, covariance, store.types):
            data = bytes(store.serialize_cdr(message, TOPICS[topic]))
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()


def _messages(
    poses: Trajectory, covariance: Float[np.ndarray, "n 3 3"] | None, types: dict[str, Any]
) -> Iterator[tuple[str, int, Any]]:
    """Topic, stamp (ns) and message: the path, then odometry and transform of each pose, in order.
    An unknown covariance is zero (ours)."""

    def make(name: str, *fields: Any) -> Any:
        package, _, message = name.partition("/")
        return types[f"{package}/msg/{message}"](*fields)

    def header(stamp: int) -> Any:
        time = make("builtin_interfaces/Time", stamp // 10**9, stamp % 10**9)
        return make("std_msgs/Header", time, WORLD)

    def pose(row: int) -> Any:
        w, *xyz = poses.orientation[row].tolist()
        point = make("geometry_msgs/Point", *poses.position[row].tolist())
        return make("geometry_msgs/Pose", point, make("geometry_msgs/Quaternion", *xyz, w))

    def vector(values: Float[np.ndarray, "3"]) -> Any:
        return make("geometry_msgs/Vector3", *values.tolist())

    stamps = np.round(poses.time * 1e9).astype(np.int64).tolist()
    pose_messages = [pose(row) for row in range(len(stamps))]
    path = [
        make("geometry_msgs/PoseStamped", header(stamp), pose_message)
        for stamp, pose_message in zip(stamps, pose_messages, strict=True)
    ]
    yield "/path", stamps[0], make("nav_msgs/Path", header(stamps[0]), path)
    velocity, rate = _body_motion(poses)
    for row, (stamp, pose_message) in enumerate(zip(stamps, pose_messages, strict=True)):
        pose_covariance = np.zeros((6, 6))
        if covariance is not None and np.isfinite(covariance[row]).all():
            pose_covariance[:3, :3] = covariance[row]
        pose_with_covariance = make(
            "geometry_msgs/PoseWithCovariance", pose_message, pose_covariance.ravel()
        )
        twist = make("geometry_msgs/Twist", vector(velocity[row]), vector(rate[row]))
        twist_with_covariance = make("geometry_msgs/TwistWithCovariance", twist, np.zeros(36))
        yield (
            "/odometry",
            stamp,
            make(
                "nav_msgs/Odometry",
                header(stamp),
                BODY,
                pose_with_covariance,
                twist_with_covariance,
            ),
        )
        transform_of_pose = make(
            "geometry_msgs/Transform", vector(poses.position[row]), pose_message.orientation
        )
        transform = make("geometry_msgs/TransformStamped", header(stamp), BODY, transform_of_pose)
        yield "/tf", stamp, make("tf2_msgs/TFMessage", [transform])


def _body_motion(
    poses: Trajectory,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Velocity (m/s) and angular rate (rad/s) in the body frame, from differences of the poses."""
    count = len(poses.time)
    if count < 2:
        return np.zeros((count, 3)), np.zeros((count, 3))
    attitude = rotations(poses.orientation)
    velocity = np.gradient(poses.position, poses.time, axis=0)
    turn = turns_between(attitude) / np.diff(poses.time)[:, None]
    return attitude.inv().apply(velocity), np.concatenate([turn, turn[-1:]])
