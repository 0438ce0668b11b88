"""The filter that an experiment's options describe."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp

from gnio_jax.config import CONSIDERED_FIELDS, DataConfig, FilterOptions
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.considered import ConsideredStd
from gnio_jax.filtering.lasting_errors import LastingErrors
from gnio_jax.filtering.noise import InitialStd, NoiseModel

DEGREE = math.pi / 180
"""rad."""
STD_FACTORS = ("std_factor_x", "std_factor_y", "std_factor_z")
"""Fields of `FilterOptions`: factors of the network's σ, by axis."""
_STATIC = ("mahalanobis_fail_scale", "window_rotation")
"""Fields that decide what is compiled."""


class FilterSetup(NamedTuple):
    """A filter as the options ask for it."""

    config: FilterConfig
    noise: NoiseModel
    initial_std: InitialStd
    considered: ConsideredStd | None = None
    """Of errors that the filter does not estimate; None: there are none."""


def filter_setup(windows: DataConfig, options: FilterOptions) -> FilterSetup:
    """The filter for the windows and strides that a network was trained with."""
    config = FilterConfig(
        dt=1.0 / windows.rate,
        samples_per_clone=windows.stride,
        clones_per_window=windows.window // windows.stride,
        context_samples=windows.context,
        mahalanobis_fail_scale=options.mahalanobis_fail_scale,
        measurement_scale=options.measurement_scale,
        history="core",
        window_rotation=options.window_rotation or windows.window_rotation,
    )
    fields = vars(options)
    considered = considered_std(fields)
    return FilterSetup(
        config,
        noise_model(fields),
        initial_std(fields),
        considered if any(considered) else None,
    )


def filter_with(
    windows: DataConfig, options: FilterOptions, values: Mapping[str, Any]
) -> FilterSetup:
    """`filter_setup` with other values of some options, which may be traced.

    The factor of the measurement's covariance, static in `FilterConfig`, goes into the factors of
    σ, which are not. Errors that are considered are left out: they change no estimate.
    """
    fields = {**vars(options), **values}
    root = jnp.sqrt(fields["measurement_scale"])
    factors = {name: root * fields[name] for name in STD_FACTORS}
    setup = filter_setup(windows, dataclasses.replace(options, measurement_scale=1.0))
    return FilterSetup(setup.config, noise_model({**fields, **factors}), initial_std(fields))


def scale_in_noise(setup: FilterSetup) -> FilterSetup:
    """The same filter, its `measurement_scale` in the noise's factors of σ: filters that differ in
    the scale alone share what is compiled."""
    root = math.sqrt(setup.config.measurement_scale)
    factors = tuple(root * factor for factor in setup.noise.std_factor)
    config = dataclasses.replace(setup.config, measurement_scale=1.0)
    return setup._replace(config=config, noise=setup.noise._replace(std_factor=factors))


def switches_and_numbers(options: FilterOptions) -> tuple[FilterOptions, dict[str, float]]:
    """The options as the static part of a program and what it is told when it runs: with both,
    `filter_with` gives the filter of the options, and filters that have the same things switched on
    share what is compiled. What is considered is left out, as there."""
    numbers = {
        name: float(value)
        for name, value in vars(options).items()
        if name not in _STATIC and isinstance(value, int | float) and value > 0
    }
    considered = dict.fromkeys(CONSIDERED_FIELDS, 0.0)
    for name in considered:
        numbers.pop(name, None)
    return dataclasses.replace(options, **dict.fromkeys(numbers, 1.0), **considered), numbers


def noise_model(options: Mapping[str, Any]) -> NoiseModel:
    """The filter's noises, from the fields of its options; their values may be traced."""
    return NoiseModel(
        gyro_density=options["gyro_density"],
        accel_density=options["accel_density"],
        gyro_bias_walk=options["gyro_bias_walk"],
        accel_bias_walk=options["accel_bias_walk"],
        std_factor=tuple(options[name] for name in STD_FACTORS),
        displacement=_lasting_errors(options),
    )


def initial_std(options: Mapping[str, Any]) -> InitialStd:
    """The standard deviations of the filter's start, as `noise_model` takes the options."""
    return InitialStd(
        tilt=options["tilt_std_degrees"] * DEGREE,
        yaw=options["yaw_std_degrees"] * DEGREE,
        velocity=options["velocity_std"],
        position=options["position_std"],
        gyro_bias=options["gyro_bias_std"],
        accel_bias=options["accel_bias_std"],
    )


def considered_std(options: Mapping[str, Any]) -> ConsideredStd:
    """The standard deviations of the errors that are considered, as `noise_model` takes the
    options."""
    return ConsideredStd(
        options["considered_gyro_bias_std"],
        options["considered_scale_std"],
        options["considered_heading_std_degrees"] * DEGREE,
        options["considered_slope_std"],
    )


def _lasting_errors(options: Mapping[str, Any]) -> LastingErrors | None:
    """None where no error of the displacements lasts."""
    sizes = [
        options[name]
        for name in ("window_error_share", "scale_error_std", "heading_error_std_degrees")
    ]
    if all(isinstance(size, int | float) and size == 0 for size in sizes):
        return None
    return LastingErrors(
        window_share=options["window_error_share"],
        window_seconds=options["window_error_seconds"],
        scale_std=options["scale_error_std"],
        heading_std=options["heading_error_std_degrees"] * DEGREE,
        walk_seconds=options["walk_error_seconds"],
    )
