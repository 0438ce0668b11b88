"""The filter that the settings of an experiment describe, and its numbers as free parameters."""

import dataclasses

import jax
import numpy as np
import pytest

from gnio_jax import config as configuration
from gnio_jax import filtering
from gnio_jax.config import DataConfig, FilterSettings, TrainConfig
from gnio_jax.filtering.settings import (
    FIXED,
    filter_config,
    free_parameters,
    is_below,
    with_free_parameters,
    with_written_parameters,
)
from tests.support.filter_settings import changed


def test_free_parameters_and_back():
    """Logarithms, and a share's logit; with a derivative; what is 0 is not there."""
    correlation = filtering.CorrelatedError(share=0.25, seconds=2.0)
    settings = changed(noise={"correlation": correlation, "gyro_bias_walk": 0.0})
    free = free_parameters(settings, ["noise", "start.gyro_bias"])
    assert {"noise.gyro_density", "noise.std_factor.0", "start.gyro_bias"} <= free.keys()
    assert "noise.gyro_bias_walk" not in free and "start.tilt" not in free
    np.testing.assert_allclose(free["noise.correlation.share"], np.log(1 / 3))
    np.testing.assert_allclose(free["noise.correlation.seconds"], np.log(2.0))
    again = with_free_parameters(settings, free)
    jax.tree.map(np.testing.assert_allclose, again, settings)
    slope = jax.grad(
        lambda u: with_free_parameters(settings, {"noise.correlation.share": u}).noise[6][0]
    )
    np.testing.assert_allclose(slope(np.log(1 / 3)), 0.25 * 0.75)


def test_the_mounting_and_the_lever_may_be_zero_or_negative():
    numbers = {"lateral_std": 0.5, "yaw": 0.0, "pitch": -0.02, "lever_z": -0.6}
    settings = FilterSettings(measurements={"nonholonomic": numbers})
    free = free_parameters(settings, ["measurements"])
    names = {name.rpartition(".")[2]: value for name, value in free.items()}
    np.testing.assert_allclose(names["lateral_std"], np.log(0.5))
    assert names["yaw"] == 0 and names["lever_z"] == -0.6 and names.keys() == numbers.keys()
    assert with_written_parameters(settings, free, 5) == settings
    moved = with_written_parameters(settings, {"measurements.nonholonomic.yaw": -0.2}, 5)
    assert moved.measurements["nonholonomic"]["yaw"] == -0.02


def test_what_a_filter_does_not_have_is_left_out():
    """Errors without a size, and measurements without numbers."""
    ekf = filtering.make_filter(DataConfig(), FilterSettings(measurements={"zero_velocity": None}))
    assert ekf.considered is None and ekf.measurements == ()
    settings = changed(considered={"slope": 0.1})
    assert filtering.make_filter(DataConfig(), settings).considered == filtering.ConsideredStd(
        slope=0.1
    )


def test_a_section_is_named_whole():
    """And not by the beginning of a name."""
    settings = FilterSettings()
    assert free_parameters(settings, ["noise.gyro"]) == {}
    assert free_parameters(settings, ["start.gyro_bias"]).keys() == {"start.gyro_bias"}
    assert is_below("noise.std_factor.0", "noise.std_factor")
    assert is_below("noise.gyro_density", "noise.gyro_density")
    assert not is_below("noise.gyro_density", "noise.gyro")


def test_written_numbers_are_rounded_and_a_share_stays_below_1():
    correlation = filtering.CorrelatedError(share=0.5, seconds=2.0)
    settings = changed(noise={"correlation": correlation})
    free = {
        "noise.correlation.share": 12.0,  # its logit: the share is 0.999994
        "noise.correlation.seconds": np.log(1.23456),
        "noise.gyro_density": np.log(7.6543e-4),
    }
    noise = with_written_parameters(settings, free, 3).noise
    assert noise.correlation == (0.9999, 1.23) and noise.gyro_density == 7.65e-4
    assert noise.accel_density == settings.noise.accel_density
    share = with_written_parameters(settings, {"noise.correlation.share": 0.1234}, 3)
    assert share.noise.correlation == (0.531, 2.0)


@pytest.mark.parametrize("fitted, written", [(-30.0, 1e-6), (30.0, 1e6), (0.0, 1.0)])
def test_a_factor_that_no_error_bounds_is_written_as_a_file_takes_it(fitted, written):
    """Displacements without any error make the likelihood of a factor grow to 0."""
    names = ["noise.measurement_scale", *(f"noise.std_factor.{axis}" for axis in range(3))]
    settings = with_written_parameters(FilterSettings(), dict.fromkeys(names, fitted), 4)
    assert settings.noise.measurement_scale == written
    assert settings.noise.std_factor == (written,) * 3
    configuration.validate(TrainConfig(filter=settings))


def test_every_setting_of_the_filter_is_reachable_from_a_file_or_fixed_by_name():
    """And a value that a file gives is the value that the filter has."""
    options = {field.name for field in dataclasses.fields(FilterSettings)}
    fields = {field.name for field in dataclasses.fields(filtering.FilterConfig)}
    assert fields == (options & fields) | FIXED.keys() and not options & FIXED.keys()
    others = {
        **{name: 0.4 for name in ("success_seconds", "pause_seconds", "rest_seconds")},
        **{"rest_test_seconds": 2.0},
        **{name: 0.25 for name in ("rest_gyro", "rest_accel", "bridge_seconds")},
        **{name: 0.75 for name in ("gap_gyro_std", "gap_accel_std", "low_pass_seconds")},
        **{"gate_threshold": 7.0, "convergence_seconds": 3.0},
        **{"log_std_min": -5.0, "speed_limit": 9.0},
        **{"error": "additive", "window_rotation": "single", "measures": "velocity"},
        **{"rest_by": "means"},
    }
    assert others.keys() | {"mahalanobis_fail_scale"} == options & fields
    config = filter_config(DataConfig(), FilterSettings(**others))
    assert {name: getattr(config, name) for name in others} == others
    scaled = FilterSettings(mahalanobis_fail_scale=8.0)
    assert filter_config(DataConfig(), scaled).mahalanobis_fail_scale == 8.0
    assert filter_config(DataConfig(), FilterSettings()).invariant
    assert not filter_config(DataConfig(), FilterSettings(window_rotation="tlio")).invariant
