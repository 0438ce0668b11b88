"""The types that datasets, networks and estimators share.

Units are SI (s, rad, m), quaternions are wxyz, the world is z-up with gravity (0, 0, -9.81) m/s².
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gnio_jax.errors import InputError as InputError

Array = jax.Array | np.ndarray

GRAVITY = 9.81
"""Magnitude of gravity in the world frame, m/s²."""

FASTEST_TURN, STRONGEST_FORCE = 100.0, 1000.0
"""Limits beyond the range of any gyro (rad/s) and accelerometer (m/s²) for navigation."""

STANDARD_G = 9.80665
"""The unit "G" in which phones report acceleration, m/s²."""


KITTI_LENGTHS = tuple(range(100, 900, 100))
"""Lengths of the pieces of a path over which KITTI's relative errors are taken, m."""


NONHOLONOMIC_LOG_FACTOR = "nonholonomic_log_factor"
"""Name of the diagnostics (2,) of a network that are the logarithms of the factors of both standard
deviations of the non-holonomic constraint."""


class Waypoints(NamedTuple):
    """Known positions at a few moments, instead of a pose at every sample."""

    time: Float[np.ndarray, "k"]
    """Increasing stamps on the clock of the sequence, s."""
    position: Float[np.ndarray, "k 2"]
    """Horizontal position, expressed in the frame of a map, m."""

    def problem(self, clock: Float[np.ndarray, "n"], reach: float, fewest: int) -> str:
        """The first condition that they do not meet, or an empty text: there are at least `fewest`,
        they are finite, and they increase from at most `reach` s before the first stamp of the
        sequence's `clock` to at most `reach` s after its last one."""
        time, position = self
        count = len(time)
        if time.ndim != 1 or position.shape != (count, 2):
            return f"have the shapes {time.shape} and {position.shape}, expected (k,) and (k, 2)"
        if count < fewest:
            return f"are {count}, at least {fewest} are needed"
        if not (np.isfinite(time).all() and np.isfinite(position).all()):
            return "are not all finite"
        if not (np.diff(time) > 0).all():
            return "do not increase in time"
        if time[0] < clock[0] - reach or time[-1] > clock[-1] + reach:
            return f"({time[0]:.2f} to {time[-1]:.2f} s) are not all on the IMU's clock"
        return ""


class Readings(NamedTuple):
    """Readings of a sensor beside the IMU, which has stamps of its own. `data.sensors` has the
    names of the sensors, the columns of their values, and the units."""

    time: Float[np.ndarray, "f"]
    """Increasing stamps on the clock of the sequence, s."""
    values: Float[np.ndarray, "f w"]
    """One reading in each row. A column that a reading does not have is NaN."""
    std: Float[np.ndarray, "f w"]
    """Standard deviations as the sensor states them; NaN where it states none."""


class Sequence(NamedTuple):
    """One recording: IMU and reference on one uniform clock. Host arrays in float64.

    Where the reference is missing, its arrays are NaN and `valid` is False.
    """

    name: str
    time: Float[np.ndarray, "n"]
    """Stamps, s, strictly increasing and uniform. Sample k drives the interval [t_k, t_{k+1}]."""
    gyro: Float[np.ndarray, "n 3"]
    """Angular rate in the IMU body frame, rad/s."""
    accel: Float[np.ndarray, "n 3"]
    """Specific force in the IMU body frame, m/s² (level at rest reads +9.81 on the up axis)."""
    orientation: Float[np.ndarray, "n 4"]
    """Reference body→world quaternion wxyz, unit norm, at the stamp of the sample."""
    position: Float[np.ndarray, "n 3"]
    """Reference position of the IMU in the world, m."""
    velocity: Float[np.ndarray, "n 3"]
    """Reference velocity in the world, m/s."""
    valid: Bool[np.ndarray, "n"]
    """True where the reference can be trusted. No window is cut that contains a False."""
    device_orientation: Float[np.ndarray, "n 4"] | None = None
    """The device's own estimate of its attitude, body→world with arbitrary yaw, if it gives one."""
    imu_valid: Bool[np.ndarray, "n"] | None = None
    """False where `gyro` and `accel` were interpolated across a gap; None if nothing is missing.
    The filter takes no measurement there (`filtering.gaps`)."""
    waypoints: Waypoints | None = None
    """Known positions at a few moments. A recording with no other reference is valid nowhere, and
    functions that need poses refuse it."""
    readings: dict[str, Readings] = {}
    """The readings of other sensors by the name of the sensor (`data.sensors`)."""
    attributes: dict[str, Any] = {}
    """The origin: dataset, session, group, subject, device, placement, truth, licence, ...
    (str, float or bool)."""

    @property
    def measured_rows(self) -> Int[np.ndarray, "m"]:
        """Rows of the IMU that were measured, and not interpolated across a gap."""
        mask = self.imu_valid
        return np.arange(len(self.time)) if mask is None else np.flatnonzero(mask)

    def with_reference_where(self, valid: Bool[np.ndarray, "n"]) -> Sequence:
        """The sequence with its reference where `valid` is True, and none elsewhere."""
        poses = (self.orientation, self.position, self.velocity)
        orientation, position, velocity = (np.where(valid[:, None], x, np.nan) for x in poses)
        return self._replace(
            orientation=orientation, position=position, velocity=velocity, valid=valid
        )


class Windows(NamedTuple):
    """A batch of training windows in the gravity-aligned frame whose first sample has zero yaw."""

    imu: Float[Array, "b n c"]
    """[accel m/s², gyro rad/s], the paper's channel order (eq. 1); with `window_rotation:
    body_axes` the x and y axes of the body are channels 6 to 11."""
    displacement: Float[Array, "b 3"]
    """Displacement over the window in the same frame, m."""
    steps: Float[Array, "b n 3"]
    """Parts of the displacement, from each sample's stamp to the next, m. They train a network that
    predicts a velocity for every sample."""


Quantity = Literal["displacement", "velocity"]
"""What a filter can measure of a network: the displacement over its window, or its velocity."""


class Velocity(NamedTuple):
    """The velocity that a network predicts for the end of its window, in metres per window."""

    value: Float[Array, "*b 3"]
    """In the body."""
    log_std: Float[Array, "*b 3"]
    """Logarithm of its standard deviation, per axis of the body."""


class Prediction(NamedTuple):
    """The prediction of a network for a window."""

    displacement: Float[Array, "*b 3"]
    """m, in the gravity-aligned zero-yaw frame of the window's start."""
    log_std: Float[Array, "*b 3"]
    """Logarithm of the standard deviation of `displacement`, per axis."""
    diagnostics: dict[str, Array] = {}
    """Internal values for inspection: `gate`, `scale` (b, 3), `attention` (b, heads, m), if the
    model has them."""
    axes: Float[Array, "*b 2"] | None = None
    """Cosine and sine of the angle about z by which the axes of `log_std` are turned; None: they
    are those of `displacement`. With turned axes the covariance is full in the plane."""
    velocity: Velocity | None = None
    """The velocity in the body, if the network predicts one."""

    def with_quantity(self, quantity: Quantity) -> Prediction:
        """The prediction with the measured quantity in the place of its displacement. Raises
        `ValueError` for a velocity that the network does not predict."""
        if quantity == "displacement":
            return self
        if self.velocity is None:
            raise ValueError("filter.measures: is velocity, which this network does not predict")
        value, log_std = self.velocity
        return self._replace(displacement=value, log_std=log_std, axes=None)

    def covariance(self, least: float, dtype: Any) -> Float[jax.Array, "*b 3 3"]:
        """Covariance of `displacement`, m²: A diag(exp 2u) Aᵀ with the axes A, u raised to
        `least`."""
        variance = jnp.exp(2 * jnp.maximum(jnp.asarray(self.log_std, dtype), least))
        if self.axes is None:
            return jnp.vectorize(jnp.diag, signature="(d)->(d,d)")(variance)
        cosine, sine = jnp.moveaxis(jnp.asarray(self.axes, dtype), -1, 0)
        x, y = variance[..., 0], variance[..., 1]
        zero, cross = jnp.zeros_like(x), cosine * sine * (x - y)
        rows = (
            (cosine**2 * x + sine**2 * y, cross, zero),
            (cross, sine**2 * x + cosine**2 * y, zero),
            (zero, zero, variance[..., 2]),
        )
        return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)

    def along_axes(self, error: Float[jax.Array, "*b d"]) -> Float[jax.Array, "*b d"]:
        """Errors of the first d axes (2 or 3), expressed in the axes of `log_std`."""
        if self.axes is None:
            return error
        cosine, sine = jnp.moveaxis(jnp.asarray(self.axes), -1, 0)
        x, y = error[..., 0], error[..., 1]
        plane = jnp.stack([cosine * x + sine * y, cosine * y - sine * x], axis=-1)
        return jnp.concatenate([plane, error[..., 2:]], axis=-1)

    def normalise(
        self, error: Float[jax.Array, "*b d"], least: float | None
    ) -> tuple[Float[jax.Array, "*b d"], Float[jax.Array, "*b d"]]:
        """(e/σ)² of errors of the first d axes, m, along the axes of `log_std`, and log σ, with the
        same covariance. Without its constant, −log N(e) is Σ ½ (e/σ)² + log σ."""
        error = self.along_axes(error)
        log_std = jnp.asarray(self.log_std)[..., : error.shape[-1]]
        log_std = log_std if least is None else jnp.maximum(log_std, least)
        return error**2 * jnp.exp(-2 * log_std), log_std


class Memory(NamedTuple):
    """The memory of a network that carries a state from one clone interval to the next, and the
    frame in which it is expressed: gravity on z, and a heading of its own (`models.memory`)."""

    network: Any
    """The network's state: arrays in float32."""
    heading: Float[Array, "2"]
    """Cosine and sine of the yaw that turns the frame to the world; zeros before the first step."""
    attitude: Float[Array, "3 3"]
    """Attitude at the end of the last interval as it was estimated then, body → world."""
    intervals: Int[Array, ""]
    """Number of intervals since the memory began."""
