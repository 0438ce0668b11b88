"""Choices of an evaluation, and the filter they give."""

import dataclasses

import pytest

from gnio_jax import evaluation, filtering
from gnio_jax.config import DataConfig, FilterSettings
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Setup
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
    config, noise, initial_std, considered = evaluation.filter_setup(DataConfig(), FilterSettings())
    assert considered is None
    usual = filtering.FilterConfig(config.dt, config.samples_per_clone, config.clones_per_window)
    assert config == dataclasses.replace(usual, history="core")
    assert noise == filtering.NoiseModel() and initial_std == filtering.InitialStd()
