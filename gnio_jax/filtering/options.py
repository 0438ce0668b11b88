"""The filter that an experiment's options describe."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from gnio_jax.config import DataConfig, FilterOptions
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.lasting_errors import LastingErrors
from gnio_jax.filtering.noise import InitialStd, NoiseModel

_RADIANS = math.pi / 180


class FilterSetup(NamedTuple):
    """A filter as the options ask for it."""

    config: FilterConfig
    noise: NoiseModel
    initial_std: InitialStd


def filter_setup(windows: DataConfig, options: FilterOptions) -> FilterSetup:
    """The filter for the windows and strides that a network was trained with."""
    config = FilterConfig(
        dt=1.0 / windows.rate,
        samples_per_clone=windows.stride,
        clones_per_window=windows.window // windows.stride,
        mahalanobis_fail_scale=options.mahalanobis_fail_scale,
        measurement_scale=options.measurement_scale,
        history="core",
        window_rotation=options.window_rotation or windows.window_rotation,
    )
    values = vars(options)
    return FilterSetup(config, noise_model(values, errors_last(options)), initial_std(values))


def errors_last(options: FilterOptions) -> bool:
    """Whether any error of the displacements lasts beyond its window."""
    return any(
        (options.window_error_share, options.scale_error_std, options.heading_error_std_degrees)
    )


def noise_model(values: Mapping[str, Any], lasting: bool) -> NoiseModel:
    """The noise of `FilterOptions`' fields by name, numbers or arrays; differentiable. `lasting`:
    the displacements have errors that last."""
    names = ("gyro_density", "accel_density", "gyro_bias_walk", "accel_bias_walk")
    errors = _lasting_errors(values) if lasting else None
    return NoiseModel(**{name: values[name] for name in names}, displacement=errors)


def _lasting_errors(values: Mapping[str, Any]) -> LastingErrors:
    return LastingErrors(
        window_share=values["window_error_share"],
        window_seconds=values["window_error_seconds"],
        scale_std=values["scale_error_std"],
        heading_std=values["heading_error_std_degrees"] * _RADIANS,
        walk_seconds=values["walk_error_seconds"],
    )


def initial_std(values: Mapping[str, Any]) -> InitialStd:
    """The uncertainty of the start from `FilterOptions`' fields by name, numbers or arrays;
    differentiable."""
    return InitialStd(
        tilt=values["tilt_std_degrees"] * _RADIANS,
        yaw=values["yaw_std_degrees"] * _RADIANS,
        velocity=values["velocity_std"],
        position=values["position_std"],
        gyro_bias=values["gyro_bias_std"],
        accel_bias=values["accel_bias_std"],
    )
