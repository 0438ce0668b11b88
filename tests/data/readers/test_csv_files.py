"""One's own recordings: CSV and HDF5 folders must tell of the known walk again."""

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.readers import csv_files as csv
from gnio_jax.data.self_check import self_check
from gnio_jax.numerics import rotations
from tests.support import known_walk
from tests.support.csv_writers import SECONDS, compare_imu, write_native
from tests.support.refusals import refused


def compare_reference(sequence, start=0.0):
    known_walk.compare(sequence, sequence.time + start, speed=0.015)


@pytest.mark.parametrize(("rate", "velocity"), [(50.0, False), (202.3, True)])
def test_a_recording_with_a_reference_comes_back_at_its_own_rate(tmp_path, rate, velocity):
    """Rows without one are not valid."""

    def hole(columns):
        for name in ("px", "py", "pz"):
            columns[name][300:420] = np.nan

    jitter = np.random.default_rng(0).uniform(-1e-4, 1e-4, round(SECONDS * rate))
    time = np.arange(round(SECONDS * rate)) / rate + jitter
    path = write_native(tmp_path / "walk.csv", time, velocity=velocity, spoil=hole)
    (sequence,) = csv.read(path)
    intervals = np.diff(sequence.time)
    assert np.ptp(intervals) < 1e-9
    assert 1 / intervals[0] == pytest.approx(rate, rel=2e-2)
    assert sequence.name == "walk"
    start = sequence.attributes["start_time"]
    assert sequence.time[0] == 0.0 and start == pytest.approx(100.0 + time[0], abs=1e-8)
    compare_imu(sequence, start=start - 100.0)
    compare_reference(sequence, start=start - 100.0)
    assert self_check(sequence).failures == ()
    inside = (sequence.time > 300 / rate) & (sequence.time < 419 / rate)
    beside = (sequence.time < 298 / rate) | (sequence.time > 421 / rate)
    assert not sequence.valid[inside].any() and sequence.valid[beside].all()


def test_a_recording_without_a_reference_is_read_and_passes_no_check(tmp_path):
    write_native(tmp_path / "bare.csv", reference=False)
    write_native(tmp_path / "turned.csv", drop=("px", "py", "pz"))
    (named,) = csv.read(tmp_path / "bare.csv")
    data.write_hdf5(tmp_path / "again.h5", named)
    again, bare, turned = data.load("csv", tmp_path, "test")
    # A file gives its recording the name: two of one name would be one recording.
    assert (again.name, bare.name) == ("again", "bare")
    for sequence in (bare, turned):
        compare_imu(sequence, start=0.0)
        assert not sequence.valid.any()
        assert np.isnan(sequence.position).all()
        assert np.isnan(sequence.velocity).all()
    # An attitude alone is no reference, but the device's own.
    assert bare.device_orientation is None and turned.device_orientation is not None
    turn = rotations(turned.device_orientation).inv() * known_walk.attitude(turned.time)
    assert np.degrees(turn.magnitude()).max() < 0.1
    assert bare.attributes["truth"] == "none"


def test_all_columns_that_are_missing_are_told_with_the_command(tmp_path):
    path = tmp_path / "robot.csv"
    path.write_text("timestamp_ms,wx,wy,wz,Acc X (g),acc_y,what\n1,2,3,4,5,6,7\n2,2,3,4,5,6,7\n")
    missing = "'time', 'gyro_x', 'gyro_y', 'gyro_z', 'accel_x', 'accel_y', 'accel_z' are missing"
    command = "gnio data import robot.csv --out own/robot.h5 --columns time=timestamp_ms gyro_x=wx "
    command += "gyro_y=wy gyro_z=wz accel_x='Acc X (g)' accel_y=acc_y accel_z=COLUMN"
    refused(lambda: csv.read(path), path, missing, command)
