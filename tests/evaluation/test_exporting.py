"""Trajectories in other programs' formats, read back by other means than they were written."""

from __future__ import annotations

import json
import struct
from xml.etree import ElementTree

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gnio_jax.commands import console
from gnio_jax.commands.data import main
from gnio_jax.errors import InputError
from gnio_jax.evaluation.exporting import export, read_trajectory
from gnio_jax.evaluation.exporting.geographic import FirstFix, on_the_earth
from gnio_jax.evaluation.metrics import Trajectory
from tests.support import known_walk

START = 1_700_000_000.25
TIME = START + np.arange(60) / 20
FIX = FirstFix(48.1375, 11.5755, 520.0, 30.0)


def walk(time=TIME, start=START):
    x, y, z, w = known_walk.attitude(time - start).as_quat().T
    wxyz = np.stack([w, x, y, z], axis=1)
    return Trajectory(time, known_walk.position(time - start), wxyz)


# --- text


def test_csv_and_tum_have_the_poses(tmp_path):
    poses = walk()
    assert export(tmp_path / "walk.csv", poses) == 60
    lines = (tmp_path / "walk.csv").read_text().splitlines()
    assert lines[0] == "time,px,py,pz,qw,qx,qy,qz"
    rows = np.array([line.split(",") for line in lines[1:]], dtype=float)
    expected = np.column_stack([TIME, poses.position, poses.orientation])
    np.testing.assert_allclose(rows, expected, atol=1e-9)
    export(tmp_path / "walk.tum", poses)
    again = read_trajectory(tmp_path / "walk.tum")
    for field, own in zip(again, poses, strict=True):
        np.testing.assert_allclose(field, own, atol=1e-9)


def test_kitti_is_the_matrix_that_turns_the_body_into_the_world(tmp_path):
    poses = walk()
    export(tmp_path / "poses.txt", poses, kind="kitti")
    rows = np.loadtxt(tmp_path / "poses.txt").reshape(-1, 3, 4)
    point = np.array([0.3, -0.2, 0.7])
    expected = known_walk.attitude(TIME - START).apply(point) + poses.position
    np.testing.assert_allclose(rows @ np.append(point, 1.0), expected, atol=1e-8)


def test_rows_without_a_pose_are_left_out(tmp_path):
    poses = walk()
    poses.position[10:20] = np.nan
    poses.orientation[15:25] = np.nan
    assert export(tmp_path / "walk.csv", poses) == 45
    poses.position[:] = np.nan
    with pytest.raises(InputError, match=r"walk\.csv: the trajectory has no pose"):
        export(tmp_path / "walk.csv", poses)


# --- on the earth


def cartesian(latitude, longitude, height):
    """WGS 84 by the axes of the ellipse."""
    lat, lon = np.radians(latitude), np.radians(longitude)
    a, b = 6378137.0, 6356752.314245179
    normal = a**2 / np.sqrt((a * np.cos(lat)) ** 2 + (b * np.sin(lat)) ** 2)
    across = (normal + height) * np.cos(lat)
    z = (b**2 / a**2 * normal + height) * np.sin(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), z], axis=-1)


@pytest.mark.parametrize("latitude", [0.0, 48.1375, -33.9, 89.9999])
def test_distances_on_the_earth_are_those_of_the_world(latitude):
    position = np.array([[5.0, 6.0, 7.0], [305.0, 6.0, 7.0], [5.0, 806.0, 7.0], [-95.0, 6.0, 57.0]])
    places = on_the_earth(position, FIX._replace(latitude=latitude))
    there = cartesian(*places.T)
    for first in range(4):
        for second in range(4):
            expected = np.linalg.norm(position[first] - position[second])
            found = np.linalg.norm(there[first] - there[second])
            assert found == pytest.approx(expected, abs=1e-5)
    np.testing.assert_allclose(places[0], [latitude, FIX.longitude, 520.0], atol=1e-8)


@pytest.mark.parametrize(
    ("heading", "moved", "north", "east"),
    [(0, [9, 0, 0], 9, 0), (90, [9, 0, 0], 0, 9), (0, [0, 9, 0], 0, -9), (180, [9, 4, 0], -9, 4)],
)
def test_x_points_to_the_heading_and_y_to_its_left(heading, moved, north, east):
    fix = FIX._replace(heading=heading)
    position = np.array([[0.0, 0.0, 0.0], moved], dtype=float)
    step = np.radians(np.diff(on_the_earth(position, fix)[:, :2], axis=0)[0])
    # Radii of curvature at this latitude, by the formulas of geodesy.
    lat, flat = np.radians(fix.latitude), 0.0066943799901413165
    normal = 6378137.0 / np.sqrt(1 - flat * np.sin(lat) ** 2)
    meridian = normal * (1 - flat) / (1 - flat * np.sin(lat) ** 2)
    assert step[0] * (meridian + 520.0) == pytest.approx(north, abs=1e-4)
    assert step[1] * (normal + 520.0) * np.cos(lat) == pytest.approx(east, abs=1e-4)


def test_geojson_and_gpx_hold_the_same_places(tmp_path):
    poses, name = walk(), "walk <1> & more"
    export(tmp_path / f"{name}.geojson", poses, fix=FIX)
    feature = json.loads((tmp_path / f"{name}.geojson").read_text())["features"][0]
    assert feature["geometry"]["type"] == "LineString" and feature["properties"]["name"] == name
    assert feature["properties"]["times"] == TIME.tolist()
    line = np.array(feature["geometry"]["coordinates"])
    expected = on_the_earth(poses.position, FIX)[:, [1, 0, 2]]
    np.testing.assert_allclose(line, expected, atol=1e-4)
    np.testing.assert_allclose(line[:, :2], expected[:, :2], atol=1e-9)

    export(tmp_path / f"{name}.gpx", poses, fix=FIX)
    space = {"": "http://www.topografix.com/GPX/1/1"}
    root = ElementTree.parse(tmp_path / f"{name}.gpx").getroot()
    points = root.findall("trk/trkseg/trkpt", space)
    assert root.findtext("trk/name", namespaces=space) == name
    places = [[float(point.get("lon")), float(point.get("lat"))] for point in points]
    np.testing.assert_allclose(places, line[:, :2], atol=2e-9)
    heights = [float(point.findtext("ele", namespaces=space)) for point in points]
    np.testing.assert_allclose(heights, line[:, 2], atol=1e-4)
    assert points[0].findtext("time", namespaces=space) == "2023-11-14T22:13:20.250000Z"


def test_what_is_not_known_is_left_out(tmp_path):
    """Neither an altitude nor unix time."""
    poses = walk(TIME - START, 0.0)
    fix = FIX._replace(altitude=None)
    export(tmp_path / "walk.geojson", poses, fix=fix)
    feature = json.loads((tmp_path / "walk.geojson").read_text())["features"][0]
    assert {len(place) for place in feature["geometry"]["coordinates"]} == {2}
    export(tmp_path / "walk.gpx", poses, fix=fix)
    text = (tmp_path / "walk.gpx").read_text()
    assert "<ele>" not in text and "<time>" not in text and text.count("<trkpt") == 60


# --- MCAP


def test_a_stamp_that_is_no_date_has_none(tmp_path):
    poses = walk()
    poses = poses._replace(time=poses.time * 1e9)  # somebody's nanoseconds
    export(tmp_path / "walk.gpx", poses, fix=FIX)
    assert "<time>" not in (tmp_path / "walk.gpx").read_text()


def test_the_mcap_is_read_by_rosbags(tmp_path):
    """With the types that the file itself defines."""
    poses = walk()
    spread = np.tile(np.diag([0.04, 0.09, 0.01]), (60, 1, 1))
    spread[5] = np.nan
    assert export(tmp_path / "walk.mcap", poses, covariance=spread) == 60
    store = get_typestore(Stores.EMPTY)
    with Reader(tmp_path / "walk.mcap") as reader:
        for one in reader.connections:
            store.register(get_types_from_msg(one.msgdef.data, one.msgtype))
        found = [
            (one.topic, time, store.deserialize_cdr(data, one.msgtype))
            for one, time, data in reader.messages()
        ]
    odometry = [message for topic, _, message in found if topic == "/odometry"]
    (path,) = [message for topic, _, message in found if topic == "/path"]
    times = [time for topic, time, _ in found if topic == "/odometry"]
    np.testing.assert_allclose(np.array(times) * 1e-9, TIME, atol=1e-6)
    for message, stamped, place in zip(odometry, path.poses, poses.position, strict=True):
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "imu")
        point, other = message.pose.pose.position, stamped.pose.position
        assert (point.x, point.y, point.z) == (other.x, other.y, other.z) == tuple(place)
        assert message.header.stamp == stamped.header.stamp
    assert odometry[3].pose.covariance.reshape(6, 6)[1, 1] == 0.09
    assert not odometry[5].pose.covariance.any()
    moving, when = odometry[30].twist.twist, TIME[30] - START
    body = known_walk.attitude(when).inv().apply(known_walk.velocity(when))
    linear, angular = moving.linear, moving.angular
    np.testing.assert_allclose([linear.x, linear.y, linear.z], body, atol=0.05)
    rate = known_walk.rate(when + 0.025)
    np.testing.assert_allclose([angular.x, angular.y, angular.z], rate, atol=0.05)


def test_the_transforms_byte_by_byte(tmp_path):
    """As CDR lays them out: a header of four bytes, alignment from behind it."""
    poses = walk()
    export(tmp_path / "walk.mcap", poses)
    with (tmp_path / "walk.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        found = [message for _, _, message in reader.iter_messages("/tf")]
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    assert len(found) == 60
    for number in (0, 41):
        data = found[number].data[4:]
        count, sec, nanosec, length = struct.unpack_from("<IiII", data)
        assert (count, data[16 : 16 + length]) == (1, b"odom\0")
        assert sec + nanosec * 1e-9 == pytest.approx(TIME[number], abs=1e-6)
        (length,) = struct.unpack_from("<I", data, 24)
        assert data[28 : 28 + length] == b"imu\0"
        values = struct.unpack_from("<7d", data, 32)
        assert values[:3] == tuple(poses.position[number])
        assert values[3:] == tuple(poses.orientation[number][[1, 2, 3, 0]])


# --- the command


@pytest.fixture
def trajectory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    export(tmp_path / "walk.txt", walk())


def test_the_command_writes_what_the_suffix_says(trajectory, tmp_path, capsys):
    place = ["--first-fix", "-48.1375", "-11.5755", "--heading", "-30"]
    for name in ("a.csv", "a.kitti", "a.tum", "a.mcap"):
        main(["export", "walk.txt", name])
    for name in ("a.gpx", "a.geojson"):
        main(["export", "walk.txt", name, *place])
    main(["export", "walk.txt", "poses.dat", "--format", "kitti"])
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "a.csv: 60 poses, 3.0 s" and len(out) == 7
    assert (tmp_path / "poses.dat").read_text() == (tmp_path / "a.kitti").read_text()
    line = json.loads((tmp_path / "a.geojson").read_text())["features"][0]["geometry"]
    assert line["coordinates"][0] == [-11.5755, -48.1375]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["walk.txt"], "OUT: is missing"),
        (["gone.txt", "a.csv"], "gone.txt: cannot be read (No such file or directory)"),
        (["walk.txt", "a.dat"], "a.dat: its name tells no format; known: .tum, .txt, .kitti"),
        (["walk.txt", "folder"], "OUT: 'folder' is a folder; name a file in it"),
        (["words.txt", "a.csv"], "words.txt: "),
        (["short.txt", "a.csv"], "short.txt: has 4 columns, not the 8 of TUM's format"),
        (["back.txt", "a.csv"], "back.txt: field 'time' does not increase"),
        (["turn.txt", "a.csv"], "turn.txt: field 'qx qy qz qw' is not a unit quaternion"),
        (["nan.txt", "a.csv"], "nan.txt: field 't x y z qx qy qz qw' is NaN or Inf"),
        (["early.txt", "a.mcap"], "a.mcap: stamps begin at -1 s; ROS has none below 0"),
        (["late.txt", "a.mcap"], "a.mcap: stamps end at 1.7e+18 s; ROS counts seconds in 32 bits"),
        (["walk.txt", "a.gpx"], "a.gpx: gpx needs a place on the earth; give --first-fix LAT LON"),
        (["walk.txt", "a.gpx", "--first-fix", "48", "11"], "--heading: is missing"),
        (
            ["walk.txt", "a.gpx", "--first-fix", "48", "--heading", "1"],
            "--first-fix: holds 1 numbers; give LAT LON or LAT LON ALT",
        ),
        (
            ["walk.txt", "a.gpx", "--first-fix", "148", "11", "--heading", "1"],
            "--first-fix: 148 11 is no place on the earth; give LAT LON",
        ),
    ],
)
def test_a_mistake_is_one_line(trajectory, tmp_path, capsys, arguments, expected):
    (tmp_path / "folder").mkdir()
    for name, text in {
        "words.txt": "the quick brown fox\njumps over it\n",
        "short.txt": "0 1 2 3\n1 1 2 3\n",
        "back.txt": "1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n",
        "turn.txt": "0 0 0 0 0 0 0 2\n1 0 0 0 0 0 0 1\n",
        "nan.txt": "0 0 0 0 0 0 0 1\n1 nan 0 0 0 0 0 1\n",
        "late.txt": "0 0 0 0 0 0 0 1\n1.7e18 0 0 0 0 0 0 1\n",
        "early.txt": "-1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n",
    }.items():
        (tmp_path / name).write_text(text)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SystemExit) as left:
        console.run(lambda: main(["export", *arguments]))
    out, err = capsys.readouterr()
    assert (left.value.code, out) == (2, "") and err.count("\n") == 1 and expected in err, err
    assert sorted(tmp_path.iterdir()) == before
