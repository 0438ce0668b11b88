"""Whether a device looks where its carrier walks, by the gait.

A network with `model.equivariance: device_heading` expects a screen that faces up to look ahead.
Devices other than phones may have their axes otherwise. The network infers the direction from the
gait alone, too, and both are compared here.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gnio_jax.errors import InputError
from gnio_jax.evaluation import PreparedRecording
from gnio_jax.evaluation.infer import infer
from gnio_jax.models import Network
from gnio_jax.networks import TrainedNetwork
from gnio_jax.windows import window_starts

COMPARED_SECONDS = 60.0
"""Time from the start whose directions are compared, s (ours): the attitude is that of the
integrated gyro, which drifts."""
LEAST_MOVED = 0.3
"""Smallest displacement over a window that has a direction, m (ours)."""
LEAST_AGREEMENT = 0.5
"""Smallest length of the mean of the directions, as unit vectors, that is a direction itself
(ours)."""
LEAST_SECONDS = 10.0
"""Shortest time with a direction, over all windows of the screen's heading, s (ours)."""
MISALIGNED = 60.0
"""Angle from which the device does not look where its carrier walks, degrees (ours)."""


def uses_heading(trained: TrainedNetwork) -> bool:
    """Whether a network sees the heading of the device."""
    rotation = trained.config.filter.window_rotation or trained.config.data.window_rotation
    return getattr(trained.model, "hides_axes", False) and rotation != "hidden_axes"


def without_heading(trained: TrainedNetwork) -> TrainedNetwork:
    """The network with the axes of the device hidden, so that it infers the direction from the gait
    alone. Raises `InputError` for a network that sees no axes."""
    if not uses_heading(trained):
        problem = f"{trained.name} does not use the heading of the device"
        raise InputError("--heading gait", problem, "leave it out")
    settings = dataclasses.replace(trained.config.filter, window_rotation="hidden_axes")
    return trained._replace(config=dataclasses.replace(trained.config, filter=settings))


def misalignment(ready: PreparedRecording, trained: TrainedNetwork) -> float:
    """The angle from the direction in which the device looks to that in which the gait goes, in the
    mean over the windows of the first minute whose screen faces up for the network, degrees,
    positive to the left. NaN if these are few, or do not agree.

    A device looks to the left of its x axis, along the ground. `ready` has the attitude of the
    integrated gyro.
    """
    assert ready.attitude is not None
    windows = dataclasses.replace(trained.config.data, window_rotation="hidden_axes")
    strides = min(ready.strides, round(COMPARED_SECONDS / windows.stride_seconds))
    samples = strides * windows.stride
    if samples < windows.input_samples + windows.stride:
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
    start = window_starts(samples + 1, windows.input_samples, windows.stride)
    moved = displacements.value[-len(start) :, 0] + 1j * displacements.value[-len(start) :, 1]
    # The mean over the window with its context, as in `DeviceHeading`; windows begin at the yaw of
    # the device after the context.
    mean_of_window = np.full(windows.input_samples, 1 / windows.input_samples)
    up = np.convolve(attitude[:-1, 2, 2], mean_of_window, "valid")[start]
    least_up = getattr(trained.model, "least_up", -1.0)  # a network of your own may have no limit
    directed = (np.abs(moved) > LEAST_MOVED) & (up > least_up)  # not where it is NaN
    if directed.sum() * windows.stride_seconds < LEAST_SECONDS:
        return np.nan
    mean = np.mean(moved[directed] / np.abs(moved[directed]))
    return float(np.degrees(np.angle(mean / 1j))) if np.abs(mean) >= LEAST_AGREEMENT else np.nan
