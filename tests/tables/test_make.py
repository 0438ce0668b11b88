"""A table made from nothing to its pictures, then again without training."""

import csv
import dataclasses
import json
import sys

import numpy as np
import pytest
import yaml

from gnio_jax import calibration, models
from gnio_jax import config as configuration
from gnio_jax.calibration import run as calibration_run
from gnio_jax.config import (
    CalibrateConfig,
    DataConfig,
    ModelConfig,
    OptimConfig,
    TablesConfig,
    TrainConfig,
)
from gnio_jax.errors import InputError
from gnio_jax.evaluation import reuse
from gnio_jax.tables import activities, experiments, make
from gnio_jax.training import loop
from tests.support import small_tables
from tests.support.command_lines import run as gnio
from tests.support.tlio_files import write_sequence


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A folder with recordings, a base config and the arguments that all tables share."""
    root = tmp_path_factory.mktemp("tables")
    for name in "abc":
        write_sequence(root / "data" / name)
    for split, names in [("train", "a\nb\n"), ("val", "b\nc\n"), ("test", "b\nc\n")]:
        (root / "data" / f"{split}_list.txt").write_text(names)
    base = TrainConfig(
        dataset="tlio",
        data=DataConfig(rate=50.0),
        model=ModelConfig(width=2, bank_size=3),
        optim=OptimConfig(epochs=2, batch_size=16, learning_rate=1e-3),
    )
    configuration.save(root / "base.yaml", base)
    folders = ["--base", root / "base.yaml", "--data-root", root / "data", "--out", root / "out"]
    choices = ["--seeds", 2, "--methods", "gnio", "--split", "test", "--estimator", "integrate"]
    yield root, [str(argument) for argument in [*folders, *choices]]


@pytest.mark.slow
def test_a_table_from_nothing_and_again_without_training(workspace, monkeypatch, capsys):
    root, arguments = workspace
    gnio("tables", "comparison", *arguments)
    text = (root / "out" / "comparison_test_integrate.md").read_text(encoding="utf-8")
    assert "2 seeds" in text and "| gnio |" in text and text in capsys.readouterr().out
    with (root / "out" / "comparison_test_integrate.csv").open(encoding="utf-8") as file:
        (line,) = (row for row in csv.DictReader(file) if row["metric"] == "ate")
    path = "eval/tlio_test_integrate/metrics.json"
    texts = [(root / "out" / "runs" / f"gnio_s{seed}" / path).read_text() for seed in range(2)]
    ates = [json.loads(text)["mean"]["ate"] for text in texts]
    assert float(line["mean"]) == pytest.approx(np.mean(ates)) and ates[0] != ates[1]
    assert float(line["std"]) == pytest.approx(np.std(ates, ddof=1))
    assert (root / "out" / "comparison_test_integrate.png").read_bytes()[:4] == b"\x89PNG"

    def never(*_, **__):
        raise AssertionError("done already")

    monkeypatch.setattr(loop, "train_all", never)
    monkeypatch.setattr(reuse, "evaluate", never)
    (root / "out" / "comparison_test_integrate.md").unlink()
    gnio("tables", "comparison", *arguments)
    assert (root / "out" / "comparison_test_integrate.md").read_text(encoding="utf-8") == text
    gnio("tables", "standing", *arguments)
    text = (root / "out" / "standing_test_integrate.md").read_text(encoding="utf-8")
    assert "most attended prototype carries" in text and "| gnio | walking |" in text
    gnio("tables", "trajectories", *arguments, "--sequences", "c")
    for name in ("standing", "standing_gate", "standing_attention", "trajectories"):
        kind, _, part = name.partition("_")
        picture = f"{kind}_test_integrate{'_gnio_' * bool(part)}{part}.png"
        assert (root / "out" / picture).read_bytes()[:4] == b"\x89PNG", name
    page = (root / "out" / "trajectories_test_integrate.html").read_text(encoding="utf-8")
    assert "</span>gnio</h2>" in page
    with pytest.raises(InputError, match="no sequence 'x' in split 'test'; there are: b, c"):
        gnio("tables", "trajectories", *arguments, "--sequences", "x")
    changed = yaml.safe_load((root / "base.yaml").read_text())
    changed["optim"]["learning_rate"] = 2e-3
    (root / "other.yaml").write_text(yaml.safe_dump(changed))
    with pytest.raises(InputError, match=r"'optim\.learning_rate' was .* and is now"):
        gnio("tables", "comparison", *arguments, "--base", str(root / "other.yaml"))


@pytest.mark.slow
def test_every_run_is_calibrated_before_it_is_measured(workspace, monkeypatch, capsys):
    """As `gnio calibrate` does by default, of which one unknown and two steps are enough here."""
    calibrate = calibration.calibrate

    def quickly(config, **more):
        assert config == CalibrateConfig(config.network, config.out)
        return calibrate(dataclasses.replace(config, fit=("measurement",)), **more)

    monkeypatch.setattr(calibration, "calibrate", quickly)
    monkeypatch.setattr(calibration_run, "MOST_STEPS", 2)
    root, arguments = workspace
    arguments = [*arguments, "--seeds", "1", "--estimator", "ekf"]
    gnio("tables", "comparison", *arguments)
    gnio("tables", "comparison", *arguments, "--calibrate")
    output = capsys.readouterr()
    assert "calibrating gnio_s0" in output.err and "gnio calibrate on val;" in output.out
    figures, names = [], ("gnio_s0", "gnio_s0_calibrated")
    for ending in ("", "_calibrated"):
        text = (root / "out" / f"comparison_test_ekf{ending}.csv").read_text()
        figures.append({row["metric"]: row["mean"] for row in csv.DictReader(text.splitlines())})
    before, after = figures
    folders = [root / "out" / "runs" / name for name in names]
    trained, run = (configuration.load(folder / "config.yaml") for folder in folders)
    assert run.filter.noise.measurement_scale != 10 and run.filter.considered.gyro_bias > 0
    assert run.model == trained.model
    assert float(after["nis"]) > 0 and after["nis"] != before["nis"]
    # What the windows are measured by has the factors that calibration found.
    recordings = activities.Recordings("tlio", str(root / "data"), "test")
    raw, fitted = (activities.predict_split(folder, recordings).std for folder in folders)
    np.testing.assert_allclose(fitted, raw * run.filter.noise.std_factor, rtol=1e-6)
    assert abs(np.log(run.filter.noise.std_factor)).max() > 0.01


def test_rows_free_their_programs_and_the_note_names_what_is_not_calibrated(tmp_path, monkeypatch):
    """Linux has no memory maps for the programs of ten networks."""
    steps, shown = [], []

    def run_row(row, options, *_):
        steps.append(row.name)
        failed = row.name == "tlio"
        runs = [tmp_path / f"{row.name}_s0{'' if failed else '_calibrated'}"]
        return make.RowResult(row, [], runs, [], None)

    monkeypatch.setattr(make, "run_row", run_row)
    monkeypatch.setattr(make, "announce", lambda *_: None)
    monkeypatch.setattr(make, "make_table", lambda *parts: shown.append(parts[-1]) or "")
    monkeypatch.setattr(make.jax, "clear_caches", lambda: steps.append("free"))
    options = TablesConfig("comparison", seeds=1, methods="gnio,tlio", out=tmp_path, calibrate=True)
    make.make(options)
    assert steps == ["gnio", "free", "tlio", "free"]
    assert shown[0].endswith("Not calibrated, because the filter could not be fitted: tlio_s0.")
    make.make(dataclasses.replace(options, calibrate=False))
    assert "Not calibrated" not in shown[1]


def test_a_signal_ends_the_table_and_says_how_to_go_on(workspace, monkeypatch, capsys):
    root, arguments = workspace
    monkeypatch.setattr(loop, "train_all", lambda *_, **__: [loop.TrainingResult(root, None, 15)])
    with pytest.raises(SystemExit) as end:
        gnio("tables", "gates", *arguments, "--out", str(root / "elsewhere"))
    assert end.value.code == 128 + 15 and "continues from here" in capsys.readouterr().err


@pytest.mark.parametrize(
    "more, words",
    [
        (["--methods", "gnio,nosuch"], "no network or system 'nosuch'; known: ai_imu, airio"),
        (["--methods", "gnio,ai_imu"], "'ai_imu' predicts no displacement"),
        (["--base", "nosuch.yaml"], "no such config file"),
        (["--base", "configs/baselines/tlio.yaml"], "is of the network 'tlio'"),
    ],
)
def test_mistakes_are_named(workspace, more, words):
    with pytest.raises(InputError, match=words):
        gnio("tables", "comparison", *workspace[1], *more)


@pytest.mark.slow
def test_networks_that_learn_from_two_datasets_are_measured_on_one_that_is_named(
    workspace, tmp_path, monkeypatch
):
    """The second measurement trains nothing, and its files have another name."""
    root, arguments = workspace
    small_tables.patch(monkeypatch)
    monkeypatch.setenv("GNIO_DATA", str(tmp_path))
    (tmp_path / "tlio").symlink_to(root / "data")
    base = configuration.load(root / "base.yaml")
    configuration.save(
        tmp_path / "both.yaml", dataclasses.replace(base, dataset=("tlio", "synthetic"))
    )
    arguments = ["tables", "comparison", "--base", str(tmp_path / "both.yaml"), "--seeds", "1"]
    arguments += ["--methods", "gnio", "--out", str(tmp_path / "out"), "--estimator", "integrate"]
    with pytest.raises(InputError, match="has several datasets: tlio, synthetic; name the one to"):
        gnio(*arguments)
    with pytest.raises(InputError, match="nosuch"):
        gnio(*arguments, "--dataset", "nosuch")
    gnio(*arguments, "--dataset", "synthetic")
    trained = configuration.load(tmp_path / "out" / "runs" / "gnio_s0" / "config.yaml")
    assert trained.datasets == ("tlio", "synthetic") and trained.data_root is None
    monkeypatch.setattr(loop, "train_all", None)
    gnio(*arguments, "--dataset", "tlio")
    gnio(*arguments, "--dataset", "tlio", "--data-root", str(root / "data"))
    settings = {}
    for name in ("synthetic", "tlio", "tlio_data"):
        text = (tmp_path / "out" / f"comparison_{name}_test_integrate.md").read_text("utf-8")
        dataset = name.removesuffix("_data")
        assert f"{dataset} test, integrate; every row: tlio and synthetic, 2 epochs" in text
        folder = tmp_path / "out" / "runs" / "gnio_s0" / "eval" / f"{dataset}_test_integrate"
        settings[name] = json.loads((folder / "metrics.json").read_text())["settings"]["dataset"]
    assert settings == {"synthetic": "synthetic", "tlio": "tlio", "tlio_data": "tlio"}
    arguments[1] = "standing"
    gnio(*arguments, "--dataset", "synthetic")
    text = (tmp_path / "out" / "standing_synthetic_test_integrate.md").read_text("utf-8")
    assert "| gnio | walking |" in text


def test_a_row_that_cannot_be_trained_is_refused_before_any_other_is(workspace, monkeypatch):
    """At 50 Hz an interval of 0.1 s has 5 samples. Of scikit-learn there is none."""
    root, arguments = workspace
    monkeypatch.setattr(make, "announce", None)
    monkeypatch.setitem(sys.modules, "sklearn", None)
    out = ["--out", str(root / "refused")]
    for methods, words in (
        ("gnio,gru", r"data\.stride_seconds: is 5 samples; 'gru' takes 10"),
        ("gnio,ridi", r"network 'ridi'.*pip install"),
    ):
        with pytest.raises(InputError, match=words):
            gnio("tables", "comparison", *arguments, "--methods", methods, *out)
    assert not (root / "refused").exists()


def test_all_methods_are_the_networks_with_displacements_and_the_systems_with_sound_settings():
    names = make.networks(TablesConfig("comparison", methods="all"))
    assert sorted(names) == sorted({*models.names(), *experiments.SYSTEMS} - {"ai_imu"})
    assert names[0] == "gnio"  # the others are compared with it
    for name in names:
        configuration.validate(experiments.method(name, TrainConfig()), name)
