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


def test_null_takes_away_what_a_file_sets(tmp_path):
    path = tmp_path / "experiment.yaml"
    path.write_text("data_root: somewhere\noptim: {clip_norm: 1.0}\nmodel: {head: linear}\n")
    given = ["--data-root", "null", "--optim.clip-norm", "null", "--model.head", "null"]
    parsed = parse("--config", str(path), *given)
    assert (parsed.data_root, parsed.optim.clip_norm, parsed.model.head) == (None, None, None)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], "command: is missing; give one of track, live, train, evaluate, score"),
        (["trian"], "command: unknown 'trian'; did you mean 'train'?"),
        (["--verbose"], "command: unknown '--verbose'; give one of track, live"),
        (["train", "--optim.epoch", "3"], "--optim.epoch: unknown option; did you mean '--optim."),
        (["train", "--epochs", "3"], "--epochs: unknown option; did you mean '--optim.epochs'?"),
        (["train", "--qqqq=3"], "--qqqq: unknown option; --help lists the known ones"),
        (["train", "--model.head", "foo"], "must be one of gated, linear or null, found 'foo'"),
        (["train", "--through-filter.learn", "noise", "gate"], "must be one of noise, measurem"),
        (["train", "--optim.epochs"], "--optim.epochs: expected one argument"),
        (["train", "--data-root", "--seed", "1"], "--data-root: expected one argument"),
        (["train", "stray"], "'stray': is not an option; options are --name VALUE"),
        (["train", "--augment.yaw", "true"], "'true': is not an option"),
        (["train", "--resume=yes"], "--resume: ignored explicit argument 'yes'"),
        (["tables", "gatse"], "TABLE: must be one of complexity, comparison"),
        (["publish", "run", "--out", "x", "--data", "y"], "--license: is missing; give --license"),
    ],
)
def test_a_mistake_is_one_line(words, expected):
    assert expected in mistake(*words)


def test_options_win_over_the_file_and_the_file_over_the_default(tmp_path):
    path = tmp_path / "experiment.yaml"
    path.write_text("dataset: tlio\noptim: {epochs: 7, batch_size: 5}\n")
    for arguments in (
        ["--config", str(path), "--optim.epochs", "3"],
        ["--optim.epochs", "3", f"--config={path}"],
    ):
        parsed = parse(*arguments)
        assert (parsed.dataset, parsed.optim.epochs, parsed.optim.batch_size) == ("tlio", 3, 5)
        assert parsed.data == config.DataConfig()


def test_settings_by_name_win_over_all(tmp_path):
    path = tmp_path / "experiment.yaml"
    path.write_text("optim: {epochs: 7}\n")
    given = ["--config", str(path), "--optim.epochs", "3", "--set", "optim.epochs=2"]
    parsed = parse(*given, "--set", "filter.noise.gyro_density=1e-3")
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
    assert set(config.names()) >= {"gnio_tlio", "gnio_oxiod", "gnio_oxiod_small", "quickstart"}
