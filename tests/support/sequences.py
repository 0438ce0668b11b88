"""Two sequences compared, array by array."""

import numpy as np


def assert_same_arrays(found, expected):
    """Every array of a `types.Sequence`, to the bit."""
    for name in set(found._fields) - {"name", "attributes"}:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
