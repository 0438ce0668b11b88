"""The network's displacement of every window of the recordings, cut with a given attitude."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from gnio_jax import models
from gnio_jax.config import DataConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation.preparation import Prepared
from gnio_jax.evaluation.setup import OnShare, Orientation, no_progress
from gnio_jax.numerics import (
    cumulative_rotation,
    finite_rows,
    matrix_from_quaternion,
    yaw_rotation,
)
from gnio_jax.types import Array, Prediction
from gnio_jax.windows import (
    align_recording,
    cut_windows,
    true_displacement,
    window_starts,
    without_any,
)

WINDOWS_PER_CALL = 512
KEPT_DIAGNOSTICS = ("gate", "scale")
"""Attention and the like are too large to keep for every window."""


class Network(NamedTuple):
    """A network with its parameters."""

    apply: Callable[[Any, Any], Prediction]
    """(variables, windows (b, N, 6) float32) -> `Prediction`; hashable, as a Flax module's `apply`
    is."""
    variables: Any


def inference_network(model: nn.Module, variables: Any) -> Network:
    """A network made ready for inference: what depends on its parameters alone is computed once."""
    return Network(models.Inference(model), models.inference_variables(model, variables))


def keep_diagnostics(
    prediction: Prediction, names: tuple[str, ...] = KEPT_DIAGNOSTICS
) -> Prediction:
    """The prediction with these diagnostics only, as far as it has them."""
    kept = {name: value for name, value in prediction.diagnostics.items() if name in names}
    return prediction._replace(diagnostics=kept)


def attitude(
    prepared: Prepared, config: DataConfig, source: Orientation
) -> Float[np.ndarray, "t 3 3"]:
    """Body→world at every sample.

    `filter` is the gyro integrated from the start, `device` the device's own estimate turned about
    z to the start's yaw. Where reference or device are missing, the gyro carries on from the last
    known attitude. Raises `InputError` where they are missing at the start.
    """
    integrated = _integrated_gyro(prepared, config)
    if source == "filter":
        return integrated
    sequence = prepared.sequence
    given = sequence.orientation if source == "reference" else sequence.device_orientation
    assert given is not None  # `prepare` has checked it
    known = finite_rows(given) & (sequence.valid if source == "reference" else True)
    if not known[0]:
        raise InputError(
            sequence.name, f"has no {source} orientation at its start", "give --orientation filter"
        )
    # What is not trusted may hold anything, also what is no rotation.
    rotation = matrix_from_quaternion(np.where(known[:, None], given, np.nan))
    if source == "device":
        start, device_start = yaw_rotation(np.stack([prepared.start.rotation, rotation[0]]))
        rotation = start @ device_start.T @ rotation
    last_known = np.maximum.accumulate(np.where(known, np.arange(len(known)), 0))
    turned_since = np.einsum("tji,tjk->tik", integrated[last_known], integrated)
    return np.where(known[:, None, None], rotation, rotation[last_known] @ turned_since)


def predict_windows(
    network: Network,
    prepared: list[Prepared],
    attitudes: list[Float[np.ndarray, "_ 3 3"]],
    config: DataConfig,
    progress: OnShare = no_progress,
    diagnostics: tuple[str, ...] = KEPT_DIAGNOSTICS,
) -> list[Prediction]:
    """What the network predicts for every window of the recordings, cut with the given attitudes,
    in large batches over all of them. Row k is the window that starts k strides after the
    recording; the first rows are NaN where the context would begin before it. A displacement over a
    gap of the IMU is NaN, as it is no measurement to the filter.

    Of its diagnostics only those named, if it has them. Float64 on the host.
    """
    parts = [
        _align(each, rotation, config) for each, rotation in zip(prepared, attitudes, strict=True)
    ]
    windows = _end_to_end(parts)
    total = len(windows.start)
    size, found = min(WINDOWS_PER_CALL, total), []
    for begin in range(0, total, size):
        # The last batch is filled up with the last window: one compilation.
        rows = np.minimum(np.arange(begin, begin + size), total - 1)
        batch = windows._replace(start=windows.start[rows], rotation=windows.rotation[rows])
        prediction = _predict(
            network.apply, network.variables, batch, length=config.seen, diagnostics=diagnostics
        )
        found.append(jax.device_get(prediction))
        progress(min(1.0, (begin + size) / total))
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:total].astype(np.float64), *found)
    ends = np.cumsum([len(part.start) for part in parts])
    rows = [slice(end - len(part.start), end) for end, part in zip(ends, parts, strict=True)]
    without_context = config.context // config.stride
    each_own = [jax.tree.map(lambda leaf, own=own: leaf[own], whole) for own in rows]
    return [
        jax.tree.map(
            lambda leaf: _after_nothing(leaf, without_context),
            _without_gaps(own, each, part.start, config.seen),
        )
        for own, each, part in zip(each_own, prepared, parts, strict=True)
    ]


def _without_gaps(
    prediction: Prediction, prepared: Prepared, start: Int[np.ndarray, "m"], length: int
) -> Prediction:
    """NaN for the displacements of windows that touch a sample that was not measured."""
    mask = prepared.imu_valid
    if mask is None:
        return prediction
    whole = without_any(~mask, start, length)[:, None]
    return prediction._replace(displacement=np.where(whole, prediction.displacement, np.nan))


def _after_nothing(rows: Float[np.ndarray, "m *d"], count: int) -> Float[np.ndarray, "_ *d"]:
    """The rows after `count` rows of NaN."""
    return np.concatenate([np.full((count, *rows.shape[1:]), np.nan), rows])


def true_displacements(prepared: Prepared, config: DataConfig) -> Float[np.ndarray, "m 3"]:
    """Reference displacement of every window, m, in the yaw frame of the reference at its start;
    NaN where it cannot be trusted."""
    every_sample = prepared.reference(1)
    start = window_starts(len(every_sample.time), config.window, config.stride)
    return true_displacement(every_sample.orientation, every_sample.position, start, config.window)


class _Windows(NamedTuple):
    """Windows of recordings that lie end to end. float32."""

    imu: Float[Array, "t 6"]
    """[accel m/s², gyro rad/s], as `AlignedRecording` has it."""
    start: Int[Array, "m"]
    """Row of `imu` at which each window begins, with its context."""
    rotation: Float[Array, "m 3 3"]
    """From the frame of `imu` to the gravity-aligned frame of each window."""


def _align(
    prepared: Prepared, rotation: Float[np.ndarray, "t 3 3"], config: DataConfig
) -> _Windows:
    """Every window of one recording, without the first gyro bias."""
    sequence = prepared.sequence
    start = window_starts(len(sequence.time), config.seen, config.stride)
    gyro, after_context = sequence.gyro - prepared.gyro_bias, start + config.context
    imu, to_window = align_recording(
        sequence.accel, gyro, rotation, after_context, config.window_rotation
    )
    return _Windows(imu, start, to_window)


def _end_to_end(parts: list[_Windows]) -> _Windows:
    """The recordings' windows on the device, those of the first recording first."""
    offsets = np.cumsum([0, *(len(part.imu) for part in parts[:-1])])
    starts = [part.start + offset for part, offset in zip(parts, offsets, strict=True)]
    return _Windows(
        jnp.asarray(np.concatenate([part.imu for part in parts])),
        np.concatenate(starts).astype(np.int32),
        np.concatenate([part.rotation for part in parts]),
    )


@functools.partial(jax.jit, static_argnames=("apply", "length", "diagnostics"))
def _predict(
    apply: Callable, variables: Any, windows: _Windows, length: int, diagnostics: tuple[str, ...]
) -> Prediction:
    imu = cut_windows(windows.imu, windows.start, windows.rotation, length)
    return keep_diagnostics(apply(variables, imu), diagnostics)


def _integrated_gyro(prepared: Prepared, config: DataConfig) -> Float[np.ndarray, "t 3 3"]:
    """Body→world from the gyro without its bias, from the start."""
    rates = prepared.sequence.gyro[:-1] - prepared.gyro_bias
    turned = cumulative_rotation(Rotation.from_rotvec(rates / config.rate))
    return prepared.start.rotation @ turned.as_matrix()
