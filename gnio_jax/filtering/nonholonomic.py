"""The non-holonomic constraint of a vehicle as a measurement: a point of it moves neither sideways
nor up (Dissanayake et al. 2001; in every step with a learnt covariance: Brossard et al. 2020,
AI-IMU).

With the rotation C (car ← body) and the lever l from the IMU to the point, in the body,

    0 = [C (Rᵀ v + (ω − b_g) × l)]_{left, up} + w,   w ~ N(0, diag(σ_left², σ_up²)).

A car that the road pushes is not aimed where it goes. Pushed ahead, its springs raise the nose by
the angle γ_p f_ahead. Pushed to the left, its rear tyres slip by the angle γ_s f_left, driving
backwards, too. With the specific force f = C (f_m − b_a), f_m its mean over the interval, the
constraint is

    0 = u_{left, up} + [γ_s f_left |u_ahead|, γ_p f_ahead u_ahead] + w

for the velocity u = C (Rᵀ v + …) above. Both gradients are zero by default.

σ_left and σ_up are constants. A network in the filter's loop may say by which factors they change
from interval to interval (`models.ai_imu`).

The velocities that remain are some centimetres a second and last for seconds. They come from the
springs, the slope of the road and an error of C. So the errors of successive intervals are not
independent, and a σ must be several times their size.

The three angles and the lever are settings. Their errors may be states of the filter, as in AI-IMU:

    C ← exp(ε) C,   l ← l + λ,

with ε in the axes of the car. λ is constant, and ε a first-order Gauss–Markov process, or constant
too. Both are held in units of their standard deviations (`FilterState.correlated`).
`gnio_jax.filtering.mounting` finds the angles in a whole drive.
"""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax.config.schema import ABOVE_ZERO, FINITE, NOT_NEGATIVE, Number
from gnio_jax.filtering.state import OF_LEVER, OF_MOUNTING, FilterState
from gnio_jax.filtering.update import Correction, Outcome, Step, linearise, measure
from gnio_jax.geometry import exp, hat, matmul, right_jacobian
from gnio_jax.types import NONHOLONOMIC_LOG_FACTOR, Array

THRESHOLD = 13.816
"""99.9 % of χ² with two degrees of freedom."""


class MountingErrors(NamedTuple):
    """Errors of the mounting that are states of the filter."""

    turn: Float[Array, "3"]
    """ε, in the axes of the car, rad."""
    lever: Float[Array, "3"]
    """λ, in the body, m."""
    turn_std: Float[Array, ""]
    """Standard deviation of each component of ε before all measurements, rad."""
    lever_std: Float[Array, ""]
    """That of λ, m."""


class NonHolonomic(NamedTuple):
    """Measures a velocity of zero to the left and up of a car."""

    lateral_std: Annotated[Number, ABOVE_ZERO] = 1.0
    """Standard deviation of the velocity to the left, m/s."""
    vertical_std: Annotated[Number, ABOVE_ZERO] = 1.0
    """Standard deviation of the velocity up, m/s."""
    yaw: Annotated[Number, FINITE] = 0.0
    """Mounting of the IMU, body ← car: R_z(yaw) R_y(pitch) R_x(roll), where the car's axes point
    ahead, left and up, rad. With zeros the body's axes are the car's."""
    pitch: Annotated[Number, FINITE] = 0.0
    roll: Annotated[Number, FINITE] = 0.0
    lever_x: Annotated[Number, FINITE] = 0.0
    """Lever from the IMU to the point that does not move sideways, in the body, m. In a car that is
    steered in front this point is the middle of the rear axle."""
    lever_y: Annotated[Number, FINITE] = 0.0
    lever_z: Annotated[Number, FINITE] = 0.0
    pitch_gradient: Annotated[Number, FINITE] = 0.0
    """γ_p: pitch of the car on its springs, nose up, for a specific force ahead, rad per m/s²."""
    sideslip_gradient: Annotated[Number, FINITE] = 0.0
    """γ_s: angle by which the rear tyres slip outwards in a bend, for a specific force towards its
    inside, rad per m/s²."""
    mounting_std: Annotated[Number, NOT_NEGATIVE] | None = None
    """Standard deviation of each component of ε, rad. The filter estimates ε and λ if this or
    `lever_std` is a number; the other one is then zero."""
    mounting_seconds: Annotated[Number, ABOVE_ZERO] | None = None
    """Correlation time of ε, s; None: it is constant."""
    lever_std: Annotated[Number, NOT_NEGATIVE] | None = None
    """Standard deviation of each component of λ, m."""
    name = "nonholonomic"
    needs = MappingProxyType({"mounting_seconds": "mounting_std"})
    """Numbers that have no effect without another one."""

    @property
    def lever(self) -> tuple[Number, Number, Number]:
        return self.lever_x, self.lever_y, self.lever_z

    @property
    def estimates_mounting(self) -> bool:
        """Whether ε and λ are states of the filter."""
        return self.mounting_std is not None or self.lever_std is not None

    @property
    def correlation_times(self) -> tuple[Number, ...]:
        """Those of ε and λ, s, if they are states."""
        constant = math.inf
        of_mounting = constant if self.mounting_seconds is None else self.mounting_seconds
        return (*3 * (of_mounting,), *3 * (constant,)) if self.estimates_mounting else ()

    def mounting_errors(self, state: FilterState) -> MountingErrors:
        """The filter's estimate of ε and λ. Raises `ValueError` for a state without them, as the
        start of a run is."""
        if len(state.correlated) < len(self.correlation_times):
            problem = "the state has no errors of the mounting yet"
            raise ValueError(f"state.correlated: {problem}; take the final state of a run")
        dtype = state.offset.dtype
        stds = (0.0 if std is None else std for std in (self.mounting_std, self.lever_std))
        turn_std, lever_std = (jnp.asarray(std, dtype) for std in stds)
        turn, lever = state.correlated[OF_MOUNTING], state.correlated[OF_LEVER]
        return MountingErrors(turn_std * turn, lever_std * lever, turn_std, lever_std)

    def mounting_at(self, state: FilterState) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """C, car ← body, and the lever l, m, with the filter's estimate of their errors, as the
        final state of a run has it."""
        dtype = state.offset.dtype
        axes = car_axes(self.yaw, self.pitch, self.roll).astype(dtype)
        lever = jnp.stack([jnp.asarray(x, dtype) for x in self.lever])
        if self.estimates_mounting:
            errors = self.mounting_errors(state)
            axes, lever = matmul(exp(errors.turn), axes), lever + errors.lever
        return axes, lever

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]:
        """Where the car slides sideways or jumps, the measurement fails a χ² test of 99.9 % and is
        refused. There is none where the last sample of the interval is missing. Where a network
        says no factors, as before its first window, the standard deviations are the constants."""
        dtype = state.offset.dtype
        std = jnp.stack([jnp.asarray(number, dtype) for number in self[:2]])
        if NONHOLONOMIC_LOG_FACTOR in step.diagnostics:
            log_factor = step.diagnostics[NONHOLONOMIC_LOG_FACTOR].astype(dtype)
            finite = jnp.isfinite(log_factor).all()
            std = std * jnp.exp(jnp.where(finite, log_factor, 0.0))
        axes, lever = self.mounting_at(state)
        in_body, present = velocity_of_point(state, step, lever)
        velocity = matmul(axes, in_body[:, None])[:, 0]
        force = matmul(axes, mean_force(state, step)[:, None])[:, 0]
        # Both angles times the speed, for the left and up, and their derivatives.
        speed, slip = velocity[0], self.sideslip_gradient * jnp.abs(velocity[0])
        rise = self.pitch_gradient * speed
        slopes = jnp.stack(
            [self.sideslip_gradient * force[1] * jnp.sign(speed), self.pitch_gradient * force[0]]
        )
        predicted = velocity[1:] + jnp.stack([slip * force[1], rise * force[0]])
        by_velocity = jnp.concatenate([slopes[:, None], np.eye(2, dtype=dtype)], axis=1)
        by_force = jnp.zeros((2, 3), dtype).at[0, 1].set(slip).at[1, 0].set(rise)

        by_body_velocity = matmul(by_velocity, axes)
        of_velocity = matmul(by_body_velocity, state.rotation.T)
        jacobian = {
            "velocity": of_velocity,
            "rotation": matmul(of_velocity, hat(state.velocity)),
            "gyro_bias": matmul(by_body_velocity, hat(lever)),
            "accel_bias": -matmul(by_force, axes),
        }
        if self.estimates_mounting:
            errors, rate = self.mounting_errors(state), step.imu.gyro[-1] - state.gyro_bias
            by_turn = matmul(by_velocity, hat(velocity)) + matmul(by_force, hat(force))
            left_jacobian = right_jacobian(errors.turn).T
            jacobian["mounting"] = -errors.turn_std * matmul(by_turn, left_jacobian)
            jacobian["lever"] = errors.lever_std * matmul(by_body_velocity, hat(rate))
        residual = jnp.where(present, -predicted, jnp.nan)
        linear = linearise(state, residual, jnp.diag(std**2), **jacobian)
        return measure(state, linear, step, THRESHOLD)


def velocity_of_point(
    state: FilterState, step: Step, lever: Float[Array, "3"]
) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """Rᵀ v + (ω − b_g) × l with the last sample of the interval, and whether this was measured."""
    rate, present = step.imu.gyro[-1] - state.gyro_bias, jnp.bool_(True)
    if step.imu.gap is not None:
        present = ~step.imu.gap.missing[-1]
    velocity = matmul(state.rotation.T, state.velocity[:, None])[:, 0] + jnp.cross(rate, lever)
    return velocity, present


def mean_force(state: FilterState, step: Step) -> Float[Array, "3"]:
    """Mean specific force of the samples of the interval that were measured, without the bias; the
    negative bias if there is none."""
    imu = step.imu
    if imu.gap is None:
        return jnp.mean(imu.accel, axis=0) - state.accel_bias
    measured = ~imu.gap.missing
    sums = jnp.sum(jnp.where(measured[:, None], imu.accel, 0.0), axis=0)
    return sums / jnp.maximum(jnp.sum(measured), 1) - state.accel_bias


def car_axes(yaw: Number, pitch: Number, roll: Number) -> Float[Array, "3 3"]:
    """C, car ← body: its rows are the car's axes ahead, left and up in the body."""
    turns = []
    for angle, (i, j) in ((roll, (1, 2)), (pitch, (2, 0)), (yaw, (0, 1))):
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        turn = jnp.eye(3).at[i, i].set(cosine).at[j, j].set(cosine)
        turns.append(turn.at[i, j].set(sine).at[j, i].set(-sine))
    return matmul(turns[0], matmul(turns[1], turns[2]))
