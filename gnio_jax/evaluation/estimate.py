"""Trajectories of prepared recordings.

The filter runs with the network in its loop (tight coupling), with displacements that were inferred
before (loose coupling), or without displacements. Without a filter the displacements are summed. A
trajectory has a row at the start and one at the end of every stride. The filter runs in float64
(JAX's x64 must be on), the network in float32.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.config import DataConfig
from gnio_jax.evaluation.infer import Displacements, keep
from gnio_jax.evaluation.metrics import Filtered
from gnio_jax.evaluation.prepare import PreparedRecording, Start
from gnio_jax.evaluation.trajectory import Alignment, Trajectory, align_if_possible, relative_yaw
from gnio_jax.filtering import (
    Filter,
    FilterConfig,
    FilterHistory,
    FilterState,
    considered_covariance,
    over_sequences,
    run_filter,
    run_odometry,
    sensitivity,
    with_considered,
)
from gnio_jax.filtering.batch import batches, padded_masks, padded_signals
from gnio_jax.filtering.history import GYRO_BIAS, POSITION, explain_failure
from gnio_jax.filtering.state import gyro_bias_covariance
from gnio_jax.filtering.update import Measurement, Outcome
from gnio_jax.models import Network
from gnio_jax.numerics import (
    filled_up,
    finite_rows,
    last_true,
    quaternion_from_matrix,
    rotation_z,
    yaw_rotation,
)
from gnio_jax.reporting import Progress, silent
from gnio_jax.types import Array, Waypoints

PERFECT_STD = 0.01
"""Standard deviation of the true displacements that a `perfect` filter is given, m per axis."""


class States(NamedTuple):
    """The filter's estimates besides poses, a row for each row of the trajectory."""

    velocity: Float[np.ndarray, "n 3"]
    """In the filter's own world, m/s."""
    gyro_bias: Float[np.ndarray, "n 3"]
    """In the body, rad/s."""
    accel_bias: Float[np.ndarray, "n 3"]
    """In the body, m/s²."""
    std: Float[np.ndarray, "n 15"]
    """Standard deviations of the errors of attitude (in the world, rad), velocity, position, gyro
    bias, accelerometer bias, including the consider covariance."""
    innovation: Float[np.ndarray, "n 3"]
    """Measured minus predicted displacement, m; NaN where there was no measurement."""


class SequenceEstimate(NamedTuple):
    """A trajectory with the estimator's other results: K + 1 rows for K strides.

    Row k is at the end of stride k, which is `PreparedRecording.time[k]`. A measurement is in the
    row at the end of its window.
    """

    name: str
    trajectory: Trajectory
    """NaN from the row on in which the filter is no longer healthy: it has diverged."""
    reference: Trajectory
    """The reference at the same rows; NaN where it cannot be trusted."""
    displacements: Displacements | None = None
    """The displacements, with the standard deviations that the filter used, or without a filter
    those of the network."""
    filtered: Filtered | None = None
    states: States | None = None
    notes: tuple[str, ...] = ()
    """Notes for a reader of the result."""
    waypoints: Waypoints | None = None
    """The reference of a sequence without poses, in a frame of their own."""
    accepted: dict[str, Float[np.ndarray, "n"]] = {}
    """For each of `PreparedRecording.measurements` by name: 1 where it was used, 0 where it was
    refused, NaN where there was none."""


def estimate(
    recordings: list[PreparedRecording],
    source: Network | list[Displacements],
    windows: DataConfig,
    ekf: Filter | None,
    batch_size: int = 16,
    progress: Progress = silent,
) -> list[SequenceEstimate]:
    """Trajectories of the recordings, by the filter or by the sum of displacements.

    Args:
        recordings: Recordings of any lengths.
        source: The network, which then runs inside the filter, or the displacements of each
            recording.
        windows: Rate, window and stride.
        ekf: The filter; None: the displacements are summed.
        batch_size: Number of recordings that the filter runs over side by side. Other numbers give
            the same trajectories to rounding.
        progress: A function that gets the finished share.
    """
    if ekf is None:
        assert not isinstance(source, Network)
        return [integrate(*pair, windows) for pair in zip(recordings, source, strict=True)]
    # `_run` takes the displacements where the network has no `apply`.
    network, displacements = (
        (source, None) if isinstance(source, Network) else (Network(None, None), source)
    )
    estimates: dict[int, SequenceEstimate] = {}
    strides = [recording.strides for recording in recordings]
    for batch in batches(strides, batch_size):
        members = [recordings[i] for i in batch.members]
        rows = None if displacements is None else [displacements[i] for i in batch.members]
        inputs = filter_inputs(members, rows, batch.intervals, ekf.config)
        histories = _run(network.variables, inputs, ekf, apply=network.apply)
        histories = jax.device_get(histories)
        for row, i in enumerate(dict.fromkeys(batch.members)):
            history = jax.tree.map(lambda leaf, row=row, k=strides[i]: leaf[row, :k], histories)
            if displacements is not None:
                history = history._replace(diagnostics=displacements[i].diagnostics)
            estimates[i] = _convert_history(recordings[i], history, ekf)
        progress(sum(strides[i] for i in estimates) / sum(strides))
    return [estimates[i] for i in range(len(recordings))]


def never_moves(estimates: list[SequenceEstimate]) -> list[SequenceEstimate]:
    """Estimates that stay at the start pose. An estimator must be better than these, above all in a
    small room."""
    still = []
    for original in estimates:
        name, (time, *poses) = original.name, original.trajectory
        path = Trajectory(time, *(np.repeat(part[:1], len(part), 0) for part in poses))
        still.append(SequenceEstimate(name, path, original.reference, waypoints=original.waypoints))
    return still


def perfect(ekf: Filter) -> Filter:
    """The filter for true displacements: without the settings that were calibrated for a
    network."""
    noise = ekf.noise._replace(std_factor=(1.0, 1.0, 1.0), measurement_scale=1.0, correlation=None)
    considered = ekf.considered and ekf.considered._replace(scale=0.0, heading=0.0, slope=0.0)
    config = dataclasses.replace(ekf.config, measures="displacement")
    return dataclasses.replace(ekf, config=config, noise=noise, considered=considered)


def in_one_frame(
    estimate: SequenceEstimate, alignment: Alignment | None = "origin"
) -> SequenceEstimate:
    """Estimate and reference in one frame, for drawing: the estimate is aligned with its
    covariance, or without an `alignment` the reference is moved to the start of the estimate. An
    estimate with waypoints is aligned with these. If that is impossible, nothing changes.
    Covariances are turned only about the vertical, because an alignment of a level world turns
    about it."""
    if alignment is None and estimate.waypoints is None:
        return estimate._replace(
            reference=align_if_possible(estimate.reference, estimate.trajectory)
        )
    reference = estimate.waypoints or estimate.reference
    path, filtered = estimate.trajectory, estimate.filtered
    aligned = align_if_possible(path, reference, alignment or "origin")
    if filtered is not None and aligned is not path:
        turn = rotation_z(relative_yaw(aligned.orientation, path.orientation))
        covariance = turn @ filtered.covariance @ np.swapaxes(turn, 1, 2)
        filtered = filtered._replace(covariance=covariance)
    return estimate._replace(trajectory=aligned, filtered=filtered)


# --- the filter over many recordings


class BatchInputs(NamedTuple):
    """The inputs of the filter, with the recordings along the leading axis."""

    start: Start
    gyro: Array
    """(b, K·n, 3), rad/s."""
    accel: Array
    """(b, K·n, 3), m/s²."""
    imu_valid: Array | None
    """(b, K·n); None: every sample was measured."""
    displacements: Displacements | None
    """(b, K, 3); None where the network is in the filter."""
    variance: Array | None = None
    """(b, K·n, 6) variances of [accel, gyro] by a corrector; None: there is none."""
    measurements: tuple[Measurement, ...] = ()
    """Those of the recordings, (b, K, ...)."""


def filter_inputs(
    recordings: list[PreparedRecording],
    displacements: list[Displacements] | None,
    strides: int,
    config: FilterConfig,
) -> BatchInputs:
    """The recordings side by side, padded to the given number of strides by samples that change
    nothing before them. Rows without a displacement get a covariance of 1 m², so that derivatives
    stay finite; the filter never applies it."""
    samples, stacked = strides * config.samples_per_clone, None
    if displacements is not None:
        rows = []
        for value, covariance, _ in displacements:
            finite = np.isfinite(covariance).all((1, 2), keepdims=True)
            covariance = filled_up(np.where(finite, covariance, np.eye(3)), strides)
            rows.append(Displacements(filled_up(value, strides, np.nan), covariance))
        stacked = _stack(rows)
    variances = [recording.variance for recording in recordings if recording.variance is not None]
    variance = None
    if len(variances) == len(recordings):
        variance = np.stack([filled_up(rows[:samples], samples) for rows in variances])
    measurements = (
        jax.tree.map(lambda part: filled_up(part, strides, np.nan), recording.measurements)
        for recording in recordings
    )
    return BatchInputs(
        _stack([recording.start for recording in recordings]),
        *padded_signals(((recording.gyro, recording.accel) for recording in recordings), samples),
        padded_masks((recording.imu_valid for recording in recordings), samples),
        stacked,
        variance,
        _stack([*measurements]),
    )


@functools.partial(jax.jit, static_argnames="apply")
def _run(
    variables: Any, inputs: BatchInputs, ekf: Filter, *, apply: Callable | None
) -> FilterHistory:
    """One compiled run over all recordings of a batch. Of its covariances only that of the position
    is kept, including the consider covariance."""

    def run(inputs: BatchInputs) -> FilterHistory:
        signals, valid = (inputs.gyro, inputs.accel), inputs.imu_valid
        others: dict[str, Any] = {
            "measurements": inputs.measurements,
            "variance": inputs.variance,
        }
        state = inputs.start.state(ekf)
        if apply is None:
            assert inputs.displacements is not None
            frame = "body" if ekf.config.measures == "velocity" else "given"
            displacement = inputs.displacements.value
            covariance = inputs.displacements.covariance
            rows = displacement, covariance, valid, frame
            history = run_filter(ekf, state, *signals, *rows, **others)[1]
        else:
            frame = ekf.config.derivative_frame
            predict = Network(apply, variables).predict(keep)
            history = run_odometry(predict, ekf, state, *signals, valid, **others)[1]
        covariances = history.covariance
        assert covariances is not None
        if ekf.considered is not None:
            displacement, covariance = history.unscaled_displacements(ekf.noise)

            def repeat_run(state: FilterState, displacement: Array) -> FilterHistory:
                rows = displacement, covariance, valid, frame
                replayed = others | {"diagnostics": history.diagnostics}
                return run_filter(ekf, state, *signals, *rows, **replayed)[1]

            rotation = history.rotation if ekf.config.measures == "velocity" else None
            derivatives = sensitivity(repeat_run, state, displacement, rotation)
            axis = jnp.tile(inputs.start.raw_axis[None], (len(derivatives), 1))
            added = considered_covariance(derivatives, ekf.considered, axis)
            covariances = with_considered(covariances, added, ekf.config)
        diagonal = jnp.diagonal(covariances, axis1=1, axis2=2)
        of_position = covariances[:, POSITION, POSITION]
        return history._replace(covariance_diagonal=diagonal, covariance=of_position)

    return over_sequences(run)(inputs)


def _convert_history(
    recording: PreparedRecording, history: FilterHistory, ekf: Filter
) -> SequenceEstimate:
    """The estimate from the history of one recording, with a row for its start. It is invalid where
    the history is not healthy."""
    start, notes = recording.start, recording.notes
    healthy = _prepend(1.0, history.healthy) > 0
    if not healthy.all():
        seconds = recording.time[np.argmin(healthy)] - recording.time[0]
        cause = explain_failure(history, ekf.config)
        problem = f"filter: diverged at {seconds:.1f} s ({cause})"
        notes = (*notes, f"{problem}; the poses from then on are invalid")
    position = _prepend(start.position, history.position)
    orientation = quaternion_from_matrix(_prepend(start.rotation, history.rotation))
    poses = (np.where(healthy[:, None], part, np.nan) for part in (position, orientation))
    std = np.repeat(np.array(start.std), [2, 1, 3, 3, 3, 3])
    of_bias = gyro_bias_covariance(start.rotation, start.std.gyro_bias, start.level_gyro_bias)
    std[GYRO_BIAS] = np.sqrt(np.diag(of_bias))
    if (considered := ekf.considered) is not None:
        std[GYRO_BIAS] = np.hypot(std[GYRO_BIAS], considered.gyro_bias)
        std[GYRO_BIAS] = np.hypot(std[GYRO_BIAS], considered.raw_gyro_bias * start.raw_axis)
    return SequenceEstimate(
        recording.name,
        Trajectory(recording.time, *poses),
        recording.reference,
        Displacements(
            _prepend(np.nan, history.displacement),
            _prepend(np.nan, history.measurement_covariance),
            {name: _prepend(np.nan, value) for name, value in history.diagnostics.items()},
        ),
        Filtered(
            _prepend(np.diag(std[POSITION] ** 2), history.covariance),
            _prepend(np.nan, history.nis),
            _prepend(np.nan, history.accepted),
        ),
        States(
            _prepend(start.velocity, history.velocity),
            _prepend(start.gyro_bias, history.gyro_bias),
            _prepend(0.0, history.accel_bias),
            _prepend(std, np.sqrt(np.maximum(history.covariance_diagonal, 0.0))),
            _prepend(np.nan, history.innovation),
        ),
        notes=notes,
        waypoints=recording.waypoints,
        accepted={
            measurement.name: _prepend(np.nan, _acceptance(history.outcomes[measurement.name]))
            for measurement in recording.measurements
        },
    )


def _acceptance(outcome: Outcome) -> Float[np.ndarray, "k"]:
    """1 where a measurement was used, 0 where it was refused, NaN where there was none."""
    return np.where(outcome.present, np.asarray(outcome.accepted, float), np.nan)


def _prepend(first: Any, rows: Any) -> np.ndarray:
    """A row of `first`, then the rows."""
    row = np.broadcast_to(np.asarray(first, float), rows.shape[1:])
    return np.concatenate([row[None], rows])


def _stack(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


# --- the sum of displacements


def integrate(
    recording: PreparedRecording, displacements: Displacements, windows: DataConfig
) -> SequenceEstimate:
    """The path in which every stride is the mean of the windows that cover it, as in RoNIN-type
    baselines."""
    n, clones = windows.stride, windows.window // windows.stride
    assert recording.attitude is not None
    ends = n * np.arange(clones, recording.strides + 1)  # ends of the windows, in samples
    to_world = yaw_rotation(recording.attitude[ends - windows.window])
    steps = np.einsum("mij,mj->mi", to_world, displacements.value[clones - 1 :]) / clones
    moved = np.cumsum(mean_over_windows(steps, clones), 0)
    position = recording.start.position + np.concatenate([np.zeros((1, 3)), moved])
    orientation = quaternion_from_matrix(recording.attitude[::n])
    return SequenceEstimate(
        recording.name,
        Trajectory(recording.time, position, orientation),
        recording.reference,
        jax.tree.map(lambda leaf: _prepend(np.nan, leaf), displacements),
        notes=recording.notes,
        waypoints=recording.waypoints,
    )


def mean_over_windows(steps: Float[np.ndarray, "m 3"], window: int) -> Float[np.ndarray, "k 3"]:
    """Movement in each stride: the mean of displacement × stride/window (`steps`) over the windows
    that cover it. Window i covers strides i … i + `window` − 1.

    Using only the window that starts (or ends) at the stride would put the whole trajectory half a
    window ahead of (or behind) its time: 0.6 m at walking speed. A stride without any window gets
    the movement of the stride before. Strides before all windows (in the context of the first) get
    that of the first stride with a window.
    """
    good, over = finite_rows(steps), np.ones(window)
    counts = np.convolve(good, over)
    axes = np.where(good[:, None], steps, 0.0).T
    sums = np.stack([np.convolve(axis, over) for axis in axes], 1)
    moved = sums / np.maximum(counts, 1.0)[:, None]
    return moved[last_true(counts > 0.5)]
