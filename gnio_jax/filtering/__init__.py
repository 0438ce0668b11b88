"""Stochastic-cloning extended Kalman filter: inertial propagation, displacement measurements,
network in the loop.

The network is any function from windows to a `Prediction`, or a network that carries a memory from
one clone interval to the next (`network`). `Filter` is the filter as one value, and `scan` runs it.
"""

from gnio_jax.config import ConsideredStd, CorrelatedError, FilterSettings, InitialStd, NoiseModel
from gnio_jax.filtering.barometer import Barometer, barometer_on_intervals
from gnio_jax.filtering.batch import cores_as_devices, over_sequences
from gnio_jax.filtering.consider import considered_covariance, sensitivity, with_considered
from gnio_jax.filtering.displacement import displacements
from gnio_jax.filtering.filter import Filter, make_filter
from gnio_jax.filtering.fix import Fix, fixes_on_intervals
from gnio_jax.filtering.history import FilterHistory, explain_failure
from gnio_jax.filtering.magnetometer import (
    FieldFit,
    Magnetometer,
    fit_field,
    magnetometer_on_intervals,
)
from gnio_jax.filtering.measurements import register
from gnio_jax.filtering.mounting import Mounting, find_mounting
from gnio_jax.filtering.nonholonomic import NonHolonomic
from gnio_jax.filtering.scan import run_filter, run_odometry
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.smoother import SmoothedHistory, smooth
from gnio_jax.filtering.start import initial_state, level_state
from gnio_jax.filtering.state import FilterState, GateState
from gnio_jax.filtering.tracker import Pose, Tracker
from gnio_jax.filtering.update import Linearised, Outcome, Step, linearise, measure
from gnio_jax.filtering.waypoints import WaypointPoses, waypoint_poses
from gnio_jax.filtering.wheel_speed import WheelSpeed, speeds_on_intervals
from gnio_jax.filtering.zero_velocity import ZeroVelocity

__all__ = [
    "Barometer",
    "ConsideredStd",
    "CorrelatedError",
    "FieldFit",
    "Filter",
    "FilterConfig",
    "FilterHistory",
    "FilterSettings",
    "FilterState",
    "Fix",
    "GateState",
    "InitialStd",
    "Linearised",
    "Magnetometer",
    "Mounting",
    "NoiseModel",
    "NonHolonomic",
    "Outcome",
    "Pose",
    "SmoothedHistory",
    "Step",
    "Tracker",
    "WaypointPoses",
    "WheelSpeed",
    "ZeroVelocity",
    "barometer_on_intervals",
    "considered_covariance",
    "cores_as_devices",
    "displacements",
    "explain_failure",
    "find_mounting",
    "fit_field",
    "fixes_on_intervals",
    "initial_state",
    "level_state",
    "linearise",
    "magnetometer_on_intervals",
    "make_filter",
    "measure",
    "over_sequences",
    "register",
    "run_filter",
    "run_odometry",
    "sensitivity",
    "smooth",
    "speeds_on_intervals",
    "waypoint_poses",
    "with_considered",
]
