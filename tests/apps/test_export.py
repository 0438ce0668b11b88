"""Trajectories in other programs' formats, read back by other means than they were written."""

import itertools
import json
from datetime import datetime
from xml.etree import ElementTree

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gnio_jax.apps import export as export_module
from gnio_jax.apps.export import export, export_map
from gnio_jax.data.geodesy import Place
from gnio_jax.errors import InputError
from gnio_jax.evaluation.trajectory import Trajectory, read_tum
from tests.support import known_walk

START = 1_700_000_000.25
TIME = START + np.arange(60) / 20


def walk(time=TIME, start=START):
    x, y, z, w = known_walk.attitude(time - start).as_quat().T
    wxyz = np.stack([w, x, y, z], axis=1)
    return Trajectory(time, known_walk.position(time - start), wxyz)


def test_csv_and_tum_have_the_poses(tmp_path, monkeypatch, gnio):
    """Rows without a pose are left out."""
    poses = walk()
    holed = walk()
    holed.position[10:20] = np.nan
    holed.orientation[15:25] = np.nan
    assert export(tmp_path / "walk.csv", holed) == 45
    holed.position[:] = np.nan
    with pytest.raises(InputError, match=r"walk\.csv: the trajectory has no pose"):
        export(tmp_path / "walk.csv", holed)
    assert export(tmp_path / "walk.csv", poses) == 60
    lines = (tmp_path / "walk.csv").read_text().splitlines()
    assert lines[0] == "time,px,py,pz,qw,qx,qy,qz"
    rows = np.array([line.split(",") for line in lines[1:]], dtype=float)
    expected = np.column_stack([TIME, poses.position, poses.orientation])
    np.testing.assert_allclose(rows, expected, atol=1e-9)
    monkeypatch.chdir(tmp_path)
    export(tmp_path / "walk.txt", poses)
    output = gnio("data", "export", "walk.txt", "walk.tum")
    assert output == "walk.tum: 60 poses, 3.0 s\n"
    again = read_tum(tmp_path / "walk.tum")
    for field, original in zip(again, poses, strict=True):
        np.testing.assert_allclose(field, original, atol=1e-9)


def test_the_mcap_is_read_by_rosbags(tmp_path):
    """With the types that the file itself defines."""
    poses = walk()
    spread = np.tile(np.diag([0.04, 0.09, 0.01]), (60, 1, 1))
    spread[5] = np.nan
    assert export(tmp_path / "walk.mcap", poses, covariance=spread) == 60
    store = get_typestore(Stores.EMPTY)
    with (tmp_path / "walk.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    with Reader(tmp_path / "walk.mcap") as reader:
        for one in reader.connections:
            store.register(get_types_from_msg(one.msgdef.data, one.msgtype))
        messages = [
            (one.topic, time, store.deserialize_cdr(data, one.msgtype))
            for one, time, data in reader.messages()
        ]
    odometry = [message for topic, _, message in messages if topic == "/odometry"]
    (path,) = [message for topic, _, message in messages if topic == "/path"]
    times = [time for topic, time, _ in messages if topic == "/odometry"]
    np.testing.assert_allclose(np.array(times) * 1e-9, TIME, atol=1e-6)
    for message, stamped, position in zip(odometry, path.poses, poses.position, strict=True):
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "imu")
        point, other = message.pose.pose.position, stamped.pose.position
        assert (point.x, point.y, point.z) == (other.x, other.y, other.z) == tuple(position)
        assert message.header.stamp == stamped.header.stamp
    moved = [message.transforms for topic, _, message in messages if topic == "/tf"]
    assert len(moved) == 60 and all(len(transforms) == 1 for transforms in moved)
    one, turn = moved[41][0], moved[41][0].transform.rotation
    assert (one.header.frame_id, one.child_frame_id) == ("odom", "imu")
    assert one.header.stamp == odometry[41].header.stamp
    assert one.transform.translation.y == poses.position[41][1]
    assert (turn.w, turn.x, turn.y, turn.z) == tuple(poses.orientation[41])
    assert odometry[3].pose.covariance.reshape(6, 6)[1, 1] == 0.09
    assert not odometry[5].pose.covariance.any()
    moving, when = odometry[30].twist.twist, TIME[30] - START
    body = known_walk.attitude(when).inv().apply(known_walk.velocity(when))
    linear, angular = moving.linear, moving.angular
    np.testing.assert_allclose([linear.x, linear.y, linear.z], body, atol=0.05)
    rate = known_walk.rate(when + 0.025)
    np.testing.assert_allclose([angular.x, angular.y, angular.z], rate, atol=0.05)


LEVEL, WHOLE = "0 0 0 0 0 0 1\n", "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "out", "expected"),
    [
        (WHOLE, "a.dat", "a.dat: the ending of its name is not a known format; known"),
        ("0 1 2 3\n1 1 2 3\n", "a.csv", "walk.txt: has 4 columns, not 8"),
        (f"0 {LEVEL}1 nan 0 0 0 0 0 1\n", "a.csv", "column 'x' is NaN or Inf in 1 rows, first in"),
        (f"-1 {LEVEL}1 {LEVEL}", "a.mcap", "a.mcap: stamps begin at -1 s; ROS has none below 0"),
        (f"0 {LEVEL}1.7e18 {LEVEL}", "a.mcap", "a.mcap: stamps end at 1.7e+18 s; ROS counts sec"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, monkeypatch, mistake, text, out, expected):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "walk.txt").write_text(text)
    before = sorted(tmp_path.iterdir())
    assert expected in mistake("data", "export", "walk.txt", out)
    assert sorted(tmp_path.iterdir()) == before


def test_a_map_has_the_name_of_the_recording_and_longitudes_within_180_degrees(tmp_path):
    """A ferry goes two metres east in a second, across the antimeridian after 27 s."""
    time = START + np.arange(60.0)
    east = np.column_stack([2.0 * (time - START), 0 * time, 0 * time])
    ferry = Trajectory(time, east, np.tile([1.0, 0, 0, 0], (60, 1)))
    longitude = 179.9995 + np.degrees(east[:, 0] / 6378137.0)
    longitude[longitude > 180.0] -= 360.0
    origin = Place(0.0, 179.9995, 0.0)
    for kind in ("gpx", "geojson"):
        export_map(tmp_path / f"trajectory.{kind}", ferry, origin, "ferry & \udcff\x01walk")
    space = "{http://www.topografix.com/GPX/1/1}"
    track = ElementTree.parse(tmp_path / "trajectory.gpx").getroot()
    assert track.findtext(f"{space}trk/{space}name") == r"ferry & \udcff\x01walk"
    points = [float(point.get("lon")) for point in track.iter(f"{space}trkpt")]
    np.testing.assert_allclose(points, longitude, atol=1e-6)
    content = json.loads((tmp_path / "trajectory.geojson").read_text())
    west, east = map(np.array, content["features"][0]["geometry"]["coordinates"])
    np.testing.assert_allclose(np.append(west[:-1, 0], east[1:, 0]), longitude, atol=1e-6)
    assert west[-1, 0] == 180.0 and east[0, 0] == -180.0
    times = content["features"][0]["properties"]["coordTimes"]
    assert [len(part) for part in times] == [len(west), len(east)] == [29, 33]
    # 0.0005° are 55.660 m, which take 27.830 s; the longitudes are rounded to a centimetre.
    assert times[0][-1] == times[1][0]
    crossed = datetime.fromisoformat(times[0][-1]).timestamp()
    assert crossed - START == pytest.approx(27.830, abs=0.01)


@pytest.mark.parametrize(
    ("longitudes", "parts"),
    [
        ([179.0, 179.5], [[179.0, 179.5]]),
        ([179.0, -179.0], [[179.0, 180.0], [-180.0, -179.0]]),
        ([-179.0, 179.0], [[-179.0, -180.0], [180.0, 179.0]]),
        (
            [179.0, -178.0, -179.0, 179.0, -179.0],
            [[179, 180], [-180, -178, -179, -180], [180, 179, 180], [-180, -179]],
        ),
        ([179.0, 180.0, -179.0], [[179.0, 180.0], [-180.0, -179.0]]),
        ([179.0, -180.0, -179.0], [[179.0, 180.0], [-180.0, -179.0]]),
        ([179.0, 180.0, 179.0], [[179.0, 180.0, 179.0]]),  # it touches
        ([179.0, -180.0, 179.0], [[179.0, 180.0, 179.0]]),
        ([-179.0, 180.0, 180.0, -179.0], [[-179.0, -180.0, -180.0, -179.0]]),
        ([180.0, -179.0], [[-180.0, -179.0]]),
        ([-180.0, 179.0], [[180.0, 179.0]]),
        ([179.0, -180.0], [[179.0, 180.0]]),
    ],
)
def test_a_line_is_cut_where_it_crosses_the_antimeridian(longitudes, parts):
    """The other columns of a crossing lie between those of its neighbours."""
    count = len(longitudes)
    points = np.column_stack([longitudes, 10.0 * np.arange(count), np.arange(count)])
    lines = export_module._cut_at_antimeridian(points)
    assert [line[:, 0].tolist() for line in lines] == parts
    for line in lines:
        np.testing.assert_allclose(line[:, 1], 10.0 * line[:, 2])
    ends = [line[[0, -1], 2] for line in lines]
    for (_, end), (begin, _) in itertools.pairwise(ends):
        assert end == begin
    if parts == [[179.0, 180.0], [-180.0, -179.0]] and count == 2:
        assert lines[0][-1].tolist() == [180.0, 5.0, 0.5]


@pytest.mark.parametrize("longitude", [180.0, 180.0 - 1e-9])
def test_gpx_has_no_longitude_of_180_degrees(tmp_path, longitude):
    """Its schema ends before it. The second one is rounded to it."""
    still = Trajectory(START + np.arange(2.0), np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    export_map(tmp_path / "a.gpx", still, Place(10.0, longitude, 0.0), "north")
    assert (tmp_path / "a.gpx").read_text().count('lon="-180.0000000"') == 2
