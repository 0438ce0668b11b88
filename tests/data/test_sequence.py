import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.data import sequence as seq


@pytest.mark.parametrize("count", [1, 2, 7, 16])
def test_cumulative_rotation_against_a_loop(count):
    turns = Rotation.random(count, random_state=3)
    product, expected = np.eye(3), []
    for turn in turns.as_matrix():
        product = product @ turn
        expected.append(product)
    np.testing.assert_allclose(seq.cumulative_rotation(turns).as_matrix(), expected, atol=1e-12)
