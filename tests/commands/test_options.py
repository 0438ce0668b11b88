"""Options out of the words of a command line: what is taken, and each mistake in one line."""

import pytest

from gnio_jax import config
from gnio_jax.commands import train
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
    given = ["--through-filter.learn", "noise", "head", "--through-filter.piece-seconds", "30"]
    parsed = parse(*given).through_filter
    assert parsed.learn == ("noise", "head") and parsed.piece_seconds == 30


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], "command: is missing; give one of track, live, train, evaluate, score"),
        (["trian"], "command: unknown 'trian'; did you mean 'train'?"),
        (["train", "--optim.epoch", "3"], "--optim.epoch: unknown option; did you mean '--optim."),
        (["train", "--model.head", "foo"], "must be one of gated, linear or null, found 'foo'"),
        (["train", "--optim.epochs"], "--optim.epochs: expected one argument"),
        (["train", "stray"], "'stray': is not an option; options are --name VALUE"),
        (["train", "--resume=yes"], "--resume: ignored explicit argument 'yes'"),
        (["publish", "run", "--out", "x", "--data", "y"], "--license: is missing; give --license"),
    ],
)
def test_a_mistake_is_one_line(words, expected):
    assert expected in mistake(*words)


def test_options_win_over_the_file_and_the_file_over_the_default(tmp_path):
    """And settings by name over all; `null` takes away what a file sets."""
    path = tmp_path / "experiment.yaml"
    path.write_text("dataset: tlio\noptim: {epochs: 7, batch_size: 5, clip_norm: 1.0}\n")
    given = ["--optim.epochs", "3", "--optim.clip-norm", "null"]
    for arguments in (["--config", str(path), *given], [*given, f"--config={path}"]):
        parsed = parse(*arguments)
        assert (parsed.dataset, parsed.optim.epochs, parsed.optim.batch_size) == ("tlio", 3, 5)
        assert parsed.data == config.DataConfig() and parsed.optim.clip_norm is None
    by_name = ["--set", "optim.epochs=2", "--set", "filter.noise.gyro_density=1e-3"]
    parsed = parse("--config", str(path), *given, *by_name)
    assert parsed.optim.epochs == 2 and parsed.filter.noise.gyro_density == 1e-3
    assert "is not a setting" in mistake("train", "--set", "filter")


def test_a_config_is_found_by_its_name_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert parse("--config", "quickstart").model.width == 16
    assert parse("--config", "baselines/tlio").model.name == "tlio"
    for wrong, hint in (("quickstrat", "quickstart"), ("configs/tlio.yaml", "baselines/tlio")):
        told = mistake("train", "--config", wrong)
        assert f"{wrong}: no such config file; did you mean '{hint}'?" in told
    (tmp_path / "quickstart").mkdir()
    assert parse("--config", "quickstart").model.width == 16
    assert set(config.experiment_names()) >= {
        "gnio_tlio",
        "gnio_oxiod",
        "gnio_oxiod_small",
        "quickstart",
    }
