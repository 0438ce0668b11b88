"""Errors that are to be considered, found in positions that were drawn with them."""

import numpy as np
import pytest

from gnio_jax.calibration import considered
from gnio_jax.config import FilterOptions


def test_what_the_errors_were_drawn_with_is_found():
    rng = np.random.default_rng(0)
    rows = 4000
    root = 0.1 * rng.standard_normal((rows, 3, 3)) + 0.3 * np.eye(3)
    covariance = root @ root.transpose(0, 2, 1)
    # Metres for a unit of each: bias rad/s, log scale, heading rad, slope.
    sensitivity = rng.standard_normal((rows, 3, 6)) * [200.0, 200.0, 5.0, 5.0, 5.0, 40.0]
    wanted = np.array([2e-3, 2e-3, 2e-3, 0.1, np.deg2rad(8.0), 0.01])
    drawn = np.einsum("kij,kj->ki", root, rng.standard_normal((rows, 3)))
    error = drawn + np.einsum("kic,kc->ki", sensitivity, wanted * rng.standard_normal((rows, 6)))
    positions = considered.Positions(error, covariance, sensitivity)
    options = FilterOptions(considered_scale_std=0.7)  # of an earlier calibration
    found = considered.fit_considered(positions, 0.1, options)
    assert found.before > 2 and found.after == pytest.approx(1, abs=0.05)
    assert found.options.considered_gyro_bias_std == pytest.approx(2e-3, rel=0.1)
    assert found.options.considered_scale_std == pytest.approx(0.1, rel=0.1)
    assert found.options.considered_heading_std_degrees == pytest.approx(8.0, rel=0.1)
    assert found.options.considered_slope_std == pytest.approx(0.01, rel=0.1)
