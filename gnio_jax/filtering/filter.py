"""The filter as one value: a file holds it, calibration fits it, training learns it, and every
command runs it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
from jax.core import Tracer

from gnio_jax.config import ConsideredStd, DataConfig, FilterSettings, InitialStd, NoiseModel
from gnio_jax.config.schema import TLIO_STD, Location, Number
from gnio_jax.filtering.measurements import create_measurements
from gnio_jax.filtering.settings import FilterConfig, filter_config
from gnio_jax.filtering.update import Measurement


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Filter:
    """The stochastic-cloning EKF: its static settings, and numbers in which it is differentiable.

    It is a tree of arrays: it can be an argument of a function under `jax.jit`, `jax.vmap` and
    `jax.grad`. `dataclasses.replace` changes a part of it.
    """

    config: FilterConfig = dataclasses.field(metadata={"static": True})
    noise: NoiseModel = dataclasses.field(default_factory=NoiseModel)
    """Noise of the IMU and of the displacements."""
    start: InitialStd = TLIO_STD
    """Standard deviations of the initial state."""
    considered: ConsideredStd | None = None
    """Standard deviations of errors that are not estimated (`consider`); None: there are none."""
    raw_gyro_bias: Number | None = None
    """Standard deviation of the first bias of a gyro whose phone subtracts no bias, rad/s; None:
    that of `start`."""
    measurements: tuple[Measurement, ...] = ()
    """Measurements that are taken in every clone interval after the displacement, in this order,
    e.g. `ZeroVelocity`. They have no rows: those that do are arguments of a run."""


def make_filter(windows: DataConfig, settings: FilterSettings) -> Filter:
    """The filter that the settings describe, for the windows and strides of a network.

    The numbers of the settings may be traced. Raises `InputError` for a measurement that is not
    registered or lacks a number.
    """
    considered: Any = settings.considered
    if not any(isinstance(std, Tracer) or std > 0 for std in considered):
        considered = None
    return Filter(
        config=filter_config(windows, settings),
        noise=settings.noise,
        start=settings.start,
        considered=considered,
        raw_gyro_bias=settings.raw_gyro_bias,
        measurements=create_measurements(settings.measurements, Location("filter", "measurements")),
    )
