"""The network's displacement of every window of the recordings, cut with their attitudes."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.config import DataConfig
from gnio_jax.evaluation.infer_memory import remembered_displacements
from gnio_jax.evaluation.prepare import PreparedRecording
from gnio_jax.models import Network
from gnio_jax.reporting import Progress, silent
from gnio_jax.types import NONHOLONOMIC_LOG_FACTOR, Array, Prediction, Quantity
from gnio_jax.windows import align_recording, cut_windows, window_starts, without_any

WINDOWS_PER_CALL = 512
DIAGNOSTICS = ("gate", "scale", NONHOLONOMIC_LOG_FACTOR)
"""Diagnostics of the network that are stored for every window. Attention is too large."""


class Displacements(NamedTuple):
    """Displacements over windows, with a row for each stride of a recording: the displacement of
    the window that ends with the stride. NaN where there is none."""

    value: Float[Array, "k 3"]
    """m, expressed in the yaw frame of the window's start. For a filter that measures velocities,
    the velocity in the body, in metres per window."""
    covariance: Float[Array, "k 3 3"]
    """m²."""
    diagnostics: dict[str, Float[Array, "k ..."]] = {}

    @property
    def std(self) -> Float[np.ndarray, "k 3"]:
        """Standard deviations, m."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))


def reference_displacements(recording: PreparedRecording, std: float) -> Displacements:
    """The displacements of the reference, with a standard deviation in m."""
    value = _at_window_ends(recording.displacement, recording)
    return Displacements(value, np.tile(std**2 * np.eye(3), (len(value), 1, 1)))


def no_displacements(recording: PreparedRecording) -> Displacements:
    rows = recording.strides
    return Displacements(np.full((rows, 3), np.nan), np.full((rows, 3, 3), np.nan))


def infer(
    network: Network,
    recordings: list[PreparedRecording],
    windows: DataConfig,
    progress: Progress = silent,
    diagnostics: tuple[str, ...] = DIAGNOSTICS,
    least_std: float = 0.0,
    measures: Quantity = "displacement",
) -> list[Displacements]:
    """The network's predictions for every window of the recordings, in large batches over all of
    them. They are float64 on the host. A window that touches a sample which was not measured has no
    displacement.

    Args:
        network: The network.
        recordings: Recordings with an `attitude`, which turns the windows.
        windows: Rate, window and stride.
        progress: A function that gets the finished share.
        diagnostics: Names of the diagnostics that are stored, if the network has them.
        least_std: Smallest standard deviation that the estimator uses, m
            (`FilterConfig.log_std_min` is its logarithm).
        measures: What the estimator measures of the network (`FilterConfig.measures`).
    """
    if network.has_memory:
        select = functools.partial(keep, names=diagnostics)
        results = []
        for number, recording in enumerate(recordings):
            arguments = network, recording, windows, select, least_std
            results.append(Displacements(*remembered_displacements(*arguments)))
            progress((number + 1) / len(recordings))
        return results
    parts, starts, turns = [], [], []
    for recording in recordings:
        assert recording.attitude is not None
        start = window_starts(len(recording.gyro) + 1, windows.input_samples, windows.stride)
        imu, turn = align_recording(
            recording.accel,
            recording.gyro - recording.start.gyro_bias,
            recording.attitude[:-1],
            start + windows.context,
            windows.window_rotation,
        )
        starts.append(start + sum(map(len, parts)))
        parts.append(imu)
        turns.append(turn)
    samples = jnp.asarray(np.concatenate(parts))
    start, turn = np.concatenate(starts).astype(np.int32), np.concatenate(turns)
    total, size, predictions = len(start), min(WINDOWS_PER_CALL, len(start)), []
    for begin in range(0, total, size):
        # The last batch is filled up with the last window, so that all batches use one program.
        batch = np.minimum(np.arange(begin, begin + size), total - 1)
        arguments = network.variables, samples, start[batch], turn[batch]
        fixed = {
            "apply": network.apply,
            "length": windows.input_samples,
            "diagnostics": diagnostics,
        }
        fixed["measures"] = measures
        predictions.append(jax.device_get(_predict(*arguments, **fixed)))
        progress(min(1.0, (begin + size) / total))
    prediction = jax.tree.map(
        lambda *parts: np.concatenate(parts)[:total].astype(np.float64), *predictions
    )
    ends = np.cumsum([0, *map(len, starts)])
    return [
        _displacements_of(
            recording,
            jax.tree.map(lambda leaf, rows=rows: leaf[rows], prediction),
            windows,
            least_std,
        )
        for recording, rows in zip(recordings, map(slice, ends[:-1], ends[1:]), strict=True)
    ]


@functools.partial(jax.jit, static_argnames=("apply", "length", "diagnostics", "measures"))
def _predict(
    variables: Any,
    samples: Float[Array, "t c"],
    start: Array,
    turn: Float[Array, "b 3 3"],
    *,
    apply: Callable,
    length: int,
    diagnostics: tuple[str, ...],
    measures: Quantity,
) -> Prediction:
    prediction = apply(variables, cut_windows(samples, start, turn, length))
    return keep(prediction.with_quantity(measures), diagnostics)


def keep(prediction: Prediction, names: tuple[str, ...] = DIAGNOSTICS) -> Prediction:
    """The prediction with only the named diagnostics, of those that it has."""
    diagnostics = {name: value for name, value in prediction.diagnostics.items() if name in names}
    return prediction._replace(diagnostics=diagnostics)


def _displacements_of(
    recording: PreparedRecording, prediction: Prediction, windows: DataConfig, least_std: float
) -> Displacements:
    """The predictions for the windows of one recording."""
    value = np.asarray(prediction.displacement)
    if recording.imu_valid is not None:
        start = window_starts(len(recording.gyro) + 1, windows.input_samples, windows.stride)
        whole = without_any(~recording.imu_valid, start, windows.input_samples)
        value = np.where(whole[:, None], value, np.nan)
    with np.errstate(divide="ignore"):
        least = np.log(least_std)
    return Displacements(
        _at_window_ends(value, recording),
        _at_window_ends(np.asarray(prediction.covariance(least, np.float64)), recording),
        {
            name: _at_window_ends(diagnostic, recording)
            for name, diagnostic in prediction.diagnostics.items()
        },
    )


def _at_window_ends(
    values: Float[Array, "m *d"], recording: PreparedRecording
) -> Float[np.ndarray, "k *d"]:
    """Values of the last m windows in the last m rows of a recording, NaN before."""
    missing = np.full((recording.strides - len(values), *values.shape[1:]), np.nan)
    return np.concatenate([missing, values])
