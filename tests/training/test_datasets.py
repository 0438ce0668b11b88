"""Training on several datasets at once: what an epoch visits, validates and keeps."""

import dataclasses
import json
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from gnio_jax import config as configuration
from gnio_jax import data
from gnio_jax.commands import options, train
from gnio_jax.config import DataConfig, EvaluateConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.data import windows
from gnio_jax.data.readers import DATASETS
from gnio_jax.errors import InputError
from gnio_jax.evaluation.evaluate import resolve
from gnio_jax.training import checkpoint, epochs, loop, segments, task, window_task
from gnio_jax.training.filter_task import FilterTask
from gnio_jax.training.losses import Losses
from gnio_jax.training.task import TrainState
from gnio_jax.training.window_task import Validation, WindowTask
from tests.support import tiny_run
from tests.support.tiny_network import Tiny
from tests.support.tlio_files import write_splits

BOTH = ("tlio", "other")


@pytest.fixture(scope="module", autouse=True)
def registered(tmp_path_factory):
    """Two datasets in one folder, which $GNIO_DATA names; `other` has one walk for training."""
    base = tmp_path_factory.mktemp("data")
    for name in BOTH:
        (base / name).mkdir()
        write_splits(base / name)
    (base / "other" / "train_list.txt").write_text("a\n")
    other = dataclasses.replace(DATASETS["tlio"], name="other", folders=())
    with tiny_run.known(), pytest.MonkeyPatch.context() as patch:
        patch.setitem(DATASETS, "other", other)
        patch.setenv("GNIO_DATA", str(base))
        yield


def tiny(workdir, **changes):
    config = TrainConfig(
        dataset=BOTH,
        workdir=str(workdir),
        data=DataConfig(rate=50.0, weights=(0.5, 2.0)),
        model=ModelConfig("tiny"),
        optim=OptimConfig(epochs=3, batch_size=16, learning_rate=1e-3, warmup_epochs=1.0),
    )
    return dataclasses.replace(config, **changes)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    workdir = tmp_path_factory.mktemp("finished") / "run"
    loop.train(tiny(workdir))
    return workdir


def rows_of(workdir):
    return [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]


def variables(workdir):
    return jax.tree.map(np.asarray, checkpoint.load_run(workdir, "latest").variables)


def test_a_run_keeps_the_figures_of_each_dataset_and_chooses_by_their_mean(finished):
    assert yaml.safe_load((finished / "config.yaml").read_text())["dataset"] == list(BOTH)
    assert configuration.load(finished) == tiny(finished)
    assert yaml.safe_load((finished / "splits.yaml").read_text()) == {
        "train": ["tlio/a", "tlio/b", "other/a"],
        "val": ["tlio/c", "other/c"],
    }
    rows = rows_of(finished)
    for row in rows:
        for figure in ("val_loss", "val_mse", "val_rmse"):
            mean = (row[f"{figure}/tlio"] + row[f"{figure}/other"]) / 2
            assert row[figure] == pytest.approx(mean, rel=1e-6)
    best = min(rows, key=lambda row: row["val_loss"])
    assert checkpoint.load_run(finished, "best").step == best["step"]
    each = len(range(0, 600 - 50, 5))  # windows of a walk of 12 s at 50 Hz, every 0.1 s
    assert rows[0]["step"] == (each + 2 * each) // 16  # half of two walks, and one of them twice


def test_each_dataset_is_validated_on_all_of_its_own_windows(finished, monkeypatch):
    """The walks of the two are the same, and so are their figures, unless one of them moves."""
    row = rows_of(finished)[-1]
    assert row["val_loss/tlio"] == row["val_loss/other"]
    config = tiny("unused", data=DataConfig(rate=50.0))
    real = data.load_each

    def moved(name, *given):
        for each in real(name, *given):
            yield each._replace(position=each.position * (3.0 if name == "other" else 1.0))

    monkeypatch.setattr(data, "load_each", moved)
    training, recordings = task.set_up(WindowTask, config, loop.Lines())
    state = training.initial_state(jax.random.key(0), checkpoint.load_run(finished).variables)
    _, row = training.validate(state, recordings.held_out, jax.random.key(0))
    for name, factor in (("tlio", 1.0), ("other", 3.0)):
        (walk,) = data.load("tlio", split="val")
        walk = data.resample(walk._replace(position=factor * walk.position), 50.0)
        source = windows.window_source([walk], config.data, config.data.stride)
        every = windows.gather(jax.device_put(source), jax.numpy.arange(len(source.start)), 50)
        said = training.model.apply(state.variables, every.imu).displacement
        error = np.asarray(said, float) - np.asarray(every.displacement)
        mse = np.mean(np.sum(error**2, axis=1))
        assert row[f"val_mse/{name}"] == pytest.approx(mse, rel=1e-4)


def test_stopped_and_resumed_with_several_datasets_gives_the_same_bits(
    finished, tmp_path, monkeypatch
):
    real, calls = task.train_steps, []

    def stopping(*given, **options):
        calls.append(1)
        if len(calls) == 4:
            os.kill(os.getpid(), signal.SIGTERM)
        return real(*given, **options)

    monkeypatch.setattr(task, "train_steps", stopping)
    monkeypatch.setattr(loop, "DISPATCH_SECONDS", 0.001)
    assert loop.train(tiny(tmp_path / "run")).stopped_by == signal.SIGTERM
    assert loop.train(tiny(tmp_path / "run"), resume=True).stopped_by is None
    assert jax.tree.all(jax.tree.map(np.array_equal, *map(variables, (tmp_path / "run", finished))))


def test_the_line_of_an_epoch_has_the_error_of_each(finished):
    row = rows_of(finished)[-1]
    done = epochs.Finished(row, True, epochs.Position())
    (line,) = epochs.lines(done, WindowTask(Tiny(), tiny(finished), 1))
    assert f"(tlio {row['val_rmse/tlio']:.4f}, other {row['val_rmse/other']:.4f})" in line


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
    again = np.asarray(training.order(key, 1, source))
    np.testing.assert_array_equal(second, again)
    plain = WindowTask(Tiny(), TrainConfig(dataset=BOTH), 1, (10, 6)).order(key, 0, source)
    np.testing.assert_array_equal(np.sort(plain), source.visited)


def test_segments_are_visited_by_weight_too_each_in_its_share():
    walks = [data.resample(each, 50.0) for each in data.load("tlio", split="train")]
    parts = [segments.segment_source([walk], 100) for walk in walks]
    source = segments.joined(parts)
    counts = tuple(len(part.earliest) for part in parts)
    config = TrainConfig(dataset=BOTH, data=DataConfig(weights=(1.0, 2.0)))
    order = np.asarray(FilterTask(Tiny(), config, 1, counts).order(jax.random.key(0), 0, source))
    inside = (order >= source.earliest[:, None]) & (order <= source.latest[:, None])
    assert list(inside.sum(axis=1)) == [1] * counts[0] + [2] * counts[1]
    np.testing.assert_array_equal(source.position[600:], walks[1].position)


def test_constants_of_the_uncertainty_are_those_of_the_mean_over_the_datasets(monkeypatch):
    def found(mse):
        return Validation(Losses(*[jnp.float32(0)] * 3), *[jnp.full(3, mse, jnp.float32)] * 2)

    def source(mse):
        return windows.WindowSource(*[jnp.full(1, mse)] * len(windows.WindowSource._fields))

    monkeypatch.setattr(window_task, "validate", lambda _, of, *__, **___: found(of.imu[0]))
    state = TrainState(jnp.int32(7), {}, {"uncertainty": {"log_std": jnp.zeros(3)}}, ())
    training = WindowTask(Tiny(), TrainConfig(dataset=BOTH), 7)
    kept = training.calibrated(state, {"tlio": source(1.0), "other": source(3.0)})
    np.testing.assert_allclose(np.exp(2 * kept.batch_stats["uncertainty"]["log_std"]), 2.0, 1e-6)


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ("dataset: [tlio, tlio]", "field 'dataset' names none, or one of them twice"),
        ("dataset: []", "field 'dataset' names none"),
        ("dataset: [a, b]\ndata_root: here", "'data_root' is the folder of one dataset"),
        ("dataset: [a, b]\ndata: {weights: [1]}", "'data.weights' has 1 values for 2 datasets"),
        ("dataset: [a, b]\ndata: {weights: [1, 0]}", "'data.weights' must be positive"),
    ],
)
def test_datasets_that_do_not_fit_together(fields, problem):
    with pytest.raises(InputError) as refused:
        configuration.validate(configuration.parse(fields, "f.yaml"), "f.yaml")
    assert problem in str(refused.value)


def test_names_stand_behind_the_option_and_one_is_as_before():
    def parsed(*words):
        return options.read(train.train, options.Call("gnio train", words))

    assert parsed("--dataset", "tlio", "other", "--seed", "1").dataset == BOTH
    assert parsed("--dataset", "tlio").dataset == "tlio"
    assert (
        configuration.default_workdir(dataclasses.replace(tiny(""), workdir=None)).name
        == "tlio_other_tiny"
    )


def test_an_evaluation_says_of_which_dataset(finished):
    asked = EvaluateConfig(str(finished))
    with pytest.raises(InputError, match=r"has learnt from tlio, other; give --dataset, e\.g\. tl"):
        resolve(asked, tiny(finished))
    assert resolve(dataclasses.replace(asked, dataset="other"), tiny(finished)).dataset == "other"
