"""Stochastic-cloning extended Kalman filter: inertial propagation, displacement measurements,
network in the loop.

Needs only JAX and the geometry: the network is any function from windows to a `Prediction`.
"""

from gnio_jax.filtering.batch import cores_as_devices, over_sequences
from gnio_jax.filtering.scan import FilterHistory, run_filter, run_odometry
from gnio_jax.filtering.smoother import SmoothedHistory, smooth, smooth_odometry
from gnio_jax.filtering.state import (
    FilterConfig,
    FilterState,
    GateState,
    InitialStd,
    NoiseModel,
    initial_state,
    level_state,
)
from gnio_jax.filtering.tracker import Pose, Tracker, TrackerState

__all__ = [
    "FilterConfig",
    "FilterHistory",
    "FilterState",
    "GateState",
    "InitialStd",
    "NoiseModel",
    "Pose",
    "SmoothedHistory",
    "Tracker",
    "TrackerState",
    "cores_as_devices",
    "initial_state",
    "level_state",
    "over_sequences",
    "run_filter",
    "run_odometry",
    "smooth",
    "smooth_odometry",
]
