"""Statistics of tables by hand."""

import numpy as np
import pytest

from gnio_jax.tables import markdown, summary
from gnio_jax.tables.experiments import Experiment
from tests.support.tables import LOST, compared, result


def test_statistics_by_hand():
    first = result("a", [[1.0, 2.0, 6.0], [3.0, 2.0, 4.0]], 2.4)
    second = result("b", [[1.0, 1.0, 1.0], [2.0, 2.0, 2.0]], 1.8)
    experiment = Experiment("Title", "source", [first.cell, second.cell])
    one, two = summary.rows(experiment, [first, second], {"b": {"more": 0.5}})
    assert (
        one.seeds["ate"] == [3.0, 3.0]
        and one.gain == 0
        and one.difference == 0
        and one.interval is None
    )
    assert (
        two.gain == pytest.approx(50.0)
        and two.difference == pytest.approx(-1.5)
        and two.published_gain == pytest.approx(25.0)
    )
    assert "stationary_drift" not in one.seeds
    # Differences of the sequences: −0.5, −0.5, −3.5, of a standard error of 1.
    reach = 4.30265  # t of two degrees of freedom
    assert two.interval == pytest.approx((-1.5 - reach, -1.5 + reach), rel=1e-5)
    text = markdown.render(experiment, [one, two], ["a note"])
    assert (
        "| B | 1.50 ± 0.71 | 1.50 | 1.50 ± 0.71 | 0.5 | ↓ 50.0 % | -1.50 (-5.80 to +2.80) "
        "| 1.80 | ↓ 25.0 % |"
    ) in text
    assert "| A | 3.00 ± 0.00 | 2.50 | 3.00 ± 0.00 | – |  |  | 2.40 |  |" in text
    assert "a note" in text
    assert "diverge" not in text and "†" not in text


def test_only_sequences_that_all_seeds_measured_count():
    whole = result("a", [[1.0, 2.0], [3.0, 4.0]])
    whole.figures[1]["sequences"]["s0"]["ate"] = None
    assert {name: list(ates) for name, ates in summary.errors(whole).items()} == {"s1": [2.0, 4.0]}


def test_sequences_are_paired_by_name():
    """The second row lacks a sequence and has another: what both have is compared, in any order."""
    first, second = result("a", [[9.0, 2.0, 4.0]]), result("b", [[9.0, 1.0, 2.0]])
    second.figures[0]["sequences"] = {
        name: {"ate": ate, "group": name} for name, ate in [("s9", 50.0), ("s2", 2.0), ("s1", 1.0)]
    }
    *_, row, text = compared(first, second)
    assert (row.compared, row.sequences) == (2, 4)
    assert row.difference == pytest.approx(-1.5) and row.gain == pytest.approx(50.0)
    # −1 and −2: a standard error of 0.5, and one degree of freedom.
    assert row.interval == pytest.approx((-1.5 - 6.3531, -1.5 + 6.3531), rel=1e-4)
    assert "↓ 50.0 % | -1.50 (-7.85 to +4.85) over 2 of 4 |" in text
    second.figures[0]["sequences"] = {"other": {"ate": 1.0, "group": "other"}}
    *_, row, text = compared(first, second)
    assert (row.gain, row.difference, row.interval) == (None, None, None)
    assert "| 1.00 | 1.00 | – | – | – |" in text


def test_rows_that_diverged_in_other_sequences_are_no_better_than_each_other():
    """Equal errors in every sequence that both finished."""
    first, second = result("a", [[LOST, 2.0, 9.0, 4.0]]), result("b", [[1.0, 2.0, LOST, 4.0]])
    for pair in ((first, second), (second, first)):
        one, two, text = compared(*pair)
        assert (one.diverged, two.diverged, two.estimates) == (1, 1, 4)
        assert (two.compared, two.sequences) == (2, 4)
        assert two.gain == 0 and two.difference == 0 and two.interval == (0, 0)
        assert "| 1 of 4 | 0 % | +0.00 (+0.00 to +0.00) over 2 of 4 |" in text
        assert "† Over the sequences on which no seed diverged" in text


@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_row_is_never_better_for_having_diverged(seeds, share):
    """Its hardest sequence diverges with one seed; its other errors are as small or smaller."""
    ates = np.array([1.0, 2.0, 3.0, 40.0])
    wrong = np.tile(share * ates, (seeds, 1))
    wrong[0, 3] = LOST
    first = result("a", [list(ates)] * seeds)
    _, row, text = compared(first, result("b", wrong.tolist()))
    assert row.diverged == 1 and row.estimates == 4 * seeds
    assert row.gain == (0 if share == 1 else None) and "↓" not in text
    cells = "0 % | +0.00 (+0.00 to +0.00) over 3 of 4" if share == 1 else "– | –"
    assert f"| 1 of {4 * seeds} | {cells} |" in text and row.compared == 3
    assert (row.difference, row.interval) == ((0, (0, 0)) if share == 1 else (None, None))
    whole, back, _ = compared(result("b", wrong.tolist()), first)  # the other way about it may lose
    assert (whole.diverged, back.diverged) == (1, 0)
    assert back.gain == pytest.approx(100 * (1 - 1 / share))
    assert back.difference == pytest.approx((1 - share) * 2)


def test_the_median_is_infinite_where_half_diverged():
    first = result("a", [[1.0, 2.0], [3.0, 5.0]])
    for ates, median, cells in [
        ([[1.0, 2.0], [3.0, LOST]], 2.5, "| B | 2.00 ± 1.41 † | 2.50 |"),
        ([[1.0, LOST], [3.0, LOST]], np.inf, "| B | 2.00 ± 1.41 † | ∞ |"),
        # Seeds that have no sequence in common have no mean to spread.
        ([[LOST, LOST], [1.0, 1.0]], np.inf, "| B | – | ∞ | – | 2 of 4 | – | – |"),
        ([[LOST, LOST], [LOST, LOST]], np.inf, "| B | – | ∞ | – | 4 of 4 | – | – |"),
    ]:
        _, row, text = compared(first, result("b", ates))
        assert row.median == median and cells in text


def test_groups_are_what_is_independent():
    """Two sessions of three walks: means of −0.9 and −2.9."""

    def row_and_text(first_groups, second_groups):
        first = result("a", [[5.0] * 6], groups=first_groups)
        second = result("b", [[4.0, 4.1, 4.2, 2.0, 2.1, 2.2]], groups=second_groups)
        return compared(first, second)[1:]

    row, text = row_and_text("xxxyyy", "xxxyyy")
    assert row.groups == 2
    assert row.interval == pytest.approx((-1.9 - 12.7062, -1.9 + 12.7062), rel=1e-5)
    assert "there are 2." in text
    row, text = row_and_text("xxxxxx", "xxxxxx")
    assert row.groups == 1 and row.interval is None
    assert "↓ 38.0 % | -1.90 | –" in text and "Student" not in text
    alone, _ = row_and_text("abcdef", "abcdef")
    assert alone.groups == 6 and -3.1 < alone.interval[0] < alone.interval[1] < -0.7
