"""RIDI against scikit-learn's own predictions, and its run."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from gnio_jax import config as configuration
from gnio_jax import data
from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.models import ridi
from gnio_jax.networks.folder import WEIGHTS, training_recordings
from gnio_jax.reporting import Lines
from gnio_jax.training import loop, run_folder, support_vectors
from gnio_jax.training.support_vectors import LabelledWindows
from tests.support.circle import circle
from tests.support.tlio_files import spoil, write_sequence, write_splits

RNG = np.random.default_rng(10)
CONFIG = TrainConfig(data=DataConfig(rate=10.0), model=ModelConfig(name="ridi"))


def windows_of(count, names=("hand", "leg", "bag")):
    """Windows whose displacement follows from the mean acceleration, in another way for each
    placement, which shows in the rate."""
    label = RNG.integers(len(names), size=count)
    windows = RNG.normal(0, 0.3, (count, 10, 6)).astype(np.float32)
    windows[..., 2] += 9.81
    windows[..., :2] += RNG.normal(0, 1, (count, 1, 2))
    windows[..., 3] += 2.0 * label[:, None]
    factor = np.array([1.0, -0.5, 2.0])[label]
    displacement = windows[..., :2].mean(1) * factor[:, None]
    return LabelledWindows(windows, displacement, [names[k] for k in label])


def test_features_are_the_smoothed_samples_without_gravity():
    windows = RNG.standard_normal((2, 30, 6)).astype(np.float32)
    expected = windows.astype(float)
    expected[..., 2] -= 9.81
    expected = gaussian_filter1d(expected, 2.0, axis=1, mode="nearest", truncate=4.0)
    features = ridi.features(jnp.asarray(windows))
    np.testing.assert_allclose(features, expected.reshape(2, -1), atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_predictions_are_those_of_scikit_learn(count):
    svm = pytest.importorskip("sklearn.svm")
    data, held_out = (windows_of(90, ("hand", "leg", "bag")[:count]) for _ in range(2))
    network = support_vectors.fit(data, held_out, CONFIG)
    prediction = jax.jit(network.model.apply)(network.variables, jnp.asarray(held_out.windows))
    smooth = jax.jit(ridi.features)  # to the bit, because the fits stop at a tolerance
    x, other = (np.asarray(smooth(jnp.asarray(d.windows)), float) for d in (data, held_out))
    names, gamma = sorted(set(data.placement)), 1 / 60
    labels = np.array([names.index(name) for name in data.placement])
    classes = np.zeros(90, int)
    if count > 1:
        classes = svm.SVC(C=10.0, gamma=gamma).fit(x, labels).predict(other)
    np.testing.assert_array_equal(np.argmax(prediction.diagnostics["placement"], axis=1), classes)
    expected, grid = np.zeros((90, 3)), [(c, e) for c in (1.0, 10.0) for e in (0.001, 0.01)]
    for k in range(count):
        rows = labels == k
        for axis, y in enumerate(data.displacement[rows].T):
            machines = [svm.SVR(C=c, epsilon=e, gamma=gamma) for c, e in grid]
            scores = [score(machine, x[rows], y) for machine in machines]
            machine = machines[int(np.argmax(scores))].fit(x[rows], y)
            expected[classes == k, axis] = machine.predict(other)[classes == k]
    np.testing.assert_allclose(prediction.displacement, expected, atol=1e-4)
    rms = np.sqrt(np.mean((held_out.displacement - expected[:, :2]) ** 2, axis=0))
    np.testing.assert_allclose(np.exp(prediction.log_std[0, :2]), rms, rtol=1e-3)
    assert rms.max() < 0.3 * held_out.displacement.std()  # it has learnt


def test_a_machine_learns_from_a_share_of_many_windows_drawn_by_the_seed(monkeypatch):
    """A rare placement keeps all of its windows among those that tell the placements apart."""
    svm, counts = pytest.importorskip("sklearn.svm"), []
    fit_classes = svm.SVC.fit

    def counted(machine, x, labels):
        counts.append(np.bincount(labels).tolist())
        return fit_classes(machine, x, labels)

    monkeypatch.setattr(svm.SVC, "fit", counted)
    monkeypatch.setattr(support_vectors, "MOST_WINDOWS", 60)
    monkeypatch.setattr(support_vectors, "CHUNK", 7)
    data, mixed = windows_of(300, ("hand", "leg")), windows_of(120)
    bags = np.flatnonzero(np.array(mixed.placement) == "bag")[:12]
    rare = LabelledWindows(mixed.windows[bags], mixed.displacement[bags], ["bag"] * len(bags))
    data = LabelledWindows(
        np.concatenate([data.windows, rare.windows]),
        np.concatenate([data.displacement, rare.displacement]),
        data.placement + rare.placement,
    )
    configs = [dataclasses.replace(CONFIG, seed=seed) for seed in (0, 0, 1)]
    first, again, other = (support_vectors.fit(data, rare, config) for config in configs)
    assert first.model.supports <= 60 and counts == 3 * [[12, 20, 20]]  # bag, hand, leg
    weights = [np.asarray(n.variables["params"]["weight"]) for n in (first, again, other)]
    np.testing.assert_array_equal(weights[0], weights[1])
    assert weights[0].shape != weights[2].shape or np.any(weights[0] != weights[2])
    prediction = first.model.apply(first.variables, jnp.asarray(rare.windows))
    assert np.argmax(prediction.diagnostics["placement"], axis=1).tolist() == [0] * len(bags)


def test_rows_are_drawn_once_each_and_keep_their_order():
    rows = np.arange(5, 105)
    drawn = support_vectors.draw_rows(np.random.default_rng(0), rows, 60)
    assert len(drawn) == 60 and (np.diff(drawn) > 0).all() and set(drawn) <= set(rows)
    for most in (100, 101):
        whole = support_vectors.draw_rows(np.random.default_rng(0), rows, most)
        np.testing.assert_array_equal(whole, rows)


@pytest.mark.parametrize(
    "options, fitted, refused",
    [
        ({}, {"placements": 9, "supports": 40}, False),
        ({"placements": 2}, {"placements": 9}, True),
        ({}, {"output_dim": 9}, True),
    ],
)
def test_options_that_the_training_sets_are_no_other_settings(options, fitted, refused, tmp_path):
    """Unless the configuration gives them another value."""
    run = dataclasses.replace(CONFIG, model=ModelConfig("ridi", options=fitted))
    configuration.save(tmp_path / "config.yaml", run)
    config = dataclasses.replace(
        CONFIG, model=ModelConfig("ridi", options=options), workdir=str(tmp_path)
    )
    if not refused:
        assert run_folder.refuse_other_run(config, resume=True) == tmp_path
        return
    with pytest.raises(InputError, match="resume with the same settings"):
        run_folder.refuse_other_run(config, resume=True)


def score(machine, x, y):
    """Mean R² of three folds in their order, by which a regressor is chosen."""
    scores = []
    for part in np.array_split(np.arange(len(x)), 3):
        others = np.setdiff1d(np.arange(len(x)), part)
        error = y[part] - machine.fit(x[others], y[others]).predict(x[part])
        scores.append(1 - np.sum(error**2) / np.sum((y[part] - y[part].mean()) ** 2))
    return np.mean(scores)


def test_a_recording_without_a_window_is_no_error_beside_others():
    short, walk = (circle(seconds=seconds, rate=10.0)._replace(name="a") for seconds in (0.8, 5.0))
    windows, displacement, placement = support_vectors.labelled_windows([short, walk], CONFIG)
    alone = support_vectors.labelled_windows([walk], CONFIG)
    np.testing.assert_array_equal(windows, alone.windows)
    assert len(windows) == len(displacement) == len(placement) == 40
    with pytest.raises(InputError, match="no window of 1 s with a valid reference in any"):
        support_vectors.labelled_windows([short], CONFIG)


def test_a_run_names_its_recordings_and_what_is_left_out_of_them(tmp_path, capsys):
    """So an evaluation on what it was trained on is seen."""
    pytest.importorskip("sklearn")
    root = write_splits(tmp_path / "tlio")
    for split, names in (("train", ["a", "b", "c"]), ("val", ["c", "d"])):
        (root / f"{split}_list.txt").write_text("\n".join(names))
    write_sequence(root / "d", spoil=spoil("pos_World_Device", 5, np.nan))
    config = dataclasses.replace(
        CONFIG, dataset="tlio", data_root=str(root), workdir=str(tmp_path / "run")
    )
    with pytest.warns(data.DamagedRecording, match="d: left out"):
        support_vectors.train(config, tmp_path / "run", Lines())
    learnt = training_recordings(tmp_path / "run", config, "tlio")
    assert learnt == {"a", "b", "c"}
    text = capsys.readouterr().err
    assert "LEFT OUT of val: d: " in text and "warning: c in train and in val" in text
    assert "train: 3 sequences" in text and " windows" in text


def test_a_finished_run_that_is_resumed_stays_as_it_is(tmp_path, capsys, monkeypatch):
    """Nothing is read or fitted again. A run without its weights is fitted."""
    pytest.importorskip("sklearn")
    root, workdir = write_splits(tmp_path / "tlio"), tmp_path / "run"
    config = dataclasses.replace(CONFIG, dataset="tlio", data_root=str(root), workdir=str(workdir))
    first = loop.train(config)
    files = {path: path.read_bytes() for path in workdir.rglob("*") if path.is_file()}
    capsys.readouterr()

    with monkeypatch.context() as patch:
        patch.setattr(support_vectors, "fit", lambda *_: pytest.fail("fitted again"))
        again = loop.train(config, resume=True)
    assert again.best_loss == pytest.approx(first.best_loss, rel=1e-6) and first.best_loss > 0
    assert again.workdir == workdir and again.stopped_by is None
    assert capsys.readouterr().err == (
        f"{workdir}: is finished; the support vectors stay as they are\n"
    )
    assert files == {path: path.read_bytes() for path in workdir.rglob("*") if path.is_file()}

    (workdir / WEIGHTS).unlink()
    assert loop.train(config, resume=True).best_loss == pytest.approx(first.best_loss, rel=1e-6)
    assert (workdir / WEIGHTS).exists()


def test_a_placement_with_too_few_windows_is_refused():
    pytest.importorskip("sklearn")
    data = windows_of(5, ("hand",))
    with pytest.raises(InputError, match="'hand' has 5 windows, 9 are needed"):
        support_vectors.fit(data, data, dataclasses.replace(CONFIG))
