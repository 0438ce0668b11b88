"""Walks with waypoints as training reads them: smoothed poses by an earlier run, from the cache."""

import dataclasses

import numpy as np
import pytest

from gnio_jax import data, filtering
from gnio_jax.config import DataConfig
from gnio_jax.data import loading
from gnio_jax.errors import InputError
from gnio_jax.reporting import Lines
from gnio_jax.training import recordings
from gnio_jax.training.checkpoint import load_run
from gnio_jax.types import Waypoints
from tests.support import tiny_run
from tests.support.filter_settings import changed
from tests.support.surveyor import survey


@pytest.fixture
def earlier(tmp_path, monkeypatch):
    """A run at 25 Hz whose network makes poses."""
    monkeypatch.setenv("GNIO_CACHE", str(tmp_path / "cache"))
    windows = DataConfig(rate=25.0, stride_seconds=0.2, train_stride_seconds=0.2)
    return tiny_run.save(tmp_path / "earlier", tiny_run.config(None, "", data=windows))


def read(monkeypatch, walks, run, workers=1):
    """Names and recordings at 50 Hz of a split with these walks."""
    monkeypatch.setattr(loading, "read_split", lambda *_: iter(walks))
    config = tiny_run.config(None, "", data=DataConfig(rate=50.0, poses_by=str(run)))
    samples = {}
    found = list(recordings.read_split(config, "synthetic", "train", Lines(), workers, samples))
    assert samples == {each.name: len(each.time) for each in found}
    return found


def test_smoothed_poses_come_from_the_run_and_then_from_the_cache(earlier, monkeypatch, capsys):
    """A smoother that is known moves each interpolated position a metre up."""
    asked = []

    def waypoint_poses(walk, predict, setup):
        asked.append((walk.name, setup.config.dt))
        if walk.name == "survey 1":
            raise InputError(walk.name, "the filter fails on it")
        poses = data.with_poses(walk)
        ends = walk.time < walk.time[-1] - 3.0
        poses = poses._replace(position=poses.position + np.array([0.0, 0.0, 1.0]), valid=ends)
        return filtering.WaypointPoses(poses, None, None)

    monkeypatch.setattr(filtering, "waypoint_poses", waypoint_poses)
    first, fails, last = (survey(seed).tapped(np.zeros(9)) for seed in range(3))
    posed = survey(3).truth
    found = read(monkeypatch, [first, fails, posed, last], earlier)
    assert [each.name for each in found] == ["survey 0", "survey 3", "survey 2"]
    assert asked == [(f"survey {number}", 1 / 25) for number in range(3)]
    told = capsys.readouterr().err
    assert "warning: survey 1: the filter fails on it" in told
    assert f"warning: {earlier}: its filter is not calibrated" in told
    for walk, poses in zip((first, last), (found[0], found[2]), strict=True):
        flat = data.with_poses(walk)
        inside = flat.valid & (walk.time < walk.time[-1] - 3.0)
        inside = np.interp(poses.time, walk.time, inside) > 0.5
        assert (poses.valid != inside).mean() < 0.02 and 0 < poses.valid.mean() < 1
        np.testing.assert_allclose(poses.position[poses.valid][:, 2], 1.0)
        assert np.isnan(poses.position[~poses.valid]).all()
    np.testing.assert_array_equal(found[1].position, posed.position)

    # Again: nothing is smoothed, and nothing differs. Other waypoints and other weights are new.
    again = read(monkeypatch, [first, fails, posed, last], earlier)
    assert len(asked) == 3
    assert "warning: survey 1: the filter fails on it" in capsys.readouterr().err
    for one, other in zip(found, again, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
        np.testing.assert_array_equal(one.valid, other.valid)
    moved = Waypoints(first.waypoints.time, first.waypoints.position + 1.0)
    read(monkeypatch, [first._replace(waypoints=moved)], earlier)
    assert len(asked) == 4
    config = dataclasses.replace(
        load_run(earlier).config, filter=changed(noise={"measurement_scale": 1.0})
    )
    other = tiny_run.save(earlier.with_name("other"), config, size=0.3)
    capsys.readouterr()
    read(monkeypatch, [first], other)
    assert len(asked) == 5 and "is not calibrated" not in capsys.readouterr().err


def test_a_run_that_is_not_there_is_told_before_anything_is_read(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="gone: holds no run"):
        read(monkeypatch, iter([]), tmp_path / "gone")


@pytest.mark.slow
def test_processes_make_the_poses_that_one_makes(earlier, monkeypatch):
    """Of the run's network and its smoother, which needs float64 in every process."""
    config = load_run(earlier).config
    width = dataclasses.replace(config.model, name="gnio", width=2, uncertainty=None)
    run = earlier.with_name("gnio")
    tiny_run.save(run, dataclasses.replace(config, model=width))
    walks = [survey(seed, legs=3).tapped(np.zeros(4)) for seed in range(recordings.FEW + 1)]
    shared = read(monkeypatch, walks, run, workers=2)
    monkeypatch.setenv("GNIO_CACHE", str(earlier / "empty"))
    alone = read(monkeypatch, walks, run)
    assert len(shared) == len(alone) > recordings.FEW / 2
    for one, other in zip(shared, alone, strict=True):
        assert one.name == other.name and one.valid.any()
        assert one.attributes["reference"] == "waypoints, smoothed"
        np.testing.assert_allclose(one.position, other.position, atol=1e-6)
