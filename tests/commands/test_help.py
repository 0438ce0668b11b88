"""The help of every command fits a screen, and has an example and every option."""

import pytest

from gnio_jax.commands import app, options, short_help

SCREEN = (45, 100)
"""Lines and columns."""


def commands(group=app.GNIO, words=()):
    """(words of the command line, command) of every command."""
    for name, command in group.commands.items():
        if isinstance(command, options.Group):
            yield from commands(command, (*words, name))
        else:
            yield (*words, name), command


def shown(capsys, *arguments):
    with pytest.raises(SystemExit) as leaving:
        options.execute(app.GNIO, arguments, "gnio")
    assert leaving.value.code == 0
    return capsys.readouterr().out


def plain(text):
    """Whether no sign controls a terminal."""
    return all(sign == "\n" or sign.isprintable() for sign in text)


@pytest.mark.parametrize("words", [(), ("data",), *(words for words, _ in commands())])
def test_help_fits_a_screen_and_has_an_example(words, capsys, monkeypatch):
    lines, columns = SCREEN
    monkeypatch.setenv("COLUMNS", str(columns))
    text = shown(capsys, *words, "--help")
    folded = sum(max(1, -(-len(line) // columns)) for line in text.rstrip().splitlines())
    assert folded <= lines
    assert f"\n  {' '.join(['gnio', *words])}" in text or words == ("data",)
    assert plain(text)


@pytest.mark.parametrize("words, command", [each for each in commands() if each[1].common])
def test_all_options_are_in_the_whole_help(words, command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    short, whole = shown(capsys, *words, "-h"), shown(capsys, *words, "--help-all")
    assert plain(whole)
    for name in options.option_names(command.options):
        assert f" {name}" in whole, name
    for name in command.common:
        assert f"\n  {name}" in short, name
    known = {option.name: option for option in short_help.all_options(command.options)}
    assert f"explains all {len(known)} options" in " ".join(short.split())
    negations = sum("no-" in name for name in options.option_names(command.options))
    words = ("FILE", "RUNS", "TABLE")  # of those that are given without a name
    named = len(options.option_names(command.options)) - negations
    assert len(known) - sum(word in known for word in words) == named
    assert all(option.text for option in known.values())


@pytest.mark.parametrize("words", [("data", "list"), ("weights",), ("data", "check", "synthetic")])
def test_results_in_a_pipe_have_no_control_characters(words, capsys):
    options.execute(app.GNIO, [*words, *(["--split", "val"] if len(words) == 3 else [])], "gnio")
    text = capsys.readouterr().out
    assert text and plain(text)


def test_a_common_option_has_its_values_meaning_and_default(capsys):
    text = " ".join(shown(capsys, "evaluate", "--help").split())
    meaning = "The paper's filter, the sum of the displacements, or the IMU integrated without the"
    assert f"--estimator {{ekf,integrate,imu_only}} {meaning} network. (default: ekf)" in text
    assert "--help-all explains all" in text and "of the section filter" in text


@pytest.mark.parametrize("mark, other", [("│", "┃"), ("--out ", "-out ")])
def test_where_the_layout_of_tyro_is_another_one_the_help_is_whole(
    mark, other, capsys, monkeypatch
):
    """Boxes drawn otherwise, and an option spelt otherwise."""
    monkeypatch.setenv("COLUMNS", "100")
    whole = shown(capsys, "track", "--help-all")
    read = short_help._help_of_tyro
    monkeypatch.setattr(short_help, "_help_of_tyro", lambda kind: read(kind).replace(mark, other))
    assert shown(capsys, "track", "--help") == whole
