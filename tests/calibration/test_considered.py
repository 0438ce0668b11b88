"""Errors that are to be considered, found in positions that were drawn with them."""

import dataclasses

import numpy as np
import pytest

from gnio_jax.calibration import considered
from gnio_jax.config import FilterOptions
from gnio_jax.errors import InputError
from tests.support.calibration_walks import DATA, TRUE, first_strides, walks_with_truth


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


def nees(found):
    """Mean over all positions of eᵀ P⁻¹ e / 3."""
    return (
        np.einsum("ki,kij,kj->k", found.error, np.linalg.inv(found.covariance), found.error).mean()
        / 3
    )


def test_positions_are_compared_with_the_truth_of_their_time():
    """Of simulated walks that are as the filter has them: their errors are those it reports, but
    against the truth of a stride later they are not. A filter that fails is left out."""
    walks, truth = walks_with_truth()
    walks, truth = first_strides(walks, 125), truth[:, :125]
    options = dataclasses.replace(TRUE, measurement_scale=9.0)  # σ is three times what is said
    truth[0, 50:] = np.nan
    found = considered.filtered_positions(walks, truth, DATA, options)
    assert len(found.error) == np.isfinite(truth).all(2).sum()
    assert nees(found) == pytest.approx(1, abs=0.5)
    later = np.roll(truth, -1, axis=1)
    off = considered.filtered_positions(walks, later, DATA, options)
    assert nees(off) > 3 * nees(found)
    accel = walks.accel.copy()
    accel[1, 100:] += 1e4
    broken = considered.filtered_positions(walks._replace(accel=accel), truth, DATA, options)
    assert len(broken.error) < len(found.error) - 75 and np.abs(broken.error).max() < 50


def test_no_positions_and_no_likelihood_are_named():
    none = considered.Positions(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 6)))
    with pytest.raises(InputError, match="not healthy where these recordings have a reference"):
        considered.fit_considered(none, 0.1, FilterOptions())
    lost = considered.Positions(np.ones((9, 3)), np.full((9, 3, 3), np.nan), np.ones((9, 3, 6)))
    with pytest.raises(InputError, match="a covariance on these recordings that is not one"):
        considered.fit_considered(lost, 0.1, FilterOptions())
