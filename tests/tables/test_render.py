"""A table from its rows to its text, its CSV and its picture."""

import csv

import numpy as np
import pytest

from gnio_jax.config import TablesConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import tabulate
from gnio_jax.evaluation.views import make_view
from gnio_jax.tables import make, plots
from gnio_jax.tables.cost import RunCost
from gnio_jax.tables.experiments import Experiment, TableRow
from gnio_jax.tables.runs import RowResult
from tests.support.estimates import estimate
from tests.support.reports import BASE, LOST, measures, report_of

COST = RunCost(12_345, 1.234, "cpu")


def result(name, ates, published=None, groups="xyz"):
    """`ates`: (seeds, sequences)."""
    names = [f"s{k}" for k in range(len(ates[0]))]
    of = dict(zip(names, groups, strict=False))
    reports = [report_of(dict(zip(names, row, strict=True)), of) for row in ates]
    runs = [f"{name}_s{seed}" for seed in range(len(ates))]
    return RowResult(TableRow(name, name.upper(), BASE, published), reports, runs, runs, COST)


def table_of(*results):
    return Experiment("Title", "source", [row_result.row for row_result in results])


def test_a_table_by_hand():
    results = [
        result("a", [[1.0, 2.0, 6.0], [3.0, 2.0, 4.0]], 2.4),
        result("b", [[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]], 1.8),
    ]
    figures = make.figures_of(results)
    assert list(figures) == ["ate", "rpe_1s"]
    figures |= make._over_seeds("more", [np.zeros(0), np.array([0.25, 0.75])])
    reports = results[0].reports
    rows = {"never_moves": {name: measures(ate=7.0) for name in reports[0].scores}}
    reports[0] = reports[0]._replace(reference_rows=rows)
    text = make.render(table_of(*results), figures, results)
    assert "| never moves | 7.00 | – | – | 7.00 |  |  |  |  |  |  |" in text
    means = "| B | 1.50 ± 0.71 | 0.150 ± 0.071 | 0.500 ± 0.354 | 1.50 | ↓ 50.0 % "
    assert means + "| -1.50 (-5.80 to +2.80) | 1.23 | 12,345 | 1.80 | ↓ 25.0 % |" in text
    assert "| A | 3.00 ± 0.00 | 0.300 ± 0.000 | – | 2.50 |  |  | 1.23 | 12,345 | 2.40 |  |" in text
    assert "there are 3." in text and "†" not in text
    arrows = [make.arrow(gain) for gain in (12.34, -5.0, 0.01, None)]
    assert arrows == ["↓ 12.3 %", "↑ 5.0 %", "0 %", "–"]


def test_what_diverged_is_in_the_files_and_the_picture(tmp_path):
    """It counts among the estimates that have the metric, as in every table."""
    results = [
        result("a", [[1.0, 2.0, 4.0]]),
        result("b", [[LOST, LOST, 8.0]]),
        result("c", [[LOST, LOST, LOST]]),
        result("d", [[0.5, 1.0, LOST]]),
    ]
    experiment, figures = table_of(*results), make.figures_of(results)
    text = make.render(experiment, figures, results)
    assert "| B | 8.00 † 2/3 |" in text and "| ↑ 100.0 % | +4.00 over 1 |" in text
    assert "| C | – † 3/3 | – † 3/3 | ∞ | – | – |" in text and "| – | – ‡ |" in text
    for mark in ("† This number", "‡ Its remaining", "A difference is over"):
        assert mark in text
    heads = [{"row": row_result.row.name} for row_result in results]
    tabulate.write(tmp_path / "t", text, tabulate.records(heads, figures))
    with open(tmp_path / "t.csv", newline="", encoding="utf-8") as file:
        one, two, three, four = (row for row in csv.DictReader(file) if row["metric"] == "ate")
    assert (one["median"], one["diverged"], one["estimates"]) == ("2.0", "0", "3")
    assert (two["mean"], two["median"], two["diverged"]) == ("8.0", "inf", "2")
    assert (two["compared"], two["sequences"], two["groups"]) == ("1", "3", "1")
    assert float(two["gain_percent"]) == -100
    assert (two["difference"], two["difference_low"]) == ("4.0", "")
    assert (three["mean"], three["gain_percent"], three["difference"]) == ("", "", "")
    withheld = ("gain_percent", "difference", "difference_low", "difference_high")
    assert [four[name] for name in withheld] == [""] * 4 and four["compared"] == "2"
    axes = plots.table(table_of(*results[:3]), results[:3], figures["ate"][:3]).axes[0]
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["A", "B\n(2 of 3 diverged)", "C\n(3 of 3 diverged)"]
    assert [bar.get_width() for bar in axes.patches] == [pytest.approx(7 / 3), 8.0, 0.0]


def test_trajectories_need_a_sequence_with_poses(tmp_path, monkeypatch):
    """Of a split whose recordings have waypoints alone nothing is drawn or written."""
    row = result("a", [[1.0, 2.0]])
    views = [make_view(estimate(name, 0, truth=False)) for name in row.reports[0].scores]
    monkeypatch.setattr(make, "read_views", lambda *_: views)
    options = TablesConfig(table="trajectories", out=tmp_path)
    with pytest.raises(InputError, match="has no sequence with poses"):
        make.make_trajectories(tmp_path / "trajectories", options, [row])
    assert not any(tmp_path.iterdir())
