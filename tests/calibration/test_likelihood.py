"""Fitted options against the noises that simulated walks were made with, and the gradient against
differences."""

import dataclasses

import jax
import numpy as np
import pytest

from gnio_jax.calibration import likelihood
from gnio_jax.calibration.likelihood import fit, free_vector, innovation_objective
from gnio_jax.calibration.unknowns import GROUPS, check_fittable, chosen, with_starts
from gnio_jax.config import FilterOptions
from gnio_jax.errors import InputError
from gnio_jax.filtering.options import filter_setup, filter_with, switches_and_numbers
from gnio_jax.filtering.unconstrained import natural, with_numbers
from tests.support.calibration_walks import DATA, STRIDES, TRUE, N, first_strides, walks
from tests.support.compiling import lightly_optimised, quick

UNKNOWNS = (*chosen(("measurement",)), *GROUPS["noise"][:2])
"""Of every fit here: one program serves them all."""
SEARCH = lightly_optimised(
    likelihood._value_and_gradient, static_argnames=("windows", "switches", "unknowns")
)
"""A search runs it some thirty times."""


@pytest.fixture(scope="module", autouse=True)
def search():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(likelihood, "_value_and_gradient", SEARCH)
        yield


def test_the_noises_of_simulated_walks_are_found():
    wrong = dataclasses.replace(TRUE, gyro_density=3e-4, accel_density=2e-1)
    found = fit(walks(), DATA, wrong, UNKNOWNS, lambda calls: None)
    assert found.after < found.before - 0.1
    assert found.options.measurement_scale == pytest.approx(9.0, rel=0.15)
    assert found.options.gyro_density == pytest.approx(2e-3, rel=0.4)
    assert found.options.accel_density == pytest.approx(2e-2, rel=0.4)


def test_the_gradient_is_that_of_the_likelihood():
    unknowns = chosen(tuple(GROUPS))
    options = with_starts(TRUE, unknowns)
    two = jax.tree.map(lambda rows: rows[:2], first_strides(walks(), 110))
    both = quick(
        jax.value_and_grad(innovation_objective(two, DATA, options, unknowns), has_aux=True)
    )
    free = free_vector(options, unknowns)
    gradient = np.asarray(both(free)[1])
    assert (gradient != 0).all()
    for i, step in enumerate(1e-4 * np.eye(len(free))):
        ahead, behind = (float(both(free + off)[0][0]) for off in (step, -step))
        np.testing.assert_allclose(gradient[i], (ahead - behind) / 2e-4, rtol=1e-3, atol=1e-7)


def test_a_second_calibration_compiles_nothing():
    """Of other walks, with other factors of the axes and another start."""
    given = walks()
    fit(given, DATA, TRUE, UNKNOWNS, lambda calls: None, most_steps=1)
    programs = SEARCH._cache_size()
    others = given._replace(displacement=1.01 * given.displacement)
    options = dataclasses.replace(TRUE, std_factor_x=0.7, velocity_std=0.2)
    fit(others, DATA, options, UNKNOWNS, lambda calls: None, most_steps=1)
    assert programs > 0 and SEARCH._cache_size() == programs


@pytest.mark.parametrize("share", [0.0, 0.8])
def test_switches_and_numbers_make_the_filter_of_the_options(share):
    options = dataclasses.replace(
        TRUE,
        measurement_scale=2.5,
        window_error_share=share,
        mahalanobis_fail_scale=3.0,
        considered_scale_std=0.1,
        std_factor_z=0.5,
    )
    switches, numbers = switches_and_numbers(options)
    other = dataclasses.replace(options, velocity_std=0.123, considered_scale_std=0.0)
    assert switches_and_numbers(other)[0] == switches
    found, wanted = filter_with(DATA, switches, numbers), filter_setup(DATA, options)
    assert found.config == dataclasses.replace(wanted.config, measurement_scale=1.0)
    factors = np.sqrt(2.5) * np.array(wanted.noise.std_factor)
    np.testing.assert_allclose(found.noise.std_factor, factors, rtol=1e-12)
    assert found.noise._replace(std_factor=None) == wanted.noise._replace(std_factor=None)
    assert found.initial_std == wanted.initial_std
    assert (found.noise.displacement is None) == (share == 0)


def test_unknowns_go_to_numbers_without_bounds_and_back():
    unknowns = chosen(tuple(GROUPS))
    options = with_starts(dataclasses.replace(TRUE, window_error_seconds=0.7), unknowns)
    assert options.window_error_share == 0.8 and options.window_error_seconds == 0.7
    back = natural(dict(zip(unknowns, free_vector(options, unknowns), strict=True)))
    for name in unknowns:
        np.testing.assert_allclose(back[name], getattr(options, name), rtol=1e-12)
    number = {"gyro_density": np.log(1.23456)}
    found = with_numbers(FilterOptions(measurement_scale=3.0), number, 4)
    assert found == FilterOptions(measurement_scale=3.0, gyro_density=1.235)


def test_what_is_switched_off_and_has_no_start_cannot_be_fitted():
    off = dataclasses.replace(TRUE, gyro_bias_std=0.0)
    check_fittable(off, chosen(("noise", "window", "walk")))
    with pytest.raises(InputError, match=r"filter.gyro_bias_std: is 0 .*leave its group out"):
        check_fittable(off, chosen(("start",)))


def test_a_walk_may_be_filled_up_and_a_filter_that_fails_is_named():
    given, known = walks(), STRIDES - 40
    push = np.array([90.0, 0.0, 9.81])  # to 360 m/s, beyond the filter's bound
    after, nothing = (
        np.arange(N * STRIDES)[:, None] >= N * known,
        np.arange(STRIDES)[:, None] >= known,
    )
    falling = given._replace(
        gyro=np.where(after, 0.0, given.gyro),
        accel=np.where(after, push, given.accel),
        displacement=np.where(nothing, np.nan, given.displacement),
        std=np.where(nothing, 1.0, given.std),
    )
    short = first_strides(given, known)
    free = free_vector(TRUE, UNKNOWNS)
    alone = quick(innovation_objective(short, DATA, TRUE, UNKNOWNS))(free)[1]
    filled = fit(falling, DATA, TRUE, UNKNOWNS, lambda calls: None, most_steps=1).before
    np.testing.assert_allclose(filled, alone, rtol=1e-9)
    broken = given._replace(
        accel=np.where(np.arange(STRIDES * N)[:, None] == 900, 1e6, given.accel)
    )
    with pytest.raises(InputError, match="the filter: fails on these recordings"):
        fit(broken, DATA, TRUE, UNKNOWNS, lambda calls: None)
