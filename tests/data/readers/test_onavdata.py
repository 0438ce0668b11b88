"""onavdata: a known motion must come back from its increments and its angles, and damaged files are
refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.readers import onavdata
from gnio_jax.data.self_check import self_check
from gnio_jax.errors import InputError
from tests.support import known_walk
from tests.support import onav_files as files


def test_a_drive_comes_back(tmp_path):
    files.write(tmp_path / "HGuide n380")
    (sequence,) = data.load("onavdata", tmp_path, "test")
    assert sequence.name == files.DRIVE and self_check(sequence, pedestrian=False).failures == ()
    # The body is turned about its axis ahead, and otherwise it is the known one.
    attitude = Rotation.from_quat(sequence.orientation, scalar_first=True)
    level = sequence._replace(
        gyro=sequence.gyro @ files.FLIP,
        accel=sequence.accel @ files.FLIP,
        orientation=(attitude * Rotation.from_matrix(files.FLIP)).as_quat(scalar_first=True),
    )
    origin = known_walk.position(np.zeros(1))
    known_walk.compare(level, sequence.time, speed=2e-2, origin=origin, imu=0.3)
    # A sample drives the time after its stamp, on average at its middle.
    middle = sequence.time[:-1] + 0.005
    np.testing.assert_allclose(level.gyro[:-1], known_walk.rate(middle), atol=1e-3)
    np.testing.assert_allclose(level.accel[:-1], known_walk.force(middle), atol=1e-3)
    reference = Rotation.from_quat(level.orientation, scalar_first=True)
    turns = (reference[:-1].inv() * reference[1:]).as_rotvec() / 0.01
    np.testing.assert_allclose(level.gyro[:-1], turns, atol=2e-3)


def test_tables_that_share_no_stamp_are_refused(tmp_path):
    folder, time = files.write(tmp_path, 8.0), np.arange(0, 8, 0.01) + 0.003
    names = [f"VelocityNED[{axis}]" for axis in range(3)]
    files.zipped(folder, "velocity", names, time, np.zeros((len(time), 3)))
    with pytest.raises(InputError, match="has no stamps that position, velocity and attitude"):
        onavdata.read(folder)
