"""The filter as one value: a file holds it, calibration fits it, training learns it, and every
command runs it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Float

from gnio_jax.config import ConsideredStd, DataConfig, FilterSettings, InitialStd, NoiseModel
from gnio_jax.config.schema import TLIO_STD, Location, Number
from gnio_jax.filtering.measurements import create_measurements
from gnio_jax.filtering.nonholonomic import NonHolonomic
from gnio_jax.filtering.settings import FilterConfig, filter_config
from gnio_jax.filtering.update import Measurement
from gnio_jax.types import Array


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

    @property
    def correlation_times(self) -> tuple[Number, ...]:
        """The time τ, s, of each correlated error b of `FilterState.correlated`."""
        correlation = self.noise.correlation
        times = () if correlation is None else 3 * (correlation.seconds,)
        for measurement in self.measurements:
            if isinstance(measurement, NonHolonomic):
                times += measurement.correlation_times
        return times

    def decay(self, dtype: Any) -> Float[Array, "e"]:
        """a = exp(−T / τ) over a clone interval T, for each correlated error b: b_{k+1} = a b_k +
        √(1 − a²) n_k with n_k ~ N(0, 1), whose variance is 1 at all times."""
        times = [jnp.asarray(time, dtype) for time in self.correlation_times]
        if not times:
            return jnp.zeros(0, dtype)
        return jnp.exp(-self.config.clone_seconds / jnp.stack(times))


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
