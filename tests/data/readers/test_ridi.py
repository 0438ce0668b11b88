"""RIDI: a known walk written in both of its layouts, traps included, must come back."""

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.readers import ridi
from gnio_jax.numerics import rotations
from tests.support import known_walk as walk
from tests.support.ridi_files import BOOT, write_table, write_text

SECONDS = 20.0


def compare(sequence, device=True):
    """The sequence against the walk at its own stamps, which are returned. The game rotation vector
    is right but for its yaw, and begins as the reference does."""
    time = sequence.time + (sequence.attributes["start_time"] - BOOT * 1e-9)
    np.testing.assert_allclose(np.diff(sequence.time), 1 / 200, rtol=1e-6)
    walk.compare(sequence, time, edge=20)
    assert data.self_check(sequence).failures == ()
    if device:
        error = rotations(sequence.device_orientation) * walk.attitude(time).inv()
        assert np.degrees(error.magnitude()).max() < 0.1
    return time


ORDER = (
    "rv_z pos_z ori_y time acce_x gyro_z ori_w rv_w pos_x gyro_x acce_z acce_y gyro_y rv_x rv_y "
    "pos_y ori_x ori_z"
).split()


def test_table_comes_back(tmp_path):
    """Its columns in another order, rows late or twice."""
    time = np.arange(int(SECONDS * 202.3)) / 202.3
    rows = np.arange(len(time))
    jump = np.where(rows >= 2000, 0.5, 0.0)
    rows[[100, 101]] = rows[[101, 100]]
    rows[2000:2010] = rows[2000:2010][::-1]
    write_table(tmp_path, "dan_bag1", time, ORDER, np.insert(rows, 500, [500, 500]))
    (sequence,) = ridi.read(tmp_path / "dan_bag1")
    # A jump of the odometry is marked.
    write_table(tmp_path, "dan_bag2", time, spoil=lambda table: table["pos_x"].__iadd__(jump))
    (jumped,) = ridi.read(tmp_path / "dan_bag2")
    off = np.abs(jumped.time - 2000 / 202.3)
    assert not jumped.valid[off < 0.08].any() and jumped.valid[off > 0.2].all()
    assert compare(sequence)[0] == pytest.approx(0.0, abs=0.02)
    assert sequence.valid.all() and sequence.name == "dan_bag1"
    a = sequence.attributes
    labels = (a["subject"], a["group"], a["placement"], a["imu_compensated"])
    assert labels == ("dan", "dan", "bag", "no")
    assert a["truth"] == "Tango VIO of the phone itself"


@pytest.mark.parametrize("poses", ["pose.txt", "android_sensor_pose.txt"])
def test_text_files_come_back(tmp_path, poses):
    without = () if poses == "pose.txt" else ("orientation.txt",)  # the phone's own filter
    folder = write_text(tmp_path, "hang_leg_new3", poses, seconds=SECONDS, without=without)
    (recording,) = ridi.recordings(tmp_path, "all")
    assert set(folder.iterdir()) <= set(recording.files)  # by which the cache is keyed
    (sequence,) = recording.read()
    compare(sequence, device=not without)
    assert (sequence.device_orientation is None) == bool(without)
    assert sequence.valid.mean() > 0.999
    truth = "ARCore" if poses.startswith("android") else "Tango"
    assert sequence.attributes["truth"].startswith(truth)


def test_a_lost_odometry_ends_a_piece_and_a_short_loss_is_marked(tmp_path):
    time = np.arange(0.0, walk.SECONDS - 0.4, 1 / 30.0)
    time = time[((time < 24.0) | (time > 25.6)) & ((time < 10.0) | (time > 10.4))]
    gaps = r"hang_leg1: field 'time' has gaps longer than 1 s \(1, up to 1\.7 s\)"
    with pytest.warns(UserWarning, match=gaps):
        sequence, later = ridi.read(write_text(tmp_path, "hang_leg1", pose_time=time))
    compare(sequence)
    compare(later)
    assert later.time[-1] == pytest.approx(walk.SECONDS - 0.4 - 25.6, abs=0.1)
    assert later.valid.mean() > 0.99
    assert sequence.time[-1] == pytest.approx(24.0, abs=0.05)
    assert not sequence.valid[(sequence.time > 10.01) & (sequence.time < 10.39)].any()
    assert sequence.valid[(sequence.time < 9.9) | (sequence.time > 10.5)].all()
