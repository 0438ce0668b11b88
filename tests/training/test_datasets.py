"""Training on several datasets at once: what an epoch visits, validates and keeps."""

import dataclasses
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from gnio_jax import config as configuration
from gnio_jax import data
from gnio_jax.calibration import predictions
from gnio_jax.config import (
    CalibrateConfig,
    DataConfig,
    EvaluateConfig,
    FilterSettings,
    ModelConfig,
    OptimConfig,
    ThroughFilter,
    TrainConfig,
)
from gnio_jax.data.readers import DATASETS
from gnio_jax.errors import InputError
from gnio_jax.evaluation.evaluate import resolve
from gnio_jax.networks import read_network
from gnio_jax.training import checkpoint, loop, segments, windows
from gnio_jax.training.filter_task import FilterTask
from gnio_jax.training.task import TrainState
from gnio_jax.training.window_task import WindowTask
from tests.support import tiny_run
from tests.support.tiny_network import Tiny
from tests.support.tlio_files import write_splits

BOTH = ("tlio", "other")


@pytest.fixture(scope="module", autouse=True)
def folders(tmp_path_factory):
    """Two datasets in one folder, which $GNIO_DATA names, with a walk each for training, so that
    together they have the shapes of one; those of `other` are three times as long."""
    base = tmp_path_factory.mktemp("data")

    def tripled(parts):
        parts["pos_World_Device"] *= 3.0

    for name, of_train, spoil in (("tlio", "a", None), ("other", "b", tripled)):
        (base / name).mkdir()
        write_splits(base / name, of_train, spoil=spoil)
    other = dataclasses.replace(DATASETS["tlio"], name="other", folders=())
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(DATASETS, "other", other)
        patch.setenv("GNIO_DATA", str(base))
        yield


def experiment(workdir, weights=(0.5, 1.5)):
    of_data = DataConfig(rate=50.0, weights=weights)
    return tiny_run.config(None, workdir, dataset=BOTH, data=of_data)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    workdir = tmp_path_factory.mktemp("finished") / "run"
    loop.train(experiment(workdir))
    return workdir


def test_a_run_keeps_the_figures_of_each_dataset_and_chooses_by_their_mean(run):
    assert yaml.safe_load((run / "config.yaml").read_text())["dataset"] == list(BOTH)
    assert configuration.load(run) == experiment(run)
    splits = yaml.safe_load((run / "splits.yaml").read_text())
    assert {split: list(names) for split, names in splits.items()} == {
        "train": ["tlio/a", "other/b"],
        "val": ["tlio/c", "other/c"],
    }
    rows = tiny_run.rows(run)
    for row in rows:
        for figure in ("val_loss", "val_mse", "val_rmse"):
            mean = (row[f"{figure}/tlio"] + row[f"{figure}/other"]) / 2
            assert row[figure] == pytest.approx(mean, rel=1e-6)
    best = min(rows, key=lambda row: row["val_loss"])
    assert read_network(run).step == best["step"]
    count = len(range(0, 600 - 50, 5))  # windows of a walk of 12 s at 50 Hz, every 0.1 s
    assert rows[0]["step"] == (0.5 * count + 1.5 * count) // 16
    (line,) = loop.describe_epoch(
        row | {"windows_per_second": 9.0}, True, WindowTask(Tiny(), experiment(""), 1)
    )
    assert f"(tlio {row['val_rmse/tlio']:.4f}, other {row['val_rmse/other']:.4f})" in line


def test_each_dataset_is_validated_on_all_of_its_own_windows(run):
    row, latest = tiny_run.rows(run)[-1], checkpoint.load_latest(run)
    for name in BOTH:
        (walk,) = data.load(name, split="val")
        error = tiny_run.mean_square_error(latest, walk)
        assert row[f"val_mse/{name}"] == pytest.approx(error, rel=1e-4)
    assert row["val_mse/other"] > 4 * row["val_mse/tlio"]


def test_stopped_and_resumed_with_several_datasets_gives_the_same_bits(run, tmp_path):
    with tiny_run.stopped_at(4):
        assert loop.train(experiment(tmp_path / "run")).stopped_by == signal.SIGTERM
    assert loop.train(experiment(tmp_path / "run"), resume=True).stopped_by is None
    tiny_run.assert_same_runs(tmp_path / "run", run)


def test_an_epoch_visits_each_dataset_by_its_weight():
    """Half of one, drawn anew in each epoch, and the other two and a half times."""
    config = TrainConfig(dataset=BOTH, data=DataConfig(weights=(0.5, 2.5)))
    source = windows.WindowSource(*[None] * 7, visited=np.arange(100, 116))
    training, key = WindowTask(Tiny(), config, 1, (10, 6)), jax.random.key(0)
    first, second = (np.asarray(training.order(key, epoch, source)) for epoch in (0, 1))
    for order in (first, second):
        times = np.bincount(order - 100, minlength=16)
        assert sorted(times[:10]) == [0] * 5 + [1] * 5
        assert sorted(times[10:]) == [2] * 3 + [3] * 3
    assert set(first[first < 110]) != set(second[second < 110])
    assert (np.diff(first >= 110) != 0).sum() > 4  # not one after the other
    np.testing.assert_array_equal(second, training.order(key, 1, source))
    plain = WindowTask(Tiny(), TrainConfig(dataset=BOTH), 1, (10, 6)).order(key, 0, source)
    np.testing.assert_array_equal(np.sort(plain), source.visited)


def test_segments_are_visited_by_weight_too_each_in_its_share():
    walks = [data.resample(data.load(name, split="train")[0], 50.0) for name in BOTH]
    parts = [segments.segment_source([walk], 100) for walk in walks]
    source = segments.join_segments(parts)
    counts = tuple(len(part.earliest) for part in parts)
    config = TrainConfig(dataset=BOTH, data=DataConfig(weights=(1.0, 2.0)))
    order = np.asarray(FilterTask(Tiny(), config, 1, counts).order(jax.random.key(0), 0, source))
    inside = (order >= source.earliest[:, None]) & (order <= source.latest[:, None])
    assert list(inside.sum(axis=1)) == [1] * counts[0] + [2] * counts[1]
    np.testing.assert_array_equal(source.position[600:], walks[1].position)


def test_datasets_and_places_are_drawn_with_keys_of_their_own(monkeypatch):
    """A key that two drawings share would draw the same bits twice."""
    keys = []
    for name in ("permutation", "randint"):
        drawing = getattr(jax.random, name)

        def recorded(key, *arguments, drawing=drawing):
            keys.append(bytes(np.asarray(jax.random.key_data(key))))
            return drawing(key, *arguments)

        monkeypatch.setattr(jax.random, name, recorded)
    walks = [data.resample(data.load(name, split="train")[0], 50.0) for name in BOTH]
    parts = [segments.segment_source([walk], 100) for walk in walks]
    counts = tuple(len(part.earliest) for part in parts)
    config = TrainConfig(dataset=BOTH, data=DataConfig(weights=(0.5, 1.5)))
    source = segments.join_segments(parts)
    FilterTask(Tiny(), config, 1, counts).order(jax.random.key(0), 0, source)
    assert len(keys) == 4  # of two datasets, the places and their order
    assert len(set(keys)) == len(keys)


def test_the_mean_is_over_the_datasets_that_have_a_figure(run):
    """Only walks with waypoints have an error at them."""

    class Figures(WindowTask):
        def figures_of(self, state, held_out, key):
            return {**dict.fromkeys(("val_loss", "val_mse", "val_rmse"), 1.0), **held_out}

        def calibrate_uncertainty(self, state, held_out):
            return state

    task = Figures(Tiny(), experiment(run), 1)
    held_out = {"a": {"val_loss": 3.0}, "b": {"val_waypoint_error": 0.2}, "c": {}}
    _, row = task.validate(TrainState(jnp.int32(0), {}, None), held_out, jax.random.key(0))
    assert row["val_waypoint_error"] == 0.2 and row["val_loss"] == pytest.approx(5 / 3)


def test_networks_without_displacements_learn_from_several_datasets_too(tmp_path):
    """They have no error of a displacement, neither in the log nor in the line of an epoch."""
    config = TrainConfig(
        dataset=BOTH,
        workdir=str(tmp_path / "run"),
        data=DataConfig(rate=50.0, window_seconds=0.4, window_rotation="body_axes"),
        model=ModelConfig(name="ai_imu"),
        optim=OptimConfig(epochs=1, batch_size=4),
        filter=FilterSettings(measurements={"nonholonomic": {"lateral_std": 0.3}}),
        through_filter=ThroughFilter(("encoder", "uncertainty"), piece_seconds=2.0),
    )
    loop.train(config)
    (row,) = tiny_run.rows(tmp_path / "run")
    for figure in ("val_loss", "val_mse"):
        mean = (row[f"{figure}/tlio"] + row[f"{figure}/other"]) / 2
        assert row[figure] == pytest.approx(mean, rel=1e-6)
    assert not any("rmse" in name for name in row)


def test_an_evaluation_says_of_which_dataset(run):
    config = EvaluateConfig(str(run))
    with pytest.raises(InputError, match=r"has learnt from tlio, other; give --dataset, e\.g\. tl"):
        resolve(config, experiment(run))
    assert resolve(dataclasses.replace(config, dataset="other"), experiment(run)).dataset == "other"


def test_a_calibration_takes_a_folder_for_each_dataset(run, monkeypatch):
    read = []
    monkeypatch.setattr(data, "load", lambda name, root, *_: read.append((name, root)) or [])
    networks = [predictions.FoldNetwork(read_network(run), None)]

    def gather(*roots):
        config = CalibrateConfig(data_root=roots)
        with pytest.raises(InputError) as refused:  # also where there is nothing to be fitted
            predictions.predict("val", networks, config, TrainConfig().filter, lambda *_: None, 1)
        return str(refused.value)

    assert "has no recording with a reference" in gather() + gather("one", "two")
    assert read == [("tlio", None), ("other", None), ("tlio", "one"), ("other", "two")]
    assert gather("one").startswith("--data-root: names 1 folders, and the run has learnt from tli")
