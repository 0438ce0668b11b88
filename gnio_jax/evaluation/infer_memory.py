"""The displacements of a network with memory along whole recordings, with their attitudes."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.config import DataConfig
from gnio_jax.evaluation.prepare import PreparedRecording
from gnio_jax.models import Network
from gnio_jax.models.inference import Stepwise
from gnio_jax.numerics import spans
from gnio_jax.types import Array, Prediction
from gnio_jax.windows import align_recording, remove_yaw

SHORTEST = 64
"""Approximate smallest number of strides to which a stretch is padded, by powers of 1.5."""


def remembered_displacements(
    network: Network,
    recording: PreparedRecording,
    windows: DataConfig,
    select: Callable[[Prediction], Prediction],
    least_std: float,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"], dict[str, np.ndarray]]:
    """Displacement and covariance over the window that ends with each stride, in the yaw frame of
    the window's start, and the selected diagnostics; float64, NaN where there is none.

    The memory begins anew after a stride with a sample that was not measured. Each stretch is one
    run of the network, in the frame of its first attitude.
    """
    assert recording.attitude is not None
    n, strides, clones = windows.stride, recording.strides, windows.window // windows.stride
    measured = np.ones(strides, bool)
    if recording.imu_valid is not None:
        measured = recording.imu_valid[: strides * n].reshape(strides, n).all(axis=1)
    rates = recording.gyro - recording.start.gyro_bias
    value, covariance = np.full((strides, 3), np.nan), np.full((strides, 3, 3), np.nan)
    diagnostics: dict[str, np.ndarray] = {}
    for first, end in spans(measured).tolist():
        if end - first < clones:
            continue
        rows = slice(first * n, end * n)
        origin = np.zeros(1, int)
        attitude = recording.attitude[rows]
        signals, turn = align_recording(
            recording.accel[rows], rates[rows], attitude, origin, windows.window_rotation
        )
        signals = (signals.reshape(len(signals), -1, 3) @ turn[0].T).reshape(signals.shape)
        prediction = run_network(network, signals, end - first, n, select)
        ends = np.arange(first + clones, end + 1) * n
        to_start = remove_yaw(recording.attitude[ends - windows.window])
        # From the frame of the first attitude to that of each window's start.
        turns = to_start @ remove_yaw(attitude[:1])[0].T
        of_windows = jax.tree.map(lambda leaf: np.asarray(leaf)[clones - 1 :], prediction)
        with np.errstate(divide="ignore"):
            in_frame = np.asarray(of_windows.covariance(np.log(least_std), np.float64))
        places = slice(first + clones - 1, end)
        value[places] = np.einsum("mij,mj->mi", turns, of_windows.displacement)
        covariance[places] = turns @ in_frame @ turns.transpose(0, 2, 1)
        for name, rows_of in of_windows.diagnostics.items():
            whole = diagnostics.setdefault(name, np.full((strides, *rows_of.shape[1:]), np.nan))
            whole[places] = rows_of
    return value, covariance, diagnostics


def run_network(
    network: Network,
    signals: Float[np.ndarray, "t c"],
    count: int,
    stride: int,
    select: Callable[[Prediction], Prediction],
) -> Prediction:
    """The network's prediction at the end of each of `count` strides, float64 on the host."""
    # What is appended comes after the stretch and changes nothing before it.
    exponent = math.ceil(math.log(max(count / SHORTEST, 1.0), 1.5))
    padded = max(math.ceil(SHORTEST * 1.5**exponent), count)
    signals = np.pad(signals, ((0, padded * stride - len(signals)), (0, 0)), "edge")
    predict = network.predict(select)
    assert isinstance(predict, Stepwise)
    rows = _run(predict.ready, signals.astype(np.float32), model=predict.model, every=stride)
    prediction = select(jax.device_get(rows))
    return jax.tree.map(lambda leaf: leaf[0, :count].astype(np.float64), prediction)


@functools.partial(jax.jit, static_argnames=("model", "every"))
def _run(ready: Any, signals: Float[Array, "t c"], *, model: Any, every: int) -> Prediction:
    arguments = model.begin(1), jnp.asarray(signals)[None], every
    return model.apply(ready.variables, *arguments, method="advance", **ready.constants)[1]
