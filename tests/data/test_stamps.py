"""Stamps that come late, twice, or not at all."""

import numpy as np
import pytest

from gnio_jax.data.parsing.stamps import in_order
from gnio_jax.errors import InputError


def test_of_rows_that_share_a_stamp_the_first_is_taken():
    time, values = np.array([0.0, 0.2, 0.1, 0.1, 0.3]), np.arange(5.0)[:, None]
    rows, counts = in_order(time, values, "walk.csv")
    assert rows.tolist() == [0, 2, 1, 4]
    assert counts == {"rows_sorted": 1.0, "rows_repeated": 1.0}
    rows, counts = in_order(np.sort(time), np.zeros((5, 1)), "walk.csv")
    assert rows.tolist() == [0, 1, 3, 4] and counts == {"rows_repeated": 1.0}
    rows, counts = in_order(np.arange(5.0), values, "walk.csv")
    assert rows.tolist() == [0, 1, 2, 3, 4] and counts == {}
    with pytest.raises(InputError, match=r"gives 2 of 5 rows the same stamp as another row with"):
        in_order(np.array([0.0, 0.0, 0.0, 0.1, 0.2]), values, "walk.csv")
