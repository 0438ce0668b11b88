"""The network's displacement of every window of the recordings, cut with a given attitude."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from gnio_jax.config import DataConfig
from gnio_jax.data.windows import WindowSource, gather
from gnio_jax.evaluation.preparation import Prepared
from gnio_jax.evaluation.setup import OnShare, Orientation, no_progress
from gnio_jax.numerics import (
    cumulative_rotation,
    finite_rows,
    matrix_from_quaternion,
    yaw_rotation,
)
from gnio_jax.types import InputError, Prediction

WINDOWS_PER_CALL = 512
KEPT_DIAGNOSTICS = ("gate", "scale")
"""Attention and the like are too large to keep for every window."""


class Network(NamedTuple):
    """A network with its parameters."""

    apply: Callable[[Any, Any], Prediction]
    """(variables, windows (b, N, 6) float32) -> `Prediction`; hashable, as a Flax module's `apply`
    is."""
    variables: Any


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
    rotation = matrix_from_quaternion(given)
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
    in large batches over all of them.

    Of its diagnostics only those named, if it has them. Float64 on the host.
    """
    source, counts = _windows(prepared, attitudes, config)
    total = len(source.start)
    size, found = min(WINDOWS_PER_CALL, total), []
    for begin in range(0, total, size):
        # The last batch is filled up with the last window: one compilation.
        which = np.minimum(np.arange(begin, begin + size), total - 1).astype(np.int32)
        prediction = _predict(
            network.apply, network.variables, source, which, config.window, diagnostics
        )
        found.append(jax.device_get(prediction))
        progress(min(1.0, (begin + size) / total))
    whole = jax.tree.map(lambda *parts: np.concatenate(parts)[:total].astype(np.float64), *found)
    ends = np.cumsum(counts)
    rows = [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]
    return [jax.tree.map(lambda leaf, own=own: leaf[own], whole) for own in rows]


@functools.partial(jax.jit, static_argnames=("apply", "length", "diagnostics"))
def _predict(
    apply: Callable,
    variables: Any,
    source: WindowSource,
    which: Int[np.ndarray, "b"],
    length: int,
    diagnostics: tuple[str, ...],
) -> Prediction:
    return keep_diagnostics(apply(variables, gather(source, which, length).imu), diagnostics)


def _windows(
    prepared: list[Prepared], attitudes: list[Float[np.ndarray, "_ 3 3"]], config: DataConfig
) -> tuple[WindowSource, list[int]]:
    """All windows of the recordings, end to end and without targets, and how many each has."""
    parts, counts, offset = [], [], 0
    for each, rotation in zip(prepared, attitudes, strict=True):
        sequence = each.sequence
        imu = np.stack([sequence.accel, sequence.gyro - each.gyro_bias], 1)
        start = np.arange(0, len(sequence.time) - config.window, config.stride)
        to_window = np.swapaxes(yaw_rotation(rotation[start]), 1, 2)
        if config.window_rotation == "per_sample":
            imu = np.einsum("tij,tkj->tki", rotation, imu)
        else:
            to_window = to_window @ rotation[start]
        rows = (start + offset).astype(np.int32)
        parts.append((imu.reshape(-1, 6).astype(np.float32), rows, to_window.astype(np.float32)))
        counts.append(len(start))
        offset += len(imu)
    imu, start, to_window = (jnp.asarray(np.concatenate(part)) for part in zip(*parts, strict=True))
    no_target = jnp.zeros((len(start), 3), jnp.float32)
    source = WindowSource(
        imu=imu,
        start=start,
        rotation=to_window,
        displacement=no_target,
        step=jnp.zeros_like(imu[:, :3]),
        unyaw=no_target[:, :2],
        visited=start,
    )
    return source, counts


def _integrated_gyro(prepared: Prepared, config: DataConfig) -> Float[np.ndarray, "t 3 3"]:
    """Body→world from the gyro without its bias, from the start."""
    rates = prepared.sequence.gyro[:-1] - prepared.gyro_bias
    turned = cumulative_rotation(Rotation.from_rotvec(rates / config.rate))
    return prepared.start.rotation @ turned.as_matrix()


def true_displacements(prepared: Prepared, config: DataConfig) -> Float[np.ndarray, "m 3"]:
    """Reference displacement of every window, m, in the yaw frame of the reference at its start;
    NaN where it cannot be trusted."""
    sequence, n, length = prepared.sequence, config.stride, config.window
    start = np.arange(0, len(sequence.time) - length, n)
    moved = sequence.position[start + length] - sequence.position[start]
    good = np.asarray(sequence.valid[start] & sequence.valid[start + length])
    result = np.full_like(moved, np.nan)
    turn = matrix_from_quaternion(sequence.orientation[start[good]])
    result[good] = np.einsum("mji,mj->mi", yaw_rotation(turn), moved[good])
    return result
