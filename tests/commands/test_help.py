"""Every help explains all options and ends with examples that are understood."""

import re
import shlex
import subprocess

import pytest

from gnio_jax import config
from gnio_jax.commands import app, names, options
from tests.support.command_lines import commands, run, understood

WORDS = [words for words, _ in commands()]


def shown(capsys, *words):
    """The help of a command, for people whose terminal has 100 columns."""
    try:
        run(*words, "--help")
    except SystemExit as leaving:
        assert leaving.code == 0
    return capsys.readouterr().out


def joined(text):
    """The words of a help text, in one line. A word may be broken at its hyphen."""
    return " ".join(re.sub(r"-\n +", "-", text).split())


@pytest.fixture(autouse=True)
def columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")


@pytest.mark.parametrize("words", [(), ("data",), *WORDS], ids=" ".join)
def test_help_ends_with_examples_that_are_understood(words, capsys):
    text = shown(capsys, *words)
    assert all(sign == "\n" or sign.isprintable() for sign in text)  # no terminal is controlled
    assert max(map(len, text.splitlines())) <= 100
    description, _, examples = text.partition("\nexamples:\n")
    assert f"usage: {' '.join(['gnio', *words])}" in description
    lines = re.sub(r"\\\n +", "", examples).splitlines()
    lines = [line for line in lines if "gnio" in line and line.startswith("  ")]
    assert lines and any(" ".join(["gnio", *words]) in line for line in lines)
    for line in lines:
        # What the example does stands behind it.
        call = re.split(r" {3,}", line[line.index("gnio ") :])[0].replace("...", "quickstart")
        understood(shlex.split(call)[1:])


@pytest.mark.parametrize(
    ("words", "command"), list(commands()), ids=[" ".join(w) for w, _ in commands()]
)
def test_help_explains_every_option(words, command, capsys):
    text = shown(capsys, *words, "-H")
    assert "None" not in text  # what is not given is told in words
    if words == ("train",):
        assert all(name in text for name in config.experiment_names())
        entry = "--optim.epochs INT Passes over the training windows. (default: 200)"
        assert entry in joined(text)
    command_options = list(options.options_of(options.options_type(command)))
    # Nobody is asked for too many: all other settings have `--set`.
    assert sum(option.name.startswith("--") for option in command_options) <= (
        70 if "train" in words else 25
    )
    for option in command_options:
        for name in filter(None, (option.name, option.negation)):
            assert re.search(rf"[ \[]{re.escape(name)}[ ,\]\n]", text), name
        assert options.comment(option) in joined(text), option.name


def test_the_help_of_many_options_explains_the_main_ones_and_names_the_networks(capsys):
    text = shown(capsys, "train", "--help")
    assert "--optim.epochs INT Passes over the training windows. (default: 200)" in joined(text)
    assert "--loss.mse-weight" not in text and "gnio train -H explains" in text
    assert "-H, --help-verbose" in text and len(re.findall(r"(?m)^  --", text)) <= 25
    for name, words in names.NETWORKS.items():
        assert f"  {name:<13} {words}\n" in text


def test_bash_completes_commands_and_options(capsys):
    app.main(["--completion"])
    script = capsys.readouterr().out
    for typed, completed in (
        (["tr"], ["track", "train"]),
        (["data", "check", "oxiod", "--p"], ["--plots"]),
        (["train", "--augment.no"], ["--augment.no-yaw", "--augment.noise"]),
    ):
        words = f"COMP_WORDS=({shlex.join(['gnio', *typed])}); COMP_CWORD={len(typed)}; _gnio"
        shell = ["bash", "-c", f'{script}\n{words}; echo "${{COMPREPLY[@]}}"']
        shown = subprocess.run(shell, capture_output=True, text=True, timeout=60)
        assert sorted(shown.stdout.split()) == completed and shown.stderr == ""
