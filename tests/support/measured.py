"""A displacement between two clones, linearised at given poses."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import filtering
from gnio_jax.filtering.displacement import Displacement, linearise_displacement
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.update import Step

CONFIG = filtering.FilterConfig(0.01, 1, 1)
NO_IMU = Imu(np.zeros((1, 3)), np.zeros((1, 3)), None)


class Residual(NamedTuple):
    innovation: jax.Array
    jacobian: jax.Array
    """By θ and p of the oldest clone, and p of the newest."""
    defined: jax.Array


def displacement_residual(rotation, moved, displacement, frame="given"):
    """The residual of a displacement where the oldest clone has this rotation and `moved` leads
    from it to the newest."""
    nothing = jnp.zeros(3)
    state = filtering.initial_state(CONFIG, jnp.eye(3), nothing, nothing)
    clones = jnp.stack([rotation, jnp.eye(3)]), jnp.stack([-moved, nothing])
    state = state._replace(clone_rotation=clones[0], clone_offset=clones[1])
    measured = Displacement(displacement, jnp.eye(3), jnp.bool_(True), frame)
    step = Step(NO_IMU, 1, 0, CONFIG, filtering.NoiseModel())
    linear, defined = linearise_displacement(measured, state, step)
    by_moved = linear.jacobian["since_oldest"]
    by_rotation = linear.jacobian["oldest_rotation"]
    jacobian = jnp.concatenate([by_rotation, -by_moved, by_moved], axis=1)
    return Residual(linear.residual, jacobian, defined)
