"""Means, intervals and differences: against SciPy and by hand."""

import numpy as np
import pytest
from scipy import stats

from gnio_jax.evaluation.metrics import Measures
from gnio_jax.evaluation.statistics import compare, interval, is_uneven, summarise
from tests.support.reports import LOST, measures


def seeds_of(ates, names=None):
    return [
        {name: measures(ate=ate) for name, ate in zip(names or "abcdefgh", row, strict=False)}
        for row in ates
    ]


ALONE = {name: name for name in "abcdefgh"}


def test_the_interval_is_students_over_the_means_of_groups():
    """Groups have one size and any order. One group has no interval, nor has an infinite value."""
    values = np.random.default_rng(0).normal(5.0, 2.0, 7)
    expected = stats.t.interval(0.95, 6, values.mean(), stats.sem(values))
    assert interval(values, range(7)) == pytest.approx(expected)
    values, means = np.array([1.0, 5.0, 1.2, 5.2, 2.0, 2.2]), np.array([1.1, 5.1, 2.1])
    expected = stats.t.interval(0.95, 2, means.mean(), stats.sem(means))
    assert interval(values, "xyxyzz") == pytest.approx(expected)
    assert interval(values[::-1], "zzyxyx") == pytest.approx(expected)
    assert interval(values, ["x"] * 6) is None
    assert interval(values[:0], []) is None
    assert interval(np.array([1.0, np.inf]), "xy") is None
    assert interval(np.array([1e308, -1e308, 1e308]), "xyz") is None


def jackknife(values, groups):
    """The interval by its definition: one group after the other is left out."""
    names = sorted(set(groups))
    of = np.array(list(groups))
    means = [np.mean(values[of != name]) for name in names]
    variance = (len(names) - 1) / len(names) * sum((mean - values.mean()) ** 2 for mean in means)
    return stats.t.interval(0.95, len(names) - 1, values.mean(), np.sqrt(variance))


@pytest.mark.parametrize("groups", ["wwwwwwxyz", "wxxyyyzzzz", "wwwwxxyyy", "wwwwwwwx"])
def test_the_interval_of_uneven_groups_is_that_of_the_jackknife(groups):
    values = np.random.default_rng(1).lognormal(size=len(groups))
    assert interval(values, groups) == pytest.approx(jackknife(values, groups))


@pytest.mark.parametrize(
    "sizes, least, most",
    [
        ([5] * 3, 93, 97),
        ([5] * 8, 93, 97),
        ([12, 3, 3, 3, 3], 89, 95),  # one has half of all
        ([60, 2, 2, 2, 2], 86, 92),
        ([60, 2, 2, 60, 2, 2, 2, 2], 78, 86),
    ],
)
def test_the_interval_covers_the_mean_of_the_population(sizes, least, most):
    """Half of the variance is between groups. The sandwich (Liang and Zeger) covers 65 % where few
    groups have most of the values."""
    rng, draws = np.random.default_rng(0), 2000
    groups = np.repeat(np.arange(len(sizes)), sizes)
    hits = 0
    for _ in range(draws):
        values = rng.normal(size=len(sizes))[groups] + rng.normal(size=len(groups))
        low, high = interval(values, groups)
        hits += low <= 0 <= high
    assert least <= 100 * hits / draws <= most


def test_an_error_has_no_interval_of_few_groups_and_none_below_zero():
    def of(ates, groups):
        names = [str(number) for number in range(len(ates))]
        return summarise(seeds_of([ates], names), "ate", dict(zip(names, groups, strict=True)))

    assert [of([1.0, 9.0, 3.0, 4.0], groups).interval for groups in ("xxxx", "xxyy", "xxyz")] == [
        None
    ] * 3
    low, high = of([0.1, 9.0, 0.1, 0.1], "wxyz").interval
    assert low == 0.0 and high == pytest.approx(jackknife(np.array([0.1, 9, 0.1, 0.1]), "wxyz")[1])


@pytest.mark.parametrize(
    "groups, largest, uneven",
    [
        *(("xxxxyz", 4, True), ("xxyyzz", 2, False), ("xxyyzw", 2, False), ("xxxyyy", 3, False)),
        *(("xxxyyz", 3, True), ("xxyzwv", 2, False), ("xxxxxx", 6, False)),
    ],
)
def test_a_group_with_more_than_a_third_of_the_sequences_is_told(groups, largest, uneven):
    """And with more than others: of two people each has a half."""
    of = dict(zip("abcdef", groups, strict=True))
    scores, halves = seeds_of([[1.0, 2, 3, 4, 5, 6]]), seeds_of([[0.5, 1, 1.5, 2, 2.5, 3]])
    for figure in (summarise(scores, "ate", of), compare(halves, scores, "ate", of)):
        assert (figure.largest, is_uneven(figure)) == (largest, uneven)


def test_divergence_never_improves_a_summary():
    """The worst of six errors diverge: the mean and its number are those of the others, and the
    median never decreases; it is infinite if half of them diverged."""
    errors = [1.0, 2.0, 3.0, 4.0, 5.0, 60.0]
    summaries = [
        summarise(seeds_of([errors[: 6 - bad] + [LOST] * bad]), "ate", ALONE)
        for bad in (0, 1, 3, 6)
    ]
    assert [s.diverged for s in summaries] == [0, 1, 3, 6]
    assert [s.sequences for s in summaries] == [6, 5, 3, 0]
    assert [s.estimates for s in summaries] == [6] * 4
    assert [s.median for s in summaries] == [3.5, 3.5, np.inf, np.inf]
    assert [s.mean for s in summaries] == [12.5, 3.0, 2.0, None]
    expected = stats.t.interval(0.95, 4, 3.0, stats.sem(errors[:5]))
    assert summaries[1].interval == pytest.approx(expected)
    assert [s.groups for s in summaries] == [6, 5, 3, 0]
    assert [s.interval for s in summaries[2:]] == [None, None]  # three groups, or none


def test_a_diverged_sequence_is_in_no_mean():
    """Walk a is whole, b diverged, c has a bad covariance, d has no reference and diverged."""
    fields = ("ate", "nees", "nees_coverage", "accepted", "path_length")
    rows = {
        "a": (1.0, 2.0, 90.0, 80.0, 10.0),
        "b": (LOST, LOST, 0.0, 5.0, 500.0),
        "c": (3.0, LOST, 0.0, 70.0, 20.0),
    }
    scores = {name: measures(**dict(zip(fields, row, strict=True))) for name, row in rows.items()}
    scores["d"] = Measures({"ate": None, "nis": LOST, "accepted": 3.0}, {}, True)
    summaries = {metric: summarise([scores], metric, ALONE) for metric in (*fields, "nis")}
    means = dict(zip(fields, (2.0, np.inf, 45.0, 75.0, 15.0), strict=True))
    assert {metric: of.mean for metric, of in summaries.items()} == means | {"nis": None}
    assert {m: of.sequences for m, of in summaries.items()} == dict.fromkeys(fields, 2) | {"nis": 0}
    lost = dict.fromkeys(fields, 1) | {"nis": 1, "accepted": 2}
    assert {metric: of.diverged for metric, of in summaries.items()} == lost
    assert summaries["nees"].interval is None
    assert (summaries["path_length"].interval, summaries["path_length"].groups) == (None, 2)
    assert summaries["ate"].median == 3.0 and summaries["nees"].median == np.inf


def test_seeds_are_averaged_over_the_sequences_of_all_seeds():
    summary = summarise(seeds_of([[1.0, 2.0, 9.0], [3.0, 4.0]]), "ate", ALONE)
    assert (
        summary.seeds == [1.5, 3.5] and summary.mean == 2.5 and summary.std == pytest.approx(2**0.5)
    )
    assert summary.estimates == 4  # † is of these
    whole = seeds_of([[1.0, 2.0], [3.0, 4.0]])
    whole[1]["a"] = measures(ate=None)
    assert summarise(whole, "ate", ALONE).seeds == [2.0, 4.0]
    mixed = seeds_of([[1.0, 2.0], [3.0, LOST]]), seeds_of([[LOST, LOST], [1.0, 1.0]])
    assert [summarise(seeds, "ate", ALONE).median for seeds in mixed] == [2.5, np.inf]


def test_the_interval_of_a_share_ends_where_shares_do():
    def of(shares):
        scores = {str(i): Measures({"accepted": x}, {}, False) for i, x in enumerate(shares)}
        return summarise([scores], "accepted", {name: name for name in scores}).interval

    assert of([99.0, 60.0]) is None
    assert of([100.0, 0.0, 100.0, 0.0]) == (0.0, 100.0)
    low, high = of([90.0, 91.0, 92.0, 93.0])
    assert 85 < low < 91.5 < high < 98


def test_sequences_are_paired_by_name():
    first, second = seeds_of([[9.0, 2.0, 4.0]]), seeds_of([[50.0, 2.0, 1.0]], "hcb")
    difference = compare(second, first, "ate", ALONE)
    assert (difference.compared, difference.sequences) == (2, 4)
    assert difference.mean == pytest.approx(-1.5) and difference.gain == pytest.approx(50.0)
    # −1 and −2: a standard error of 0.5, and one degree of freedom.
    assert difference.interval == pytest.approx((-1.5 - 6.3531, -1.5 + 6.3531), rel=1e-4)
    difference = compare(seeds_of([[1.0]], "h"), first, "ate", ALONE)
    assert (difference.mean, difference.gain, difference.interval, difference.compared) == (
        None,
        None,
        None,
        0,
    )


@pytest.mark.parametrize("seeds, metric", [(1, "ate"), (3, "ate"), (1, "waypoint_rms")])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_divergence_never_makes_a_row_better(seeds, share, metric):
    """Its hardest sequence diverges with one seed; its other errors are as small or smaller."""
    ates = np.array([1.0, 2.0, 3.0, 40.0])
    wrong = np.tile(share * ates, (seeds, 1))
    wrong[0, 3] = LOST
    first, row = (
        [
            {name: one._replace(values={metric: one.values["ate"]}) for name, one in scores.items()}
            for scores in seeds_of(rows)
        ]
        for rows in ([list(ates)] * seeds, wrong.tolist())
    )
    difference = compare(row, first, metric, ALONE)
    assert difference.compared == 3 and difference.withheld == (share < 1)
    assert (difference.mean, difference.interval) == ((0, (0, 0)) if share == 1 else (None, None))
    back = compare(first, row, metric, ALONE)  # the other row may lose
    assert back.gain == pytest.approx(100 * (1 - 1 / share))
    assert back.mean == pytest.approx((1 - share) * 2)


def test_rows_with_different_numbers_of_seeds_are_compared_by_their_share_of_divergences():
    """One of four estimates diverged, and one of eight: the same number is another share."""
    first = seeds_of([[1.0, 2.0, 3.0, LOST], [1.0, 2.0, 3.0, 4.0]])
    assert compare(seeds_of([[0.5, 1.0, 1.5, LOST]]), first, "ate", ALONE).withheld
    twice = seeds_of([[1.0, 2.0, 3.0, LOST]])
    assert not compare(seeds_of([[0.5, 1.0, 1.5, LOST]] * 2), twice, "ate", ALONE).withheld


def test_a_better_row_is_nearer_to_the_best_value():
    first, row = seeds_of([[0.7], [1.4]]), seeds_of([[0.9]])
    assert compare(row, first, "ate", ALONE, best=1.0).better == 1
    assert compare(first, row, "ate", ALONE, best=1.0).better == 0


def test_no_difference_has_a_metric_of_a_diverged_estimate():
    row = [{"a": measures(ate=LOST, rpe=0.1), "b": measures(ate=1.0, rpe=0.2)}]
    first = [{"a": measures(ate=1.0, rpe=0.5), "b": measures(ate=2.0, rpe=0.1)}]
    difference = compare(row, first, "rpe", ALONE)
    back = compare(first, row, "rpe", ALONE)
    assert (
        difference.compared == back.compared == 1
        and difference.mean == pytest.approx(0.1) == -back.mean
    )
