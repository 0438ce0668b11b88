"""Options out of the words of a command line: what is taken, and each mistake in one line."""

import pytest

from gnio_jax import config
from gnio_jax.commands import train
from gnio_jax.commands.options import Call, read
from gnio_jax.config import TrainConfig
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


def test_nothing_given_is_the_default():
    assert parse() == TrainConfig()


@pytest.mark.parametrize(
    "arguments",
    [["--optim.batch-size", "3"], ["--optim.batch_size", "3"], ["--optim.batch-size=3"]],
)
def test_spellings_of_a_nested_option(arguments):
    assert parse(*arguments).optim.batch_size == 3


def test_flags_and_optional_values():
    parsed = parse("--augment.no-yaw", "--optim.clip-norm", "1", "--data-root", "null")
    assert (parsed.augment.yaw, parsed.optim.clip_norm, parsed.data_root) == (False, 1.0, None)


def test_null_takes_away_what_a_file_sets(tmp_path):
    path = tmp_path / "experiment.yaml"
    path.write_text("data_root: somewhere\noptim: {clip_norm: 1.0}\nmodel: {head: linear}\n")
    given = ["--data-root", "null", "--optim.clip-norm", "null", "--model.head", "null"]
    parsed = parse("--config", str(path), *given)
    assert (parsed.data_root, parsed.optim.clip_norm, parsed.model.head) == (None, None, None)


def test_a_list_of_words():
    given = ["--through-filter.learn", "noise", "head", "--through-filter.piece-seconds", "30"]
    parsed = parse(*given).through_filter
    assert parsed.learn == ("noise", "head") and parsed.piece_seconds == 30
    told = mistake("train", "--through-filter.learn", "noise", "gate")
    assert told.startswith("--through-filter.learn: must be one of noise, measurement, ")
    assert "found 'gate'" in told


def test_numbers_are_those_of_yaml():
    assert parse("--seed", "3", "--optim.learning-rate", "1e-3").optim.learning_rate == 1e-3
    assert parse("--loss.log-std-floor", "-6.9").loss.log_std_floor == -6.9
    assert "must be a whole number" in mistake("train", "--seed", "0x10")
    assert "must be a number" in mistake("train", "--data.rate", "inf")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], "command: is missing; give one of track, live, train, evaluate, calibrate"),
        (["trian"], "command: unknown 'trian'; did you mean 'train'?"),
        (["--verbose"], "command: unknown '--verbose'; give one of track, live"),
        (["data"], "command: is missing; give one of list, check, convert, import"),
        (["data", "chek"], "command: unknown 'chek'; did you mean 'check'?"),
        (
            ["train", "--optim.epoch", "3"],
            "--optim.epoch: unknown option; did you mean '--optim.epochs'?",
        ),
        (["train", "--epochs", "3"], "--epochs: unknown option; did you mean '--optim.epochs'?"),
        (["train", "--qqqq=3"], "--qqqq: unknown option; --help lists the known ones"),
        (["train", "-x"], "-x: unknown option"),
        (["train", "--optim.batch_size=3.5"], "--optim.batch-size: must be a whole number, found"),
        (
            ["train", "--optim.clip-norm", "a"],
            "--optim.clip-norm: must be a number or null, found 'a'",
        ),
        (
            ["train", "--model.head", "foo"],
            "--model.head: must be one of gated, linear or null, found 'foo'",
        ),
        (["train", "--optim.epochs"], "--optim.epochs: expected one argument"),
        (["train", "--data-root", "--seed", "1"], "--data-root: expected one argument"),
        (["train", "--config"], "--config: expected one argument"),
        (["train", "stray"], "'stray': is not an option; options are --name VALUE"),
        (["train", "--augment.yaw", "true"], "'true': is not an option"),
        (["train", "--resume=yes"], "--resume: ignored explicit argument 'yes'"),
        (
            ["data", "check", "tlio", "--splt", "a"],
            "--splt: unknown option; did you mean '--split'?",
        ),
        (["evaluate", "--set", "workdir=B"], "--set workdir=B: is no setting of the filter; write"),
        (["tables", "gatse"], "TABLE: must be one of complexity, comparison"),
        (["compare"], "RUNS: is missing; give it as a word"),
        (["interop", "a", "b", "c"], "'c': is not an option"),
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
    assert "did you mean 'filter.noise.gyro_density'?" in mistake(
        "train", "--set", "filter.noise.gyro_densty=1e-3"
    )
    assert "gyro_density" in mistake("train", "--set", "filter.noise.gyro_density=fast")
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
