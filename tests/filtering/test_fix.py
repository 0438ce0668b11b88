"""Fixes of position as they are laid onto intervals and refused."""

import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.errors import InputError

INTERVALS, LENGTH = 40, 0.1
CONFIG = filtering.FilterConfig(0.02, 5, 4)


def test_each_lies_in_the_interval_whose_end_is_nearest():
    """Of 0.1 s; one before the middle of the first interval lies in that."""
    time, rows = [5.02, 5.44, 5.46, 9.0, 6.2], [0, 3, 4, 39, 11]
    position = np.arange(10.0).reshape(5, 2)
    covariance = np.arange(1, 6)[:, None, None] * np.array([[2.0, 0.5], [0.5, 1.0]])
    fix = filtering.fixes_on_intervals(time, position, covariance, INTERVALS, CONFIG, 5.0, 0.3)
    assert np.flatnonzero(np.isfinite(fix.position).all(1)).tolist() == sorted(rows)
    np.testing.assert_array_equal(fix.position[rows], position)
    np.testing.assert_array_equal(fix.covariance[rows], covariance)
    ends = 5.0 + LENGTH * (np.array(rows) + 1)
    np.testing.assert_allclose(fix.before_end[rows], ends - time, atol=1e-12)
    np.testing.assert_array_equal(fix.time_std[rows], 0.3)
    assert np.isfinite(fix.before_end).all() and np.isfinite(fix.time_std).all()


def test_two_in_an_interval_become_one():
    """The same as one after the other for a filter at a constant velocity, where their covariances
    are of one shape: the information is the sum, and so is what it says of p − a v."""
    shape = np.array([[0.4, 0.1, 0.0], [0.1, 0.3, 0.0], [0.0, 0.0, 0.2]])
    time, size = [0.98, 1.03], np.array([1.0, 3.0])
    position, covariance = np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 5.0]]), size[:, None, None] * shape
    fix = filtering.fixes_on_intervals(time, position, covariance, INTERVALS, CONFIG)
    assert np.isfinite(fix.position).all(1).sum() == 1
    np.testing.assert_allclose(fix.covariance[9], shape / (1 + 1 / 3))
    np.testing.assert_allclose(fix.position[9], [1.25, 2.0, 3.5])
    np.testing.assert_allclose(fix.before_end[9], 0.75 * 0.02 - 0.25 * 0.03)


OUTSIDE, SHAPES = "are outside of the recording, one at ", "time, position and covariance must be"
NOT_POSITIVE = "a covariance is not finite, symmetric and positive definite"


@pytest.mark.parametrize(
    "change, text",
    [
        (dict(time=[0.5, 99.0]), f"1 of 2 {OUTSIDE}99 s; it lasts"),
        (dict(time=[0.5, np.nan]), f"1 of 2 {OUTSIDE}nan s"),
        (dict(time=[0.5]), SHAPES),
        (dict(position=np.zeros((2, 3))), SHAPES),
        (dict(time_std=[0.1, -0.1]), "time_std must be at least 0"),
        (dict(time_std=[0.1, 0.1, 0.1]), "time_std must be one or"),
        (dict(threshold=np.nan), "threshold must be above 0, found nan"),
        (dict(covariance=np.zeros((2, 2, 2))), NOT_POSITIVE),
        (dict(covariance=np.array([np.eye(2), [[1.0, 0.5], [0.0, 1.0]]])), NOT_POSITIVE),
    ],
)
def test_what_is_no_fix_is_refused_in_one_line(change, text):
    eyes = np.tile(np.eye(2), (2, 1, 1))
    good = {"time": [0.5, 1.0], "position": np.zeros((2, 2)), "covariance": eyes}
    with pytest.raises(InputError, match=f"^fixes: {text}") as caught:
        filtering.fixes_on_intervals(**(good | change), intervals=INTERVALS, config=CONFIG)
    assert "\n" not in str(caught.value)
