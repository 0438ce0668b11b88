"""Fitted settings against the noises that simulated walks were made with and the errors that
positions were drawn with, and the gradient against differences."""

import dataclasses
import functools
import re

import jax
import numpy as np
import pytest

from gnio_jax.calibration import fit as fitting
from gnio_jax.calibration.fit import (
    CONSIDERED,
    GROUPS,
    Positions,
    filtered_positions,
    fit_considered,
    innovation_config,
    innovation_objective,
    start_of_fit,
    unphysical,
)
from gnio_jax.calibration.fit import fit_innovations as fit
from gnio_jax.config import CalibrateConfig, CorrelatedError, FilterSettings
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Displacements
from gnio_jax.filtering.settings import free_parameters
from gnio_jax.filtering.state import GYRO_BIAS
from tests.support.calibration_walks import (
    DATA,
    STRIDES,
    TRUE,
    N,
    first_strides,
    walks,
    walks_with_truth,
)
from tests.support.compiling import lightly_optimised, quick
from tests.support.filter_settings import changed

PATHS = (*GROUPS["measurement"], *GROUPS["noise"][:2])
"""Of every fit here: one program serves them all."""
SEARCH = lightly_optimised(fitting._value_and_gradient, static_argnames=("names", "config"))
"""A search runs it some thirty times."""


@pytest.fixture(scope="module", autouse=True)
def search():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitting, "_value_and_gradient", SEARCH)
        yield


def start(settings, paths):
    return np.array(list(free_parameters(settings, paths).values()))


def objective(given, settings, paths, of=lambda function: function):
    """The objective of a fit of these walks, as a function of the free parameters."""
    names = tuple(free_parameters(settings, paths))
    function = functools.partial(
        innovation_objective, names=names, config=innovation_config(DATA, settings)
    )
    compiled = quick(of(function))
    return lambda free: compiled(free, given, start(settings, paths), settings)


def test_the_noises_of_simulated_walks_are_found():
    wrong = changed(TRUE, noise={"gyro_density": 3e-4, "accel_density": 2e-1})
    found = fit(walks(), DATA, wrong, PATHS, lambda calls: None)
    assert found.after < found.before - 0.1
    assert found.settings.noise.measurement_scale == pytest.approx(9.0, rel=0.15)
    assert found.settings.noise.gyro_density == pytest.approx(2e-3, rel=0.4)
    assert found.settings.noise.accel_density == pytest.approx(2e-2, rel=0.4)
    assert found.warnings == () and found.steps < 60


def test_the_gradient_is_that_of_the_likelihood():
    """Of the numbers that the searches here fit; those of a correlated error and of the start are
    differentiated in `filtering/test_derivatives`."""
    names, config = tuple(free_parameters(TRUE, PATHS)), innovation_config(DATA, TRUE)
    free = start(TRUE, PATHS)

    def at(free):
        return jax.device_get(
            SEARCH(free, walks(), start(TRUE, PATHS), TRUE, names=names, config=config)
        )

    gradient = np.asarray(at(free)[1])
    assert (gradient != 0).all()
    for i, step in enumerate(1e-4 * np.eye(len(free))):
        ahead, behind = (float(at(free + off)[0][0]) for off in (step, -step))
        np.testing.assert_allclose(gradient[i], (ahead - behind) / 2e-4, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize(("raw", "expected"), [(True, 0.05), (False, 1e-3)])
def test_a_raw_gyro_keeps_the_wide_start_that_its_walk_was_prepared_with(raw, expected):
    """Every other walk starts as the settings say, whatever it was prepared with."""
    settings = dataclasses.replace(TRUE, raw_gyro_bias=0.05)
    walk = jax.tree.map(lambda leaf: leaf[0], walks())
    walk = walk._replace(start=walk.start._replace(raw_gyro=np.bool_(raw)))
    _, state, _ = fitting._repeated(walk, settings, innovation_config(DATA, settings))
    found = np.sqrt(np.diag(state.core_covariance))[GYRO_BIAS]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_second_calibration_compiles_nothing_and_a_fit_that_ends_early_is_told():
    """Of other walks, with other factors of the axes and another start."""
    given = walks()
    first = fit(given, DATA, TRUE, PATHS, lambda calls: None, most_steps=1)
    (warning,) = first.warnings
    assert warning.startswith("the fit stopped after 1 steps, ") and "--fit" in warning
    options = {f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(CalibrateConfig)}
    assert set(re.findall(r"--[a-z-]+", warning)) <= options  # no remedy that there is not
    programs = SEARCH._cache_size()
    others = given._replace(given=given.given._replace(value=1.01 * given.given.value))
    settings = changed(TRUE, noise={"std_factor": (0.7, 1.0, 1.0)}, start={"velocity": 0.2})
    fit(others, DATA, settings, PATHS, lambda calls: None, most_steps=1)
    assert programs > 0 and SEARCH._cache_size() == programs


def test_values_outside_what_is_physical_are_named():
    noise = {"accel_bias_walk": 2.656, "correlation": CorrelatedError(0.9999, 5.9e4)}
    names = ("noise.gyro_density", "noise.accel_bias_walk", "noise.correlation.share")
    told = unphysical(changed(TRUE, noise=noise), (*names, "noise.correlation.seconds"))
    assert [line.split(" came out as ")[0] for line in told] == [
        "filter.noise.accel_bias_walk",
        "filter.noise.correlation.share",
        "filter.noise.correlation.seconds",
    ]
    assert "5.9e+04, outside 0.05 to 60: these recordings do not determine it" in told[2]


def test_what_is_switched_off_and_has_no_start_cannot_be_fitted():
    off = changed(TRUE, start={"gyro_bias": 0.0})
    begun = start_of_fit(off, (*GROUPS["noise"], *GROUPS["window"]))
    assert begun.noise.correlation == CorrelatedError(0.8, 0.5)
    own = changed(TRUE, noise={"correlation": CorrelatedError(0.3, 0.7)})
    assert start_of_fit(own, GROUPS["window"]) == own
    with pytest.raises(InputError, match=r"filter.start.gyro_bias: is 0 .*leave its group out"):
        start_of_fit(off, GROUPS["start"])


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
        given=Displacements(
            np.where(nothing, np.nan, given.given.value), np.where(nothing, 1.0, given.given.std)
        ),
    )
    short = first_strides(given, known)
    alone = objective(short, TRUE, PATHS)(start(TRUE, PATHS))[1]
    filled = fit(falling, DATA, TRUE, PATHS, lambda calls: None, most_steps=1).before
    np.testing.assert_allclose(filled, alone, rtol=1e-9)
    broken = given._replace(
        accel=np.where(np.arange(STRIDES * N)[:, None] == 900, 1e6, given.accel)
    )
    with pytest.raises(InputError, match="the filter: fails on these recordings"):
        fit(broken, DATA, TRUE, PATHS, lambda calls: None)


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
    positions = Positions(error, covariance, sensitivity)
    options = changed(considered={"scale": 0.7})  # of an earlier calibration
    found = fit_considered(positions, 0.1, options)
    assert found.before > 2 and found.after == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(
        found.settings.considered, [2e-3, 0.1, np.deg2rad(8.0), 0.01], rtol=0.1
    )


def test_the_prior_counts_as_many_independent_errors_as_there_are():
    """Of positions that say nothing of an error: its std stays where the search begins. Of few that
    do, it lies between that and what they say, as far as Bayes' rule has it."""
    rows, stride = 400, 0.1  # 40 s: four independent errors
    error = np.zeros((rows, 3))
    error[:, 0] = 0.3 * np.where(np.arange(rows) % 2, 1.0, -1.0)
    covariance, sensitivity = np.tile(1e-4 * np.eye(3), (rows, 1, 1)), np.zeros((rows, 3, 6))
    sensitivity[:, 0, 5] = 1.0  # the slope alone, in metres for a unit
    found = fit_considered(Positions(error, covariance, sensitivity), stride, FilterSettings())
    for name in ("gyro_bias", "scale", "heading"):
        assert getattr(found.settings.considered, name) == pytest.approx(
            getattr(CONSIDERED, name), rel=1e-3
        )

    def negative_log_posterior(log_std):
        variance = 1e-4 + np.exp(2 * log_std)
        likelihood = 4 * 0.5 * (0.3**2 / variance + np.log(variance))
        return likelihood + 0.5 * ((log_std - np.log(CONSIDERED.slope)) / 2.0) ** 2

    grid = np.linspace(np.log(0.05), np.log(0.5), 20001)
    wanted = np.exp(grid[np.argmin(negative_log_posterior(grid))])
    assert wanted < 0.28  # what the positions alone would say is 0.3
    assert found.settings.considered.slope == pytest.approx(wanted, rel=2e-3)


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
    options = changed(TRUE, noise={"measurement_scale": 9.0})  # σ is three times what is said
    truth[0, 50:] = np.nan
    found = filtered_positions(walks, truth, DATA, options)
    assert len(found.error) == np.isfinite(truth).all(2).sum()
    assert nees(found) == pytest.approx(1, abs=0.5)
    later = np.roll(truth, -1, axis=1)
    off = filtered_positions(walks, later, DATA, options)
    assert nees(off) > 3 * nees(found)
    accel = walks.accel.copy()
    accel[1, 100:] += 1e4
    broken = filtered_positions(walks._replace(accel=accel), truth, DATA, options)
    assert len(broken.error) < len(found.error) - 75 and np.abs(broken.error).max() < 50
    raw = np.arange(len(truth)) == 0  # a walk that is left out, unless all are alike
    for flag, shown in ((raw, truth[1:]), (raw | True, truth)):
        marked = walks._replace(start=walks.start._replace(raw_gyro=flag))
        known = filtered_positions(marked, truth, DATA, options)
        assert len(known.error) == np.isfinite(shown).all(axis=2).sum()


def test_no_positions_and_no_likelihood_are_named():
    none = Positions(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 6)))
    with pytest.raises(InputError, match="not healthy where these recordings have a reference"):
        fit_considered(none, 0.1, FilterSettings())
    lost = Positions(np.ones((9, 3)), np.full((9, 3, 3), np.nan), np.ones((9, 3, 6)))
    with pytest.raises(InputError, match="no positive definite covariance"):
        fit_considered(lost, 0.1, FilterSettings())
