"""Published figures and their conversion."""

import itertools

import numpy as np
import pytest

from gnio_jax.tables import experiments, published
from tests.support.command_lines import run as gnio
from tests.support.reports import BASE


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_figure_becomes_the_root_mean_square_of_the_distance_of_the_same_path(dimensions):
    """The figures are computed here from the path itself."""
    rng = np.random.default_rng(4)
    true = np.cumsum(rng.standard_normal((50, dimensions)), axis=0)
    error = rng.standard_normal((50, dimensions))
    distance = np.sqrt(np.mean([row @ row for row in error]))
    length = sum(np.linalg.norm(b - a) for a, b in itertools.pairwise(true))
    figures = {
        "distance": distance,
        "coordinate": np.sqrt(np.mean(error.ravel() ** 2)),
        "of_length": 100 * distance / length,
    }
    for definition, figure in figures.items():
        converted = published.to_distance(figure, definition, dimensions, length)
        assert converted == pytest.approx(distance)
    assert published.to_distance(figures["of_length"], "of_length", dimensions) is None
    for definition in ("aligned", "window_frames", "unknown"):
        assert published.to_distance(1.0, definition, dimensions, length) is None


def test_the_table_has_every_figure_with_its_meaning(tmp_path, capsys):
    gnio("tables", "published", "--out", str(tmp_path))
    text = (tmp_path / "published.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")][1:]
    errors = [*published.ERRORS, *published.papers_errors()]
    assert len(rows) == len(errors) + 1 and "Published errors" in capsys.readouterr().out
    cells = {row[1]: row[2:5] for row in rows if row[0] == "| RoNIN unseen"}
    assert cells["EqNIO, O(2) around RoNIN"] == ["4.42 m", "RMSE of a coordinate, 2-D", "6.25"]
    assert cells["gnio"] == ["5.02 m", "not known", "–"]
    keys = [(error.dataset, error.system) for error in errors]
    assert len(set(keys)) == len(keys)


def test_figures_of_the_paper_are_those_of_the_other_tables():
    printed = {row.label: row.published for row in experiments.components(BASE).rows}
    errors = {error.system: error.figure for error in published.ERRORS if error.source == "GNIO"}
    assert errors["TLIO, in GNIO's paper"] == printed["baseline (TLIO)"]
    assert errors["GNIO"] == printed["+ bank + gated head"]
