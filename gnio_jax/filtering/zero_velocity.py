"""The velocity at rest as a measurement (ours): the IMU is quiet, so the velocity is zero.

The paper's gated head makes displacements small at rest instead.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.gate import gate_activity
from gnio_jax.filtering.state import CLONE, VELOCITY, FilterState
from gnio_jax.filtering.update import Correction, apply_correction, relinearize, whiten
from gnio_jax.types import GRAVITY, Array


class RestUpdate(NamedTuple):
    """What became of the velocity measured as zero; False and zero where it was not."""

    quiet: Bool[Array, ""]
    """Whether the IMU was quiet for long enough."""
    nis: Float[Array, ""]
    """vᵀ S⁻¹ v."""
    accepted: Bool[Array, ""]


def no_rest(dtype: np.dtype) -> RestUpdate:
    """Where rest is no measurement."""
    return RestUpdate(jnp.bool_(False), jnp.zeros((), dtype), jnp.bool_(False))


def detect_rest(
    state: FilterState, imu: Imu, config: FilterConfig
) -> tuple[FilterState, Bool[Array, ""]]:
    """Whether the IMU has been quiet for `rest_seconds` (ours), and the state with the intervals
    that it has been so counted on."""
    gyro, force = imu.gyro - state.gyro_bias[None], imu.accel - state.accel_bias[None]
    size = jnp.sqrt(jnp.maximum(jnp.sum(force**2, axis=1), 1e-12))
    still = jnp.all(jnp.sum(gyro**2, axis=1) < config.rest_gyro**2)
    quiet = still & jnp.all(jnp.abs(size - GRAVITY) < config.rest_accel)
    if imu.gap is not None:
        quiet = quiet & jnp.all(imu.gap.gyro_variance == 0)
    count = jnp.where(quiet, state.imu.quiet + 1, 0).astype(state.imu.quiet.dtype)
    enough = int(np.ceil(config.rest_seconds / (config.dt * config.samples_per_clone) - 1e-6))
    return state._replace(imu=state.imu._replace(quiet=count)), count >= max(enough, 1)


def update_at_rest(
    state: FilterState,
    quiet: Bool[Array, ""],
    displacement_tested: Bool[Array, ""],
    newest: Array | int,
    config: FilterConfig,
) -> tuple[FilterState, RestUpdate, Correction]:
    """One EKF update with the velocity measured as zero, if `quiet` (ours).

    A quiet IMU may also glide at constant velocity, and a displacement of the same interval can
    tell. So where one was tested and the gate is active, this measurement has to pass the same χ²
    test. Elsewhere the filter may be wrong about its velocity, and rest is what can tell it: after
    the start, after a series of rejections, and where there are no displacements. Without them the
    gate never becomes stale, and a rest refused once would be refused for ever. The gate's memory
    is that of the displacements alone: a false rest must not open their gate, nor keep it shut.
    """
    dtype = state.velocity.dtype
    noise = config.zero_velocity_std**2 * np.eye(3, dtype=dtype)
    spread = jnp.where(quiet, state.core_covariance[VELOCITY, VELOCITY], 0.0) + noise
    jacobian = jnp.eye(len(state.core_covariance), dtype=dtype)[VELOCITY]
    rows = (state.core_covariance[VELOCITY], state.cross_covariance[VELOCITY], jacobian)
    (velocity, *rows), _ = whiten(spread, (state.velocity[:, None], *rows))
    whitened = -velocity[:, 0]
    nis = jnp.dot(whitened, whitened)
    fits = nis <= config.gate_threshold
    active = gate_activity(state.gate, config, state.step * config.samples_per_clone).active
    accepted = quiet & (~(active & displacement_tested) | fits)
    core_rows, clone_rows, core_jacobian = (jnp.where(accepted, part, 0.0) for part in rows)
    of_oldest = jnp.zeros((3, CLONE), dtype)
    correction = Correction(whitened, core_rows, clone_rows, core_jacobian, of_oldest)
    state = relinearize(apply_correction(state, correction, newest), accepted & ~fits)
    return state, RestUpdate(quiet, jnp.where(quiet, nis, 0.0), accepted), correction
