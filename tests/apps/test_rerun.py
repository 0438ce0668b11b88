"""The file for Rerun is read back by Rerun's own reader."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.apps import rerun
from gnio_jax.errors import InputError
from gnio_jax.evaluation import PreparedRecording
from tests.support.estimates import estimate, with_covariance
from tests.support.rerun_files import columns_of


def recording_of(walk, rate=50.0):
    """The IMU of a walk."""
    stamps = walk.trajectory.time
    time = np.arange(round(rate * (stamps[-1] - stamps[0]))) / rate
    gyro, accel = (np.sin(np.outer(time, [1.0, 2.0, 3.0]) + k) for k in (0.0, 1.0))
    unseen = dict.fromkeys(PreparedRecording._fields)
    return PreparedRecording(
        **unseen | {"name": walk.name, "time": stamps, "gyro": gyro, "accel": accel}
    )


def seconds(column):
    return np.array([stamp.total_seconds() for stamp in column])


def test_the_file_is_read_back(tmp_path):
    pytest.importorskip("rerun", reason="needs rerun-sdk")
    walk, blind = estimate("room 1/walk", 0), estimate("blind", 1, truth=False)
    covariance = np.array([[4.0, 1.5, 0.2], [1.5, 1.0, 0.1], [0.2, 0.1, 0.5]])
    walk = with_covariance(walk, np.tile(covariance, (400, 1, 1)))
    path = tmp_path / "walks.rrd"
    rerun.write(path, [walk, blind], [recording_of(walk), recording_of(blind)], "none")
    assert [file.name for file in tmp_path.iterdir()] == ["walks.rrd"]
    columns = columns_of(path)
    assert "/blind/estimate" in columns and "/blind/reference" not in columns
    for kind, of in (("estimate", walk.trajectory), ("reference", walk.reference)):
        ((line,),) = columns[f"/room_1_walk/{kind}"]["LineStrips3D:strips"]
        np.testing.assert_allclose(line, of.position, atol=1e-5)
    ellipsoid = columns["/room_1_walk/ellipsoid"]
    (size,), (turn,) = (ellipsoid[f"Ellipsoids3D:{x}"][7] for x in ("half_sizes", "quaternions"))
    axes = Rotation.from_quat(turn).as_matrix()
    np.testing.assert_allclose(axes @ np.diag(np.square(size) / 9) @ axes.T, covariance, atol=1e-5)
    gate = columns["/room_1_walk/gate"]
    rows = ~np.isnan(walk.displacements.value[:, 0])
    np.testing.assert_allclose(seconds(gate["time"]), 0.1 * np.flatnonzero(rows), atol=1e-6)
    expected = walk.displacements.diagnostics["gate"][rows]
    np.testing.assert_allclose(gate["Scalars:scalars"], expected)
    gyro = columns["/room_1_walk/imu/gyro"]
    np.testing.assert_allclose(seconds(gyro["time"])[[0, -1]], [0.0, 39.88], atol=1e-6)
    np.testing.assert_allclose(gyro["Scalars:scalars"], recording_of(walk).gyro)


def test_what_is_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)  # as if it were not installed
    with pytest.raises(InputError, match=r"--rerun: needs the package rerun; .*gnio-jax\[rerun\]"):
        rerun.check(tmp_path / "a.rrd")
    monkeypatch.setitem(sys.modules, "rerun", pytest)
    with pytest.raises(InputError, match=r"name it NAME\.rrd"):
        rerun.check(tmp_path / "a.txt")
    (tmp_path / "b.rrd").mkdir()
    with pytest.raises(InputError, match="is a folder"):
        rerun.check(tmp_path / "b.rrd")
