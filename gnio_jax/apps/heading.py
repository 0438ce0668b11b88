"""Whether a device looks where its carrier walks, by the gait.

A network with `model.equivariance: device_heading` expects a screen that faces up to look ahead.
Devices other than phones may have their axes otherwise. The network infers the direction from the
gait alone, too, and this is compared with the axes here.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gnio_jax.errors import InputError
from gnio_jax.evaluation import PreparedRecording
from gnio_jax.evaluation.infer import infer
from gnio_jax.models import Network
from gnio_jax.models.equivariance import LEAST_UP
from gnio_jax.networks import TrainedNetwork

COMPARED_SECONDS = 60.0
"""Time from the start whose directions are compared, s (ours): the attitude is that of the
integrated gyro, which drifts."""
LEAST_MOVED = 0.3
"""Smallest displacement over a window that has a direction, m (ours)."""
LEAST_AGREEMENT = 0.5
"""Smallest length of the mean of the directions, as unit vectors, that is a direction itself
(ours)."""
BESIDE = 60.0
"""Angle from which the device does not look where its carrier walks, degrees (ours)."""


def uses_heading(trained: TrainedNetwork) -> bool:
    """Whether a network sees the heading of the device."""
    hides = getattr(trained.model, "hides_axes", False)
    return hides and trained.config.filter.window_rotation != "hidden_axes"


def without_heading(trained: TrainedNetwork) -> TrainedNetwork:
    """The network that infers the direction from the gait alone. Raises `InputError` if it has no
    other source."""
    if not uses_heading(trained):
        problem = f"{trained.name} does not use the heading of the device"
        raise InputError("--heading gait", problem, "leave it out")
    settings = dataclasses.replace(trained.config.filter, window_rotation="hidden_axes")
    return trained._replace(config=dataclasses.replace(trained.config, filter=settings))


def angle_beside(ready: PreparedRecording, trained: TrainedNetwork) -> float:
    """The angle from the direction in which the device looks (its y axis) to that in which the gait
    goes, while the screen faces up, in the mean over the first minute, degrees, positive to the
    left. NaN if there is none.

    `ready` has the attitude of the integrated gyro.
    """
    windows = dataclasses.replace(trained.config.data, window_rotation="hidden_axes")
    strides = min(ready.strides, round(COMPARED_SECONDS / windows.stride_seconds))
    samples = strides * windows.stride
    if samples < windows.input_samples + windows.stride or ready.attitude is None:
        return np.nan
    attitude = ready.attitude[: samples + 1]
    minute = ready._replace(
        time=ready.time[: strides + 1],
        gyro=ready.gyro[:samples],
        accel=ready.accel[:samples],
        imu_valid=None if ready.imu_valid is None else ready.imu_valid[:samples],
        attitude=attitude,
    )
    network = Network.of(trained.model, trained.variables)
    (displacements,) = infer(network, [minute], windows)
    moved = displacements.value[:, 0] + 1j * displacements.value[:, 1]
    up = attitude[windows.stride :: windows.stride, 2, 2]
    directed = (np.abs(moved) > LEAST_MOVED) & (up > LEAST_UP)  # not where it is NaN
    if not directed.any():
        return np.nan
    mean = np.mean(moved[directed] / np.abs(moved[directed]))
    return float(np.degrees(np.angle(mean / 1j))) if np.abs(mean) >= LEAST_AGREEMENT else np.nan
