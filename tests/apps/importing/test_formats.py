"""EuRoC's layout; what is no recording; damaged files, which are read or refused in one line."""

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.errors import InputError
from tests.support import asl_files, bag_files, known_walk, logger_files
from tests.support.asl_files import EPOCH, Mount
from tests.support.importing import compare_reference, import_recording, refused

LEVER = Mount(Rotation.from_euler("zyx", [0.4, 0.2, -0.9]), np.array([0.2, -0.1, 0.3]))
KINDS = ("walk.zip", "walk.xlsx", "walk.xls", "rosbag1", "mcap", "db3")


def test_a_folder_of_eurocs_layout(tmp_path):
    """At 100 Hz, which no published set has; its estimate is moved to the IMU. A column is named as
    the authors do."""
    asl_files.write_imu(tmp_path / "mav0", step=0.01)
    alone, notes = import_recording(tmp_path)
    assert not alone.valid.any() and len(alone.time) == 1200
    assert "EuRoC's layout (ns, rad/s, m/s2), no reference" in notes[0]
    asl_files.write_estimate(tmp_path / "mav0", mount=LEVER)
    sequence, notes = import_recording(tmp_path)
    np.testing.assert_allclose(sequence.gyro, known_walk.rate(sequence.time), atol=1e-6)
    np.testing.assert_allclose(sequence.accel, known_walk.force(sequence.time), atol=1e-6)
    assert not sequence.valid[sequence.time < 0.9].any()
    compare_reference(sequence, (sequence.time > 1.5) & (sequence.time < 10.5), 1e-4)
    assert sequence.attributes["start_time"] == pytest.approx(EPOCH * 1e-9, abs=1e-6)
    assert "EuRoC's layout (ns, rad/s, m/s2), reference state_groundtruth_estimate0" in notes[0]
    assert sequence.attributes["truth"] == "state_groundtruth_estimate0"
    path = tmp_path / "mav0" / "imu0" / "data.csv"
    path.write_text(path.read_text().replace("a_RS_S_y", "b"))
    refused(tmp_path, "data.csv: column 'a_rs_s_y' is missing; found: timestamp")


def test_what_is_no_recording(tmp_path):
    with h5py.File(tmp_path / "walk.h5", "w"):
        pass
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "empty").mkdir()
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("rosbag2_bagfile_information: [1, 2]\n")
    noise = np.random.default_rng(5).integers(0, 256, 5000, dtype=np.uint8).tobytes()
    for name, head in (
        ("a", b"#ROSBAG V2.0"),
        ("b", b"\x89MCAP0\r\n"),
        ("c", b"SQLite format 3\0"),
    ):
        (tmp_path / f"{name}.db3").write_bytes(head + noise)
    for name, words in {
        "a.db3": "a.db3: cannot be read as a ROS 1 bag",
        "b.db3": "b.db3: is cut short",
        "c.db3": "c.db3: cannot be read as a ROS 2 bag",
        "walk.h5": "walk.h5: is HDF5 already; check it with gnio data check",
        "empty.csv": "empty.csv: holds no row",
        "empty": "empty: has the layout of no known recording .found: no CSV file.; known: CSV",
        "bag": "bag: cannot be read as a ROS 2 bag",
        "gone": "gone: cannot be read .No such file",
    }.items():
        refused(tmp_path / name, words)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Kind -> a path of it."""
    folder = tmp_path_factory.mktemp("whole")
    logger_files.workbooks(folder, logger_files.phyphox_sets(seconds=2.0))
    paths = {name: folder / name for name in ("walk.xlsx", "walk.xls")}
    members = logger_files.sensor_logger("ios", seconds=2.0)
    paths["walk.zip"] = logger_files.zipped(folder / "walk.zip", members)
    for kind in ("rosbag1", "mcap", "db3"):
        (folder / kind).mkdir()
        entries = bag_files.imu(bag_files.Maker(kind), seconds=2.0)
        paths[kind] = bag_files.write(folder / kind, kind, entries)
    return paths


def damaged(data, seed):
    """64 bytes anywhere, or 4 near the beginning or the end, are others."""
    random = np.random.default_rng(seed)
    width = (64, 4, 4)[seed % 3]
    near = (random.integers(len(data) - 64), random.integers(400), len(data) - 8 - seed * 9)
    start = int(near[seed % 3])
    noise = random.integers(0, 256, width, dtype=np.uint8).tobytes()
    return data[:start] + noise + data[start + width :]


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file(tmp_path, whole, kind, capfd):
    data, path = whole[kind].read_bytes(), tmp_path / whole[kind].name
    messages = []
    for seed in range(6):
        path.write_bytes(damaged(data, seed))
        try:
            import_recording(path)
        except InputError as error:
            messages.append(str(error))
    assert messages and "\n" not in "".join(messages)
    assert capfd.readouterr() == ("", "")
