"""The velocity in the body that a network predicts, as a measurement (AirIO): h = Rᵀ v."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import jax.numpy as jnp

from gnio_jax import geometry
from gnio_jax.config.schema import ABOVE_ZERO, Number
from gnio_jax.filtering.state import FilterState
from gnio_jax.filtering.update import Correction, Outcome, Step, linearise, measure


class BodyVelocity(NamedTuple):
    """Measures the last velocity of the network's window, in the place of its displacement.

    The network says it in the diagnostics `body_velocity` and `body_velocity_log_std` (m, 3), in
    metres per window. A run with given displacements, without a network, has no such measurement.
    """

    scale: Annotated[Number, ABOVE_ZERO] = 0.1
    """Factor of the predicted variance (AirIO: 0.1)."""
    name = "body_velocity"
    needs = ("body_velocity", "body_velocity_log_std")
    """The diagnostics of the network that are measured in the place of its displacement."""

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]:
        dtype, config = state.velocity.dtype, step.config
        seconds, nothing = config.window * config.dt, jnp.full((1, 3), jnp.nan)
        velocity, log_std = (
            step.diagnostics.get(name, nothing)[-1].astype(dtype) for name in self.needs
        )
        present = jnp.isfinite(velocity) & jnp.isfinite(log_std)
        variance = self.scale * jnp.exp(2 * jnp.where(present, log_std, 0.0)) / seconds**2
        to_body = state.rotation.T
        residual = jnp.where(present, velocity / seconds - to_body @ state.velocity, jnp.nan)
        jacobian = {"velocity": to_body, "rotation": to_body @ geometry.hat(state.velocity)}
        linear = linearise(state, residual, jnp.diag(variance), **jacobian)
        return measure(state, linear, step)
