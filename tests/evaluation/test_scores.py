"""Summaries over sequences and their intervals."""

import numpy as np
import pytest

from gnio_jax.evaluation.metrics import Measures
from gnio_jax.evaluation.scores import summarise


def measured(values, lost=()):
    """Of sequence -> metric -> value: those have diverged whose ATE is infinite, and the lost."""
    return {
        name: Measures(own, {}, name in lost or own["ate"] == np.inf)
        for name, own in values.items()
    }


def test_divergence_never_improves_a_summary():
    """The worst of six errors diverge: the mean is of the others and counts them, the median gets
    no smaller, and is infinite with half."""
    errors = [1.0, 2.0, 3.0, 4.0, 5.0, 60.0]
    names = [f"{group}{k}" for group in "ab" for k in range(3)]
    summaries = []
    for bad in (0, 1, 3, 6):
        values = errors[: 6 - bad] + [np.inf] * bad
        measures = {
            name: {"ate": value, "rte": None} for name, value in zip(names, values, strict=True)
        }
        summaries.append(summarise(measured(measures), {name: name[0] for name in names}))
    assert [s.diverged for s in summaries] == [{"ate": n, "rte": 0} for n in (0, 1, 3, 6)]
    assert [s.count["ate"] for s in summaries] == [6, 5, 3, 0]
    assert [s.median["ate"] for s in summaries] == [3.5, 3.5, np.inf, np.inf]
    assert [s.mean["ate"] for s in summaries] == [12.5, 3.0, 2.0, None]
    # Of 1, 2, 3 and 4, 5: sums of deviations −3 and 3, standard error √2 √18 / 5, t of 1 degree.
    reach = 12.7062 * np.sqrt(2 * 18) / 5
    assert summaries[1].interval["ate"] == pytest.approx((3 - reach, 3 + reach), rel=1e-5)
    assert summaries[1].groups["ate"] == 2
    assert [s.interval["ate"] for s in summaries[2:]] == [None, None]  # one group is left, or none


def test_divergence_is_of_the_sequence_and_leaves_every_mean():
    """Of four: whole, lost, whole with a bad covariance, without a reference and lost."""
    fields = ("ate", "nees", "nees_coverage", "accepted", "path_length")
    rows = {
        "a": (1.0, 2.0, 90.0, 80.0, 10.0),
        "b": (np.inf, np.inf, 0.0, 5.0, 500.0),
        "c": (3.0, np.inf, 0.0, 70.0, 20.0),
    }
    measures = {name: dict(zip(fields, row, strict=True)) for name, row in rows.items()}
    measures["d"] = {"ate": None, "nis": np.inf, "accepted": 3.0}
    summary = summarise(measured(measures, {"d"}), {name: name for name in measures})
    means = {
        "ate": 2.0,
        "nees": np.inf,
        "nees_coverage": 45.0,
        "accepted": 75.0,
        "path_length": 15.0,
    }
    assert summary.mean == means | {"nis": None}
    assert summary.count == dict.fromkeys(fields, 2) | {"nis": 0}
    assert summary.diverged == dict.fromkeys(fields, 1) | {"nis": 1, "accepted": 2}
    assert summary.interval["nees"] is None
    reach = 12.7062 * 5  # t of one degree of freedom
    assert summary.interval["accepted"] == pytest.approx((75 - reach, 75 + reach), rel=1e-4)
    assert summary.median["ate"] == 3.0 and summary.median["nees"] == np.inf


def test_groups_are_what_is_independent():
    measures = {
        f"{group}{k}": {"ate": value + 0.001 * k, "rte": None}
        for group, value in [("a", 1.0), ("b", 3.0)]
        for k in range(5)
    }
    groups = {name: name[0] for name in measures}
    summary = summarise(measured(measures), groups)
    assert summary.mean["ate"] == pytest.approx(2.002) and summary.median["ate"] == pytest.approx(
        2.002
    )
    assert summary.groups["ate"] == 2
    # The means of the groups are 1.002 and 3.002; their standard error is 1.
    assert summary.interval["ate"] == pytest.approx((2.002 - 12.7062, 2.002 + 12.7062), rel=1e-5)
    assert (
        summary.count == {"ate": 10, "rte": 0}
        and summary.mean["rte"] is None
        and summary.interval["rte"] is None
    )
    assert summarise(measured(measures), dict.fromkeys(measures, "one")).interval["ate"] is None
    assert summarise(measured(measures), groups) == summary
