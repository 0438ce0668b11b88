"""Walks with waypoints as training reads them: smoothed poses by an earlier run, from the cache."""

import dataclasses
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from gnio_jax import data, filtering
from gnio_jax.config import DataConfig
from gnio_jax.data import loading
from gnio_jax.errors import InputError
from gnio_jax.models import Network
from gnio_jax.networks import read_network
from gnio_jax.reporting import Lines, Silence
from gnio_jax.training import recordings, run_folder, waypoint_poses
from gnio_jax.training.window_task import WindowTask
from gnio_jax.types import Waypoints
from tests.support import drawn_run, tiny_run
from tests.support.filter_settings import changed
from tests.support.surveyor import survey

SETTINGS = changed(noise={"measurement_scale": 0.5, "correlation": None})
WINDOW = np.random.default_rng(0).standard_normal((1, 100, 6))


@pytest.fixture
def earlier(tmp_path, monkeypatch):
    """A run at 100 Hz, calibrated, whose network makes poses."""
    monkeypatch.setenv("GNIO_CACHE", str(tmp_path / "cache"))
    settings = dataclasses.replace(SETTINGS, raw_gyro_bias=0.03)
    config = tiny_run.config(None, "", data=DataConfig(rate=100.0), filter=settings)
    return tiny_run.save(tmp_path / "earlier", config)


def experiment(run, workdir="", **changes):
    windows = DataConfig(rate=50.0, poses_by=run and str(run))
    return tiny_run.config(None, workdir, data=windows, dataset="synthetic", **changes)


def read(monkeypatch, walks, run, workers=1):
    monkeypatch.setattr(loading, "read_split", lambda *_: iter(walks))
    config, samples = experiment(run), {}
    poses = waypoint_poses.load_pose_network(config, Lines())
    arguments = config, "synthetic", "train", Lines(), workers, samples, poses
    sequences = list(recordings.read_split(*arguments))
    assert samples == {sequence.name: len(sequence.time) for sequence in sequences}
    return sequences


@pytest.fixture
def smoothed(earlier, monkeypatch):
    """A smoother that is known: it moves each interpolated position a metre up, and knows nothing
    of the last three seconds. The walks that it was asked for."""
    walk_names, run = [], read_network(earlier)
    network = Network.of(run.model, run.variables)
    expected_filter = filtering.make_filter(run.config.data, run.config.filter)

    def smooth(walk, predict, ekf):
        walk_names.append(walk.name)
        assert jnp.ones(()).dtype == np.float64
        if len(walk_names) == 1:
            expected = network.apply(network.variables, jnp.float32(WINDOW))
            prediction = predict(jnp.float32(WINDOW))
            np.testing.assert_array_equal(prediction.displacement, expected.displacement)
            assert ekf == expected_filter and ekf.raw_gyro_bias == 0.03
        if walk.name == "survey 1":
            raise InputError(walk.name, "the filter fails on it")
        poses = data.with_poses(walk)
        poses = poses._replace(
            position=poses.position + np.array([0.0, 0.0, 1.0]),
            orientation=np.tile([1.0, 0.0, 0.0, 0.0], (len(walk.time), 1)),
            velocity=np.zeros((len(walk.time), 3)),
            valid=walk.time < walk.time[-1] - 3.0,
            waypoints=None,
        )
        return filtering.WaypointPoses(poses, None, None)

    monkeypatch.setattr(filtering, "waypoint_poses", smooth)
    return walk_names


def tapped(seed):
    walk = survey(seed).tapped(np.zeros(9))
    assert walk.waypoints is not None
    return walk._replace(waypoints=Waypoints(*(part[1:] for part in walk.waypoints)))


def test_smooth_poses_come_from_the_run_and_then_from_the_cache(
    earlier, smoothed, monkeypatch, capsys
):
    walks = tapped(0), tapped(1), survey(3).truth, tapped(2)
    first, _, posed, last = walks
    with jax.enable_x64(False):
        sequences = read(monkeypatch, walks, earlier)
    assert [sequence.name for sequence in sequences] == ["survey 0", "survey 3", "survey 2"]
    assert smoothed == ["survey 0", "survey 1", "survey 2"]
    text = capsys.readouterr().err
    assert "warning: survey 1: the filter fails on it" in text and "not calibrated" not in text
    for walk, poses in zip((first, last), (sequences[0], sequences[2]), strict=True):
        # On the legs of the interpolation, as far as the smoother knows.
        inside = data.with_poses(walk).valid & (walk.time < walk.time[-1] - 3.0)
        inside = np.interp(poses.time, walk.time, inside) > 0.5
        assert (poses.valid != inside).mean() < 0.02 and 0.1 < poses.valid.mean() < 0.9
        np.testing.assert_allclose(poses.position[poses.valid][:, 2], 1.0)
        for part in (poses.position, poses.orientation, poses.velocity):
            assert np.isnan(part[~poses.valid]).all() and np.isfinite(part[poses.valid]).all()
        expected = np.interp(poses.time, walk.time, walk.accel[:, 2])
        np.testing.assert_allclose(poses.accel[5:-5, 2], expected[5:-5], atol=0.05)
    np.testing.assert_array_equal(sequences[1].position, posed.position)

    again = read(monkeypatch, walks, earlier)
    assert len(smoothed) == 3
    assert "warning: survey 1: the filter fails on it" in capsys.readouterr().err
    for one, other in zip(sequences, again, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
        np.testing.assert_array_equal(one.valid, other.valid)


def test_what_the_poses_depend_on_is_what_they_are_kept_under(earlier, monkeypatch):
    sources = []
    monkeypatch.setattr(
        waypoint_poses, "cache_entry", lambda name, files: sources.append(files) or Path(name)
    )
    walk, run = tapped(0), read_network(earlier)
    digest = waypoint_poses.digest_network(run)
    by = waypoint_poses.PoseNetwork(str(earlier), digest)
    assert walk.waypoints is not None
    time, position = walk.waypoints
    others = [
        walk._replace(name="other"),
        walk._replace(attributes=walk.attributes | {"imu_compensated": "no"}),
        walk._replace(gyro=walk.gyro + 1e-9),
        walk._replace(accel=walk.accel + 1e-9),
        walk._replace(imu_valid=np.arange(len(walk.time)) > 5),
        walk._replace(waypoints=Waypoints(time, position + 1e-9)),
    ]
    entries = {waypoint_poses._cache_entry(sequence, by) for sequence in [walk, *others]}
    entries.add(waypoint_poses._cache_entry(walk, by._replace(digest="other")))
    assert len(entries) == len(others) + 2
    names = {"/".join(path.parts[-2:]) for path in sources[0]}
    assert {"filtering/waypoints.py", "models/gnio.py", "gnio_jax/geometry.py"} <= names

    settings = dataclasses.replace(run.config.filter, raw_gyro_bias=0.04)
    other = run._replace(config=dataclasses.replace(run.config, filter=settings))
    changed_weights = jax.tree.map(lambda leaf: leaf + 1e-6, run.variables)
    moved = run._replace(config=dataclasses.replace(run.config, workdir="elsewhere"))
    assert waypoint_poses.digest_network(moved) == digest
    for network in (other, run._replace(variables=changed_weights)):
        assert waypoint_poses.digest_network(network) != digest


def test_a_run_that_changes_at_its_place_makes_its_own_poses(earlier, smoothed, monkeypatch):
    config = read_network(earlier).config
    read(monkeypatch, [tapped(0)], earlier)
    old = waypoint_poses.PoseNetwork(
        str(earlier), waypoint_poses.digest_network(read_network(earlier))
    )
    tiny_run.save(earlier, dataclasses.replace(config, filter=changed(SETTINGS)), size=0.3)
    read(monkeypatch, [tapped(0)], earlier)
    assert smoothed == ["survey 0"] * 2
    waypoint_poses._load_smoother.cache_clear()
    with pytest.raises(InputError, match="has changed while it made poses"):
        waypoint_poses.smooth_poses(tapped(0), old)


def unread():
    pytest.fail("was read")
    yield


def test_a_run_that_cannot_make_poses_is_told_before_anything_is_read(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="gone: no such network"):
        read(monkeypatch, unread(), tmp_path / "gone")
    slow = DataConfig(rate=25.0, stride_seconds=0.2, train_stride_seconds=0.2)
    tiny_run.save(tmp_path / "slow", tiny_run.config(None, "", data=slow))
    with pytest.raises(InputError, match="slower than data"):
        read(monkeypatch, unread(), tmp_path / "slow")


def test_a_run_that_is_not_calibrated_is_warned_of(tmp_path, capsys):
    run = tiny_run.save(tmp_path / "plain", tiny_run.config(None, "", data=DataConfig(rate=50.0)))
    assert waypoint_poses.load_pose_network(experiment(run), Lines()) is not None
    assert f"warning: {run}: its filter is not calibrated" in capsys.readouterr().err


def test_a_resumed_run_takes_the_same_poses_from_another_place(
    earlier, smoothed, monkeypatch, tmp_path
):
    seeds = {"train": 0, "val": 2}
    monkeypatch.setattr(
        loading, "read_split", lambda _, __, split, *___: iter([tapped(seeds[split])])
    )

    def opened(run, resume=True):
        config = experiment(run, tmp_path / "run")
        task, training_data = recordings.set_up(WindowTask, config, Silence())
        assert task.config.data.poses_by is None
        with run_folder.open_run(config, training_data, {}, resume):
            return yaml.safe_load((tmp_path / "run" / "splits.yaml").read_text())

    splits = opened(earlier, resume=False)
    assert splits["data.poses_by"] == [waypoint_poses.digest_network(read_network(earlier))]
    assert opened(shutil.copytree(earlier, tmp_path / "moved")) == splits
    other = tiny_run.save(tmp_path / "other", read_network(earlier).config, size=0.3)
    with pytest.raises(InputError, match=r"begun with other recordings in split 'data\.poses_by'"):
        opened(other)
    assert len(smoothed) == 4
    with pytest.raises(InputError, match=r"begun with other recordings in split 'data\.poses_by'"):
        opened(None)


@pytest.mark.slow
def test_processes_make_the_poses_that_one_makes(earlier, monkeypatch):
    """By a network that has learnt only that people walk at 1.1 m/s where the phone points."""
    config = read_network(earlier).config
    model = dataclasses.replace(config.model, name="tlio", width=2, uncertainty=None)
    config = dataclasses.replace(config, model=model, data=DataConfig(rate=50.0))
    outputs = iter(([0.0, 1.1, 0.0], [-1.5, -1.5, -1.5]))  # m, and logarithms of m

    def draw(random, kind, shape):
        return next(outputs) if shape == (3,) else np.full(shape, float(kind == "batch_stats"))

    run = drawn_run.save(earlier.with_name("ahead"), config, draw)
    monkeypatch.setattr(waypoint_poses, "FEW", 1)
    walks = [survey(seed, legs=3).tapped(np.zeros(4)) for seed in (1, 7)]
    shared = read(monkeypatch, walks, run, workers=2)
    monkeypatch.setenv("GNIO_CACHE", str(earlier / "empty"))
    alone = read(monkeypatch, walks, run)
    assert len(shared) == len(alone) == 2
    for one, other in zip(shared, alone, strict=True):
        assert one.name == other.name and one.valid.any()
        assert one.attributes["reference"] == "waypoints, smoothed"
        np.testing.assert_allclose(one.position, other.position, atol=1e-6)
