"""The interval of a mean over groups: against SciPy, by hand, and how often it covers the truth."""

import numpy as np
import pytest
from scipy import stats

from gnio_jax.evaluation.statistics import interval


def test_with_a_group_for_each_value_it_is_students_interval():
    values = np.random.default_rng(0).normal(5.0, 2.0, 7)
    wanted = stats.t.interval(0.95, 6, values.mean(), stats.sem(values))
    assert interval(values, range(7)) == pytest.approx(wanted)
    wanted = stats.t.interval(0.8, 6, values.mean(), stats.sem(values))
    assert interval(values, range(7), 0.8) == pytest.approx(wanted)


def test_groups_of_one_size_count_by_their_means_in_any_order():
    values = np.array([1.0, 5.0, 1.2, 5.2, 2.0, 2.2])
    means = np.array([1.1, 5.1, 2.1])
    wanted = stats.t.interval(0.95, 2, means.mean(), stats.sem(means))
    assert interval(values, ["x", "y", "x", "y", "z", "z"]) == pytest.approx(wanted)
    assert interval(values[::-1], ["z", "z", "y", "x", "y", "x"]) == pytest.approx(wanted)


def test_where_there_is_none():
    values = np.array([1.0, 5.0, 1.2, 5.2])
    assert interval(values, ["x"] * 4) is None
    assert interval(values[:0], []) is None
    assert interval(np.array([1.0, np.inf]), "xy") is None
    assert interval(np.array([1e308, -1e308, 1e308]), "xyz") is None


@pytest.mark.parametrize("groups", [2, 3, 6, 10])
def test_it_covers_the_mean_as_often_as_it_says(groups):
    """Walks of one person are alike. A percentile bootstrap over groups misses the mean in 50, 25,
    15 and 10 % of the cases."""
    random, missed, trials = np.random.default_rng(groups), 0, 1000
    names = np.repeat(np.arange(groups), 4)
    for _ in range(trials):
        people = random.normal(0.0, 1.0, groups)
        low, high = interval(people[names] + 0.5 * random.normal(size=len(names)), names)
        missed += not low <= 0.0 <= high
    assert 0.03 < missed / trials < 0.07
