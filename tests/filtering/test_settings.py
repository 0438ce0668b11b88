"""The filter that the settings of an experiment describe."""

import dataclasses

from gnio_jax import filtering
from gnio_jax.config import DataConfig, FilterSettings


def test_the_settings_defaults_are_those_of_the_filter():
    setup = filtering.filter_setup(DataConfig(), FilterSettings())
    config, noise, initial_std, considered, raw_gyro_bias = setup
    assert considered is None and raw_gyro_bias is None
    usual = filtering.FilterConfig(config.dt, config.samples_per_clone, config.clones_per_window)
    assert config == dataclasses.replace(usual, history="core")
    assert noise == filtering.NoiseModel() and initial_std == filtering.InitialStd()
