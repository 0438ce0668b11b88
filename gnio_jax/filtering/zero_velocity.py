"""The velocity at rest as a measurement (ours): the IMU is quiet, so the velocity is zero.

The paper's gated head makes displacements small at rest instead.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import geometry
from gnio_jax.config.schema import ABOVE_ZERO, Number
from gnio_jax.filtering.displacement import gate_activity
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import FilterState
from gnio_jax.filtering.update import Correction, Outcome, Step, linearise, measure
from gnio_jax.types import GRAVITY, Array


class ZeroVelocity(NamedTuple):
    """Measures a velocity of zero while the IMU is quiet."""

    std: Annotated[Number, ABOVE_ZERO] = 0.02
    """Standard deviation of the velocity at rest along each axis of the body, m/s."""
    name = "zero_velocity"

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]:
        """Apply the measurement, after a χ² test where a displacement was tested and the gate is
        active: a quiet IMU may also move at constant velocity, which a displacement of the same
        interval shows. In all other cases the filter's velocity may be wrong, and rest can correct
        it: after the start, after a series of rejections, and where there are no displacements.
        Without displacements no gate would open again, and a rest that was refused once would
        always be refused. So there the test is made only in the first `rest_test_seconds` after a
        rest counts (ours), against the moments in which a smooth road is quiet. A true stop that is
        shorter than this corrects no velocity of which the filter is wrongly sure.

        The gate's memory depends on the displacements alone, because a false rest must neither open
        nor close their gate. `mahalanobis_fail_scale` and `gate_softness` are not for rest.
        """
        config = step.config
        state, quiet = detect_rest(state, step.imu, config)
        eye = np.eye(3, dtype=state.velocity.dtype)
        # In the body, where an error of the attitude has no part in a velocity of zero.
        to_body = state.rotation.T
        residual = jnp.where(quiet, -(to_body @ state.velocity), jnp.nan)
        jacobian = {"velocity": to_body, "rotation": to_body @ geometry.hat(state.velocity)}
        linear = linearise(state, residual, self.std**2 * eye, **jacobian)
        active, _ = gate_activity(state.gate, config, state.step * config.samples_per_clone)
        displacement = step.before["displacement"]
        tested = active & displacement.tested
        if config.rest_test_seconds > 0:
            times = config.rest_seconds, config.rest_test_seconds
            young = state.imu.quiet < sum(intervals_of(seconds, config) for seconds in times)
            tested = tested | (young & ~displacement.present)
        return measure(state, linear, step, jnp.where(tested, config.gate_threshold, jnp.inf))


def detect_rest(
    state: FilterState, imu: Imu, config: FilterConfig
) -> tuple[FilterState, Bool[Array, ""]]:
    """Whether the IMU has been quiet for `rest_seconds` (ours), and the state with the count of
    quiet intervals in a row.

    An interval is quiet as `is_quiet` says, if no sample is missing.
    """
    quiet = is_quiet(*unbiased_output(imu, state), config)
    if imu.gap is not None:
        quiet = quiet & jnp.all(~imu.gap.missing)
    count = jnp.where(quiet, state.imu.quiet + 1, 0).astype(state.imu.quiet.dtype)
    enough = intervals_of(config.rest_seconds, config)
    return state._replace(imu=state.imu._replace(quiet=count)), count >= enough


def intervals_of(seconds: float, config: FilterConfig) -> int:
    """The smallest number of clone intervals, at least one, that last for a time."""
    return max(int(np.ceil(seconds / config.clone_seconds - 1e-6)), 1)


def unbiased_output(
    imu: Imu, state: FilterState
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Rate, rad/s, and specific force, m/s², without their biases. Where the low-pass of the IMU
    was undone, which enlarges its noise, they are those behind it."""
    gyro, accel = (imu.gyro, imu.accel) if imu.output is None else imu.output
    return gyro - state.gyro_bias[None], accel - state.accel_bias[None]


def is_quiet(
    rate: Float[Array, "n 3"], force: Float[Array, "n 3"], config: FilterConfig
) -> Bool[Array, ""]:
    """Whether the samples of an interval are quiet, or with `rest_by: means` their mean: the rate
    without its bias, rad/s, is below `rest_gyro`, and the specific force, m/s², differs from
    gravity by less than `rest_accel`."""
    if config.rest_by == "means":
        rate, force = (jnp.mean(part, axis=0, keepdims=True) for part in (rate, force))
    size = jnp.sqrt(jnp.maximum(jnp.sum(force**2, axis=1), 1e-12))
    still = jnp.sum(rate**2, axis=1) < config.rest_gyro**2
    return jnp.all(still & (jnp.abs(size - GRAVITY) < config.rest_accel))
