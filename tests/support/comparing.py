"""Comparisons that hold on every processor."""

import numpy as np


def assert_close_in_size(actual, desired, tolerance):
    """No component is off by more than this share of the largest one.

    Sums in float32 round in another order on every processor, and by the sizes of their terms. So
    what is left of a small component says nothing, however right the sum is.

    Raises:
        AssertionError: otherwise, or if `desired` is zero throughout, which has no size.
    """
    largest = np.abs(desired).max()
    assert largest > 0, "nothing to compare with"
    np.testing.assert_allclose(actual, desired, rtol=0, atol=tolerance * largest)
