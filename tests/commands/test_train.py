"""`gnio train`: one line on stderr and status 2 for every mistake, nothing left behind."""

import dataclasses
import shutil
import sys
from pathlib import Path

import pytest

import train
from gnio_jax import config as configuration
from gnio_jax.commands import console
from gnio_jax.commands.options import Call, read
from gnio_jax.commands.train import experiment
from gnio_jax.commands.train import train as command
from gnio_jax.config import DataConfig, FilterSettings, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.config.schema import Location
from gnio_jax.training import optimizer
from tests.support import tiny_run, tlio_files
from tests.support.filter_settings import changed

ROOT = Path(__file__).parents[2]


def mistake(monkeypatch, capsys, tmp_path, *arguments):
    """The one line that the command answers with."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GNIO_DATA", raising=False)
    monkeypatch.setattr(sys, "argv", ["train.py", *arguments])
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as end:
        console.run(train.main)
    assert end.value.code == 2
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if not line.startswith("reading ")]
    assert out == "" and len(lines) == 1, (out, err)
    assert sorted(tmp_path.rglob("*")) == before
    return lines[0]


@pytest.mark.parametrize(
    "arguments, expected",
    [
        (["--dataset", "tlio"], "github.com/CathIAS/TLIO"),
        (["--dataset", "oxoid"], "did you mean 'oxiod'? known datasets: blackbird, comma2k19"),
        (["--devices", "0"], "--devices: must be at least 1"),
        (["--model.name", "ctin", "--model.width", "90"], "model 'ctin': width must be even and a"),
        (["--data.stride-seconds", "0.3"], "field 'data.stride_seconds' must divide the window"),
        (["--data.context-seconds", "1", "--model.name", "ctin"], "is not for ctin"),
        (["--workdir", __file__], "test_train.py: is a file; name a folder with --workdir"),
        (
            ["--dataset", "tlio", "--set", "filter.measurements.foo.std=1"],
            "config: field 'filter.measurements.foo' is not known",
        ),
        (
            ["--dataset", "tlio", "--set", "filter.measurements.zero_velocity.sdt=1"],
            "config: field 'filter.measurements.zero_velocity.sdt' is unknown; known numbers: std",
        ),
        (["--resume", "--workdir", "none"], "none: holds no run to resume"),
        (
            ["--config", "vehicles", "--dataset", "kitti", "--set", "through_filter.learn=[]"],
            "through_filter.learn: is empty, and 'ai_imu' is trained in the filter's loop alone",
        ),
    ],
)
def test_mistakes(monkeypatch, capsys, tmp_path, arguments, expected):
    assert expected in mistake(monkeypatch, capsys, tmp_path, *arguments)


@pytest.mark.parametrize(
    "setting, purpose",
    [
        ("augment.walkway_share=0.9", "is for training on segments"),
        ("augment.walkway=[0.5,0.6]", "is for training on segments"),
        ("augment.time_stretch=[0.5,0.6]", "is for training on segments"),
        ("augment.alternating_gain=[2,3]", "is for training on segments"),
        ("segments.truncate_seconds=1", "is for training on segments"),
        ("segments.horizon_weight=3", "is for training on segments"),
        ("through_filter.piece_seconds=30", "is for training through the filter"),
        ("through_filter.start_spread=0", "is for training through the filter"),
        ("loss.angle_weight=5", "is for loss.name: polar"),
    ],
)
def test_a_setting_without_effect_is_refused(monkeypatch, capsys, tmp_path, setting, purpose):
    name = setting.partition("=")[0]
    line = mistake(monkeypatch, capsys, tmp_path, "--dataset", "tlio", "--set", setting)
    assert line.startswith(f"config: field '{name}' {purpose}") and "leave it out, or set" in line


def test_shifted_samples_are_for_windows(monkeypatch, capsys, tmp_path):
    words = ["--model.name", "gru", "--segments.seconds", "4", "--augment.shift-samples", "3"]
    line = mistake(monkeypatch, capsys, tmp_path, "--dataset", "tlio", *words)
    assert "field 'augment.shift_samples' is for training on windows" in line


def test_a_damaged_recording_is_left_out_loudly_or_ends_a_strict_run(
    tmp_path, tmp_path_factory, monkeypatch, capsys
):
    root = tlio_files.write_splits(tmp_path_factory.mktemp("data"))
    table = root / "b" / "imu0_resampled.npy"
    table.write_bytes(table.read_bytes()[:2000])
    words = ["--dataset", "tlio", "--data-root", str(root), "--data.rate", "50", "--strict"]
    line = mistake(monkeypatch, capsys, tmp_path, *words)
    assert line.startswith(f"{table}: ") and "warning" not in line
    monkeypatch.setattr(sys, "argv", ["train.py", *words[:-1], "--optim.batch-size", "1000"])
    with pytest.raises(SystemExit, match="2"):  # by the batch, behind the recordings
        console.run(train.main)
    lines = capsys.readouterr().err.splitlines()
    assert f"  warning: LEFT OUT of train: b: {line}" in lines
    assert any(text.startswith("  train: 1 sequences") for text in lines)
    assert any(text.startswith("warning: b: left out: ") for text in lines)


def test_every_config_of_the_repository_is_valid_and_names_its_command():
    files = {file.stem: file for file in (ROOT / "configs").glob("*.yaml")}
    assert {"quickstart", "gnio_tlio", "gnio_oxiod", "gnio_oxiod_small"} <= files.keys()
    budgets = {file.stem: file for file in (ROOT / "configs" / "tables").glob("*.yaml")}
    networks = {"networks_oxiod", "networks_synthetic", "networks_walks"}
    assert budgets.keys() == networks | {
        *("oxiod_lists", "oxiod_sessions", "synthetic", "tlio_layout"),
    }
    commands = {name: f"gnio train --config {name} " for name in files}
    commands |= {name: f"gnio tables comparison --base tables/{name}" for name in budgets}
    commands["drive"] = "gnio track drive.zip --carrier car"
    for name, file in (files | budgets).items():
        config = configuration.validate(configuration.load(file), str(file))
        config.refuse_unused(Location(str(file)))
        assert configuration.parse(configuration.to_yaml(config), "its own text") == config
        assert commands[name] in file.read_text()
        model, optim = config.model, config.optim
        same_budget = (model.name, model.width, optim.batch_size) == ("gnio", 16, 128)
        assert same_budget or name not in budgets


@pytest.mark.parametrize("name", ["gnio_tlio", "gnio_oxiod"])
def test_the_papers_configs_are_the_papers(name):
    config, defaults = configuration.load(ROOT / "configs" / f"{name}.yaml"), TrainConfig()
    assert (config.model, config.loss) == (defaults.model, defaults.loss)
    optim = OptimConfig(
        epochs=200, batch_size=1024, start_learning_rate=1e-6, learning_rate=1e-4, warmup_epochs=5.0
    )
    assert config.optim == defaults.optim == optim and optimizer.END_LEARNING_RATE == 1e-6
    assert (config.loss.mse_weight, config.loss.nll_weight) == (1e2, 1e-4)
    assert config.data.stride * 10 == config.data.window == config.data.rate


def experiment_of(*words):
    """The experiment that these words come to."""
    call = Call("gnio train", words)
    return experiment(read(command, call), call)


def test_training_through_the_filter_begins_with_the_filter_of_the_run(tmp_path):
    calibrated = changed(noise={"gyro_density": 0.02}, start={"velocity": 0.7, "accel_bias": 0.3})
    considered = changed(calibrated, considered={"scale": 0.1})
    tiny = TrainConfig(data=DataConfig(rate=50.0), model=ModelConfig(name="tiny"))
    with tiny_run.registry_entry():
        run = tiny_run.save(tmp_path / "run", dataclasses.replace(tiny, filter=considered))
        file = tmp_path / "own.yaml"
        file.write_text("through_filter: {learn: [noise]}\nfilter: {start: {velocity: 1.0}}\n")
        workdir = tmp_path / "new"
        options = ["--config", str(file), "--init-from", str(run), "--workdir", str(workdir)]
        # What the file says wins, also where it is the default of the package.
        settings = changed(calibrated, start={"velocity": 1.0})
        assert experiment_of(*options).filter == settings
        louder = experiment_of(*options, "--set", "filter.noise.gyro_density=0.5").filter
        assert louder == changed(settings, noise={"gyro_density": 0.5})
        bare = experiment_of("--init-from", str(run), "--through-filter.learn", "noise")
        assert bare.filter == calibrated
        by_name = experiment_of("--init-from", str(run), "--set", "through_filter.learn=[noise]")
        assert by_name.filter == calibrated
        # Training on windows has no use for it.
        assert experiment_of("--init-from", str(run)).filter == FilterSettings()
    # A run that is resumed goes on with its own, whether --config is given again or not.
    configuration.save(workdir / "config.yaml", TrainConfig(filter=settings))
    shutil.rmtree(run)
    assert experiment_of(*options, "--resume").filter == settings
    assert experiment_of(*options[2:], "--resume").filter == settings
    # Also where the file says that the run is, and for seeds in folders beside it.
    file.write_text(f"workdir: {workdir}\noptim: {{epochs: 3}}\n")
    config = experiment_of("--config", str(file), "--resume")
    assert (config.workdir, config.filter, config.optim.epochs) == (str(workdir), settings, 3)
    assert experiment_of("--config", str(file), "--seeds", "1", "2").workdir == str(workdir)
    by_name = experiment_of("--set", f"workdir={workdir}", "--resume")
    assert (by_name.workdir, by_name.filter) == (str(workdir), settings)
