"""Displacements summed to a path, as RoNIN-type baselines do."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gnio_jax.config import DataConfig
from gnio_jax.evaluation.estimators.result import Estimate, at_window_ends
from gnio_jax.evaluation.preparation import Prepared
from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.numerics import finite_rows, quaternion_from_matrix, yaw_rotation
from gnio_jax.types import Prediction


def integrate(
    prepared: Prepared,
    rotation: Float[np.ndarray, "t 3 3"],
    prediction: Prediction,
    config: DataConfig,
) -> Estimate:
    """The path whose every stride is what the windows over it predict, on average.

    `rotation` is the attitude at every sample with which the windows were cut, `prediction` holds
    one row for each window.
    """
    n, clones = config.stride, config.window // config.stride
    strides = prepared.strides(n)
    window_starts = n * np.arange(len(prediction.displacement))
    to_world = yaw_rotation(rotation[window_starts])
    steps = np.einsum("mij,mj->mi", to_world, prediction.displacement) / clones
    moved = np.cumsum(mean_over_windows(steps, strides, clones), 0)
    path = prepared.start.position + np.concatenate([np.zeros((1, 3)), moved])
    return Estimate(
        prepared.sequence.name,
        Trajectory(prepared.sequence.time[::n], path, quaternion_from_matrix(rotation[::n])),
        prepared.reference(n),
        displacement=at_window_ends(prediction.displacement, strides + 1),
        displacement_std=at_window_ends(np.exp(prediction.log_std), strides + 1),
        diagnostics={
            name: at_window_ends(value, strides + 1)
            for name, value in prediction.diagnostics.items()
        },
        notes=prepared.notes,
    )


def mean_over_windows(
    steps: Float[np.ndarray, "m 3"], strides: int, window: int
) -> Float[np.ndarray, "k 3"]:
    """Movement in each stride: the mean of displacement × stride/window (`steps`) over the windows
    that cover it. Window i covers strides i … i + `window` − 1.

    Taking the one window that starts (or ends) at the stride instead puts the whole trajectory half
    a window ahead of (or behind) its time: 0.6 m at walking speed. A stride without any window
    keeps the movement of the one before; those before all windows (the context of the first) take
    that of the first that has one.
    """
    good = finite_rows(steps)
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(np.where(good[:, None], steps, 0.0), 0)])
    counts = np.concatenate([[0], np.cumsum(good)])
    stride = np.arange(strides)
    first = np.clip(stride - window + 1, 0, len(steps))
    last = np.minimum(stride + 1, len(steps))
    covering = (counts[last] - counts[first])[:, None]
    moved = np.zeros((strides, 3))
    np.divide(sums[last] - sums[first], covering, out=moved, where=covering > 0)
    covered = covering[:, 0] > 0
    return moved[np.maximum.accumulate(np.where(covered, stride, int(np.argmax(covered))))]
