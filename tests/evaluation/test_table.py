"""The table on the screen names what matters."""

from rich.console import Console

from gnio_jax.commands.console import stdout
from gnio_jax.evaluation import table


def test_table_says_what_matters(made):
    console = Console(width=160, record=True, file=open("/dev/null", "w"))
    console.print(table.render(made))
    text = console.export_text()
    for words in (
        "room 1/walk",
        "ATE 2-D",
        "mean",
        "95 % interval (",
        "never_moves",
        "window orientation: filter",
        "initial state: reference",
        "gyro bias: zero",
        "IMU compensated: no",
        "blind: start: rough",
        "left out: short",
        "–",
    ):
        assert words in text
    assert f"{made.scores.summary.mean['ate']:.2f}" in text


def test_divergence_is_in_the_table(made, with_divergence):
    def text(of):
        console = Console(width=180, record=True, file=open("/dev/null", "w"))
        console.print(table.render(of))
        return console.export_text().splitlines()

    lines = text(with_divergence[1])
    cells = {line.split("  ")[1].strip(): line.split() for line in lines if line.startswith("  ")}
    assert "mean without 1 diverged" in cells and "mean" not in cells
    assert "1" in cells["diverged"] and cells["room 1:walk"].count("∞") >= 6
    assert any("∞: the estimate diverged" in line for line in lines)
    assert not any("diverged" in line for line in text(made))


def test_headings_are_words_on_the_console_of_results(made, capsys):
    stdout().print(table.render(made))
    shown = capsys.readouterr().out
    assert "ATE" in shown and "m/min" in shown and "[dim]" not in shown
