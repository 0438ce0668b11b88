"""Every help explains all options, ends with examples that are understood, and nobody is asked for
too many."""

import dataclasses
import re
import shlex

import pytest
import tyro

from gnio_jax import config
from gnio_jax.commands import options
from tests.support.command_lines import commands, run, understood

WORDS = [words for words, _ in commands()]


def shown(capsys, *words):
    """The help of a command, for people whose terminal has 100 columns."""
    try:
        run(*words, "--help")
    except SystemExit as leaving:
        assert leaving.code == 0
    return capsys.readouterr().out


def plain(text):
    """Whether no sign controls a terminal."""
    return all(sign == "\n" or sign.isprintable() for sign in text)


def joined(text):
    """The words of a help text, without its boxes."""
    return " ".join(re.sub("[│╭╮╰╯─]", " ", text).split())


@pytest.fixture(autouse=True)
def columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")


@pytest.mark.parametrize("words", [(), ("data",), *WORDS], ids=" ".join)
def test_help_ends_with_examples_that_are_understood(words, capsys):
    text = shown(capsys, *words)
    assert plain(text) and max(map(len, text.splitlines())) <= 100
    about, _, examples = text.partition("\nexamples:\n")
    assert f"usage: {' '.join(['gnio', *words])}" in about
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
    kind, text = options.options_type(command), shown(capsys, *words, "-H")
    for option in options.options_of(kind):
        assert re.search(rf"[ \[]{re.escape(option.name)}[ ,\]\n]", text), option.name
    assert "None" not in text  # what is not given is told in words
    for field, hint, markers in options._fields(kind):
        if tyro.conf.Suppress not in markers and not dataclasses.is_dataclass(hint):
            meaning = options._comments(kind)[field.name]
            assert " ".join(meaning.split()[:6]) in joined(text), field.name


def test_help_of_the_overviews_names_every_command(capsys):
    overview, of_data = shown(capsys), shown(capsys, "data")
    for word, *inner in WORDS:
        assert re.search(rf"^ +{word} ", overview, re.M), word
        for name in inner:
            assert re.search(rf"^ +{name} ", of_data, re.M), name


def test_help_of_train_names_the_configs(capsys):
    text = joined(shown(capsys, "train", "-H"))
    assert all(name in text for name in config.names())
    assert "--optim.epochs INT Passes over the training windows. (default: 200)" in text


def test_nobody_is_asked_for_too_much():
    counts = {
        words: sum(
            option.name.startswith("--") and "no-" not in option.name
            for option in options.options_of(options.options_type(command))
        )
        for words, command in commands()
    }
    assert counts[("train",)] <= 60
    assert sum(counts.values()) <= 150, counts


@pytest.mark.parametrize("words", [("data", "list"), ("weights",), ("data", "check", "synthetic")])
def test_results_in_a_pipe_have_no_control_characters(words, capsys):
    run(*words, *(["--split", "val"] if len(words) == 3 else []))
    text = capsys.readouterr().out
    assert text and plain(text)
