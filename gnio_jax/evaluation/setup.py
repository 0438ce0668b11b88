"""How a trajectory is estimated: the choices of the command line, and the filter they give."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

from gnio_jax.config import DataConfig, FilterOptions
from gnio_jax.errors import InputError
from gnio_jax.filtering import FilterConfig, InitialStd, LastingErrors, NoiseModel

Estimator = Literal["ekf", "integrate", "imu_only"]
Orientation = Literal["filter", "device", "reference"]
DEGREE = math.pi / 180
"""rad."""
OnShare = Callable[[float], None]
"""Called with the share of the work that is done, from 0 to 1."""


def no_progress(share: float) -> None:
    """An `OnShare` that tells nobody."""


class Setup(NamedTuple):
    """How a trajectory is estimated; everything that changes what a result means."""

    estimator: Estimator = "ekf"
    coupling: Literal["tight", "loose"] = "tight"
    """Only for the ekf."""
    orientation: Orientation | None = None
    """Attitude that rotates the network's windows; None: the filter's where the network is in its
    loop, else the reference's."""
    init: Literal["reference", "static"] = "reference"
    """Start from the reference's pose and velocity, or from the gravity of the first second with
    yaw, velocity and position zero."""
    gyro_bias: Literal["zero", "rest", "reference"] = "zero"
    """First estimate of the gyro bias: none, the mean of a rest at the start, or the first 10 s
    against the reference."""

    @property
    def tightly_coupled(self) -> bool:
        """Whether the network is in the filter's loop."""
        return self.estimator == "ekf" and self.coupling == "tight"


DEFAULT_SETUP = Setup()


def resolve(setup: Setup) -> Setup:
    """`setup` with its orientation filled in. Raises `InputError` for an orientation that the
    estimator cannot use."""
    if not (setup.tightly_coupled or setup.estimator == "imu_only"):
        return setup._replace(orientation=setup.orientation or "reference")
    if setup.orientation not in (None, "filter"):
        what = "the tight coupling" if setup.estimator == "ekf" else "imu_only"
        raise InputError(
            f"--orientation {setup.orientation}",
            f"{what} uses the filter's own attitude",
            "leave it out, or choose --coupling loose or --estimator integrate",
        )
    return setup._replace(orientation="filter")


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
    return FilterSetup(config, noise_model(vars(options)), initial_std(vars(options)))


def noise_model(options: Mapping[str, Any]) -> NoiseModel:
    """The filter's noises, from the fields of its options; their values may be traced."""
    return NoiseModel(
        gyro_density=options["gyro_density"],
        accel_density=options["accel_density"],
        gyro_bias_walk=options["gyro_bias_walk"],
        accel_bias_walk=options["accel_bias_walk"],
        std_factor=tuple(options[f"std_factor_{axis}"] for axis in "xyz"),
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
