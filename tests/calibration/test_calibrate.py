"""A calibrated run: what is written, what is refused, and what evaluation makes of it."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import calibration, data
from gnio_jax.calibration import evidence
from gnio_jax.calibration import run as calibrating
from gnio_jax.calibration.fit import std_factors
from gnio_jax.commands import app
from gnio_jax.config import CalibrateConfig, DataConfig, ModelConfig, TrainConfig, plain
from gnio_jax.data.simulated import walks as simulated
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Displacements, Estimate, Trajectory
from gnio_jax.training import checkpoint
from tests.support import tiny_run
from tests.support.filter_settings import changed

TRAINED = TrainConfig(
    data=DataConfig(rate=50.0),
    model=ModelConfig(name="tiny", width=4),
    filter=changed(start={"velocity": 0.7}),
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    with tiny_run.known():
        yield tiny_run.save(tmp_path_factory.mktemp("trained") / "run", TRAINED)


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    """What the search finds is told elsewhere; here it only has to have run."""
    monkeypatch.setattr(calibrating, "MOST_STEPS", 2)


@pytest.fixture
def two_walks(monkeypatch):
    """Every split has two short walks; the splits that were read."""
    walks = [simulated.pedestrian(seed, seed, "handheld", 14.0, 50.0) for seed in (1, 2)]
    read = []
    monkeypatch.setattr(data, "load", lambda name, root, split, *_: read.append(split) or walks)
    return read


def test_the_run_differs_in_the_filter_and_its_average_alone(run, two_walks, tmp_path, capsys):
    out = tmp_path / "calibrated"
    words = ["calibrate", "--workdir", str(run), "--out", str(out), "--average-headings"]
    app.main([*words, "--fit", "measurement", "window"])
    told = capsys.readouterr().out
    assert "noise.std_factor" in told and f"gnio evaluate --workdir {out}" in told
    assert two_walks == ["val"]
    before, after = (checkpoint.load_run(folder) for folder in (run, out))
    assert after.config.model.equivariance == "four_headings"
    same = {name: getattr(before.config, name) for name in ("workdir", "filter", "model")}
    assert dataclasses.replace(after.config, **same) == before.config
    jax.tree.map(np.testing.assert_array_equal, after.variables, before.variables)
    found = after.config.filter
    assert found.start == TRAINED.filter.start
    assert found.noise.gyro_density == TRAINED.filter.noise.gyro_density
    assert found.noise.correlation.share > 0 and found.noise.std_factor[0] != 1
    about = json.loads((out / "calibration.json").read_text())
    likelihood = about["negative_log_likelihood_per_innovation"]
    assert likelihood["after"] < likelihood["before"]
    assert found.considered.gyro_bias > 0
    nees = about["position_nees_per_axis"]
    assert abs(np.log(nees["after"])) < abs(np.log(nees["before"]))
    assert about["split"] == "val" and about["filter"] == plain(found)


def test_the_network_is_averaged_over_four_headings(run):
    asked = CalibrateConfig(str(run), average_headings=True)
    plain = evidence.load_run(run, CalibrateConfig(str(run)))
    averaged = evidence.load_run(run, asked)
    assert averaged.config.model.equivariance == "four_headings"
    jax.tree.map(np.testing.assert_array_equal, averaged.variables, plain.variables)
    windows = np.random.default_rng(0).normal(size=(1, 50, 6)).astype(np.float32)
    predict, answers = jax.jit(plain.model.apply), []
    for quarter in range(4):
        turn = np.float32(Rotation.from_euler("z", 90 * quarter, degrees=True).as_matrix())
        turned = (windows.reshape(1, 50, 2, 3) @ turn.T).reshape(1, 50, 6)
        answers.append(predict(plain.variables, jnp.asarray(turned)).displacement @ turn)
    np.testing.assert_allclose(
        jax.jit(averaged.model.apply)(averaged.variables, jnp.asarray(windows)).displacement,
        np.mean(answers, axis=0),
        rtol=1e-4,
        atol=1e-6,
    )


@pytest.mark.parametrize(
    ("model", "augment", "problem"),
    [
        ({"equivariance": "canonical_frame"}, {}, "has a canonical frame"),
        ({}, {"yaw": False}, "four_headings without augment.yaw"),
    ],
)
def test_a_network_that_cannot_be_averaged(run, model, augment, problem):
    loaded = checkpoint.load_run(run)
    config = dataclasses.replace(
        loaded.config,
        model=dataclasses.replace(loaded.config.model, **model),
        augment=dataclasses.replace(loaded.config.augment, **augment),
    )
    with pytest.raises(InputError, match=f"the run.*{problem}"):
        checkpoint.averaged_over_headings(loaded._replace(config=config), "the run")


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"split": "test"}, "neither the validation nor the training split"),
        ({"out": "."}, "is there already"),
        ({"fit": ()}, "--fit: names nothing; name some of measurement, noise"),
    ],
)
def test_what_is_refused(run, two_walks, options, problem):
    with pytest.raises(InputError, match=problem):
        calibration.calibrate(CalibrateConfig(workdir=str(run), **options))
    assert two_walks == []


def test_a_calibrated_run_is_not_calibrated_again(run, two_walks, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / "calibration.json").write_text("{}")
    with pytest.raises(InputError, match="is a calibrated run; calibrate the run that it was"):
        calibration.calibrate(CalibrateConfig(workdir=str(tmp_path / "run")))


@pytest.mark.parametrize(("asked", "split"), [(None, "val"), ("val", "val"), ("train", "train")])
def test_the_split_is_that_of_validation_or_of_training(run, asked, split):
    loaded = checkpoint.load_run(run)
    found, ((source, fold),) = evidence.sources(loaded, CalibrateConfig(str(run), split=asked))
    assert found == split and source is loaded and fold is None


def estimate(error, std):
    rows = len(error) + 2
    path = Trajectory(np.arange(rows), np.zeros((rows, 3)), np.zeros((rows, 4)))
    before = np.full((2, 3), np.nan)
    found = (np.concatenate([before, each]) for each in (1.0 + error, std))
    return Estimate("walk", path, path, Displacements(*found))


def test_the_factors_are_those_of_the_errors():
    rng = np.random.default_rng(0)
    std = rng.uniform(0.05, 0.2, (400, 3))
    error = std * np.array([1.5, 0.5, 3.0]) * rng.choice([-1.0, 1.0], (400, 3))
    truth = np.ones((400, 3))
    truth[:50, 1] = np.nan
    found = std_factors([estimate(error, std)], [truth])
    np.testing.assert_allclose(found, [1.5, 0.5, 3.0], rtol=1e-12)
    with pytest.raises(ValueError, match="10 windows have a reference"):
        truth[:390] = np.nan
        std_factors([estimate(error, std)], [truth])


@pytest.fixture(scope="module")
def fold_runs(run, tmp_path_factory):
    """Copies of the run as the folds of one experiment, whose networks differ by a factor."""
    folders, loaded, parent = [], checkpoint.load_run(run), tmp_path_factory.mktemp("folds")
    for fold in (0, 1):
        windows = dataclasses.replace(loaded.config.data, train_split=f"train-{fold}of2")
        folders.append(
            tiny_run.save(
                parent / f"fold{fold}",
                dataclasses.replace(loaded.config, data=windows, workdir=None),
                size=0.2 + fold,
            )
        )
    return [str(folder) for folder in folders]


def test_each_session_is_judged_by_the_network_that_left_it_out(run, two_walks, fold_runs):
    loaded = checkpoint.load_run(run)
    config = CalibrateConfig(workdir=str(run), out_of_fold=tuple(fold_runs))
    split, asked = evidence.sources(loaded, config)
    found = evidence.gather(split, asked, config, loaded.config.filter, lambda *_: None, 1)
    assert two_walks == ["train"] and len(found.estimates) == 2
    walks = data.load("synthetic", None, "train")
    fold_of = data.folds(walks, 2)
    assert sorted(fold_of.values()) == [0, 1]
    for recording, estimate in zip(*found, strict=True):
        fold = fold_of[recording.group]
        alone = evidence.Source(asked[fold].run, None)
        both = evidence.gather("train", [alone], config, loaded.config.filter, lambda *_: None, 1)
        expected = {p.name: e for p, e in zip(*both, strict=True)}[recording.name]
        # To rounding: batches of other sizes are other programs. The networks differ by far more.
        own, wanted = estimate.displacements.value, expected.displacements.value
        np.testing.assert_allclose(own, wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("folders", "split", "problem"),
    [
        (
            [0],
            None,
            "--out-of-fold: were trained on the splits train-0of2; train one run for each of",
        ),
        ([0, 0], None, "were trained on the splits train-0of2, train-0of2"),
        ([0, 1], "train", "--split train: is of no use with --out-of-fold"),
    ],
)
def test_folds_that_do_not_make_a_whole_are_refused(
    run, two_walks, fold_runs, folders, split, problem
):
    chosen = tuple(fold_runs[fold] for fold in folders)
    with pytest.raises(InputError, match=problem):
        calibration.calibrate(CalibrateConfig(workdir=str(run), out_of_fold=chosen, split=split))
    assert two_walks == []


def test_folds_of_another_experiment_are_refused(run, two_walks, fold_runs):
    config = CalibrateConfig(workdir=str(run), out_of_fold=tuple(fold_runs))
    loaded = checkpoint.load_run(run)
    other = dataclasses.replace(loaded.config.model, width=5)
    changed = loaded._replace(config=dataclasses.replace(loaded.config, model=other))
    with pytest.raises(InputError, match="fold0: differs from the calibrated run in 'model'"):
        evidence.sources(changed, config)
