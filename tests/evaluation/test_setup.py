"""Choices of an evaluation, and the filter they give."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import evaluation, filtering
from gnio_jax.config import DataConfig, FilterOptions
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Setup
from gnio_jax.filtering.displacement import scaled_measurement
from gnio_jax.filtering.options import filter_with
from tests.support.estimators import CONFIG, LOOSE


def test_setups_that_make_no_sense(walks):
    for setup in (Setup(orientation="reference"), Setup("imu_only", orientation="device")):
        with pytest.raises(InputError, match="leave it out"):
            evaluation.resolve(setup)
    assert (
        evaluation.resolve(Setup()).orientation == "filter"
        and evaluation.resolve(LOOSE).orientation == "reference"
    )
    with pytest.raises(InputError, match="no device orientation"):
        evaluation.prepare(
            [walks[0]._replace(device_orientation=None)],
            CONFIG,
            Setup("integrate", orientation="device"),
        )


def test_the_options_defaults_are_those_of_the_filter():
    config, noise, initial_std, considered = evaluation.filter_setup(DataConfig(), FilterOptions())
    assert considered is None
    usual = filtering.FilterConfig(config.dt, config.samples_per_clone, config.clones_per_window)
    assert config == dataclasses.replace(usual, history="core")
    assert noise == filtering.NoiseModel() and initial_std == filtering.InitialStd()


def test_a_filter_with_other_values_is_the_one_with_those_options():
    values = {"measurement_scale": 4.0, "std_factor_y": 1.5, "gyro_density": 0.01}
    values |= {"velocity_std": 0.3, "window_error_share": 0.8}
    wanted = evaluation.filter_setup(DataConfig(), FilterOptions(**values))
    found = filter_with(DataConfig(), FilterOptions(), values)
    assert dataclasses.replace(found.config, measurement_scale=4.0) == wanted.config
    assert found.noise._replace(std_factor=wanted.noise.std_factor) == wanted.noise
    assert found.initial_std == wanted.initial_std
    displacement, covariance = jnp.ones(3), jnp.diag(jnp.array([1.0, 2.0, 3.0]))
    ours, theirs = (
        scaled_measurement(displacement, covariance, each.config, each.noise).covariance
        for each in (found, wanted)
    )
    np.testing.assert_allclose(ours, theirs, rtol=1e-12)
