"""The benchmarks find what they measure: their own figures are taken by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import drives, train_step
from gnio_jax.apps.drive import load_filter
from gnio_jax.data.geodesy import east_north_up
from gnio_jax.errors import InputError
from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.types import Sequence


def test_the_training_step_has_windows_to_learn_from():
    source = train_step.recordings(20, 4)
    rows = np.asarray(source.start)[:, None] + np.arange(20)
    assert rows.max() < len(source.imu) and len(source.visited) == len(source.start)
    first, last = np.asarray(source.stretch).T
    assert (first <= rows[:, 0]).all() and (rows[:, -1] <= last).all()


def straight_drive(seconds):
    """A drive eastwards at 10 m/s from 70 to 110 s, else at 1 m/s, with ten samples a second."""
    time = 5.0 + np.arange(0.0, seconds, 0.1)
    position = np.zeros((len(time), 3))
    position[:, 0] = time - 5.0 + 9.0 * np.clip(time - 75.0, 0.0, 40.0)
    nothing = np.zeros((len(time), 3))
    orientation = np.tile([1.0, 0.0, 0.0, 0.0], (len(time), 1))
    return Sequence(
        "drive", time, nothing, nothing, orientation, position, nothing, np.ones(len(time), bool)
    )


def test_fixes_of_a_drive_have_errors_that_last():
    drive, errors = straight_drive(1000.0), []
    for seed in range(20):
        fixes = drives.make_fixes(drive, seed)
        np.testing.assert_array_equal(fixes.time, np.arange(5.0, 1005.0))
        true = np.stack([np.interp(fixes.time, drive.time, axis) for axis in drive.position.T], 1)
        errors.append(east_north_up(fixes.values, drives.ORIGIN) - true)
    errors = np.stack(errors)
    assert errors.std(axis=(0, 1)) == pytest.approx(3.0, rel=0.1)
    products = np.mean(errors[:, 20:] * errors[:, :-20], axis=(0, 1))
    assert products / 9.0 == pytest.approx(np.exp(-1.0), abs=0.15)


def test_the_way_through_the_longest_gap_is_compared(monkeypatch):
    """The estimate of this drive runs 2 m south while it has no fixes, and the next fix ends it."""
    drive, config = straight_drive(160.0), load_filter("car")

    def estimate_drive(drive, readings, settings):
        assert settings is config
        fixes = readings["gnss"].time
        (gap,) = np.flatnonzero(np.diff(fixes) > 1.5)
        first, last = fixes[gap], fixes[gap + 1]
        assert last - first == 30.0 and 75.0 <= first and last <= 115.0
        error = np.zeros_like(drive.position)
        share = (drive.time - first) / (last - 0.1 - first)
        error[:, 1] = np.where(drive.time < last - 0.05, -2.0 * np.clip(share, 0.0, 1.0), 0.0)
        paths = (
            Trajectory(drive.time, drive.position + move, drive.orientation)
            for move in (error + np.array([40.0, -7.0, 1.0]), 0.0)
        )
        return SimpleNamespace(
            estimate=SimpleNamespace(**dict(zip(("trajectory", "reference"), paths, strict=True)))
        )

    monkeypatch.setattr(drives, "estimate_drive", estimate_drive)
    error, length = drives.error_through_gap(drive, config, drives.Gap(30.0, 30.0), 0)
    assert error == pytest.approx(2.0, abs=0.02) and length == pytest.approx(299.0, abs=0.5)
    with pytest.raises(InputError, match="gap of 30 s after 200 s"):
        drives.error_through_gap(drive, config, drives.Gap(30.0, 200.0), 0)


def test_the_states_of_a_drive_are_those_that_are_named():
    config = load_filter("car")
    before = config.filter.measurements["nonholonomic"]
    names = {"mounting_std", "mounting_seconds", "lever_std"}
    without = drives.with_states(config, {}).filter.measurements["nonholonomic"]
    assert without == {name: value for name, value in before.items() if name not in names}
    lever = drives.with_states(config, {"lever_std": 1.0}, roll=3.0)
    assert lever.filter.measurements["nonholonomic"] == {**without, "lever_std": 1.0, "roll": 3.0}
    assert drives.KITTI_STATES.items() <= before.items()
