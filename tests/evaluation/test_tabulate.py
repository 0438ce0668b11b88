"""The table on the screen: its content, and its width."""

import numpy as np
import pytest
from rich.console import Console

from gnio_jax.evaluation import tabulate
from gnio_jax.evaluation.metrics import OF_WAYPOINTS
from gnio_jax.evaluation.statistics import Cell, Difference, MetricSummary
from tests.support.reports import report_of


def text(report, width=80):
    console = Console(width=width, record=True, file=open("/dev/null", "w"))
    console.print(tabulate.render(report))
    return console.export_text()


def rows(report, width=80):
    lines = [line for line in text(report, width).splitlines() if line.startswith("  ")]
    return {line.split("  ")[1].strip(): line.split() for line in lines}


def test_the_table_has_figures_choices_and_notes(made_report):
    shown = " ".join(text(made_report).split())
    assert "[" not in shown  # no heading is markup
    for words in ("made test: ekf", "room 1/walk", "never_moves", "window orientation: filter"):
        assert words in shown
    for words in ("IMU compensated: no", "blind: start: rough", "left out: short", "–"):
        assert words in shown
    table, summary = rows(made_report), made_report.summary()
    assert f"{summary['ate'].mean:.2f}" in table["mean"]
    assert table["blind"][1:4] == ["–"] * 3
    assert table["groups"][1:] == [str(summary[name].groups) for name in tabulate.SCREEN]
    low, _ = summary["nees_coverage"].interval or (None, None)
    assert table["95 % from"][-1] == tabulate.number(low, 0)


def test_vehicles_have_kittis_error_in_the_place_of_the_path_ratio(made_report):
    far = {
        name: measures._replace(values=measures.values | {"t_rel": 1.23})
        for name, measures in made_report.scores.items()
    }
    for dataset, scores, heading in (
        ("kitti", far, "t_rel"),
        ("kitti", made_report.scores, "ratio"),  # no piece of 100 m
        ("tyrex", far, "ratio"),
        ("a file", far, "ratio"),
    ):
        settings = made_report.settings | {"dataset": dataset}
        table = text(made_report._replace(settings=settings, scores=scores))
        assert [words in table for words in ("t_rel", "1.23", "ratio")] == (
            [True, True, False] if heading == "t_rel" else [False, False, True]
        )


@pytest.mark.parametrize("tapped", [False, True])
def test_the_table_fits_into_80_columns_and_breaks_names_between_their_words(made_report, tapped):
    name = "2023-11-25T12-30_person-17_pocket_left_down"
    measures = made_report.scores["room 1/walk"]
    values = dict.fromkeys([*measures.values, *(OF_WAYPOINTS if tapped else ())], 123456.7)
    scores = {name: measures._replace(values=values), "b": measures}
    rows_below = {"never_moves": scores, "perfect_displacements": scores}
    report = made_report._replace(
        scores=scores, reference_rows=rows_below, groups={name: "x", "b": "y"}, notes={}
    )
    lines = text(report).splitlines()
    assert max(map(len, lines)) <= 80 and not any("…" in line for line in lines)
    heads = " ".join("\n".join(lines[:6]).split())
    whole = ("ATE", "RTE 60 s", "RPE 1 s", "yaw", "path", "ratio", "NEES<95")
    assert all(words in heads for words in (("ATE", "leg", "waypoint") if tapped else whole))
    assert ("leg" in heads) == tapped
    names = [line[2:30].split("  ")[0].strip() for line in lines if line.startswith("  ")]
    pieces = [piece for piece in names if len(piece) > 1 and piece in name]
    assert name in "".join(pieces) and all(piece[-1] in "-_" for piece in pieces[:-1])


def test_divergence_is_in_the_table(made_report, with_divergence):
    table = rows(with_divergence[1], 120)
    assert "mean without 1 diverged" in table and "mean" not in table
    assert table["room 1:walk"].count("∞") == 5
    shown = " ".join(text(with_divergence[1]).split())
    assert "∞: the estimate diverged" in shown
    assert "room 1:walk: the estimate diverged, and is in no mean" in shown
    assert "diverged" not in text(made_report)


def test_a_heading_says_by_what_a_normalised_error_is_divided():
    """By the number of its dimensions."""
    assert tabulate.column("nees").title == "NEES/3 (best 1)"
    assert tabulate.column("nees_2d").title == "NEES/2 2-D (best 1)"
    assert tabulate.column("ate_2d").title == "ATE 2-D (m)"


def test_cells_have_the_digits_of_an_interval_and_the_spread_of_seeds():
    """A mean of 3.0 ° may differ by 0.0045 °."""
    difference = Difference(0.00452, (0.00213, 0.00709), None, 1, 2, 2, 2)
    assert tabulate.difference(difference, 1) == "+0.0045 (+0.0021 to +0.0071)"
    assert (
        tabulate.difference(difference._replace(interval=None, sequences=3), 1) == "+0.0045 over 2"
    )
    assert tabulate.difference(difference._replace(mean=None, withheld=True), 1) == "– ‡"
    mean = MetricSummary(2.25, [1.5, 3.0], 2.0, None, 3, 2, 0, 8)
    assert tabulate.mean(mean, 2) == "2.25 ± 1.06"
    assert tabulate.mean(mean._replace(seeds=[2.25], diverged=1), 2) == "2.25 † 1/8"
    assert tabulate.mean(mean._replace(mean=None, seeds=[]), 2) == "–"


def test_marks_are_explained():
    mean = MetricSummary(1.0, [1.0], 1.0, None, 3, 2, 0, 3)
    less = Difference(-1, (-2, 0), 50, 2, 3, 3, 2)
    withheld = Difference(None, None, None, 0, 3, 3, 1, True)
    for cell, beginnings in (
        (Cell(mean, less), ["The interval is Student's t over people or sessions; there are 2."]),
        (Cell(mean, less._replace(compared=2)), ["The interval", "A difference is over"]),
        (Cell(mean._replace(diverged=1), less), ["The interval", "† "]),
        (Cell(mean, less._replace(largest=2)), ["The interval", "One of 2 people or sessions has"]),
        (Cell(mean, withheld), ["‡ "]),
        (Cell(mean._replace(seeds=[np.inf]), None), ["∞"]),
        (Cell(mean._replace(mean=None, seeds=[]), None), ["–"]),
    ):
        lines = tabulate.marks([Cell(mean, None), cell])
        assert len(lines) == len(beginnings)
        assert all(line.startswith(words) for line, words in zip(lines, beginnings, strict=True))


def test_recordings_that_are_left_out_for_one_reason_are_one_line(made_report):
    reasons = {name: f"{name}.csv: is damaged" for name in "xyz"} | {"short": "0.5 s"}
    report = made_report._replace(left_out=reasons)
    lines = [line for line in tabulate.remarks(report) if line.startswith("left out: ")]
    alike = "left out: 3 recordings for one reason, the first: x: x.csv: is damaged"
    assert lines == [alike, "left out: short: 0.5 s"]
    assert tabulate.gaps(report) == "4 of 7 recordings were left out: x, y, z, ..."
    assert tabulate.gaps(made_report) == "1 of 4 recordings were left out: short"
    assert tabulate.gaps(report._replace(left_out={})) == ""


def test_groups_that_make_an_interval_unsure_are_told():
    """In the table and on the page, with the largest of the metrics' groups."""

    def remarks(groups, **values):
        ates = dict(zip("abcdefgh", range(1, 9), strict=True))
        return tabulate.remarks(report_of(ates, dict(zip("abcdefgh", groups, strict=True)), values))

    assert remarks("vvwwxxyz") == []
    uneven = "One of 4 people or sessions has 5 of 8 sequences, so the interval may be too narrow."
    assert remarks("wwwwwxyz") == [uneven]
    assert remarks("wwwwxxxx") == ["no interval of a mean over 2 groups: it needs 4"]
    assert remarks("wwwwwwww") == ["no interval of a mean over 1 group: it needs 4"]
