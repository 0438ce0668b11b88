"""Options out of the words of a command line: what is taken, and each mistake in one line."""

import os
import subprocess
import sys
from importlib.metadata import version

import pytest

from gnio_jax import config, data, models
from gnio_jax.commands import app, names, train
from gnio_jax.commands.options import Call, read
from gnio_jax.errors import InputError
from tests.support.command_lines import run


def parse(*arguments):
    """The experiment that `gnio train` reads from these words."""
    call = Call("gnio train", arguments)
    return train.experiment(read(train.train, call), call)


def mistake(*words):
    with pytest.raises(InputError) as caught:
        run(*words)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_spellings_and_values_of_options():
    for words in ("--optim.batch-size 3", "--optim.batch_size 3", "--optim.batch-size=3"):
        assert parse(*words.split()).optim.batch_size == 3
    parsed = parse("--augment.no-yaw", "--optim.clip-norm", "1", "--data-root", "null")
    assert (parsed.augment.yaw, parsed.optim.clip_norm, parsed.data_root) == (False, 1.0, None)
    assert parse("--loss.log-std-floor", "-6.9").loss.log_std_floor == -6.9
    options = ["--through-filter.learn", "noise", "head", "--through-filter.piece-seconds", "30"]
    parsed = parse(*options).through_filter
    assert parsed.learn == ("noise", "head") and parsed.piece_seconds == 30


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["trian"], "command: unknown 'trian'; did you mean 'train'?"),
        (["train", "--optim.epoch", "3"], "--optim.epoch: unknown option; did you mean '--optim."),
        (["train", "--lr", "1e-3"], "--lr: unknown option; did you mean '--optim.learning-rate'?"),
        (["train", "--bs", "8"], "--bs: unknown option; did you mean '--optim.batch-size'?"),
        (["train", "--batch-size", "8"], "did you mean '--optim.batch-size'?"),
        (["train", "--epochs", "3"], "did you mean '--optim.epochs'?"),
        (["train", "--gpu", "1"], "did you mean '--devices'?"),
        (["track", "walk.csv", "--output", "x"], "did you mean '--out'?"),
        (["evaluate", "--weights", "x"], "did you mean '--network'?"),
        (
            ["train", "--model.head", "foo"],
            "must be one of gated, linear, bins or null, found 'foo'",
        ),
        (["train", "--optim.epochs"], "--optim.epochs: expected one argument"),
        (["train", "stray"], "'stray': is not an option; options are --name VALUE"),
        (["train", "--resume=yes"], "--resume: ignored explicit argument 'yes'"),
        (["publish", "run", "--out", "x", "--data", "y"], "--license: is missing; give --license"),
    ],
)
def test_a_mistake_is_one_line(words, expected):
    assert expected in mistake(*words)


def test_without_a_command_the_help_is_shown(capsys):
    run()
    assert "usage: gnio COMMAND" in capsys.readouterr().out
    app.main(["--version"])
    assert capsys.readouterr().out == f"gnio-jax {version('gnio-jax')}\n"


@pytest.mark.parametrize(
    ("prog", "sibling"),
    [
        ("gnio train", "gnio evaluate"),
        ("python train.py", "python evaluate.py"),
        ("python training/deeper.py train", "python training/deeper.py evaluate"),
    ],
)
def test_the_next_command_is_one_of_the_same_program(prog, sibling):
    assert Call(prog, []).sibling("evaluate") == sibling


def test_names_that_exist_are_those_of_the_registries():
    assert sorted(names.NETWORKS) == sorted(models.registry._PUBLISHED)
    assert sorted(names.DATASETS) == sorted(data.registry._PUBLISHED)


def test_a_wrong_name_does_not_wait_for_jax():
    for words, line in (
        (["train", "--dataset", "tilo"], "dataset: unknown name 'tilo'; did you mean 'tlio'?"),
        (["train", "--model.name", "gnoi"], "model: unknown name 'gnoi'; did you mean 'gnio'?"),
        (["evaluate", "--dataset", "oxoid"], "dataset: unknown name 'oxoid'; did you mean 'oxiod'"),
        (["data", "check", "oxoid"], "dataset: unknown name 'oxoid'; did you mean 'oxiod'?"),
        (["track", "no_walk.csv"], "no_walk.csv: no such file or folder"),
    ):
        program = (
            "import sys\nfrom gnio_jax.commands.app import main\ntry:\n    main(sys.argv[1:])\n"
        )
        program += "finally:\n    assert 'jax' not in sys.modules"
        line_of_command = [sys.executable, "-c", program, *words]
        environment = {name: text for name, text in os.environ.items() if name != "GNIO_PLUGINS"}
        result = subprocess.run(
            line_of_command, capture_output=True, text=True, timeout=60, env=environment
        )
        assert result.returncode == 2 and result.stderr.startswith(line), result.stderr


def test_options_win_over_the_file_and_the_file_over_the_default(tmp_path):
    """And settings by name over all; `null` takes away what a file sets."""
    path = tmp_path / "experiment.yaml"
    path.write_text("dataset: tlio\noptim: {epochs: 7, batch_size: 5, clip_norm: 1.0}\n")
    options = ["--optim.epochs", "3", "--optim.clip-norm", "null"]
    for arguments in (["--config", str(path), *options], [*options, f"--config={path}"]):
        parsed = parse(*arguments)
        assert (parsed.dataset, parsed.optim.epochs, parsed.optim.batch_size) == ("tlio", 3, 5)
        assert parsed.data == config.DataConfig() and parsed.optim.clip_norm is None
    by_name = ["--set", "optim.epochs=2", "--set", "filter.noise.gyro_density=1e-3"]
    parsed = parse("--config", str(path), *options, *by_name)
    assert parsed.optim.epochs == 2 and parsed.filter.noise.gyro_density == 1e-3
    assert "is not a setting" in mistake("train", "--set", "filter")


def test_a_config_is_found_by_its_name_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert parse("--config", "quickstart").model.width == 16
    assert parse("--config", "baselines/tlio").model.name == "tlio"
    for wrong, hint in (("quickstrat", "quickstart"), ("configs/tlio.yaml", "baselines/tlio")):
        refusal = mistake("train", "--config", wrong)
        assert f"{wrong}: no such config file; did you mean '{hint}'?" in refusal
    (tmp_path / "quickstart").mkdir()
    assert parse("--config", "quickstart").model.width == 16
    assert set(config.experiment_names()) >= {
        "gnio_tlio",
        "gnio_oxiod",
        "gnio_oxiod_small",
        "quickstart",
    }
