"""Recordings through the filter, many side by side.

The filter runs in float64 (JAX's x64 must be on), the network in float32.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.inference import Network, keep_diagnostics
from gnio_jax.evaluation.preparation import Prepared
from gnio_jax.evaluation.setup import OnShare, no_progress
from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.filtering import (
    ConsideredStd,
    FilterConfig,
    FilterHistory,
    FilterState,
    InitialStd,
    NoiseModel,
    considered_covariance,
    initial_state,
    over_sequences,
    run_filter,
    run_odometry,
    sensitivity,
)
from gnio_jax.filtering.batch import Batch, batches, padded_masks, padded_signals
from gnio_jax.filtering.config import YawFrame
from gnio_jax.filtering.history import GYRO_BIAS, POSITION
from gnio_jax.filtering.settings import FilterSetup
from gnio_jax.numerics import filled_up, quaternion_from_matrix
from gnio_jax.parallel import on_host
from gnio_jax.types import Array

SHORTEST = 16
"""No batch is padded to less than about this many strides."""


class Measurements(NamedTuple):
    """Displacements given to the filter, a row per stride; NaN where there is none."""

    displacement: Float[Array, "k 3"]
    """m, in the yaw frame of the window's start."""
    std: Float[Array, "k 3"]
    """m."""


class Imu(NamedTuple):
    """What the filter is driven by, the recordings along the leading axis."""

    gyro: Array
    """(b, K·n, 3), rad/s."""
    accel: Array
    """(b, K·n, 3), m/s²."""
    valid: Array | None
    """(b, K·n) booleans: False where a sample was made up; None: nowhere."""


class FilterStart(NamedTuple):
    """Arguments of `initial_state`."""

    rotation: Any
    velocity: Any
    position: Any
    gyro_bias: Any
    std: InitialStd


def run_filters(
    prepared: list[Prepared],
    source: Network | list[Measurements],
    setup: FilterSetup,
    batch_size: int,
    progress: OnShare = no_progress,
) -> list[Estimate]:
    """The filter over every recording, with the network in its loop or with the measurements of
    each recording."""
    n = setup.config.samples_per_clone
    strides = [each.strides(n) for each in prepared]
    found: dict[int, Estimate] = {}
    for batch in _batches(strides, batch_size):
        history = _run_batch([prepared[i] for i in batch.members], batch, source, setup)
        for place, i in enumerate(dict.fromkeys(batch.members)):
            own = jax.tree.map(lambda leaf, p=place, k=strides[i]: leaf[p, :k], history)
            found[i] = _estimate(prepared[i], own, setup)
        progress(sum(strides[i] for i in found) / sum(strides))
    return [found[i] for i in range(len(prepared))]


def _batches(strides: list[int], batch_size: int) -> list[Batch]:
    """Batches of one size, as full as they can be. Their lengths are few (the longest recording's
    times powers of 0.8), and none is padded by more than a quarter."""
    count = max(1, math.ceil(len(strides) / batch_size))
    size = max(1, math.ceil(len(strides) / count))

    def padded(longest: int) -> int:
        length = max(strides)
        while 0.8 * length >= longest and length > SHORTEST:
            length = math.ceil(0.8 * length)
        return length

    return batches(strides, size, padded)


def _run_batch(
    members: list[Prepared],
    batch: Batch,
    source: Network | list[Measurements],
    setup: FilterSetup,
) -> FilterHistory:
    """One compiled run; leading axis: the members."""
    samples = batch.intervals * setup.config.samples_per_clone
    start = _stacked([_filter_start(each, setup) for each in members])
    signals = ((each.sequence.gyro[:-1], each.sequence.accel[:-1]) for each in members)
    masks = (each.imu_valid for each in members)
    imu = Imu(*padded_signals(signals, samples), padded_masks(masks, samples))
    if isinstance(source, Network):
        history = _run_with_network(
            source.apply, source.variables, start, imu, setup.config, setup.noise
        )
    else:
        given = [
            Measurements(*(filled_up(part, batch.intervals, np.nan) for part in source[i]))
            for i in batch.members
        ]
        history = _run_with_measurements(start, imu, _stacked(given), setup.config, setup.noise)
    if setup.considered is not None:
        frame = setup.config.displacement_frame if isinstance(source, Network) else "given"
        fixed = setup.config, setup.noise, setup.considered, frame
        history = _with_considered(start, imu, history, *fixed)
    return on_host(history)


@functools.partial(jax.jit, static_argnames=("config", "frame"))
def _with_considered(
    start: FilterStart,
    imu: Imu,
    history: FilterHistory,
    config: FilterConfig,
    noise: NoiseModel,
    considered: ConsideredStd,
    frame: YawFrame,
) -> FilterHistory:
    """With the errors that the filter considers in its covariance."""

    def run(start: FilterStart, imu: Imu, history: FilterHistory) -> tuple[Array, Array]:
        state = initial_state(config, **start._asdict())
        signals = imu.gyro, imu.accel
        displacement, covariance = history.given(noise)
        fixed = config, noise, imu.valid, frame

        def repeated(state: FilterState, displacement: Array) -> FilterHistory:
            return run_filter(state, *signals, displacement, covariance, *fixed)[1]

        found = sensitivity(repeated, state, displacement)
        added = considered_covariance(found, considered)
        variances = history.covariance_diagonal + jnp.diagonal(added, axis1=1, axis2=2)
        assert history.covariance is not None
        return variances, history.covariance + added[:, POSITION, POSITION]

    diagonal, covariance = over_sequences(run)(start, imu, history)
    return history._replace(covariance_diagonal=diagonal, covariance=covariance)


@functools.partial(jax.jit, static_argnames=("apply", "config"))
def _run_with_network(
    apply: Callable,
    variables: Any,
    start: FilterStart,
    imu: Imu,
    config: FilterConfig,
    noise: NoiseModel,
) -> FilterHistory:
    def predict(windows: Array) -> Any:
        return keep_diagnostics(apply(variables, windows))

    def run(start: FilterStart, imu: Imu) -> FilterHistory:
        state = initial_state(config, **start._asdict())
        signals = imu.gyro, imu.accel
        return _lean(run_odometry(predict, state, *signals, config, noise, imu.valid)[1])

    return over_sequences(run)(start, imu)


@functools.partial(jax.jit, static_argnames="config")
def _run_with_measurements(
    start: FilterStart,
    imu: Imu,
    measurements: Measurements,
    config: FilterConfig,
    noise: NoiseModel,
) -> FilterHistory:
    def run(start: FilterStart, imu: Imu, measurements: Measurements) -> FilterHistory:
        state = initial_state(config, **start._asdict())
        given = measurements.displacement, jax.vmap(jnp.diag)(measurements.std**2)
        signals = imu.gyro, imu.accel
        return _lean(run_filter(state, *signals, *given, config, noise, imu.valid)[1])

    return over_sequences(run)(start, imu, measurements)


def _lean(history: FilterHistory) -> FilterHistory:
    """With the covariance of the position alone."""
    assert history.covariance is not None
    return history._replace(covariance=history.covariance[:, POSITION, POSITION])


def _filter_start(prepared: Prepared, setup: FilterSetup) -> FilterStart:
    """The recording's own start, as certain as it says or else as the options say."""
    start, std = prepared.start, setup.initial_std
    if start.tilt_std is not None:
        std = std._replace(tilt=start.tilt_std)
    if start.velocity_std is not None:
        std = std._replace(velocity=start.velocity_std)
    return FilterStart(start.rotation, start.velocity, start.position, prepared.gyro_bias, std)


def _estimate(prepared: Prepared, history: FilterHistory, setup: FilterSetup) -> Estimate:
    """The history of one recording behind a row for its start; void where not healthy."""
    n, start = setup.config.samples_per_clone, _filter_start(prepared, setup)
    assert history.covariance is not None
    time, notes = prepared.sequence.time[::n], prepared.notes
    healthy = _after(1.0, history.healthy) > 0
    if not healthy.all():
        since = time[np.argmin(healthy)] - time[0]
        notes = (*notes, f"filter: not healthy from {since:.1f} s on, and all after it is void")
    position = _after(start.position, history.position)
    orientation = quaternion_from_matrix(_after(start.rotation, history.rotation))
    poses = (np.where(healthy[:, None], part, np.nan) for part in (position, orientation))
    start_std = np.repeat(np.array(start.std), [2, 1, 3, 3, 3, 3])
    if setup.considered is not None:
        start_std[GYRO_BIAS] = np.hypot(start_std[GYRO_BIAS], setup.considered.gyro_bias)
    start_covariance = np.eye(3) * setup.initial_std.position**2
    return Estimate(
        prepared.sequence.name,
        Trajectory(time, *poses),
        prepared.reference(n),
        displacement=_after(np.nan, history.displacement),
        displacement_std=_after(np.nan, history.measurement_std),
        diagnostics={key: _after(np.nan, value) for key, value in history.diagnostics.items()},
        velocity=_after(start.velocity, history.velocity),
        gyro_bias=_after(start.gyro_bias, history.gyro_bias),
        accel_bias=_after(0.0, history.accel_bias),
        std=_after(start_std, np.sqrt(np.maximum(history.covariance_diagonal, 0.0))),
        position_covariance=_after(start_covariance, history.covariance),
        accepted=_after(np.nan, history.accepted),
        nis=_after(np.nan, history.nis),
        notes=notes,
    )


def _after(first: Any, rest: Any) -> np.ndarray:
    """`rest` behind a row of `first`."""
    row = np.broadcast_to(np.asarray(first, float), rest.shape[1:])
    return np.concatenate([row[None], rest])


def _stacked(trees: list[Any]) -> Any:
    """One tree of arrays with a leading axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)
