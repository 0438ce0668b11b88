"""Trajectories of prepared recordings, by the estimator that the setup names.

`ekf` filters (`tight`: the network inside the filter, its windows cut with the filter's own state;
`loose`: the network over all windows first, with a given orientation); `integrate` sums
displacements; `imu_only` integrates the IMU alone. A trajectory has a row at the start, which is
the first sample with a trusted reference, and one at the end of every stride (clone interval).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gnio_jax.config import DataConfig, FilterSettings
from gnio_jax.evaluation.estimators.filtered import Measurements, run_filters
from gnio_jax.evaluation.estimators.integrated import integrate
from gnio_jax.evaluation.estimators.result import Estimate, at_window_ends
from gnio_jax.evaluation.inference import (
    Network,
    attitude,
    predict_windows,
    true_displacements,
)
from gnio_jax.evaluation.preparation import Prepared
from gnio_jax.evaluation.setup import (
    DEFAULT_SETUP,
    OnShare,
    Setup,
    no_progress,
    resolve,
)
from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.filtering import ConsideredStd
from gnio_jax.filtering.settings import FilterSetup, filter_setup
from gnio_jax.types import Prediction

PERFECT_STD = 0.01
"""Standard deviation given to the filter with true displacements, m per axis, before
`measurement_scale`."""


def estimate(
    prepared: list[Prepared],
    network: Network | None,
    config: DataConfig,
    options: FilterSettings,
    setup: Setup = DEFAULT_SETUP,
    batch_size: int = 16,
    progress: OnShare = no_progress,
) -> list[Estimate]:
    """Trajectories of the recordings, `batch_size` of them side by side.

    `network` may be None for `imu_only`. A run of the same recordings in other batches gives the
    same trajectories to rounding.
    """
    setup, ekf = resolve(setup), filter_setup(config, options)
    if setup.estimator == "imu_only":
        none = [_no_measurements(each, config) for each in prepared]
        return run_filters(prepared, none, ekf, batch_size, progress)
    if network is None:
        raise ValueError(f"estimator '{setup.estimator}' needs a network")
    if setup.tightly_coupled:
        return run_filters(prepared, network, ekf, batch_size, progress)
    attitudes = [attitude(each, config, setup.orientation or "reference") for each in prepared]
    if setup.estimator == "integrate":
        predictions = predict_windows(network, prepared, attitudes, config, progress)
        return [
            integrate(each, rotation, prediction, config)
            for each, rotation, prediction in zip(prepared, attitudes, predictions, strict=True)
        ]
    predictions = predict_windows(network, prepared, attitudes, config)
    return _filter_predictions(prepared, predictions, ekf, batch_size, progress)


def perfect_displacements(
    prepared: list[Prepared],
    config: DataConfig,
    options: FilterSettings,
    setup: Setup = DEFAULT_SETUP,
    batch_size: int = 16,
    progress: OnShare = no_progress,
) -> list[Estimate]:
    """The same estimator fed with the reference's displacements: the error that no network can take
    away.

    The filter (also in the place of `imu_only`) is told a standard deviation of 1 cm per axis.
    """
    setup, ekf = resolve(setup), _without_network_errors(filter_setup(config, options))
    truths = [true_displacements(each, config) for each in prepared]
    if setup.estimator == "integrate":
        return [
            integrate(
                each,
                attitude(each, config, setup.orientation or "reference"),
                Prediction(truth, np.zeros_like(truth)),
                config,
            )
            for each, truth in zip(prepared, truths, strict=True)
        ]
    measurements = [
        _measurements(each, truth, np.full_like(truth, PERFECT_STD), config.stride)
        for each, truth in zip(prepared, truths, strict=True)
    ]
    return run_filters(prepared, measurements, ekf, batch_size, progress)


def _without_network_errors(ekf: FilterSetup) -> FilterSetup:
    """The filter without what was calibrated for a network: true displacements lack nothing."""
    noise = ekf.noise._replace(std_factor=(1.0, 1.0, 1.0), correlation=None)
    considered = ekf.considered and ConsideredStd(gyro_bias=ekf.considered.gyro_bias)
    return ekf._replace(noise=noise, considered=considered)


def never_moves(estimates: list[Estimate]) -> list[Estimate]:
    """The start pose throughout: what an estimator must beat, above all in a small room."""
    return [Estimate(e.name, _held_start(e.trajectory), e.reference) for e in estimates]


def _held_start(path: Trajectory) -> Trajectory:
    poses = (np.repeat(part[:1], len(part), 0) for part in (path.position, path.orientation))
    return Trajectory(path.time, *poses)


def _filter_predictions(
    prepared: list[Prepared],
    predictions: list[Prediction],
    ekf: FilterSetup,
    batch_size: int,
    progress: OnShare,
) -> list[Estimate]:
    """The loose coupling: predictions of all windows as measurements, and as diagnostics."""
    lowest, n = ekf.config.log_std_min, ekf.config.samples_per_clone
    measurements = [
        _measurements(each, p.displacement, np.exp(np.maximum(p.log_std, lowest)), n)
        for each, p in zip(prepared, predictions, strict=True)
    ]
    estimates = run_filters(prepared, measurements, ekf, batch_size, progress)
    return [
        e._replace(
            diagnostics={
                name: at_window_ends(value, len(e.trajectory.time))
                for name, value in p.diagnostics.items()
            }
        )
        for e, p in zip(estimates, predictions, strict=True)
    ]


def _measurements(
    prepared: Prepared,
    displacement: Float[np.ndarray, "m 3"],
    std: Float[np.ndarray, "m 3"],
    stride: int,
) -> Measurements:
    """Of all windows, at their ends. The filter has no clone at the start of the first window, so
    that one is of no use to it."""
    strides = prepared.strides(stride)
    return Measurements(at_window_ends(displacement[1:], strides), at_window_ends(std[1:], strides))


def _no_measurements(prepared: Prepared, config: DataConfig) -> Measurements:
    none = np.full((prepared.strides(config.stride), 3), np.nan)
    return Measurements(none, none)
