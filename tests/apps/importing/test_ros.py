"""Bags that the libraries' own writers wrote must tell of the known walk again."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.apps.importing import ros
from tests.support import bag_files, known_walk
from tests.support.bag_files import EPOCH, KINDS, LOGGED, Maker, imu, poses, text, write
from tests.support.importing import import_recording, refused

ONE = (Rotation.identity(), np.zeros(3))
MOUNT = (Rotation.from_euler("zyx", [0.5, -1.1, 2.0]), np.array([0.1, -0.3, 0.25]))


def compare_imu(sequence):
    np.testing.assert_allclose(sequence.gyro, known_walk.rate(sequence.time), atol=1e-9)
    np.testing.assert_allclose(sequence.accel, known_walk.force(sequence.time), atol=1e-9)


def compare_reference(sequence, atol, inner=50):
    """Where it is valid, which it is but near the ends."""
    rows = slice(inner, -inner)
    time = sequence.time[rows]
    assert sequence.valid[rows].all()
    np.testing.assert_allclose(sequence.position[rows], known_walk.position(time), atol=atol)
    speed = known_walk.velocity(time)
    np.testing.assert_allclose(sequence.velocity[rows], speed, atol=20 * atol)
    wxyz = sequence.orientation[rows]
    turned = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).inv() * known_walk.attitude(time)
    assert turned.magnitude().max() < 10 * atol


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag(tmp_path, kind):
    make = Maker(kind)
    entries = imu(make) + poses(make, "Odometry", ONE, child="imu_link") + text(make)
    sequence, notes = import_recording(write(tmp_path, kind, entries))
    compare_imu(sequence)
    compare_reference(sequence, 2e-3)
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
    make = Maker()
    sequence, notes = import_recording(
        write(tmp_path, "mcap", imu(make) + poses(make, kind, ONE, child="imu_link"))
    )
    if kind == "Pose":  # without a header: stamped by the bag
        assert sequence.valid[100:-100].all()
        late = known_walk.position(sequence.time[100:-100] - LOGGED * 1e-9)
        np.testing.assert_allclose(sequence.position[100:-100], late, atol=2e-3)
    else:
        compare_reference(sequence, 2e-3)
    mixed = "/pose has no stamps of its own and is stamped by the bag, the IMU by its headers"
    assert any(mixed in note for note in notes) == (kind == "Pose")
    joined = kind == "TransformStamped"
    assert any("taken as one" in note for note in notes) != joined


@pytest.mark.parametrize("forward", [True, False])
def test_a_reference_is_moved_along_static_transforms(tmp_path, forward):
    """base_link → plate → imu_link, the first given in either direction."""
    make = Maker()
    half = Rotation.from_euler("x", 0.7)
    rest = half.inv() * MOUNT[0], half.inv().apply(MOUNT[1] - [0.1, 0.0, 0.0])
    first = ("base_link", "plate", half, [0.1, 0.0, 0.0])
    if not forward:
        first = ("/plate", "base_link", half.inv(), half.inv().apply([-0.1, 0.0, 0.0]))
    static = [make.static(*first), make.static("plate", "imu_link", *rest)]
    entries = imu(make) + poses(make, "Odometry", MOUNT)
    for number, one in enumerate(static):
        entries += bag_files.rows("/tf_static", "tf2_msgs/msg/TFMessage", [number], lambda _: one)  # noqa: B023
    sequence, notes = import_recording(write(tmp_path, "mcap", entries))
    compare_reference(sequence, 2e-3)
    assert any("moved from 'base_link' to 'imu_link' by /tf_static" in note for note in notes)


def test_transforms_need_a_frame_where_several_move(tmp_path):
    make = Maker()
    entries = imu(make) + poses(make, "TFMessage", ONE, topic="/tf", child="imu_link")
    path = write(tmp_path, "mcap", entries)
    sequence, notes = import_recording(path)
    assert not sequence.valid.any()
    assert any("no reference is taken; --reference-topic may be /tf (" in note for note in notes)
    refused(
        path,
        "topic /tf moves the frames imu_link, wheel; name one: --reference-topic /tf:FRAME",
        reference_topic="/tf",
    )
    sequence, _ = import_recording(path, reference_topic="/tf:imu_link")
    compare_reference(sequence, 2e-3)


def test_slow_poses_follow_splines(tmp_path):
    """A lidar's 10 Hz."""
    make = Maker()
    entries = imu(make) + poses(make, "Odometry", ONE, rate=10.0, child="imu_link")
    sequence, _ = import_recording(write(tmp_path, "mcap", entries))
    compare_reference(sequence, 2e-2)
    assert sequence.valid.mean() > 0.9


def test_empty_headers_leave_the_bags_stamps(tmp_path):
    make = Maker(headers=False)
    entries = imu(make) + poses(make, "Odometry", ONE, child="imu_link")
    sequence, notes = import_recording(write(tmp_path, "mcap", entries))
    compare_imu(sequence)
    compare_reference(sequence, 2e-3)
    assert sequence.attributes["start_time"] == pytest.approx((EPOCH + LOGGED) * 1e-9, abs=1e-6)
    assert any("stamped by its bag: its headers have no time" in note for note in notes)


def test_topics_are_chosen_and_named(tmp_path):
    make = Maker()
    entries = imu(make) + imu(make, "/camera/imu", rate=200.0, unit=1 / 9.80665) + text(make)
    entries += poses(make, "PoseStamped", ONE, topic="/a", child="")
    entries += poses(make, "PoseStamped", ONE, topic="/b", child="")
    path = write(tmp_path, "rosbag2", entries)
    refused(
        path,
        r"walk: has 2 IMU topics; choose one by --imu-topic: "
        r"/imu/data \(sensor_msgs/Imu\), /camera/imu \(sensor_msgs/Imu\)",
    )
    refused(path, r"walk: has no topic '/imu'; its topics: .*/chatter", imu_topic="/imu")
    refused(path, "topic /a is geometry_msgs/msg/PoseStamped, no IMU", imu_topic="/a")
    sequence, notes = import_recording(path, imu_topic="/camera/imu")
    assert any("accel taken as g" in note for note in notes)  # as some lidars' drivers give it
    assert any("no reference is taken; --reference-topic may be /a (" in note for note in notes)
    compare_imu(sequence)
    assert len(sequence.time) == 1200 and not sequence.valid.any()
    options = {"imu_topic": "/imu/data"}
    refused(
        path, "topic /chatter is std_msgs/msg/String, no p", reference_topic="/chatter", **options
    )
    sequence, _ = import_recording(path, reference_topic="/b", **options)
    compare_reference(sequence, 2e-3)


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
    refused(path, "/camera/gyro/sample says that it has no accel", imu_topic="/camera/gyro/sample")


def test_a_bag_without_an_imu_names_its_topics(tmp_path):
    make = Maker()
    path = write(tmp_path, "mcap", text(make))
    refused(path, r"walk.mcap: has no topic of sensor_msgs/Imu; its topics: /chatter \(std_msgs/S")


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_what_an_imu_says_it_does_not_measure(tmp_path, sensor):
    path = write(tmp_path, "mcap", imu(Maker(), no=sensor))
    refused(path, f"topic /imu/data says that it has no {sensor}; name another topic")


def test_a_reference_that_is_none_is_left_out_unless_it_was_named(tmp_path):
    make = Maker()
    entries = imu(make) + poses(make, "PoseStamped", ONE, rate=1.0)
    path = write(tmp_path, "mcap", entries)
    refused(path, "topic /pose: holds 6 poses; name another", reference_topic="/pose")
    sequence, notes = import_recording(path)
    assert not sequence.valid.any()
    assert any("no reference is taken: " in note for note in notes)
    far = imu(make) + poses(make, "PoseStamped", ONE, start=100.0)
    path = write(tmp_path, "mcap", far)
    words = r"topic /pose: field 'time' .100.0 to 106.0 s .* shares nothing .* .0.0 to 6.0 s."
    refused(path, words, reference_topic="/pose")
    sequence, notes = import_recording(path)
    assert not sequence.valid.any()
    assert any("shares nothing with the IMU's" in note for note in notes)


class Bug(Exception):
    """Of ours."""


@pytest.mark.parametrize("error", [Bug, MemoryError])
@pytest.mark.parametrize("kind", ["rosbag1", "mcap"])
def test_only_what_a_library_cannot_read_is_called_damage(tmp_path, monkeypatch, error, kind):
    def fails(_):
        raise error

    path = write(tmp_path, kind, imu(Maker(kind), seconds=2.0))
    monkeypatch.setattr(ros, "_stamp", fails)
    with pytest.raises(error):
        import_recording(path)


def test_a_reference_that_does_not_fit_the_imu_is_none(tmp_path):
    """Its world lies on its side."""
    make = Maker()
    on_its_side = Rotation.from_euler("x", 90, degrees=True)
    entries = imu(make) + poses(make, "PoseStamped", (on_its_side, np.zeros(3)))
    path = write(tmp_path, "mcap", entries)
    sequence, notes = import_recording(path)
    text = " | ".join(notes)
    assert "poses of 'an unnamed frame', the IMU is in 'imu_link', and no static tra" in text
    words = "the reference /pose does not fit the IMU .mean of R·accel is"
    assert words.replace("IMU .", "IMU (") in text and not sequence.valid.any()
    assert sequence.attributes["truth"] == "none"
    refused(path, words, reference_topic="/pose")


@pytest.mark.parametrize("kind", ["rosbag1", "db3", "mcap"])
@pytest.mark.parametrize("kept", [0.1, 0.9, 0.99])
def test_a_bag_cut_short_is_one_line(tmp_path, kind, kept):
    path = write(tmp_path, kind, imu(Maker(kind), seconds=2.0))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    refused(path, f"{path.name}: (cannot be read as a ROS . bag, it may be|is) cut short")


def test_a_chunk_that_unpacks_to_gigabytes_is_refused(tmp_path, monkeypatch):
    path = write(tmp_path, "mcap", imu(Maker(), seconds=2.0))
    monkeypatch.setattr(ros, "LARGEST_CHUNK", 20_000)
    refused(path, r"walk.mcap: holds a chunk that unpacks to gigabytes")


def test_messages_of_another_encoding_are_refused(tmp_path):
    entries = imu(Maker(), seconds=2.0)
    path = bag_files.write_mcap(tmp_path / "walk.mcap", "mcap", entries, encoding="protobuf")
    refused(path, "walk.mcap: topic /imu/data is encoded as protobuf; record it as ROS 2")


@pytest.mark.parametrize("magic", [b"#ROSBAG V2.0", b"\x89MCAP0\r\n", b"SQLite format 3\0"])
def test_garbage_behind_a_true_beginning_is_one_line(tmp_path, magic):
    noise = np.random.default_rng(5).integers(0, 256, 5000, dtype=np.uint8).tobytes()
    (tmp_path / "walk.db3").write_bytes(magic + noise)
    refused(tmp_path / "walk.db3", r"walk.db3: (cannot be read as a|is cut short)")


def test_a_package_that_is_missing_is_named(tmp_path, monkeypatch):
    path = write(tmp_path, "mcap", imu(Maker(), seconds=2.0))
    monkeypatch.setitem(__import__("sys").modules, "mcap", None)
    refused(path, r"walk.mcap: needs the package mcap; pip install 'gnio-jax\[bags\]'")
