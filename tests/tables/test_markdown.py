"""Files of a table name what diverged."""

import csv

import pytest

from gnio_jax.tables import markdown, pictures, summary
from gnio_jax.tables.experiments import Experiment
from tests.support.tables import LOST, result


def test_divergence_is_in_the_files_and_the_picture(tmp_path):
    first = result("a", [[1.0, 2.0, 4.0]], groups="xyz")
    second = result("b", [[LOST, LOST, 8.0]], groups="xyz")
    third = result("c", [[LOST, LOST, LOST]], groups="xyz")
    fourth = result("d", [[0.5, 1.0, LOST]], groups="xyz")
    results = [first, second, third, fourth]
    experiment = Experiment("Title", "source", [each.cell for each in results])
    found = summary.rows(experiment, results)
    markdown.write(tmp_path / "table", experiment, found, [])
    with open(tmp_path / "table.csv", newline="", encoding="utf-8") as file:
        one, two, three, four = csv.DictReader(file)
    assert (one["ate_median"], one["diverged"], one["estimates"]) == ("2.0", "0", "3")
    assert (two["ate"], two["ate_median"], two["diverged"]) == ("8.0", "inf", "2")
    assert (two["compared"], two["sequences"], two["groups"]) == ("1", "3", "1")
    assert float(two["gain_percent"]) == -100
    assert (two["difference"], two["difference_low"]) == ("4.0", "")
    assert (three["ate"], three["gain_percent"], three["difference"]) == ("", "", "")
    assert three["diverged"] == "3"
    withheld = ("gain_percent", "difference", "difference_low", "difference_high")
    assert [four[name] for name in withheld] == [""] * 4 and four["compared"] == "2"
    axes = pictures.table(experiment, results[:3], found[:3]).axes[0]
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["A", "B\n(2 of 3 diverged)", "C\n(3 of 3 diverged)"]
    assert [bar.get_width() for bar in axes.patches] == [pytest.approx(7 / 3), 8.0, 0.0]


def test_arrows_point_as_the_error_goes():
    assert [markdown.arrow(x) for x in (12.34, -5.0, 0.01, None)] == [
        "↓ 12.3 %",
        "↑ 5.0 %",
        "0 %",
        "",
    ]
