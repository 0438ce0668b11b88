"""Bags that the libraries' own writers wrote must tell of the known walk again."""

import re
import sys
import tempfile

import numpy as np
import pytest
from rosbags import rosbag2
from rosbags.rosbag2.reader import zstd
from scipy.spatial.transform import Rotation

from gnio_jax.apps.importing import bags, ros
from tests.support import bag_files, known_walk
from tests.support.bag_files import EPOCH, KINDS, LOGGED, Maker, imu, poses, text, write
from tests.support.importing import compare_reference, import_recording, imported, refused

ZERO = (0.0, 0.0, 0.0, 0.0)
ONE = (Rotation.identity(), np.zeros(3))
INNER = slice(50, -50)
MOUNT = (Rotation.from_euler("zyx", [0.5, -1.1, 2.0]), np.array([0.1, -0.3, 0.25]))


def compare_imu(sequence):
    np.testing.assert_allclose(sequence.gyro, known_walk.rate(sequence.time), atol=1e-9)
    np.testing.assert_allclose(sequence.accel, known_walk.force(sequence.time), atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag(tmp_path, kind):
    make = Maker(kind)
    entries = imu(make) + poses(make, "Odometry", ONE, child="imu_link") + text(make)
    sequence, notes = import_recording(write(tmp_path, kind, entries))
    compare_imu(sequence)
    compare_reference(sequence, INNER, 2e-3)
    assert sequence.attributes["start_time"] == pytest.approx(EPOCH * 1e-9, abs=1e-6)
    assert sequence.attributes["truth"] == "/pose" and sequence.name == "walk"
    shown = " | ".join(notes)
    assert "IMU /imu/data (600 messages), stamped by its headers" in shown
    assert "accel taken as m/s2" in shown and "taken as one" not in shown
    assert "reference from /pose, " in shown


@pytest.mark.parametrize(
    "kind", ["Pose", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped"]
)
def test_every_kind_of_reference(tmp_path, kind):
    """Slow poses follow splines: a lidar's 10 Hz."""
    make, slow = Maker(), kind == "PoseStamped"
    entries = imu(make) + poses(make, kind, ONE, rate=10.0 if slow else 50.0, child="imu_link")
    sequence, notes = import_recording(write(tmp_path, "mcap", entries))
    if kind == "Pose":  # without a header: stamped by the bag
        assert sequence.valid[100:-100].all()
        expected = known_walk.position(sequence.time[100:-100] - LOGGED * 1e-9)
        np.testing.assert_allclose(sequence.position[100:-100], expected, atol=2e-3)
    else:
        compare_reference(sequence, INNER, 2e-2 if slow else 2e-3)
    text = " | ".join(notes)
    mixed = "/pose has no stamps in its headers, so those of the bag are taken"
    assert (mixed in text) == (kind == "Pose")
    assert ("taken as one" in text) == (kind != "TransformStamped")


def test_a_reference_is_moved_along_static_transforms(tmp_path):
    """base_link → plate → imu_link, the first given in the other direction; one that is no rotation
    joins nothing. Empty headers leave the bag's stamps."""
    make = Maker(headers=False)
    half = Rotation.from_euler("x", 0.7)
    remainder = half.inv() * MOUNT[0], half.inv().apply(MOUNT[1] - [0.1, 0.0, 0.0])
    first = ("/plate", "base_link", half.inv(), half.inv().apply([-0.1, 0.0, 0.0]))
    static = [make.static(*first), make.static("plate", "imu_link", *remainder)]
    static.append(make.static("base_link", "imu_link", half, [9.0, 9.0, 9.0]))
    static[-1].transforms[0].transform.rotation = make.new("geometry_msgs/msg/Quaternion", *ZERO)
    entries = imu(make) + poses(make, "Odometry", MOUNT)
    for number, one in enumerate(static):
        entries += bag_files.rows("/tf_static", "tf2_msgs/msg/TFMessage", [number], lambda _: one)  # noqa: B023
    sequence, notes = import_recording(write(tmp_path, "mcap", entries))
    compare_reference(sequence, INNER, 2e-3)
    assert any("moved from 'base_link' to 'imu_link' by /tf_static" in note for note in notes)
    assert any("stamped by its bag: its headers have no time" in note for note in notes)
    assert sequence.attributes["start_time"] == pytest.approx((EPOCH + LOGGED) * 1e-9, abs=1e-6)


def test_transforms_need_a_frame_where_several_move(tmp_path):
    make = Maker()
    entries = imu(make) + poses(make, "TFMessage", ONE, topic="/tf", child="imu_link")
    path = write(tmp_path, "mcap", entries)
    sequence, notes = import_recording(path)
    assert not sequence.valid.any()
    assert any("no reference is taken; --reference-topic may be /tf (" in note for note in notes)
    words = "topic /tf moves the frames imu_link, wheel; name one: --reference-topic /tf:FRAME"
    refused(path, words, reference_topic="/tf")
    compare_reference(import_recording(path, reference_topic="/tf:imu_link")[0], INNER, 2e-3)


def test_topics_are_chosen_and_named(tmp_path):
    make = Maker()
    entries = imu(make) + imu(make, "/camera/imu", rate=200.0, unit=1 / 9.80665) + text(make)
    entries += poses(make, "PoseStamped", ONE, topic="/a", child="")
    entries += poses(make, "PoseStamped", ONE, topic="/b", child="")
    path = write(tmp_path, "rosbag2", entries)
    topics = r"/imu/data \(sensor_msgs/Imu\), /camera/imu \(sensor_msgs/Imu\)"
    refused(path, f"walk: has 2 IMU topics; choose one by --imu-topic: {topics}")
    refused(path, r"walk: has no topic '/imu'; its topics: .*/chatter", imu_topic="/imu")
    refused(path, "topic /a is geometry_msgs/msg/PoseStamped, no IMU", imu_topic="/a")
    sequence, notes = import_recording(path, imu_topic="/camera/imu")
    assert any("accel taken as g" in note for note in notes)  # as some lidars' drivers give it
    assert any("no reference is taken; --reference-topic may be /a (" in note for note in notes)
    compare_imu(sequence)
    assert len(sequence.time) == 1200 and not sequence.valid.any()
    options = {"imu_topic": "/imu/data", "reference_topic": "/chatter"}
    refused(path, "/chatter is std_msgs/msg/String, no pose; pose topics: /a", **options)
    compare_reference(import_recording(path, **options | {"reference_topic": "/b"})[0], INNER, 2e-3)


def test_gyro_and_accelerometer_of_two_topics(tmp_path):
    """As a RealSense camera gives them, at two rates."""
    make = Maker()
    entries = imu(make, "/camera/gyro/sample", rate=200.0, no="accel")
    entries += imu(make, "/camera/accel/sample", rate=100.0, no="gyro")
    path = write(tmp_path, "mcap", entries)
    topics = {"imu_topic": "/camera/gyro/sample", "accel_topic": "/camera/accel/sample"}
    sequence, notes = import_recording(path, **topics)
    assert "accel /camera/accel/sample (600 messages), stamped by its headers" in notes[0]
    np.testing.assert_allclose(sequence.gyro, known_walk.rate(sequence.time), atol=1e-9)
    force = known_walk.force(sequence.time)
    np.testing.assert_allclose(sequence.accel[20:-20], force[20:-20], atol=2e-3)
    for sensor, other in (("gyro", "accel"), ("accel", "gyro")):
        topic = f"/camera/{sensor}/sample"
        words = f"topic {topic} says that it has no {other}; name another topic"
        refused(path, words, imu_topic=topic)


def test_an_accelerometer_in_a_frame_of_its_own_is_turned_to_the_gyro(tmp_path):
    make, turn = Maker(), Rotation.from_euler("z", 90, degrees=True)
    entries = imu(make, "/accel", seconds=20.0, no="gyro", frame="accel_link")
    for _, _, _, message in entries:
        force = message.linear_acceleration
        message.linear_acceleration = make.vector(turn.inv().apply([force.x, force.y, force.z]))
    static = make.static("imu_link", "accel_link", turn, [0.0, 0.0, 0.0])
    entries += imu(make, "/gyro", seconds=20.0, no="accel")
    topics = {"imu_topic": "/gyro", "accel_topic": "/accel"}
    refused(
        write(tmp_path, "mcap", entries),
        "the sensors contradict each other.*give both sensors the same axes in their driver, or in",
        **topics,
    )
    entries += bag_files.rows("/tf_static", "tf2_msgs/msg/TFMessage", [0.0], lambda _: static)
    sequence, notes = import_recording(write(tmp_path, "mcap", entries), **topics)
    np.testing.assert_allclose(sequence.accel, known_walk.force(sequence.time), atol=1e-9)
    assert "walk.mcap: /accel turned from 'accel_link' to 'imu_link' by /tf_static" in notes


def test_topics_of_different_clocks_and_options_of_tables_are_refused(tmp_path):
    make = Maker()
    accel_rows = imu(make, "/accel", no="gyro")
    for _, _, _, message in accel_rows:
        message.header.stamp.sec += 1
    path = write(tmp_path, "mcap", imu(make, "/gyro", no="accel") + accel_rows)
    topics = {"imu_topic": "/gyro", "accel_topic": "/accel"}
    refused(path, "topics /gyro and /accel are stamped by different clocks", **topics)
    words = "is an MCAP, no table with columns and rows; leave out --columns"
    refused(path, words, {"gyro_x": "gyro_y"}, **topics)


def test_a_reference_that_is_none_is_left_out_unless_it_was_named(tmp_path):
    """Too few poses, those of another time, those of a world that lies on its side."""
    make = Maker()
    on_its_side = Rotation.from_euler("x", 90, degrees=True), np.zeros(3)
    for reference, words in (
        ((ONE, 1.0, 0.0), "topic /pose: holds 6 poses; name another"),
        (
            (ONE, 50.0, 100.0),
            r"/pose: field 'time' .100.0 to 106.0 s .* shares nothing .* .0.0 to 6",
        ),
        ((on_its_side, 50.0, 0.0), "the reference /pose does not fit the IMU .mean of R·accel is"),
    ):
        mount, rate, start = reference
        entries = imu(make) + poses(make, "PoseStamped", mount, rate=rate, start=start)
        path = write(tmp_path, "mcap", entries)
        refused(path, words, reference_topic="/pose")
        sequence, notes = import_recording(path)
        assert not sequence.valid.any() and sequence.attributes["truth"] == "none"
        assert any(re.search(f"no reference is taken: .*{words}", note) for note in notes)
    assert any("'an unnamed frame', the IMU is in 'imu_link', and no st" in note for note in notes)


@pytest.mark.parametrize("kind", ["rosbag1", "db3", "mcap"])
def test_only_what_a_library_cannot_read_is_called_damage(tmp_path, monkeypatch, kind):
    """A bag that is cut short, or one whose index counts wrongly: `rosbags` asserts what it expects
    of an index. An error of ours is none."""
    path = write(tmp_path, kind, imu(Maker(kind), seconds=2.0))
    whole = path.read_bytes()
    for fraction in (0.1, 0.99):
        path.write_bytes(whole[: int(fraction * len(whole))])
        refused(path, f"{path.name}: (cannot be read as a ROS . bag, it may be|is) cut short")
    if kind == "rosbag1":
        data = bytearray(whole)
        index = data.index(b"op=\x04")  # a record of this kind, in whose header the count stands
        data[data.index(b"count=", index - 60) + 6] ^= 1
        path.write_bytes(data)
        refused(path, "walk.bag: cannot be read as a ROS 1 bag, it may be cut short")
    path.write_bytes(whole)
    for error in (ZeroDivisionError, MemoryError):

        def fails(_, error=error):
            raise error

        monkeypatch.setattr(ros, "_stamp", fails)
        with pytest.raises(error):
            import_recording(path)


def test_headers_that_do_not_run_as_the_bag_are_not_used(tmp_path):
    """Twice as fast, not at all, and a twentieth too fast; a delay that varies is none of these."""
    for pace, words in ((2.0, "run 2 times as"), (0.0, "run 0 times as"), (1.05, "run 1.05 times")):
        make = Maker()
        make.header = lambda time, frame, header=make.header, pace=pace: header(time * pace, frame)
        path = write(tmp_path, "mcap", imu(make))
        recording = imported(path)
        compare_imu(recording.sequence)
        assert any(f"the headers of /imu/data {words}" in warning for warning in recording.warnings)
        assert recording.sequence.attributes["start_time"] == pytest.approx(
            (EPOCH + LOGGED) * 1e-9, abs=1e-6
        )
    make = Maker()  # a few messages without a stamp
    make.header = lambda time, frame, header=make.header: header(
        time if time > 0.025 else -1.6e9, frame
    )
    recording = imported(write(tmp_path, "mcap", imu(make)))
    compare_imu(recording.sequence._replace(time=recording.sequence.time + 0.03))
    assert any(
        "rows of gyro are left out, whose stamps are far" in note for note in recording.notes
    )
    delays = np.random.default_rng(0).integers(0, 2 * LOGGED, 600)
    entries = [
        (*row[:2], row[2] + int(delay), row[3])
        for row, delay in zip(imu(Maker()), delays, strict=True)
    ]
    recording = imported(write(tmp_path, "mcap", entries))
    compare_imu(recording.sequence)
    assert recording.warnings == ()


def test_a_bag_without_an_index_and_a_name_for_another_file_have_a_remedy(tmp_path):
    path = write(tmp_path, "rosbag1", imu(Maker("rosbag1"), seconds=2.0))
    content = bytearray(path.read_bytes())
    offset = content.index(b"index_pos=") + 10
    end = int.from_bytes(content[offset : offset + 8], "little")
    content[offset : offset + 8] = bytes(8)  # as rosbag leaves it when it is killed
    path.write_bytes(content[:end])
    refused(path, r"walk\.bag: has no index, .*; make one: rosbag reindex walk\.bag$")
    path = write(tmp_path, "db3", imu(Maker("db3"), seconds=2.0))
    other = path.rename(path.with_name("walk%41.db3"))  # SQLite would open walkA.db3
    refused(other, "has %, . or # in its name; rename it")


def test_a_bag_compressed_as_a_whole_is_unpacked_by_its_owner(tmp_path, monkeypatch):
    """The library would do so itself, to the disk and whatever the size."""
    compressed = rosbag2.Writer(tmp_path / "walk", version=9)
    modes, formats = rosbag2.CompressionMode, rosbag2.CompressionFormat
    compressed.set_compression(modes.FILE, formats.ZSTD)
    monkeypatch.setattr(rosbag2, "Writer", lambda *_, **__: compressed)
    folder = write(tmp_path, "rosbag2", imu(Maker("rosbag2")))
    (packed,) = folder.glob("*.zstd")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))  # which is not there
    words = r"walk: is compressed as a whole .*; unpack its file \(zstd -d FILE\.zstd\) and import"
    refused(folder, words)
    unpacked = tmp_path / packed.stem
    unpacked.write_bytes(zstd.decompress(packed.read_bytes()))
    compare_imu(import_recording(unpacked)[0])


def test_what_no_bag_is_read_for(tmp_path, monkeypatch):
    entries = imu(Maker(), seconds=2.0)
    other = bag_files.write_mcap(tmp_path / "other.mcap", "mcap", entries, encoding="protobuf")
    refused(other, "other.mcap: topic /imu/data is encoded as protobuf; record it as ROS 2")
    path = write(tmp_path, "mcap", text(Maker()))
    refused(path, r"has no topic of sensor_msgs/Imu; its topics: /chatter \(std_msgs/String\)")
    path = write(tmp_path, "mcap", entries)
    with monkeypatch.context() as patch:
        patch.setattr(bags, "LARGEST_CHUNK", 20_000)
        refused(path, "walk.mcap: holds a chunk that unpacks to gigabytes")
    monkeypatch.setitem(sys.modules, "mcap", None)
    refused(path, r"walk.mcap: needs the package mcap; pip install 'gnio-jax\[bags\]'")
