"""The command lines' shared handling: mistakes in one line, help that teaches, configs."""

import subprocess
import sys
import warnings

import pytest
from rich.table import Table

from gnio_jax import config
from gnio_jax.commands import app, console, options, train
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError


def parse(*arguments):
    """The experiment that `train` reads from these options."""
    found = []
    command = train.COMMAND._replace(run=lambda read, _prog: found.append(read.experiment()))
    options.execute(command, arguments, "train.py")
    return found[0]


def mistake(*arguments):
    with pytest.raises(InputError) as caught:
        parse(*arguments)
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
    parsed = parse("--augment.no-yaw", "--optim.clip-norm", "1", "--data-root", "None")
    assert (
        parsed.augment.yaw is False and parsed.optim.clip_norm == 1.0 and parsed.data_root is None
    )


def test_a_list_of_words():
    given = ["--through-filter.learn", "noise", "head", "--through-filter.piece-seconds", "30"]
    parsed = parse(*given).through_filter
    assert parsed.learn == ("noise", "head") and parsed.piece_seconds == 30
    told = mistake("--through-filter.learn", "noise", "gate")
    assert told.startswith("--through-filter.learn: must be words out of noise, measurement, ")
    assert "found 'gate'" in told


def test_negative_numbers_are_values():
    assert parse("--seed", "-1").seed == -1
    assert parse("--loss.log-std-floor", "-6.9").loss.log_std_floor == -6.9


def test_misspelt_option_names_the_closest():
    assert (
        mistake("--optim.epoch", "3")
        == "--optim.epoch: unknown option; did you mean --optim.epochs?"
    )
    assert mistake("--epochs", "3") == "--epochs: unknown option; did you mean --optim.epochs?"
    assert mistake("--qqqq=3") == "--qqqq: unknown option; --help lists the known ones"
    assert "unknown option" in mistake("-x")


def test_wrong_types_say_what_is_wanted_and_found():
    assert mistake("--optim.epochs", "abc") == "--optim.epochs: must be a whole number, found 'abc'"
    assert (
        mistake("--optim.batch_size=3.5")
        == "--optim.batch-size: must be a whole number, found '3.5'"
    )
    assert (
        mistake("--optim.clip-norm", "a")
        == "--optim.clip-norm: must be a number or None, found 'a'"
    )
    assert (
        mistake("--model.head", "foo")
        == "--model.head: must be one of gated, linear or None, found 'foo'"
    )


def test_missing_values_and_stray_words():
    assert (
        mistake("--optim.epochs") == "--optim.epochs: needs a value, which must be a whole number"
    )
    assert (
        mistake("--data-root", "--seed", "1")
        == "--data-root: needs a value, which must be text or None"
    )
    assert mistake("stray").startswith("'stray': is not an option")
    assert mistake("--augment.yaw", "True").startswith("'True': is not an option")
    assert mistake("--config") == "--config: needs a value, which must be text or None"


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


def test_file_mistakes_are_input_errors(tmp_path):
    path = tmp_path / "experiment.yaml"
    path.write_text("optim: {epoch: 7}\n")
    assert "did you mean 'optim.epochs'?" in mistake("--config", str(path))
    assert "no such config file" in mistake("--config", str(tmp_path / "missing.yaml"))


def test_help_teaches(capsys):
    with pytest.raises(SystemExit) as leaving:
        parse("--help")
    assert leaving.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "Train a network" in text and "--config FILE" in text
    assert "--optim.epochs INT Passes over the training windows. (default: 200)" in text


def outcome(body):
    program = (
        "from gnio_jax.commands import console\nfrom gnio_jax.errors import InputError\n"
        f"def main():\n    {body}\nconsole.run(main)\n"
    )
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize(
    "body, status, line",
    [
        (
            "raise InputError('file.csv', 'has no column x', 'add\\nit')",
            2,
            "file.csv: has no column x; add it\n",
        ),
        ("raise KeyboardInterrupt", 130, "interrupted\n"),
        ("open('/dev/null/x', 'w')", 2, "/dev/null/x: Not a directory\n"),
        ("import os; os.kill(os.getpid(), 15)", 143, ""),
        ("import warnings; warnings.warn('two\\nlines')", 0, "warning: two lines\n"),
        ("print('fine')", 0, ""),
    ],
)
def test_run_ends_in_one_line_and_a_status(body, status, line):
    result = outcome(body)
    assert (result.returncode, result.stderr) == (status, line)


def test_faults_of_the_program_keep_their_traceback():
    result = outcome("1 / 0")
    assert result.returncode == 1 and "Traceback" in result.stderr


def test_a_config_is_found_by_its_name_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert parse("--config", "quickstart").model.width == 16
    assert parse("--config", "baselines/tlio").model.name == "tlio"
    for wrong, hint in (("quickstrat", "quickstart"), ("configs/tlio.yaml", "baselines/tlio")):
        assert f"{wrong}: no such config file; did you mean '{hint}'?" in mistake("--config", wrong)
    (tmp_path / "quickstart").mkdir()
    assert parse("--config", "quickstart").model.width == 16
    assert set(config.names()) >= {"gnio_tlio", "gnio_oxiod", "gnio_oxiod_small", "quickstart"}


@pytest.mark.parametrize(
    "arguments, expected",
    [
        ([], "command: is missing; give one of train, evaluate, calibrate, compare, data"),
        (["trian"], "command: unknown 'trian'; did you mean 'train'?"),
        (["--verbose"], "command: unknown '--verbose'; give one of train, evaluate"),
        (["data"], "command: is missing; give one of list, check, convert, import"),
        (["data", "chek"], "command: unknown 'chek'; did you mean 'check'?"),
        (["data", "convert", "oxiod", "-", "out", "--workers"], "--workers: needs a value"),
        (["data", "check", "tlio", "--splt", "a"], "--splt: unknown option; did you mean --split?"),
        (["evaluate", "--estimater", "ekf"], "unknown option; did you mean --estimator?"),
        (["tables", "gatse"], "TABLE: must be one of complexity, comparison"),
        (["tables", "gates", "--seeds", "x"], "--seeds: must be a whole number, found 'x'"),
        (["interop", "weights.npz"], "WORKDIR: is missing"),
    ],
)
def test_subcommands_and_their_mistakes(arguments, expected):
    with pytest.raises(InputError) as caught:
        options.execute(app.GNIO, arguments, "gnio")
    assert str(caught.value).startswith(expected) or expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--help"], ["usage: gnio [-h]", "• train", "gnio data list"]),
        (["train", "--help"], ["usage: gnio train", "gnio train --config quickstart", "--resume"]),
        (["data", "--help"], ["usage: gnio data", "• check", "gnio data COMMAND --help"]),
        (["data", "convert", "--help"], ["usage: gnio data convert", "gnio data convert oxiod"]),
        (["tables", "--help"], ["gnio tables complexity", "Width of the convolutional networks"]),
    ],
)
def test_help_of_the_subcommands(arguments, words, capsys):
    with pytest.raises(SystemExit) as leaving:
        options.execute(app.GNIO, arguments, "gnio")
    assert leaving.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for word in words:
        assert word in text, word


def test_events_of_another_tyro_fall_through():
    """A version of tyro with other mistakes shows its own box."""

    class Unheard:
        pass

    assert options._explain(Unheard(), [], [], subcommands=False) is None


def test_names_of_files_are_no_controls_of_the_terminal(capsys):
    """A name may colour the terminal, retitle it or delete what it showed."""
    name = "walk\x1b]0;mine\x07\x1b[2J\x9b31m\u202e.zip"

    def told():
        console.stdout().print(f"{name}: read", soft_wrap=True)
        grid = Table()
        grid.add_column(name, overflow="fold")
        console.stdout().print(grid)
        with console.terminal() as terminal:
            terminal.line(name)
        warnings.warn(name, stacklevel=1)
        raise InputError(name, "no such file")

    with pytest.raises(SystemExit, match="2"):
        console.run(told)
    out, err = capsys.readouterr()
    assert not set(out + err) & set("\x1b\x07\x9b\u202e")
    assert r"walk\x1b]0;mine\x07\x1b[2J\x9b31m\u202e.zip: read" in out
    assert err.count(r"walk\x1b]0;mine") == 3
